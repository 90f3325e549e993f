"""The same scene again, by other numbers of threads, and in other pieces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.stability.worlds import Matter, blob, scene
from mitsuba_irrcache.solvers import path

pytestmark = pytest.mark.usefixtures("rgb")


def look(solver: str, **settings) -> tuple[np.ndarray, np.ndarray]:
    """Image and irradiance of a cloud."""
    integrator = {"solver": solver, "resolution": 12, "cache_spp": 64} | settings
    built = scene(integrator, Matter(blob(12, 6.0), 0.9, turn=20))
    image = np.array(mi.render(built, spp=16, seed=5))
    return image, np.array(built.integrator().cache.irradiance)


@pytest.fixture
def threads():
    """The number of threads; it is restored."""
    count = dr.thread_count()
    yield count
    dr.set_thread_count(count)


def assert_same(solver: str, found: tuple, expected: tuple) -> None:
    """``path``: the same bits. ``sweep``, whose lines add up in no fixed order in grids of up to
    40^3 voxels: within 1e-6 of the brightest (measured: 2e-7).
    """
    for ours, theirs in zip(found, expected, strict=True):
        tolerance = 0 if solver == "path" else 1e-6 * np.abs(theirs).max()
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance)


@pytest.mark.parametrize("solver", ["path", "sweep"])
def test_again_and_by_other_threads(solver, threads):
    expected = look(solver)
    assert_same(solver, look(solver), expected)
    for count in (1, 7):
        dr.set_thread_count(count)
        assert_same(solver, look(solver), expected)


def test_in_other_passes(monkeypatch):
    """A cache in blocks of voxels, and in passes of fewer samples: the same bits, since sums are in
    double precision.
    """
    expected = look("path")
    monkeypatch.setattr(path, "LANES", 1 << 12)
    assert_same("path", look("path"), expected)


def test_another_seed_is_another_picture():
    """Else the tests above would say nothing."""
    for solver in ("path", "sweep"):
        (image, phi), (other, other_phi) = look(solver), look(solver, cache_seed=1)
        assert np.abs(image - other).max() > 1e-4 and np.abs(phi - other_phi).max() > 1e-3
