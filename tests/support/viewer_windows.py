"""What a window of the viewer shows once it has settled."""

from __future__ import annotations

import io
import time
from collections.abc import Callable

import numpy as np
from PIL import Image

from experiments.performance.viewer.browser import Window

SIZE = (700, 260)


#: The part of a window, in pixels from the left, that the panel never covers.
CLEAR = 340


def settled(window: Window) -> np.ndarray:
    """What is on the screen once nothing better will follow: float (height, width, 3), without
    what the panel may cover.
    """
    count = -1
    while count != len(window.shown()) or not window.note().startswith("final"):
        window.wait_for("^final", 90)
        count = len(window.shown())
        time.sleep(0.5)
    return screen(window)


def after(window: Window, act: Callable[[], None]) -> np.ndarray:
    """What is on the screen in the end, once ``act`` has changed it."""
    count = len(window.shown())
    act()
    window.wait_for_picture(count, SIZE[0])
    return settled(window)


def screen(window: Window, width: int = CLEAR) -> np.ndarray:
    """So many columns of what is on the screen."""
    shot = Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")
    return np.asarray(shot, dtype=float)[:, :width]


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())
