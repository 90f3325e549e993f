"""The aureole: radiance of a narrow source scattered several times into a forward peak.

delta-M (`delta_m`) treats scattering into the forward peak as unscattered, and the TMS correction
scatters the radiance of narrow sources once with the full phase function, at every position along a
path. Radiance scattered n times into the peak is thus counted n times, each time with the angular
distribution of a single scattering event. It should be counted once, with the distribution of n
events. Without a correction the image around the source is up to twice too bright, and the aureole
too narrow.

For small angles the number of events along a path is Poisson distributed with mean D, the optical
depth of scattering into the peak, and the Legendre moments of successive distributions multiply
(Goudsmit and Saunderson 1940). With the moments q_l of the peak, the sum over all n >= 1 has the
moments exp(-D (1 - q_l)) - exp(-D). The TMS correction alone has the moments D q_l, so the phase
function of the peak is replaced by the one with the moments

    a_l = [exp(-D (1 - q_l)) - exp(-D)] / D.

The radiance that the peak scatters changes with D by d(D a_l)/dD instead of a_l.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

#: Number of Legendre moments, and degree from which on they are attenuated, so that the series of a
#: phase function too sharp for that number of moments does not oscillate.
PEAK_MOMENTS, FIRST_ATTENUATED = 256, 128
#: Size of the table: numbers of angles, of mean numbers of scattering events D, and of angular
#: extents of sources; largest D and extent [rad] in the table, to which arguments are clamped.
ANGLES, DEPTHS, EXTENTS = 128, 32, 24
MAX_DEPTH, MAX_EXTENT = 30.0, 1.0


class Aureole:
    """The difference between several scattering events into a forward peak and one."""

    # docs/primer, eq. (5.11)

    def __init__(self, moments: np.ndarray, scale: float, of_changes: bool = False) -> None:
        """Tabulate the difference.

        ``moments`` are the `PEAK_MOMENTS` Legendre moments q_0 = 1, q_1, ... of the peak, and
        ``scale`` is f / (1 - f), where f is the share of the peak in the phase function. The
        difference is that of the derivatives with respect to D if ``of_changes``.
        """
        angles = np.pi * np.linspace(0, 1, ANGLES) ** 2
        depths = MAX_DEPTH * np.linspace(0, 1, DEPTHS) ** 2
        extents = MAX_EXTENT * np.linspace(0, 1, EXTENTS)
        differences = _differences(moments, angles, depths, np.square(extents), of_changes)
        table = (scale * differences).astype(np.float32)
        # GPUs' texture units interpolate with weights of 8 bits: too coarse for angles this small.
        options = {"use_accel": False, "wrap_mode": dr.WrapMode.Clamp}
        self._wide = mi.Texture3f(mi.TensorXf(table[..., None]), **options)
        self._narrow = mi.Texture2f(mi.TensorXf(table[0][..., None]), **options)

    def correction(
        self,
        cosine: mi.Float,
        depth: mi.Float | mi.Color3f,
        variance: mi.Float | None = None,
    ) -> mi.Float | mi.Color3f:
        """Return what has to be added to 4 pi p / (1 - f) for scattering at an angle with this
        ``cosine``, where ``depth`` is the mean number of scattering events into the peak between
        the source and the camera.

        ``variance`` is the mean square angle of a source with extent.
        """
        if isinstance(depth, mi.Color3f):
            return mi.Color3f([self.correction(cosine, d, variance) for d in depth])
        angle = _centred(dr.sqrt(dr.safe_acos(cosine) * dr.inv_pi), ANGLES)
        depth = _centred(dr.sqrt(dr.minimum(depth, MAX_DEPTH) * (1 / MAX_DEPTH)), DEPTHS)
        if variance is None:
            return self._narrow.eval(mi.Point2f(angle, depth))[0]
        extent = _centred(dr.minimum(dr.sqrt(variance) * (1 / MAX_EXTENT), 1), EXTENTS)
        return self._wide.eval(mi.Point3f(angle, depth, extent))[0]


def _centred(place: mi.Float, count: int) -> mi.Float:
    """Map [0, 1] to the texture coordinates from the first to the last texel centre."""
    return dr.fma(place, (count - 1) / count, 0.5 / count)


def _differences(
    moments: np.ndarray,
    angles: np.ndarray,
    depths: np.ndarray,
    variances: np.ndarray,
    of_changes: bool,
) -> np.ndarray:
    """Return the sums over Legendre polynomials, an array (variance, depth, angle)."""
    degrees = np.arange(PEAK_MOMENTS)
    depths = np.maximum(depths, 1e-6)[:, None]
    several = np.exp(-depths) * np.expm1(depths * moments) / depths
    if of_changes:
        several = np.exp(-depths) - (1 - moments) * np.exp(-depths * (1 - moments))
    coefficients = (2 * degrees + 1) * series_window() * (several - moments)
    blur = np.exp(-0.25 * degrees * (degrees + 1) * variances[:, None])
    polynomials = np.polynomial.legendre.legvander(np.cos(angles), PEAK_MOMENTS - 1)
    return (blur[:, None] * coefficients) @ polynomials.T


def series_window() -> np.ndarray:
    """Return the factors of the `PEAK_MOMENTS` moments that attenuate those of highest degree."""
    degrees = np.arange(PEAK_MOMENTS)
    beyond = np.clip((degrees - FIRST_ATTENUATED) / (PEAK_MOMENTS - FIRST_ATTENUATED), 0, 1)
    return 0.5 * (1 + np.cos(np.pi * beyond))
