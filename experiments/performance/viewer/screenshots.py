"""Screenshots of the viewer: ``python -m experiments.performance.viewer.screenshots``.

The thorax phantom at each stage of its use and at three sizes of the window, and ``viewer.jpg`` for
the documentation.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from experiments.performance.viewer.browser import Browser, Window, viewer

SIZES = ((1400, 900), (800, 600), (1920, 1080))
PICTURE = (1200, 800)
VIEW = ("phantom:thorax:190,120,165", "--preset", "ct-chest", "-D", "radiance=2")
#: Relative error of the caches in percent.
TARGET = 4


def edit(window: Window) -> None:
    """Raise the opacity of bone."""
    window.drag_point(9, 300, 0.7)
    window.page.wait_for_timeout(4000)


def turn_light(window: Window) -> None:
    """Light from the upper right."""
    window.page.locator("irrcache-light canvas").click(position={"x": 55, "y": 20})
    window.page.wait_for_timeout(4000)


def swipe(window: Window) -> None:
    """Compare with volpath, after its first sample."""
    window.choose("compare", "swipe")
    window.wait_for("volpath, [0-9]+ sample", 240)


def error(window: Window) -> None:
    """Show the error in false colours."""
    window.choose("compare", "error")
    window.page.locator("#irrcache-overlay .scale").wait_for(timeout=240_000)


def marks(window: Window) -> None:
    """Mark the pixels whose error bar exceeds the target."""
    window.choose("compare", "off")
    window.choose("show", "image, errors")
    window.page.wait_for_timeout(4000)


def crop(window: Window) -> None:
    """Fold out the crop box and the slices."""
    window.choose("show", "image")
    window.unfold("Transfer function")
    window.unfold("Crop and slices")
    window.page.wait_for_timeout(2000)


STAGES: tuple[Callable[[Window], None], ...] = (edit, turn_light, swipe, error, marks, crop)


def main() -> None:
    """Take the screenshots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("output/viewer"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    with viewer(VIEW, args.output / "screenshots.log") as address, Browser() as browser:
        window = browser.open(address, PICTURE)
        window.page.locator("#irrcache-overlay .message:visible").wait_for(timeout=60_000)
        take(window, args.output / "waiting.jpg")
        window.wait_for("per pixel", 240)
        window.unfold("Scattering and error")
        window.enter("target error %", TARGET)
        window.unfold("Scattering and error")
        window.orbit(10, 4, 0.03, first=150)
        window.wait_for("^final", 600)
        window.page.get_by_text("View", exact=True).scroll_into_view_if_needed()
        take(window, args.output / "viewer.jpg")
        window.page.close()
        for size in SIZES:
            window = browser.open(address, size)
            window.wait_for("at rest|final", 240)
            take(window, args.output / f"start-{size[0]}.jpg")
            for stage in STAGES:
                stage(window)
                take(window, args.output / f"{stage.__name__}-{size[0]}.jpg")
            print(size, "errors in the console:", window.errors or "none")
            window.page.close()


def take(window: Window, file: Path) -> None:
    """Take a screenshot."""
    window.page.screenshot(path=str(file), type="jpeg", quality=90)


if __name__ == "__main__":
    main()
