"""Interpolated fields."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.fields import ROUNDED, GridField, change_within
from mitsuba_irrcache.grids.grid import Grid

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize("channels", [1, 3])
def test_error_of_rounded_weights(channels):
    """The bound holds for weights of 8 bits, and is below a hundredth of the largest value."""
    rng = np.random.default_rng(3)
    shape = (5, 6, 7)
    # Steps of several orders of magnitude: relative to small values the error is large.
    data = 10.0 ** rng.uniform(-8, 1, (*shape, channels))
    field = GridField(Grid(shape, np.eye(4)), mi.Float(np.float32(data.ravel())), channels)
    u = rng.uniform(-0.5, 6.5, (3, 4000)).astype(np.float32)
    exact = np.atleast_2d(np.array(field.at(mi.Point3f(u))))
    rounded = np.atleast_2d(np.array(field.at(mi.Point3f(np.round(u * 256) / 256))))
    bound = np.atleast_2d(np.array(change_within(field, mi.Point3f(u), ROUNDED)))
    error = np.abs(rounded - exact)
    assert (error <= bound + 1e-6 * exact).all()
    assert bound.max() < 0.01 * data.max()
    assert (error > 0.05 * exact).any()
