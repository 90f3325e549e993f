"""Screenshots of the viewer for the README: ``python -m
experiments.performance.viewer.screenshots``.

The thorax phantom with the panel open, and the same beside volpath after ``--seconds`` of it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from experiments.performance.viewer.browser import Browser, Window, viewer

SIZE = (1100, 620)
VIEW = (
    "phantom:thorax:190,120,165", "--preset", "ct-chest", "-D", "hide_emitters=true",
    "-D", "radiance=2",
)  # fmt: skip
#: Relative error of the caches in percent.
TARGET = 2


def main() -> None:
    """Take the screenshots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("output/viewer"))
    parser.add_argument("--seconds", type=float, default=60.0, help="for volpath")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    with viewer(VIEW, args.output / "screenshots.log") as address, Browser() as browser:
        window = browser.open(address, SIZE)
        window.wait_for("per pixel", 60)
        window.enter("target error %", TARGET)
        window.orbit(10, 6, 0.03, first=150)
        window.wait_for("^final", 120)
        take(window, args.output / "viewer.jpg")
        window.tick("compare with volpath")
        window.wait_for("RMSE", 120)
        time.sleep(args.seconds)
        take(window, args.output / "comparison.jpg")


def take(window: Window, file: Path) -> None:
    """Take a screenshot without viser's temporary notifications."""
    window.page.add_style_tag(content="[class*=Notification] {display: none !important}")
    window.page.mouse.move(150, SIZE[1] - 5)
    window.page.screenshot(path=str(file), type="jpeg", quality=90)


if __name__ == "__main__":
    main()
