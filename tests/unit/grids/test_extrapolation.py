"""Extrapolation of square roots beyond the faces of a grid."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import STEEPER, Extension, extrapolated

pytestmark = pytest.mark.usefixtures("mono")

DECAY = np.exp(-np.arange(6))  # a factor of e per voxel: less than the largest ratio


def beyond(row: np.ndarray, separated_after: int | None = None, noise: float | None = None):
    """Return the root beyond the first voxel of a ``row`` along x.

    A surface lies behind the voxel ``separated_after``; ``noise`` is the relative variance.
    """
    grid = Grid((1, 1, len(row)), np.eye(4))
    separated = None
    if separated_after is not None:
        nowhere = dr.zeros(mi.Bool, len(row))
        along_x = np.arange(len(row)) == separated_after
        separated = (mi.Bool(along_x), nowhere, nowhere)
    variance = None if noise is None else dr.full(mi.Float, noise, len(row))
    found = extrapolated(Extension(grid), mi.Float(np.float32(row)), 1, variance, None, separated)
    return np.array(found).reshape(3, 3, -1)[1, 1, 0]


@pytest.mark.parametrize("row", [DECAY, np.ones(6), DECAY[::-1], DECAY[:2], np.linspace(1, 2, 6)])
def test_smooth_decay_is_continued(row):
    assert beyond(row) == pytest.approx(row[0] ** 2 / row[1], rel=1e-6)


@pytest.mark.parametrize("level", [0.3, 1e-3])
def test_the_edge_of_a_shadow_is_not_continued(level):
    """One jump between otherwise equal values is that of a shadow, not a decay in the medium."""
    row = np.array([1.0, *[level] * 5])
    assert beyond(row) == pytest.approx(STEEPER, rel=1e-6)


def test_noise_does_not_limit_extrapolation():
    """The limit on noisy values is wider, else the mean of extrapolated values would decrease."""
    row = np.array([1.3, *[1.0] * 5])
    assert beyond(row) == pytest.approx(1.3 * STEEPER, rel=1e-6)
    variance = 0.01
    assert beyond(row, noise=variance) == pytest.approx(1.3**2 * (1 - 0.72 * variance), rel=1e-6)


@pytest.mark.parametrize("row", [DECAY, DECAY[::-1]])
def test_surfaces_end_extrapolation(row):
    """Values behind a surface are not continued, whether they are larger or smaller."""
    assert beyond(row, separated_after=0) == pytest.approx(row[0], rel=1e-6)
    assert beyond(row, separated_after=3) == pytest.approx(row[0] ** 2 / row[1], rel=1e-6)


def test_values_behind_a_surface_do_not_justify_a_steep_decay():
    assert beyond(DECAY, separated_after=1) == pytest.approx(STEEPER, rel=1e-6)
