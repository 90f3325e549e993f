"""Anderson acceleration of fixed-point iterations.

D. G. Anderson, *Iterative procedures for nonlinear integral equations*, Journal of the ACM 12,
1965; H. F. Walker and P. Ni, *Anderson acceleration for fixed-point iterations*, SIAM Journal on
Numerical Analysis 49, 2011.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.solvers.discrete_ordinates.layout import voxel_and_channel

#: Lower bound of denominators, to avoid division by 0.
TINY = 1e-300
#: Maximum extrapolation beyond the image of the last step, in units of the last change of images.
MAX_EXTRAPOLATION = 20.0
#: Ratio of singular values of the changes of residuals below which the smaller one is ignored.
SINGULAR = 1e-8


class AndersonAcceleration:
    """Anderson acceleration of depth 1 for large arrays.

    The residuals of the last two steps determine the decay of the slowest error, and from that its
    remaining size.
    """

    def __init__(self, sums: Callable[..., np.ndarray]) -> None:
        """``sums(function, *arrays)``: (weighted) sums of ``function(*arrays)`` per channel."""
        self._sums = sums
        self._last: tuple[mi.Float, mi.Float] | None = None

    def next(self, phi: mi.Float, image: mi.Float) -> mi.Float:
        """Return the next iterate, after a fixed-point step from ``phi`` to its ``image``."""
        # docs/primer, eq. (4.11)
        residual = image - phi
        dr.eval(residual)
        last, self._last = self._last, (residual, image)
        if last is None:
            return image
        along = self._sums(lambda now, before: now * (now - before), residual, last[0])
        square = self._sums(lambda now, before: dr.square(now - before), residual, last[0])
        with np.errstate(invalid="ignore", over="ignore"):
            share = -along / np.maximum(square, TINY)
        # Squares of very large radiance are not finite.
        share = np.clip(np.where(np.isfinite(share), share, 0), -0.5, MAX_EXTRAPOLATION)
        channel = voxel_and_channel(dr.width(phi) // len(share), len(share))[1]
        # One more value: arrays of a single value compile other kernels.
        factor = dr.gather(mi.Float, mi.Float([*share, 0.0]), channel)
        result = dr.fma(image - last[1], factor, image)
        dr.eval(result)
        return result


def accelerated(images: np.ndarray, residuals: np.ndarray) -> np.ndarray:
    """Return the combination of images with the smallest residual: Anderson acceleration of any
    depth, for small arrays.

    ``images`` of the last iterates and their ``residuals``, images minus iterates, are (iterates,
    channels, n), the last one last; channels are independent. Returns (channels, n).
    """
    result = images[-1].copy()
    if len(images) > 1:
        for channel, final in enumerate(residuals[-1]):
            differences = (residuals[:-1, channel] - final).T
            share, *_ = np.linalg.lstsq(differences, -final, rcond=SINGULAR)
            result[channel] += share @ (images[:-1, channel] - images[-1, channel])
    return result
