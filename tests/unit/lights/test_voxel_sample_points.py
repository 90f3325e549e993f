"""Sample points in voxels that contain a point light have a minimum distance from it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.falloff import MINIMUM_DISTANCE, VoxelSamplePoints

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize("aside", [0.0, 1e-3, 0.03, 0.2, 0.6])
def test_sample_points_are_moved_away_from_lights(scenes, aside):
    """Sample points are moved away from the light up to a quarter of the shortest edge.

    The light lies ``aside`` of the centre of an oblong voxel; points of other voxels are unchanged.
    """
    grid = Grid((5, 6, 7), scenes.placement((7.0, 3.0, 10.0), turn=25))
    index = mi.UInt32(np.arange(grid.voxel_count, dtype=np.uint32))
    centres = np.array(grid.centers(index), np.float64).T
    lamp = centres[100] + aside * np.array([0.48, -0.6, 0.64])
    light = {"type": "point", "position": lamp.tolist(), "intensity": 1.0}
    found = np.array(
        VoxelSamplePoints(mi.load_dict({"type": "scene", "l": light}), grid).of(index)
    ).T
    least = MINIMUM_DISTANCE * grid.voxel_size.min()
    before, after = (np.linalg.norm(p - lamp, axis=1) for p in (centres, found))
    near = before < least
    assert near.sum() == (aside < least)
    np.testing.assert_allclose(after[near], least, rtol=1e-3)
    np.testing.assert_allclose(found[~near], centres[~near], atol=1e-6)
    if aside:
        moved = (found - lamp)[near] / least
        np.testing.assert_allclose(moved, ((centres - lamp) / before[:, None])[near], atol=5e-3)
