"""Radiance of dense media under a uniform environment, against the half-space in closed form."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.dense_faces.run import (
    SPP,
    VOXELS,
    cube,
    cube_image,
    face,
    radiance,
    rendered,
    single_scattering,
)
from mitsuba_irrcache.cache import border
from tests.support.slow import with_slow

pytestmark = pytest.mark.usefixtures("mono")


@pytest.mark.parametrize("mu", with_slow([1.0, 0.5], 1.0))
@pytest.mark.parametrize(
    ("albedo", "max_depth", "depth", "bound"),
    [
        # Depths of 1 are between those of 0.5 and 2; all orders have another albedo each.
        (0.8, 2, 0.5, 0.015),
        pytest.param(0.8, 2, 1.0, 0.012, marks=pytest.mark.slow),
        (0.8, 2, 2.0, 0.025),
        (0.5, -1, 0.5, 0.025),
        pytest.param(0.8, -1, 0.5, 0.03, marks=pytest.mark.slow),
        pytest.param(0.8, -1, 1.0, 0.022, marks=pytest.mark.slow),
        (0.95, -1, 1.0, 0.025),
        (0.8, -1, 2.0, 0.055),
    ],
)
def test_half_space(mu, albedo, max_depth, depth, bound):
    """The face of an opaque cube agrees with a half-space.

    When the outermost values were extrapolated by their ratio, and the mean over a voxel was
    taken as the value at its centre, single scattering was 7, 39 and 107 % too bright with optical
    depths of 0.5, 1 and 2 per voxel, all orders with an albedo of 0.8 by 2, 9 and 29 %.
    """
    expected = radiance(albedo, max_depth, mu)
    found = rendered(depth, albedo, max_depth, mu)
    assert found == pytest.approx(expected, rel=bound)


# Errors grow with the depth and the angle of view.
@pytest.mark.parametrize("mu", with_slow([1.0, 0.5], 1.0))
@pytest.mark.parametrize(("depth", "bound"), [(0.5, 0.025), (1.0, 0.05)])
@pytest.mark.parametrize("g", [0.3, -0.4])
def test_anisotropic_half_space(g, depth, bound, mu):
    """Single anisotropic scattering of the face of an opaque cube agrees with a half-space.

    Azimuthal means of the phase function follow from its Legendre expansion. When the profile was
    fitted to values at the centres of voxels instead of means, an error was -6.6 % at a depth of
    1 per voxel.
    """
    incident, weights = np.polynomial.legendre.leggauss(64)
    incident, weights = 0.5 * (incident + 1), 0.5 * weights
    degrees = [np.eye(60)[n] for n in range(60)]
    values = np.polynomial.legendre.legval
    phase = sum(
        (2 * n + 1) * g**n * values(mu, c) * values(-incident, c) for n, c in enumerate(degrees)
    )
    expected = 0.4 * np.sum(weights * phase * incident / (incident + mu))
    body = cube(depth * VOXELS, 0.8)
    body["interior"]["phase"] = {"type": "hg", "g": g}
    solver = {"type": "irrcache", "solver": "sweep", "resolution": VOXELS, "max_depth": 2}
    assert face(solver, body, mu, SPP).mean() == pytest.approx(expected, rel=bound)


def thin_plate(thickness: float, depth: float, albedo: float, mu: float, **integrator) -> float:
    """Return the radiance of the middle of a plate of this ``thickness`` over its other sides and
    this optical ``depth``, at default settings or those of an ``integrator``.
    """
    place = mi.ScalarTransform4f().scale([1, 1, thickness])
    body = cube(depth / thickness, albedo) | {"to_world": place}
    volume = body["interior"]["sigma_t"]
    volume["to_world"] = place @ volume["to_world"]
    return float(face({"type": "irrcache"} | integrator, body, mu, SPP, half=0.25).mean())


@pytest.mark.parametrize("mu", with_slow([1.0, 0.5], 1.0))
@pytest.mark.parametrize("depth", [2.0, 6.0])
@pytest.mark.parametrize("thickness", [1 / 64, 1 / 16])
def test_thin_plate(thickness, depth, mu):
    """Single scattering in a thin opaque plate at default settings agrees with the closed form.

    When the number of voxels was limited along the longest side, so that two of depth 1 were left
    across the first plate, its radiance was 20 % (face on) to 36 % (obliquely) too small.
    """
    incident, weights = np.polynomial.legendre.leggauss(64)
    incident, weights = 0.5 * (incident + 1), 0.5 * weights
    here, there = 1 / mu + 1 / incident, 1 / mu - 1 / incident
    near = (1 - np.exp(-depth * here)) / here
    far = (np.exp(-depth / incident) - np.exp(-depth / mu)) / there
    expected = 0.4 * np.sum(weights * (near + far)) / mu
    assert thin_plate(thickness, depth, 0.8, mu, max_depth=2) == pytest.approx(expected, rel=0.01)


# The one with the most orders of scattering, seen obliquely.
@pytest.mark.parametrize(
    ("albedo", "mu"),
    [
        (0.95, 0.5),
        *(pytest.param(*p, marks=pytest.mark.slow) for p in ((0.95, 1.0), (0.5, 0.5), (0.5, 1.0))),
    ],
)
def test_thin_plate_with_all_orders(albedo, mu):
    """All orders in a thin plate at default settings agree with 16 voxels across."""
    expected = thin_plate(1 / 16, 2.0, albedo, mu, resolution=256)
    assert thin_plate(1 / 16, 2.0, albedo, mu) == pytest.approx(expected, rel=0.01)


# The error at a corner is the larger one.
@pytest.mark.parametrize("corner", with_slow([True, False], False))
def test_dense_voxel_at_the_boundary_of_thin_data(corner):
    """Single scattering of a sun in one opaque voxel of the data, in a corner or on a face, agrees
    with that of a fine cache, in means over 4 x 4 pixels that show this voxel only.

    The boundary is dense on a five-hundredth of its area. When the share was required to be a
    twentieth for the sun to be evaluated along camera rays, mean and largest error were 30 and 185
    % (corner), and 8 and 61 % (face).
    """
    values, images = np.zeros((16, 16, 16, 1), np.float32), []
    row, column = (0, 15) if corner else (8, 8)
    values[15, row, column] = 60
    middle = np.array([(column + 0.5) / 8 - 1, (row + 0.5) / 8 - 1, 15.5 / 8 - 1])
    to_world = mi.ScalarTransform4f()
    origin = middle + np.array([1.2, -0.8, 4])
    look = to_world.look_at(list(origin), list(middle), [0, 1, 0])
    place, grid = to_world.translate(-1).scale(2), mi.VolumeGrid(values)
    volume = {"type": "gridvolume", "grid": grid, "to_world": place, "raw": True}
    medium = {"type": "heterogeneous", "sigma_t": volume, "albedo": 0.9}
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    for resolution in (0, 256):
        solver = {"type": "irrcache", "max_depth": 2, "resolution": resolution}
        scene = {
            "type": "scene",
            "integrator": solver | {"hide_emitters": True},
            "sensor": {"type": "perspective", "fov": 4, "to_world": look, "film": film},
            "sun": {"type": "directional", "direction": [-0.4, 1, -0.55], "irradiance": 3.0},
            "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        }
        image = np.array(mi.render(mi.load_dict(scene), spp=64), np.float64)[..., 0]
        images.append(image.reshape(6, 4, 6, 4).mean(axis=(1, 3)))
    found, expected = images
    difference = (found - expected) / expected.mean()
    assert abs(difference.mean()) < 0.02
    assert abs(difference).max() < 0.1


@pytest.mark.parametrize("max_depth", [2, -1])
@pytest.mark.parametrize("shape", ["cube", "sphere"])
def test_a_boundary_around_the_data_has_no_effect(shape, max_depth):
    """Data that end within the boundary of their medium have the same image as in one that ends
    with them, since Mitsuba clips the medium to them.

    When such voxels counted as cut by the boundary, blocks of a dense cube differed by 16 % of the
    mean.
    """
    body, images = cube(12, 0.9), []
    sun = {"type": "directional", "direction": [0.1, -1, 0.2], "irradiance": 3.0}
    around = {
        "type": shape,
        "to_world": mi.ScalarTransform4f().scale(1.01 if shape == "cube" else 2),
    }
    for boundary in ({}, around):
        solver = {"type": "irrcache", "resolution": 24, "max_depth": max_depth}
        image, _ = cube_image(body | boundary, 16, sun, **solver)
        images.append(image)
    np.testing.assert_allclose(*images, rtol=1e-3)


def window(direction: np.ndarray) -> dict:
    """Return an environment map of which only 3 x 3 texels around a direction have radiance."""
    values = np.zeros((128, 256, 1), np.float32)
    u, v = (
        np.arctan2(direction[0], -direction[2]) / (2 * np.pi) % 1,
        np.arccos(direction[1]) / np.pi,
    )
    row, column = int(128 * v), int(256 * u)
    values[row - 1 : row + 2, column - 1 : column + 2] = 1000
    return {"type": "envmap", "bitmap": mi.Bitmap(values)}


# Profiles differ most from that of a uniform environment with the steepest and the flattest angle,
# and with the larger depth.
@pytest.mark.parametrize("mu", with_slow([1.0, 0.5], 1.0))
@pytest.mark.parametrize("incident", with_slow([0.9, 0.5, 0.25], 0.5))
@pytest.mark.parametrize("depth", with_slow([0.4, 0.8], 0.4))
def test_window_of_an_environment_map(depth, incident, mu):
    """Radiance from a narrow window of a map is scattered as by a half-space, to 2.5 %.

    Its irradiance decays as e^(-t / mu_0) with the optical depth t. The profile of a uniform
    environment in its place had errors of -17 to +5 %, the ratio of the outermost values of up to
    140 %.
    """
    sine = np.sqrt(1 - incident**2)
    direction = np.array([sine * np.cos(0.44), sine * np.sin(0.44), -incident])
    environment = window(direction)
    (emitter,) = mi.load_dict({"type": "scene", "environment": environment}).emitters()
    points = mi.Point2f(np.float32(np.random.default_rng(0).random((2, 1 << 16))))
    record, irradiance = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1 << 16), points)
    cosine, irradiance = -np.array(record.d[2]), np.array(irradiance[0])
    expected = 0.8 / (4 * np.pi) * (irradiance / (1 + mu / cosine)).mean()
    solver = {"type": "irrcache", "solver": "sweep", "resolution": VOXELS, "max_depth": 2}
    image = face(solver, cube(depth * VOXELS, 0.8), mu, SPP, environment)
    assert image.mean() == pytest.approx(expected, rel=0.025)


@pytest.mark.parametrize(
    ("albedo", "bound"), [pytest.param(0.5, 0.011, marks=pytest.mark.slow), (0.9, 0.01)]
)
def test_cube_under_a_sun(albedo, bound):
    """A cube of 0.5 optical depths per voxel under a sun agrees with one of four times as many
    voxels, in means over 8 x 8 pixels.

    Its scattered irradiance is interpolated without that of the sun. With the ratio of the two
    outermost values the errors were 1.6 and 1.8 % of the mean.
    """
    sun = {"type": "directional", "direction": [-0.6, -0.5, 0.62], "irradiance": 3.0}
    body, images = cube(15, albedo), []
    for resolution in (30, 120):
        solver = {"type": "irrcache", "solver": "sweep", "resolution": resolution}
        image, _ = cube_image(body, 64, sun, **solver)
        images.append(image)
    coarse, fine = images
    assert np.sqrt(np.square(coarse - fine).mean()) < bound * fine.mean()


@pytest.mark.parametrize(("depth", "bound"), [(0.2, 0.012), (0.4, 0.015), (0.8, 0.055)])
def test_ball(depth, bound):
    """Single scattering in a ball of 48^3 voxels of these optical depths agrees with that which is
    sampled without a cache, in means over 4 x 4 pixels.

    When tracks read the extinction at the voxels alone, whose interpolation blurs the boundary, the
    errors were 0.5, 3.9 and 15 %.
    """
    ball = {"shape": "sphere"}
    exact = single_scattering(cube(48 * depth, 0.8, homogeneous=True, **ball))
    solver = {"type": "irrcache", "solver": "sweep", "resolution": 48, "max_depth": 2}
    found, _ = cube_image(cube(48 * depth, 0.8, **ball), 64, **solver)
    error = np.sqrt(np.square(found - exact).mean()) / exact.mean()
    assert error < bound


def test_tables():
    """The tables agree with published values of E_2 and E_3, and with the equation of the decay."""
    e2, e3 = border._exponential_integrals(1.0)
    assert e2 == pytest.approx(0.148496, rel=1e-4)  # Abramowitz and Stegun, table 5.4
    assert e3 == pytest.approx(0.109692, rel=1e-4)
    decay, root = border._decay_table().astype(float), np.linspace(0, 1, border.ALBEDOS)
    clear = (root > 0) & (decay < 0.999)  # closer to 1, single precision does not suffice
    albedo, k = 1 - root[clear] ** 2, decay[clear]
    np.testing.assert_allclose(albedo * np.arctanh(k) / k, 1, rtol=1e-4)
    assert clear.sum() > 60
