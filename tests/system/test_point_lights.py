"""Point and spot lights in and near media: images against quadrature, the cache against the
solution for an infinite medium.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.render import raymarch

pytestmark = pytest.mark.usefixtures("mono")

SIGMA_T, ALBEDO, SIZE = 1.0, 0.9, 32
#: Position of the light; allowed relative RMSE of the pixels, and relative error of the mean, with
#: 32 voxels along the box. When the irradiance was interpolated directly, they were 260 and 9 % for
#: the light in the box, and 7 % for the one above it.
LAMPS = {
    "in the box": ((0.13, 0.22, -0.3), 0.01, 0.005),
    "in a corner": ((0.97, 0.96, -0.98), 0.01, 0.005),
    "right above": ((0.1, 1.1, 0.2), 0.01, 0.005),
}


def camera(scenes, size: int = SIZE) -> dict:
    sensor = scenes.description({}, None, size)["sensor"]
    look = mi.ScalarTransform4f().look_at([1.0, 2.0, 5.0], [0, 0, 0], [0, 1, 0])
    return sensor | {"to_world": look, "fov": 30.0}


def point(position) -> dict:
    return {"type": "point", "position": list(position), "intensity": 1.0}


def single(scene: mi.Scene, lamp: np.ndarray, count: int, g: float) -> np.ndarray:
    """Return the single scattering in the cube [-1, 1]^3 by equiangular quadrature in float64.

    Means over ``count``^2 points of a pixel; NaN for pixels that the cube's silhouette crosses.
    """
    points = (np.arange(400) + 0.5) / 400
    fine = (np.arange(count) + 0.5) / count
    y, x, v, u = np.meshgrid(np.arange(SIZE), np.arange(SIZE), fine, fine, indexing="ij")
    film = np.float32(np.stack([(x + u).ravel(), (y + v).ravel()]) / SIZE)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(film), mi.Point2f(0.5))
    o, d = (np.array(a, dtype=np.float64).T for a in (ray.o, ray.d))
    ends = np.sort((np.array([[-1.0], [1.0]])[:, None] - o) / d, axis=0)
    near, far = ends[0].max(axis=-1), ends[1].min(axis=-1)
    hit = near < far
    far = np.maximum(near, far)
    middle = ((lamp - o) * d).sum(axis=-1)
    q = np.linalg.norm(lamp - o - middle[:, None] * d, axis=-1)
    low, high = np.arctan((near - middle) / q), np.arctan((far - middle) / q)
    total = np.zeros(len(o))
    for s in points:
        t = middle + q * np.tan(low + (high - low) * s)
        p = o + t[:, None] * d
        way = lamp - p
        r = np.linalg.norm(way, axis=-1)
        inside = np.minimum(((np.sign(way) - p) / way * r[:, None]).min(axis=-1), r)
        # dt is q / cos^2 of the angle, over the square of the distance 1 / q times the angle.
        cosine = (way * d).sum(axis=-1) / r
        phase = (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cosine) ** 1.5)
        light = SIGMA_T * ALBEDO * phase * np.exp(-SIGMA_T * (t - near + inside))
        total += (high - low) / q / len(points) * light
    return np.where(hit, total, np.nan).reshape(SIZE, SIZE, -1).mean(axis=-1)


@pytest.mark.parametrize(("solver", "g"), [("sweep", 0.0), ("path", 0.0), ("path", 0.4)])
@pytest.mark.parametrize(("lamp", "rmse", "mean"), LAMPS.values(), ids=LAMPS)
def test_single_scattering(scenes, lamp, rmse, mean, solver, g):
    """Single scattering of point lights agrees with quadrature.

    Pixels next to the light are excluded: their radiance is inversely proportional to the distance,
    so that both results depend on the sampling positions within the pixel.
    """
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    cube = scenes.boundary(scenes.medium(SIGMA_T, ALBEDO) | {"phase": phase})
    settings = {"max_depth": 2, "resolution": 32, "solver": solver, "cache_spp": 32}
    scene = scenes.load(
        {"type": "irrcache", "solver": "path", **settings}, cube, SIZE,
        emitter=point(lamp), sun=None, sensor=camera(scenes),
    )  # fmt: skip
    image = scenes.image(scene, spp=256)[..., 0]
    expected = single(scene, np.array(lamp), 4, g)
    scale = np.nanmean(expected)
    dim = expected < 4 * scale
    error = (image - expected)[dim] / scale
    assert np.sqrt((error**2).mean()) < rmse
    assert abs(error.mean()) < mean


#: int_0^inf k sin(k r) c A^2 / (1 - c A) dk with A = atan(k) / k and c = 0.8, by quadrature, in two
#: ways that agree to 1e-6: divided by 2 pi^2 r, it is Phi of all orders but the first at r mean
#: free paths from a source of unit power in an infinite medium of albedo c.
ORDERS = {1.0: 1.54237649, 2.0: 0.76483116, 3.0: 0.37801463}


def test_all_orders_in_an_infinite_medium(scenes):
    """The fluence of a point light agrees with that of an infinite medium in spherical shells.

    The medium is 16 mean free paths wide, with voxels of a quarter of one. Shells around the
    distances hold 200 to 2500 voxels; the bound is 2.5 %, of which their discretisation is 1.6.
    ``path`` has unbounded variance here, as its paths can pass arbitrarily close to the emitter.
    """
    to_world = scenes.placement((16.0, 16.0, 16.0))
    lamp = np.array([0.05, 0.11, -0.07])
    settings = {"max_depth": -1, "resolution": 64, "solver": "sweep", "cache_spp": 128}
    scene = scenes.load(
        {"type": "irrcache", "solver": "path", "rr_depth": 50, **settings},
        scenes.boundary(scenes.medium(1.0, 0.8), to_world), 4, emitter=point(lamp), sun=None,
    )  # fmt: skip
    scene.integrator().prepare(scene)
    cache = scene.integrator().cache
    places = np.array(cache.grid.centers(cache.active), dtype=np.float64)
    distance = np.linalg.norm(places - lamp[:, None], axis=0)
    phi = np.array(cache.scattered).ravel()[np.array(cache.active)]
    for r, value in ORDERS.items():
        shell = np.abs(distance - r) < 0.25
        expected = value * 2 / np.pi / r
        # The result varies like e^-kr / r; dividing by it makes the shell's width irrelevant.
        like = np.exp(-0.71 * (distance[shell] - r)) * r / distance[shell]
        assert (phi[shell] / like).mean() == pytest.approx(expected, rel=0.025)


@pytest.mark.parametrize("lamp", [(0.0, 0.0, 0.0), (0.25, 0.25, 0.25)], ids=str)
def test_scattering_near_a_light_in_thin_voxels(scenes, lamp):
    """Multiple scattering in coarse voxels around a light is that in fine ones to 2 %: what voxels
    scatter first is the mean over them. That at their centres would be up to 11 % too little.
    """
    means = []
    for resolution in (8, 32):
        settings = {"type": "irrcache", "solver": "sweep", "resolution": resolution}
        cube = scenes.boundary(scenes.medium(0.1, ALBEDO))
        scene = scenes.load(settings | {"cache_spp": 64}, cube, 4, emitter=point(lamp), sun=None)
        scene.integrator().prepare(scene)
        cache = scene.integrator().cache
        assert not cache.direct_lights  # which know the mean over voxels themselves
        means.append(np.array(cache.scattered).mean(dtype=np.float64))
    assert means[0] == pytest.approx(means[1], rel=0.02)


def test_beside_a_spot_light(scenes):
    """The image mean of a narrow spot light right above the medium agrees with volpath.

    Of the bound, 2 % are the interpolation error at the cone's edge.
    """
    look = mi.ScalarTransform4f().look_at([0.1, 1.6, 0.2], [0, 0, 0], [1, 0, 0])
    spot = {"type": "spot", "to_world": look, "intensity": 1.0, "cutoff_angle": 30.0}
    cube = scenes.boundary(scenes.medium(SIGMA_T, ALBEDO))
    means = []
    for integrator in (
        {"type": "irrcache", "solver": "sweep", "resolution": 32},
        {"type": "volpath"},
    ):
        scene = scenes.load(
            {"max_depth": 2, **integrator}, cube, SIZE,
            emitter=spot, sun=None, sensor=camera(scenes), default_solver="path",
        )  # fmt: skip
        means.append([scenes.image(scene, spp=1024, seed=seed).mean() for seed in range(3)])
    (ours, theirs), errors = np.mean(means, axis=1), np.std(means, axis=1, ddof=1) / 3**0.5
    assert errors[1] < 0.003 * theirs, "too noisy to say"
    assert abs(ours - theirs) < 0.005 * theirs + 3 * errors.max()


@pytest.mark.parametrize("g", [0.0, 0.5])
def test_many_lights(monkeypatch, g):
    """Lights that the ray march evaluates by function calls add the same radiance as others."""
    dense = {"type": "homogeneous", "sigma_t": 12.0, "albedo": ALBEDO}
    dense["phase"] = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    places = [(2.0, 1.5, 0.3), (-1.6, 1.8, 1.0), (0.2, -2.0, 1.7), (0.4, 0.3, 2.5)]
    colours = np.linspace(0.5, 1.5, len(places))
    lights = {
        f"light {k}": point(place) | {"intensity": float(colour)}
        for k, (place, colour) in enumerate(zip(places, colours, strict=True))
    }
    sensor = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([1.0, 2.0, 5.0], [0, 0, 0], [0, 1, 0]),
        "fov": 30.0,
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
    }
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": dense}
    images = []
    for many in (len(places), len(places) + 1):
        monkeypatch.setattr(raymarch, "MANY_LIGHTS", many)
        integrator = {"type": "irrcache", "resolution": 8, "cache_spp": 64}
        scene = mi.load_dict(
            {"type": "scene", "integrator": integrator, "sensor": sensor, "cube": cube} | lights
        )
        images.append(np.array(mi.render(scene, spp=16)))
        assert len(scene.integrator().cache.direct_lights) == len(places)
    assert images[0].mean() > 0
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-6)
