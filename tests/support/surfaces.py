"""Scenes with surfaces, and the comparison of their images with those of volpath."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

SIZE, BLOCK = 24, 6


#: Error allowed in the mean of a block, relative to the mean radiance, in addition to 4.5 standard
#: errors, which may be at most a few times as large. It accounts for the bias of coarse caches.
TOLERANCE, NOISE = 0.02, 0.02


def colour(*rgb: float) -> dict:
    return {"type": "rgb", "value": [float(v) for v in rgb]}


def fog(extinction=(1.0, 1.0, 1.0), albedo=(0.9, 0.9, 0.9)) -> dict:
    scale = max(extinction) or 1.0
    sigma_t = colour(*(v / scale for v in extinction))
    return {
        "type": "homogeneous", "sigma_t": sigma_t, "albedo": colour(*albedo), "scale": scale,
    }  # fmt: skip


def ref(name: str) -> dict:
    return {"type": "ref", "id": name}


def placed(center=(0, 0, 0), scale=(1, 1, 1), towards=None):
    transform = mi.ScalarTransform4f
    if towards is not None:
        return transform().look_at(list(center), list(towards), [0.1, 1, 0.2]).scale(list(scale))
    return transform().translate(list(center)).scale(list(scale))


def bound(kind="cube", interior=None, center=(0, 0, 0), scale=(1, 1, 1), **more) -> dict:
    """Return a null boundary."""
    place = placed(center, scale)
    return {"type": kind, "to_world": place, "bsdf": {"type": "null"}, "interior": interior} | more


def ball(center=(0, 0, 0), radius=0.4, **more) -> dict:
    return {"type": "sphere", "center": list(center), "radius": radius} | more


def lamp(center, towards, size=0.5, radiance=(12, 10, 8)) -> dict:
    emitter = {"type": "area", "radiance": colour(*radiance)}
    place = placed(center, (size, size, 1), towards)
    return {"type": "rectangle", "to_world": place, "emitter": emitter}


def diffuse(*rgb: float) -> dict:
    return {"type": "diffuse", "reflectance": colour(*rgb)}


def ground(height=-1.1, bsdf=None) -> dict:
    place = placed((0, height, 0), (5, 5, 1), (0, height + 1, 0.001))
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or diffuse(0.6, 0.5, 0.4)}


def images(scenes, objects: dict, settings: dict, depth: dict, spp: tuple) -> list[np.ndarray]:
    """Return two images by irrcache and two by volpath."""
    own = {"type": "irrcache", "resolution": 20, "cache_spp": 64} | depth | settings
    theirs = {"type": "volpath"} | depth
    return pair(scenes, objects, own, spp[0]) + pair(scenes, objects, theirs, spp[1])


def pair(scenes, objects: dict, integrator: dict, spp: int) -> list[np.ndarray]:
    """Return images of two seeds."""
    objects = {"emitter": scenes.sky, "sun": scenes.sun} | objects
    scene = scenes.load(integrator, None, SIZE, **objects, default_solver="path")
    return [scenes.image(scene, spp=spp, seed=seed) for seed in (1, 2)]


def blocks(image: np.ndarray) -> np.ndarray:
    n = SIZE // BLOCK
    return image.reshape(n, BLOCK, n, BLOCK, -1).mean(axis=(1, 3))


def check(x, y, p, q, tolerance=TOLERANCE, noise=NOISE) -> None:
    scale = 0.5 * (p + q)[..., :3].mean()
    assert scale > 0
    difference = blocks(0.5 * (x + y - p - q)) / scale
    errors = [np.sqrt(blocks((0.5 * (a - b)) ** 2) / BLOCK**2) / scale for a, b in ((x, y), (p, q))]
    error = np.hypot(*errors)
    assert np.median(error) < noise, "too noisy to say"
    excess = np.abs(difference) - 4.5 * error
    assert excess.max() < tolerance, (difference, error)
