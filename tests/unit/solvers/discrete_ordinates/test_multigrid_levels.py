"""Coarse multigrid levels: placement, conservation of mass, and transfer between levels."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

pytestmark = pytest.mark.usefixtures("rgb")

#: Voxels along z, y, x, and the edges of one along x, y, z.
GRIDS = {
    "cubes": ((24, 22, 26), (1.0, 1.0, 1.0)),
    "1:1:5": ((8, 24, 22), (1.0, 1.0, 5.0)),
    "rods": ((6, 9, 26), (1.0, 3.0, 2.5)),
    "odd sides": ((21, 25, 23), (1.0, 1.2, 0.9)),
}


def level_of(scenes, shape, edges, sigma_t: np.ndarray, evenly: bool) -> MultigridLevel:
    sides = np.array(shape)[::-1] * edges
    grid = Grid(shape, scenes.placement(tuple(sides), turn=20))
    values = mi.Float(np.float32(sigma_t).ravel())
    tracks = Tracks(grid, values, np.zeros(3, int), grid.resolution)
    return MultigridLevel(
        values, mi.Float(np.full(values.shape[0], 0.8, np.float32)), tracks, evenly
    )


def centres(level: MultigridLevel) -> np.ndarray:
    """Return the world positions of the voxels (n, 3)."""
    return np.array(level.grid.centers(level.tracks.active), np.float64).T


@pytest.mark.parametrize("evenly", [False, True])
@pytest.mark.parametrize(("shape", "edges"), GRIDS.values(), ids=GRIDS)
def test_coarse_levels_conserve_mass_and_position(scenes, shape, edges, evenly):
    """Each coarse voxel has the mass of the fine voxels whose centres lie in it.

    Mass is extinction times volume; world positions are compared, also beyond the end of odd sides.
    """
    sigma_t = np.random.default_rng(3).uniform(0.0, 2.0, shape)
    level = level_of(scenes, shape, edges, sigma_t, evenly)
    coarser = level.coarser
    to_voxels = coarser.grid.coordinates.matrix
    x, y, z = np.floor(centres(level) @ to_voxels[:3, :3].T + to_voxels[:3, 3]).astype(int).T
    assert min(x.min(), y.min(), z.min()) == 0
    voxel = np.ravel_multi_index((z, y, x), coarser.grid.shape)
    mass = sigma_t.ravel() * np.prod(level.grid.voxel_size)
    expected = np.bincount(voxel, mass, coarser.grid.voxel_count)
    found = np.array(coarser.sigma_t, np.float64) * np.prod(coarser.grid.voxel_size)
    assert len(found) < 0.7 * sigma_t.size
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("evenly", [False, True])
@pytest.mark.parametrize(("shape", "edges"), GRIDS.values(), ids=GRIDS)
def test_transfer_between_levels_preserves_linear_functions(scenes, shape, edges, evenly):
    """Restriction followed by interpolation preserves linear functions, except at the border."""
    level = level_of(scenes, shape, edges, np.ones(shape), evenly)
    values = centres(level) @ np.array([0.5, -0.3, 0.8])
    values = np.float32(values - values.min() + 1)
    found = np.array(level.prolong(level.restrict(mi.Float(values)))).reshape(shape)
    inner = tuple(slice(2, max(n - 3, 3)) for n in shape)
    np.testing.assert_allclose(found[inner], values.reshape(shape)[inner], rtol=1e-4)
