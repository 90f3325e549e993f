"""Classification of the voxels of a cache by media and surfaces."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import fibonacci_direction, kronecker
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.cut_cells import CutCells
from mitsuba_irrcache.scene.medium_probe import probe
from mitsuba_irrcache.scene.occluders import first_surface, hole_in
from mitsuba_irrcache.transport.path import (
    MOST_CROSSINGS,
    Media,
    illuminates,
    is_null,
    refracts,
    transmits,
)

#: Number of rays from each voxel that determine its medium; number of samples of emitters that
#: determine whether it is directly illuminated.
RAYS, EMITTER_SAMPLES = 16, 8


class VoxelClasses(Immutable):
    """Position of the voxels of ``grid``, a cache's grid over ``medium``, relative to media and
    surfaces.

    Attributes:
        medium_number: per voxel, the number of the medium at its centre: 0 for none, 1 for the
            first of ``media``, and so on (see `Media.pointer_of`).
        readable: mask of the voxels that a lookup in ``medium`` can read: voxels that overlap the
            medium, and their neighbours.
        enclosed: mask of the voxels that lie within objects: from their centres only backs of
            surfaces are visible, and surfaces separate them from all that emitters illuminate.
        cut_cells: cells between voxel centres that surfaces intersect; None without any.
        separated: for x, y, z, a mask of the voxels that a surface separates from the next voxel
            along this axis; None if there are no cut cells.
        inside: mask of the voxels whose centres are in the medium, if its boundary refracts: values
            on both sides of it are unrelated, and lookups extrapolate from inside. None for other
            boundaries.
    """

    def __init__(
        self,
        scene: mi.Scene,
        media: Media,
        medium: MediumGrid,
        grid: Grid,
        by_centre: bool = False,
    ) -> None:
        """``by_centre`` states that values are those at voxel centres, not means over voxels."""
        self.grid = grid
        index = dr.arange(mi.UInt32, grid.voxel_count)
        box = np.zeros(3, int), grid.resolution
        # Rays can miss a boundary that nearly coincides with walls; its closed form cannot.
        exact = medium.has_exact_boundary and not medium.others
        exact = exact and hole_in(scene, medium, grid, box) is None
        glass = any(refracts(shape) for shape in scene.shapes())
        *votes, within, backs = _probed(scene, media, medium, grid, index, exact, glass)
        within, sees_backs = within > 0, backs == RAYS
        dr.eval(votes, within, sees_backs)
        best, number = mi.UInt32(0), mi.UInt32(0)
        for i, count in enumerate(votes):
            number = dr.select(count > best, i, number)
            best = dr.maximum(best, count)
        dr.eval(number)
        self.inside = None
        if medium.refracts:
            self.inside = number == medium.number + 1
            dr.eval(self.inside)
        cut_cells = CutCells(scene, grid, None if self.inside is None else medium.pointer)
        self.medium_number = number
        self.cut_cells = cut_cells if cut_cells.count else None
        self.separated = None
        if cut_cells.count:
            self.separated = tuple(_separated(scene, grid, axis) for axis in range(3))
        # Walls of a room may have normals that point outwards.
        self.enclosed = sees_backs
        if dr.any(sees_backs):
            self.enclosed &= _unreached(scene, grid)
            dr.eval(self.enclosed)
        total, _ = neighbourhood(grid, dr.select(within, mi.Float(1), 0), within)
        self.readable = within | (total > 0)
        if self.inside is not None:
            self.readable &= self.inside | (within & (not by_centre))
        dr.eval(self.readable)

    def filled(self, values: mi.Float, channels: int) -> mi.Float:
        """Return ``values`` with extrapolated ones in enclosed voxels and outside of glass.

        Zeros in enclosed voxels are replaced by the mean of their neighbours, and values outside of
        a refracting boundary are extrapolated from inside. Near curved surfaces, lookups read some
        of these voxels although `cut_cells` restricts them to one side.
        """
        if self.inside is not None:
            values = extended(self.grid, values, self.inside, channels)
        voxel = dr.arange(mi.UInt32, self.grid.voxel_count)
        positive = mi.Bool(False)
        for c in range(channels):
            positive |= dr.gather(mi.Float, values, voxel * channels + c) > 0
        known = positive | ~self.enclosed
        dr.eval(known)
        total, weights = neighbourhood(self.grid, values, known, channels)
        own = dr.gather(mi.Bool, known, dr.arange(mi.UInt32, dr.width(values)) // channels)
        own |= weights == 0
        result = dr.select(own, values, total / dr.select(own, 1, weights))
        dr.eval(result)
        return result


@symbolic
def _probed(
    scene: mi.Scene,
    media: Media,
    medium: MediumGrid,
    grid: Grid,
    index: mi.UInt32,
    exact: bool,
    glass: bool,
):
    """Count rays from each voxel by their results.

    Returns a list of counts per voxel: rays according to which the voxel's centre is in no medium,
    and in each medium in turn; random positions in the voxel that are in ``medium``; rays from the
    centre that hit the back of a surface first.

    ``exact`` states that a position is in the medium exactly if it is within its boundary, so that
    no rays are needed for this. ``glass`` states that there are transmissive shapes, whose backs
    do not count for positions in ``medium``.
    """
    corner = mi.Point3f(*grid.voxel_indices(index))
    votes = [mi.UInt32(0) for _ in range(len(media.grids) + 1)]
    within, backs = mi.UInt32(0), mi.UInt32(0)
    k, count = mi.UInt32(0), dr.opaque(mi.UInt32, RAYS)
    while dr.hint(k < count, label="voxel classes"):
        u, direction = kronecker(k, 3), fibonacci_direction(k, RAYS, azimuth=0.4)
        pointer = _medium_at(scene, medium, grid.world.point(corner + 0.5), direction, exact)
        is_medium = mi.Bool(False)
        if dr.hint(glass, mode="scalar"):
            there = probe(scene, grid.world.point(corner + 0.5), direction)
            is_medium = there == medium.pointer
        meets_back = _meets_back(scene, grid.world.point(corner + 0.5), direction, is_medium)
        backs += dr.select(meets_back, mi.UInt32(1), 0)
        votes[0] += dr.select(pointer == None, mi.UInt32(1), 0)  # noqa: E711
        for i in range(len(media.grids)):
            votes[i + 1] += dr.select(pointer == media.grids[i].pointer, mi.UInt32(1), 0)
        p = grid.world.point(corner + mi.Point3f(u))
        pointer = _medium_at(scene, medium, p, direction, exact)
        within += dr.select(pointer == medium.pointer, mi.UInt32(1), 0)
        k += 1
    return [*votes, within, backs]


def _medium_at(
    scene: mi.Scene, medium: MediumGrid, p: mi.Point3f, direction: mi.Vector3f, exact: bool
) -> mi.MediumPtr:
    """Return the medium at ``p``, with ``exact`` from the boundary of ``medium``, the only one."""
    if not exact:
        return probe(scene, p, direction)
    none = dr.zeros(mi.MediumPtr, dr.width(p))
    return dr.select(medium.contains(p), medium.pointer, none)


@symbolic
def _meets_back(scene: mi.Scene, p: mi.Point3f, direction: mi.Vector3f, is_medium: mi.Bool):
    """Return whether rays hit the first surface that is not null from behind.

    Transmissive surfaces do not count if ``p`` is in the medium.
    """
    ray, back = mi.Ray3f(p, direction), mi.Bool(False)
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="backs"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        solid = active & ~is_null(si.bsdf().flags())
        encloses = ~(is_medium & transmits(si.bsdf().flags()))
        back |= solid & encloses & (dr.dot(si.n, direction) > 0)
        ray = si.spawn_ray(direction)
        crossings += 1
        active &= ~solid & (crossings < MOST_CROSSINGS)
    return back


def _separated(scene: mi.Scene, grid: Grid, axis: int, opaque: bool = False) -> mi.Bool:
    """Return for each voxel whether a surface, if ``opaque`` one that transmits nothing, lies
    between its centre and that of the next voxel along ``axis``; false for the last voxels.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count)
    at = list(grid.voxel_indices(index))
    start = grid.centers(index)
    exists = at[axis] + 1 < mi.UInt32(grid.sides[axis])
    at[axis] = at[axis] + 1
    stop = grid.world.point(mi.Point3f(*at) + 0.5)
    *_, found = first_surface(scene, start, stop, exists, opaque)
    dr.eval(found)
    return found


def _unreached(scene: mi.Scene, grid: Grid) -> mi.Bool:
    """Return for each voxel whether surfaces that transmit nothing separate it from all voxels that
    emitters illuminate; false everywhere if they illuminate no voxel directly.
    """
    count, index = dr.opaque(mi.UInt32, EMITTER_SAMPLES), dr.arange(mi.UInt32, grid.voxel_count)
    reached = _is_illuminated(scene, grid.centers(index), count)
    dr.eval(reached)
    if not dr.any(reached):
        return dr.full(mi.Bool, False, grid.voxel_count)
    barriers = [_separated(scene, grid, axis, opaque=True) for axis in range(3)]
    before = 0
    while (after := dr.count(reached)[0]) > before:
        before = after
        for axis, barrier in enumerate(barriers):
            for step in (1, -1):
                offset = [step * (k == axis) for k in range(3)]
                other, exists = _neighbour(grid, index, offset)
                # A barrier lies between a voxel and the next one.
                lower = index if step > 0 else other
                exists &= ~dr.gather(mi.Bool, barrier, lower, exists)
                reached |= dr.gather(mi.Bool, reached, other, exists)
                dr.eval(reached)
    return ~reached


@symbolic
def _is_illuminated(scene: mi.Scene, p: mi.Point3f, samples: mi.UInt32):
    """Return whether any of the ``samples`` of emitters is visible from positions, or through
    surfaces that let light pass straight.
    """
    vertex = dr.zeros(mi.Interaction3f, dr.width(p))
    vertex.p = p
    k, found, rng = mi.UInt32(0), mi.Bool(False), mi.PCG32(dr.width(p))
    while dr.hint(k < samples, label="illuminated voxels"):
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        record, value = scene.sample_emitter_direction(vertex, u, False, ~found)
        seen, rng = illuminates(scene, vertex, record, value, rng, ~found)
        found |= seen
        k += 1
    return found


def extended(grid: Grid, values: mi.Float, valid: mi.Bool, channels: int = 1) -> mi.Float:
    """Extrapolate non-negative ``values`` from ``valid`` voxels to two layers of voxels around.

    A new value is the mean of linear extrapolations through two valid voxels in a row, in each of
    26 directions, or of the nearest one alone if only that is valid.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels
    for _ in range(2):
        dr.eval(values, valid)
        total, weights = mi.Float(0), mi.Float(0)
        for offset, squared in _directions():
            (one, there), (two, beyond) = (
                _neighbour(grid, voxel, [n * o for o in offset]) for n in (1, 2)
            )
            there &= dr.gather(mi.Bool, valid, one, there)
            beyond &= there & dr.gather(mi.Bool, valid, two, beyond)
            channel = index - voxel * channels
            near = dr.gather(mi.Float, values, one * channels + channel, there)
            far = dr.gather(mi.Float, values, two * channels + channel, beyond)
            change = dr.select(beyond, dr.clip(near - far, -0.5 * near, 0.5 * near), 0)
            total += dr.select(there, (near + change) / squared, 0)
            weights += dr.select(there, mi.Float(1 / squared), 0)
        own = dr.gather(mi.Bool, valid, voxel)
        mean = total / dr.select(weights > 0, weights, 1)
        values = dr.select(own, values, dr.select(weights > 0, mean, 0))
        every = dr.arange(mi.UInt32, grid.voxel_count) * channels
        valid = valid | (dr.gather(mi.Float, weights + dr.zeros(mi.Float, len(index)), every) > 0)
    dr.eval(values)
    return values


def _directions() -> Iterator[tuple[list[int], int]]:
    """Yield the offsets of the 26 neighbours of a voxel, and their squared lengths."""
    for step in np.ndindex(3, 3, 3):
        offset = [s - 1 for s in step]
        if any(offset):
            yield offset, sum(o * o for o in offset)


def _neighbour(grid: Grid, voxel: mi.UInt32, offset: list[int]) -> tuple[mi.UInt32, mi.Bool]:
    """Return the flat indices of voxels at an ``offset`` (x, y, z), and whether they exist."""
    at = [mi.Int32(p) + o for p, o in zip(grid.voxel_indices(voxel), offset, strict=True)]
    inside = mi.Bool(True)
    for a, side in zip(at, grid.sides, strict=True):
        inside &= (a >= 0) & (a < mi.Int32(side))
    nx, ny, _ = grid.sides
    return mi.UInt32((at[2] * mi.Int32(ny) + at[1]) * mi.Int32(nx) + at[0]), inside


def neighbourhood(
    grid: Grid, values: mi.Float, valid: mi.Bool, channels: int = 1
) -> tuple[mi.Float, mi.Float]:
    """Return weighted sums of ``values`` over the valid ones of the 26 neighbours of each voxel,
    and the sums of the weights, which are inverse squared distances.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels
    channel = index - voxel * channels
    total, weights = mi.Float(0), mi.Float(0)
    for offset, squared in _directions():
        there, inside = _neighbour(grid, voxel, offset)
        inside &= dr.gather(mi.Bool, valid, there, inside)
        value = dr.gather(mi.Float, values, there * channels + channel, inside)
        total += dr.select(inside, value / squared, 0)
        weights += dr.select(inside, mi.Float(1 / squared), 0)
    return total, weights
