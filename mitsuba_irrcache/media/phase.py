"""Phase functions, by their Legendre moments.

Of a phase function that depends on the scattering angle alone, p = sum_l (2 l + 1) / (4 pi) g_l
P_l(cos), the light scattered into a direction w is (Funk and Hecke)

    J(w) = int p(w . w') L(w') dw' = sum_l g_l sum_m L_lm Y_lm(w),

with the coefficients L_lm of the radiance in spherical harmonics. Where g_l falls off soon, a few
of them tell all there is to know.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.grid import Grid

#: Highest order of spherical harmonics that a cache holds, and where a forward peak is taken away.
HIGHEST, SHARPEST = 4, 6
#: Share of light in a forward peak up to which the lower of these will do, and up to which the
#: other does. Of ``hg``, g is at most 0.75 and 0.85 then.
PEAK, LARGEST_PEAK = 0.25, 0.33
#: Moments beyond the order of a cache are at most so large: what is left out of the radiance is
#: scattered with this share of its weight or less. Of ``hg``, |g| is at most 0.58 then.
TAIL = 0.07
#: Moments that are looked at, and points of the quadrature they are computed with.
MOMENTS, NODES = 32, 256
#: Directions in which a phase function is compared with itself.
PROBES = 1024


class Phase:
    """A phase function: Mitsuba's ``plugin`` (None for `ISOTROPIC`), its ``moments`` g_0 = 1, g_1,
    ..., and its ``peak``, the maximum of 4 pi p. These are without the share ``forward`` of light
    that goes on straight (see `delta_m`).
    """

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
        #: with that share
        self.all_moments = moments if all_moments is None else all_moments

    def tail(self, order: int) -> float:
        """The largest moment beyond ``order``."""
        return float(np.abs(self.moments[order + 1 :]).max())

    @property
    def is_isotropic(self) -> bool:
        """Whether it is of order 0: a cache of the irradiance holds all that it needs."""
        return not self.tail(0)

    @property
    def order(self) -> int | None:
        """Highest degree of the spherical harmonics that a cache has to hold; None where there were
        too many.
        """
        if self.is_isotropic:
            return 0
        if self.forward:
            return int(np.flatnonzero(self.moments)[-1])
        return next((n for n in range(1, HIGHEST + 1) if self.tail(n) <= TAIL), None)

    @property
    def has_peak(self) -> bool:
        """Whether what makes it sharp is a forward peak, not too large a one."""
        return self.order is None and 0 < self.moments[SHARPEST + 1] <= LARGEST_PEAK

    def without_peak(self) -> Phase:
        """The same where light in the peak goes on straight."""
        orders = range(HIGHEST, SHARPEST)
        order = next((n for n in orders if self.moments[n + 1] <= PEAK), SHARPEST)
        share = float(self.moments[order + 1])
        known = np.arange(len(self.moments)) <= order
        moments = np.where(known, (self.moments - share) / (1 - share), 0)
        return Phase(self.plugin, moments, self.peak / (1 - share), share, self.moments)

    def gain(
        self, p: mi.Point3f, direction: mi.Vector3f, towards: mi.Vector3f, active: mi.Bool = True
    ) -> mi.Float:
        """4 pi p for light at ``p`` from ``towards`` that is seen along ``direction``."""
        place = interaction(p, direction)
        value, _ = self.plugin.eval_pdf(mi.PhaseFunctionContext(), place, towards, active)
        return 4 * dr.pi / (1 - self.forward) * value[0]


#: Isotropic scattering, of order 0.
ISOTROPIC = Phase(None, np.eye(1, MOMENTS)[0], 1.0)


def interaction(p: mi.Point3f, direction: mi.Vector3f) -> mi.MediumInteraction3f:
    """A collision at ``p`` of a path that came along ``direction``."""
    found = dr.zeros(mi.MediumInteraction3f)
    found.p, found.wi = p, -direction
    found.sh_frame = mi.Frame3f(found.wi)
    return found


def phase_of(medium: mi.Medium, boundary: Boundary, name: str) -> Phase:
    """The phase function of ``medium``, which lies in ``boundary``.

    Raises UnsupportedSceneError for those that depend on anything but the scattering angle.
    """
    plugin = medium.phase_function()
    if plugin.class_name() == "IsotropicPhaseFunction":
        return ISOTROPIC
    cosines, weights = _gauss_legendre()
    values, _ = _evaluate(plugin, np.tile([[0.0], [0.0], [1.0]], NODES), cosines)
    known = np.polynomial.legendre.legvander(cosines, MOMENTS - 1)
    moments = 2 * np.pi * (weights * values) @ known
    _check(plugin, boundary, f"{name} has the phase function {plugin.class_name()}, which")
    if np.abs(moments[1:]).max() < 1e-6:
        return ISOTROPIC
    ends, _ = _evaluate(plugin, np.tile([[0.0], [0.0], [1.0]], 2), np.array([-1.0, 1.0]))
    return Phase(plugin, moments / moments[0], 4 * np.pi * max(values.max(), ends.max()))


@cache
def _gauss_legendre() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [-1, 1]. Computing them takes longer than all else here."""
    return np.polynomial.legendre.leggauss(NODES)


def _evaluate(
    plugin: mi.PhaseFunction,
    direction: np.ndarray,
    cosines: np.ndarray,
    turn: np.ndarray | float = 0.0,
    p: mi.Point3f | None = None,
) -> tuple[np.ndarray, float]:
    """Values for light that comes along ``direction`` (3, n) and is scattered by an angle, and how
    much colours and the density of samples differ from them at most.
    """
    frame = mi.Frame3f(mi.Vector3f(np.float32(direction)))
    sines = np.sqrt(np.maximum(1 - cosines**2, 0))
    local = np.array([sines * np.cos(turn), sines * np.sin(turn), cosines])
    place = interaction(mi.Point3f(0) if p is None else p, frame.n)
    outwards = frame.to_world(mi.Vector3f(np.float32(local)))
    value, density = plugin.eval_pdf(mi.PhaseFunctionContext(), place, outwards)
    count = len(cosines)
    density = np.broadcast_to(np.array(density, dtype=np.float64), count)
    channels = [np.broadcast_to(np.array(v, dtype=np.float64), count) for v in value]
    return channels[0], max(np.abs(c - density).max() for c in channels)


def _check(plugin: mi.PhaseFunction, boundary: Boundary, name: str) -> None:
    """Compares values for one angle with each other: everywhere, from and to all directions."""
    rng = np.random.default_rng(7)
    cosines, turn = rng.uniform(-1, 1, PROBES), rng.uniform(0, 2 * np.pi, PROBES)
    frame = Grid((1, 1, 1), boundary.frame)
    p = frame.world.point(mi.Point3f(np.float32(rng.uniform(0, 1, (3, PROBES)))))
    directions = rng.normal(size=(3, PROBES))
    directions /= np.linalg.norm(directions, axis=0)
    plain, apart = _evaluate(plugin, np.tile([[0.0], [0.0], [1.0]], PROBES), cosines)
    turned, _ = _evaluate(plugin, directions, cosines, turn, p)
    # Single precision tells angles near 0 to 1e-3 only.
    tolerance = 0.01 * plain.max()
    if not np.isfinite(plain).all() or np.abs(turned - plain).max() > tolerance:
        raise UnsupportedSceneError(
            f"irrcache: {name} depends on more than the angle of scattering, which would be "
            'rendered wrongly. Make it "isotropic", "hg" or "rayleigh", or use "volpath".'
        )
    if apart > tolerance:
        raise UnsupportedSceneError(
            f'irrcache: {name} is coloured, or not sampled as it is; use "volpath".'
        )


def refuse_sharp(phase: Phase, name: str) -> None:
    """Raises UnsupportedSceneError, with the bound, where ``phase`` has too many moments."""
    if phase.order is not None:
        return
    limit, most = TAIL ** (1 / (HIGHEST + 1)), LARGEST_PEAK ** (1 / (SHARPEST + 1))
    raise UnsupportedSceneError(
        f"irrcache: {name} has the phase function {phase.plugin.class_name()} with the mean cosine "
        f"{phase.moments[1]:.2f}, too sharp for a cache: of its Legendre moments beyond order "
        f"{HIGHEST} the largest is {phase.tail(HIGHEST):.2f}, and only up to {TAIL:g} (|g| up to "
        f'{limit:.2f} of "hg") images are right; sharper ones, up to {most:.2f}, only forward. '
        'Make it broader, or render this scene with "volpath".'
    )
