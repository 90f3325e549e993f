"""Anderson's mixing: where an iteration leads, told by its last steps."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.solvers.discrete_ordinates.layout import voxel_and_channel

#: Below all light.
TINY = 1e-300
#: Times the last change of the images, at most, that a step may go on behind its own.
FARTHEST = 20.0


class AndersonAcceleration:
    """Of an iteration of large arrays, of which two steps are kept: how the error that falls most
    slowly has fallen tells what is left of it.
    """

    def __init__(self, sums: Callable[[mi.Float], np.ndarray]) -> None:
        """``sums``: of an array, in each of its channels, which lie next to each other."""
        self._sums = sums
        self._last: tuple[mi.Float, mi.Float] | None = None

    def next(self, phi: mi.Float, image: mi.Float) -> mi.Float:
        """From where to go on, if a step leads from ``phi`` to its ``image``."""
        residual = image - phi
        dr.eval(residual)
        last, self._last = self._last, (residual, image)
        if last is None:
            return image
        change = residual - last[0]
        along, square = self._sums(residual * change), self._sums(change * change)
        with np.errstate(invalid="ignore", over="ignore"):
            share = -along / np.maximum(square, TINY)
        # Squares of very bright light are not finite.
        share = np.clip(np.where(np.isfinite(share), share, 0), -0.5, FARTHEST)
        channel = voxel_and_channel(dr.width(phi) // len(share), len(share))[1]
        # One more, since kernels that read an array of a single value are different ones.
        factor = dr.gather(mi.Float, mi.Float([*share, 0.0]), channel)
        result = dr.fma(image - last[1], factor, image)
        dr.eval(result)
        return result


def mixed(history: list, channel: int) -> np.ndarray:
    """Of a short history of points and their images, few voxels each, the combination of images
    that leaves the least residual in a channel.
    """
    points, images = (np.array([x[channel] for x in xs]) for xs in zip(*history, strict=True))
    residuals = images - points
    if len(history) == 1:
        return images[0]
    differences = (residuals[:-1] - residuals[-1]).T
    share, *_ = np.linalg.lstsq(differences, -residuals[-1], rcond=1e-8)
    return images[-1] + share @ (images[:-1] - images[-1])
