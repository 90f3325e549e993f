"""Phase functions in terms of their Legendre moments.

For a phase function of the scattering angle, p = sum_l (2 l + 1) / (4 pi) g_l P_l(cos), the
in-scattered radiance in direction w is, by the Funk-Hecke theorem,

    J(w) = int p(w . w') L(w') dw' = sum_l g_l sum_m L_lm Y_lm(w),

with the spherical-harmonic coefficients L_lm of the radiance. If g_l decays quickly, few
coefficients suffice.
"""

from __future__ import annotations

from copy import copy
from functools import cache, cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.aureole import PEAK_MOMENTS, Aureole
from mitsuba_irrcache.media.peak_blur import PeakBlur

#: Maximum order of the spherical harmonics in a cache; and the order beyond which moments g_l must
#: be at most MAX_TAIL in magnitude, which for ``hg`` limits |g| to 0.58. Otherwise a forward peak
#: is truncated.
MAX_ORDER, TAIL_ORDER, MAX_TAIL = 6, 4, 0.07
#: Maximum energy fraction of a truncated forward peak for orders 4 and 5, and for order 6. For
#: ``hg`` they allow g up to 0.75 (order 4), 0.79 (5) and 0.85 (6).
PEAK, LARGEST_PEAK = 0.25, 0.33
#: Moments of a truncated peak beyond the order that is kept: at least, relative to the first one,
#: and at most. Those of other sharp phase functions have both signs: tabulated steps, side
#: scattering and rainbows were treated as peaks, with images that were wrong by up to a half.
LEAST_OF_PEAK, MOST_OF_PEAK = -0.2, 1.2
#: Magnitude of the moments g_l that are neglected: usually, with orders up to MAX_ORDER; and in
#: isolated media without an uneven environment, with orders up to TAIL_ORDER. Where a camera sees
#: light that is scattered backwards, with a black sky behind the medium, neglected moments of 0.03
#: had an error of 6 % of the mean (``hg``, g = 0.3, single scattering), and those of 0.008 have
#: one of 1 %. In a uniform environment, on coarse grids of high contrast, moments of 0.03 cause an
#: error of 0.1 %; light of suns and points that is scattered once does not depend on them.
TAIL, TAIL_IN_EVEN_LIGHT = 0.01, 0.03
#: Number of moments computed, and nodes of their Gauss-Legendre quadrature.
MOMENTS, NODES = 32, 256
#: Number of random directions and positions at which a phase function is validated.
CHECKS = 1024


class Phase:
    """A phase function.

    ``plugin`` is Mitsuba's phase function (None for `ISOTROPIC`), ``moments`` are the Legendre
    moments g_0 = 1, g_1, ..., without the fraction ``forward`` that `delta_m` treats as
    unscattered, and ``peak`` is the maximum of 4 pi p / (1 - forward).
    """

    # docs/primer, eqs. (1.2), (1.5)

    def __init__(
        self,
        plugin: mi.PhaseFunction | None,
        moments: np.ndarray,
        peak: float,
        forward: float = 0.0,
        all_moments: np.ndarray | None = None,
    ) -> None:
        self.plugin, self.moments, self.peak = plugin, moments, peak
        self.forward = forward
        #: kernels do not depend on its value
        self._normalization: mi.Float | None = None
        if plugin is not None:
            self._normalization = dr.opaque(mi.Float, 4 * np.pi / (1 - forward))
        #: magnitude of moments that are neglected, and the maximum order of the others
        self._neglected = TAIL, MAX_ORDER
        #: moments including the forward peak
        self.all_moments = moments if all_moments is None else all_moments
        #: Correction of narrow sources for multiple scattering into the ``forward`` peak. It is not
        #: left to its first use, in a symbolic loop: evaluating arrays there can abort Dr.Jit.
        self.aureole: Aureole | None = None
        #: blur of the radiance behind the medium by that peak
        self.blur: PeakBlur | None = None
        if forward and plugin is not None:
            peak_moments = self._peak_moments()
            self.aureole = Aureole(peak_moments, self.peak_ratio)
            self.blur = PeakBlur(peak_moments)

    @property
    def peak_ratio(self) -> float:
        """Ratio of the truncated forward peak to the rest of the phase function."""
        return self.forward / (1 - self.forward)

    @cached_property
    def aureole_of_changes(self) -> Aureole:
        """The derivative of what `aureole` corrects, with respect to the depth of the peak."""
        return Aureole(self._peak_moments(), self.peak_ratio, of_changes=True)

    def tail(self, order: int) -> float:
        """Return the largest magnitude of the moments beyond ``order``."""
        return float(np.abs(self.moments[order + 1 :]).max())

    @property
    def is_isotropic(self) -> bool:
        """Whether it is of order 0: the irradiance alone determines the scattered radiance."""
        return not self.tail(0)

    @property
    def order(self) -> int | None:
        """Required order of the spherical harmonics in a cache; None if above the maximum."""
        if self.is_isotropic:
            return 0
        if self.forward:
            return int(np.flatnonzero(self.moments)[-1])
        if self.tail(TAIL_ORDER) > MAX_TAIL:
            return None
        tail, most = self._neglected
        return next((n for n in range(1, most) if self.tail(n) <= tail), most)

    @property
    def has_peak(self) -> bool:
        """Whether the phase function is sharp because of a forward peak that can be truncated."""
        if self.order is not None:
            return False
        share, *beyond = self.moments[self._order_without_peak() + 1 :]
        is_peak = LEAST_OF_PEAK * share <= min(beyond) and max(beyond) <= MOST_OF_PEAK * share
        return 0 < share <= LARGEST_PEAK and is_peak

    def in_even_light(self) -> Phase:
        """Return the phase function for light of suns, points and uniform environments alone."""
        phase = copy(self)
        phase._neglected = TAIL_IN_EVEN_LIGHT, TAIL_ORDER
        return phase

    def without_peak(self) -> Phase:
        """Return the phase function with a truncated forward peak."""
        order = self._order_without_peak()
        share = float(self.moments[order + 1])
        known = np.arange(len(self.moments)) <= order
        moments = np.where(known, (self.moments - share) / (1 - share), 0)
        return Phase(self.plugin, moments, self.peak / (1 - share), share, self.moments)

    def _order_without_peak(self) -> int:
        """Return the order of the phase function if a forward peak is truncated."""
        orders = range(TAIL_ORDER, MAX_ORDER)
        return next((n for n in orders if self.moments[n + 1] <= PEAK), MAX_ORDER)

    def _peak_moments(self) -> np.ndarray:
        """Return the Legendre moments of the ``forward`` peak."""
        moments = legendre_moments(self.plugin, PEAK_MOMENTS)[0] / self.forward
        moments[: self.order + 1] = 1
        return moments

    def gain(
        self, p: mi.Point3f, direction: mi.Vector3f, towards: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Float:
        """Return 4 pi p / (1 - forward) for scattering at ``p`` of radiance from ``towards``.

        ``towards`` points to the source of the radiance, ``direction`` is that of the camera ray.
        """
        place = interaction(p, direction)
        value, _ = self.plugin.eval_pdf(mi.PhaseFunctionContext(), place, towards, active)
        return self._normalization * value[0]


#: Isotropic scattering, of order 0.
ISOTROPIC = Phase(None, np.eye(1, MOMENTS)[0], 1.0)


def interaction(p: mi.Point3f, direction: mi.Vector3f) -> mi.MediumInteraction3f:
    """Return the medium interaction at ``p`` of a ray with this direction."""
    found = dr.zeros(mi.MediumInteraction3f)
    found.p, found.wi = p, -direction
    found.sh_frame = mi.Frame3f(found.wi)
    return found


def phase_of(medium: mi.Medium, boundary: Boundary, name: str) -> Phase:
    """Return the phase function of ``medium``, which fills ``boundary``.

    Raises UnsupportedSceneError if it depends on anything but the scattering angle.
    """
    plugin = medium.phase_function()
    if plugin.class_name() == "IsotropicPhaseFunction":
        return ISOTROPIC
    moments, highest = legendre_moments(plugin, MOMENTS)
    _check(plugin, boundary, f"{name} has the phase function {plugin.class_name()}, which")
    if np.abs(moments[1:]).max() < 1e-6:
        return ISOTROPIC
    ends, _ = _evaluate(plugin, np.tile([[0.0], [0.0], [1.0]], 2), np.array([-1.0, 1.0]))
    return Phase(plugin, moments, 4 * np.pi * max(highest, ends.max()))


def legendre_moments(plugin: mi.PhaseFunction, count: int) -> tuple[np.ndarray, float]:
    """Return the first moments g_0 = 1, g_1, ... of a phase function, and its largest value."""
    cosines, weights = _gauss_legendre()
    values, _ = _evaluate(plugin, np.tile([[0.0], [0.0], [1.0]], NODES), cosines)
    moments = (weights * values) @ np.polynomial.legendre.legvander(cosines, count - 1)
    return moments / moments[0], float(values.max())


@cache
def _gauss_legendre() -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights on [-1, 1].

    They are cached, because computing them takes longer than all else in `legendre_moments`.
    """
    return np.polynomial.legendre.leggauss(NODES)


def _evaluate(
    plugin: mi.PhaseFunction,
    direction: np.ndarray,
    cosines: np.ndarray,
    azimuth: np.ndarray | float = 0.0,
    p: mi.Point3f | None = None,
) -> tuple[np.ndarray, float]:
    """Evaluate the phase function for rays along ``direction`` (3, n).

    ``cosines`` (n) and ``azimuth`` are the angles of scattering. Returns the values (n) of the
    first channel, and the maximum deviation of any channel from the sampling density.
    """
    frame = mi.Frame3f(mi.Vector3f(np.float32(direction)))
    sines = np.sqrt(np.maximum(1 - cosines**2, 0))
    local = np.array([sines * np.cos(azimuth), sines * np.sin(azimuth), cosines])
    place = interaction(mi.Point3f(0) if p is None else p, frame.n)
    outwards = frame.to_world(mi.Vector3f(np.float32(local)))
    value, density = plugin.eval_pdf(mi.PhaseFunctionContext(), place, outwards)
    count = len(cosines)
    density = np.broadcast_to(np.array(density, dtype=np.float64), count)
    channels = [np.broadcast_to(np.array(v, dtype=np.float64), count) for v in value]
    return channels[0], max(np.abs(c - density).max() for c in channels)


def _check(plugin: mi.PhaseFunction, boundary: Boundary, name: str) -> None:
    """Reject phase functions that depend on position or on directions other than by the angle."""
    rng = np.random.default_rng(7)
    cosines, azimuth = rng.uniform(-1, 1, CHECKS), rng.uniform(0, 2 * np.pi, CHECKS)
    frame = Grid((1, 1, 1), boundary.frame)
    p = frame.world.point(mi.Point3f(np.float32(rng.uniform(0, 1, (3, CHECKS)))))
    directions = rng.normal(size=(3, CHECKS))
    directions /= np.linalg.norm(directions, axis=0)
    reference, deviation = _evaluate(plugin, np.tile([[0.0], [0.0], [1.0]], CHECKS), cosines)
    rotated, _ = _evaluate(plugin, directions, cosines, azimuth, p)
    # Single precision resolves angles near 0 to 1e-3 only.
    tolerance = 0.01 * reference.max()
    if not np.isfinite(reference).all() or np.abs(rotated - reference).max() > tolerance:
        raise UnsupportedSceneError(
            f"irrcache: {name} depends on more than the angle of scattering, which would be "
            'rendered wrongly. Make it "isotropic", "hg" or "rayleigh", or use "volpath".'
        )
    if deviation > tolerance:
        raise UnsupportedSceneError(
            f"irrcache: {name} is coloured, or its sampling density differs from its values; "
            'use "volpath".'
        )


def _rounded_down(limit: float) -> float:
    """Round a limit down to two decimals, so that the rounded value is still within it."""
    return int(100 * limit) / 100


def refuse_sharp(phase: Phase, name: str) -> None:
    """Raise UnsupportedSceneError, with the limits, if ``phase`` is too sharp for a cache."""
    if phase.order is not None:
        return
    limit = _rounded_down(MAX_TAIL ** (1 / (TAIL_ORDER + 1)))
    most = _rounded_down(LARGEST_PEAK ** (1 / (MAX_ORDER + 1)))
    raise UnsupportedSceneError(
        f"irrcache: {name} has the phase function {phase.plugin.class_name()} with the mean cosine "
        f"{phase.moments[1]:.2f}, too sharp for a cache: its largest Legendre moment beyond order "
        f"{TAIL_ORDER} is {phase.tail(TAIL_ORDER):.2f}; images are accurate up to {MAX_TAIL:g} "
        f'(|g| up to {limit:.2f} for "hg"), or up to {most:.2f} for sharp forward peaks. '
        'Make it broader, or render this scene with "volpath".'
    )
