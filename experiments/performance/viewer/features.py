"""What the viewer offers: ``python -m experiments.performance.viewer.features --document
docs/how-to/viewer.md``.

Every row is tried in a browser with ``irrcache view``; "no" is printed where that fails.
"""

from __future__ import annotations

import argparse
import io
import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from experiments.performance.viewer.browser import Browser, Window, viewer
from experiments.support.documents import as_markdown, replace_tables
from mitsuba_irrcache.compare.tables import Table

VIEW = ("phantom:thorax:60,38,52", "--preset", "ct-chest")
SIZES = ((1400, 900), (800, 600), (1920, 1080))


def curve(window: Window) -> str:
    """Drag a point, add one and remove it; undo all."""
    before = window.curve()
    window.drag_point(8, 120, 0.5)
    window.page.mouse.click(*window.place_of(-600, 0.4))
    window.wait_for_curve(len(before) + 1)
    window.page.keyboard.press("Delete")
    window.wait_for_curve(len(before))
    for _ in range(3):
        window.page.keyboard.press("Control+z")
    window.page.wait_for_function(
        "n => JSON.stringify(document.querySelector('irrcache-transfer').points.opacity) == n",
        arg=re.sub(r"\.0(?=[,\]])", "", str(before)).replace(" ", ""),
    )
    return "drag, click, Delete, undo"


def layout(window: Window) -> str:
    """Compare the places of image and panel at three sizes."""
    for width, height in SIZES:
        window.page.set_viewport_size({"width": width, "height": height})
        window.page.wait_for_timeout(1000)
        place = window.canvas()
        panel = window.page.locator("irrcache-transfer").bounding_box()
        assert place["x"] + place["width"] <= panel["x"] and place["height"] == height
    return "beside the image"


def crop(window: Window) -> str:
    """Drag the upper face of the crop box downwards by its arrow, whose tip is above it."""
    window.unfold("Crop and slices")
    window.page.get_by_text("y, %", exact=True).wait_for()
    window.tick("drag faces")
    window.page.wait_for_timeout(2000)
    place, before = window.canvas(), window.page.screenshot(clip=window.canvas())
    x, y = place["x"] + place["width"] / 2, place["y"] + 0.06 * place["height"]
    drag(window, (x, y), (x, y + 0.2 * place["height"]))
    window.page.wait_for_timeout(2000)
    assert changed(before, window.page.screenshot(clip=place)) > 0.03  # not only the arrow
    window.page.get_by_role("button", name="whole volume").click()
    window.tick("drag faces")
    return "ranges in the panel, faces dragged in the image"


def changed(before: bytes, after: bytes) -> float:
    """Return the share of pixels in which two screenshots differ visibly."""
    a, b = (np.asarray(Image.open(io.BytesIO(shot)).convert("L"), int) for shot in (before, after))
    return float((np.abs(a - b) > 30).mean())


def drag(window: Window, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Drag the mouse from one place of the page to another."""
    mouse = window.page.mouse
    mouse.move(*start)
    mouse.down()
    mouse.move(*end, steps=8)
    mouse.up()


def slices(window: Window) -> str:
    """Drag a slice in the image by its arrow, then show all three."""
    window.page.locator("irrcache-slice img").wait_for()
    place, shown = window.canvas(), len(window.shown())
    window.choose("in the image", "this one")
    window.wait_for_picture(shown)
    window.page.wait_for_timeout(1000)
    x, y = place["x"] + place["width"] / 2, place["y"] + 0.46 * place["height"]
    drag(window, (x, y), (x, y - 0.1 * place["height"]))
    window.page.wait_for_timeout(1000)
    assert int(window.field("position, %").input_value()) > 55
    shown = len(window.shown())
    window.choose("in the image", "all three")
    window.wait_for_picture(shown)
    window.choose("in the image", "none")
    return "three, at their places in the medium, dragged"


def background(window: Window) -> str:
    """Show the emitters instead of the background."""
    shown = len(window.shown())
    window.tick("hide emitters")
    window.wait_for_picture(shown)
    window.tick("hide emitters")
    return "any colour, or the emitters"


def marker(window: Window) -> str:
    """Count the labels of the axes."""
    assert window.page.locator("#irrcache-overlay svg text").count() == 3
    return "yes"


def light(window: Window) -> str:
    """Place the sun on its sphere."""
    shown = len(window.shown())
    window.page.locator("irrcache-light canvas").click(position={"x": 45, "y": 20})
    window.wait_for_picture(shown)
    return "dragged on a sphere"


def reference(window: Window) -> str:
    """Choose both comparisons."""
    window.choose("compare", "swipe")
    window.page.locator("#irrcache-overlay .divider").wait_for()
    window.wait_for("volpath, [0-9]+ sample", 120)
    window.choose("compare", "error")
    window.page.locator("#irrcache-overlay .scale").wait_for()
    window.choose("compare", "off")
    return "path traced, swipe and false colours"


def errors(window: Window) -> str:
    """Mark pixels."""
    window.choose("show", "image, errors")
    window.wait_for("at rest|final", 60)
    window.choose("show", "image")
    return "per pixel; marked where above the target"


def video(window: Window) -> str:
    """Export a turntable of few and small frames."""
    window.page.set_viewport_size({"width": 800, "height": 400})
    window.unfold("Animation")
    window.enter("frames", 2)
    with window.page.expect_download(timeout=120_000):
        window.page.get_by_role("button", name="export turntable").click()
    return "turntable, camera path"


#: Row: how it is tried.
ROWS: dict[str, Callable[[Window], str]] = {
    "opacity and colours on a plot over the histogram": curve,
    "panel at 1400 x 900, 800 x 600, 1920 x 1080": layout,
    "crop box": crop,
    "slice planes": slices,
    "orientation marker": marker,
    "background": background,
    "direction of the sun": light,
    "comparison with `volpath`": reference,
    "error bars": errors,
    "animation, as frames and video": video,
}


def main() -> None:
    """Try every row, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("output/viewer"))
    parser.add_argument("--document", type=Path, help="page to write the table into")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    rows = []
    with viewer(VIEW, args.output / "features.log") as address, Browser() as browser:
        window = browser.open(address, SIZES[0])
        window.wait_for("per pixel", 120)
        time.sleep(2)
        for name, attempt in ROWS.items():
            try:
                found = attempt(window)
            except Exception as error:
                found = "no"
                print(f"{name}: {type(error).__name__}: {error}".splitlines()[0])
            rows.append([name, found])
        assert not window.errors, window.errors
    table = Table("Features", ["", "how"], rows)
    print(as_markdown(table))
    if args.document:
        replace_tables(args.document, {"viewer-features": table})


if __name__ == "__main__":
    main()
