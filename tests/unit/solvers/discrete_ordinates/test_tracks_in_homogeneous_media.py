"""Tallies of tracks in homogeneous media, where each track is known."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates import tracks
from mitsuba_irrcache.solvers.discrete_ordinates.track_record import FIXED_POINT_ONE
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (6, 9, 7)
WAYS = np.array([[0.9, 0.3, 0.2], [-0.5, 0.8, 0.4], [0.5, -0.6, 0.9], [1.0, 0.9, -0.8]])
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)


@pytest.fixture(params=["together", "apart"], autouse=True)
def mode(request, monkeypatch):
    """Launch all directions at once, or one by one."""
    if request.param == "apart":
        monkeypatch.setattr(tracks, "SMALL_GRID", 0)


def behind_the_entry(grid: Grid, way: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the world lengths (z, y, x) of the tracks from their entry to the middle of each
    slice.
    """
    velocity = grid.coordinates.matrix[:3, :3] @ way
    axis = int(np.abs(velocity).argmax())
    at = np.moveaxis(np.indices(grid.shape)[::-1], 0, -1) + 0.5
    for k, start in zip([k for k in range(3) if k != axis], offset, strict=True):
        slope = round(velocity[k] / velocity[axis] * FIXED_POINT_ONE)
        steps = (at[..., axis] - 0.5).astype(int)
        at[..., k] += (
            int(start * FIXED_POINT_ONE) + steps * slope
        ) % FIXED_POINT_ONE / FIXED_POINT_ONE - 0.5
    entry = np.where(velocity > 0, 0, grid.resolution)
    return ((at - entry) / velocity).min(axis=-1)


@pytest.mark.parametrize("way", WAYS, ids=lambda w: ",".join(f"{x:.1f}" for x in w))
@pytest.mark.parametrize("back", [0, 1])
def test_incoming_radiance_is_attenuated(way, back):
    """Incoming radiance is attenuated by e^-tau, and collisions are proportional to it.

    Tracks may enter between two slices; sigma_t is 0.5 to 1 per voxel.
    """
    grid, sigma_t = Grid(SHAPE, np.diag([1.4, 1.8, 1.2, 1])), 4.0
    count = grid.voxel_count
    tracks = Tracks(grid, dr.full(mi.Float, sigma_t, count), np.zeros(3, int), grid.resolution)
    light, offset = np.zeros((1, 2)), np.array([[0.35, 0.8]])
    light[0, back] = 3.0
    volume = dr.opaque(mi.Float, 0, count * 4)
    tracks.sweep(volume, tracks.table(way[None], light, np.ones(1), offset))
    received = np.array(volume, np.float64).reshape(*SHAPE, 4)[..., 1]
    length = behind_the_entry(grid, -way if back else way, offset[0])
    np.testing.assert_allclose(received, 3 * np.exp(-sigma_t * length), rtol=2e-3)
