"""Conservative roots at every voxel of a grid, at its sides and beside unknown voxels."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.conservative import conserving
from mitsuba_irrcache.grids.grid import Grid

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (6, 5, 7)
RNG = np.random.default_rng(11)
LIGHT = RNG.uniform(0.1, 4.0, SHAPE)
KNOWN = RNG.random(SHAPE) < 0.8


def conservative_roots(light: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the roots of ``light``, both (z, y, x)."""
    roots = mi.Float(np.float32(np.sqrt(light)).ravel())
    found = conserving(Grid(light.shape, np.eye(4)), roots, mi.Bool(known.ravel()))
    return np.array(found).reshape(light.shape)


@pytest.mark.parametrize("axis", range(3))
def test_mirrored_field_has_mirrored_roots(axis):
    """Mirrored fields have mirrored roots."""
    mirrored = conservative_roots(np.flip(LIGHT, axis), np.flip(KNOWN, axis))
    np.testing.assert_allclose(mirrored, np.flip(conservative_roots(LIGHT, KNOWN), axis), rtol=1e-5)


def test_unknown_values_do_not_affect_known_ones():
    """Values at unknown voxels do not affect the roots at others."""
    results = [
        conservative_roots(np.where(KNOWN, LIGHT, other), KNOWN)[KNOWN] for other in (0.0, 1.0, 1e4)
    ]
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("count", "lit"), [(3, 1), (5, 1), (5, 3), (4, 2)])
def test_single_voxel_of_a_row_is_conserved(axis, count, lit):
    """The integral of a single nonzero voxel in a row is conserved.

    Interpolated roots rise and fall linearly between this voxel and its zero neighbours, so their
    square has the integral r^2 (1/3 + 1/3). This must equal the voxel's value, also next to the
    last voxel of either end.
    """
    shape = np.ones(3, int)
    shape[2 - axis] = count
    light = np.zeros(count)
    light[lit] = 2.5
    roots = conservative_roots(light.reshape(shape), np.ones(shape, bool)).ravel()
    assert np.flatnonzero(roots).tolist() == [lit]
    assert 2 / 3 * roots[lit] ** 2 == pytest.approx(2.5, rel=1e-5)
