"""The transpose of resampling the medium's data to the voxels of the cache."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, of_channels
from mitsuba_irrcache.gradients.transport import Derivatives
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid

#: Points along each axis of a voxel that the boundary may cut, at least.
CUT_POINTS = 4
#: Points along each axis of a voxel by which its extinction is integrated, at least.
COLLISION_POINTS = 4


class VoxelQuadrature:
    """Points in the voxels of ``grid`` at which the data of ``medium`` are read: as dense as the
    data along each axis, and at their voxel centres where both grids are the same.
    """

    def __init__(self, medium: MediumGrid, grid: Grid) -> None:
        self.medium, self.grid = medium, grid
        fields = [f.grid for f in (medium.sigma_t, medium.albedo) if f.grid is not None]
        if medium.emission is not None and medium.emission.grid is not None:
            fields.append(medium.emission.grid)
        ratio = max((float((grid.voxel_size / g.voxel_size).max()) for g in fields), default=1.0)
        self.cut = not medium.fills(grid)
        points = 2 * int(np.ceil(ratio - 1e-3))
        self.points = max(points, CUT_POINTS if self.cut else 1)

    @symbolic
    def add(
        self,
        sigma_t: GridSplat | ConstantSplat | None,
        albedo: GridSplat | ConstantSplat | None,
        found: Derivatives,
        mean_albedo: list,
        emission: GridSplat | ConstantSplat | None = None,
    ):
        """Add the derivatives ``found`` at voxels to those by the data. ``mean_albedo`` is the
        albedo of the voxels: matter of another albedo scatters more, or less.
        """
        # docs/primer, eqs. (8.8), (8.11)
        grid, medium = self.grid, self.medium
        voxel = dr.arange(mi.UInt32, grid.voxel_count)
        corner, sides = mi.Point3f(*grid.voxel_indices(voxel)), [Divisor(self.points)] * 2
        count, points = dr.opaque(mi.UInt32, self.points**3), dr.opaque(mi.Float, self.points)
        # A channel that stands for all is their sum.
        several = dr.size_v(mi.Spectrum) // len(found.collided)
        share = dr.opaque(mi.Float, volume_of(grid) / self.points**3 / several)
        by_sigma_t = mi.Spectrum(*(found.sigma_t or [0.0])) * share
        by_collided = mi.Spectrum(*found.collided) * share
        by_emission = mi.Spectrum(*(found.emitted or [0.0])) * share
        mean, k = mi.Spectrum(*mean_albedo), mi.UInt32(0)
        while dr.hint(k < count, label="points in a voxel"):
            place = mi.Point3f(*unravelled(k, sides)) + 0.5
            p = grid.world.point(corner + place / points)
            inside = mi.Bool(True)
            if dr.hint(self.cut, mode="scalar"):
                inside = medium.contains(p)
            if dr.hint(sigma_t is not None, mode="scalar"):
                own = mi.Spectrum(medium.albedo.at_world(p, inside))
                change = by_sigma_t + (own - mean) * by_collided
                sigma_t.add(p, of_channels(change, sigma_t.channels), inside)
            if dr.hint(albedo is not None, mode="scalar"):
                change = mi.Spectrum(medium.sigma_t.at_world(p, inside)) * by_collided
                albedo.add(p, of_channels(change, albedo.channels), inside)
            if dr.hint(emission is not None, mode="scalar"):
                there = inside & medium.emission.covers(p)
                emission.add(p, of_channels(by_emission, emission.channels), there)
            k += 1

    @symbolic
    def extinction(self):
        """Means of the extinction over the voxels, for each channel of the radiance."""
        grid, medium = self.grid, self.medium
        voxel = dr.arange(mi.UInt32, grid.voxel_count)
        number = max(self.points, COLLISION_POINTS)
        corner, sides = mi.Point3f(*grid.voxel_indices(voxel)), [Divisor(number)] * 2
        count, points = dr.opaque(mi.UInt32, number**3), dr.opaque(mi.Float, number)
        total, k = mi.Spectrum(dr.zeros(mi.Float, grid.voxel_count)), mi.UInt32(0)
        while dr.hint(k < count, label="points in a voxel"):
            p = grid.world.point(corner + (mi.Point3f(*unravelled(k, sides)) + 0.5) / points)
            inside = medium.contains(p) if dr.hint(self.cut, mode="scalar") else mi.Bool(True)
            total += dr.select(inside, mi.Spectrum(medium.sigma_t.at_world(p, inside)), 0)
            k += 1
        return total * dr.opaque(mi.Float, 1 / number**3)


def volume_of(grid: Grid) -> float:
    """The volume of a voxel."""
    return abs(float(np.linalg.det(grid.to_world[:3, :3]))) / grid.voxel_count
