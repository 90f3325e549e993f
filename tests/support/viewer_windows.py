"""Screenshots of a viewer window whose image is final."""

from __future__ import annotations

import io
import time
from collections.abc import Callable

import numpy as np
from PIL import Image

from experiments.performance.viewer.browser import Window

SIZE = (700, 260)


#: Width in pixels, from the left, that the control panel never covers.
CLEAR = 340


def settled(window: Window) -> np.ndarray:
    """Wait for the final image; return the screenshot (height, width, 3) as float.

    The columns that the panel may cover are cropped.
    """
    count = -1
    while count != len(window.shown()) or not window.note().startswith("final"):
        window.wait_for("^final", 90)
        count = len(window.shown())
        time.sleep(0.5)
    return screen(window)


def after(window: Window, act: Callable[[], None]) -> np.ndarray:
    """Call ``act`` and return the final screenshot that differs from the previous one."""
    count = len(window.shown())
    act()
    window.wait_for_picture(count, SIZE[0])
    return settled(window)


def screen(window: Window, width: int = CLEAR) -> np.ndarray:
    """Return the left columns of a screenshot."""
    shot = Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")
    return np.asarray(shot, dtype=float)[:, :width]


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())
