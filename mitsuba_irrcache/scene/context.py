"""What is around the voxels of a cache where a scene has surfaces or several media."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import fibonacci_direction, kronecker
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.cut_cells import CutCells
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.transport.path import MOST_CROSSINGS, Media, is_null

#: Rays from each voxel that look for its medium.
RAYS = 16


class Surroundings:
    """All media of a scene, and what light does between them. The scene itself is not held."""

    def __init__(self, scene: mi.Scene, grids: list[MediumGrid]) -> None:
        self.media = Media(grids)
        #: radiance that no emitter exceeds
        self.brightest = dr.opaque(mi.Float, _brightest(scene))
        for grid in grids:
            grid.surroundings = self

    def survey(self, scene: mi.Scene, grid: Grid, medium: MediumGrid) -> VoxelClasses:
        """Of all voxels of the cache's ``grid`` in ``medium``."""
        index = dr.arange(mi.UInt32, grid.voxel_count)
        *votes, within, backs = _survey(scene, self.media, medium, grid, index)
        within, enclosed = within > 0, backs == RAYS
        dr.eval(votes, within, enclosed)
        best, place = mi.UInt32(0), mi.UInt32(0)
        for i, count in enumerate(votes):
            place = dr.select(count > best, i, place)
            best = dr.maximum(best, count)
        dr.eval(place)
        edges = CutCells(scene, grid)
        return VoxelClasses(grid, place, within, enclosed, edges if edges.count else None)

    def pointer(self, place: mi.UInt32) -> mi.MediumPtr:
        """The medium of a number from `VoxelClasses.place`."""
        pointer = dr.zeros(mi.MediumPtr, dr.width(place))
        for i, grid in enumerate(self.media.grids):
            pointer = dr.select(place == i + 1, grid.pointer, pointer)
        return pointer


@symbolic
def _survey(scene: mi.Scene, media: Media, medium: MediumGrid, grid: Grid, index: mi.UInt32):
    """Per voxel, of its rays: how many found each medium (none first), how many found ``medium``
    from some place in the voxel, how many met the back of a surface first.
    """
    corner = mi.Point3f(*grid.places(index))
    votes = [mi.UInt32(0) for _ in range(len(media.grids) + 1)]
    within, backs = mi.UInt32(0), mi.UInt32(0)
    k, count = mi.UInt32(0), dr.opaque(mi.UInt32, RAYS)
    while dr.hint(k < count, label="survey"):
        u, direction = kronecker(k, 3), fibonacci_direction(k, RAYS, azimuth=0.4)
        pointer = probe(scene, grid.world.point(corner + 0.5), direction)
        meets_back = _meets_back(scene, grid.world.point(corner + 0.5), direction)
        backs += dr.select(meets_back, mi.UInt32(1), 0)
        votes[0] += dr.select(pointer == None, mi.UInt32(1), 0)  # noqa: E711
        for i in range(len(media.grids)):
            votes[i + 1] += dr.select(pointer == media.grids[i].pointer, mi.UInt32(1), 0)
        pointer = probe(scene, grid.world.point(corner + mi.Point3f(u)), direction)
        within += dr.select(pointer == medium.pointer, mi.UInt32(1), 0)
        k += 1
    return [*votes, within, backs]


def medium_at(scene: mi.Scene, position: np.ndarray) -> mi.MediumPtr:
    """The medium that a world position (3) is in, found along a direction of no axis."""
    return probe(scene, mi.Point3f(position), mi.Vector3f(0.48, 0.64, 0.6))


@symbolic
def probe(scene: mi.Scene, p: mi.Point3f, direction: mi.Vector3f):
    """The medium at ``p``, as the first shape along ``direction`` tells that has a medium; none
    where there is no such shape.
    """
    ray, pointer = mi.Ray3f(p, direction), dr.zeros(mi.MediumPtr, dr.width(p))
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="probe"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        tells = active & si.is_medium_transition()
        pointer = dr.select(tells, si.target_medium(-direction), pointer)
        ray = si.spawn_ray(direction)
        crossings += 1
        active &= ~tells & (crossings < MOST_CROSSINGS)
    return pointer


@symbolic
def _meets_back(scene: mi.Scene, p: mi.Point3f, direction: mi.Vector3f):
    """Whether the first surface that is not null is met from behind."""
    ray, back = mi.Ray3f(p, direction), mi.Bool(False)
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="backs"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        solid = active & ~is_null(si.bsdf().flags())
        back |= solid & (dr.dot(si.n, direction) > 0)
        ray = si.spawn_ray(direction)
        crossings += 1
        active &= ~solid & (crossings < MOST_CROSSINGS)
    return back


def _brightest(scene: mi.Scene) -> float:
    """The largest radiance found on emitters that can be seen."""
    rng = mi.PCG32(1024)
    si = dr.zeros(mi.SurfaceInteraction3f, 1024)
    si.uv = mi.Point2f(rng.next_float32(), rng.next_float32())
    found = [0.0]
    for emitter in scene.emitters():
        environment = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
        sample = mi.Point2f(rng.next_float32(), rng.next_float32())
        si.wi = mi.warp.square_to_uniform_sphere(sample) if environment else mi.Vector3f(0, 0, 1)
        value = mi.Spectrum(emitter.eval(si))
        found.append(float(np.nanmax(np.array(value))))
    return max(f for f in found if np.isfinite(f))
