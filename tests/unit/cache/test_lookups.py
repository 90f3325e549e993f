"""Lookups in a cache have the irradiance of its voxels."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.grids.grid import Grid

pytestmark = pytest.mark.usefixtures("rgb")

SIDE, POINTS = 12, 6


@pytest.mark.parametrize("kind", ["correlated", "noisy"])
def test_a_field_with_a_sharp_end_is_conserved(kind):
    """The mean over a field that is 0 outside of a slab is that of its voxels; plainly interpolated
    square roots lose a sixth of a voxel at either end, 8 % in all.

    Voxels with errors of their own are conserved where these are large, see `share_of_noise`.
    """
    grid, voxels = Grid((SIDE,) * 3, np.eye(4)), mi.UInt32(np.arange(SIDE**3, dtype=np.uint32))
    phi = np.zeros((SIDE,) * 3)
    phi[4:8] = 1
    cache = IrradianceCache(grid, voxels, 1, -1, correlated=kind == "correlated")
    values = cache.real(2 * phi.ravel())  # of two batches; a relative variance of 1
    cache.add(0, 2 * BATCH, [((values, None), (values,))])
    along = 1.5 + (np.arange(POINTS * (SIDE - 3)) + 0.5) / POINTS
    u = np.stack(np.meshgrid(along, along, along)).reshape(3, -1) / SIDE
    found = float(np.array(cache.field().at_world(mi.Point3f(np.float32(u))), np.float64).mean())
    assert found == pytest.approx(4 / (SIDE - 3), rel=0.02)


@pytest.mark.parametrize("correlated", [True, False])
def test_errors_of_voxels_do_not_bias_lookups(correlated):
    """Errors that differ between neighbours do not change the mean of any channel up to the faces
    of the grid, with relative variances of 0.06, 0 and 0.02; if the variance is neglected, the mean
    is 0.8 % too large, because extrapolation to the faces is not linear.
    """
    shape, variances, scales = (72, 72, 4), (0.06, 0.0, 0.02), (1.0, 30.0, 1e-3)
    count = int(np.prod(shape))
    grid, voxels = Grid(shape, np.eye(4)), mi.UInt32(np.arange(count, dtype=np.uint32))
    rng = np.random.default_rng(2)
    phi = [
        s * (rng.gamma(1 / v, v, count) if v else 1) for v, s in zip(variances, scales, strict=True)
    ]
    phi = [np.broadcast_to(values, count) for values in phi]
    squares = [v * s**2 for v, s in zip(variances, scales, strict=True)]
    cache = IrradianceCache(grid, voxels, 3, -1, correlated=correlated)
    totals = tuple(cache.real(2 * values) for values in phi)  # of two batches
    spreads = tuple(cache.real(np.full(count, 2 * square)) for square in squares)
    own = [mi.Float(np.full(count, 4 * square)) for square in squares]
    blocks = [((*totals, None, None, None), 3 * (None,) if correlated else spreads)]
    cache.add(0, 2 * BATCH, blocks, own if correlated else None)
    points = ((np.arange(3 * n) + 0.5) / (3 * n) for n in shape[::-1])
    u = np.stack(np.meshgrid(*points)).reshape(3, -1)
    found = np.array(cache.field().at_world(mi.Point3f(np.float32(u))), np.float64).mean(axis=1)
    assert found == pytest.approx([values.mean() for values in phi], rel=0.003)
