"""Compensation of the numerical diffusion of sources that are constant within voxels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.antidiffusion import (
    LARGEST_PART,
    Antidiffusion,
    coefficient,
)

pytestmark = pytest.mark.usefixtures("mono")

VOXELS = 6 * 5 * 4


def excess_displacement(depth: float) -> float:
    """Return half of what tracks add to the mean square displacement per flight along an axis.

    Flights begin at random positions of a track within a slice, and end in another slice or the
    same one; across the track, voxels change where its middle of a slice lies in the next one.
    """
    i = np.arange(4000) + 0.5
    z, angle = 1 - i / 2000, np.pi * (1 + 5**0.5) * i
    directions = np.stack(
        [np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z]
    )
    dominant, *across = -np.sort(-np.abs(directions), axis=0)
    per_slice = depth / dominant
    slices = np.arange(1, 2000)[:, None]
    probability = (1 - np.exp(-per_slice)) ** 2 / per_slice * np.exp(-per_slice * (slices - 1))
    square = (probability * slices**2).sum(axis=0)
    for component in across:
        moved = component / dominant * slices
        part = moved % 1
        square += (probability * (moved**2 + part * (1 - part))).sum(axis=0)
    return (square.mean() / 3 - 2 / (3 * depth**2)) / 2


@pytest.mark.parametrize("depth", [0.1, 0.4, 1.0, 1.5])
def test_coefficient_is_the_excess_displacement_along_tracks(depth):
    assert coefficient(mi.Float(depth))[0] == pytest.approx(excess_displacement(depth), rel=0.02)


@pytest.mark.parametrize("depth", [2.5, 4.0, 16.0, 100.0])
def test_most_of_the_displacement_remains_in_opaque_voxels(depth):
    half = 1 / (3 * depth**2) + excess_displacement(depth)
    assert 0 < coefficient(mi.Float(depth))[0] < 1.05 * LARGEST_PART * half


def compensation(active: np.ndarray, sigma_t: np.ndarray) -> Antidiffusion:
    grid = Grid((4, 5, 6), np.diag([3.0, 2.5, 4.0, 1.0]))
    indices = dr.full(mi.UInt32, len(active), VOXELS)
    dr.scatter(indices, dr.arange(mi.UInt32, len(active)), mi.UInt32(active))
    return Antidiffusion(
        grid, mi.Float(sigma_t), mi.UInt32(active),
        lambda voxel: dr.gather(mi.UInt32, indices, voxel),
    )  # fmt: skip


def test_energy_is_preserved_and_channels_and_moments_are_separate():
    rng = np.random.default_rng(7)
    active = np.sort(rng.choice(VOXELS, 90, replace=False))
    sigma_t = rng.random(90) * 10.0 ** rng.integers(-2, 2, 90)
    sigma_t[::9] = 0
    source = rng.random((3, 90, 2))  # moment, voxel, channel

    own = compensation(active, sigma_t)
    moment, rest = np.divmod(np.arange(source.size), 180)
    begin = mi.UInt32(moment * 180 + rest % 2)
    found = own.applied(mi.Float(source.ravel()), mi.UInt32(rest // 2), 2, begin)
    found = np.array(found).reshape(source.shape)

    assert np.abs(found - source).max() > 0.1
    weights = sigma_t[:, None]
    before, after = (weights * source).sum(axis=1), (weights * found).sum(axis=1)
    np.testing.assert_allclose(after, before, rtol=1e-5)
    each = dr.arange(mi.UInt32, 90)
    for m, c in np.ndindex(3, 2):
        single = own.applied(mi.Float(source[m, :, c].copy()), each)
        np.testing.assert_allclose(np.array(single), found[m, :, c], rtol=1e-4, atol=1e-5)


def test_even_sources_are_unchanged_and_thin_voxels_need_nothing():
    every, sigma_t = np.arange(VOXELS), np.random.default_rng(3).random(VOXELS)
    each = dr.arange(mi.UInt32, VOXELS)
    even = compensation(every, sigma_t)
    assert even.is_needed
    np.testing.assert_allclose(np.array(even.applied(dr.full(mi.Float, 2, VOXELS), each)), 2)
    assert not compensation(every, 0.02 * sigma_t).is_needed
