"""The maximum of a cache, by which rays are terminated, bounds every lookup."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.interpolation import Interpolation
from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.falloff import InverseSquareFactor

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize("correlated", [True, False])
@pytest.mark.parametrize("lamp", [(0.5, 0.5, 0.5), (0.47, 0.62, 0.5)], ids=str)
def test_maximum_bounds_all_lookups(lamp, correlated):
    """The maximum bounds lookups next to a light in the medium, and the cached values."""
    grid, voxels = Grid((8, 8, 8), np.eye(4)), mi.UInt32(np.arange(512, dtype=np.uint32))
    light = {"type": "point", "position": list(lamp), "intensity": 3.0}
    falloff = InverseSquareFactor.of(mi.load_dict({"type": "scene", "lamp": light}), grid)
    interpolation = Interpolation(falloff=falloff)
    cache = IrradianceCache(grid, voxels, 1, -1, correlated=correlated, interpolation=interpolation)
    places = cache.falloff.sample_points.of(voxels)
    way = np.array(places, np.float64) - np.array(lamp)[:, None]
    phi = 3 / np.sum(way**2, axis=0)
    cache.add(0, 2 * BATCH, [((cache.real(2 * phi), None), (cache.real(0 * phi),))])
    field = cache.field()
    found = np.array(field.at_world(places) * cache.falloff.at(places), np.float64)
    np.testing.assert_allclose(found, phi, rtol=0.35)
    assert field.maximum >= 0.999 * found.max()
