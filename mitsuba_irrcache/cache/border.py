"""Irradiance in the outermost voxels of a medium that is dense at its boundary.

Within a mean free path of a plane boundary the irradiance changes too steeply to be interpolated
between voxels. At the optical depth t from the boundary it is about

    Phi(t) = A e^(-k t) + B E_2(t)

with the asymptotic decay k of radiance in the medium, which depends on the albedo (Case and
Zweifel, *Linear Transport Theory*, 1967, chapter 4), and the exponential integral E_2: uncollided
radiance of a uniform environment is proportional to E_2(t), a medium without absorption under such
an environment has k = 0 and B = 0. A and B follow from the values of the two outermost voxels.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid

#: Optical depths of a voxel between which the profile gradually replaces the extrapolation by the
#: ratio of neighbouring values, which is as accurate in thinner voxels; and largest depth of the
#: table, which stands for larger ones.
THIN, RESOLVED, OPAQUE = 0.1, 0.2, 8.0
#: The same limits, and the largest share of the profile, where the irradiance of suns, points and
#: other emitters is looked up separately. The rest, once scattered first, has a profile between
#: both: in a half-space under a sun at the zenith, with a depth of 0.5 per voxel, the ratio yields
#: up to 5 % too much radiance, the profile up to 6 % too little.
THIN_BESIDE_DIRECT, RESOLVED_BESIDE_DIRECT, SHARE_BESIDE_DIRECT = 0.25, 0.5, 0.5
#: Cosine between camera rays and the normal of the boundary for which the profile between the
#: boundary and the outermost voxel centres is approximated.
COSINE = 0.6
#: Numbers of entries of the tables, over the optical depth and over the albedo.
DEPTHS, ALBEDOS = 128, 128
#: Columns of the table over the optical depth: the means of E_2 over the outermost voxel and over
#: the next one, its value at the centre of the first, and its weighted mean between boundary and
#: centre, where the squared weights of linear interpolation have the last three means.
OUTER, INNER, CENTRE, HALF, TO_CENTRE, MIXED, TO_FACE = range(COLUMNS := 7)


class BorderProfile(Immutable):
    """The profile of the irradiance at the faces of a grid, where its medium is dense there.

    Args:
        medium: the medium, of which only the extinction, albedo and mean cosine of scattering of
            voxels at the faces are used.
        grid: the grid of the cache.
        single: whether radiance is scattered once only, so that the irradiance is uncollided.
        has_direct: whether emitters are looked up separately, so that values lack their irradiance.

    Values are means over voxels without noise, as those of the solver ``sweep``.
    """

    def __init__(self, medium: MediumGrid, grid: Grid, single: bool, has_direct: bool) -> None:
        self.medium, self.grid, self.single = medium, grid, single
        #: optical depths between which the share of the profile increases, and its maximum
        self.limits = THIN, RESOLVED, 1.0
        if has_direct and not single:
            self.limits = THIN_BESIDE_DIRECT, RESOLVED_BESIDE_DIRECT, SHARE_BESIDE_DIRECT

    def at_centres(self, roots: mi.Float, known: mi.Bool, channels: int) -> mi.Float:
        """Convert square ``roots`` of means over the outermost voxels to roots at their centres.

        ``known`` are the voxels that have values; others are not changed.
        """
        index = dr.arange(mi.UInt32, self.grid.voxel_count * channels)
        voxel, result, stride = index // channels, roots, channels
        own = dr.gather(mi.Bool, known, voxel)
        sides = zip(self.grid.voxel_indices(voxel), self.grid.sides, strict=True)
        for axis, (place, side) in enumerate(sides):
            last = mi.UInt32(side) - 1
            at_face = own & (last > 0) & ((place == 0) | (place == last))
            step = dr.select(place == 0, stride, -stride)
            inner = mi.UInt32(mi.Int32(index) + step)
            at_face &= dr.gather(mi.Bool, known, inner // channels, at_face)
            profile = _Profile(self, axis, voxel, index - voxel * channels, at_face)
            outermost = dr.square(roots)
            further = dr.square(dr.gather(mi.Float, roots, inner, at_face))
            value = profile.centre(outermost, further)
            ratio = dr.select(outermost > 0, value / dr.maximum(outermost, 1e-30), 1)
            ratio = dr.sqrt(dr.lerp(1, ratio, profile.weight))
            result = dr.select(at_face, result * ratio, result)
            stride *= self.grid.shape[2 - axis]
        dr.eval(result)
        return result

    def growth(
        self,
        axis: int,
        voxel: mi.UInt32,
        channel: mi.UInt32,
        roots: tuple[mi.Float, mi.Float],
        ratio: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """Return the ratio of the root one voxel beyond a face to that at the outermost centre.

        ``roots`` are those at the centre of the outermost ``voxel`` along an ``axis``, and of the
        next one inwards. ``ratio`` is returned where the medium is thin.
        """
        profile = _Profile(self, axis, voxel, channel, active)
        return dr.lerp(ratio, profile.growth(*roots), profile.weight)


class _Profile:
    """A and B of the profile, for the voxels at faces normal to an ``axis``."""

    # docs/primer, eq. (2.13)

    def __init__(
        self,
        border: BorderProfile,
        axis: int,
        voxel: mi.UInt32,
        channel: mi.UInt32,
        active: mi.Bool,
    ) -> None:
        medium, grid = border.medium, border.grid
        p = grid.centers(voxel)
        extinction = _channel(medium.sigma_t.at_world(p, active), channel)
        albedo = 0 if border.single else _channel(medium.albedo.at_world(p, active), channel)
        # Anisotropic scattering decays like isotropic scattering of the reduced extinction.
        reduced = 1 - albedo * dr.opaque(mi.Float, float(medium.phase.moments[1]))
        albedo = dr.clip(1 - (1 - albedo) / dr.maximum(reduced, 1e-3), 0, 1)
        depth = extinction * dr.opaque(mi.Float, float(grid.voxel_size[axis]))
        #: share of this profile in the result
        thin, resolved, most = border.limits
        self.weight = dr.clip((depth - thin) * (most / (resolved - thin)), 0, most)
        self.weight = dr.select(_is_plain_face(medium, grid, axis, voxel), self.weight, 0)

        # Pairs are coefficients of A and B.
        depth = dr.clip(depth, THIN, OPAQUE)
        self._table = table = _Table(depth)
        decay, slope = _decay(albedo) * reduced, 1 / COSINE
        x, towards, both = decay * depth, 0.5 * slope * depth, 0.5 * (decay + slope) * depth
        outer = _mean_exponential(x)
        self._outer, self._inner = (outer, table[OUTER]), (outer * dr.exp(-x), table[INNER])
        self._centre = dr.exp(-0.5 * x), table[CENTRE]
        self._half = _mean_exponential(both) / _mean_exponential(towards), table[HALF]

    def centre(self, outermost: mi.Float, further: mi.Float) -> mi.Float:
        """Return Phi at the outermost centres, from the means over the two outermost voxels."""
        a, b = _solved(self._outer, self._inner, outermost, further)
        value = a * self._centre[0] + b * self._centre[1]
        largest = 1.1 * dr.maximum(outermost, 0.5 * (outermost + further))
        return dr.clip(value, 0.05 * outermost, largest)

    def growth(self, outermost: mi.Float, further: mi.Float) -> mi.Float:
        """Return the ratio of the root beyond the face to that at the outermost centre.

        Linear interpolation of roots between both has the same weighted mean as the profile.
        """
        phi = dr.square(outermost)
        a, b = _solved(self._centre, self._inner, phi, dr.square(further))
        table, scale = self._table, dr.select(phi > 0, dr.rcp(phi), 0)
        mean = dr.maximum((a * self._half[0] + b * self._half[1]) * scale, 0)
        # The root f at the face solves w_ff f^2 + 2 w_fc f + w_cc = mean, in units of the centre's.
        mixed, to_face = table[MIXED], table[TO_FACE]
        rest = dr.maximum(mean - table[TO_CENTRE], 0)
        face = rest / (mixed + dr.sqrt(dr.fma(mixed, mixed, to_face * rest)))
        return dr.maximum(2 * face - 1, 0)


def _is_plain_face(medium: MediumGrid, grid: Grid, axis: int, voxel: mi.UInt32) -> mi.Bool:
    """Return whether the medium fills a voxel at a face normal to an ``axis`` up to the face, and
    no other face is next to the voxel, whose profile would add up with that of this one.
    """
    places, at_edge = grid.voxel_indices(voxel), mi.Bool(False)
    for other, (place, side) in enumerate(zip(places, grid.sides, strict=True)):
        if other != axis:
            at_edge |= (place == 0) | (place + 1 == mi.UInt32(side))
    nearly = grid.to_world[:3, axis] * (0.45 / grid.resolution[axis])
    outwards = mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in nearly))
    outwards *= dr.select(places[axis] == 0, -1, 1)
    return medium.contains(grid.centers(voxel) + outwards) & ~at_edge


def _solved(first: tuple, second: tuple, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Solve A f + B g = u, v for A and B, with (f, g) as ``first`` and ``second``.

    A is not negative: where the second value is too small, for instance because voxels are opaque
    and it is inaccurate, the first one determines B.
    """
    (f0, g0), (f1, g1) = first, second
    a = dr.maximum((u * g1 - v * g0) / (f0 * g1 - f1 * g0), 0)
    return a, (u - a * f0) / g0


def _channel(values: mi.Float | mi.Color3f, channel: mi.UInt32) -> mi.Float:
    """Return the value of a channel of the cache."""
    if isinstance(values, mi.Float):
        return values
    first, second, third = values
    return dr.select(channel == 0, first, dr.select(channel == 1, second, third))


def _mean_exponential(x: mi.Float) -> mi.Float:
    """Return the mean of e^-s for s between 0 and ``x``."""
    series = 1 - 0.5 * x + dr.square(x) * (1 / 6)
    return dr.select(x < 0.02, series, (1 - dr.exp(-x)) / dr.maximum(x, 0.02))


class _Table:
    """Columns of the table at these optical depths of voxels."""

    def __init__(self, depth: mi.Float) -> None:
        values, lowest, per_octave = _depth_table()
        place = (dr.log2(depth) - lowest) * per_octave
        self._values = mi.Float(values.ravel())
        self._row = mi.UInt32(dr.clip(place, 0, DEPTHS - 2))
        self._weight = place - mi.Float(self._row)

    def __getitem__(self, column: int) -> mi.Float:
        at = self._row * COLUMNS + column
        low, high = (dr.gather(mi.Float, self._values, i) for i in (at, at + COLUMNS))
        return dr.fma(high - low, self._weight, low)


def _decay(albedo: mi.Float) -> mi.Float:
    """Return k for isotropic scattering, per optical depth."""
    values = mi.Float(_decay_table())
    place = dr.sqrt(1 - albedo) * (ALBEDOS - 1)
    row = mi.UInt32(dr.clip(place, 0, ALBEDOS - 2))
    low, high = (dr.gather(mi.Float, values, i) for i in (row, row + 1))
    return dr.fma(high - low, place - mi.Float(row), low)


@cache
def _decay_table() -> np.ndarray:
    """Solve a artanh(k) = k for equidistant square roots of 1 - a, by bisection."""
    albedo = 1 - np.linspace(0, 1, ALBEDOS) ** 2
    low, high = np.zeros(ALBEDOS), np.ones(ALBEDOS)
    for _ in range(40):
        k = 0.5 * (low + high)
        below = albedo * np.arctanh(k) < k
        low, high = np.where(below, k, low), np.where(below, high, k)
    return np.float32(low)


@cache
def _depth_table() -> tuple[np.ndarray, float, float]:
    """Return the table, the logarithm of its first optical depth, and its rows per octave."""
    lowest, highest = np.log2(THIN), np.log2(OPAQUE)
    x, w = np.polynomial.legendre.leggauss(48)
    y, w = (0.5 * (x + 1)) ** 2, 0.5 * w * (x + 1)  # E_2 has an infinite slope at 0
    rows = []
    for d in np.exp2(np.linspace(lowest, highest, DEPTHS)):
        e3 = [0.5, *(_exponential_integrals(n * d)[1] for n in (1.0, 2.0))]
        weight = w * np.exp(-0.5 * d * y / COSINE)
        weight /= weight.sum()
        between = np.array([_exponential_integrals(0.5 * d * t)[0] for t in y])
        rows.append([
            (e3[0] - e3[1]) / d, (e3[1] - e3[2]) / d, _exponential_integrals(0.5 * d)[0],
            weight @ between, weight @ y**2, weight @ (y * (1 - y)), weight @ (1 - y) ** 2,
        ])  # fmt: skip
    return np.float32(rows), float(lowest), float((DEPTHS - 1) / (highest - lowest))


def _exponential_integrals(x: float) -> tuple[float, float]:
    """Return E_2(x) and E_3(x)."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    t = 0.5 * (nodes + 1)
    mu, weights = t**3, 1.5 * t**2 * weights
    e2 = float(weights @ np.exp(-x / mu))
    return e2, 0.5 * (float(np.exp(-x)) - x * e2)
