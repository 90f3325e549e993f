"""A sweep over a box smaller than its grid accesses no memory out of bounds.

Dr.Jit reports such accesses in its debug mode. Otherwise they return arbitrary values or crash the
process.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import SweptBox, Tracks, values_at_centres

pytestmark = pytest.mark.usefixtures("rgb")

#: Boxes (x, y, z) with margins on all sides, on some, on none; and with too few voxels to sharpen.
BOXES = {
    "inside": ((1, 1, 1), (6, 4, 5)),
    "at the lower corner": ((0, 0, 0), (4, 4, 4)),
    "at the upper corner": ((3, 1, 2), (7, 5, 6)),
    "whole": ((0, 0, 0), (7, 5, 6)),
    "thin": ((2, 2, 2), (4, 3, 4)),
}


@pytest.fixture
def grid():
    return Grid((6, 5, 7), np.eye(4))  # z, y, x


@pytest.mark.parametrize("box", BOXES.values(), ids=BOXES)
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("axis", range(3))
def test_sharpening(out_of_bounds, grid, axis, channels, box):
    """Sharpening stays in bounds at all voxels, including those outside of the box."""
    count = grid.voxel_count
    rng = np.random.default_rng(axis)
    values = mi.Float((rng.random(count * channels) + 1).astype(np.float32).tolist())
    every = dr.arange(mi.UInt32, count)
    dr.eval(values, every)

    def action() -> None:
        for c in range(channels):
            swept = SweptBox(grid, *map(np.array, box), axis)
            dr.eval(values_at_centres(values, swept, every, c, channels))

    assert not out_of_bounds(action)


@pytest.mark.parametrize("box", BOXES.values(), ids=BOXES)
def test_incoming_radiance_stays_in_bounds(out_of_bounds, grid, box):
    """Carrying incoming radiance through the box stays in bounds, inside and outside of it."""
    directions = np.array([[0.2, 0.5, 1.0], [1.0, -0.7, 0.4], [-0.3, -1.0, 0.6]])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    sigma_t = dr.opaque(mi.Float, 0.5, grid.voxel_count)
    tracks = Tracks(grid, sigma_t, *map(np.array, box))
    offsets = np.random.default_rng(1).random((3, 2))
    assert not out_of_bounds(
        lambda: dr.eval(tracks.uncollided(directions, np.ones((3, 2)), offsets))
    )
