"""Transposes of interpolation are exact, and their bits do not depend on the order of additions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.splatting import (
    SLOTS,
    ConstantSplat,
    FixedPointSums,
    GridSplat,
    VoxelSums,
)
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from tests.support.scenes import placement

pytestmark = pytest.mark.usefixtures("rgb")

POINTS = 5000


def points(grid: Grid, rng: np.random.Generator, beyond: float = 0.1) -> mi.Point3f:
    """World positions in a grid and a little beyond it."""
    u = rng.uniform(-beyond, 1 + beyond, (3, POINTS)) * grid.resolution[:, None]
    return grid.world.point(mi.Point3f(u.astype(np.float32)))


@pytest.mark.parametrize("channels", [1, 3])
def test_grid_splat_is_the_transpose_of_a_lookup(channels):
    rng = np.random.default_rng(1)
    grid = Grid((5, 7, 4), placement((1.0, 2.0, 3.0), turn=40.0))
    data = rng.normal(size=grid.voxel_count * channels).astype(np.float32)
    weights = rng.normal(size=(channels, POINTS)).astype(np.float32)
    p = points(grid, rng)
    found = np.array(GridField(grid, mi.Float(data), channels).at_world(p), dtype=np.float64)
    splat = GridSplat(grid, channels, float(np.abs(weights).sum()))
    splat.add(p, [mi.Float(w) for w in weights], mi.Bool(True))
    transposed = np.array(splat.values(), dtype=np.float64)
    expected = (found.reshape(channels, -1) * weights).sum()
    scale = np.abs(found.reshape(channels, -1) * weights).sum()
    assert transposed @ data == pytest.approx(expected, abs=1e-6 * scale)


def test_sums_do_not_depend_on_the_order():
    rng = np.random.default_rng(2)
    index, value = (
        rng.integers(0, 20, POINTS),
        rng.normal(size=POINTS) * 10.0 ** rng.uniform(-6, 3, POINTS),
    )
    results = []
    for order in (np.arange(POINTS), rng.permutation(POINTS)):
        sums = FixedPointSums(20, float(np.abs(value).sum()))
        sums.add(mi.UInt32(index[order]), mi.Float(value[order]), mi.Bool(True))
        results.append(np.array(sums.values()))
    assert results[0].tobytes() == results[1].tobytes()
    exact = np.bincount(index, weights=value.astype(np.float32).astype(np.float64))
    np.testing.assert_allclose(results[0], exact, rtol=1e-6, atol=1e-9)


def test_inactive_lanes_add_nothing_and_a_bound_of_zero_is_allowed():
    sums = FixedPointSums(2, 0.0)
    sums.add(mi.UInt32(0, 1), mi.Float(3, 4), mi.Bool(False, True))
    assert np.array(sums.values()).tolist() == [0.0, 4.0]


def test_constant_splat_adds_all():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(3, POINTS)).astype(np.float32)
    splat = ConstantSplat(3, float(np.abs(values).sum()))
    p = points(Grid((2, 2, 2), placement()), rng)
    splat.add(p, [mi.Float(v) for v in values], mi.Bool(True))
    np.testing.assert_allclose(
        np.array(splat.values()), values.sum(axis=1, dtype=np.float64), rtol=1e-4, atol=1e-3
    )
    assert SLOTS & (SLOTS - 1) == 0


def test_voxel_sums_count_points_in_their_voxels():
    rng = np.random.default_rng(4)
    grid = Grid((3, 4, 5), placement((1.0, 2.0, 3.0), turn=20.0))
    p = points(grid, rng, beyond=0.0)
    sums = VoxelSums(grid, 2, 2.0 * POINTS)
    sums.add(p, [mi.Float(1), mi.Float(2)], mi.Bool(True))
    ones, twos = (np.array(v) for v in sums.values())
    u = np.array(grid.coordinates.point(p))
    place = np.clip(np.floor(u).astype(int), 0, grid.resolution[:, None] - 1)
    expected = np.bincount(
        np.ravel_multi_index(place[::-1], grid.shape), minlength=grid.voxel_count
    )
    np.testing.assert_array_equal(ones, expected)
    np.testing.assert_array_equal(twos, 2 * expected)
    assert dr.width(sums.values()[0]) == grid.voxel_count


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(value):
    """Fixed point would turn them into large numbers; those of inactive lanes do not matter."""
    grid = Grid((2, 2, 2), placement())
    p = mi.Point3f([0.1, 0.2], 0.0, 0.0)
    values = [mi.Float([1.0, value])]
    for kind in (GridSplat, VoxelSums):
        splat = kind(grid, 1, 4.0)
        splat.add(p, values, mi.Bool([True, False]))
        splat.values()
        splat.add(p, values, mi.Bool(True))
        with pytest.raises(IrrcacheError, match=r"not finite.*report"):
            splat.values()
