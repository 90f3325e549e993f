"""Quadratures of the ray march: weights, orders of convergence, skipping and early termination."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import mitsuba_irrcache.render.raymarch as module
from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.render.empty_space import MOST_CELLS, Clearance
from mitsuba_irrcache.render.quadrature import QUADRATURES, segment
from mitsuba_irrcache.render.raymarch import EARLY_STOP, Projection

pytestmark = pytest.mark.usefixtures("rgb")

LENGTH = 2.0


def march(projection, origin, direction, background=0.0, offset=1.0, lanes=1):
    """Return radiance and transmittance of one ray per lane, with an offset per lane or for all."""
    shift = mi.Float(np.broadcast_to(np.float32(offset), lanes))
    ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
    _, near, far = projection.medium.intersect(ray)
    near = dr.maximum(near, 0) + dr.zeros(mi.Float, lanes)
    radiance, transmittance, gathered, _ = projection.march(
        ray, near, far, mi.Spectrum(background), shift, mi.Bool(True)
    )
    assert not gathered, "without layers nothing else is gathered"
    return tuple(np.array(value.x, dtype=np.float64) for value in (radiance, transmittance))


# Weights

DEPTHS = [0.0, 1e-38, 1e-8, 1e-4, 0.01, 0.0999, 0.1001, 0.5, 1.0, 5.0, 20.0, 80.0, 1e4, 1e30]


@pytest.mark.parametrize("tau_b", DEPTHS)
@pytest.mark.parametrize("tau_a", DEPTHS)
def test_exponential_weights_are_the_integral(tau_a, tau_b):
    """The weights approximate int_0^1 (1 - u | u) sigma(u) e^-tau(u) du with linear sigma.

    The reference is adaptive quadrature in float64. Their sum is exact; each alone is accurate to
    2e-3 up to an optical depth of 5 and to 0.06 beyond.
    """
    ends, depth = (mi.Float(tau_a), mi.Float(tau_b)), 0.5 * (tau_a + tau_b)
    near, far = (float(w[0]) for w in segment("exponential", ends, mi.Float(1))[0])

    def absorbed(u):
        return -np.expm1(-(tau_a * u + 0.5 * (tau_b - tau_a) * u * u))

    scales = [min(1.0, 1 / max(tau_a, 1e-3)), min(1.0, np.sqrt(2 / max(tau_b, 1e-3)))]
    expected_near = quad(absorbed, 0, 1, epsabs=0, points=[u for u in scales if u < 1])[0]
    tolerance = 2e-6 * depth + 1e-37 if depth < 0.1 else 2e-3 if depth <= 5 else 0.06
    assert near + far == pytest.approx(-np.expm1(-depth), rel=2e-6, abs=1e-37)
    assert near == pytest.approx(expected_near, abs=tolerance)
    assert near >= 0 and far >= 0


@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_constant_segment_far_and_near_opaque(quadrature):
    """A constant source S in a constant medium adds S (1 - e^-tau), up to large optical depths."""
    sigma, source, length = mi.Float(3.0), mi.Float(0.7), mi.Float([0.0, 1e-4, 0.01, 1.0, 1e30])
    (near, far), passed = segment(quadrature, (sigma, sigma), length)
    added = near * source + far * source
    tau = 3.0 * np.float64(length)
    np.testing.assert_allclose(passed, np.exp(-tau), rtol=1e-6)
    np.testing.assert_allclose(np.float64(added), 0.7 * -np.expm1(-tau), rtol=2e-4)


# Orders of convergence


class Analytic:
    """A smooth field along x that replaces a grid's."""

    channels, maximum, minimum = 1, 4.0, 0.0

    def __init__(self, function) -> None:
        self.function = function
        self.grid = None

    def at_world(self, p, active=True):
        return self.function(p.x)


def analytic_projection(quadrature: str, step: float) -> Projection:
    boundary = Boundary("box", np.diag([LENGTH / 2, 1, 1, 1.0]))
    medium = MediumGrid(ConstantField(np.array([4.0])), ConstantField(np.array([1.0])), boundary)
    sigma_t = Analytic(lambda x: 1.5 + dr.sin(3 * x))
    medium = medium.replaced(sigma_t=sigma_t, macrocells=medium.macrocells)
    irradiance = Analytic(lambda x: 4 * dr.pi * (1 + 0.8 * dr.cos(2 * x + 0.5)))
    projection = Projection(medium, irradiance, quadrature, 1.0)
    projection.step = dr.opaque(mi.Float, step)
    return projection


@pytest.fixture(scope="module")
def exact() -> float:
    """Return the radiance of the analytic medium by an adaptive Runge-Kutta method, to 1e-10."""

    def slope(t, state):
        x = t - LENGTH / 2
        sigma = 1.5 + np.sin(3 * x)
        return [sigma, np.exp(-state[0]) * sigma * (1 + 0.8 * np.cos(2 * x + 0.5))]

    return solve_ivp(slope, (0, LENGTH), [0, 0], rtol=1e-11, atol=1e-12).y[1, -1]


@pytest.mark.parametrize(
    ("quadrature", "order"), [("riemann", 1), ("trapezoid", 2), ("exponential", 3)]
)
def test_order_of_convergence(exact, quadrature, order, monkeypatch):
    """Without jitter, halving the step divides the error by 2^order.

    This is measured over 8 to 64 steps of equal length.
    """
    monkeypatch.setattr(module, "COARSER", 0)
    monkeypatch.setattr(module, "COARSEST", 0)
    errors = []
    for count in (8, 16, 32, 64):
        value = march(analytic_projection(quadrature, LENGTH / count), (-3, 0, 0), (1, 0, 0))[0][0]
        errors.append(abs(value - exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(order, abs=0.15), errors
    assert (orders > order - 0.4).all()


@pytest.mark.parametrize("count", [16, 32, 64])
def test_longer_steps_in_what_hardly_shows(exact, count):
    """Longer steps behind most of the opacity add an error of at most 2e-4.

    Steps are twice and four times as long where less than a fifth, or 3 %, of the radiance remains.
    """
    value = march(analytic_projection("exponential", LENGTH / count), (-3, 0, 0), (1, 0, 0))[0][0]
    assert value == pytest.approx(exact, rel=2e-4 + 0.5 / count**2)


@pytest.mark.parametrize("quadrature", ["trapezoid", "exponential"])
def test_jitter_keeps_the_order(exact, quadrature):
    """The mean over all offsets has order 2 in the step, like the unshifted steps."""
    offsets = (np.arange(4096) + 1.0) / 4096
    errors = []
    for count in (8, 16, 32):
        projection = analytic_projection(quadrature, LENGTH / count)
        value = march(projection, (-3, 0, 0), (1, 0, 0), offset=offsets, lanes=4096)[0].mean()
        errors.append(abs(value - exact))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.6).all(), errors
    assert errors[-1] < 2e-3 * exact


# Empty space and early termination


def sparse_medium() -> tuple[MediumGrid, Grid]:
    """Return two blobs in an empty, rotated grid of 24 x 20 x 28 voxels."""
    density = np.zeros((24, 20, 28), np.float32)
    rng = np.random.default_rng(5)
    density[3:8, 4:9, 2:7] = rng.uniform(0, 3, (5, 5, 5))
    density[15:21, 9:17, 18:25] = rng.uniform(0, 2, (6, 8, 7))
    angle = 0.4
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    frame = np.eye(4)
    frame[:3, :3] = turn @ np.diag([2.8, 2.0, 2.4])
    frame[:3, 3] = -0.5 * frame[:3, :3].sum(axis=1)
    to_cube = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
    grid = Grid(density.shape, frame)
    field = GridField(grid, mi.Float(density.ravel()), 1)
    boundary = Boundary("box", frame @ to_cube)
    return MediumGrid(field, ConstantField(np.array([0.8])), boundary), grid


def test_skipping_empty_macrocells_changes_nothing():
    """Skipping empty macrocells gives the radiance of the same march without skipping."""
    medium, grid = sparse_medium()
    phi = np.random.default_rng(6).uniform(1, 4, grid.voxel_count).astype(np.float32)
    irradiance = GridField(grid, mi.Float(phi), 1)
    occupied = Macrocells(
        dr.maximum(medium.macrocells.majorant, 1e-9),
        medium.macrocells.minorant,
        medium.macrocells.shape,
        medium.macrocells.coordinates,
    )
    assert dr.count(medium.macrocells.majorant == 0)[0] > 0.5 * medium.macrocells.count
    rng = np.random.default_rng(7)
    count = 4096
    origin = rng.normal(size=(3, count))
    origin *= 4 / np.linalg.norm(origin, axis=0)
    target = rng.uniform(-0.9, 0.9, (3, count))
    ray = mi.Ray3f(
        mi.Point3f(np.float32(origin)), dr.normalize(mi.Vector3f(np.float32(target - origin)))
    )
    hit, near, far = medium.intersect(ray)
    near, offset = dr.maximum(near, 0), mi.Float(rng.uniform(0.01, 1, count).astype(np.float32))
    results = []
    for cells in (medium.macrocells, occupied):
        divided = medium.replaced(macrocells=cells)
        projection = Projection(divided, irradiance, "exponential", 1.0)
        radiance, passed, *_ = projection.march(ray, near, far, mi.Spectrum(1), offset, hit)
        results.append([np.array(v.x) for v in (radiance, passed)])
    assert results[0][0].max() > 0.1
    np.testing.assert_allclose(results[0], results[1], rtol=1e-4, atol=1e-5)


def test_clearance_is_the_distance_to_matter():
    """The clearance of macrocells is their distance to occupied ones, up to MOST_CELLS.

    The distance in the maximum norm is compared with a search over all pairs of cells.
    """
    medium, _ = sparse_medium()
    cells = medium.macrocells
    place = np.argwhere(np.ones(cells.shape))
    matter = place[np.array(cells.majorant) > 0]
    expected = np.abs(place[:, None] - matter[None]).max(axis=2).min(axis=1)
    found = np.array(Clearance(cells).distance)
    np.testing.assert_array_equal(found, np.minimum(expected, MOST_CELLS))


def test_early_stop_with_a_bright_light_behind():
    """A radiance of 1e5 behind T = 0.005 contributes 500, in spite of early termination.

    Without a background, the march may terminate within EARLY_STOP of the exact radiance.
    """
    boundary = Boundary("box", np.eye(4))
    grid = Grid((1, 1, 64), np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]]))
    for depth in (-np.log(0.005), 60.0):
        sigma = GridField(grid, dr.full(mi.Float, depth / 2, 64), 1)
        medium = MediumGrid(sigma, ConstantField(np.array([1.0])), boundary)
        irradiance = GridField(grid, dr.full(mi.Float, 4 * dr.pi, 64), 1)
        projection = Projection(medium, irradiance, "exponential", 1.0)
        for background in (0.0, 1e5):
            radiance, passed = march(projection, (-3, 0, 0), (1, 0, 0), background)
            expected = -np.expm1(-depth) + np.exp(-depth) * background
            total = radiance[0] + passed[0] * background
            assert total == pytest.approx(expected, rel=EARLY_STOP + 1e-5)


@pytest.mark.parametrize("sigma", [0.0, 1e-38, 1e-12, 1e4, 1e30])
@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_extreme_extinction_stays_finite(quadrature, sigma):
    """Radiance is finite for zero, tiny and huge extinction."""
    boundary = Boundary("box", np.eye(4))
    grid = Grid((1, 1, 8), np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]]))
    medium = MediumGrid(
        GridField(grid, dr.full(mi.Float, sigma, 8), 1), ConstantField(np.array([1.0])), boundary
    )
    irradiance = GridField(grid, dr.full(mi.Float, 4 * dr.pi, 8), 1)
    projection = Projection(medium, irradiance, quadrature, 1.0)
    radiance, passed = march(projection, (-3, 0, 0), (1, 0, 0))
    assert np.isfinite(radiance).all() and radiance[0] >= 0
    assert passed[0] == pytest.approx(np.exp(-2 * sigma), abs=1e-6)
    assert radiance[0] == pytest.approx(-np.expm1(-2 * sigma), rel=1e-4, abs=1e-37)


@pytest.mark.parametrize(
    "direction", [(1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1e-30, 0), (0.6, 0.8, 1e-42)]
)
@pytest.mark.parametrize("where", [(0, 0, 0), (0.25, 0.5, 0.75), (0.999, 1, 0)])
def test_rays_along_axes_faces_and_edges(direction, where):
    """Rays along axes, in faces and through edges have the optical depth of their length."""
    boundary = Boundary("box", np.diag([2, 2, 2, 1.0]))
    frame = np.array([[4, 0, 0, -2], [0, 4, 0, -2], [0, 0, 4, -2], [0, 0, 0, 1.0]])
    grid = Grid((16, 16, 16), frame)
    sigma = GridField(grid, dr.full(mi.Float, 0.5, grid.voxel_count), 1)
    medium = MediumGrid(sigma, ConstantField(np.array([1.0])), boundary)
    irradiance = GridField(grid, dr.full(mi.Float, 4 * dr.pi, grid.voxel_count), 1)
    projection = Projection(medium, irradiance, "exponential", 1.0)
    _, passed = march(projection, where, direction)
    pairs = [(x, d) for x, d in zip(where, direction, strict=True) if abs(d) > 1e-20]
    length = min((np.sign(d) * 2 - x) / d for x, d in pairs)
    assert passed[0] == pytest.approx(np.exp(-0.5 * length), rel=1e-5)
