"""Crop, clip, resample and bake preserve positions, range and mean of the values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes import processing
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.transfer import DensityMapping, TransferFunction

TURN = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, -1.0]])
STEP = TransferFunction([99.9, 100.0], [0.0, 0.9], [0, 200], [[0.2] * 3, [0.8] * 3])


def volume(values: np.ndarray) -> VolumeData:
    return VolumeData(values, (0.5, 1.0, 3.0), (10.0, -5.0, 2.0), TURN)


def noise(shape=(8, 9, 10)) -> np.ndarray:
    return np.random.default_rng(5).uniform(0, 255, shape).astype(np.float32)


def linear_in_world(shape=(8, 9, 10)) -> VolumeData:
    """Return a volume whose values are an affine function of the world position."""
    placed = volume(np.zeros(shape))
    z, y, x = np.indices(shape)
    index = np.stack([x, y, z, np.ones_like(x)], axis=-1)
    world = index @ placed.index_to_world.T
    return volume((world @ (1.0, -2.0, 3.0, 7.0)).astype(np.float64))


def test_crop_preserves_world_positions():
    whole = linear_in_world()
    part = processing.crop(whole, [(2, 7), (None, 4), (3, None)])
    assert part.size == (5, 4, 5)
    world = part.index_to_world @ (0, 0, 0, 1)
    np.testing.assert_allclose(part.values[0, 0, 0], world @ (1, -2, 3, 7))


@pytest.mark.parametrize("bounds", [(3, 3), (5, 2), (0, 11), (-1, 4)])
def test_crop_outside_is_refused(bounds):
    with pytest.raises(IrrcacheError, match=r"along x.*0:10"):
        processing.crop(volume(noise()), [bounds, (None, None), (None, None)])


def test_clip_limits_every_type():
    for dtype in ("uint8", "int16", "float32"):
        values = np.array([[[0, 5, 50, 120]]], dtype=dtype)
        clipped = processing.clip(volume(values), 5, np.inf).values
        np.testing.assert_array_equal(clipped, [[[5, 5, 50, 120]]])
        assert clipped.dtype == dtype
    with pytest.raises(IrrcacheError, match="lower value first"):
        processing.clip(volume(noise()), 5, 5)


def test_rescale():
    values = processing.rescale(volume(np.array([[[0, 1000]]], dtype=np.uint16)), 2, -1000).values
    np.testing.assert_array_equal(values, [[[-1000, 1000]]])
    with pytest.raises(IrrcacheError, match="slope not 0"):
        processing.rescale(volume(noise()), 0, 1)


@pytest.mark.parametrize("size", [(5, 5, 4), (20, 27, 8), (7, 18, 3), (10, 9, 8)])
def test_resampling_preserves_an_affine_function(size):
    """Resampling preserves an affine function, except at the border, where it is clamped."""
    resampled = processing.resample(linear_in_world((24, 27, 30)), size)
    x, y, z = (n // 2 for n in size)
    world = resampled.index_to_world @ (x, y, z, 1)
    np.testing.assert_allclose(resampled.values[z, y, x], world @ (1, -2, 3, 7), atol=0.02)


@given(size=st.tuples(*[st.integers(1, 25)] * 3))
@settings(max_examples=30, deadline=None)
def test_resampling_stays_in_range_and_in_its_box(size):
    source = volume(noise())
    resampled = processing.resample(source, size)
    assert resampled.size == size
    np.testing.assert_allclose(resampled.to_world, source.to_world)
    margin = 1e-3
    assert source.values.min() - margin <= resampled.values.min()
    assert resampled.values.max() <= source.values.max() + margin


def test_downsampling_is_antialiased():
    """A checkerboard at the limit of resolution becomes grey, without a moire pattern."""
    board = (np.indices((24, 24, 24)).sum(axis=0) % 2).astype(np.float32)
    assert processing.resample(VolumeData(board), (8, 8, 8)).values.std() < 0.02


def test_same_size_changes_nothing():
    values = noise()
    np.testing.assert_allclose(
        processing.resample(volume(values), (10, 9, 8)).values, values, rtol=1e-6
    )


def test_sizes_give_near_cubic_voxels():
    source = VolumeData(noise((20, 30, 40)), (1.0, 1.0, 5.0))
    assert processing.size_for_longest(source, 50) == (20, 15, 50)
    assert processing.size_for_voxel(source, 2.0) == (20, 15, 50)
    for call in (processing.size_for_longest, processing.size_for_voxel):
        with pytest.raises(IrrcacheError, match="0"):
            call(source, 0)


def test_isolation_removes_the_table_and_preserves_the_lungs():
    chest = np.full((12, 40, 40), -1000, dtype=np.int16)
    chest[:, 5:25, 5:35] = 40
    chest[:, 10:20, 10:18] = -850
    chest[:, 32:36, 2:38] = 300
    chest[:, 25:32, 20] = 0
    isolated = processing.isolate(VolumeData(chest), -300).values
    np.testing.assert_array_equal(isolated[:, :25], chest[:, :25])
    assert (isolated[:, 29:] == -1000).all()
    with pytest.raises(IrrcacheError, match="lower threshold"):
        processing.isolate(VolumeData(chest), 5000)


def test_flip_mirrors_in_place():
    source = volume(noise())
    flipped = processing.flip(source, "xz")
    np.testing.assert_array_equal(flipped.values, source.values[::-1, :, ::-1])
    np.testing.assert_array_equal(flipped.to_world, source.to_world)


def test_supersampling_a_linear_mapping_preserves_its_mean():
    source = VolumeData(noise((6, 6, 6)))
    plain = processing.bake(source, DensityMapping(), source.size)[1]
    fine = processing.bake(source, DensityMapping(), source.size, supersample=4)[1]
    assert abs(fine.mean() / plain.mean() - 1) < 0.02


def test_supersampling_converges_to_the_exact_average():
    """With a ramp and a step transfer function, a voxel's extinction is its share above the
    step.
    """
    ramp = np.broadcast_to(np.arange(0.0, 200.0, 15.0), (3, 3, 14)).copy()
    source = VolumeData(ramp)
    crossing = 100.0 / 15.0 + 0.5  # in voxels from the face, so voxel 7 lies above by 0.83
    share = np.clip(np.arange(14) + 1 - crossing, 0, 1)
    opaque = -np.log(0.1)
    sigma_t = processing.bake(source, STEP, source.size, supersample=24)[1]
    np.testing.assert_allclose(sigma_t[1, 1] / opaque, share, atol=0.03)
    plain = processing.bake(source, STEP, source.size)[1]
    assert np.abs(plain[1, 1] / opaque - share).max() > 0.15


def test_averaged_albedo_is_weighted_by_extinction():
    """The albedo of a voxel of which only one side is occupied is that side's."""
    ramp = np.broadcast_to(np.arange(0.0, 200.0, 15.0), (3, 3, 14)).copy()
    albedo = processing.bake(VolumeData(ramp), STEP, (14, 3, 3), supersample=16)[2]
    assert (albedo <= 1).all()
    assert albedo[1, 1, 7, 0] > STEP.albedo(np.array([100.0]))[0, 0]


def test_bake_returns_the_resampled_grid():
    source = volume(noise())
    for size in [source.size, (5, 5, 4), (20, 20, 20)]:
        resampled, sigma_t, albedo = processing.bake(source, DensityMapping(), size, 2)
        assert resampled.size == size
        assert sigma_t.shape == resampled.values.shape and albedo.shape == (*sigma_t.shape, 3)
    with pytest.raises(IrrcacheError, match="supersample 0"):
        processing.bake(source, DensityMapping(), source.size, 0)


@pytest.mark.parametrize("supersample", [1, 10**20])
def test_grids_larger_than_memory_are_refused(supersample):
    """More voxels than fit in memory are refused before allocation, in bytes and with the
    remedy.

    Sizes of any number of digits are tested.
    """
    volume = VolumeData(np.ones((4, 4, 4), np.float32), (1.0, 1.0, 1.0))
    size = (4, 4, 4) if supersample > 1 else (10**6, 10**6, 10**6)
    with pytest.raises(IrrcacheError, match=r"needs \d+\.\d GiB, and \d+\.\d GiB are free; ask"):
        processing.bake(volume, DensityMapping(1.0), size, supersample)


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf, 5e-324])
def test_invalid_voxel_sizes_are_refused(size):
    volume = VolumeData(np.ones((4, 4, 4), np.float32), (1.0, 1.0, 1.0))
    with pytest.raises(IrrcacheError, match="give a positive length"):
        processing.size_for_voxel(volume, size)
