"""Rays and pixels of a view on which errors of its image are measured."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor
from mitsuba_irrcache.core.sequences import kronecker
from mitsuba_irrcache.render.camera import CameraRays, ClosedFormCameraRays
from mitsuba_irrcache.render.film import CameraSampler, PixelPositions, camera_ray

#: Pixels whose radiance is compared, and rays of each: detail that is smaller than a pixel averages
#: out in an image, and must do so here.
PIXELS, RAYS_PER_PIXEL = 1 << 11, 8
#: Pixels that are rendered with several seeds, and these seeds; pixels for the mean radiance. A few
#: pixels at edges may have most of the variance.
SAMPLED_PIXELS, GROUPS, MEAN_PIXELS = 1 << 11, 2, 1 << 12


class ProbeRays:
    """Rays through pixels that are spread over the film of a sensor."""

    def __init__(self, sensor: mi.Sensor) -> None:
        film = sensor.film()
        size = mi.Vector2f(film.crop_size())
        self.pixels = min(PIXELS, int(np.prod(film.crop_size())))
        pixel, number = Divisor(RAYS_PER_PIXEL).split(
            dr.arange(mi.UInt32, self.pixels * RAYS_PER_PIXEL)
        )
        corner = dr.floor(mi.Point2f(kronecker(pixel, 2, (mi.Float(0.5),) * 2)) * size)
        within = mi.Point2f(kronecker(number, 2, (mi.Float(0.5),) * 2))
        position = corner + within + mi.Vector2f(film.crop_offset())
        self._ray, self._weight = camera_ray(sensor, _Middle(), position)
        dr.eval(self._ray, self._weight)
        self._medium = sensor.get_medium()

    def radiance(self, scene: mi.Scene, camera_rays: CameraRays) -> np.ndarray:
        """Return the radiance (pixel, channel) that media scatter, float64.

        For an isolated medium it includes that of the background.
        """
        ray = mi.Ray3f(self._ray)
        found = camera_rays.sample(scene, _Middle(), ray, self._medium, mi.Bool(True))
        radiance = found.scattered
        if isinstance(camera_rays, ClosedFormCameraRays):
            radiance = radiance + found.background
        radiance = mi.Spectrum(radiance * self._weight)
        radiance += dr.zeros(mi.Float, self.pixels * RAYS_PER_PIXEL)
        means = [dr.block_sum(channel, RAYS_PER_PIXEL) for channel in radiance]
        return np.array(means, dtype=np.float64).T / RAYS_PER_PIXEL

    @property
    def identity(self) -> tuple:
        """Values that identify the rays, to detect a change of the sensor."""
        ray, weight = self._ray, self._weight
        arrays = mi.Vector3f(ray.o), mi.Vector3f(ray.d), ray.time, mi.Spectrum(weight)
        return (*(np.array(a).tobytes() for a in arrays), self._medium)


class _Middle:
    """A sampler that always returns 0.5, so that images of two caches can be compared."""

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        return mi.Float(0.5)

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        return mi.Point2f(0.5)


class SampledPixels:
    """Pixels of a ``sensor`` that are rendered with independent seeds, beginning with ``seed``."""

    def __init__(self, scene: mi.Scene, sensor: mi.Sensor, seed: int) -> None:
        self._scene, self._sensor, self._seed = scene, sensor, seed

    def mean(self, camera_rays: CameraRays, of_volume: bool) -> float:
        """Return the mean radiance of the image, or that scattered by the media (``of_volume``)."""
        return float(self._samples(camera_rays, 1, 0, MEAN_PIXELS, of_volume).mean())

    def standard_error(self, camera_rays: CameraRays, spp: int) -> float:
        """Return the RMS of the standard errors of pixels with ``spp`` samples each."""
        groups = [
            self._samples(camera_rays, spp, group, SAMPLED_PIXELS, False) for group in range(GROUPS)
        ]
        return float(np.sqrt(np.var(groups, axis=0, ddof=1).mean()))

    def rounded(self, spp: int) -> int:
        """Return the samples per pixel that the sensor's sampler uses for ``spp``."""
        return self._sampler(spp).sample_count()

    def _samples(
        self, camera_rays: CameraRays, spp: int, group: int, most: int, of_volume: bool
    ) -> np.ndarray:
        """Return means (pixel, channel) of ``spp`` samples in at most ``most`` pixels."""
        spp, seed = self.rounded(spp), self._seed + group
        film, medium = self._sensor.film(), self._sensor.get_medium()
        width, height = (int(n) for n in film.crop_size())
        pixels = min(most, width * height)
        lane, sample = Divisor(spp).split(dr.arange(mi.UInt32, pixels * spp))
        place = kronecker(lane, 2, (mi.Float(0.5),) * 2)
        x, y = (mi.UInt32(u * n) for u, n in zip(place, (width, height), strict=True))
        corner = mi.Vector2f(mi.Float(x), mi.Float(y)) + mi.Vector2f(film.crop_offset())
        sampler = self._sampler(spp)
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, pixels * spp)
        spread = PixelPositions(sampler, seed, spp)
        position = corner + spread.next(y * width + x, sample)
        ray, weight = camera_ray(self._sensor, sampler, position)
        chosen = CameraSampler(sampler, lambda: spread.emitter_sample(y * width + x, sample))
        result = camera_rays.sample(self._scene, chosen, mi.Ray3f(ray), medium, mi.Bool(True))
        radiance = result.scattered if of_volume else result.scattered + result.background
        radiance = mi.Spectrum(radiance * weight) + dr.zeros(mi.Float, pixels * spp)
        dr.eval(radiance)
        means = [dr.block_sum(channel, spp) for channel in radiance]
        return np.array(means, dtype=np.float64).T / spp

    def _sampler(self, spp: int) -> mi.Sampler:
        """Return a copy of the sensor's sampler for ``spp`` samples per pixel."""
        sampler = self._sensor.sampler().clone()
        sampler.set_sample_count(spp)
        return sampler
