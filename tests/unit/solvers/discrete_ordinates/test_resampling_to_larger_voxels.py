"""Fields of a medium resampled to voxels that are larger than those of the data."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import extinction_grid, resampled

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (4, 6, 12)  # z, y, x


def medium_of(scenes, density: np.ndarray):
    place = scenes.placement((2.4, 1.2, 0.8), turn=20)
    shape = scenes.boundary(scenes.medium(density, 0.5, place), place)
    return compile_scene(scenes.load({"type": "volpath"}, shape)).visible[0]


@pytest.mark.parametrize("block", [(1, 2, 3), (4, 1, 2), (2, 3, 1), (2, 1, 6)], ids=str)
def test_blocks_are_means_of_their_voxels(scenes, block):
    """Block means equal NumPy's for blocks of any size along z, y, x."""
    density = scenes.texture(SHAPE, 0.0, 3.0, 9)
    medium = medium_of(scenes, density)
    sides = tuple(n // k for n, k in zip(SHAPE, block, strict=True))
    (found,) = resampled(medium, medium.sigma_t, Grid(sides, medium.frame))
    parts = density.reshape(sides[0], block[0], sides[1], block[1], sides[2], block[2])
    expected = parts.mean(axis=(1, 3, 5), dtype=np.float64)
    np.testing.assert_allclose(np.array(found).reshape(sides), expected, rtol=1e-5)


@pytest.mark.parametrize("shape", [(12, 12, 12), (15, 8, 21), (9, 25, 7), (3, 3, 30)], ids=str)
@pytest.mark.parametrize("cache", [(2, 2, 2), (4, 3, 5), (3, 1, 2)], ids=str)
def test_track_voxels_are_aligned_with_the_data(scenes, shape, cache):
    """Track voxels are those of the cache or whole divisions of the data, and conserve the mean."""
    density = scenes.texture(shape, 0.0, 3.0, 9)
    medium = medium_of(scenes, density)
    grid = Grid(cache, medium.frame)
    detail = extinction_grid(medium, grid)
    data = np.array(shape)
    assert detail.shape == cache or not (data % np.array(detail.shape)).any()
    if detail.shape != cache:
        (found,) = resampled(medium, medium.sigma_t, detail)
        assert np.mean(np.array(found)) == pytest.approx(density.mean(), rel=1e-4)
