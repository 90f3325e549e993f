"""Spot lights in media: beams narrower than the voxels of a cache, against quadrature."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("mono")

SIGMA_T, ALBEDO, SIZE, PER_SIDE, POINTS = 0.8, 0.9, 16, 24, 600
ORIGIN, TARGET = np.array([0.3, 1.4, 0.1]), np.array([-0.1, 0.0, 0.05])


def spot(cutoff: float, origin: np.ndarray = ORIGIN) -> dict:
    look = mi.ScalarTransform4f().look_at(list(origin), list(TARGET), [1, 0, 0])
    return {"type": "spot", "to_world": look, "cutoff_angle": cutoff, "intensity": 10.0}


def fog(scenes, cutoff: float, resolution: int, solver: str = "sweep", **objects) -> mi.Scene:
    cube = scenes.boundary(scenes.medium(SIGMA_T, ALBEDO))
    settings = {"max_depth": 2, "resolution": resolution, "solver": solver, "cache_spp": 32}
    lights = {"emitter": spot(cutoff), "sun": None}
    return scenes.load(
        {"type": "irrcache", "solver": "path", **settings}, cube, SIZE, **(lights | objects)
    )


def single(scene: mi.Scene) -> np.ndarray:
    """Radiance of single scattering in the cube [-1, 1]^3: means over `PER_SIDE`^2 places of each
    pixel, by the midpoint rule along each ray, between its ends in the cube.
    """
    at = (np.arange(SIZE * PER_SIDE) + 0.5) / (SIZE * PER_SIDE)
    x, y = (np.float32(c.ravel()) for c in np.meshgrid(at, at))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    o, d = (np.array(v, dtype=np.float64) for v in (ray.o, ray.d))
    ends = np.sort((np.array([[-1.0], [1.0]])[:, None] - o) / d, axis=0)
    near, far = ends[0].max(axis=0), ends[1].min(axis=0)
    far = np.maximum(near, far)
    total = 0
    emitter = scene.emitters()[0]
    for u in (np.arange(POINTS) + 0.5) / POINTS:
        t = near + u * (far - near)
        p = o + t * d
        way = ORIGIN[:, None] - p
        r = np.linalg.norm(way, axis=0)
        leave = ((np.sign(way) - p) / way * r).min(axis=0)
        it = mi.Interaction3f()
        it.p = mi.Point3f(np.float32(p))
        _, light = emitter.sample_direction(it, mi.Point2f(0.5))
        passed = np.exp(-SIGMA_T * (t - near + np.minimum(leave, r)))
        total += passed * np.array(light)[0] * (far - near) / POINTS
    image = total * SIGMA_T * ALBEDO / (4 * np.pi)
    return image.reshape(SIZE, PER_SIDE, SIZE, PER_SIDE).mean(axis=(1, 3))


@pytest.mark.parametrize(("cutoff", "rmse"), [(7.0, 0.04), (30.0, 0.015)])
def test_single_scattering(scenes, cutoff, rmse):
    """With 16 voxels along the cube, of which a beam of 7 degrees has one or two across; what is
    left is the noise of both where rays cross the beam next to the light: 45 times as bright as the
    image's mean. As an irradiance interpolated between voxels, the beam was 7 % too dark.
    """
    scene = fog(scenes, cutoff, 16)
    expected, image = single(scene), scenes.image(scene, spp=4096)[..., 0]
    error = image - expected
    assert abs(error.mean()) < 0.003 * expected.mean()
    assert np.sqrt(np.square(error).mean()) < rmse * expected.mean()


def test_all_orders_agree_with_path(scenes):
    """The sum over the image, whose noise is 0.5 % with ``path`` here; sweep scatters the means
    over voxels.
    """
    images = [
        scenes.image(_all_orders(scenes, solver), spp=64).mean() for solver in ("sweep", "path")
    ]
    assert images[0] == pytest.approx(images[1], rel=0.02)


def _all_orders(scenes, solver: str) -> mi.Scene:
    cube = scenes.boundary(scenes.medium(2.0, ALBEDO))
    samples = 64 if solver == "sweep" else 256
    settings = {"resolution": 24, "solver": solver, "cache_spp": samples}
    return scenes.load(
        {"type": "irrcache", "solver": "path", **settings}, cube, SIZE, emitter=spot(20.0), sun=None
    )


def test_a_beam_past_an_object(scenes):
    """A ball in the beam shadows the fog behind it, as with ``path``."""
    ball = {
        "type": "sphere",
        "center": [0.16, 1.15, 0.05],
        "radius": 0.06,
        "bsdf": {"type": "diffuse"},
    }
    dark, clear = (
        scenes.image(fog(scenes, 7.0, 16, ball=extra), spp=64).mean() for extra in (ball, None)
    )
    assert dark < 0.75 * clear


def test_the_cache_of_a_file_shows_the_beam(scenes, tmp_path):
    """A stored cache, which is not refined, is rendered like the one that was computed."""
    file = str(tmp_path / "cache.irr")
    cube = scenes.boundary(scenes.medium(SIGMA_T, ALBEDO))
    settings = {"resolution": 12, "solver": "sweep", "cache_spp": 32, "cache_file": file}
    images = []
    for _ in range(2):
        scene = scenes.load(
            {"type": "irrcache", "solver": "path", **settings}, cube, 8, emitter=spot(7.0), sun=None
        )
        images.append(scenes.image(scene, spp=4))
    np.testing.assert_array_equal(*images)


def test_irradiance_of_the_cache_holds_the_mean_of_the_beam(scenes):
    """The integral of ``cache.uncollided`` over the volume against points all over it."""
    scene = fog(scenes, 10.0, 12)
    scene.integrator().prepare(scene)
    mean = np.array(scene.integrator().cache.uncollided).mean()
    rng = np.random.default_rng(1)
    p = 2 * rng.random((3, 1 << 18)) - 1
    it = mi.Interaction3f()
    it.p = mi.Point3f(np.float32(p))
    _, light = scene.emitters()[0].sample_direction(it, mi.Point2f(0.5))
    way = ORIGIN[:, None] - p
    r = np.linalg.norm(way, axis=0)
    leave = np.minimum(((np.sign(way) - p) / way * r).min(axis=0), r)
    assert mean == pytest.approx((np.array(light)[0] * np.exp(-SIGMA_T * leave)).mean(), rel=0.02)
