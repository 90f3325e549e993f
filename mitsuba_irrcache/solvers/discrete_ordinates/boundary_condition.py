"""The boundary condition among surfaces: radiance that enters the medium's box along each track.

If there are surfaces around a medium, the incoming radiance depends on position and direction. It
is estimated by Monte Carlo paths that start where a track enters the box, against the direction of
propagation: one path for each track and for both of its directions (*ways*), or one for a square
block of neighbouring tracks (a *cell*) if there are many. Radiance that comes straight from
emitters along a track needs only a visibility test.

A path that enters the medium ends at its first collision there. The radiance scattered towards the
path from that voxel is proportional to the unknown phi of the solver. The incoming radiance is
therefore ``emitted + reflected phi(voxel)``, linear in phi, with voxels and factors that are
constant during the iteration: surfaces become part of the operator A of phi = A phi + b
(`multigrid`).

Where tracks cross surfaces among the voxels (`crossings`), the radiance that leaves these surfaces
is found in the same way, by one path for each crossing and way.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.jit import Divisor, concatenated, symbolic
from mitsuba_irrcache.core.sequences import hashed_seed, kronecker_points, random_stream
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.medium_probe import probe
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.crossings import (
    SurfaceCrossings,
    SurfaceVoxels,
    voxel_at,
)
from mitsuba_irrcache.solvers.discrete_ordinates.cut_voxel_light import CutVoxelLight
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import BoundarySource, TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks
from mitsuba_irrcache.transport.path import Media, trace_to_infinity, unobstructed
from mitsuba_irrcache.transport.path_tracer import PathStart, PathTracer

#: Approximate maximum number of cells of an ordinate, for paths (one per cell), and for ordinates
#: along which only the visibility of emitters is tested, which is cheaper. Radiance from surfaces
#: varies more between ordinates than between neighbouring tracks, unless walls in the medium
#: separate these. Then every track has its own path on grids of up to about 140^3 voxels; on
#: larger ones 2 x 2 tracks share one, to limit the memory.
PATH_CELLS, EMITTER_CELLS, SEPARATED_CELLS = 1 << 11, 1 << 16, 1 << 15
#: Total number of cells of ordinates of the second kind, at most: if there are many of these, each
#: matters less.
MOST_EMITTER_CELLS = 1 << 20
#: Paths begin at this distance inside the box [voxels]: surfaces may lie on its faces.
INSET = 1e-3
#: Offset of the random streams of paths from surfaces among the voxels.
CROSSING_STREAM = 0x5F00
#: Number of positions in the medium from which the visibility of the environment is tested.
VISIBILITY_POINTS = 32
#: Smallest number of rows of the table of ordinates, a power of two.
FEWEST_ROWS = 1024
#: Parameters of an ordinate that the kernel reads, see `IncomingRadiance._parameters`.
_INTEGERS = ("first", "width", "axis", "axis_b")
_REALS = (
    "x", "y", "z", "slope_b", "slope_c", "lowest_b", "lowest_c", "size_b", "size_c", "slices",
    "edge", "weight",
)  # fmt: skip


class SurfaceBoundary:
    """The surroundings of a medium, from which radiance enters it.

    ``area_emitters`` are the emitters that tracks hit by chance; radiance that comes straight from
    other emitters is sampled from the voxels instead. ``rr_depth`` applies to paths.
    ``angular_basis`` is None for isotropic scattering. ``surfaces`` are the voxels near surfaces,
    None without any. ``within`` are other media, which lie in the box of ``medium`` and are part of
    the solution there.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        area_emitters: Sequence[mi.EmitterPtr],
        rr_depth: int,
        angular_basis: AngularBasis | None = None,
        surfaces: SurfaceVoxels | None = None,
        within: Sequence[MediumGrid] = (),
    ) -> None:
        self.surfaces = surfaces
        self.scene, self.medium, self.media = scene, medium, Media.around(medium)
        self.pointer, self.area_emitters = medium.pointer, list(area_emitters)
        self._solved = [medium.pointer, *(other.pointer for other in within)]
        #: the other media; ``medium`` is convex, so a straight ray that leaves it never returns.
        #: Rays through transmitting surfaces among the voxels continue in it.
        self.other_media = self.media.without(medium)
        self.angular_basis = angular_basis
        #: whether radiance is refracted when it enters the medium, and reflected inside
        self.refracts = medium.refracts
        #: light of emitters in closed form in cut voxels; None without any
        self.cut_voxel_light: CutVoxelLight | None = None
        #: whether tracks carry refracted radiance of emitters; otherwise see `refracted_light`
        self.carries_refracted = True
        self._depths = dr.opaque(mi.UInt32, 0xFFFFFFFF), dr.opaque(mi.UInt32, rr_depth)

    @property
    def has_sources(self) -> bool:
        """Whether tracks may hit emitters or emissive media by chance."""
        return bool(self.area_emitters) or self.other_media.is_emissive

    @property
    def paths(self) -> PathTracer:
        """Tracer of paths in the current scene that end at their first collision in a medium of the
        solution.
        """
        return PathTracer(self.scene, self.media, *self._depths, is_cached=self._is_solved)

    def _is_solved(self, pointer: mi.MediumPtr) -> mi.Bool:
        found = mi.Bool(False)
        for own in self._solved:
            found |= pointer == own
        return found

    def visible_share(self, tracks: Tracks, towards: np.ndarray) -> np.ndarray:
        """Return, for each of the directions ``towards`` (n, 3) the environment, the share (n) of
        the box of ``tracks`` from which no surface occludes it.
        """
        places = tracks.lower + tracks.size * kronecker_points(np.arange(VISIBILITY_POINTS), 3).T
        p = tracks.grid.world.point(mi.Point3f(np.float32(places.T)))
        p = mi.Point3f(p + dr.zeros(mi.Float, VISIBILITY_POINTS))
        way, place = Divisor(VISIBILITY_POINTS).split(
            dr.arange(mi.UInt32, len(towards) * VISIBILITY_POINTS)
        )
        direction = dr.gather(mi.Vector3f, mi.Vector3f(np.float32(towards.T)), way)
        ray = mi.Ray3f(dr.gather(mi.Point3f, p, place), direction)
        clear = unobstructed(self.scene, ray, mi.Bool(True))
        count = dr.block_sum(dr.select(clear, mi.Float(1), 0), VISIBILITY_POINTS)
        return np.array(count, dtype=np.float64) / VISIBILITY_POINTS

    def crossings(self, tracks: Tracks, ordinates: Ordinates) -> SurfaceCrossings | None:
        """Return the crossings of tracks along ``ordinates`` with surfaces among the voxels."""
        if self.surfaces is None:
            return None
        geometry = tracks.table(*ordinates).geometry
        return SurfaceCrossings(self.surfaces, tracks.lower, geometry)


class IncomingRadiance:
    """Incoming radiance along ``tracks`` in the directions of ``ordinates``.

    Radiance from surfaces enters only along ordinates with a non-zero weight; without ``paths``,
    only radiance that comes straight from emitters enters. All values are radiance times solid
    angle (irradiance).
    """

    def __init__(
        self,
        boundary: SurfaceBoundary,
        tracks: Tracks,
        ordinates: Ordinates,
        paths: bool,
        seed: tuple[int, int, int],
    ) -> None:
        directions, incoming, weights, offsets = ordinates
        self.tracks = tracks
        parts = [incoming]
        if boundary.angular_basis is not None:
            parts = boundary.angular_basis.split_by_source(directions, incoming)
        #: ordinates along which radiance may come straight from emitters; with an angular basis
        #: first from all but narrow sources, then from each of these
        self.has_emitters = [part.any(axis=(1, 2)) for part in parts]
        self.has_emitters[0] |= (weights > 0) & boundary.has_sources
        self._geometry = tracks.table(directions, incoming[..., 0], weights, offsets).geometry
        is_divided = boundary.surfaces is not None and boundary.surfaces.meet_faces
        path_cells = SEPARATED_CELLS if is_divided else PATH_CELLS
        emitter_cells = MOST_EMITTER_CELLS // max((weights == 0).sum(), 1)
        emitter_cells = np.clip(emitter_cells, path_cells, EMITTER_CELLS)
        self._lay_out_cells(np.where(weights > 0, path_cells, emitter_cells))
        #: where tracks cross surfaces among the voxels
        self.crossings = boundary.crossings(tracks, ordinates)
        parameters = self._parameters(directions, parts, weights)
        found = _trace_cells(boundary, self, *parameters, paths, seed)
        #: Per channel: ``unscattered``, straight from emitters, for each part of `has_emitters`;
        #: ``emitted``, all that does not depend on phi; ``reflected``, factors of phi. The voxels
        #: of phi, and the directions in which radiance leaves them (None if isotropic).
        self.unscattered, self.emitted, self.reflected, self.voxel, self._direction = found
        if boundary.refracts and not _any_positive(self.unscattered):
            self.has_emitters = [np.zeros_like(each) for each in self.has_emitters]
        self._voxels: dict[tuple, mi.UInt32] = {tracks.grid.shape: self.voxel}

    @property
    def spectra(self) -> list[list]:
        """All computed spectra, each a list of channels."""
        return [*self.unscattered, self.emitted, self.reflected]

    def emitter_source(
        self, channels: Sequence[int], table: TrackTable, numbers: np.ndarray, part: int = 0
    ) -> BoundarySource:
        """Return the boundary source of radiance straight from emitters.

        ``part`` is an index of `has_emitters`; ``table`` has the same tracks, for the ordinates
        with the indices ``numbers``.
        """
        values = concatenated([self.unscattered[part][c] for c in channels])
        cells = self._cells_of(self.tracks, table, numbers)
        if self.crossings is not None:
            table.crossings = self.crossings.of_table(numbers)
        return BoundarySource(*cells, values, len(channels), self._first_crossing)

    @property
    def _first_crossing(self) -> int | None:
        """Index of the value of the first crossing."""
        return None if self.crossings is None else self._count

    def reflected_source(
        self,
        channels: Sequence[int],
        level: MultigridLevel,
        table: TrackTable,
        numbers: np.ndarray,
        emitted: bool,
    ) -> ReflectedBoundarySource:
        """Return the boundary source of all radiance, with or without the ``emitted`` part.

        ``table`` has the tracks of ``level``, the same ones or those of a coarser grid, for the
        ordinates with the consecutive indices ``numbers``.
        """
        tracks, grid = level.tracks, level.grid
        if grid.shape not in self._voxels:
            self._voxels[grid.shape] = _coarse_voxels(self.tracks.grid, grid, self.voxel)
        transforms, cells = self._cells_of(tracks, table, numbers)
        start, count = int(cells[0, 0]), int(self._ends[numbers[-1]] - cells[0, 0])
        cells[:, 0] -= start
        here = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
        first_crossing = None
        if self.crossings is not None and tracks.surfaces is not None:
            # Coarser levels, which only correct the solution, do without surfaces among the voxels.
            table.crossings = self.crossings.of_table(numbers)
            begin, end = (int(2 * self.crossings.starts[n]) for n in (numbers[0], numbers[-1] + 1))
            first_crossing = count - begin
            if end > begin:  # some sets of tracks meet no surface
                own = dr.arange(mi.UInt32, end - begin) + dr.opaque(mi.UInt32, self._count + begin)
                here = concatenated([here, own])
        values = [
            concatenated([dr.gather(mi.Float, kind[c], here) for c in channels])
            for kind in (self.reflected, *([self.emitted] if emitted else []))
        ]
        # All extinction is in active voxels: no radiance is scattered in others.
        at = tracks.active_index(dr.gather(mi.UInt32, self._voxels[grid.shape], here))
        first = dr.minimum(at, dr.opaque(mi.UInt32, tracks.active_count - 1)) * len(channels)
        dr.eval(first)
        indices = concatenated([first + c for c in range(len(channels))])
        direction = None
        if self._direction is not None:
            own = (dr.gather(mi.Float, x, here) for x in self._direction)
            direction = mi.Vector3f(*(concatenated([x] * len(channels)) for x in own))
        dr.eval(values, indices, direction)
        return ReflectedBoundarySource(
            level, len(channels), (transforms, cells, first_crossing), indices, direction, *values
        )

    def sample_rays(
        self, parameters: tuple[mi.UInt32, mi.Float], seed: tuple[int, int, int]
    ) -> tuple[mi.UInt32, mi.Float, mi.Bool, mi.Ray3f, mi.PCG32]:
        """Sample a track of each cell, for both ways.

        Returns the index of the way (two for each ordinate), the ordinate weight, whether the track
        intersects the box, the ray from its entry point against the direction of propagation, and
        the random number generator.
        """
        lanes = dr.arange(mi.UInt32, self._count)
        ordinate, read = self._read(parameters, lanes)
        within = lanes - read.first
        back, cell = (within & 1) == 1, within >> 1
        cell_c = cell // dr.maximum(read.width, 1)
        cell_b = cell - cell_c * read.width
        *batch, use = seed
        stream = hashed_seed(batch)[0] + dr.opaque(mi.UInt32, use)
        rng = random_stream(mi.sample_tea_32(lanes, stream))
        b, c, near, far, rng = _sample_track(read, mi.Float(cell_b), mi.Float(cell_c), rng)
        hit = near < far
        a = dr.select(back, far, near)
        b, c = dr.fma(a - 0.5, read.slope_b, b), dr.fma(a - 0.5, read.slope_c, c)
        sizes = read.slices, read.size_b, read.size_c
        a, b, c = (dr.clip(x, INSET, n - INSET) for x, n in zip((a, b, c), sizes, strict=True))
        place = [
            dr.select(read.axis == k, a, dr.select(read.axis_b == k, b, c))
            + dr.opaque(mi.Float, float(low))
            for k, low in enumerate(self.tracks.lower)
        ]
        p = self.tracks.grid.world.point(mi.Point3f(place))
        ray = mi.Ray3f(p, mi.Vector3f(read.x, read.y, read.z) * dr.select(back, 1, -1))
        return ordinate * 2 + dr.select(back, 1, 0), read.weight, hit, ray, rng

    def _lay_out_cells(self, most: np.ndarray) -> None:
        """Divide the tracks of each ordinate into square cells, at most about ``most`` of them."""
        geometry = self._geometry
        length = geometry.sizes[:, 2:]
        # The first slice passes the middle of the first voxels.
        moved = np.stack([-0.5 * geometry.slopes, (length - 0.5) * geometry.slopes])
        self._lowest = np.floor(-geometry.starts - moved.max(axis=0))
        last = np.ceil(geometry.sizes[:, :2] - geometry.starts - moved.min(axis=0))
        count = last - self._lowest + 1
        self._edge = np.maximum(1, np.ceil(np.sqrt(count.prod(axis=1) / most)))
        self._sides = np.ceil(count / self._edge[:, None]).astype(np.int64)
        self._ends = np.cumsum(2 * self._sides.prod(axis=1))
        self._first, self._count = np.concatenate([[0], self._ends[:-1]]), int(self._ends[-1])

    def _parameters(
        self, directions: np.ndarray, parts: list[np.ndarray], weights: np.ndarray
    ) -> tuple[tuple[mi.UInt32, mi.Float], list[mi.Float]]:
        """Return the parameters of each ordinate for `sample_rays`, and the ``parts`` of the
        irradiance from distant emitters for both ways.

        The parameters are `_INTEGERS` (index of the first value, cells along b, axes) and `_REALS`
        (direction along the axis, slopes, first track, size of the box, tracks along the edge of a
        cell, ordinate weight).
        """
        geometry = self._geometry
        axes = [geometry.axis, geometry.transverse[:, 0]]
        integers = np.column_stack([self._first, self._sides[:, 0], *axes])
        sign = np.where(geometry.forward, 1.0, -1.0)
        columns = [sign[:, None] * directions, geometry.slopes, geometry.starts + self._lowest]
        reals = np.column_stack([*columns, geometry.sizes, self._edge, weights])
        forward = geometry.forward[:, None, None]
        ways = [np.where(forward, part, part[:, ::-1]).ravel().tolist() for part in parts]
        # Rows that `_read` never finds.
        rest = (_searched_rows(len(integers)) - len(integers)) * len(_INTEGERS)
        as_list = mi.UInt32([*integers.ravel().tolist(), *[0xFFFFFFFF] * rest])
        return (as_list, mi.Float(reals.ravel().tolist())), [mi.Float(way) for way in ways]

    def _read(
        self, parameters: tuple[mi.UInt32, mi.Float], lanes: mi.UInt32
    ) -> tuple[mi.UInt32, SimpleNamespace]:
        """Return the index of the ordinate of each lane, and its parameters by name."""
        integers, reals = parameters
        ordinate = dr.binary_search(
            0,
            _searched_rows(len(self._first)) - 1,
            lambda i: dr.gather(mi.UInt32, integers, (i + 1) * len(_INTEGERS)) <= lanes,
        )
        first, begin = ordinate * len(_INTEGERS), ordinate * len(_REALS)
        read = {n: dr.gather(mi.UInt32, integers, first + i) for i, n in enumerate(_INTEGERS)}
        read |= {n: dr.gather(mi.Float, reals, begin + i) for i, n in enumerate(_REALS)}
        return ordinate, SimpleNamespace(**read)

    def _cells_of(
        self, tracks: Tracks, table: TrackTable, numbers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the arguments ``transforms`` and ``cells`` of `BoundarySource`."""
        mine, geometry = self.tracks, table.geometry
        ratio = float(round((tracks.grid.voxel_size / mine.grid.voxel_size)[0]))
        lower, across, n = mine.lower, geometry.transverse, np.arange(len(numbers))
        # Coordinate 0 in the first slice of the finest grid, seen from the coarser one.
        ahead = (lower[geometry.axis] + 0.5) / ratio - tracks.lower[geometry.axis] - 0.5
        shifts = ratio * (tracks.lower[across] + geometry.slopes * ahead[n, None]) - lower[across]
        shifts = shifts - self._geometry.starts[numbers] - self._lowest[numbers] + 0.5
        edge = self._edge[numbers, None]
        transforms = np.hstack([ratio / edge, shifts / edge, geometry.slopes])
        return transforms, np.column_stack([self._first[numbers], self._sides[numbers]])


class ReflectedBoundarySource(BoundarySource):
    """A boundary source ``emitted + reflected phi(index)``.

    For anisotropic scattering, phi(index) stands for the radiance scattered into ``direction``.
    """

    def __init__(
        self,
        level: MultigridLevel,
        channels: int,
        cells: tuple[np.ndarray, np.ndarray, int | None],
        index: mi.UInt32,
        direction: mi.Vector3f | None,
        reflected: mi.Float,
        emitted: mi.Float | None = None,
    ) -> None:
        transforms, cells, first_crossing = cells
        super().__init__(transforms, cells, None, channels, first_crossing)
        self._level, self._index, self._direction = level, index, direction
        self._reflected, self._emitted = reflected, emitted

    def update(self, phi: mi.Float | None) -> None:
        """Set the values for a mean irradiance of collisions ``phi`` (None: 0)."""
        # docs/primer, eq. (4.15)
        values = dr.zeros(mi.Float, dr.width(self._index))
        if phi is not None:
            radiance = self._level.scattered_radiance(phi, self._index, self._direction)
            values = self._reflected * radiance
        self.values = values if self._emitted is None else values + self._emitted
        dr.eval(self.values)


@symbolic
def _sample_track(read, cell_b, cell_c, rng):
    """Sample one of the tracks of a cell that intersect the box, uniformly (reservoir sampling).

    Returns its coordinates b and c in the first slice, the coordinates along the axis where it
    enters and leaves the box (entry >= exit: no track intersects it), and the generator.
    """
    b, c = mi.Float(0), mi.Float(0)
    near, far = mi.Float(1) + 0 * read.slices, 0 * read.slices
    k, found = mi.Float(0), mi.Float(0)
    while dr.hint(k < read.edge * read.edge, label="tracks of a cell"):
        row = dr.floor(k / read.edge)
        at_b = read.lowest_b + cell_b * read.edge + (k - row * read.edge)
        at_c = read.lowest_c + cell_c * read.edge + row
        begin, end = mi.Float(0), mi.Float(read.slices)
        begin, end = _clipped(begin, end, at_b, read.slope_b, read.size_b)
        begin, end = _clipped(begin, end, at_c, read.slope_c, read.size_c)
        meets = begin < end
        found += dr.select(meets, 1.0, 0.0)
        chosen = meets & (rng.next_float32() * found < 1)
        b, c = dr.select(chosen, at_b, b), dr.select(chosen, at_c, c)
        near, far = dr.select(chosen, begin, near), dr.select(chosen, end, far)
        k += 1
    return b, c, near, far, rng


def _clipped(begin, end, at, slope, size) -> tuple[mi.Float, mi.Float]:
    """Clip the interval of a track to two opposite sides of the box."""
    first, last = -at / slope + 0.5, (size - at) / slope + 0.5
    begin = dr.maximum(begin, dr.minimum(first, last))
    return begin, dr.minimum(end, dr.maximum(first, last))


def _coarse_voxels(fine: Grid, coarse: Grid, voxel: mi.UInt32) -> mi.UInt32:
    """Return the voxels of a coarser grid of the hierarchy that contain voxels of the fine one."""
    ratio = Divisor(round((coarse.voxel_size / fine.voxel_size)[0]))
    result = coarse.index(*(ratio.split(place)[0] for place in fine.voxel_indices(voxel)))
    dr.eval(result)
    return result


def _searched_rows(ordinates: int) -> int:
    """Return the number of rows of the table of ordinates that a binary search covers, more than
    there are ordinates.

    Kernels contain one step for each factor of two: most numbers of ordinates share a kernel.
    """
    return max(FEWEST_ROWS, 1 << ordinates.bit_length())


def _any_positive(spectra: list[list]) -> bool:
    """Return whether any value of any spectrum is positive."""
    largest = [dr.max(channel) for spectrum in spectra for channel in spectrum]
    dr.eval(largest)
    return any(each[0] > 0 for each in largest)


def _trace_cells(
    boundary: SurfaceBoundary,
    incoming: IncomingRadiance,
    parameters: tuple[mi.UInt32, mi.Float],
    distant: list[mi.Float],
    paths: bool,
    seed: tuple[int, int, int],
) -> tuple[list, list, list, mi.UInt32, mi.Vector3f | None]:
    """Trace the incoming radiance along the tracks of all cells, then of all crossings, both ways
    in turn; see `IncomingRadiance` for the result.
    """
    way, weight, hit, ray, rng = incoming.sample_rays(parameters, seed)
    pointer = probe(boundary.scene, ray.o, ray.d)
    rays = way, weight, hit, ray, rng, pointer
    found = _trace(boundary, incoming, rays, distant, paths)
    if incoming.crossings is not None and incoming.crossings.count:
        rays = _crossing_rays(boundary, incoming.crossings, parameters, seed)
        at_crossings = _trace(boundary, incoming, rays, distant, paths)
        if paths and boundary.cut_voxel_light is not None:
            at_crossings = _with_hidden_parts(boundary, incoming.crossings, rays, at_crossings)
        found = _joined(found, at_crossings)
    return found


def _with_hidden_parts(
    boundary: SurfaceBoundary, crossings: SurfaceCrossings, rays: tuple, found: tuple
) -> tuple:
    """Add to the result of `_trace` for ``crossings`` the radiance that is scattered once on the
    other side of cut voxels, see `CutVoxelLight`.
    """
    weight, rng = rays[1], rays[4]
    radiance = boundary.cut_voxel_light.along_hidden_parts(crossings, mi.PCG32(rng))
    unscattered, emitted, *rest = found
    emitted = [e + weight * r for e, r in zip(emitted, radiance, strict=True)]
    dr.eval(emitted)
    return unscattered, emitted, *rest


def _crossing_rays(
    boundary: SurfaceBoundary,
    crossings: SurfaceCrossings,
    parameters: tuple[mi.UInt32, mi.Float],
    seed: tuple[int, int, int],
) -> tuple[mi.UInt32, mi.Float, mi.Bool, mi.Ray3f, mi.PCG32, mi.MediumPtr]:
    """Return the ``rays`` of `_trace` for tracks that leave surfaces among the voxels."""
    way, hit, ray = crossings.rays()
    weight = dr.gather(mi.Float, parameters[1], (way >> 1) * len(_REALS) + _REALS.index("weight"))
    *batch, use = seed
    stream = hashed_seed(batch)[0] + dr.opaque(mi.UInt32, use + CROSSING_STREAM)
    lanes = dr.arange(mi.UInt32, dr.width(way))
    rng = random_stream(mi.sample_tea_32(lanes, stream))
    pointer = dr.zeros(mi.MediumPtr, dr.width(way))
    pointer = dr.select(True, boundary.pointer, pointer)
    return way, weight, hit, ray, rng, pointer


def _joined(first: tuple, second: tuple) -> tuple:
    """Concatenate the results of `_trace` for two sets of rays."""
    unscattered, emitted, reflected, voxel, direction = (
        zip(a, b, strict=True) if isinstance(a, list) else (a, b)
        for a, b in zip(first, second, strict=True)
    )
    unscattered = [
        [concatenated(pair) for pair in zip(*parts, strict=True)] for parts in unscattered
    ]
    emitted, reflected = ([concatenated(p) for p in pairs] for pairs in (emitted, reflected))
    if direction[0] is not None:
        direction = mi.Vector3f(*(concatenated([a, b]) for a, b in zip(*direction, strict=True)))
    else:
        direction = None
    return unscattered, emitted, reflected, concatenated(voxel), direction


def _trace(
    boundary: SurfaceBoundary,
    incoming: IncomingRadiance,
    rays: tuple,
    distant: list[mi.Float],
    paths: bool,
) -> tuple[list, list, list, mi.UInt32, mi.Vector3f | None]:
    """Trace the incoming radiance along ``rays``.

    ``rays`` are a tuple of way indices, ordinate weights, hit masks, rays, random generators, and
    media. See `IncomingRadiance` for the result.
    """
    if not boundary.refracts:
        return _trace_all(boundary, incoming, rays, distant, paths)
    # Skip rays that begin outside of the glass: no radiance enters there without refraction.
    _, _, hit, ray, *_ = rays
    index = dr.compress(hit & boundary.medium.contains(ray.o))
    if not dr.width(index):
        index = mi.UInt32(0)
    rays = tuple(dr.gather(type(each), each, index) for each in rays)
    return _expanded(_trace_all(boundary, incoming, rays, distant, paths), index, dr.width(hit))


def _expanded(found: object, index: mi.UInt32, count: int) -> object:
    """Return arrays of width ``count`` with the values of ``found`` at ``index``, 0 elsewhere.

    ``found`` is an array or nested lists and tuples of arrays.
    """
    if found is None:
        return None
    if isinstance(found, (list, tuple)):
        return type(found)(_expanded(each, index, count) for each in found)
    result = dr.zeros(type(found), count)
    dr.scatter(result, found, index)
    dr.eval(result)
    return result


def _trace_all(
    boundary: SurfaceBoundary,
    incoming: IncomingRadiance,
    rays: tuple,
    distant: list[mi.Float],
    paths: bool,
) -> tuple[list, list, list, mi.UInt32, mi.Vector3f | None]:
    """Trace as `_trace`, without skipping rays."""
    way, weight, hit, ray, rng, pointer = rays
    parts = [dr.gather(mi.Spectrum, each, way) for each in distant]
    visible = hit & (dr.max(sum(parts)) > 0)
    if boundary.has_sources:
        visible |= hit & (weight > 0)
    # The medium up to the first surface is part of the track.
    media = boundary.other_media if boundary.surfaces is None else boundary.media
    emitters, clear = boundary.area_emitters, pointer == boundary.pointer
    transmittance, radiance, rng = trace_to_infinity(
        boundary.scene, media, ray, pointer, emitters, rng, visible, clear
    )
    parts = [irradiance * transmittance for irradiance in parts]
    parts[0] += weight * radiance
    unscattered = [dr.select(visible, irradiance, 0) for irradiance in parts]
    emitted, reflected, voxel = sum(unscattered), mi.Spectrum(0), mi.UInt32(0)
    direction = mi.Vector3f(0, 0, 1)
    if paths:
        begin = PathStart(ray, pointer, depth=1, pdf=0.0, clear=pointer == boundary.pointer)
        sums, _ = boundary.paths.trace(begin, rng, hit & (weight > 0))
        end = sums.end
        if boundary.carries_refracted:
            emitted = emitted + weight * sums.scattered
        direction = end.direction
        reflected = weight * end.weight * dr.inv_four_pi
        if boundary.surfaces is None:
            voxel = voxel_at(incoming.tracks.grid, end.p)
        else:
            collides = dr.max(end.weight) > 0
            voxel, known = boundary.surfaces.nearest(end.p, collides)
            reflected = dr.select(known, reflected, 0)
            if boundary.cut_voxel_light is not None:
                own = voxel_at(incoming.tracks.grid, end.p)
                collides &= boundary.surfaces.is_cut_at(own)
                more = boundary.cut_voxel_light.scattered_radiance(end.p, voxel, collides)
                emitted = emitted + weight * end.weight * more
    none = dr.zeros(mi.Float, dr.width(weight))
    unscattered = [[v + none for v in part] for part in unscattered]
    emitted, reflected = ([v + none for v in spectrum] for spectrum in (emitted, reflected))
    voxel = voxel + dr.zeros(mi.UInt32, dr.width(weight))
    direction = None if boundary.angular_basis is None else direction + none
    dr.eval(unscattered, emitted, reflected, voxel, direction)
    return unscattered, emitted, reflected, voxel, direction
