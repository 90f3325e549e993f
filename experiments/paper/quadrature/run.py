"""Quadratures: orders of convergence, banding, and the remaining error with jitter.

    python -m experiments.paper.quadrature.run [--full] [--force]

All rules march through the same cache. *Orders*: jitter off, against the same rule at a very fine
step, in a smooth fog and in the chest phantom. *Banding*: jitter off, images of the phantom.
*Jitter*: the integrator's own images of the phantom. Writes output/quadrature/results.json and
EXRs.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support.analysis import orders, rms
from experiments.support.marching import pixel_rays, unjittered
from experiments.support.methods import specify
from experiments.support.options import Options, parse
from experiments.support.recording import APPEARANCE
from experiments.support.scenes import scene_file
from experiments.support.store import Store
from experiments.validation.convergence.run import gaussian_ball, parallel_rays
from mitsuba_irrcache.io.images import write_image
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings
from mitsuba_irrcache.render.quadrature import QUADRATURES
from mitsuba_irrcache.render.raymarch import Projection

STEPS = (4.0, 2.0, 1.0, 0.5, 0.25)
#: Step of the reference.
FINE = 1 / 32
#: Step of the images that show banding, and their pixels per side.
BANDED, PIXELS = 2.0, 384
SAMPLES = 16
#: Dense at the faces of its box: if a medium fades out there, even the Riemann sum has high order.
FOG = {"peak": 1.5, "falloff": 1.0}


def run(options: Options) -> None:
    """Compute missing results."""
    folder = options.folder("quadrature")
    store = Store(folder / "results.json", options.force)
    path = scene_file("phantom", options.output, min(options.size.longest, 128))
    pixels = min(options.size.pixels, 256)
    scenes = {
        "fog": (mi.load_dict(gaussian_ball(**FOG)), parallel_rays()),
        "phantom": phantom(path, pixels),
    }
    for name, (scene, rays) in scenes.items():
        store.row(name, partial(without_jitter, scene, rays))
    store.row("banding", partial(banding, *phantom(path, PIXELS), folder))
    store.row("jitter", partial(with_jitter, path, pixels, folder / "phantom.cache"))


def phantom(path: Path, pixels: int) -> tuple[mi.Scene, mi.Ray3f]:
    """Return the scene, and a ray through the centre of every pixel."""
    scene = load_scene(path, parameters(pixels))
    return scene, pixel_rays(scene.sensors()[0])


def parameters(pixels: int) -> dict[str, str]:
    """Return the scene's parameters for an image of this size."""
    return APPEARANCE | {"width": str(pixels), "height": str(pixels)}


def without_jitter(scene: mi.Scene, rays: mi.Ray3f) -> dict:
    """Return the relative RMSE of every rule and step, and the orders."""
    builder = built(scene)
    errors = {}
    for quadrature in QUADRATURES:
        exact = _radiance(builder, quadrature, FINE, rays)
        errors[quadrature] = [
            rms(_radiance(builder, quadrature, step, rays) - exact) / rms(exact) for step in STEPS
        ]
    found = {quadrature: orders(list(STEPS), e) for quadrature, e in errors.items()}
    return {"steps": STEPS, "errors": errors, "orders": found}


def banding(scene: mi.Scene, rays: mi.Ray3f, folder: Path) -> dict:
    """Return images without jitter, and at a fine step."""
    builder = built(scene)
    images = {}
    for quadrature, step in [*((q, BANDED) for q in QUADRATURES), ("exponential", FINE)]:
        projection = Projection(builder.medium, builder.cache.field(), quadrature, step)
        radiance, transmittance = unjittered(projection, rays)
        image = (radiance + transmittance).T.reshape(PIXELS, PIXELS, -1)  # the sky's radiance is 1
        label = "fine step" if step == FINE else quadrature
        images[label] = str(folder / f"{label.replace(' ', '-')}.exr")
        write_image(Path(images[label]), image, {"quadrature": quadrature, "step": step})
    return {"step": BANDED, "images": images}


def with_jitter(path: Path, pixels: int, cache_file: Path) -> dict:
    """Return RMSE and mean error of the integrator's images in units of the mean.

    The reference is the finest step with the same camera samples.
    """
    cache_file.unlink(missing_ok=True)

    def image(quadrature: str, step: float) -> np.ndarray:
        integrator = specify(
            "irrcache{solver=path}", quadrature=quadrature, step=step, cache_spp=SAMPLES,
            cache_file=cache_file,
        )  # fmt: skip
        scene = load_scene(path, parameters(pixels), integrator)
        return np.array(mi.render(scene, spp=SAMPLES), np.float64)

    exact = image("exponential", FINE)
    wrong = {q: [image(q, step) - exact for step in STEPS] for q in QUADRATURES}
    mean = float(exact.mean())
    return {
        "steps": STEPS,
        "errors": {q: [rms(e) / mean for e in own] for q, own in wrong.items()},
        "mean_errors": {q: [float(e.mean()) / mean for e in own] for q, own in wrong.items()},
    }


def built(scene: mi.Scene) -> CacheBuilder:
    """Return the medium and its cache, which all rules share."""
    builder = CacheBuilder(CacheSettings(max_depth=2, samples=SAMPLES))
    builder.update(scene)
    return builder


def _radiance(builder: CacheBuilder, quadrature: str, step: float, rays: mi.Ray3f) -> np.ndarray:
    return unjittered(Projection(builder.medium, builder.cache.field(), quadrature, step), rays)[0]


if __name__ == "__main__":
    run(parse(__doc__))
