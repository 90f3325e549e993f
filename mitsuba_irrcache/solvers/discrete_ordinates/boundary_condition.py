"""The light that arrives at a medium's box among surfaces, along the lines of the solver ``sweep``.

Where there are surfaces, what comes along a line is not told by its direction. It is followed back
to where it comes from: one path for each line and way, from the point where the line enters the
box, or one for a few lines next to each other where these are many. What emitters send straight
along a line is known without paths, but for whether it gets there.

A path that comes upon the medium again ends with its first collision: what is scattered towards it
there, it brings back, and this light is only known once the solver knows it. So what arrives is
``emitted + returned phi(place)``, linear in phi, with places and factors that stay as they are
while phi is solved for: surfaces become part of the operator whose fixed point phi is.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.jit import Divisor, symbolic
from mitsuba_irrcache.core.sequences import hashed_seed, random_stream
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.context import probe
from mitsuba_irrcache.solvers.discrete_ordinates.layout import concatenated
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import BoundarySource, TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks
from mitsuba_irrcache.transport.path import Start, trace, trace_to_infinity

#: Cells of a direction, at most about: a path is followed for one line in each, and rays that only
#: find what is in the way of an emitter's light are cheaper. What comes from surfaces differs more
#: from one direction to the next than between lines next to each other.
CELLS, LIT_CELLS = 1 << 11, 1 << 16
#: Paths begin so far within the box [voxels]: surfaces may lie on its faces.
WITHIN = 1e-3
_NUMBERS = 12


class SurfaceBoundary:
    """What is around a medium, as far as its light comes from there.

    ``lamps`` are area emitters that lines meet by chance: what the others send straight to a voxel
    is known otherwise. ``rr_depth`` is that of paths. ``directional`` is what is to be known of
    light by its direction, None where the medium is isotropic.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        lamps: Sequence[mi.EmitterPtr],
        rr_depth: int,
        directional: AngularBasis | None = None,
    ) -> None:
        self.scene, self.media = scene, medium.surroundings.media.around(medium)
        self.pointer, self.lamps = medium.pointer, list(lamps)
        #: the others: what leaves this one, which is convex, meets none of it going straight on
        self.others = self.media.without(medium)
        self.directional = directional
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)
        self.max_depth = dr.opaque(mi.UInt32, 0xFFFFFFFF)

    @property
    def shines(self) -> bool:
        """Whether lines meet light by chance."""
        return bool(self.lamps) or self.others.shines


class IncomingRadiance:
    """The light that arrives along the lines of a table of ``lattice``."""

    def __init__(
        self,
        around: SurfaceBoundary,
        lattice: Tracks,
        rows: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        paths: bool,
        seed: tuple[int, int, int],
    ) -> None:
        """``rows`` are directions, light from far away (n, 2, channels), weights and offsets as
        for `Tracks.table`: light from surfaces comes along those that have a weight. Without
        ``paths``, light comes straight from emitters only.
        """
        directions, light, weights, offsets = rows
        self.lattice = lattice
        parts = [light] if around.directional is None else around.directional.apart(rows[0], light)
        #: rows along which light may come straight from emitters; where it is told by its
        #: direction, from those that are not narrow, and from each that is
        self.lit = [part.any(axis=(1, 2)) for part in parts]
        self.lit[0] |= (weights > 0) & around.shines
        self._lines = lattice.table(directions, light[..., 0], weights, offsets).geometry
        self._cells(np.where(weights > 0, CELLS, LIT_CELLS))
        found = _follow(around, self, *self._numbers(directions, parts, weights), paths, seed)
        #: for each channel: straight from emitters, as of `lit`; all of what does not depend on
        #: phi; factors of phi; and for all of them, the voxels of phi, and the directions in which
        #: these are seen, if they matter
        self.straight, self.emitted, self.returned, self.voxel, self._heading = found
        self._voxels: dict[tuple, mi.UInt32] = {lattice.grid.shape: self.voxel}

    @property
    def kinds(self) -> list[list]:
        """All that has channels."""
        return [*self.straight, self.emitted, self.returned]

    def directly(
        self, channels: Sequence[int], table: TrackTable, rows: np.ndarray, part: int = 0
    ) -> BoundarySource:
        """Light straight from emitters, that ``part`` of it, along the lines of a ``table`` of the
        same lattice for these ``rows``.
        """
        light = concatenated([self.straight[part][c] for c in channels])
        return BoundarySource(*self._placed(self.lattice, table, rows), light, len(channels))

    def returning(
        self,
        channels: Sequence[int],
        level: MultigridLevel,
        table: TrackTable,
        rows: np.ndarray,
        emitted: bool,
    ) -> ReflectedBoundarySource:
        """Light along the lines of a ``table`` for these ``rows``, which follow each other, of the
        same lattice or that of a coarser ``level``; without what is ``emitted`` unless that is
        wanted.
        """
        lattice, grid = level.lattice, level.grid
        if grid.shape not in self._voxels:
            self._voxels[grid.shape] = _coarser(self.lattice.grid, grid, self.voxel)
        places, cells = self._placed(lattice, table, rows)
        start, count = int(cells[0, 0]), int(self._ends[rows[-1]] - cells[0, 0])
        cells[:, 0] -= start
        here = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
        values = [
            concatenated([dr.gather(mi.Float, kind[c], here) for c in channels])
            for kind in (self.returned, *([self.emitted] if emitted else []))
        ]
        # All matter is in wanted voxels: no light comes from others.
        at = lattice.active_index(dr.gather(mi.UInt32, self._voxels[grid.shape], here))
        first = dr.minimum(at, dr.opaque(mi.UInt32, lattice.active_count - 1)) * len(channels)
        dr.eval(first)
        sources = concatenated([first + c for c in range(len(channels))])
        heading = None
        if self._heading is not None:
            heading = mi.Vector3f(*(dr.gather(mi.Float, x, here) for x in self._heading))
        dr.eval(values, sources, heading)
        return ReflectedBoundarySource(
            level, len(channels), places, cells, sources, heading, *values
        )

    def _cells(self, most: np.ndarray) -> None:
        """Lays out cells: blocks of lines, so many along an edge that there are not too ``many``
        in a direction.
        """
        lines = self._lines
        length = lines.sizes[:, 2:]
        # The first slice passes the middle of the first voxels.
        moved = np.stack([-0.5 * lines.slopes, (length - 0.5) * lines.slopes])
        self._least = np.floor(-lines.starts - moved.max(axis=0))
        last = np.ceil(lines.sizes[:, :2] - lines.starts - moved.min(axis=0))
        count = last - self._least + 1
        self._edge = np.maximum(1, np.ceil(np.sqrt(count.prod(axis=1) / most)))
        self._sides = np.ceil(count / self._edge[:, None]).astype(np.int64)
        self._ends = np.cumsum(2 * self._sides.prod(axis=1))
        self._first, self._count = np.concatenate([[0], self._ends[:-1]]), int(self._ends[-1])

    def _numbers(
        self, directions: np.ndarray, parts: list[np.ndarray], weights: np.ndarray
    ) -> tuple[tuple[mi.UInt32, mi.Float], list[mi.Float]]:
        """What `_follow` has to know of each row; ``parts`` are those of the light."""
        lines = self._lines
        integers = np.column_stack(
            [self._first, self._sides[:, 0], lines.axis, lines.transverse[:, 0]]
        )
        sign = np.where(lines.forward, 1.0, -1.0)
        columns = [sign[:, None] * directions, lines.slopes, lines.starts + self._least]
        numbers = np.column_stack([*columns, lines.sizes, self._edge, weights])
        forward = lines.forward[:, None, None]
        ways = [np.where(forward, light, light[:, ::-1]).ravel().tolist() for light in parts]
        as_list = mi.UInt32([*integers.ravel().tolist(), 0xFFFFFFFF])  # the end, to be searched for
        return (as_list, mi.Float(numbers.ravel().tolist())), [mi.Float(way) for way in ways]

    def begin(
        self, numbers: tuple[mi.UInt32, mi.Float], seed: tuple[int, int, int]
    ) -> tuple[mi.UInt32, mi.Float, mi.Bool, mi.Ray3f, mi.PCG32]:
        """For each value that cells have: the number of the row's way (two in each), the row's
        weight, whether the line meets the box, the ray from there to where light comes from, and a
        random generator.
        """
        integers, values = numbers
        lanes = dr.arange(mi.UInt32, self._count)
        row = dr.binary_search(
            0,
            len(self._first) - 1,
            lambda i: dr.gather(mi.UInt32, integers, (i + 1) * 4) <= lanes,
        )
        start, wide, axis, axis_b = (dr.gather(mi.UInt32, integers, row * 4 + i) for i in range(4))
        dx, dy, dz, slope_b, slope_c, least_b, least_c, nb, nc, na, edge, weight = (
            dr.gather(mi.Float, values, row * _NUMBERS + i) for i in range(_NUMBERS)
        )
        within = lanes - start
        back, cell = (within & 1) == 1, within >> 1
        cell_c = cell // dr.maximum(wide, 1)
        cell_b = cell - cell_c * wide
        *batch, use = seed
        stream = hashed_seed(batch)[0] + dr.opaque(mi.UInt32, use)
        rng = random_stream(mi.sample_tea_32(lanes, stream))
        lines = least_b, least_c, slope_b, slope_c, nb, nc, na
        b, c, near, far, rng = _one_of(edge, mi.Float(cell_b), mi.Float(cell_c), *lines, rng)
        hit = near < far
        a = dr.select(back, far, near)
        b, c = dr.fma(a - 0.5, slope_b, b), dr.fma(a - 0.5, slope_c, c)
        a, b, c = (dr.clip(x, WITHIN, n - WITHIN) for x, n in ((a, na), (b, nb), (c, nc)))
        place = [
            dr.select(axis == k, a, dr.select(axis_b == k, b, c)) + dr.opaque(mi.Float, float(low))
            for k, low in enumerate(self.lattice.lower)
        ]
        p = self.lattice.grid.world.point(mi.Point3f(place))
        ray = mi.Ray3f(p, mi.Vector3f(dx, dy, dz) * dr.select(back, 1, -1))
        return row * 2 + dr.select(back, 1, 0), weight, hit, ray, rng

    def _placed(
        self, lattice: Tracks, table: TrackTable, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The first arguments of `BoundarySource`."""
        mine, lines = self.lattice, table.geometry
        ratio = float(round((lattice.grid.voxel_size / mine.grid.voxel_size)[0]))
        lower, across, n = mine.lower, lines.transverse, np.arange(len(rows))
        # Where the lines are that pass the first slice of the finest grid at 0, in the coarser one.
        ahead = (lower[lines.axis] + 0.5) / ratio - lattice.lower[lines.axis] - 0.5
        moves = ratio * (lattice.lower[across] + lines.slopes * ahead[n, None]) - lower[across]
        moves = moves - self._lines.starts[rows] - self._least[rows] + 0.5
        edge = self._edge[rows, None]
        places = np.hstack([ratio / edge, moves / edge, lines.slopes])
        return places, np.column_stack([self._first[rows], self._sides[rows]])


@symbolic
def _one_of(edge, cell_b, cell_c, least_b, least_c, slope_b, slope_c, nb, nc, na, rng):
    """Of the lines of a cell, ``edge`` along either axis, one of those that meet the box: where it
    passes the first slice, and where along the axis it enters the box and leaves it.
    """
    b, c, near, far = mi.Float(0), mi.Float(0), mi.Float(1) + 0 * na, 0 * na
    k, met = mi.Float(0), mi.Float(0)
    while dr.hint(k < edge * edge, label="lines of a cell"):
        row = dr.floor(k / edge)
        at_b, at_c = least_b + cell_b * edge + (k - row * edge), least_c + cell_c * edge + row
        begin, end = mi.Float(0), mi.Float(na)
        first, last = -at_b / slope_b + 0.5, (nb - at_b) / slope_b + 0.5
        begin, end = (
            dr.maximum(begin, dr.minimum(first, last)),
            dr.minimum(end, dr.maximum(first, last)),
        )
        first, last = -at_c / slope_c + 0.5, (nc - at_c) / slope_c + 0.5
        begin, end = (
            dr.maximum(begin, dr.minimum(first, last)),
            dr.minimum(end, dr.maximum(first, last)),
        )
        meets = begin < end
        met += dr.select(meets, 1.0, 0.0)
        chosen = meets & (rng.next_float32() * met < 1)
        b, c = dr.select(chosen, at_b, b), dr.select(chosen, at_c, c)
        near, far = dr.select(chosen, begin, near), dr.select(chosen, end, far)
        k += 1
    return b, c, near, far, rng


class ReflectedBoundarySource(BoundarySource):
    """`BoundarySource` light ``emitted + returned phi(source)``, this as it is seen along
    ``heading``.
    """

    def __init__(
        self,
        level: MultigridLevel,
        channels: int,
        places: np.ndarray,
        cells: np.ndarray,
        source: mi.UInt32,
        heading: mi.Vector3f | None,
        returned: mi.Float,
        emitted: mi.Float | None = None,
    ) -> None:
        super().__init__(places, cells, None, channels)
        self._level, self._source, self._heading = level, source, heading
        self._returned, self._emitted = returned, emitted

    def receive(self, phi: mi.Float | None) -> None:
        """Where the mean irradiance of collisions is ``phi`` (None: 0)."""
        light = dr.zeros(mi.Float, dr.width(self._source))
        if phi is not None:
            light = self._returned * self._level.seen(phi, self._source, self._heading)
        self.values = light if self._emitted is None else light + self._emitted
        dr.eval(self.values)


def _coarser(fine: Grid, coarse: Grid, voxel: mi.UInt32) -> mi.UInt32:
    """The voxels of a coarser grid of the hierarchy in which those of the fine one lie."""
    ratio = Divisor(round((coarse.voxel_size / fine.voxel_size)[0]))
    result = coarse.index(*(ratio.split(place)[0] for place in fine.places(voxel)))
    dr.eval(result)
    return result


def _follow(
    around: SurfaceBoundary,
    arrivals: IncomingRadiance,
    numbers: tuple[mi.UInt32, mi.Float],
    colours: list[mi.Float],
    paths: bool,
    seed: tuple[int, int, int],
) -> tuple[list, list, list, mi.UInt32, mi.Vector3f | None]:
    """What arrives along the lines of all cells, both ways in turn; see `IncomingRadiance`."""
    grid = arrivals.lattice.grid
    way, weight, hit, ray, rng = arrivals.begin(numbers, seed)
    pointer = probe(around.scene, ray.o, ray.d)

    parts = [dr.gather(mi.Spectrum, colour, way) for colour in colours]
    lit = hit & (dr.max(sum(parts)) > 0)
    if around.shines:
        lit |= hit & (weight > 0)
    passed, glow, rng = trace_to_infinity(
        around.scene, around.others, ray, pointer, around.lamps, rng, lit
    )
    parts = [light * passed for light in parts]
    parts[0] += weight * glow
    straight = [dr.select(lit, light, 0) for light in parts]
    emitted, returned, voxel = sum(straight), mi.Spectrum(0), mi.UInt32(0)
    heading = mi.Vector3f(0, 0, 1)
    if paths:
        begin = Start(ray, pointer, depth=1, pdf=0.0, clear=pointer == around.pointer)
        _, scattered, _, end, _ = trace(
            around.scene, around.media, begin, around.max_depth, around.rr_depth, False, rng,
            hit & (weight > 0), lambda medium: medium == around.pointer,
        )  # fmt: skip
        emitted = emitted + weight * scattered
        heading = end.direction
        returned = weight * end.weight * dr.inv_four_pi
        u = grid.coordinates.point(end.p)
        at = (
            mi.Int32(dr.clip(dr.floor(v), 0, mi.Float(n - 1)))
            for v, n in zip(u, grid.sides, strict=True)
        )
        voxel = grid.index(*at)
    none = dr.zeros(mi.Float, dr.width(weight))
    straight = [[v + none for v in part] for part in straight]
    emitted, returned = ([v + none for v in kind] for kind in (emitted, returned))
    voxel = voxel + dr.zeros(mi.UInt32, dr.width(weight))
    heading = None if around.directional is None else heading + none
    dr.eval(straight, emitted, returned, voxel, heading)
    return straight, emitted, returned, voxel, heading
