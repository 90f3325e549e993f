"""Determinism: identical results in other processes, with other thread counts and pass sizes."""

from __future__ import annotations

import multiprocessing
from functools import cache, partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.robustness.stability.worlds import WHITE_SKY, Camera, Matter, World, blob, scene
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import SMALL_GRID
from mitsuba_irrcache.solvers.path import solver as path_solver

pytestmark = pytest.mark.usefixtures("rgb")

#: A sweep of all orders in one launch; one launch per pair of directions for one order of
#: scattering; and paths.
KINDS = {
    "sweep": {"solver": "sweep", "resolution": 24},
    "large sweep": {"solver": "sweep", "resolution": 42, "cache_spp": 32, "max_depth": 3},
    "single sweep": {"solver": "sweep", "resolution": 24, "max_depth": 2},
    "path": {"solver": "path", "resolution": 12},
}
assert 24**3 < SMALL_GRID < 42**3


def look(kind: str, **settings) -> tuple[np.ndarray, np.ndarray]:
    """Return image and irradiance of a cloud."""
    integrator = {"cache_spp": 64} | KINDS[kind] | settings
    built = scene(integrator, Matter(blob(12, 6.0), 0.9, turn=20))
    return seen(built)


@cache
def once(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the result with which others are compared."""
    return look(kind)


def seen(built: mi.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return image and irradiance of any scene."""
    image = np.array(mi.render(built, spp=16, seed=5))
    return image, np.array(built.integrator().cache.irradiance)


@pytest.fixture
def threads():
    """Set the number of threads, and restore it."""
    count = dr.thread_count()
    yield count
    dr.set_thread_count(count)


def assert_same(found: tuple, expected: tuple) -> None:
    """Assert that arrays are equal bit by bit."""
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("kind", KINDS)
def test_repeated_and_with_other_thread_counts(kind, threads):
    for count in (threads, 7):
        dr.set_thread_count(count)
        assert_same(look(kind), once(kind))


def test_with_surfaces(threads):
    """`sweep` with surfaces is deterministic: along tracks and for emitters sampled at voxels."""

    def again() -> tuple[np.ndarray, np.ndarray]:
        place = mi.ScalarTransform4f().translate
        ground = {"type": "rectangle", "to_world": place([0, -1.6, 0]).rotate([1, 0, 0], -90)}
        lamp = {"type": "sphere", "center": [0, 3, 0], "radius": 0.2}
        parts = {
            "integrator": {
                "type": "irrcache",
                "solver": "sweep",
                "resolution": 12,
                "cache_spp": 32,
            },
            "sensor": Camera().description(World()),
            "matter": Matter(blob(12, 6.0), 0.9).description(World()),
            "ground": ground | {"bsdf": {"type": "diffuse"}},
            "lamp": lamp | {"emitter": {"type": "area", "radiance": 5.0}},
            "sky": WHITE_SKY,
        }
        return seen(mi.load_dict({"type": "scene"} | parts))

    expected = again()
    dr.set_thread_count(7)
    assert_same(again(), expected)


def test_with_error_bars_and_filter(threads):
    settings = {"filter": "bilateral", "aovs": "noise,bias"}
    expected = look("sweep", **settings)
    assert expected[0].shape[-1] > 4
    dr.set_thread_count(7)
    assert_same(look("sweep", **settings), expected)


@pytest.mark.parametrize("name", ["box", "gaussian", "lanczos"])
def test_films(name, threads):
    """Films are deterministic with five samples per pixel, where thread blocks end within
    pixels.
    """
    film = {"width": 250, "height": 250, "rfilter": {"type": name}}
    settings = {"type": "irrcache", "solver": "sweep", "resolution": 4, "cache_spp": 32}
    built = scene(settings, Matter(), camera=Camera(film=film))
    expected = scene_image(built)
    for count in (threads, 7):
        dr.set_thread_count(count)
        np.testing.assert_array_equal(scene_image(built), expected)


def scene_image(built: mi.Scene) -> np.ndarray:
    return np.array(mi.render(built, spp=5, seed=5))


def _look_elsewhere(variant: str, kind: str) -> tuple[np.ndarray, np.ndarray]:
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    return look(kind)


def test_in_another_process():
    elsewhere = partial(_look_elsewhere, mi.variant())
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for kind, found in zip(KINDS, pool.map(elsewhere, KINDS), strict=True):
            assert_same(found, once(kind))


def test_in_other_passes(monkeypatch):
    """Splitting a cache build into blocks of voxels or smaller passes does not change a bit.

    The sums are accumulated in double precision.
    """
    expected = once("path")
    monkeypatch.setattr(path_solver, "LANES", 1 << 12)
    assert_same(look("path"), expected)


def test_another_seed_is_another_picture():
    """Another seed gives another image; otherwise the tests above would prove nothing."""
    for kind in KINDS:
        (image, phi), (other, other_phi) = once(kind), look(kind, cache_seed=1)
        assert np.abs(image - other).max() > 1e-4 and np.abs(phi - other_phi).max() > 1e-3
