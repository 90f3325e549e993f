"""Interpolated fields."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.fields import TEXTURE_UNIT_ERROR, GridField, range_around
from mitsuba_irrcache.grids.grid import Grid

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize("channels", [1, 3])
def test_error_of_rounded_weights(channels):
    """The bound of the error of texture units holds for weights of 8 bits."""
    rng = np.random.default_rng(3)
    shape = (5, 6, 7)
    # Steps of several orders of magnitude: relative to small values the error is large.
    data = 10.0 ** rng.uniform(-8, 1, (*shape, channels))
    field = GridField(Grid(shape, np.eye(4)), mi.Float(np.float32(data.ravel())), channels)
    u = rng.uniform(-0.5, 6.5, (3, 4000)).astype(np.float32)
    exact = np.atleast_2d(np.array(field.at(mi.Point3f(u))))
    rounded = np.atleast_2d(np.array(field.at(mi.Point3f(np.round(u * 256) / 256))))
    around = np.atleast_2d(np.array(range_around(field, mi.Point3f(u))))
    error = np.abs(rounded - exact)
    assert (error <= TEXTURE_UNIT_ERROR * around + 1e-6 * exact).all()
    assert (error > 0.05 * exact).any()


def test_range_of_the_voxels_around(scenes):
    values = scenes.texture((3, 4, 5), 0, 2, 1)
    field = GridField(Grid(values.shape, np.eye(4)), mi.Float(values.ravel()), 1)
    cell = values[0:2, 1:3, 3:5]
    found = range_around(field, mi.Point3f(3.7, 2.2, 1.4))
    np.testing.assert_allclose(found, np.ptp(cell), rtol=1e-6)
