"""Errors of lookups for voxel errors that are fully correlated, and near point lights."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.interpolation import PLAIN, Interpolation
from mitsuba_irrcache.cache.uncertainty import PROBES, uncertainty_of
from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.falloff import InverseSquareFactor

pytestmark = pytest.mark.usefixtures("rgb")

SIDE = 8
#: Between voxel centres, in the corner of a voxel, and at a centre.
LAMPS = [(0.53, 0.41, 0.62), (0.5, 0.5, 0.5), (0.4375, 0.5625, 0.4375)]


def cache_of(
    light: np.ndarray, error: np.ndarray, correlated: bool, interpolation: Interpolation = PLAIN
) -> IrradianceCache:
    """Return a grey cache of two batches with mean ``light`` and this standard error."""
    grid, voxels = Grid((SIDE,) * 3, np.eye(4)), mi.UInt32(np.arange(SIDE**3, dtype=np.uint32))
    cache = IrradianceCache(grid, voxels, 1, -1, correlated=correlated, interpolation=interpolation)
    total, spread = cache.real(2 * light), cache.real(2 * error**2)
    cache.add(0, 2 * BATCH, [((total, None), (spread,))])
    return cache


def lookups(cache: IrradianceCache, inside: float) -> tuple[np.ndarray, np.ndarray]:
    """Return irradiance and relative errors (probe, n) at random points.

    The points are at least ``inside`` away from the faces.
    """
    places = np.random.default_rng(2).uniform(inside, 1 - inside, (3, 4000))
    p = mi.Point3f(np.float32(places))
    phi = cache.field().at_world(p)
    *probes, _ = uncertainty_of(cache).at_world(p, phi, mi.Bool(True))
    assert len(probes) == PROBES
    return np.array(phi, dtype=np.float64), np.array([np.array(e) for e in probes], np.float64)


def test_common_errors_of_voxels_do_not_average_out():
    """An error of 3 % common to all voxels is an error of 3 % in every lookup and probe.

    For independent voxels it would be half of that in the middle of eight.
    """
    light = np.full(SIDE**3, 2.0)
    _, shared = lookups(cache_of(light, 0.03 * light, correlated=True), 0.1)
    np.testing.assert_allclose(shared, 0.03, rtol=1e-3)
    _, own = lookups(cache_of(light, 0.03 * light, correlated=False), 0.1)
    assert (own < 0).any() and np.abs(own).min() < 0.015


@pytest.mark.parametrize("lamp", LAMPS, ids=str)
@pytest.mark.parametrize("correlated", [True, False])
def test_errors_near_a_point_light_are_relative_to_its_irradiance(lamp, correlated):
    """Errors near a point light are relative to its irradiance.

    With the inverse-square field 3 % too large in every voxel, no lookup is off by more, and those
    at which all signs agree are off by just that, near and far.
    """
    scene = {"type": "scene", "lamp": {"type": "point", "position": list(lamp), "intensity": 3.0}}
    falloff = InverseSquareFactor.of(mi.load_dict(scene), Grid((SIDE,) * 3, np.eye(4)))
    index = mi.UInt32(np.arange(SIDE**3, dtype=np.uint32))
    light = np.array(falloff.of_voxels(index), dtype=np.float64)
    assert light.max() > 20 * light.min()
    cache = cache_of(light, 0.03 * light, correlated, Interpolation(falloff=falloff))
    found = np.abs(lookups(cache, 0.5 / SIDE)[1])
    if correlated:
        np.testing.assert_allclose(found, 0.03, rtol=2e-3)
    else:
        assert found.max() == pytest.approx(0.03, rel=0.01)
        assert 0.5 < np.sqrt((found**2).mean()) / (0.03 * (2 / 3) ** 1.5) < 1.5
