"""The transpose of resampling a medium's data to the voxels of the cache."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, summed_to_channels
from mitsuba_irrcache.gradients.transport import Derivatives
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid

#: Smallest number of points along each axis of voxels that the boundary may cut.
CUT_POINTS = 4
#: Smallest number of points along each axis with which the extinction of a voxel is integrated.
COLLISION_POINTS = 4


class VoxelQuadrature:
    """Quadrature points in each voxel of ``grid`` at which the data of ``medium`` are evaluated.

    Along each axis there are two points for each voxel of the finest data.
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
        """Add the derivatives ``found`` with respect to voxels to those with respect to the data.

        Args:
            sigma_t: sums of the derivatives with respect to the extinction; None if not wanted.
            albedo: sums of those with respect to the albedo.
            found: derivatives with respect to the means over the voxels.
            mean_albedo: the albedo of the voxels, by channel. Where the albedo of the data differs
                from it, extinction that is added also changes the albedo of the voxel.
            emission: sums of those with respect to the emission.
        """
        # docs/primer, eqs. (8.8), (8.11)
        grid, medium = self.grid, self.medium
        voxel = dr.arange(mi.UInt32, grid.voxel_count)
        corner, sides = mi.Point3f(*grid.voxel_indices(voxel)), [Divisor(self.points)] * 2
        count, points = dr.opaque(mi.UInt32, self.points**3), dr.opaque(mi.Float, self.points)
        # A single channel that represents all holds the sum of their derivatives.
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
                sigma_t.add(p, summed_to_channels(change, sigma_t.channels), inside)
            if dr.hint(albedo is not None, mode="scalar"):
                change = mi.Spectrum(medium.sigma_t.at_world(p, inside)) * by_collided
                albedo.add(p, summed_to_channels(change, albedo.channels), inside)
            if dr.hint(emission is not None, mode="scalar"):
                there = inside & medium.emission.covers(p)
                emission.add(p, summed_to_channels(by_emission, emission.channels), there)
            k += 1

    @symbolic
    def means(
        self, sigma_t: Field | None, albedo: Field | None, emission: Field | None, mean: list
    ):
        """Return the transpose of `add`: means over the voxels of changes of the data.

        Args:
            sigma_t: field of the changes of the extinction; None for 0.
            albedo: field of those of the albedo.
            emission: field of those of the emission.
            mean: the albedo of the voxels, by channel.

        Returns the changes of the extinction, of the scattering coefficient beyond those at the
        albedo of the voxel, and of the emission.
        """
        grid, medium = self.grid, self.medium
        voxel = dr.arange(mi.UInt32, grid.voxel_count)
        corner, sides = mi.Point3f(*grid.voxel_indices(voxel)), [Divisor(self.points)] * 2
        count, points = dr.opaque(mi.UInt32, self.points**3), dr.opaque(mi.Float, self.points)
        share = dr.opaque(mi.Float, 1 / self.points**3)
        own_mean, k, none = mi.Spectrum(*mean), mi.UInt32(0), dr.zeros(mi.Float, grid.voxel_count)
        extinction, collided, emitted = mi.Spectrum(none), mi.Spectrum(none), mi.Spectrum(none)
        while dr.hint(k < count, label="points in a voxel"):
            place = mi.Point3f(*unravelled(k, sides)) + 0.5
            p = grid.world.point(corner + place / points)
            inside = mi.Bool(True)
            if dr.hint(self.cut, mode="scalar"):
                inside = medium.contains(p)
            if dr.hint(sigma_t is not None, mode="scalar"):
                change = dr.select(inside, mi.Spectrum(sigma_t.at_world(p, inside)) * share, 0)
                extinction += change
                collided += change * (mi.Spectrum(medium.albedo.at_world(p, inside)) - own_mean)
            if dr.hint(albedo is not None, mode="scalar"):
                change = mi.Spectrum(albedo.at_world(p, inside)) * share
                change *= mi.Spectrum(medium.sigma_t.at_world(p, inside))
                collided += dr.select(inside, change, 0)
            if dr.hint(emission is not None, mode="scalar"):
                there = inside & medium.emission.covers(p)
                emitted += dr.select(there, mi.Spectrum(emission.at_world(p, there)) * share, 0)
            k += 1
        return extinction, collided, emitted

    @symbolic
    def extinction(self):
        """Return the mean of the extinction over each voxel, for each channel of the radiance."""
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
    """Return the volume of a voxel in world space."""
    return abs(float(np.linalg.det(grid.to_world[:3, :3]))) / grid.voxel_count
