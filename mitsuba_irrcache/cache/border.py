"""Irradiance in the outermost voxels of a medium that is dense at its boundary.

Within a mean free path of a plane boundary the irradiance changes too steeply to be interpolated
between voxels. At the optical depth t from the boundary it is about

    Phi(t) = A e^(-k t) + B E_2(t)

with the asymptotic decay k of radiance in the medium, which depends on the albedo (Case and
Zweifel, *Linear Transport Theory*, 1967, chapter 4), and the exponential integral E_2: uncollided
radiance of a uniform environment is proportional to E_2(t), a medium without absorption under such
an environment has k = 0 and B = 0. Radiance that enters at grazing angles, from a bright region of
an environment, decays faster: then an exponential takes the place of E_2. All parameters follow
from the values of the three outermost voxels.
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
#: Cosine between camera rays and the normal of the boundary for which the profile between the
#: boundary and the outermost voxel centres is approximated.
COSINE = 0.6
#: Relative range of the decay per voxel, below that of E_2, over which the exponential gradually
#: takes the place of E_2, and its minimum.
BLENDED, STEEPEST = 0.25, 0.02
#: Fewest voxels along an axis between whose faces the profile is used.
FEWEST = 4
#: Numbers of entries of the tables, over the optical depth and over the albedo.
DEPTHS, ALBEDOS = 128, 128
#: Columns of the table over the optical depth: the means of E_2 over the three outermost voxels and
#: its value at the centre of the first; then weighted means over the outer half of the outermost
#: voxel, of E_2 and of the squared weights of linear interpolation between face and centre; and the
#: same over its inner half, of interpolation between its centre and the next one.
(
    OUTER, INNER, THIRD, CENTRE, OUTER_HALF, TO_CENTRE, MIXED, TO_FACE,
    INNER_HALF, FROM_CENTRE, MIXED_INWARDS, TO_INNER,
) = range(COLUMNS := 12)  # fmt: skip


class BorderProfile(Immutable):
    """The profile of the irradiance at the faces of a grid, where its medium is dense there.

    Args:
        medium: the medium, of which only the extinction, albedo and mean cosine of scattering of
            voxels at the faces are used.
        grid: the grid of the cache.
        single: whether radiance is scattered once only, so that the irradiance is uncollided.
        depth: optical depth of a voxel at the boundary.

    Values are means over voxels without noise, as those of the solver ``sweep``. In a medium whose
    boundary cuts voxels, such as a sphere, it has no effect.
    """

    def __init__(self, medium: MediumGrid, grid: Grid, single: bool, depth: float) -> None:
        self.medium, self.grid, self.single, self.depth = medium, grid, single, depth
        #: whether the boundary is that of the grid
        self.is_at_faces = medium.fills(grid)


class FittedBorder(Immutable):
    """The profile at the faces of a grid, fitted to the square ``roots`` of means over voxels.

    ``known`` are the voxels that have values; ``separated`` are those that a surface separates from
    the next voxel along each axis, beyond which no values are read.
    """

    def __init__(
        self,
        border: BorderProfile,
        roots: mi.Float,
        known: mi.Bool,
        channels: int,
        separated: tuple[mi.Bool, mi.Bool, mi.Bool] | None = None,
    ) -> None:
        self.border, self.roots, self.known, self.channels = border, roots, known, channels
        self.separated = separated

    def at_centres(self) -> mi.Float:
        """Return the ``roots`` with those of the outermost voxels replaced by roots at their
        centres.

        Linear interpolation between these and the next ones has the weighted mean of the profile
        over the inner half of the outermost voxels.
        """
        grid, channels, result = self.border.grid, self.channels, dr.copy(self.roots)
        voxel = dr.arange(mi.UInt32, grid.voxel_count)
        sides = zip(grid.voxel_indices(voxel), grid.sides, strict=True)
        for axis, (place, side) in enumerate(sides):
            last = mi.UInt32(side) - 1
            at_face = dr.compress(self.known & (last > 0) & ((place == 0) | (place == last)))
            if not dr.width(at_face):
                continue
            number = dr.arange(mi.UInt32, dr.width(at_face) * channels)
            own = dr.gather(mi.UInt32, at_face, number // channels)
            channel = number - number // channels * channels
            profile = _Profile(self, axis, own, channel, mi.Bool(True))
            index = own * channels + channel
            root = dr.gather(mi.Float, result, index)
            ratio = dr.select(root > 0, profile.centre() / dr.maximum(root, 1e-15), 1)
            dr.scatter(result, root * dr.lerp(1, ratio, profile.weight), index)
        dr.eval(result)
        return result

    def growth(
        self, axis: int, voxel: mi.UInt32, channel: mi.UInt32, ratio: mi.Float, active: mi.Bool
    ) -> mi.Float:
        """Return the ratio of the root one voxel beyond a face normal to an ``axis`` to that at the
        centre of the outermost ``voxel``.

        ``ratio`` is returned where the medium is thin.
        """
        profile = _Profile(self, axis, voxel, channel, active)
        return dr.lerp(ratio, profile.growth(), profile.weight)


class _Profile:
    """The profile at the outermost ``voxel`` along an ``axis``."""

    # docs/primer, eqs. (2.13), (2.14)

    def __init__(
        self,
        fitted: FittedBorder,
        axis: int,
        voxel: mi.UInt32,
        channel: mi.UInt32,
        active: mi.Bool,
    ) -> None:
        border = fitted.border
        medium, grid = border.medium, border.grid
        p = grid.centers(voxel)
        extinction = _channel(medium.sigma_t.at_world(p, active), channel)
        albedo = 0 if border.single else _channel(medium.albedo.at_world(p, active), channel)
        # Anisotropic scattering decays like isotropic scattering of the reduced extinction.
        reduced = 1 - albedo * dr.opaque(mi.Float, float(medium.phase.moments[1]))
        albedo = dr.clip(1 - (1 - albedo) / dr.maximum(reduced, 1e-3), 0, 1)
        depth = extinction * dr.opaque(mi.Float, float(grid.voxel_thickness[axis]))

        # Read the three outermost values.
        place, side = grid.voxel_indices(voxel)[axis], grid.sides[axis]
        stride = dr.opaque(mi.Int32, int(np.prod(grid.resolution[:axis], dtype=int)))
        step = dr.select(place == 0, stride, -stride)
        roots, is_known = [], active
        for k in range(3):
            at = mi.UInt32(mi.Int32(voxel) + k * step)
            is_known = is_known & (mi.UInt32(side) > k)
            is_known &= dr.gather(mi.Bool, fitted.known, at, is_known)
            if fitted.separated is not None and k:
                lower = dr.minimum(at, mi.UInt32(mi.Int32(at) - step))
                is_known &= ~dr.gather(mi.Bool, fitted.separated[axis], lower, is_known)
            roots.append(
                dr.gather(mi.Float, fitted.roots, at * fitted.channels + channel, is_known)
            )
            if k == 1:
                has_inner = is_known
        self._roots = roots
        first, second, third = (dr.square(root) for root in roots)

        #: share of this profile in the result
        self.weight = dr.clip((depth - THIN) * (1 / (RESOLVED - THIN)), 0, 1)
        # In a thin plate radiance that enters on the other side is not small.
        is_used = has_inner & (mi.UInt32(side) >= FEWEST) & _is_apart_from_edges(grid, axis, voxel)
        self.weight = dr.select(is_used, self.weight, 0)
        depth = dr.clip(depth, THIN, OPAQUE)
        if border.single:
            # No radiance that enters here decays less than perpendicular one: more of the second
            # value has entered through other faces.
            slowest = dr.exp(-depth)
            ratio = second / dr.maximum(first, 1e-30)
            self.weight *= dr.clip((1 - ratio) / (1 - slowest), 0, 1)

        # Fit A and B, with E_2 and with the exponential in its place.
        self._table = table = _Table(depth)
        decay, slope = _decay(albedo) * reduced, 1 / COSINE
        slow = _Exponential(decay, depth, slope)
        per_voxel = dr.exp(-decay * depth)
        a, b = _solved(slow.outer, slow.inner, table[OUTER], table[INNER], first, second)
        diffuse = (table[INNER] * per_voxel - table[THIRD]) / (
            table[OUTER] * per_voxel - table[INNER]
        )
        # The part that decays as e^(-k t) cancels in these differences.
        rest, next_rest = first * per_voxel - second, second * per_voxel - third
        found = is_known & (rest > 0) & (next_rest > 0)
        share = next_rest / dr.select(found, rest, 1) / diffuse
        steep_share = dr.select(found, dr.clip((1 - share) * (1 / BLENDED), 0, 1), 0)
        steep = _Exponential(
            -dr.log(dr.clip(share * diffuse, STEEPEST, 0.999)) / depth, depth, slope
        )
        c, d = _solved(slow.outer, slow.inner, steep.outer, steep.inner, first, second)
        #: coefficients, and values of the functions at the centre of the outermost voxel, in the
        #: mean over its outer half, and in that over its inner half
        self._terms = [
            (dr.lerp(a, c, steep_share), slow.values),
            (b * (1 - steep_share), (table[CENTRE], table[OUTER_HALF], table[INNER_HALF])),
            (d * steep_share, steep.values),
        ]

    def _values(self) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return Phi at the centre of the outermost voxel, and its weighted means over the outer
        and the inner half, within bounds relative to the means over voxels.
        """
        sums = (sum(c * values[i] for c, values in self._terms) for i in range(3))
        centre, outer_half, inner_half = sums
        outermost, inner = (dr.square(root) for root in self._roots[:2])
        bounds = 0.05 * outermost, 1.1 * dr.maximum(outermost, 0.5 * (outermost + inner))
        return dr.clip(centre, *bounds), dr.maximum(outer_half, 0), dr.clip(inner_half, *bounds)

    def centre(self) -> mi.Float:
        """Return the root at the outermost centre, see `FittedBorder.at_centres`."""
        table, (_, inner, third) = self._table, self._roots
        value, _, inner_half = self._values()
        # The next root is reduced by `conserving`.
        mixed = (dr.sqrt(value) + 4 * inner + dr.select(third > 0, third, inner)) * (1 / 6)
        inner = inner * dr.sqrt(dr.select(mixed > 0, inner / mixed, 1))
        return _end(inner_half, table[FROM_CENTRE], table[MIXED_INWARDS], table[TO_INNER], inner)

    def growth(self) -> mi.Float:
        """Return the ratio of the root beyond the face to that at the outermost centre.

        Linear interpolation of roots between both has the same weighted mean as the profile.
        """
        table, centre = self._table, self.centre()
        _, outer_half, _ = self._values()
        face = _end(outer_half, table[TO_FACE], table[MIXED], table[TO_CENTRE], centre)
        return dr.maximum(2 * face * dr.select(centre > 0, dr.rcp(centre), 0) - 1, 0)


class _Exponential:
    """Means of e^(-k t) over the ``outer`` and the next ``inner`` voxel, and its ``values``: at the
    centre of the outermost voxel, and in the weighted means over its outer and inner half.
    """

    def __init__(self, decay: mi.Float, depth: mi.Float, slope: float) -> None:
        x = decay * depth
        self.outer, centre = _mean_exponential(x), dr.exp(-0.5 * x)
        self.inner = self.outer * dr.exp(-x)
        both, weight = 0.5 * (decay + slope) * depth, 0.5 * slope * depth
        outer_half = _mean_exponential(both) / _mean_exponential(weight)
        self.values = centre, outer_half, outer_half * centre


def _end(
    mean: mi.Float, own: mi.Float, mixed: mi.Float, others: mi.Float, other: mi.Float
) -> mi.Float:
    """Return the root at one end of a line whose square has the weighted ``mean``, given that at
    the ``other`` end, and the weighted means of the squared weights of both ends.
    """
    rest = dr.maximum(mean - others * dr.square(other), 0)
    mixed = mixed * other
    total = mixed + dr.sqrt(dr.fma(mixed, mixed, own * rest))
    return dr.select(total > 0, rest / dr.maximum(total, 1e-30), 0)


def _is_apart_from_edges(grid: Grid, axis: int, voxel: mi.UInt32) -> mi.Bool:
    """Return whether a voxel at a face normal to an ``axis`` is at no other face, whose profile
    would add up with that of this one.
    """
    places, at_edge = grid.voxel_indices(voxel), mi.Bool(False)
    for other, (place, side) in enumerate(zip(places, grid.sides, strict=True)):
        if other != axis:
            at_edge |= (place == 0) | (place + 1 == mi.UInt32(side))
    return ~at_edge


def _solved(
    f0: mi.Float, f1: mi.Float, g0: mi.Float, g1: mi.Float, u: mi.Float, v: mi.Float
) -> tuple[mi.Float, mi.Float]:
    """Solve A f + B g = u, v for A and B, with the components (f0, f1) of f and (g0, g1) of g.

    A is not negative: where the second value is too small, for instance because voxels are opaque
    and it is inaccurate, the first one determines B.
    """
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
        e3 = [0.5, *(_exponential_integrals(n * d)[1] for n in (1.0, 2.0, 3.0))]
        row = [(e3[n] - e3[n + 1]) / d for n in range(3)]
        row.append(_exponential_integrals(0.5 * d)[0])
        weight = w * np.exp(-0.5 * d * y / COSINE)
        weight /= weight.sum()
        # Own weight of the end that is sought: of the face, and of the centre.
        for first, own in ((0.0, 1 - y), (0.5 * d, 1 - 0.5 * y)):
            values = np.array([_exponential_integrals(first + 0.5 * d * t)[0] for t in y])
            means = [weight @ (1 - own) ** 2, weight @ (own * (1 - own)), weight @ own**2]
            row += [weight @ values, *(means if first == 0 else means[::-1])]
        rows.append(row)
    return np.float32(rows), float(lowest), float((DEPTHS - 1) / (highest - lowest))


def _exponential_integrals(x: float) -> tuple[float, float]:
    """Return E_2(x) and E_3(x)."""
    mu, weights = _nodes_of_exponential_integrals()
    e2 = float(weights @ np.exp(-x / mu))
    return e2, 0.5 * (float(np.exp(-x)) - x * e2)


@cache
def _nodes_of_exponential_integrals() -> tuple[np.ndarray, np.ndarray]:
    """Return cosines and weights, which take most of a millisecond and are needed 12800 times."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    t = 0.5 * (nodes + 1)
    return t**3, 1.5 * t**2 * weights
