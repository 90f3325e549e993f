"""Skipping of empty space along tracks: distances by brute force, and unchanged results."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates import empty_space, tracks
from mitsuba_irrcache.solvers.discrete_ordinates.empty_space import CELL, EmptySpace
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (26, 21, 32)
SIDES = SHAPE[::-1]


def sparse(share: float = 1e-3) -> np.ndarray:
    """Return a few occupied voxels (z, y, x), and a solid ball."""
    occupied = np.random.default_rng(2).random(SHAPE) < share
    at = np.moveaxis(np.indices(SHAPE), 0, -1) - [14, 8, 20]
    return occupied | (np.linalg.norm(at, axis=-1) < 3.5)


def found(occupied: np.ndarray, lower, upper) -> np.ndarray | None:
    needed = mi.UInt32(np.flatnonzero(occupied).tolist())
    emptiness = EmptySpace.find(Grid(SHAPE, np.eye(4)), needed, np.array(lower), np.array(upper))
    if emptiness is None:
        return None
    shape = [-(-(b - a) // CELL) for a, b in zip(lower, upper, strict=True)][::-1]
    return np.array(emptiness.slices).reshape(shape)


def test_tracks_skip_only_empty_slices():
    """Slices that tracks may skip contain no occupied voxel and no side of the box.

    The first cell that prevents a longer skip is nearer than two cells behind them.
    """
    occupied = sparse()
    lower, upper = (2, 1, 3), (31, 20, 26)  # including odd sizes
    occupied[:3] = occupied[:, :1] = occupied[:, 20:] = occupied[..., :2] = occupied[..., 31:] = 0
    slices = found(occupied, lower, upper)
    blocked = np.pad(occupied[3:26, 1:20, 2:31], 40, constant_values=True)
    longest = 0
    for z, y, x in np.ndindex(*slices.shape):
        n = int(slices[z, y, x])
        first = np.array([z, y, x]) * CELL + 40
        here = blocked[tuple(np.s_[a : a + CELL] for a in first)]
        inside = here[: 23 - z * CELL, : 19 - y * CELL, : 29 - x * CELL]
        assert (n == 0) == inside.any()
        if n > 1:  # reached from any voxel of the cell in fewer than n slices
            assert not blocked[tuple(np.s_[a - n + 1 : a + CELL + n - 1] for a in first)].any()
        if n and n < (empty_space.MAX_DISTANCE - 1) * CELL:
            wide = n + 2 * CELL
            assert blocked[tuple(np.s_[a - wide : a + CELL + wide] for a in first)].any()
        longest = max(longest, n)
    assert longest > 2 * CELL


def test_skipping_is_disabled_where_it_saves_little():
    assert found(np.ones(SHAPE, bool), (0, 0, 0), SIDES) is None
    assert found(sparse(), (0, 0, 0), SIDES) is not None


@pytest.mark.parametrize("box", [((0, 0, 0), (32, 21, 26)), ((3, 1, 2), (32, 20, 25))])
@pytest.mark.parametrize("detailed", [False, True])
def test_skipping_does_not_change_the_radiance(monkeypatch, box, detailed):
    """Skipping does not change the result, for all directions and entry points.

    Both incoming and scattered radiance are compared, with voxels of the medium and its detail.
    """
    monkeypatch.setattr(tracks, "SMALL_GRID", 0)
    monkeypatch.setattr(tracks, "SECOND_DIFFERENCE", 0.0)
    monkeypatch.setattr(empty_space, "WORTHWHILE", 1.0)
    occupied = sparse()
    lower, upper = (np.array(end) for end in box)
    keep = np.zeros_like(occupied)
    keep[tuple(np.s_[a:b] for a, b in zip(lower[::-1], upper[::-1], strict=True))] = True
    occupied &= keep
    grid = medium = Grid(SHAPE, np.eye(4))
    density = np.where(occupied, 40.0, 0)
    if detailed:
        medium = Grid((13, 7, 16), np.eye(4))
        coarse = np.add.reduceat(density, np.arange(0, 26, 2), axis=0)
        coarse = np.add.reduceat(coarse, np.arange(0, 21, 3), axis=1)
        density = np.add.reduceat(coarse, np.arange(0, 32, 2), axis=2)
        # A track depends on a value as far as the value's neighbours, through interpolation.
        seen = np.kron(density > 0, np.ones((2, 3, 2))) > 0
        occupied = keep & (_dilated(seen, 3))
    else:
        occupied = keep & _dilated(occupied, 1)
    wanted = mi.UInt32(np.flatnonzero(occupied).tolist())
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    light, offsets = rng.random((12, 2)), rng.random((12, 2))
    sigma_t = mi.Float(density.ravel().tolist())
    lines = [Tracks(grid, sigma_t, lower, upper, medium, wanted, skip) for skip in (False, True)]
    values = [np.array(each.uncollided(directions, light, offsets)) for each in lines]
    assert values[0].max() > 2 * values[0].min()
    np.testing.assert_allclose(*values, rtol=1e-6)
    count = dr.width(wanted)
    for channels in (1, 3):
        phi, found = mi.Float(rng.random(count * channels).tolist()), []
        for each in lines:
            level = MultigridLevel(dr.full(mi.Float, 1, count), phi * 0.8, each)
            table = each.table(directions, light, np.full(12, 0.5), offsets)
            found.append([np.array(v) for v in level.sweep(phi, table)])
        for all_voxels, some in zip(*found, strict=True):
            # Antidiffusive fluxes make some values almost cancel.
            rounding = 1e-8 * np.abs(all_voxels).max()
            np.testing.assert_allclose(all_voxels, some, rtol=2e-6, atol=rounding)


def _dilated(mask: np.ndarray, by: int) -> np.ndarray:
    for axis in range(3):
        padded = np.pad(mask, [(by, by) if k == axis else (0, 0) for k in range(3)])
        views = np.lib.stride_tricks.sliding_window_view(padded, 2 * by + 1, axis)
        mask = views.any(axis=-1)
    return mask
