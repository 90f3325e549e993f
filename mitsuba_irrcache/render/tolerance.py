"""Choose cache, step and samples per pixel such that an image has at most a given error.

The error of an image has independent parts, each of which gets a share of the tolerance. All are
measured on the image itself, along probe rays that are spread over the film:

- *Voxels*: caches of increasing resolution. If the error is C h^p, where h is the voxel edge, the
  images for h and r h differ by C h^p (r^p - 1). The order p follows from three resolutions
  (Richardson extrapolation); from two, a low one is assumed.
- *Directions*, or samples per voxel: the variance between coarse caches with different seeds. With
  `sweep` all voxels share their ordinates, so that the variance hardly depends on the resolution;
  with `path` it is larger for coarser caches.
- *Steps*: the difference from ray marching with half the step.
- *Pixels*: the variance between renderings with different seeds, for some pixels of the film.

Resolutions grow geometrically, so that all coarser caches together cost a fraction of the last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.cancellation import Stopped
from mitsuba_irrcache.core.jit import Divisor
from mitsuba_irrcache.core.sequences import kronecker
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings, Progress
from mitsuba_irrcache.pipeline.defaults import needs_no_cache
from mitsuba_irrcache.render.camera import CameraRays, ClosedFormCameraRays, TracedCameraRays
from mitsuba_irrcache.render.film import CameraSampler, PixelPositions, camera_ray

#: Shares of the tolerance; their squares add up to about 1. Work is in proportion to n^3 N for n
#: voxels along an axis and N directions; with errors of order n^-p and N^(-1/2) it is least where
#: the squares of both are in the ratio 3 : 2 p.
SHARES = {"voxels": 0.62, "directions": 0.62, "steps": 0.3, "pixels": 0.35}
#: Values of the property ``tolerance_of``.
SCALES = ("image", "volume")
#: Rays that are compared, pixels that are sampled, and seeds with which they are.
RAYS, PIXELS, GROUPS = 1 << 14, 1 << 8, 4
#: Resolution of the first cache, the ratio between resolutions, and its minimum.
COARSEST, LARGEST_RATIO, SMALLEST_RATIO = 16, 2.0, 1.4
#: Order of the error in the voxel edge: assumed if it is not known, and its limits.
ASSUMED_ORDER, ORDERS = 1.3, (0.8, 2.0)
#: The next resolution is larger by this factor than predicted.
MARGIN = 1.2
#: Finest resolution that is tried, unless the data have more voxels along their longest side.
FINEST = 256
#: Seeds by which the scatter of a coarse cache is measured.
SEEDS = 4
#: Most directions or samples per voxel that are chosen; the order of the error in their number by
#: which the next one is predicted, between that of random and that of stratified ones; and limits
#: of its ratio to the one before.
MOST_SAMPLES, SAMPLE_ORDER, SAMPLE_RATIOS = 1 << 12, 0.7, (1.5, 4.0)
#: Steps that are tried, from the longest on.
STEPS = (4.0, 2.0, 1.0, 0.5, 0.25)
#: Order of the error in the step.
STEP_ORDER = 2
#: Samples per pixel that are tried.
MOST_PIXEL_SAMPLES = 1 << 10

MakeCameraRays = Callable[[CacheBuilder, float], CameraRays]
if TYPE_CHECKING:  # types of Mitsuba exist once a variant is set
    Rays = tuple[mi.Ray3f, mi.Spectrum, mi.Medium | None]


@dataclass(frozen=True)
class Certificate:
    """Estimated error of an image: RMSE over its pixels, in units of the mean radiance.

    Attributes:
        tolerance: the requested error.
        tolerance_of: "image", or "volume" if the unit is the mean radiance of the media alone.
        parts: estimated RMSE by "voxels", "directions", "steps" and "pixels"; parts that do not
            exist for a scene are 0. Empty if there is no estimate.
        settings: the chosen "resolution", "cache_spp", "step" and "spp".
        open_points: errors that the estimate does not include, or why the tolerance is not met.
    """

    tolerance: float
    tolerance_of: str
    parts: dict[str, float]
    settings: dict[str, float]
    open_points: tuple[str, ...] = ()

    @property
    def error(self) -> float:
        """Return the estimated RMSE of the image in units of the mean radiance; NaN if unknown."""
        if not self.parts:
            return float("nan")
        return float(np.sqrt(sum(part**2 for part in self.parts.values())))

    @property
    def is_met(self) -> bool:
        """Whether the estimated error is at most the tolerance; False without an estimate."""
        return self.error <= self.tolerance

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {100 * value:.2g} %" for name, value in self.parts.items())
        settings = ", ".join(f"{name} {value:g}" for name, value in self.settings.items())
        if not self.parts:
            return "; ".join((*self.open_points, settings))
        text = (
            f"error {100 * self.error:.2g} % of the mean radiance of the {self.tolerance_of} "
            f"({parts}), tolerance {100 * self.tolerance:.2g} %: {settings}"
        )
        return "; ".join((text, *self.open_points))


class Level:
    """A cache of one resolution, with its camera rays by step."""

    def __init__(self, resolution: int, builder: CacheBuilder, make: MakeCameraRays) -> None:
        self.resolution, self.builder, self._make = resolution, builder, make
        #: radiance (ray, channel) along the probe rays
        self.radiance = np.zeros((0, 1))
        self._camera_rays: dict[float, CameraRays] = {}
        self._revision = -1

    def camera_rays(self, step: float) -> CameraRays:
        """Return the camera rays for the current cache."""
        if self._revision != self.builder.revision:
            self._camera_rays, self._revision = {}, self.builder.revision
        if step not in self._camera_rays:
            self._camera_rays[step] = self._make(self.builder, step)
        return self._camera_rays[step]


class ToleranceSearch:
    """Finds the settings with which the image of a sensor has at most a given error.

    The caches of all resolutions are kept: for another sensor only the probe rays are new.
    """

    def __init__(
        self,
        tolerance: float,
        tolerance_of: str,
        settings: CacheSettings,
        step: float | None,
        new_builder: Callable[[CacheSettings], CacheBuilder],
        camera_rays: MakeCameraRays,
    ) -> None:
        """Store settings. Values of ``settings`` that are not 0, and ``step`` if it is not None,
        are fixed; the others are searched for.
        """
        self.tolerance, self._of = tolerance, tolerance_of
        self._settings, self._step = settings, step
        self._new_builder, self._camera_rays = new_builder, camera_rays
        self._levels: list[Level] = []
        self._samples = settings.samples
        self._notes: list[str] = []
        self._view: tuple = ()  # what the last result was found for
        self._found: tuple | None = None

    def share(self, part: str) -> float:
        """Return the largest error of a part of the estimate."""
        return SHARES[part] * self.tolerance

    @property
    def finest(self) -> CacheBuilder | None:
        """Builder of the finest cache so far, also of a search that was stopped; None without."""
        return self._levels[-1].builder if self._levels else None

    def find(
        self, scene: mi.Scene, sensor: mi.Sensor, spp: int, seed: int, progress: Progress | None
    ) -> tuple[CacheBuilder, float, int, Certificate]:
        """Return the builder of a cache, a step and the samples per pixel with which the image of
        ``sensor`` meets the tolerance, as far as the limits permit; and the estimate of its error.

        ``spp`` is 0, or the number of samples per pixel to be used.
        """
        rays = _probe_rays(sensor)
        self._begin(scene, progress)
        view = spp, *_values_of(rays)
        if view != self._view:
            self._view, self._notes = (), []
            self._found = self._search(scene, sensor, rays, (spp, seed), progress)
            self._view = view
        return self._found

    def _search(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        rays: Rays,
        samples: tuple[int, int],
        progress: Progress | None,
    ) -> tuple[CacheBuilder, float, int, Certificate]:
        """Return the result of `find` for a view, given by its probe ``rays``; ``samples`` are the
        number of samples per pixel and their seed.
        """
        spp, seed = samples
        first = self._levels[0]
        closed = self._closed_form(scene)
        if closed is not None:
            return self._without_cache(scene, sensor, spp, seed, closed, progress)
        mean = self._mean(scene, sensor, seed)
        for level in self._levels:
            level.radiance = self._probe(scene, level, rays)
        parts = {"voxels": 0.0, "directions": 0.0}
        if not first.builder.is_dark:
            parts["directions"] = self._fit_samples(scene, rays, mean, progress)
            parts["voxels"] = self._fit_resolution(scene, rays, mean, progress)
        last = self._levels[-1]
        step, parts["steps"] = self._fit_step(scene, last, rays, mean)
        camera_rays = last.camera_rays(step)
        spp, parts["pixels"] = self._fit_pixels(scene, sensor, camera_rays, spp, seed, mean)
        if isinstance(camera_rays, TracedCameraRays):
            self._notes.append("the irradiance of surfaces is not part of the estimate")
        found = {"resolution": last.resolution, "cache_spp": last.builder.done}
        found |= {"step": step, "spp": spp}
        certificate = Certificate(self.tolerance, self._of, parts, found, tuple(self._notes))
        return last.builder, step, spp, certificate

    # Caches

    def _begin(self, scene: mi.Scene, progress: Progress | None) -> None:
        """Bring the coarsest cache up to date; discard all others if the scene has changed."""
        if not self._levels:
            self._levels = [self._level(self._settings.resolution or COARSEST)]
        first = self._levels[0].builder
        before = first.revision
        first.fit(scene)
        if first.revision != before:
            del self._levels[1:]
            self._view = ()
            self._samples = first.samples = self._settings.samples
        first.update(scene, progress)

    def _level(self, resolution: int, seed: int = 0) -> Level:
        """Return a level whose cache is empty."""
        settings = replace(
            self._settings,
            resolution=resolution,
            seed=self._settings.seed + seed,
            samples=self._samples,
            file="",
        )
        return Level(resolution, self._new_builder(settings), self._camera_rays)

    def _built(
        self, scene: mi.Scene, resolution: int, seed: int, progress: Progress | None
    ) -> Level:
        level = self._level(resolution, seed)
        level.builder.update(scene, progress)
        return level

    def _closed_form(self, scene: mi.Scene) -> str | None:
        """Return why no cache is needed; None if one is."""
        builder, depth = self._levels[0].builder, self._settings.max_depth
        if depth in (0, 1) or not builder.parts:
            return "nothing is scattered" if builder.parts else "no medium is visible"
        if len(builder.parts) > 1:
            return None
        return needs_no_cache(scene, builder.medium, depth, self._settings.resolution)

    def _without_cache(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        spp: int,
        seed: int,
        reason: str,
        progress: Progress | None,
    ) -> tuple[CacheBuilder, float, int, Certificate]:
        """Return the result of `find` for a scene without a cache."""
        builder = self._new_builder(replace(self._settings, file=""))
        builder.update(scene, progress)
        step = self._step or 1.0
        spp = spp or sensor.sampler().sample_count()
        found = {"step": step, "spp": spp}
        notes = (f"no estimate, since {reason}",)
        return builder, step, spp, Certificate(self.tolerance, self._of, {}, found, notes)

    def _fit_samples(
        self, scene: mi.Scene, rays: Rays, mean: float, progress: Progress | None
    ) -> float:
        """Choose the samples per voxel from the scatter of coarse caches; return the error."""
        if len(self._levels) > 1:
            return self._direction_error  # of another view, with the same ordinates
        wanted, most = self.share("directions"), MOST_SAMPLES
        while True:
            error, used = self._scatter(scene, rays, mean, progress), self._levels[0].builder.done
            self._direction_error = error
            if self._settings.samples or error <= wanted:
                return error
            if used >= most:
                self._notes.append(f"more than {used} samples per voxel were not tried")
                return error
            ratio = np.clip((error / wanted) ** (1 / SAMPLE_ORDER), *SAMPLE_RATIOS)
            self._samples = min(int(np.ceil(used * ratio)), most)
            # The batches of a cache depend on the number of its samples.
            resolution = self._levels[0].resolution
            self._levels = [self._built(scene, resolution, 0, progress)]
            self._levels[0].radiance = self._probe(scene, self._levels[0], rays)

    def _scatter(
        self, scene: mi.Scene, rays: Rays, mean: float, progress: Progress | None
    ) -> float:
        """Return the standard error of an image due to the directions, from other seeds."""
        # docs/primer, eq. (7.4)
        first = self._levels[0]
        images = [first.radiance]
        for seed in range(1, SEEDS):
            level = self._built(scene, first.resolution, seed, progress)
            images.append(self._probe(scene, level, rays))
        return float(np.sqrt(np.var(images, axis=0, ddof=1).mean())) / mean

    def _fit_resolution(
        self, scene: mi.Scene, rays: Rays, mean: float, progress: Progress | None
    ) -> float:
        """Add finer caches until the error of the voxels has its share; return it."""
        wanted = self.share("voxels")
        if self._settings.resolution:
            coarse = self._built(scene, max(self._settings.resolution // 2, 1), 0, progress)
            coarse.radiance = self._probe(scene, coarse, rays)
            return self._error([coarse, self._levels[0]], mean)
        while True:
            error = self._error(self._levels, mean)
            if error <= wanted:
                return error
            if len(self._levels) > 2 and error > self._error(self._levels[:-1], mean):
                self._notes.append("the error does not decrease with the resolution")
                return error
            resolution = self._next_resolution(error / wanted)
            if resolution > self._finest:
                self._notes.append(f"resolutions above {self._finest} were not tried")
                return error
            try:
                level = self._built(scene, resolution, 0, progress)
            except Stopped:
                self._notes.append(f"the time did not suffice for resolution {resolution}")
                return error
            except IrrcacheError as problem:
                self._notes.append(f"resolution {resolution} is not possible: {problem}")
                return error
            level.radiance = self._probe(scene, level, rays)
            self._levels.append(level)

    @property
    def _finest(self) -> int:
        """Finest resolution that is tried."""
        grids = (part.medium.sigma_t.grid for part in self._levels[0].builder.parts)
        return max([FINEST, *(max(grid.shape) for grid in grids if grid is not None)])

    def _next_resolution(self, excess: float) -> int:
        """Return the resolution at which the error is predicted to be smaller by ``excess``."""
        last = self._levels[-1].resolution
        ratio = LARGEST_RATIO
        if len(self._levels) > 1 and np.isfinite(excess):
            ratio = MARGIN * excess ** (1 / self._order(self._levels))
        return int(np.ceil(last * np.clip(ratio, SMALLEST_RATIO, LARGEST_RATIO)))

    def _order(self, levels: list[Level]) -> float:
        """Estimate the order of the error in the voxel edge from the last three levels."""
        # docs/primer, eq. (7.3)
        if len(levels) < 3:
            return ASSUMED_ORDER
        a, b, c = levels[-3:]
        coarse, fine = _rms(a.radiance - b.radiance), _rms(b.radiance - c.radiance)
        orders = np.linspace(*ORDERS, 61)
        # I(h) - I(r h) is in proportion to (r^p - 1) h^p.
        u, v = b.resolution / a.resolution, c.resolution / b.resolution
        ratios = (u**orders - 1) * v**orders / (v**orders - 1)
        return float(orders[np.abs(ratios - coarse / max(fine, 1e-30)).argmin()])

    def _error(self, levels: list[Level], mean: float) -> float:
        """Estimate the error of the finest level due to its voxels."""
        if len(levels) < 2:
            return float("inf")
        coarse, fine = levels[-2:]
        ratio = fine.resolution / coarse.resolution
        difference = _rms(fine.radiance - coarse.radiance) / mean
        return difference / (ratio ** self._order(levels) - 1)

    # March

    def _fit_step(
        self, scene: mi.Scene, level: Level, rays: Rays, mean: float
    ) -> tuple[float, float]:
        """Choose the longest step whose error has its share; return both."""
        steps = STEPS if self._step is None else (self._step, self._step / 2)
        error, chosen = float("inf"), steps[0]
        before = self._probe(scene, level, rays, steps[0])
        for step, half in pairwise(steps):
            after = self._probe(scene, level, rays, half)
            error = _rms(before - after) / mean / (1 - 2.0**-STEP_ORDER)
            chosen, before = step, after
            if error <= self.share("steps"):
                break
        return chosen, error

    def _probe(
        self, scene: mi.Scene, level: Level, rays: Rays, step: float | None = None
    ) -> np.ndarray:
        """Return the radiance (ray, channel) of the media along the probe rays."""
        camera_rays = level.camera_rays(step or self._step or 1.0)
        ray, weight, medium = rays
        found = camera_rays.sample(scene, _Middle(), mi.Ray3f(ray), medium, mi.Bool(True))
        radiance = found.scattered
        if isinstance(camera_rays, ClosedFormCameraRays):
            radiance = radiance + found.background
        return np.array(mi.Spectrum(radiance * weight), dtype=np.float64).T

    # Pixels

    def _mean(self, scene: mi.Scene, sensor: mi.Sensor, seed: int) -> float:
        """Return the mean radiance to which errors are relative."""
        camera_rays = self._levels[0].camera_rays(self._step or 1.0)
        samples = _pixel_samples(scene, sensor, camera_rays, 1, seed, self._of == "volume")
        mean = float(samples.mean())
        if not mean > 0:
            raise IrrcacheError(
                f"irrcache: the {self._of} has no radiance in the view of the sensor, so there is "
                "no unit for its tolerance; set resolution instead of tolerance."
            )
        return mean

    def _fit_pixels(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        camera_rays: CameraRays,
        spp: int,
        seed: int,
        mean: float,
    ) -> tuple[int, float]:
        """Choose the samples per pixel, unless ``spp`` is given; return their number and error."""
        tried = _rounded(sensor, spp or sensor.sampler().sample_count())
        while True:
            samples = _pixel_samples(scene, sensor, camera_rays, tried, seed, False)
            error = float(np.sqrt(samples.var(axis=0, ddof=1).mean())) / mean
            if spp or error <= self.share("pixels"):
                return tried, error
            if tried >= MOST_PIXEL_SAMPLES:
                self._notes.append(f"more than {tried} samples per pixel were not tried")
                return tried, error
            wanted = tried * (error / self.share("pixels")) ** 2
            tried = int(2 ** np.ceil(np.log2(np.clip(wanted, 2 * tried, 8 * tried))))
            tried = _rounded(sensor, min(tried, MOST_PIXEL_SAMPLES))


class _Middle:
    """A sampler that always returns 0.5, so that images of two caches can be compared."""

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        return mi.Float(0.5)

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        return mi.Point2f(0.5)


def _probe_rays(sensor: mi.Sensor) -> Rays:
    """Return rays spread over the film, their weights, and the sensor's medium."""
    film = sensor.film()
    count = min(RAYS, 4 * int(np.prod(film.crop_size())))
    place = mi.Point2f(kronecker(dr.arange(mi.UInt32, count), 2, (mi.Float(0.5),) * 2))
    position = place * mi.Vector2f(film.crop_size()) + mi.Vector2f(film.crop_offset())
    ray, weight = camera_ray(sensor, _Middle(), position)
    dr.eval(ray, weight)
    return ray, weight, sensor.get_medium()


def _pixel_samples(
    scene: mi.Scene,
    sensor: mi.Sensor,
    camera_rays: CameraRays,
    spp: int,
    seed: int,
    of_volume: bool,
) -> np.ndarray:
    """Return means of ``spp`` samples (group, pixel, channel) in pixels spread over the film.

    The groups have different seeds.
    """
    spp = _rounded(sensor, spp)
    film, medium = sensor.film(), sensor.get_medium()
    width, height = (int(n) for n in film.crop_size())
    pixels = min(PIXELS, width * height)
    lane, sample = Divisor(spp).split(dr.arange(mi.UInt32, pixels * spp))
    place = kronecker(lane, 2, (mi.Float(0.5),) * 2)
    x, y = (mi.UInt32(u * n) for u, n in zip(place, (width, height), strict=True))
    corner = mi.Vector2f(mi.Float(x), mi.Float(y)) + mi.Vector2f(film.crop_offset())
    found = []
    for group in range(GROUPS):
        sampler = _sampler(sensor, spp)
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed + group, pixels * spp)
        spread = PixelPositions(sampler, seed + group, spp)
        position = corner + spread.next(y * width + x, sample)
        ray, weight = camera_ray(sensor, sampler, position)
        chosen = CameraSampler(sampler, lambda s=sampler: s.next_2d())
        result = camera_rays.sample(scene, chosen, mi.Ray3f(ray), medium, mi.Bool(True))
        radiance = result.scattered if of_volume else result.scattered + result.background
        radiance = mi.Spectrum(radiance * weight) + dr.zeros(mi.Float, pixels * spp)
        dr.eval(radiance)
        found.append([np.array(dr.block_sum(c, spp), dtype=np.float64) / spp for c in radiance])
    return np.moveaxis(np.array(found), 1, 2)


def _rounded(sensor: mi.Sensor, spp: int) -> int:
    """Return the samples per pixel that the sensor's sampler uses for ``spp``."""
    return _sampler(sensor, spp).sample_count()


def _sampler(sensor: mi.Sensor, spp: int) -> mi.Sampler:
    """Return a copy of the sensor's sampler for ``spp`` samples per pixel."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    return sampler


def _values_of(rays: Rays) -> tuple:
    """Return the values of rays that identify them, to detect a change of the sensor."""
    ray, weight, medium = rays
    arrays = mi.Vector3f(ray.o), mi.Vector3f(ray.d), ray.time, mi.Spectrum(weight)
    return (*(np.array(a).tobytes() for a in arrays), medium)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
