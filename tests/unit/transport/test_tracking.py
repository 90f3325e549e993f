"""Null-collision tracking against deterministic integrals along the ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.tracking import free_flight, transmittance

pytestmark = pytest.mark.usefixtures("rgb")

CENTERED = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]])
COUNT = 1 << 18


def column_medium(channels: int, density: float = 1.0) -> tuple[MediumGrid, np.ndarray]:
    """Return a medium in [-1, 1]^3 that varies along x only, and its values (24, channel).

    A part of it is empty.
    """
    values = (
        density
        * np.random.default_rng(8).exponential(1.0, (24, channels))
        * [[1.0, 0.4, 2.0][:channels]]
    )
    values[9:15] = 0
    data = np.broadcast_to(values, (4, 4, 24, channels)).astype(np.float32)
    field = GridField(Grid((4, 4, 24), CENTERED), mi.Float(data.ravel()), channels)
    medium = MediumGrid(field, ConstantField(np.array([0.5])), Boundary("box", np.eye(4)))
    return medium, values


def optical_depth(values: np.ndarray, start: float, end: float) -> np.ndarray:
    """Return int sigma_t dx along the axis from start to end, by a fine midpoint rule in
    float64.
    """
    x = start + (end - start) * (np.arange(200000) + 0.5) / 200000
    centers = -1 + (np.arange(24) + 0.5) / 12
    return np.stack([np.interp(x, centers, v).mean() * (end - start) for v in values.T])


def lanes(start: float):
    ray = mi.Ray3f(mi.Point3f(start, 0.1, -0.2), mi.Vector3f(1, 0, 0))
    rng = mi.PCG32(COUNT)
    return ray, dr.zeros(mi.Float, COUNT), rng


@pytest.mark.parametrize("density", [0.3, 1.5])
@pytest.mark.parametrize("channels", [1, 3])
def test_transmittance_is_unbiased(channels, density):
    """Transmittance estimates are unbiased and lie in [0, 1].

    The bound is 4 standard errors of 2^18 estimates, each below 0.4 % of T (here 0.08 to 0.8): an
    error of 2 % fails for all, 1 % for most.
    """
    medium, values = column_medium(channels, density)
    ray, near, rng = lanes(-0.9)
    estimate, _ = transmittance(medium, ray, near, near + 1.7, rng, mi.Bool(True))
    estimate = np.atleast_2d(np.array(estimate, dtype=np.float64))
    expected = np.exp(-optical_depth(values, -0.9, 0.8))
    error = estimate.std(axis=1) / np.sqrt(COUNT)
    assert (error < 4e-3 * np.maximum(expected, 0.05)).all()
    assert (np.abs(estimate.mean(axis=1) - expected) < 4 * error + 1e-6).all()
    assert estimate.min() >= 0 and estimate.max() <= 1 + 1e-5


@pytest.mark.parametrize("channels", [1, 3])
def test_free_flights_have_the_density_of_the_medium(channels):
    """Collisions of free flights have the density T sigma_t, and escapes the probability T.

    They are compared per channel in 10 intervals, within 4.5 errors.
    """
    medium, values = column_medium(channels)
    ray, near, rng = lanes(-1.0)
    collided, t, weight, *_ = free_flight(
        medium, ray, near, near + 2.0, mi.Spectrum(1.0), rng, mi.Bool(True)
    )
    collided, t, weight = np.array(collided), np.array(t), np.array(weight, dtype=np.float64)
    edges = np.linspace(0, 2, 11)
    through = np.exp(-np.stack([optical_depth(values, -1, -1 + e) for e in edges]))
    through = np.broadcast_to(through, (11, 3))
    for c in range(3):
        for i in range(10):
            here = weight[c] * (collided & (t >= edges[i]) & (t < edges[i + 1]))
            expected = through[i, c] - through[i + 1, c]
            assert abs(here.mean() - expected) < 4.5 * here.std() / np.sqrt(COUNT) + 1e-5
        escaped = weight[c] * ~collided
        assert abs(escaped.mean() - through[-1, c]) < 4.5 * escaped.std() / np.sqrt(COUNT) + 1e-5


def test_coloured_weights_stay_bounded():
    """The sum of spectral tracking weights (Kutz et al.) is at most three times the initial
    maximum.
    """
    medium, _ = column_medium(3, 4.0)
    ray, near, rng = lanes(-1.0)
    _, _, weight, *_ = free_flight(
        medium, ray, near, near + 2.0, mi.Spectrum(1.0), rng, mi.Bool(True)
    )
    weight = np.array(weight)
    assert np.isfinite(weight).all() and weight.min() >= 0
    assert weight.sum(axis=0).max() <= 3 * (1 + 1e-3)


def test_empty_medium():
    """With majorant 0 there are no collisions, no attenuation and no NaN."""
    field = GridField(Grid((5, 5, 5), CENTERED), dr.zeros(mi.Float, 125), 1)
    medium = MediumGrid(field, ConstantField(np.array([1.0])), Boundary("box", np.eye(4)))
    ray, near, rng = lanes(-1.0)
    estimate, rng = transmittance(medium, ray, near, near + 2.0, rng, mi.Bool(True))
    collided, *_ = free_flight(medium, ray, near, near + 2, mi.Spectrum(1), rng, mi.Bool(True))
    assert (np.array(estimate) == 1).all() and not np.array(collided).any()


def test_emitter_at_infinity_through_a_constant_medium():
    """Zero extinction times an infinite distance gives transmittance 1."""
    medium = MediumGrid(
        ConstantField(np.array([0.0, 1.0, 2.0])),
        ConstantField(np.array([1.0])),
        Boundary("box", np.eye(4)),
    )
    ray, near, rng = lanes(0.0)
    estimate, _ = transmittance(medium, ray, near, near + dr.inf, rng, mi.Bool(True))
    np.testing.assert_array_equal(np.array(estimate)[:, 0], [1, 0, 0])
