"""Fields of a medium resampled to the voxels of a cache."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import collision_albedo

pytestmark = pytest.mark.usefixtures("rgb")


def at_voxels(scenes, density: np.ndarray, albedo: np.ndarray | float, sides: int) -> np.ndarray:
    """Return the collision albedo in a cube of ``sides`` voxels an edge (z, y, x, channel)."""
    shape = scenes.boundary(scenes.medium(density, albedo))
    medium = compile_scene(scenes.load({"type": "volpath"}, shape)).visible[0]
    grid = Grid((sides,) * 3, medium.frame)
    voxels = dr.arange(mi.UInt32, grid.voxel_count)
    found = collision_albedo(medium, grid, voxels)
    return np.stack([np.array(c) for c in found], axis=-1).reshape(sides, sides, sides, -1)


def test_albedo_is_that_of_collisions(scenes):
    """The albedo of a voxel is weighted by collisions.

    Extinction x and albedo a + b x rise linearly between two voxel centres of the data: the mean of
    x (a + b x) over that of x in each of four voxels of half the size, and less at the empty end.
    """
    density = np.zeros((2, 2, 2), np.float32)
    density[..., 1] = 1
    albedo = np.empty((2, 2, 2, 3), np.float32)
    albedo[..., 0, :], albedo[..., 1, :] = (0.1, 0.2, 0.9), (0.5, 1.0, 0.3)
    found = at_voxels(scenes, density, albedo, 4)
    for voxel, (begin, end) in ((1, (0.0, 0.5)), (2, (0.5, 1.0))):
        x, x2 = ((end**n - begin**n) / n for n in (2, 3))
        first, last = albedo[0, 0, 0], albedo[0, 0, 1]
        expected = first + (last - first) * (x2 / x)
        np.testing.assert_allclose(found[:, :, voxel], np.broadcast_to(expected, (4, 4, 3)), 1e-5)
    assert (found[:, :, 0] == 0).all()  # no collisions here
    np.testing.assert_allclose(found[:, :, 3], np.broadcast_to(last, (4, 4, 3)), 1e-5)


@pytest.mark.parametrize("sides", [3, 16])
def test_constant_albedo_is_unchanged(scenes, sides):
    """A constant albedo, also as a grid of one value, is unchanged for any extinction."""
    density = scenes.texture((8, 8, 8), 0.0, 3.0, 2)
    assert (at_voxels(scenes, density, 0.7, sides) == np.float32(0.7)).all()
    everywhere = np.full((5, 4, 3, 1), 0.7, np.float32)
    np.testing.assert_allclose(at_voxels(scenes, density, everywhere, sides), 0.7, 1e-5)


@pytest.mark.parametrize("sides", [3, 6, 12, 18])
def test_albedo_of_rough_data(scenes, sides):
    """The albedo of random data is accurate to 0.3 % in larger and smaller voxels.

    The reference is a sum over 12^3 points of each voxel; values at voxel centres are off by up to
    60 %.
    """
    fields = [scenes.texture((6, 6, 6), 0.0, 1.0, seed) for seed in (3, 4)]
    found = at_voxels(scenes, fields[0], fields[1][..., None], sides)[..., 0]
    at = ((np.arange(12 * sides) + 0.5) / (2 * sides)) - 0.5  # in voxels of the data
    points = np.stack(np.meshgrid(at, at, at, indexing="ij"))
    density, albedo = (map_coordinates(f, points, order=1, mode="nearest") for f in fields)
    parts = sides, 12, sides, 12, sides, 12
    sums = [f.reshape(parts).sum(axis=(1, 3, 5)) for f in (density * albedo, density)]
    np.testing.assert_allclose(found, sums[0] / sums[1], rtol=3e-3)
