"""Errors of ``irrcache``'s image, split into noise and discretisation."""

from __future__ import annotations

import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.methods import specify
from mitsuba_irrcache.compare import metrics
from mitsuba_irrcache.compare.reference import Reference
from mitsuba_irrcache.io.scene_files import load_scene


def measure(
    path: Path, parameters: dict[str, str], truth: Reference, **properties: object
) -> dict[str, float]:
    """Return errors in units of the mean reference radiance of all pixels, and seconds.

    Two caches of different seeds are built: the common part of their errors is discretisation, the
    rest is noise.
    """
    a, b = truth.a, truth.b
    images, cache_seconds, image_seconds = [], 0.0, 0.0
    for seed in (1, 2):
        integrator = specify("irrcache", cache_seed=seed, **properties)
        scene = load_scene(path, parameters, integrator)
        started = time.perf_counter()
        scene.integrator().prepare(scene)
        dr.sync_thread()
        cache_seconds = time.perf_counter() - started
        started = time.perf_counter()
        images.append(np.array(mi.render(scene, spp=64, seed=seed), dtype=np.float64))
        image_seconds = time.perf_counter() - started
    x, y = images
    mean = float(np.mean(0.5 * (a + b)))
    cache = scene.integrator().cache
    return {
        "mean_error": metrics.mean_error(0.5 * (x + y), a, b) / mean,
        "net_rmse": metrics.net_rmse(x, a, b) / mean,
        "noise": metrics.noise(x, y) / mean,
        "discretisation": metrics.discretisation_error(x, y, a, b) / mean,
        "blocks": metrics.block_error(x, a, b) / mean,
        "reference_noise": metrics.noise(a, b) / 2**0.5 / mean,
        "cache_seconds": cache_seconds,
        "image_seconds": image_seconds,
        "active_voxels": cache.active_count,
        "samples": cache.samples,
    }
