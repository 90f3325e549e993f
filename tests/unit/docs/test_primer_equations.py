"""Equations of docs/primer, written down in NumPy, give what the code computes."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.render import quadrature
from mitsuba_irrcache.solvers.discrete_ordinates import anderson
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (4, 5, 7)  # z, y, x
SIGMA = 0.8
DIRECTIONS = np.array([[0.9, 0.3, -0.31], [-0.2, 0.7, 0.5], [0.35, -0.1, -0.93]])
LIGHT = np.array([[1.0, 0.5], [0.3, 0.0], [0.7, 2.0]])
WEIGHTS = np.array([0.4, 0.9, 0.6])
OFFSETS = np.array([[0.31, 0.77], [0.52, 0.05], [0.9, 0.43]])


def tracks():
    """Each of the tracks of all directions: its voxels (x, y, z), and the optical depths of each
    before and behind the middle, whether it enters there, L at entry, and the area that it stands
    for; eq. (4.3).
    """
    sides, to_world = np.array(SHAPE[::-1]), np.array([1.4, 0.9, 0.8])
    for direction, light, weight, offset in zip(DIRECTIONS, LIGHT, WEIGHTS, OFFSETS, strict=True):
        direction = direction / np.linalg.norm(direction)
        v = direction * sides / to_world
        a = int(np.abs(v).argmax())
        across = [k for k in range(3) if k != a]
        slope, length = v[across] / v[a], 1 / abs(v[a])
        for way, first in itertools.product((1, -1), np.ndindex(*sides[across])):
            entering = light[0 if (v[a] > 0) == (way > 0) else 1]
            found, before = [], None
            for k in range(sides[a])[::way]:
                q = offset + first + k * slope
                lap, place = np.floor(q / sides[across]), q % sides[across]
                # Slices since the face that the track enters through, if it is that near.
                moved = way * slope
                since = np.where(moved > 0, place / moved, (place - sides[across]) / moved)
                if before is None:
                    new, depth = True, min(0.5, *since)
                else:
                    new = bool((lap != before).any())
                    depth = min(1.0, *since[lap != before]) if new else 0.5
                before, voxel = lap, np.zeros(3, int)
                voxel[a], voxel[across] = k, np.floor(place)
                found.append((tuple(voxel), depth * SIGMA * length, 0.5 * SIGMA * length, new))
            yield found, entering, weight, 1 / length


def swept() -> tuple[np.ndarray, np.ndarray]:
    """Sources, and what the code tallies: irradiance, V and W of eq. (4.7), (z, y, x, 3)."""
    to_world = np.diag([1.4, 0.9, 0.8, 1.0])
    grid = Grid(SHAPE, to_world)
    source = np.random.default_rng(3).uniform(0, 1, SHAPE).astype(np.float32)
    volume = np.zeros((*SHAPE, 4), np.float32)
    volume[..., 0] = source
    volume = mi.Float(volume.ravel())
    lattice = Tracks(
        grid, dr.full(mi.Float, SIGMA, grid.voxel_count), np.zeros(3, int), grid.resolution
    )
    unit = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    lattice.sweep(volume, lattice.table(unit, LIGHT, WEIGHTS, OFFSETS))
    return source, np.array(volume).reshape(*SHAPE, 4)[..., 1:]


def test_transfer_along_tracks():
    """Eqs. (4.3), (4.6) and (4.7). Extinction is in 16 bits: 1e-4 of the largest value."""
    source, tallied = swept()
    expected = np.zeros_like(tallied, dtype=np.float64)
    for track, entering, weight, area in tracks():
        for (x, y, z), first, second, new in track:
            radiance = entering if new else radiance  # noqa: F821 (the first voxel is new)
            s, tau = weight * source[z, y, x], first + second
            expected[z, y, x] += (
                s + (radiance - s) * np.exp(-first),
                area * (radiance - s) * (1 - np.exp(-tau)),
                area * weight * tau,
            )
            radiance = s + (radiance - s) * np.exp(-tau)
    scale = np.abs(expected).max(axis=(0, 1, 2))
    np.testing.assert_allclose(tallied / scale, expected / scale, atol=1e-4)


@pytest.mark.parametrize(("a", "b"), [(0.0, 1.3), (0.7, 0.2), (2.0, 2.0), (0.01, 0.02)])
@pytest.mark.parametrize("length", [0.5, 1.5])
def test_quadrature_rules(a, b, length):
    """Eqs. (5.2) to (5.4); the integral of (5.4) by many points, so the code's three are within
    2e-3.
    """
    tau_a, tau_b = a * length, b * length
    tau = 0.5 * (tau_a + tau_b)
    u, w = np.polynomial.legendre.leggauss(200)
    u, w = 0.5 * (u + 1), 0.5 * w
    near = (w * -np.expm1(-(tau_a * u + (tau_b - tau_a) * u**2 / 2))).sum()
    total = 0.5 * tau_a + 0.5 * tau_b * np.exp(-tau)
    share = min(1, -np.expm1(-tau) / total)
    expected = {
        "riemann": (-np.expm1(-tau_a), 0, np.exp(-tau_a)),
        "trapezoid": (0.5 * tau_a * share, 0.5 * tau_b * np.exp(-tau) * share, np.exp(-tau)),
        "exponential": (near, -np.expm1(-tau) - near, np.exp(-tau)),
    }
    assert expected.keys() == quadrature.RULES.keys()
    for rule, (first, second, passed) in expected.items():
        weights, through = quadrature.segment(rule, (mi.Float(a), mi.Float(b)), mi.Float(length))
        found = [float(x[0]) for x in (*weights, through)]
        np.testing.assert_allclose(
            found, (first, second, passed), atol=2e-3 if rule == "exponential" else 1e-5
        )


def test_curvature():
    """Eq. (5.5): the mean of both ends becomes that of the parabola through three samples."""
    values, lengths = (0.4, 1.0, 1.3), (0.5, 0.8)
    parabola = np.polyfit([-lengths[0], 0, lengths[1]], values, 2)
    mean = np.diff(np.polyval(np.polyint(parabola), [0, lengths[1]]))[0] / lengths[1]
    rho = lengths[1] / lengths[0]
    y, y0, y1 = values
    factor = 1 - rho * (rho * (y - y0) + y1 - y0) / (3 * (1 + rho) * (y0 + y1))
    ends = [float(x[0]) for x in quadrature.curved(*(mi.Float(v) for v in values), mi.Float(rho))]
    np.testing.assert_allclose(ends, [y0 * factor, y1 * factor], rtol=1e-6)
    assert np.mean(ends) == pytest.approx(mean, rel=1e-6)


def test_anderson_acceleration():
    """Eq. (4.11), two steps of an affine map; the limits of theta do not matter here."""
    rng = np.random.default_rng(8)
    matrix, b, weight = 0.15 * rng.uniform(0, 1, (6, 6)), rng.uniform(0, 1, 6), rng.uniform(0, 1, 6)
    factors = mi.Float(weight)
    steps = anderson.AndersonAcceleration(
        lambda integrand, *fields: np.array([float(dr.sum(integrand(*fields) * factors)[0])])
    )
    before, phi = None, np.zeros(6)
    for _ in range(4):
        image = matrix @ phi + b
        expected = image
        if before is not None:
            last_residual, last_image = before
            change = image - phi - last_residual
            theta = -(weight * (image - phi)) @ change / ((weight * change) @ change)
            assert -0.5 < theta < anderson.MAX_EXTRAPOLATION
            expected = image + theta * (image - last_image)
        found = np.array(steps.next(mi.Float(phi), mi.Float(image)))
        np.testing.assert_allclose(found, expected, rtol=2e-4)
        before, phi = (image - phi, image), expected
    np.testing.assert_allclose(phi, np.linalg.solve(np.eye(6) - matrix, b), rtol=2e-2)
