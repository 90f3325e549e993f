"""Opaque homogeneous media: H functions, closed-form radiance, and when it replaces the cache."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_irrcache
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.solvers.half_space import TABLE, _higher_orders, chandrasekhar_h

pytestmark = pytest.mark.usefixtures("rgb")

#: H(.1), H(.5), H(1) by albedo; see docs of the closed forms, [C].
PUBLISHED = {
    0.5: (1.07237, 1.18774, 1.25126),
    0.8: (1.13881, 1.41326, 1.59822),
    0.9: (1.17214, 1.55603, 1.85010),
    0.99: (1.22488, 1.84860, 2.47279),
}


@pytest.mark.parametrize("albedo", PUBLISHED)
def test_h_function(albedo):
    found = chandrasekhar_h(albedo, np.array([0.1, 0.5, 1.0]))
    np.testing.assert_allclose(found, PUBLISHED[albedo], atol=6e-6)


def test_h_function_of_albedo_1_conserves_energy():
    """Half of the integral of H is 1 for albedo 1: a white half-space reflects everything."""
    x, w = np.polynomial.legendre.leggauss(200)
    mu = (0.5 * (x + 1)) ** 2
    assert 0.5 * (0.5 * w * 2 * np.sqrt(mu) * chandrasekhar_h(1.0, mu)).sum() == pytest.approx(
        1, abs=1e-5
    )


def test_orders_add_up_to_all():
    few, many, all_ = (_higher_orders(0.7, orders) for orders in (2, 60, 0))
    np.testing.assert_allclose(many, all_, atol=1e-6)
    assert (few < many).all() or np.allclose(few[0, 0], many[0, 0])
    assert few.shape == (TABLE, TABLE)


def opaque(scenes, kind: str, albedo, integrator: dict, size: int = 16, **objects) -> mi.Scene:
    shape = scenes.boundary(scenes.medium(400.0, albedo), kind=kind)
    return scenes.load({"type": "irrcache", "solver": "auto"} | integrator, shape, size, **objects)


def seen(scene: mi.Scene, samples: int = 16) -> np.ndarray:
    return np.array(mi.render(scene, spp=samples), dtype=np.float64)


SKY = {"type": "constant", "radiance": 1.0}


@pytest.mark.parametrize("kind", ["sphere", "cube"])
def test_white_furnace(scenes, kind):
    """With albedo 1 under a sky of radiance 1, every pixel is 1."""
    image = seen(opaque(scenes, kind, 1.0, {}, emitter=SKY), 64)
    assert image.mean() == pytest.approx(1, abs=0.003)
    assert np.sqrt(np.square(image - 1).mean()) < 0.012  # the noise of 64 samples per pixel


@pytest.mark.parametrize(("depth", "albedo"), [(-1, 0.8), (2, 0.8), (2, 0.3)])
def test_radiance_of_a_face(scenes, depth, albedo):
    """The radiance of a cube face under a uniform sky has the closed form.

    It is 1 - sqrt(1 - w) H(mu), or the integral of w / 2 mu0 / (mu + mu0) for single scattering.
    """
    look = mi.ScalarTransform4f().look_at([0.0, 0.0, -60.0], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "component_format": "float32"}
    sensor = {"type": "perspective", "fov": 0.5, "to_world": look, "film": film}
    scene = opaque(scenes, "cube", albedo, {"max_depth": depth}, emitter=SKY, sensor=sensor)
    expected = 1 - np.sqrt(1 - albedo) * chandrasekhar_h(albedo, np.array([1.0]))[0]
    if depth == 2:
        expected = albedo / 2 * (1 - np.log(2))
    image = seen(scene, 256)
    assert scene.integrator().cache is None
    assert image.mean() == pytest.approx(expected, rel=0.004)


@pytest.mark.parametrize("kind", ["sun", "point"])
def test_single_scattering_is_exact(scenes, kind):
    """Single scattering of an opaque sphere agrees with quadrature in double precision.

    The quadrature is along the rays of 16 x 16 points in each pixel; the sphere has a radius of 1
    and 400 mean free paths per unit.
    """
    position = np.array([2.0, 2.5, -3.0])
    direction = -np.array(scenes.sun["direction"]) / np.linalg.norm(scenes.sun["direction"])
    light = {"type": "point", "position": list(position), "intensity": 20.0}
    light = light if kind == "point" else scenes.sun | {"irradiance": 1.0}
    scene = opaque(scenes, "sphere", 0.7, {"max_depth": 2}, emitter=light)
    size, per_side, sigma_t, radius = 16, 16, 400.0, 1.0
    at = (np.arange(size * per_side) + 0.5) / (size * per_side)
    x, y = (np.float32(c.ravel()) for c in np.meshgrid(at, at))
    ray, _ = scene.sensors()[0].sample_ray(0, 0, mi.Point2f(x, y), mi.Point2f(0.5))
    o, d = (np.array(v, dtype=np.float64) for v in (ray.o, ray.d))

    def both_ends(o, d):
        along = (o * d).sum(0)
        half = np.sqrt(np.maximum(along**2 - (o * o).sum(0) + radius**2, 0))
        return -along - half, -along + half

    near, far = both_ends(o, d)
    points, weights = np.polynomial.legendre.leggauss(48)
    length = np.minimum(far - near, 30 / sigma_t)
    total = 0
    for u, w in zip(0.5 * (points + 1), weights, strict=True):
        t = u * u * length  # denser next to the surface
        p = o + (near + t) * d
        way = position[:, None] - p if kind == "point" else direction[:, None] + 0 * p
        distance = np.linalg.norm(way, axis=0)
        _, leave = both_ends(p, way / distance)
        irradiance = 20 / distance**2 if kind == "point" else 1
        total += w * u * length * sigma_t * np.exp(-sigma_t * (t + leave)) * irradiance
    expected = 0.7 / (4 * np.pi) * np.where(far > near, total, 0).mean()
    assert seen(scene, 256).mean() == pytest.approx(expected, rel=0.003)


def test_three_orders_lie_between(scenes):
    images = [
        seen(opaque(scenes, "sphere", 0.8, {"max_depth": depth}, emitter=SKY)).mean()
        for depth in (2, 3, 4, -1)
    ]
    assert np.diff(images).min() > 0.004


def test_explicit_resolution_selects_the_cache(scenes):
    scene = opaque(scenes, "sphere", 0.8, {"resolution": 16, "max_depth": 2}, size=4)
    mi.render(scene, spp=1)
    assert scene.integrator().cache is not None


def test_sensor_inside_the_medium_selects_the_cache_or_is_refused(scenes):
    scene = opaque(scenes, "sphere", 0.8, {"max_depth": 2}, size=4)
    inside = mi.load_dict(
        {
            "type": "perspective",
            "medium": scene.shapes()[0].interior_medium(),
            "film": {"type": "hdrfilm", "width": 4, "height": 4},
        }
    )
    with pytest.raises(IrrcacheError, match="inside of the opaque medium"):
        scene.integrator().render(scene, inside, spp=1)


def test_emitter_inside_the_medium_selects_the_cache(scenes):
    light = {"type": "point", "position": [0.1, 0.2, 0.3], "intensity": 1.0}
    scene = opaque(scenes, "sphere", 0.8, {"max_depth": 2, "cache_spp": 1}, size=4, lamp=light)
    mi.render(scene, spp=1)
    assert scene.integrator().cache is not None


def test_aovs_and_progressive_images(scenes):
    """Colour times illumination plus background is the image, and no cache samples are
    requested.
    """
    scene = opaque(
        scenes, "sphere", 0.8, {"aovs": "colour,illumination,background,noise"}, 8, emitter=SKY
    )
    image = seen(scene, 4)
    colour, illumination, background = image[..., 3:6], image[..., 6:9], image[..., 9:12]
    np.testing.assert_allclose(colour * illumination + background, image[..., :3], atol=1e-5)
    assert (image[..., 12:] == 0).all() and illumination.max() > 0
    frames = list(mitsuba_irrcache.render_progressive(scene, spp=2, cache_spp=64))
    assert len(frames) == 1
    last = np.array(frames[-1].image)[..., :3]
    assert last.mean() == pytest.approx(image[..., :3].mean(), rel=0.05)
