"""Speed-up by the solver ``sweep`` with surfaces: a dense cloud over the ground.

    python -m experiments.performance.ground.run [--force]

A ball-shaped cloud of 64^3 voxels, albedo 0.97 and an optical depth of about 30 across its middle,
over a grey ground, under a white sky, and under a sun: all orders of scattering, by each solver at
default settings. Measures the seconds of the cache (and with ``sweep`` of a second one, with
compiled kernels), and the errors of the image, of pixels and of means over 8 x 8, against volpath,
net of its noise (of two halves). Writes output/ground/results.json.
"""

from __future__ import annotations

import time
from functools import cache, partial

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.options import Options, parse
from experiments.support.store import Store

VOXELS, CORE, ALBEDO = 64, 38.0, 0.97
PIXELS, BLOCK, SPP = 64, 8, 256
SUN = {"type": "directional", "direction": [0.4, -1.0, 0.55], "irradiance": 3.0}
LIGHTS = {
    "sky": {"sky": {"type": "constant", "radiance": 1.0}},
    "sun": {"sky": {"type": "constant", "radiance": 0.1}, "sun": SUN},
}


def run(options: Options) -> None:
    """Compute missing rows and print all."""
    store = Store(options.folder("ground") / "results.json", options.force)
    for light in LIGHTS:
        for solver in ("sweep", "path"):
            row = store.row(f"{light} {solver}", partial(measure, light, solver))
            print(
                f"{light} {solver:5}: {row['seconds']:.1f} s, again {row['again']:.1f} s; error of "
                f"pixels {row['pixels']:.2%}, of blocks {row['blocks']:.2%}",
                flush=True,
            )


def measure(light: str, solver: str) -> dict:
    """Return seconds, and errors in units of the mean radiance."""
    scene, a, b = reference(light)
    seconds = []
    for seed in (1, 2) if solver == "sweep" else (1,):
        settings = {"type": "irrcache", "solver": solver, "cache_seed": seed, "rr_depth": 50}
        integrator = mi.load_dict(settings)
        started = time.perf_counter()
        integrator.prepare(scene)
        dr.sync_thread()
        seconds.append(time.perf_counter() - started)
    x, found = picture(scene, integrator, 1), {"seconds": seconds[0], "again": seconds[-1]}
    for name, size in (("pixels", 1), ("blocks", BLOCK)):
        apart = [means(x - half, size) for half in (a, b)]
        found[name] = float(np.sqrt(max((apart[0] * apart[1]).mean(), 0)) / np.mean([a, b]))
    return found


@cache
def reference(light: str) -> tuple[mi.Scene, np.ndarray, np.ndarray]:
    """Return the scene, and two halves of the reference by volpath."""
    scene = mi.load_dict(description(light))
    stock = mi.load_dict({"type": "volpath", "rr_depth": 50})
    return scene, *(picture(scene, stock, seed) for seed in (3, 4))


def picture(scene: mi.Scene, integrator: mi.Integrator, seed: int) -> np.ndarray:
    """Render with an integrator other than the scene's."""
    return np.array(mi.render(scene, integrator=integrator, spp=SPP, seed=seed), np.float64)


def means(image: np.ndarray, size: int) -> np.ndarray:
    """Return means over squares of pixels."""
    n = PIXELS // size
    return image.reshape(n, size, n, size, -1).mean(axis=(1, 3))


def description(light: str) -> dict:
    """Return the scene."""
    c = (np.arange(VOXELS) + 0.5) / VOXELS * 2 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    density = np.clip(1.0 - 1.4 * np.sqrt(x**2 + y**2 + z**2), 0, None)
    density *= 1 + 0.4 * np.sin(5 * x) * np.cos(4 * y + 1)
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    grid = mi.VolumeGrid((CORE * density).astype(np.float32)[..., None])
    medium = {
        "type": "heterogeneous",
        "sigma_t": {"type": "gridvolume", "grid": grid, "raw": True, "to_world": place},
        "albedo": {"type": "constvolume", "value": ALBEDO},
    }
    flat = mi.ScalarTransform4f().look_at([0, -1.3, 0], [0, 0, 0.001], [0.1, 1, 0.2])
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "component_format": "float32"}
    look = mi.ScalarTransform4f().look_at([1.0, 1.5, -5.0], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 34.0, "to_world": look, "film": film},
        "cloud": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        "ground": {
            "type": "rectangle",
            "to_world": flat.scale([5, 5, 1]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5] * 3}},
        },
    } | LIGHTS[light]


if __name__ == "__main__":
    run(parse(__doc__))
