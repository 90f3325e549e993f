"""Estimate whether Mitsuba's own integrator reaches the error of a cache in less time.

The time of both is measured by numbers of paths, which do not depend on what else the machine does,
so that the same scene always gives the same image. A cache costs what its solver states
(`Solver.cost`). An image by path tracing needs V / e^2 samples per pixel for a relative RMSE e,
where V is the relative variance of a sample. V is measured by a pilot image of a few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.render.film import camera_ray

#: Pixels of the pilot image, and samples of each.
PIXELS, SAMPLES = 1 << 12, 4
#: A cache must cost this many pilot images, and this many images by path tracing with the samples
#: per pixel of the user; otherwise it is built without a pilot image.
WORTH_A_PILOT, WORTH_A_SWITCH = 16, 4
#: Camera samples of the cached media whose processor time is that of a path.
COST_OF_CAMERA_SAMPLE = 4.0
#: Cost of a path with a large ``rr_depth`` in paths with that of ``volpath``'s default, 5: measured
#: 1.1 to 1.6 where it reduces the error.
COST_OF_PATH = 1.6
#: Maximum number of samples of an image, which are taken in one launch.
MOST_SAMPLES = 1 << 24
#: Path tracing must need less than this share of the paths of a cache: the variance of samples is
#: underestimated as long as rare bright ones have not been found.
MARGIN = 0.7
#: Upper limit, at a confidence of 95 %, of the expected number of events of which none occurred.
NONE_SEEN = 3.0


@dataclass(frozen=True)
class StockImage:
    """An image by path tracing that is estimated to be faster than one with a cache.

    Attributes:
        spp: samples per pixel.
        paths: their cost in paths of `Solver.cost`.
        cost: of the caches and of an image with them, in paths.
        error: relative RMSE of either image.
    """

    spp: int
    paths: float
    cost: float
    error: float

    def __str__(self) -> str:
        return (
            f"{self.spp} samples per pixel reach an RMSE of {self.error:.1%} of the mean radiance "
            f"at about {self.paths / self.cost:.2f} times the cost"
        )


def cheaper_stock_image(
    scene: mi.Scene,
    sensor: mi.Sensor,
    spp: int,
    parts: list[CachedMedium],
    stock: mi.Integrator,
    spent: float,
) -> StockImage | None:
    """Return the image by ``stock`` that has the error of one with the caches of ``parts``, and is
    estimated to be faster; None if none is.

    ``spent`` is the number of paths of earlier images of the same scene by ``stock``. With those of
    this image, it may not exceed the cost of the caches: like renting and buying, the cost of all
    images is at most twice that of the better choice, however many images follow.
    """
    pixels = int(np.prod([int(n) for n in sensor.film().crop_size()]))
    cost = sum(part.cost for part in parts)
    if cost < max(WORTH_A_PILOT * PIXELS * SAMPLES, WORTH_A_SWITCH * pixels * spp):
        return None
    error = min(part.solver.size_rule.target_error for part in parts) / 100
    brightest = parts[0].description.brightest
    hidden = 0.0 if brightest is None else float(brightest[0])
    variance = relative_variance(_pilot(scene, sensor, stock), hidden)
    needed = max(spp, int(np.ceil(variance / error**2))) if np.isfinite(variance) else np.inf
    paths = COST_OF_PATH * pixels * needed
    if pixels * needed > MOST_SAMPLES or spent + paths > MARGIN * cost:
        return None
    return StockImage(needed, paths, cost + COST_OF_CAMERA_SAMPLE * pixels * spp, error)


def relative_variance(samples: np.ndarray, brightest: float) -> float:
    """Return an upper estimate of the variance of a sample, in units of the squared mean radiance.

    ``samples`` are of shape (channel, pixel, sample). Samples as bright as the emitter of radiance
    ``brightest`` that only chance finds (through glass) may be missing among them. Returns infinity
    if they are black, or not finite.
    """
    mean = samples.mean()
    if not np.isfinite(mean) or mean <= 0:
        return np.inf
    variance = samples.var(axis=2, ddof=1).mean(axis=0)
    upper = variance.mean() + 2 * variance.std(ddof=1) / np.sqrt(variance.size)
    missing = NONE_SEEN / (variance.size * samples.shape[2]) * brightest**2
    return float((upper + missing) / mean**2)


def _pilot(scene: mi.Scene, sensor: mi.Sensor, integrator: mi.Integrator) -> np.ndarray:
    """Return radiance samples (channel, pixel, sample) of pixels that are spread over the film."""
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
    lane = dr.arange(mi.UInt32, PIXELS * SAMPLES)
    number, _ = Divisor(SAMPLES).split(lane)
    # A rank-1 lattice of pixels.
    rng = mi.PCG32(PIXELS * SAMPLES, dr.opaque(mi.UInt64, 1), lane)
    x = (mi.Float(number) + 0.5) / PIXELS
    y = mi.Float(number * mi.UInt32(2654435769)) * 2.0**-32
    pixel = mi.Point2f(dr.floor(x * width), dr.minimum(dr.floor(y * height), height - 1))
    within = mi.Point2f(rng.next_float32(), rng.next_float32())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, PIXELS * SAMPLES)
    position = pixel + within + mi.Vector2f(film.crop_offset())
    ray, weight = camera_ray(sensor, sampler, position)
    found = integrator.sample(scene, sampler, ray, sensor.get_medium(), mi.Bool(True))
    values = [np.broadcast_to(np.array(v, dtype=np.float64), len(lane)) for v in found[0] * weight]
    return np.reshape(values, (len(values), PIXELS, SAMPLES))
