"""Square-root fields whose interpolated square has the integral of the voxel values."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.conservative import conserving
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import RootField

pytestmark = pytest.mark.usefixtures("rgb")

SIDE = 20


@pytest.fixture
def grid(rgb) -> Grid:
    return Grid((SIDE,) * 3, np.diag([SIDE, SIDE, SIDE, 1.0]))


def conservative_roots(grid: Grid, phi: np.ndarray, known: np.ndarray | None = None) -> np.ndarray:
    """Return the conservative roots of ``phi`` (z, y, x, channel) at ``known`` (z, y, x) voxels."""
    roots = mi.Float(np.sqrt(phi).ravel().astype(np.float32))
    known = np.ones(phi.shape[:3], bool) if known is None else known
    result = conserving(grid, roots, mi.Bool(known.ravel()), phi.shape[-1])
    return np.array(result).reshape(phi.shape)


def mean_lookup(grid: Grid, roots: np.ndarray) -> float:
    """Return the mean of one channel at 6^3 points per cell, far from the border."""
    field = RootField(grid, mi.Float(roots.ravel()), 1)
    points = 1.5 + (np.arange(6 * (SIDE - 3)) + 0.5) / 6
    u = np.stack(np.meshgrid(points, points, points)).reshape(3, -1)
    return float(np.array(field.at(mi.Point3f(np.float32(u))), dtype=np.float64).mean())


def ball(radius: float) -> np.ndarray:
    """Return a field that is zero outside of a ball, (z, y, x, 1)."""
    z, y, x = np.indices((SIDE,) * 3) + 0.5 - SIDE / 2 + np.reshape([0.1, 0.3, 0.2], (3, 1, 1, 1))
    return (np.sqrt(x**2 + y**2 + z**2) < radius).astype(float)[..., None]


def layers(values: np.ndarray) -> np.ndarray:
    """Return a field that varies along z only."""
    return values[:, None, None, None] * np.ones((1, SIDE, SIDE, 1))


@pytest.mark.parametrize("radius", [1.5, 5.5])
@pytest.mark.parametrize("dim", [0.0, 0.2])
def test_fields_with_a_sharp_end_are_conserved(grid, radius, dim):
    """Fields with a sharp end are conserved.

    The error of the sum is an eighth of that of plainly interpolated roots, which lose 3 to 40 % of
    the field in the ball.
    """
    phi, lit = dim + ball(radius) * (1 - dim), (SIDE - 3) ** 3
    total, left = phi.sum() - dim * SIDE**3, dim * lit
    found = mean_lookup(grid, conservative_roots(grid, phi)) * lit - left
    plain = mean_lookup(grid, np.sqrt(phi)) * lit - left
    assert plain < 0.97 * total
    assert abs(found - total) < 0.125 * (total - plain)


@pytest.mark.parametrize(
    ("k", "error", "before"), [(0.5, 0.001, 0.009), (1.0, 0.003, 0.04), (2.0, 0.03, 0.15)]
)
def test_exponential_decay_is_conserved(grid, k, error, before):
    """The mean of lookups agrees with the integral of e^-kx between two voxels.

    ``before`` is the minimum error of plainly interpolated roots.
    """
    phi = np.exp(-k * np.arange(SIDE))
    u = np.full((3, 64), SIDE / 2)
    u[2] = SIDE / 2 + 0.5 + (np.arange(64) + 0.5) / 64
    exact = phi[SIDE // 2] * (1 - np.exp(-k)) / k
    for roots, low, high in (
        (conservative_roots(grid, layers(phi)), -error, error), (np.sqrt(layers(phi)), before, 1),
    ):  # fmt: skip
        field = RootField(grid, mi.Float(roots.ravel()), 1)
        found = np.array(field.at(mi.Point3f(np.float32(u)))).mean()
        assert low < found / exact - 1 < high


def test_smooth_field_is_conserved_per_cell(grid):
    """The mean of a smooth field over any cell agrees to 0.3 %.

    The field is a cosine of 12 voxels' length on top of 2, where plain interpolation is off by up
    to 2.2 %.
    """
    w = 2 * np.pi / 12
    x = np.arange(SIDE) + 0.5
    place = np.arange(3, 15) + 0.5
    exact = 2 + (np.sin(w * (place + 1)) - np.sin(w * place)) / w
    u = np.full((3, 12, 32), SIDE / 2)
    u[2] = place[:, None] + (np.arange(32) + 0.5) / 32
    errors = []
    for roots in (
        np.sqrt(layers(2 + np.cos(w * x))),
        conservative_roots(grid, layers(2 + np.cos(w * x))),
    ):
        field = RootField(grid, mi.Float(roots.ravel()), 1)
        found = np.array(field.at(mi.Point3f(np.float32(u.reshape(3, -1))))).reshape(12, 32)
        errors.append(np.abs(found.mean(axis=1) / exact - 1).max())
    assert errors[1] < 0.003 < 0.02 < errors[0]


def test_channels_are_independent(grid):
    one = ball(4.0)
    other = np.roll(one, 3, axis=0) * 0.5
    both = conservative_roots(grid, np.concatenate([one, other, one], axis=-1))
    for c, alone in enumerate((one, other, one)):
        np.testing.assert_allclose(both[..., c : c + 1], conservative_roots(grid, alone), rtol=1e-5)


def test_unknown_neighbours_are_ignored(grid):
    """Unknown voxels and the border do not affect their neighbours along the axis.

    A field that varies linearly is unchanged.
    """
    phi, known = layers((1 + np.arange(SIDE)) ** 2.0), np.ones((SIDE,) * 3, bool)
    known[:, :10] = False
    phi[:, :10] = 0
    np.testing.assert_allclose(conservative_roots(grid, phi, known=known), np.sqrt(phi), rtol=1e-5)
    assert np.abs(conservative_roots(grid, phi) - np.sqrt(phi)).max() > 0.5
    np.testing.assert_array_equal(conservative_roots(grid, np.zeros_like(phi)), 0)
