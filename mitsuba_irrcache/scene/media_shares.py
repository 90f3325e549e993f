"""Shares of voxels that lie in each medium, for boundaries of any shape.

Rays along the columns of a grid cross the shapes that bound the media. Along a ray the lengths of
the intervals in each medium are exact; across it, a column is sampled by `RAYS` x `RAYS` rays.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.occluders import SLACK, boxes_meet, corners_of, hole_in
from mitsuba_irrcache.transport.path import MOST_CROSSINGS, medium_after

#: Rays along each axis of the cross section of a column of voxels.
RAYS = 8


def media_within(medium: MediumGrid, grid: Grid, box: tuple) -> list[MediumGrid]:
    """Return ``medium``, then all others that may reach into the ``box`` (lower, upper) of voxels
    of ``grid``.
    """
    others = (o for o in medium.others if boxes_meet(grid, *box, corners_of(o.frame)))
    return [medium, *others]


def media_in(medium: MediumGrid, grid: Grid) -> list[MediumGrid]:
    """Return the other media that lie in the box of ``grid`` as a whole."""
    found = []
    for other in medium.others:
        to_grid = grid.coordinates.matrix
        corners = corners_of(other.frame) @ to_grid[:3, :3].T + to_grid[:3, 3]
        if (corners >= -SLACK).all() and (corners <= grid.resolution + SLACK).all():
            found.append(other)
    return found


def why_shared(scene: mi.Scene, medium: MediumGrid, grid: Grid, box: tuple) -> str | None:
    """Return why ``medium`` does not fill its closed-form boundary in the ``box`` (lower, upper) of
    voxels of ``grid``; None if it does.
    """
    name = f'medium "{medium.name}"'
    if not medium.has_exact_boundary:
        return f"{name} is bounded by other shapes than one box or sphere"
    for other in media_within(medium, grid, box)[1:]:
        return f'medium "{other.name}" reaches into {name}'
    hole = hole_in(scene, medium, grid, box)
    return hole and f"{hole} is a hole in {name}, or bounds another medium in it"


def media_shares(scene: mi.Scene, media: Sequence[MediumGrid], grid: Grid) -> list[mi.Float]:
    """Return the share of the volume of each voxel of ``grid`` that lies in each of the ``media``,
    which Mitsuba's pointers identify.
    """
    count = len(media) + 1  # the last one stands for all others, and for no medium
    sums = [dr.zeros(mi.Float, count * grid.voxel_count) for _ in range(2)]
    nx, ny, nz = (int(n) for n in grid.resolution)
    column = dr.arange(mi.UInt32, nx * ny)
    dr.eval(*sums)
    _add_columns(scene, [medium.pointer for medium in media], grid, column, *sums)
    dr.eval(*sums)
    shares = [dr.zeros(mi.Float, grid.voxel_count) for _ in media]
    for number, share in enumerate(shares):
        first = dr.opaque(mi.UInt32, number * grid.voxel_count)
        _sum_columns(share, column, dr.opaque(mi.UInt32, nz), nx * ny, first, *sums)
    dr.eval(*shares)
    return shares


@symbolic
def _add_columns(scene, pointers, grid, column, partial, beyond):
    """Add the intervals of rays along the third axis of ``grid`` in each medium.

    An interval from a to b covers clip(b - k, 0, 1) - clip(a - k, 0, 1) of voxel k. Either term is
    the fractional part of the coordinate in the voxel that contains it, added to ``partial``, and 1
    in all voxels before that, added to ``beyond`` once. Both arrays have the voxels of the grid for
    each of the ``pointers``, and for others. A lane adds to its own column only.
    """
    x, y, _ = grid.voxel_indices(column)
    slices = mi.Float(grid.sides[2])
    across, rays = dr.opaque(mi.Float, RAYS), dr.opaque(mi.UInt32, RAYS)
    start = grid.world.point(mi.Point3f(0))
    direction = grid.world.point(mi.Point3f(0, 0, slices)) - start
    length = dr.norm(direction)
    direction /= length
    k = mi.UInt32(0)
    while dr.hint(k < rays * rays, label="rays of a column"):
        row = k // rays
        u = mi.Float(x) + (mi.Float(k - row * rays) + 0.5) / across
        v = mi.Float(y) + (mi.Float(row) + 0.5) / across
        ray = mi.Ray3f(grid.world.point(mi.Point3f(u, v, 0)), direction)
        origin, at, within = mi.Point3f(ray.o), mi.Float(0), dr.zeros(mi.MediumPtr)
        crossings, active = mi.UInt32(0), mi.Bool(True)
        while dr.hint(active, label="media of a column"):
            si = scene.ray_intersect(ray, active)
            met = active & si.is_valid()
            distance = dr.dot(si.p - origin, direction) / length * slices
            end = dr.select(met, dr.clip(distance, at, slices), slices)
            # Where boundaries touch, a ray can skip the second one of them.
            transition = met & si.is_medium_transition()
            before = dr.select(transition, si.target_medium(-direction), within)
            within = dr.select(within == None, before, within)  # noqa: E711
            number = mi.UInt32(len(pointers))
            for i, pointer in enumerate(pointers):
                number = dr.select(within == pointer, i, number)
            first = number * mi.UInt32(grid.sides[2])
            for place, sign in ((at, -1.0), (end, 1.0)):
                slice_ = dr.minimum(mi.UInt32(place), mi.UInt32(grid.sides[2]) - 1)
                voxel = grid.index(x, y, first + slice_)
                inside = sign * (place - mi.Float(slice_))
                dr.scatter_add(partial, inside, voxel, active, mode=dr.ReduceMode.NoConflicts)
                dr.scatter_add(
                    beyond, mi.Float(sign), voxel, active, mode=dr.ReduceMode.NoConflicts
                )
            at = dr.select(active, end, at)
            within = dr.select(transition, medium_after(si, direction, within), within)
            ray = si.spawn_ray(direction)
            crossings += 1
            active &= met & (at < slices) & (crossings < MOST_CROSSINGS)
        k += 1


@symbolic
def _sum_columns(share, column, slices, area, first, partial, beyond):
    """Write the means over the rays of each column to ``share``, from the last voxel on."""
    covered, k = mi.Float(0), mi.UInt32(slices)
    scale, area = dr.opaque(mi.Float, 1 / RAYS**2), dr.opaque(mi.UInt32, area)
    while dr.hint(k > 0, label="voxels of a column"):
        k -= 1
        voxel = k * area + column
        own = dr.gather(mi.Float, partial, first + voxel) + covered
        dr.scatter(share, dr.clip(own * scale, 0, 1), voxel)
        covered += dr.gather(mi.Float, beyond, first + voxel)
