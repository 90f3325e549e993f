"""Scenes of the gallery: ``make gallery``, or ``python -m experiments.docs.gallery [NAME ...]``.

Every function of `SCENES` returns a scene; the page docs/gallery.md shows its source beside its
image, docs/images/gallery/NAME.jpg. Settings are the defaults where a scene does not say otherwise.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from experiments.support.options import begin

FOLDER, SIZE, SPP, QUALITY = Path("docs/images/gallery"), 320, 32, 88


def camera(origin: list[float], target: list[float], fov: float = 35) -> dict:
    """Return a sensor of the gallery's size; z is up."""
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb"},
    }


def rgb(*value: float) -> dict:
    """Return a colour."""
    return {"type": "rgb", "value": value}


def grid(values: np.ndarray) -> dict:
    """Return values (z, y, x[, channel]) as a volume in the cube from -1 to 1."""
    values = values.reshape(*values.shape[:3], -1).astype(np.float32)
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    volume = mi.VolumeGrid(np.ascontiguousarray(values))
    return {"type": "gridvolume", "grid": volume, "to_world": place, "raw": True}


def medium(sigma_t: np.ndarray, albedo: dict | float, **properties) -> dict:
    """Return a cube from -1 to 1 with a medium in it."""
    interior = {"type": "heterogeneous", "sigma_t": grid(sigma_t), "albedo": albedo} | properties
    return {"type": "cube", "bsdf": {"type": "null"}, "interior": interior}


def noise(size: int, seed: int) -> np.ndarray:
    """Return turbulence of several scales, of standard deviation 1."""
    rng = np.random.default_rng(seed)
    total = sum(gaussian_filter(rng.normal(size=(size,) * 3), s) * s**2 for s in (1, 2, 4, 8))
    return total / total.std()


def cumulus() -> dict:
    """A cloud under a sun, all orders of scattering, forward scattering."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 64)] * 3, indexing="ij")
    ball = 0.75 - np.sqrt(x**2 + y**2 + np.where(z < -0.3, 3, 1) * (z + 0.1) ** 2)
    density = 60 * np.clip(5 * (ball + 0.13 * noise(64, 3)), 0, 1)
    return {
        "integrator": {"type": "irrcache", "resolution": 64},
        "sensor": camera([-1.5, -4, 0.6], [0, 0, -0.05]),
        "sky": {"type": "constant", "radiance": rgb(0.18, 0.32, 0.6)},
        "sun": {
            "type": "directional",
            "direction": [-0.8, 0.5, -0.7],
            "irradiance": rgb(3, 3, 2.5),
        },
        "cloud": medium(density, 0.999, phase={"type": "hg", "g": 0.5}),
    }


def coloured_lights() -> dict:
    """Smoke in three spot lights: narrow beams stay sharp whatever the grid of the cache."""
    density = 0.7 * np.clip(1 + 0.5 * noise(48, 5), 0.1, 3)
    lights = {
        f"spot{k}": {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at([x, -0.3, 1.9], [0.3 * x, 0, -1], [0, 1, 0]),
            "intensity": rgb(*colour),
            "cutoff_angle": 11,
            "beam_width": 9,
        }
        for k, (x, colour) in enumerate(
            {-1.0: (40, 4, 4), 0.0: (4, 32, 6), 1.0: (5, 10, 46)}.items()
        )
    }
    return lights | {
        "integrator": {"type": "irrcache"},
        "sensor": camera([0, -4.4, 0.5], [0, 0, 0]),
        "smoke": medium(density, 0.9),
    }


def jade() -> dict:
    """Extinction and albedo of their own in each channel, in closed form where it is opaque."""
    interior = {
        "type": "homogeneous",
        "sigma_t": rgb(0.9, 0.6, 0.8),
        "scale": 12,
        "albedo": rgb(0.93, 0.99, 0.955),
    }
    return {
        "integrator": {"type": "irrcache"},
        "sensor": camera([0, -4.4, 1.4], [0, 0, 0]),
        "sky": {"type": "constant", "radiance": rgb(0.03, 0.035, 0.05)},
        "sun": {"type": "directional", "direction": [1, 0.6, -0.8], "irradiance": rgb(4, 3.7, 3.2)},
        "ball": {"type": "sphere", "bsdf": {"type": "null"}, "interior": interior},
    }


def fire() -> dict:
    """An emissive medium lights its own smoke and the ground."""
    z, y, x = np.meshgrid(np.linspace(0, 1, 56), *[np.linspace(-1, 1, 56)] * 2, indexing="ij")
    distance = np.hypot(x + 0.1 * np.sin(8 * z), y) / (0.2 + 0.35 * z)
    density = np.clip(1.1 - distance + 0.28 * noise(56, 2), 0, 1) * np.clip(9 * (1 - z), 0, 1)
    heat = np.clip(1.5 * density - 1.2 * z, 0, 1)
    emission = heat[..., None] ** 2 * np.array([30, 9, 1.6])
    return {
        "integrator": {"type": "irrcache", "max_depth": -1, "emission": grid(emission)},
        "sensor": camera([0.6, -5.4, 0.7], [0, 0, -0.1], 32),
        "dusk": {"type": "constant", "radiance": rgb(0.02, 0.03, 0.06)},
        "ground": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -1.05]).scale(6),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.45, 0.4)},
        },
        "smoke": medium(13 * density, 0.7),
    }


def nebula() -> dict:
    """A star in an RGB medium: an emitter within the voxels, 1/r^2 without a bright voxel."""
    field = noise(64, 11)
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 64)] * 3, indexing="ij")
    radius = np.sqrt(x**2 + y**2 + z**2)
    dust = np.exp(1.5 * field) * np.clip(8 * (0.95 - radius), 0, 1) * np.clip(3 * radius, 0, 1)
    albedo = np.stack([0.93 - 0.1 * np.tanh(field), 0.75 + 0.1 * field, 0.85 - 0 * field], axis=-1)
    return {
        "integrator": {"type": "irrcache"},
        "sensor": camera([2.4, -3.2, 1.2], [0, 0, 0], 36),
        "star": {"type": "point", "position": [0.12, -0.1, 0.1], "intensity": rgb(1.0, 0.9, 1.15)},
        "dust": medium(1.8 * dust, grid(np.clip(albedo, 0.1, 0.98))),
    }


def room() -> dict:
    """A room with smoke: walls, a lamp and interreflection are part of the solution."""
    t = mi.ScalarTransform4f()
    walls = {
        "floor": (t.translate([0, 0, -1.1]), (0.7, 0.68, 0.62)),
        "ceiling": (t.translate([0, 0, 1.1]).rotate([1, 0, 0], 180), (0.7, 0.7, 0.7)),
        "back": (t.translate([0, 1.1, 0]).rotate([1, 0, 0], 90), (0.7, 0.7, 0.7)),
        "left": (t.translate([-1.1, 0, 0]).rotate([0, 1, 0], 90), (0.65, 0.1, 0.08)),
        "right": (t.translate([1.1, 0, 0]).rotate([0, 1, 0], -90), (0.12, 0.45, 0.12)),
    }
    scene = {
        name: {
            "type": "rectangle",
            "to_world": place.scale(1.1),
            "bsdf": {"type": "diffuse", "reflectance": rgb(*colour)},
        }
        for name, (place, colour) in walls.items()
    }
    return scene | {
        "integrator": {"type": "irrcache"},
        "sensor": camera([0, -4.6, 0], [0, 0, 0], 36),
        "lamp": {
            "type": "rectangle",
            "to_world": t.translate([0, 0, 1.09]).rotate([1, 0, 0], 180).scale(0.35),
            "emitter": {"type": "area", "radiance": rgb(14, 12.5, 10)},
        },
        "smoke": medium(0.5 * np.exp(0.9 * noise(48, 9)), 0.95),
    }


SCENES: tuple[Callable[[], dict], ...] = (cumulus, coloured_lights, jade, fire, nebula, room)


def main() -> None:
    """Render the scenes that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="functions of this module; all without any")
    args = parser.parse_args()
    begin()
    FOLDER.mkdir(parents=True, exist_ok=True)
    known = {scene.__name__: scene for scene in SCENES}
    for name in args.names or known:
        started = perf_counter()
        image = mi.render(mi.load_dict({"type": "scene"} | known[name]()), spp=SPP)
        mi.util.convert_to_bitmap(image).write(str(FOLDER / f"{name}.jpg"), quality=QUALITY)
        print(f"{name:16} {perf_counter() - started:6.1f} s", flush=True)


if __name__ == "__main__":
    main()
