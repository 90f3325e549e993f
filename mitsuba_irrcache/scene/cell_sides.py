"""Division of cells, the boxes between eight voxel centres, by the surfaces that cut them.

The surfaces in a cell are approximated by planes, or by spheres if they are curved: first those
that separate most of the pairs of corners that do not see each other, then others, such as the
second face of a wall, or a lamp in front of it. They divide the cell into regions. The corners
whose values are valid in a region are those that most positions in it see, as far as they see each
other.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.core.sequences import kronecker
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.scene.occluders import first_surface

CORNERS = list(itertools.product((0, 1), repeat=3))
#: Largest number of planes per cell, and number of regions into which they divide it.
PLANES = 4
REGIONS = 1 << PLANES
#: Masks of corners per word, and words per cell.
PER_WORD = 4
WORDS = REGIONS // PER_WORD
#: Segments between corners in both directions, as pairs of `CORNERS`.
SEGMENTS = list(itertools.permutations(range(8), 2))
#: Segments that determine which cells are cut: edges and diagonals.
FIRST_SEGMENTS = [
    (a, b)
    for a, b in itertools.combinations(range(8), 2)
    if sum(x != y for x, y in zip(CORNERS[a], CORNERS[b], strict=True)) in (1, 3)
]
#: By how much segments are extended at corners, relative to their length, and the distance in
#: voxels up to which a corner lies in a plane: such a corner is on neither side.
MARGIN = 1e-3
#: A plane is another one than those found before if its surface point is farther from them [voxels]
#: or the cosine between the normals is smaller.
OTHER_DISTANCE, OTHER_COSINE = 0.05, 0.9
#: Scores of planes: for each visible pair of corners that they separate, and for their distance
#: from the centre of the cell in voxels. Each separated pair that is not visible adds 1.
HARM, REMOTENESS = -0.25, -0.1
#: Normals whose cosine with that of a surface is larger determine its curvature, which is at most
#: `MOST_CURVED` [1/voxel].
CURVED_COSINE, MOST_CURVED = 0.7, 1.0
#: Positions per cell from which the visible corners are determined, and the weight of those that
#: see no backs of surfaces: the others are likely to lie in objects.
POSITIONS, IN_FRONT = 64, 64
#: Cells whose positions are processed at a time.
BLOCK = 1 << 15
#: Random positions among which one in a region is searched, and the length of random walks from
#: such positions to one that sees a corner: steps in all, and steps of each walk.
TRIALS, STEPS, WALK = 256, 64, 8


class CellSides:
    """Planes and valid corners of the cells of ``grid`` that surfaces cut.

    Surfaces that bound ``medium``, if given, are ignored.

    Attributes:
        found: indices of the cut cells.
        planes: for each of them, `PLANES` planes (g, c), with g s + c = 0 for coordinates s in
            voxels that are 0 at the centre of the first voxel.
        curvatures: the curvature k of each plane: the surface is g s + c + k |s - m|^2 / 2 = 0,
            where m is the middle of the cell.
        corners: for each of them, the mask of the valid corners of each region (see `region_of`),
            8 bits each, `PER_WORD` in a word.
    """

    def __init__(self, scene: mi.Scene, grid: Grid, medium: mi.MediumPtr | None) -> None:
        self._scene, self._grid, self._medium = scene, grid, medium
        self._divisors = [Divisor(int(n) - 1) for n in grid.resolution[:2]]
        cut = self._is_cut(dr.arange(mi.UInt32, int((grid.resolution - 1).prod())))
        dr.eval(cut)
        self.found = dr.compress(cut)
        count = dr.width(self.found)
        if not count:
            return
        index = dr.arange(mi.UInt32, count * PLANES)
        self.planes = dr.zeros(mi.Float, 4 * count * PLANES)
        # Without a surface, a plane is one that has all positions in front of it.
        dr.scatter(self.planes, mi.Vector4f(0, 0, 0, 1), index)
        self.curvatures = dr.zeros(mi.Float, count * PLANES)
        blocked, simple = self._find_planes()
        self.corners = dr.zeros(mi.UInt32, count * WORDS)
        if dr.any(simple):
            self._set_simple(dr.compress(simple))
        others = dr.compress(~simple)
        for first in range(0, dr.width(others), BLOCK):
            size = min(BLOCK, dr.width(others) - first)
            part = dr.gather(
                mi.UInt32, others, dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, first)
            )
            self._set_corners(part, blocked)

    def _first(self, cell: mi.UInt32) -> mi.Point3f:
        """Return the first corner of cells, in voxels, 0 at the centre of the first voxel."""
        return mi.Point3f(*unravelled(cell, self._divisors))

    def _world(self, s: mi.Point3f) -> mi.Point3f:
        """Convert coordinates in voxels, 0 at the centre of the first one, to a world position."""
        return self._grid.world.point(s + 0.5)

    def _surface(self, a: mi.Point3f, b: mi.Point3f, active: mi.Bool | bool = True):
        """Find the first surface between two positions in voxels, see `first_surface`."""
        ends = self._world(a), self._world(b)
        return first_surface(self._scene, *ends, mi.Bool(active), ignored=self._medium)

    # ------------------------------------------------------------------ planes

    @symbolic
    def _is_cut(self, cell: mi.UInt32):
        """Return whether surfaces lie between corners of cells."""
        first, found = self._first(cell), mi.Bool(False)
        starts, ends = _tables(FIRST_SEGMENTS)
        k, count = mi.UInt32(0), dr.opaque(mi.UInt32, len(FIRST_SEGMENTS))
        while dr.hint(k < count, label="cut cells"):
            a, b = _segment(first, dr.gather(mi.UInt32, starts, k), dr.gather(mi.UInt32, ends, k))
            *_, hit = self._surface(a, b, ~found)
            found |= hit
            k += 1
        return found

    @symbolic
    def _blocked(self, cell: mi.UInt32):
        """Return for each cell a matrix of bits: 8 a + b is set if corner a does not see b."""
        first, blocked = self._first(cell), mi.UInt64(0)
        starts, ends = _tables(SEGMENTS)
        k, count = mi.UInt32(0), dr.opaque(mi.UInt32, len(SEGMENTS))
        while dr.hint(k < count, label="blocked corners"):
            one, two = dr.gather(mi.UInt32, starts, k), dr.gather(mi.UInt32, ends, k)
            a, b = _segment(first, one, two)
            *_, hit = self._surface(a, b)
            pair = (mi.UInt64(1) << (8 * one + two)) | (mi.UInt64(1) << (8 * two + one))
            blocked |= dr.select(hit, pair, 0)
            k += 1
        return blocked

    def _find_planes(self) -> tuple[mi.UInt64, mi.Bool]:
        """Set the planes of all cells.

        Returns the matrix of `_blocked`, and whether one plane describes a cell completely: it
        separates exactly those corners that do not see each other, and there is no other surface.
        """
        count = dr.width(self.found)
        blocked = self._blocked(self.found)
        dr.eval(blocked)
        left, exact, more = mi.UInt64(blocked), *(dr.full(mi.Bool, False, count) for _ in range(2))
        chosen = dr.arange(mi.UInt32, count)
        for number in range(PLANES):
            pairs, rest = (dr.gather(mi.UInt64, values, chosen) for values in (blocked, left))
            cell = dr.gather(mi.UInt32, self.found, chosen)
            known = planes_of(self.planes, self.curvatures, chosen)
            score, plane, point, separated = self._best_plane(cell, pairs, rest, known)
            is_new = score > -dr.inf
            dr.eval(is_new, plane, point, separated)
            curved, curvature = self._curved(cell, plane, point, is_new)
            fits = _separated(curved, curvature, self._first(cell)) == separated
            dr.scatter(
                self.planes, dr.select(fits, curved, plane), chosen * PLANES + number, is_new
            )
            dr.scatter(self.curvatures, curvature, chosen * PLANES + number, is_new & fits)
            dr.scatter(left, rest & ~separated, chosen, is_new)
            if number == 0:
                dr.scatter(exact, is_new & (separated == pairs), chosen)
            else:
                dr.scatter(more, mi.Bool(True), chosen, is_new)
            dr.eval(self.planes, self.curvatures, left, exact, more)
            kept = dr.compress(is_new)
            if not dr.width(kept):
                break
            chosen = dr.gather(mi.UInt32, chosen, kept)
            dr.eval(chosen)
        return blocked, exact & ~more

    @symbolic
    def _best_plane(
        self,
        cell: mi.UInt32,
        pairs: mi.UInt64,
        rest: mi.UInt64,
        known: list[tuple[mi.Vector4f, mi.Float]],
    ):
        """Choose a tangent plane of a surface that segments between corners hit.

        ``pairs`` are those of corners that do not see each other, ``rest`` those that the ``known``
        planes do not separate. A plane separates some of these, or is another one than those known.
        Returns its score, -inf if there is none, the plane, a position on the surface, and the
        pairs that the plane separates.
        """
        first = self._first(cell)
        middle = first + 0.5
        best, separated = mi.Float(-dr.inf), mi.UInt64(0)
        plane, point = mi.Vector4f(0, 0, 0, 1), mi.Point3f(0)
        starts, ends = _tables(SEGMENTS)
        k, count = mi.UInt32(0), dr.opaque(mi.UInt32, len(SEGMENTS))
        while dr.hint(k < count, label="planes of cells"):
            a, b = _segment(first, dr.gather(mi.UInt32, starts, k), dr.gather(mi.UInt32, ends, k))
            at, steps, hit = self._tangent(a, b, mi.Bool(True))
            here = mi.Vector4f(steps.x, steps.y, steps.z, -dr.dot(steps, at))
            is_other = mi.Bool(True)
            for each, curvature in known:
                off = at - middle
                distance = _distance(each, curvature, at, dr.squared_norm(off))
                slope = mi.Vector3f(each.x, each.y, each.z) + curvature * off
                cosine = dr.abs(dr.dot(slope, steps)) / dr.maximum(dr.norm(slope), 1e-30)
                is_other &= (dr.abs(distance) > OTHER_DISTANCE) | (cosine < OTHER_COSINE)
            apart = _separated(here, mi.Float(0), first)
            # The matrices are symmetric: they contain each pair twice.
            gain = mi.Float(dr.popcnt(apart & rest)) * 0.5
            score = gain + mi.Float(dr.popcnt(apart & ~pairs)) * (0.5 * HARM)
            score += REMOTENESS * dr.norm(at - middle)
            better = hit & (is_other | (gain > 0)) & (score > best)
            best = dr.select(better, score, best)
            plane = dr.select(better, here, plane)
            point = dr.select(better, at, point)
            separated = dr.select(better, apart, separated)
            k += 1
        return best, plane, point, separated

    @symbolic
    def _curved(self, cell: mi.UInt32, plane: mi.Vector4f, point: mi.Point3f, active: mi.Bool):
        """Determine the curvature of the surface at ``point`` from the normals of other hits.

        Returns the linear terms and the curvature of the sphere that touches ``plane`` there. The
        curvature is the slope of a linear regression of normals over positions.
        """
        first = self._first(cell)
        normal = mi.Vector3f(plane.x, plane.y, plane.z)
        starts, ends = _tables(FIRST_SEGMENTS)
        k, count = mi.UInt32(0), dr.opaque(mi.UInt32, len(FIRST_SEGMENTS))
        product, square = mi.Float(0), mi.Float(0)
        while dr.hint(k < count, label="curvatures of cells"):
            a, b = _segment(first, dr.gather(mi.UInt32, starts, k), dr.gather(mi.UInt32, ends, k))
            at, other, hit = self._tangent(a, b, active)
            hit &= dr.dot(other, normal) > CURVED_COSINE
            away = at - point
            product += dr.select(hit, dr.dot(other - normal, away), 0)
            square += dr.select(hit, dr.squared_norm(away), 0)
            k += 1
        curvature = dr.clip(product / dr.maximum(square, 1e-6), -MOST_CURVED, MOST_CURVED)
        # The sphere around the middle of the cell, where its quadratic term is 0.
        off = first + 0.5 - point
        slope = normal + curvature * off
        rest = dr.dot(normal, off) + 0.5 * curvature * dr.squared_norm(off)
        constant = rest - dr.dot(slope, first + 0.5)
        return mi.Vector4f(slope.x, slope.y, slope.z, constant), curvature

    @symbolic
    def _tangent(self, a: mi.Point3f, b: mi.Point3f, active: mi.Bool):
        """Return position and unit normal, in voxels, of the first surface between two positions,
        and whether there is one.
        """
        distance, normal, hit = self._surface(a, b, active)
        length = dr.norm(self._world(b) - self._world(a))
        units = (1, 0, 0), (0, 1, 0), (0, 0, 1)
        slope = mi.Vector3f(
            [dr.dot(normal, self._grid.world.vector(mi.Vector3f(*unit))) for unit in units]
        )
        return a + (b - a) * (distance / length), slope / dr.maximum(dr.norm(slope), 1e-30), hit

    # ------------------------------------------------------------------ corners

    def _set_simple(self, chosen: mi.UInt32) -> None:
        """Set the corners of cells that one plane describes completely."""
        first = self._first(dr.gather(mi.UInt32, self.found, chosen))
        (plane, curvature), *_ = planes_of(self.planes, self.curvatures, chosen)
        ahead, behind = _sides(plane, curvature, first)
        dr.scatter(self.corners, ahead | (behind << 8), chosen * WORDS)
        dr.eval(self.corners)

    def _set_corners(self, chosen: mi.UInt32, blocked: mi.UInt64) -> None:
        """Set the corners of cells from those seen by positions in the regions."""
        count = dr.width(chosen)
        index = dr.arange(mi.UInt32, count * POSITIONS)
        number = index // POSITIONS
        place = dr.gather(mi.UInt32, chosen, number)
        seen, weight, region = self._seen_from(place, index - number * POSITIONS)
        counts = dr.zeros(mi.UInt32, count * REGIONS * 8)
        is_open = dr.full(mi.Bool, False, count * REGIONS)
        dr.scatter(is_open, mi.Bool(True), number * REGIONS + region, weight == IN_FRONT)
        for c in range(8):
            target = (number * REGIONS + region) * 8 + c
            dr.scatter_add(counts, weight, target, (seen >> c) & 1 > 0)
        dr.eval(counts, is_open)
        index = dr.arange(mi.UInt32, count * REGIONS)
        number = index // REGIONS
        region = index - number * REGIONS
        seen = [dr.gather(mi.UInt32, counts, index * 8 + c) for c in range(8)]
        most, best = mi.UInt32(0), mi.UInt32(0)
        for c, n in enumerate(seen):
            best = dr.select(n > most, c, best)
            most = dr.maximum(n, most)
        place = dr.gather(mi.UInt32, chosen, number)
        pairs = dr.gather(mi.UInt64, blocked, place)
        corners = mi.UInt32(0)
        for c, n in enumerate(seen):
            corners |= dr.select((n > 0) & (2 * n >= most), mi.UInt32(1 << c), 0)
        corners &= _seen_by(pairs, best)
        dr.eval(corners)
        dark = dr.compress(corners == 0)
        if dr.width(dark):
            lanes = [dr.gather(mi.UInt32, values, dark) for values in (place, region)]
            lanes += [dr.gather(mi.UInt64, pairs, dark), dr.gather(mi.Bool, is_open, dark)]
            dr.scatter(corners, self._reached_from(*lanes), dark)
            dr.eval(corners)
        index = dr.arange(mi.UInt32, count * WORDS)
        number = index // WORDS
        word = mi.UInt32(0)
        for k in range(PER_WORD):
            word |= dr.gather(mi.UInt32, corners, index * PER_WORD + k) << (8 * k)
        place = dr.gather(mi.UInt32, chosen, number) * WORDS + index - number * WORDS
        dr.scatter(self.corners, word, place)
        dr.eval(self.corners)

    @symbolic
    def _seen_from(self, place: mi.UInt32, sample: mi.UInt32):
        """Determine which corners positions in cells see.

        Returns the mask of the corners, the weight of the position, and its region.
        """
        first = self._first(dr.gather(mi.UInt32, self.found, place))
        s = first + mi.Point3f(kronecker(sample, 3))
        region = region_of(planes_of(self.planes, self.curvatures, place), s, first + 0.5)
        seen, is_back, k = mi.UInt32(0), mi.Bool(False), mi.UInt32(0)
        while dr.hint(k < 8, label="visible corners"):
            towards = (1 + MARGIN) * (first + _corner(k) - s)
            _, normal, hit = self._surface(s, s + towards)
            seen |= dr.select(hit, 0, mi.UInt32(1) << k)
            is_back |= hit & (dr.dot(normal, self._grid.world.vector(mi.Vector3f(towards))) > 0)
            k += 1
        return seen, dr.select(is_back, mi.UInt32(1), IN_FRONT), region

    @symbolic
    def _reached_from(
        self, place: mi.UInt32, region: mi.UInt32, pairs: mi.UInt64, is_open: mi.Bool
    ):
        """Return the corners of regions from which none is visible.

        They are those that are visible from the first corner that random walks between surfaces
        reach. If they reach none, the corners are those in the region. Without any, the region is
        likely to be in an object, unless it ``is_open``: then they are those that the fewest planes
        separate from it.
        """
        first = self._first(dr.gather(mi.UInt32, self.found, place))
        planes = planes_of(self.planes, self.curvatures, place)
        rng = mi.PCG32(dr.width(place))
        s, corners = mi.Point3f(first), mi.UInt32(0)
        trial, step, active = mi.UInt32(0), mi.UInt32(0), mi.Bool(True)
        while dr.hint(active, label="walks"):
            searching = step % WALK == 0
            while dr.hint(searching, label="starts of walks"):
                start = first + mi.Point3f(kronecker(trial, 3))
                matches = region_of(planes, start, first + 0.5) == region
                s = dr.select(matches, start, s)
                trial += 1
                active &= trial < TRIALS
                searching &= ~matches & active
            u = mi.Point2f(rng.next_float32(), rng.next_float32())
            towards = mi.warp.square_to_uniform_sphere(u)
            distance, _, hit = self._surface(s, s + towards, active)
            length = dr.norm(self._grid.world.vector(towards))
            s = mi.Point3f(s + towards * dr.select(hit, 0.5 * distance / length, 0.5))
            place_in_cell = s - first
            nearest = mi.UInt32(0)
            for axis, value in enumerate(place_in_cell):
                nearest |= dr.select(value > 0.5, mi.UInt32(4 >> axis), 0)
            end = s + (1 + MARGIN) * (first + _corner(nearest) - s)
            *_, hit = self._surface(s, end, active)
            corners = dr.select(active & ~hit, _seen_by(pairs, nearest), corners)
            step += 1
            active &= hit & (step < STEPS)
        fewest, likely = mi.UInt32(PLANES + 1), mi.UInt32(0)
        for c in range(8):
            at = first + _corner(mi.UInt32(c))
            crossed = dr.popcnt(region_of(planes, at, first + 0.5) ^ region)
            likely = dr.select(crossed < fewest, 0, likely)
            likely |= dr.select(crossed <= fewest, mi.UInt32(1 << c), 0)
            fewest = dr.minimum(crossed, fewest)
        # Too small a region for any position may still contain corners.
        own = mi.UInt32(0xFF)
        for k, (plane, curvature) in enumerate(planes):
            ahead, behind = _sides(plane, curvature, first)
            own &= dr.select((region >> k) & 1 > 0, behind, ahead)
        own &= _seen_by(pairs, dr.minimum(dr.tzcnt(own), 7))
        likely = dr.select(own > 0, own, dr.select(is_open, likely, 0))
        return dr.select(corners > 0, corners, likely)


def region_of(
    planes: Sequence[tuple[mi.Vector4f, mi.Float]], s: mi.Point3f, middle: mi.Point3f
) -> mi.UInt32:
    """Return the region, of the cell with this ``middle``, that contains ``s``: bit k is set if it
    is behind plane k.
    """
    region, square = mi.UInt32(0), dr.squared_norm(s - middle)
    for k, (plane, curvature) in enumerate(planes):
        region |= dr.select(_distance(plane, curvature, s, square) > 0, 0, mi.UInt32(1 << k))
    return region


def _distance(plane: mi.Vector4f, curvature: mi.Float, s: mi.Point3f, square: mi.Float) -> mi.Float:
    """Return the distance of ``s`` [voxels] from a plane in the direction of its normal, or a
    number of the same sign if it is curved; ``square`` is the squared distance of ``s`` from the
    middle of the cell.
    """
    return dr.dot(mi.Vector3f(plane.x, plane.y, plane.z), s) + plane.w + 0.5 * curvature * square


def planes_of(
    planes: mi.Float, curvatures: mi.Float, place: mi.UInt32
) -> list[tuple[mi.Vector4f, mi.Float]]:
    """Return the planes of cells, which are the records ``place``, and their curvatures."""
    indices = [place * PLANES + k for k in range(PLANES)]
    return [
        (dr.gather(mi.Vector4f, planes, index), dr.gather(mi.Float, curvatures, index))
        for index in indices
    ]


def _sides(
    plane: mi.Vector4f, curvature: mi.Float, first: mi.Point3f
) -> tuple[mi.UInt32, mi.UInt32]:
    """Return the masks of the corners of a cell that lie ahead of and behind a plane."""
    ahead, behind = mi.UInt32(0), mi.UInt32(0)
    for c, corner in enumerate(CORNERS):
        distance = _distance(plane, curvature, first + mi.Vector3f(*corner), mi.Float(0.75))
        ahead |= dr.select(distance > MARGIN, mi.UInt32(1 << c), 0)
        behind |= dr.select(distance < -MARGIN, mi.UInt32(1 << c), 0)
    return ahead, behind


def _separated(plane: mi.Vector4f, curvature: mi.Float, first: mi.Point3f) -> mi.UInt64:
    """Return the symmetric matrix of bits of the pairs of corners that a plane separates."""
    ahead, behind = _sides(plane, curvature, first)
    result = mi.UInt64(0)
    for c in range(8):
        row = dr.select((ahead >> c) & 1 > 0, behind, 0)
        row = dr.select((behind >> c) & 1 > 0, ahead, row)
        result |= mi.UInt64(row) << (8 * c)
    return result


def _seen_by(blocked: mi.UInt64, corner: mi.UInt32) -> mi.UInt32:
    """Return the mask of the corners that a corner sees, including itself."""
    return ~mi.UInt32(blocked >> mi.UInt64(8 * corner)) & 0xFF


def _segment(first: mi.Point3f, a: mi.UInt32, b: mi.UInt32) -> tuple[mi.Point3f, mi.Point3f]:
    """Return the ends of the extended segment between two corners of a cell."""
    start, stop = first + _corner(a), first + _corner(b)
    more = MARGIN * (stop - start)
    return start - more, stop + more


def _corner(index: mi.UInt32) -> mi.Vector3f:
    """Return the corner of a cell with this index in `CORNERS`."""
    return mi.Vector3f((index >> 2) & 1, (index >> 1) & 1, index & 1)


def _tables(segments: list[tuple[int, int]]) -> list[mi.UInt32]:
    """Return the first and second ends of segments."""
    return [mi.UInt32(ends) for ends in zip(*segments, strict=True)]
