"""Screenshots of a viewer window whose image is final."""

from __future__ import annotations

import io
import time
from collections.abc import Callable

import numpy as np
from PIL import Image

from experiments.performance.viewer.browser import Window

SIZE = (620, 260)
#: Hides what lies over the image.
HIDDEN = "#irrcache-overlay {visibility: hidden}"


def settled(window: Window) -> np.ndarray:
    """Wait for the final image; return the screenshot (height, width, 3) as float."""
    count = -1
    while count != len(window.shown()) or not window.note().startswith("final"):
        window.wait_for("^final", 90)
        count = len(window.shown())
        time.sleep(0.3)
    return screen(window)


def after(window: Window, act: Callable[[], None]) -> np.ndarray:
    """Call ``act`` and return the final screenshot that differs from the previous one."""
    count = len(window.shown())
    act()
    window.wait_for_picture(count, round(window.canvas()["width"]))
    return settled(window)


def screen(window: Window) -> np.ndarray:
    """Return a screenshot of the image, without what lies over it."""
    style = window.page.add_style_tag(content=HIDDEN)
    shot = Image.open(io.BytesIO(window.page.screenshot(clip=window.canvas()))).convert("RGB")
    style.evaluate("style => style.remove()")
    return np.asarray(shot, dtype=float)


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())
