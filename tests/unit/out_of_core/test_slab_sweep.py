"""Sweeps slab by slab find what a sweep of the whole volume in memory finds."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.out_of_core import slab_sweep
from mitsuba_irrcache.out_of_core.slab_sweep import SlabSweep
from mitsuba_irrcache.out_of_core.slabs import symmetric_slabs
from mitsuba_irrcache.out_of_core.survey import MappedField
from mitsuba_irrcache.out_of_core.volume_files import VolumeFile
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import joint_ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Above `tracks.SMALL_GRID` voxels, so that the sweep in memory adds pair after pair, too.
SHAPE, SCALE = (41, 45, 38), 6.0
#: Sums of 12 pairs in single precision, in another order.
ROUNDING = 1e-6


@pytest.fixture
def medium(rgb, tmp_path):
    """A noisy volume in a file, in memory, and its grid, whose voxels are not cubes."""
    values = np.random.default_rng(1).random(SHAPE, dtype=np.float32)
    np.save(tmp_path / "density.npy", values)
    grid = Grid(SHAPE, np.diag([1.0, 1.2, 0.9, 1.0]))
    return MappedField(VolumeFile(tmp_path / "density.npy"), grid, SCALE, "density"), values


def in_memory(medium, ordinates):
    field, values = medium
    sigma_t = mi.Float(values.ravel()) * field.scale
    tracks = Tracks(field.grid, sigma_t, np.zeros(3, int), field.grid.resolution)
    return np.array(tracks.uncollided(*ordinates)).reshape(-1, *SHAPE).transpose(1, 2, 3, 0)


def by_slabs(medium, ordinates, folder, memory):
    sweep = SlabSweep(medium[0], folder, memory)
    irradiance = sweep.uncollided(*ordinates)
    found = irradiance.read((0, 0, 0), SHAPE).reshape(*SHAPE, -1)
    irradiance.close()
    sweep.close()
    return found


def ordinates_of(pairs, channels):
    rng = np.random.default_rng(2)
    directions, _ = joint_ordinates(1, pairs, rng)[0]
    return directions, rng.random((pairs, 2, channels)), rng.random((pairs, 2))


@pytest.mark.parametrize("most", [5, 64])
@pytest.mark.parametrize("channels", [1, 3])
def test_slabs_find_the_irradiance_of_a_sweep_in_memory(
    medium, tmp_path, monkeypatch, most, channels
):
    monkeypatch.setattr(slab_sweep, "MOST_SLICES", most)
    ordinates = ordinates_of(12, channels)
    whole = in_memory(medium, ordinates)
    parts = by_slabs(medium, ordinates, tmp_path, memory=1 << 32)
    if most > max(SHAPE):  # one slab
        np.testing.assert_array_equal(parts, whole)
    np.testing.assert_allclose(parts, whole, rtol=ROUNDING)


def test_suns_are_the_same_to_the_last_bit(medium, tmp_path, monkeypatch):
    monkeypatch.setattr(slab_sweep, "MOST_SLICES", 6)
    _, incoming, offsets = ordinates_of(4, 1)
    incoming[:, 1] = 0
    direction = np.array([0.4, -0.7, 0.59])
    ordinates = np.tile(direction / np.linalg.norm(direction), (4, 1)), incoming, offsets
    parts = by_slabs(medium, ordinates, tmp_path, memory=1 << 32)
    np.testing.assert_array_equal(parts, in_memory(medium, ordinates))


def test_in_little_memory_pairs_are_swept_one_by_one_as_in_memory(medium, tmp_path):
    ordinates = ordinates_of(4, 1)
    parts = by_slabs(medium, ordinates, tmp_path, memory=1 << 10)
    np.testing.assert_array_equal(parts, in_memory(medium, ordinates))


@pytest.mark.parametrize("slices", [1, 2, 7, 12, 41, 64])
@pytest.mark.parametrize("most", [1, 2, 3, 5, 64])
def test_slabs_are_symmetric_and_cover_all_slices(slices, most):
    slabs = symmetric_slabs(slices, most)
    assert [i for first, end in slabs for i in range(first, end)] == list(range(slices))
    sizes = [end - first for first, end in slabs]
    assert sizes == sizes[::-1]
    assert max(sizes) <= most
