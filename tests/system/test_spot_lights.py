"""Spot lights in media: cones narrower than a voxel of the cache, against quadrature."""

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
    """Return the radiance of single scattering in the cube [-1, 1]^3.

    Means over `PER_SIDE`^2 points of each pixel, by the midpoint rule along the ray inside the
    cube.
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


@pytest.mark.parametrize(
    ("cutoff", "rmse"), [(7.0, 0.04), pytest.param(30.0, 0.015, marks=pytest.mark.slow)]
)
def test_single_scattering(scenes, cutoff, rmse):
    """Single scattering of a spot light of 7 degrees agrees with quadrature.

    With 16 voxels along the cube, the cone is one or two voxels wide. The remaining error is the
    noise of both images where rays cross the cone next to the emitter, at 45 times the mean
    radiance. When the irradiance was interpolated between voxels, the cone was 7 % too dark.
    """
    scene = fog(scenes, cutoff, 16)
    expected, image = single(scene), scenes.image(scene, spp=4096)[..., 0]
    error = image - expected
    assert abs(error.mean()) < 0.003 * expected.mean()
    assert np.sqrt(np.square(error).mean()) < rmse * expected.mean()


def test_all_orders_agree_with_path(scenes):
    """The image means of both solvers agree with all orders of scattering.

    The noise of ``path`` is 0.5 % here; sweep scatters the means over voxels.
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


def test_spot_light_with_an_occluder(scenes):
    """An object in the cone of a spot light casts the same shadow in the medium as with
    ``path``.
    """
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


def test_loaded_cache_renders_the_spot_light(scenes, tmp_path):
    """A cache loaded from a file renders the same spot light as the cache that was saved."""
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


def test_cached_irradiance_conserves_the_spot_light(scenes):
    """The integral of ``cache.uncollided`` equals that of points sampled in the whole volume."""
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
