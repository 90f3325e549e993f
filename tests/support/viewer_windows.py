"""Screenshots of a viewer window whose image is final."""

from __future__ import annotations

import io
import time
from collections.abc import Callable

import numpy as np
from PIL import Image

from experiments.performance.viewer.browser import PATIENCE, Window

SIZE = (620, 260)
#: Hides what lies over the image.
HIDDEN = "#irrcache-overlay {visibility: hidden}"


def settled(window: Window) -> np.ndarray:
    """Wait for the final image; return the screenshot (height, width, 3) as float."""
    window.wait_until_final()
    return screen(window)


def after(window: Window, act: Callable[[], None]) -> np.ndarray:
    """Call ``act`` and return the final screenshot that differs from the previous one."""
    count = len(window.shown())
    act()
    window.wait_for_picture(count, round(window.canvas()["width"]))
    return settled(window)


def finally_(window: Window, condition: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Return the first final screenshot that fulfils ``condition``.

    After several edits, those before it may show the state between two of them.
    """
    began = time.monotonic()
    while not condition(shot := settled(window)):
        assert time.monotonic() - began < PATIENCE, "no final image fulfils the condition"
    return shot


def drag_until_coarse(window: Window, width: int) -> None:
    """Drag over the image until one narrower than ``width`` is displayed.

    On a busy machine, none may arrive during a single drag.
    """
    began, count = time.monotonic(), len(window.shown())
    while all(image["width"] >= width for image in window.shown()[count:]):
        assert time.monotonic() - began < PATIENCE, "no image of a moving camera is coarser"
        window.orbit(12, 8, 0.02)


def screen(window: Window) -> np.ndarray:
    """Return a screenshot of the image, without what lies over it."""
    style = window.page.add_style_tag(content=HIDDEN)
    shot = Image.open(io.BytesIO(window.page.screenshot(clip=window.canvas()))).convert("RGB")
    style.evaluate("style => style.remove()")
    return np.asarray(shot, dtype=float)


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())
