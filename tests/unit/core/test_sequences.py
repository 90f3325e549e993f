"""Low-discrepancy points cover their domain evenly, and random streams differ between lanes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.sequences import (
    GENERALISED_GOLDEN_RATIOS,
    GOLDEN_STEP,
    fibonacci_direction,
    fibonacci_hemisphere,
    golden_words,
    hashed_seed,
    kronecker,
    kronecker_points,
    kronecker_steps,
    kronecker_words,
    lattice_points,
    random_stream,
    unit_floats,
)

pytestmark = pytest.mark.usefixtures("rgb")

COUNT = 1 << 12


def occupied(points: np.ndarray, cells: int) -> np.ndarray:
    """How many of the points (dimension, n) lie in each of cells^dimension equal cells."""
    number = np.zeros(points.shape[1], int)
    for row in points:
        number = number * cells + np.floor(row * cells).astype(int)
    return np.bincount(number, minlength=cells ** len(points))


@pytest.mark.parametrize("dimension", GENERALISED_GOLDEN_RATIOS)
def test_the_ratio_is_the_root(dimension):
    """x^(d+1) = x + 1: a digit that is wrong makes sequences of lower quality, and no error."""
    ratio = GENERALISED_GOLDEN_RATIOS[dimension]
    assert ratio ** (dimension + 1) == pytest.approx(ratio + 1, rel=1e-15)
    assert 1 / GENERALISED_GOLDEN_RATIOS[1] == pytest.approx(GOLDEN_STEP, rel=1e-15)


@pytest.mark.parametrize("dimension", [1, 2, 3, 4])
def test_kronecker_points_are_even(dimension):
    """Counts in cells differ from their mean by much less than those of random points."""
    index = dr.arange(mi.UInt32, COUNT)
    shift = [mi.Float(0.3)] * dimension
    points = np.array(kronecker(index, dimension, shift), np.float64).reshape(dimension, -1)
    assert points.min() >= 0 and points.max() < 1
    cells = {1: 256, 2: 16, 3: 6, 4: 4}[dimension]
    counts = occupied(points, cells)
    assert counts.var() < 0.35 * counts.mean()  # random points: 1 times
    alone = np.array(kronecker(index, dimension), np.float64).reshape(dimension, -1)
    # In single precision, products of index and step are rounded to 2^-12 at most.
    np.testing.assert_allclose((points - alone + 0.2) % 1, 0.5, atol=1e-3)
    exact = kronecker_points(np.arange(COUNT), dimension)
    np.testing.assert_allclose((alone - exact + 0.5) % 1, 0.5, atol=1e-3)


def test_words_are_the_same_sequence():
    """Fixed-point coordinates are those of float64, for indices beyond single precision, too."""
    index = np.array([0, 1, 1000, 1 << 26])
    words = kronecker_words(mi.UInt32(index), [mi.UInt32(5 << 28), mi.UInt32(0)])
    found = np.array(unit_floats(words), np.float64)
    steps = [round(step * 2**32) / 2**32 for step in kronecker_steps(2)]
    expected = [(index * steps[0] + 5 / 16) % 1, index * steps[1] % 1]
    np.testing.assert_allclose(found, expected, atol=2**-23)
    golden = np.array(golden_words(mi.UInt32(index), 1 << 31), np.float64) / 2**32
    step = int(GOLDEN_STEP * 2**32) / 2**32
    np.testing.assert_allclose(golden, (index * step + 0.5) % 1, atol=1e-9)


@pytest.mark.parametrize("dimension", [1, 2])
def test_lattices_are_even(dimension):
    points = lattice_points(COUNT, kronecker_steps(dimension)[0])
    counts = occupied(points, 16)
    assert counts.var() < 0.35 * counts.mean()
    assert (occupied(points[:1], COUNT) == 1).all()


def test_spirals_integrate_polynomials():
    """Unit vectors whose means are those of the sphere, or half of it."""
    count = 500
    around = fibonacci_direction(dr.arange(mi.UInt32, count), count, azimuth=0.4)
    half, turn = fibonacci_hemisphere(count)
    around = np.array(around, np.float64).T
    for directions, mean in ((around, 0.0), (half, 0.5)):
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
        np.testing.assert_allclose(directions.mean(axis=0), [0, 0, mean], atol=5e-3)
        np.testing.assert_allclose((directions**2).mean(axis=0), [1 / 3] * 3, atol=5e-3)
    assert (half[:, 2] > 0).all()
    angle = np.arctan2(half[:, 1], half[:, 0]) / (2 * np.pi)
    np.testing.assert_allclose((angle - turn + 0.5) % 1, 0.5, atol=1e-9)


@pytest.mark.parametrize("sequence", [None, 7])
def test_streams_differ_between_lanes_and_seeds(sequence):
    """No lane repeats the numbers of another, whatever changes: the lane or a part of the seed."""
    lanes = dr.arange(mi.UInt32, 64)
    drawn = []
    for seed in ((0, 0), (0, 1), (1, 0)):
        words = mi.sample_tea_32(lanes, hashed_seed(seed)[0])
        drawn += np.array(random_stream(words, sequence).next_uint32()).tolist()
    assert len(set(drawn)) == len(drawn)
    values = np.array(drawn) / 2**32
    assert abs(values.mean() - 0.5) < 4 * np.sqrt(1 / 12 / len(drawn))
