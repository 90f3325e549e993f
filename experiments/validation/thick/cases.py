"""Scenes with optically thick voxels, coarse grids and narrow spot lights."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

SKY = {"sky": {"type": "constant", "radiance": 1.0}}
SUN = {"sun": {"type": "directional", "direction": [-0.5, -1, -0.3], "irradiance": 3.0}}
POINT = {"point": {"type": "point", "position": [1.5, 2.0, 1.0], "intensity": 8.0}}


def lamp() -> dict:
    """Return a square area light of edge 0.8 near a corner of the cube."""
    look = mi.ScalarTransform4f().look_at([1.5, 2, 1], [0, 0, 0], [0, 1, 0]).scale(0.4)
    emitter = {"type": "area", "radiance": 10.0}
    return {"lamp": {"type": "rectangle", "to_world": look, "emitter": emitter}}


def spot(cutoff: float) -> dict:
    """Return a spot light above the cube."""
    look = mi.ScalarTransform4f().look_at([0.3, 2.2, 0.1], [-0.1, 0, 0], [1, 0, 0])
    return {"spot": {"type": "spot", "to_world": look, "cutoff_angle": cutoff, "intensity": 10.0}}


def centres(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coordinates z, y, x of voxel centres in [-1, 1]^3."""
    c = (np.arange(n) + 0.5) / n * 2 - 1
    return np.meshgrid(c, c, c, indexing="ij")


def ball(n: int) -> np.ndarray:
    """Return 1 inside of a ball and 0 outside, with a transition of one voxel."""
    z, y, x = centres(n)
    return np.clip((0.7 - np.sqrt(x * x + y * y + z * z)) * n / 2 + 0.5, 0, 1)


def bone(n: int) -> np.ndarray:
    """Return filtered noise through a steep transfer function, like opaque bone in a CT volume."""
    frequency = np.fft.fftfreq(n) * n
    squared = sum(np.meshgrid(*[frequency**2] * 3))
    noise = np.random.default_rng(3).normal(size=(n, n, n))
    smooth = np.fft.ifftn(np.fft.fftn(noise) * np.exp(-squared / 18)).real
    z, y, x = centres(n)
    within = np.maximum(np.maximum(abs(x), abs(y)), abs(z)) < 0.9
    return np.clip((smooth / smooth.std() - 0.3) * 4, 0, 1) * within


def contrast() -> np.ndarray:
    """Return 4^3 voxels over four decades."""
    values = np.random.default_rng(5).random((4, 4, 4)) ** 8 + 1e-4
    values[1, 2, 1] = 1
    return values


def smooth() -> np.ndarray:
    """Return 32^3 voxels, dense up to the boundary."""
    z, y, x = centres(32)
    return 0.7 + 0.3 * np.sin(2 * x) * np.cos(1.5 * y + z)


def row(n: int) -> np.ndarray:
    """Return random voxels in a row."""
    return np.random.default_rng(5).random(n) + 0.1


def medium(values: np.ndarray | None, depth: float, albedo: float = 0.8) -> dict:
    """Return a medium of this optical depth along the densest edge of the cube.

    It is homogeneous without ``values``.
    """
    if values is None:
        return {"type": "homogeneous", "sigma_t": 1.0, "albedo": albedo, "scale": depth / 2}
    grid = mi.VolumeGrid((values / values.max())[..., None].astype(np.float32))
    volume = {
        "type": "gridvolume",
        "grid": grid,
        "to_world": mi.ScalarTransform4f().translate(-1).scale(2),
    }
    return {"type": "heterogeneous", "sigma_t": volume, "albedo": albedo, "scale": depth / 2}


def objects(interior: dict, lights: dict, shape: str = "cube") -> dict:
    """Return a medium in the cube [-1, 1]^3, or a sphere in it, and emitters."""
    return {"shape": {"type": shape, "bsdf": {"type": "null"}, "interior": interior}} | lights


def floor() -> dict:
    """Return a diffuse floor below the cube."""
    place = mi.ScalarTransform4f().translate([0, -1.5, 0]).rotate([1, 0, 0], -90).scale(4)
    return {"floor": {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}}}


def grids() -> dict[str, tuple[dict, int]]:
    """Return opaque media on grids: 5 to 100 optical depths per data voxel."""
    found = {}
    for name, values in (("ball 16^3", ball(16)), ("bone 32^3", bone(32))):
        for per_voxel in (5, 30, 100):
            for depth in (2, -1):
                within = medium(values, per_voxel * len(values))
                found[f"{name}, {per_voxel} per voxel, {_orders(depth)}"] = (
                    objects(within, SKY),
                    depth,
                )
    found["bone 32^3, 30 per voxel, sun, all orders"] = (
        objects(medium(bone(32), 960), SUN),
        -1,
    )
    return found


def coarse() -> dict[str, tuple[dict, int]]:
    """Return few data voxels, or media that the boundary cuts."""
    one = np.ones((1, 1, 1))
    cases = {
        "1^3 in a sphere, depth 5": objects(medium(one, 5), SKY, "sphere"),
        "4^3, depth 15, point": objects(medium(contrast(), 15), POINT),
        "4^3, depth 15, lamp": objects(medium(contrast(), 15), lamp()),
        "4^3, depth 15, sun": objects(medium(contrast(), 15), SUN),
        "9 x 1 x 1, depth 40": objects(medium(row(9).reshape(1, 1, 9), 40), SKY),
        "1 x 1 x 9, depth 40": objects(medium(row(9).reshape(9, 1, 1), 40), SKY),
        "2^3, depth 60, sun": objects(medium(row(8).reshape(2, 2, 2), 60), SUN),
        "5 x 2 x 3, depth 20, point": objects(medium(row(30).reshape(3, 2, 5), 20), POINT),
        "smooth 32^3 cut by its boundary, depth 10": objects(medium(smooth(), 10), SKY),
    }
    return {f"{name}, {_orders(d)}": (c, d) for name, c in cases.items() for d in (2, -1)}


def homogeneous() -> dict[str, tuple[dict, int]]:
    """Return homogeneous media from thin to opaque."""
    found = {}
    for shape, depths in (("sphere", (40, 100, 300)), ("cube", (30, 100, 300))):
        for across in depths:
            for name, lights in (("sky", SKY), ("sun", SUN)):
                for depth in (2, -1):
                    key = f"{shape}, {across} across, {name}, {_orders(depth)}"
                    found[key] = objects(medium(None, across), lights, shape), depth
    return found


def beams() -> dict[str, tuple[dict, int]]:
    """Return spot lights in fog."""
    wisps = np.random.default_rng(2).random((16, 16, 16)) ** 2
    return {
        "spot of 7 degrees in fog, single": (objects(medium(None, 1), spot(7)), 2),
        "spot of 7 degrees in fog, all orders": (objects(medium(None, 1), spot(7)), -1),
        "spot of 7 degrees in wisps, all orders": (objects(medium(wisps, 4), spot(7)), -1),
        "spot of 25 degrees in wisps, all orders": (objects(medium(wisps, 4), spot(25)), -1),
        "spot of 7 degrees over a floor, all orders": (
            objects(medium(None, 1), spot(7)) | floor(),
            -1,
        ),
    }


def _orders(depth: int) -> str:
    return "single" if depth == 2 else "all orders"


CLASSES: dict[str, Callable[[], dict[str, tuple[dict, int]]]] = {
    "grid": grids,
    "coarse": coarse,
    "homogeneous": homogeneous,
    "beam": beams,
}


def scene(found: dict, integrator: dict, pixels: int) -> dict:
    """Return the description of a scene seen by a camera outside of the cube."""
    film = {
        "type": "hdrfilm", "width": pixels, "height": pixels, "pixel_format": "rgb",
        "component_format": "float32", "rfilter": {"type": "box"},
    }  # fmt: skip
    look = mi.ScalarTransform4f().look_at([2.6, 2.2, 3.6], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 35, "to_world": look, "film": film}
    return {"type": "scene", "integrator": integrator, "sensor": sensor} | found
