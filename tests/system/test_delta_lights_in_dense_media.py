"""Direct illumination by suns and point lights in media that are opaque within a cache voxel."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

SIZE, PER_SIDE, POINTS, ALBEDO = 16, 24, 256, 0.7
RESOLUTION = {"cube": 8, "sphere": 32}
SUNS = {
    "oblique": [-0.5, -1.0, -0.3],
    "grazing": [-1.0, -0.01, -0.3],
    "in the plane of a face": [-1.0, 0.0, -0.3],
    "towards the camera": [0.6, 0.5, 0.9],
}
LIGHTS = {"point outside": [1.5, 2.0, 0.4], "point in the plane of a face": [1.5, 2.0, 1.0]}


def light(name: str) -> dict:
    if name in SUNS:
        return {"type": "directional", "direction": SUNS[name], "irradiance": 3.0}
    return {"type": "point", "position": LIGHTS[name], "intensity": 8.0}


def scene(scenes, name: str, sigma_t: float, shape: str) -> mi.Scene:
    """Return a dense medium that fills the cube [-1, 1]^3 or the sphere in it."""
    place = scenes.placement()  # the cube [-1, 1]^3
    within = scenes.medium(np.full((1, 1, 1), sigma_t), ALBEDO, place)
    boundary = {"type": shape, "bsdf": {"type": "null"}, "interior": within}
    settings = {"solver": "sweep", "max_depth": 2, "resolution": RESOLUTION[shape]}
    integrator = {"type": "irrcache"} | settings
    return scenes.load(integrator, boundary, SIZE, emitter=light(name), sun=None)


def exits(o: np.ndarray, d: np.ndarray, shape: str) -> np.ndarray:
    """Return the distances (2, n) at which rays enter and leave the cube or the sphere."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape == "cube":
            ends = np.sort((np.array([[[-1.0]], [[1.0]]]) - o) / d, axis=0)
            ends = np.where(d == 0, np.array([[[-np.inf]], [[np.inf]]]), ends)
            return np.array([ends[0].max(axis=0), ends[1].min(axis=0)])
        middle = -(o * d).sum(axis=0)
        half = np.sqrt(1 - ((o + middle * d) ** 2).sum(axis=0))
        return np.array([middle - half, middle + half])


def quadrature(loaded: mi.Scene, name: str, sigma_t: float, shape: str) -> np.ndarray:
    """Return the radiance of single scattering, means over `PER_SIDE`^2 rays of each pixel.

    The midpoint rule is applied in the transmittance of camera rays.
    """
    at = (np.arange(SIZE * PER_SIDE) + 0.5) / (SIZE * PER_SIDE)
    x, y = (np.float32(c.ravel()) for c in np.meshgrid(at, at))
    ray, _ = loaded.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    o, d = (np.array(v, dtype=np.float64) for v in (ray.o, ray.d))
    near, far = exits(o, d, shape)
    hit = near < far
    o, d, near, far = o[:, hit], d[:, hit], near[hit], far[hit]
    absorbed, total = 1 - np.exp(-sigma_t * (far - near)), 0
    for u in (np.arange(POINTS) + 0.5) / POINTS:
        p = o + (near - np.log1p(-u * absorbed) / sigma_t) * d
        if name in SUNS:
            direction = -np.array(SUNS[name])[:, None] / np.linalg.norm(SUNS[name])
            irradiance, distance = 3.0, np.inf
        else:
            way = np.array(LIGHTS[name])[:, None] - p
            distance = np.linalg.norm(way, axis=0)
            direction, irradiance = way / distance, 8.0 / distance**2
        leave = exits(p, np.broadcast_to(direction, p.shape), shape)[1]
        total += irradiance * np.exp(-sigma_t * np.clip(np.minimum(leave, distance), 0, None))
    image = np.zeros(hit.shape)
    image[hit] = total / POINTS * absorbed * ALBEDO / (4 * np.pi)
    return image.reshape(SIZE, PER_SIDE, SIZE, PER_SIDE).mean(axis=(1, 3))


@pytest.mark.usefixtures("mono")
@pytest.mark.parametrize("shape", ["cube", "sphere"])
@pytest.mark.parametrize(
    ("name", "sigma_t"),
    [(name, 5.0) for name in (*SUNS, *LIGHTS)]
    # Towards a face seen edge-on, too few rays intersect the unshadowed thin part of the medium.
    + [(name, 20.0) for name in ("oblique", "grazing", "towards the camera", "point outside")],
)
def test_single_scattering(scenes, name, sigma_t, shape):
    """Single scattering agrees with quadrature in voxels of large optical depth.

    The voxels have optical depths of 1.25 and 5 in the cube, 0.3 and 1.25 in the sphere. When
    transmittance was interpolated, the RMSE was 63 % with 16 voxels along the edge of a similar
    cube. Errors are bounded in blocks of 4 x 4 pixels, which excludes pixel noise.
    """
    loaded = scene(scenes, name, sigma_t, shape)
    expected = quadrature(loaded, name, sigma_t, shape)
    error = scenes.image(loaded, spp=4096)[..., 0] - expected
    blocks = error.reshape(4, 4, 4, 4).mean(axis=(1, 3))
    assert abs(error.mean()) < 0.0025 * expected.mean()
    assert np.abs(blocks).max() < 0.02 * expected.mean()
