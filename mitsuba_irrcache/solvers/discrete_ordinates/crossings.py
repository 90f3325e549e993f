"""Surfaces among the voxels: intersections of the tracks of ordinates with them.

In every slice each voxel has exactly one track of an ordinate (`tracks`), so the segment of a track
in a voxel is identified by the ordinate and the voxel. For all voxels near surfaces and all
ordinates, these segments are intersected with the scene once, before the sweeps. A track that
crosses surfaces between the positions ``first`` and ``last`` of a segment ends at ``first`` and
restarts at ``last``, with the radiance that leaves the surface there (`boundary_condition`).

The value of a voxel that a surface cuts is that on the side of its centre: only parts of segments
from which the centre is visible are tallied (eq. (4.16) of docs/primer).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import concatenated, symbolic
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import marked
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.occluders import (
    first_surface,
    has_one_sided_shapes,
    rays_through_faces,
)
from mitsuba_irrcache.solvers.discrete_ordinates.layout import block_and_index
from mitsuba_irrcache.solvers.discrete_ordinates.track_record import FIXED_POINT_ONE
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import (
    NO_VOXEL,
    TrackCrossings,
    TrackGeometry,
)
from mitsuba_irrcache.transport.path import MOST_CROSSINGS, is_solid

#: Rays along each edge of a voxel's face that detect surfaces in it.
RAYS_PER_EDGE = 6
#: Segments end at this distance inside the box [slices]: surfaces on its faces are part of the
#: boundary condition.
INSET = 1e-3
#: Overlap of consecutive segments [slices], so that no surface is missed between them.
OVERLAP = 1e-4
#: Maximum number of segments that are intersected in one launch.
LANES = 1 << 22
#: Position outside of every segment [slices from its middle].
BEYOND = 2.0


class SurfaceVoxels:
    """The voxels near surfaces, in the box of ``grid`` between ``lower`` and ``upper`` (x, y, z).

    ``medium`` is given if its boundary refracts, with the ``active`` voxels. Voxels that this
    boundary cuts then represent the medium only, even if their centres are outside of it.

    Attributes:
        voxels: flat indices of the voxels that surfaces cut and of their neighbours, ascending.
        number: for each voxel of the grid, 1 + its index in ``voxels``; 0 if it is not among them.
        is_cut: for each voxel of the grid, whether a surface cuts it.
        meet_faces: whether surfaces cut voxels at the faces of the box.
    """

    def __init__(
        self,
        scene: mi.Scene,
        grid: Grid,
        lower: np.ndarray,
        upper: np.ndarray,
        medium: MediumGrid | None = None,
        active: mi.UInt32 | None = None,
    ) -> None:
        self.scene, self.grid, self.lower, self.upper = scene, grid, lower, upper
        self.medium = medium
        marks, both_ways = dr.zeros(mi.UInt32, grid.voxel_count), has_one_sided_shapes(scene)
        for axis in range(3):
            start, stop = rays_through_faces(grid, lower, upper, axis, RAYS_PER_EDGE)
            _mark_hits(scene, grid, start, stop, marks)
            if both_ways:
                _mark_hits(scene, grid, stop, start, marks)
            dr.eval(marks)
        self.is_cut = self._within(marks > 0)
        dr.eval(self.is_cut)
        self.meet_faces = bool(dr.any(self.is_cut & ~self._within(True, inset=1))[0])
        #: mask of the voxels of the medium whose centres are outside of its boundary
        self._beyond = mi.Bool(False)
        if medium is not None:
            centre = grid.centers(dr.arange(mi.UInt32, grid.voxel_count))
            self._beyond = self.is_cut & marked(grid, active) & ~medium.contains(centre)
            dr.eval(self._beyond)
        self.voxels = dr.compress(self._within(_dilated(grid, self.is_cut)))
        self.count = dr.width(self.voxels)
        self.number = dr.zeros(mi.UInt32, grid.voxel_count)
        if self.count:
            dr.scatter(self.number, dr.arange(mi.UInt32, self.count) + 1, self.voxels)
        dr.eval(self.number)

    def is_cut_at(self, voxel: mi.UInt32) -> mi.Bool:
        """Return whether surfaces cut these voxels of the grid."""
        return dr.gather(mi.Bool, self.is_cut, voxel)

    def is_beyond(self, voxel: mi.UInt32, active: mi.Bool = True) -> mi.Bool:
        """Return whether these are voxels of a medium whose centres are outside of its boundary."""
        if self.medium is None:
            return mi.Bool(False)
        return dr.gather(mi.Bool, self._beyond, voxel, active)

    def hidden(
        self, voxel: mi.UInt32, centre: mi.Point3f, p: mi.Point3f, active: mi.Bool
    ) -> tuple[mi.Bool, mi.Normal3f]:
        """Return whether world positions lie on another side of surfaces than the ``centre`` of
        their ``voxel``, and the normal of the surface between them.
        """
        _, normal, hidden = first_surface(self.scene, centre, p, active)
        if self.medium is not None:
            hidden = dr.select(self.is_beyond(voxel), ~self.medium.contains(p), hidden)
        return hidden, normal

    @symbolic
    def nearest(self, p: mi.Point3f, active: mi.Bool):
        """Return the voxel whose value applies at world positions.

        It is the voxel that contains the position or, if a surface cuts that, the nearest of it and
        its neighbours whose centre is on the same side of surfaces. Also returns whether there is
        one: not in gaps between surfaces that contain no centre.
        """
        u = self.grid.coordinates.point(p)
        own = voxel_at(self.grid, p)
        voxel = mi.UInt32(own)
        active = mi.Bool(active) & dr.gather(mi.Bool, self.is_cut, own, active)
        active &= ~self.is_beyond(own, active)
        best, k = mi.Float(dr.inf), mi.UInt32(0)
        while dr.hint(active & (k < 27), label="nearest voxel"):
            at, there = _neighbour(self.grid, u, k)
            distance = dr.squared_norm(at - u)
            *_, hidden = first_surface(
                self.scene, p, self.grid.world.point(at), active & (distance < best)
            )
            nearer = ~hidden & (distance < best)
            best, voxel = dr.select(nearer, distance, best), dr.select(nearer, there, voxel)
            k += 1
        return voxel, ~active | (best < dr.inf)

    def _within(self, marks: mi.Bool, inset: int = 0) -> mi.Bool:
        """Restrict marks of all voxels to those in the box, and ``inset`` voxels from its faces."""
        at = self.grid.voxel_indices(dr.arange(mi.UInt32, self.grid.voxel_count))
        for k, low, high in zip(at, self.lower, self.upper, strict=True):
            marks = marks & (k >= int(low) + inset) & (k + inset < int(high))
        return marks


class SurfaceCrossings:
    """Crossings of the tracks of n ordinates with surfaces; ``geometry`` is that of the tracks.

    ``records`` has four values per crossing: the positions ``first`` and ``last`` along the
    dominant axis, in slices from the middle of the segment, and whether the centre of the voxel is
    visible from the parts before ``first`` and behind ``last``. ``first`` > ``last`` marks a
    segment that does not cross a surface but is separated from the centre by one. ``sources`` has
    two values per crossing, the voxels whose source applies to the two parts.
    """

    def __init__(self, surfaces: SurfaceVoxels, lower: np.ndarray, geometry: TrackGeometry) -> None:
        self.surfaces, self._lower = surfaces, lower
        ordinates = len(geometry.axis)
        self._parameters = _parameters(geometry)
        count = surfaces.count
        self.slots = dr.zeros(mi.UInt32, ordinates * count)
        records, sources, found_at, total = [], [], [], 0
        most = max(1, LANES // max(count, 1))
        #: index of the first crossing of each ordinate, and the number of all crossings
        self.starts = np.zeros(ordinates + 1, np.int64)
        for begin in range(0, ordinates, most):
            number, place = block_and_index(count, min(most, ordinates - begin))
            number += dr.opaque(mi.UInt32, begin)
            first, last, before, behind, *voxels = _intersect(self, number, place)
            wanted = (first <= last) | (before < 1)
            dr.eval(wanted, first, last, before, behind, voxels)
            index = dr.compress(wanted)
            width = dr.width(index)
            if not width:
                continue
            found = first, last, before, behind
            values = dr.ravel(mi.Vector4f(*(dr.gather(mi.Float, x, index) for x in found)))
            lane = index + dr.opaque(mi.UInt32, begin * count)
            slot = dr.arange(mi.UInt32, width) + dr.opaque(mi.UInt32, total)
            dr.scatter(self.slots, slot + 1, lane)
            dr.eval(values, lane, self.slots)
            sources.append(dr.ravel(mi.Vector2u(*(dr.gather(mi.UInt32, x, index) for x in voxels))))
            dr.eval(sources)
            records.append(values)
            found_at.append(lane)
            total += width
        self.count = total
        self._lanes = concatenated(found_at) if found_at else mi.UInt32()
        self.records = concatenated(records) if records else mi.Float([0, 0, 0, 0])
        self.sources = concatenated(sources) if sources else mi.UInt32([0, 0])
        if total:
            ordinate = np.array(self._lanes) // count
            self.starts[1:] = np.cumsum(np.bincount(ordinate, minlength=ordinates))

    def of_table(self, numbers: np.ndarray) -> TrackCrossings:
        """Return the crossings for a table of the same tracks, whose ordinates have the indices
        ``numbers`` here.
        """
        first = numbers * self.surfaces.count
        data = self.slots, self.records, self.sources
        return TrackCrossings(self.surfaces.number, first, *data)

    def rays(self) -> tuple[mi.UInt32, mi.Bool, mi.Ray3f]:
        """Return for each crossing, both ways in turn: the index of the way (two for each
        ordinate), whether radiance leaves a surface there, and the ray to the surface, against the
        direction of propagation.
        """
        lane = dr.arange(mi.UInt32, 2 * self.count)
        back, slot = (lane & 1) == 1, lane >> 1
        record = dr.gather(mi.Vector4f, self.records, slot)
        number, segment = self._segment(slot)
        origin = dr.select(back, segment.start, segment.end)
        direction = dr.select(back, 1.0, -1.0) * segment.direction
        return number * 2 + dr.select(back, 1, 0), record.x <= record.y, mi.Ray3f(origin, direction)

    def hidden_parts(self) -> tuple[mi.Point3f, mi.Point3f, mi.UInt32, mi.Bool, mi.Bool]:
        """Return for each crossing, both ways in turn, the part of the segment behind the surface,
        or all of it if it does not cross a surface: both ends in world space, the voxel whose
        source applies to it, whether it is behind a surface, and whether it is hidden from the
        centre of its voxel.
        """
        lane = dr.arange(mi.UInt32, 2 * self.count)
        back, slot = (lane & 1) == 1, lane >> 1
        _, segment = self._segment(slot)
        first, last, before, behind = dr.gather(mi.Vector4f, self.records, slot)
        voxels = dr.gather(mi.Vector2u, self.sources, slot)
        crosses = first <= last
        low, high = -dr.minimum(segment.back, 0.5), dr.minimum(segment.ahead, 0.5)
        # Tracks that enter through a side begin up to a slice before the middle.
        low = dr.select(~back, -segment.back, low)
        high = dr.select(back, segment.ahead, high)
        begin = dr.select(crosses & ~back, dr.maximum(last, low), low)
        end = dr.select(crosses & back, dr.minimum(first, high), high)
        is_before = back | ~crosses
        hidden = dr.select(is_before, before, behind) < 1
        voxel = dr.select(is_before, voxels.x, voxels.y)
        hidden &= voxel != NO_VOXEL
        voxel = dr.select(hidden, voxel, 0)
        end = dr.maximum(begin, end)
        return segment.at(begin), segment.at(end), voxel, crosses, hidden

    def _segment(self, slot: mi.UInt32) -> tuple[mi.UInt32, _Segment]:
        """Return the indices of the ordinates of crossings, and the segments."""
        at = dr.gather(mi.UInt32, self._lanes, slot)
        number = at // max(self.surfaces.count, 1)
        return number, _Segment(self, number, at - number * self.surfaces.count)


class _Segment:
    """Segments of tracks in voxels near surfaces, one per lane, given by the index ``number`` of
    the ordinate and the index ``place`` of the voxel in `SurfaceVoxels.voxels`.
    """

    def __init__(self, crossings: SurfaceCrossings, number: mi.UInt32, place: mi.UInt32) -> None:
        surfaces = crossings.surfaces
        integers, reals = crossings._parameters
        axis, axis_b, slope_b, slope_c, start_b, start_c, slices = (
            dr.gather(mi.Int32, integers, number * 7 + i) for i in range(7)
        )
        sizes = [dr.gather(mi.Float, reals, number * 2 + i) for i in range(2)]
        self.voxel = dr.gather(mi.UInt32, surfaces.voxels, place)
        at = [mi.Int32(i) for i in surfaces.grid.voxel_indices(self.voxel)]
        low = [dr.opaque(mi.Int32, int(n)) for n in crossings._lower]
        own = [i - n for i, n in zip(at, low, strict=True)]
        slice_ = dr.select(axis == 0, own[0], dr.select(axis == 1, own[1], own[2]))
        b = dr.select(axis_b == 0, own[0], own[1])
        c = dr.select(axis == 2, own[1], own[2])
        # The same integers as in the kernel: see `_TransverseMotion.advance`.
        middle, steps, ahead, back = [mi.Float(slice_) + 0.5], [mi.Float(1)], [], []
        for i, slope, start, size in (
            (b, slope_b, start_b, sizes[0]),
            (c, slope_c, start_c, sizes[1]),
        ):
            position = (start + slice_ * slope) & (FIXED_POINT_ONE - 1)
            x = dr.fma(mi.Float(position), 1 / FIXED_POINT_ONE, mi.Float(i))
            step = mi.Float(slope) * (1 / FIXED_POINT_ONE)
            low_end, high_end = x / dr.abs(step), (size - x) / dr.abs(step)
            ahead.append(dr.select(slope > 0, high_end, low_end))
            back.append(dr.select(slope > 0, low_end, high_end))
            middle.append(x)
            steps.append(step)

        def reach(sides: list[mi.Float], at_end: mi.Bool) -> mi.Float:
            # Tracks that entered since the middle of the previous slice begin where they did.
            side = dr.minimum(sides[0], sides[1])
            side = dr.select(at_end, dr.minimum(side, 0.5), side)
            return dr.select(at_end | (side < 1), side - INSET, 0.5 + OVERLAP)

        self.back = dr.maximum(reach(back, slice_ == 0), 0)
        self.ahead = dr.maximum(reach(ahead, slice_ == slices - 1), 0)
        order = [
            [
                dr.select(axis == 0, m[0], m[1]),
                dr.select(axis == 1, m[0], dr.select(axis == 0, m[1], m[2])),
                dr.select(axis == 2, m[0], m[2]),
            ]
            for m in (middle, steps)
        ]
        world = surfaces.grid.world
        lower = mi.Point3f(*(mi.Float(n) for n in low))
        self.middle = world.point(mi.Point3f(*order[0]) + lower)
        self.step = world.vector(mi.Vector3f(*order[1]))  # from slice to slice
        self.direction = dr.normalize(self.step)
        self.start, self.end = self.at(-self.back), self.at(self.ahead)
        self.centre = world.point(mi.Point3f(*at) + 0.5)

    def at(self, position: mi.Float) -> mi.Point3f:
        """Return the world position at a ``position`` [slices from the middle]."""
        return self.middle + self.step * position


def _intersect(crossings: SurfaceCrossings, number: mi.UInt32, place: mi.UInt32) -> tuple:
    """Intersect segments with surfaces; return records and sources as in `SurfaceCrossings`."""
    segment, scene = _Segment(crossings, number, place), crossings.surfaces.scene
    slice_length = dr.norm(segment.step)
    near, _, hit = first_surface(scene, segment.start, segment.end, mi.Bool(True))
    far, *_ = first_surface(scene, segment.end, segment.start, hit)
    first = dr.select(hit, near / slice_length - segment.back, BEYOND)
    last = dr.select(hit, segment.ahead - far / slice_length, -BEYOND)
    last = dr.select(hit, dr.maximum(first, last), last)
    # The middle of each part; without a crossing there is one, the whole segment.
    middle_before = dr.select(hit, 0.5 * (first - segment.back), 0)
    middle_behind = 0.5 * (last + segment.ahead)
    is_cut = dr.gather(mi.Bool, crossings.surfaces.is_cut, segment.voxel)
    before, source_before = _side(crossings, segment, middle_before, is_cut | hit)
    behind, source_behind = _side(crossings, segment, middle_behind, hit)
    return first, last, before, behind, source_before, source_behind


def _side(
    crossings: SurfaceCrossings, segment: _Segment, position: mi.Float, active: mi.Bool
) -> tuple[mi.Float, mi.UInt32]:
    """Return whether a position on a segment is on the same side of surfaces as the centre of its
    voxel (1 or 0), and the voxel whose source applies there.

    On the other side that is a neighbouring voxel, one voxel away from the surface, or the nearest
    one if another surface hides that, as at edges; none (`NO_VOXEL`) in gaps without any centre.
    """
    surfaces, p = crossings.surfaces, segment.at(position)
    hidden, normal = surfaces.hidden(segment.voxel, segment.centre, p, active)
    normal = dr.select(dr.dot(normal, p - segment.centre) > 0, normal, -normal)
    step = surfaces.grid.coordinates.vector(mi.Vector3f(normal))
    step /= dr.maximum(dr.max(dr.abs(step)), 1e-30)
    away = voxel_at(surfaces.grid, p + surfaces.grid.world.vector(step))
    *_, behind = first_surface(surfaces.scene, p, surfaces.grid.centers(away), hidden)
    nearest, known = surfaces.nearest(p, behind)
    away = dr.select(behind, dr.select(known, nearest, NO_VOXEL), away)
    return dr.select(hidden, mi.Float(0), 1), dr.select(hidden, away, segment.voxel)


def _parameters(geometry: TrackGeometry) -> tuple[mi.Int32, mi.Float]:
    """Return the integers (7 per ordinate) and reals (2 per ordinate) that `_Segment` reads."""
    fixed = [np.rint(x * FIXED_POINT_ONE) for x in (geometry.slopes, geometry.starts)]
    columns = [geometry.axis, geometry.transverse[:, 0], *fixed, geometry.sizes[:, 2]]
    integers = np.column_stack(columns).astype(np.int64)
    sizes = geometry.sizes[:, :2]
    return mi.Int32(integers.ravel().tolist()), mi.Float(sizes.ravel().tolist())


@symbolic
def _mark_hits(
    scene: mi.Scene,
    grid: Grid,
    start: mi.Point3f,
    stop: mi.Point3f,
    marks: mi.UInt32,
):
    """Mark the voxels in which rays between two ends hit surfaces that are not null boundaries."""
    length = dr.norm(stop - start)
    direction = (stop - start) / length
    ray, active, crossings = mi.Ray3f(start, direction), mi.Bool(True), mi.UInt32(0)
    ray.maxt = mi.Float(length)
    while dr.hint(active, label="surface voxels"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        solid = active & is_solid(si)
        dr.scatter(marks, mi.UInt32(1), voxel_at(grid, si.p), solid)
        ray = si.spawn_ray(direction)
        ray.maxt = dr.maximum(length - dr.norm(si.p - start), 0)
        crossings += 1
        active &= crossings < MOST_CROSSINGS


def _neighbour(grid: Grid, u: mi.Point3f, k: mi.UInt32) -> tuple[mi.Point3f, mi.UInt32]:
    """Return centre (voxel coordinates) and flat index of voxel ``k`` of the 27 around ``u``."""
    shifts = k % 3, (k // 3) % 3, k // 9
    at = [
        mi.Int32(dr.clip(dr.floor(v) + mi.Float(s) - 1, 0, mi.Float(n - 1)))
        for v, s, n in zip(u, shifts, grid.sides, strict=True)
    ]
    return mi.Point3f(*(mi.Float(i) + 0.5 for i in at)), grid.index(*at)


def voxel_at(grid: Grid, p: mi.Point3f) -> mi.UInt32:
    """Return the flat index of the voxel that contains a world position, or of the nearest one."""
    u = grid.coordinates.point(p)
    at = (
        mi.Int32(dr.clip(dr.floor(v), 0, mi.Float(n - 1)))
        for v, n in zip(u, grid.sides, strict=True)
    )
    return grid.index(*at)


def _dilated(grid: Grid, marks: mi.Bool) -> mi.Bool:
    """Return a mask of the marked voxels and their 26 neighbours."""
    values = dr.select(marks, mi.UInt32(1), 0)
    at = [mi.Int32(i) for i in grid.voxel_indices(dr.arange(mi.UInt32, grid.voxel_count))]
    for axis in range(3):
        dr.eval(values)
        total = mi.UInt32(values)
        for shift in (-1, 1):
            place = list(at)
            place[axis] = at[axis] + shift
            inside = (place[axis] >= 0) & (place[axis] < grid.sides[axis])
            total |= dr.gather(mi.UInt32, values, grid.index(*place), inside)
        values = total
    return values > 0
