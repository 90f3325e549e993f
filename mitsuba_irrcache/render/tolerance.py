"""Choose cache, step and samples per pixel such that an image has at most a given error.

The error of an image has independent parts, whose squares add up. All are measured on the image
itself, as means over pixels along probe rays that are spread over the film:

- *Voxels*: caches of increasing resolution. If the error is C h^p, where h is the voxel edge, the
  images for h and r h differ by C h^p (r^p - 1). The order p follows from three resolutions
  (Richardson extrapolation); from two, a low one is assumed. Detail of the data that is smaller
  than the voxels may be missing in both images, and has an estimate of its own.
- *Directions*, or samples per voxel: every cache consists of at least two parts of independent
  samples, whose images differ. The product of the differences that two parts have between two
  resolutions does not contain their noise.
- *Steps*: the difference from ray marching with half the step.
- *Pixels*: the variance between renderings with different seeds, for some pixels of the film.

Resolutions grow geometrically, so that all coarser caches together cost a fraction of the last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.cancellation import Stopped
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings, Progress
from mitsuba_irrcache.pipeline.defaults import needs_no_cache
from mitsuba_irrcache.render.camera import CameraRays, TracedCameraRays
from mitsuba_irrcache.render.certificate import Certificate
from mitsuba_irrcache.render.probe_rays import ProbeRays, SampledPixels
from mitsuba_irrcache.solvers.grid_size import unresolved_error

#: Shares of the tolerance. Work is in proportion to n^3 N for n voxels along an axis and N
#: directions; with errors of order n^-p and N^(-1/2) it is least where the squares of both are in
#: the ratio 3 : 2 p. What one part leaves of its share is used by those that are fitted after it.
SHARES = {"voxels": 0.62, "directions": 0.62, "steps": 0.3, "pixels": 0.35}
#: The least share of the directions.
LEAST_OF_DIRECTIONS = 0.3
#: Values of the property ``tolerance_of``.
SCALES = ("image", "volume")
#: Resolution of the first cache, the ratio between resolutions, and its minimum.
COARSEST, LARGEST_RATIO, SMALLEST_RATIO = 8, 2.0, 1.3
#: Order of the error in the voxel edge: assumed for the first two levels, and if it is not known,
#: and its limits. Fewer voxels than FEWEST are too few to estimate it.
FIRST_ORDER, ASSUMED_ORDER, ORDERS, FEWEST = 1.0, 1.3, (0.8, 1.7), 16
#: The least error due to detail that voxels do not resolve, in units of its estimate.
LEAST_OF_DETAIL = 1 / 3
#: The next resolution is larger by this factor than predicted.
MARGIN = 1.1
#: Finest resolution that is tried, unless the data have more voxels along their longest side.
FINEST = 256
#: Minimum number of directions or samples in a part of a cache, for single scattering and for
#: several orders; maximum number in parts of finer caches. With few ordinates the solution for all
#: orders is not only noisy, but too bright (.7 % of the mean with 64, albedo .98 and depth 12).
LEAST_PART_ONCE, LEAST_PART, LARGEST_PART = 64, 128, 256
#: Ratio of the scatter of fine to that of coarse caches, about; and the number of independent
#: values, about, in an image's noise due to directions, which all pixels share.
LESS_SCATTER, INDEPENDENT = 0.4, 10
#: Scatter of a level, at least, in units of that expected from the level before.
LEAST_DECREASE = 0.6
#: Most directions or samples per voxel that are chosen.
MOST_SAMPLES = 1 << 12
#: The longest and the shortest step that are tried, and the order of the error in it.
STEPS, STEP_ORDER = (4.0, 0.25), 2
#: Samples per pixel that are tried.
MOST_PIXEL_SAMPLES = 1 << 10

MakeCameraRays = Callable[[CacheBuilder, float], CameraRays]


@dataclass
class Found:
    """Result of a search: the builder of a cache, its camera rays, and settings."""

    builder: CacheBuilder
    camera_rays: CameraRays | None
    step: float
    spp: int
    certificate: Certificate


class Level:
    """A cache of one resolution, and images of the probe rays for it."""

    def __init__(self, resolution: int, builder: CacheBuilder, make: MakeCameraRays) -> None:
        self.resolution, self.builder, self._make = resolution, builder, make
        #: radiance (pixel, channel) for the whole cache, and for its first part alone
        self.radiance = self.first = np.zeros((0, 1))
        #: samples of a part
        self.part = 0
        #: standard error due to the directions, in units of the mean; for later views of a cache
        #: that of the first one. None: not measured yet
        self.scatter: float | None = None
        #: ratio of the noise-free difference from the coarser level to that with noise, likewise
        self.noise_free: float | None = None
        self._camera_rays: dict[float, CameraRays] = {}
        self._revision = -1

    def camera_rays(self, step: float) -> CameraRays:
        """Return the camera rays for the current cache."""
        if self._revision != self.builder.revision:
            self._camera_rays, self._revision = {}, self.builder.revision
        if step not in self._camera_rays:
            self._camera_rays[step] = self._make(self.builder, step)
        return self._camera_rays[step]

    def reset(self, samples: int) -> None:
        """Discard the measurements of another scene."""
        self.builder.samples, self.scatter, self.noise_free = samples, None, None

    def error_of_detail(self) -> float:
        """Return the least error due to detail of the data that the voxels do not resolve."""
        parts = [part for part in self.builder.parts if part.cache is not None]
        errors = (unresolved_error(part.medium, part.cache.grid) for part in parts)
        return LEAST_OF_DETAIL * max(errors, default=0.0) / 100


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
        self._notes: list[str] = []
        self._view: tuple = ()  # what the last result was found for
        self._found: Found | None = None
        self.is_stopped = False  # whether the time did not suffice

    @property
    def finest(self) -> CacheBuilder | None:
        """Builder of the finest cache so far, also of a search that was stopped; None without."""
        return self._levels[-1].builder if self._levels else None

    def find(
        self, scene: mi.Scene, sensor: mi.Sensor, spp: int, seed: int, progress: Progress | None
    ) -> Found:
        """Return the cache, the step and the samples per pixel with which the image of ``sensor``
        meets the tolerance, as far as the limits permit; and the estimate of its error.

        ``spp`` is 0, or the number of samples per pixel to be used.
        """
        rays = ProbeRays(sensor)
        self._begin(scene, progress)
        view = spp, *rays.identity
        if view != self._view:
            self._view, self._notes, self.is_stopped = (), [], False
            pixels = SampledPixels(scene, sensor, seed)
            self._found = self._search(scene, sensor, rays, pixels, spp, progress)
            # The next rendering continues a search that was stopped.
            self._view = () if self.is_stopped else view
        return self._found

    def _search(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        rays: ProbeRays,
        pixels: SampledPixels,
        spp: int,
        progress: Progress | None,
    ) -> Found:
        """Return the result of `find` for a view."""
        closed = self._closed_form(scene)
        if closed is not None:
            return self._without_cache(scene, sensor, spp, closed, progress)
        first = self._levels[0]
        mean = pixels.mean(first.camera_rays(self._step or 1.0), self._of == "volume")
        if not mean > 0:
            raise IrrcacheError(
                f"irrcache: the {self._of} has no radiance in the view of the sensor, so there is "
                "no unit for its tolerance; set resolution instead of tolerance."
            )
        fit = _CacheFit(self, scene, rays, mean, progress)
        parts = {"voxels": 0.0, "directions": 0.0}
        if first.builder.is_dark:
            first.radiance = fit.probe(first)
        else:
            parts["voxels"] = fit.refine_voxels()
        last = self._levels[-1]
        step, parts["steps"] = self._fit_step(last, fit)
        if not first.builder.is_dark:
            parts["directions"] = fit.refine_directions(parts)
        camera_rays = last.camera_rays(step)
        spp, parts["pixels"] = self._fit_pixels(
            sensor, scene, pixels, camera_rays, spp, parts, mean
        )
        if isinstance(camera_rays, TracedCameraRays):
            self._notes.append("the irradiance of surfaces is not part of the estimate")
        settings = {"resolution": last.resolution, "cache_spp": last.builder.done}
        settings |= {"step": step, "spp": spp}
        certificate = Certificate(self.tolerance, self._of, parts, settings, tuple(self._notes))
        return Found(last.builder, camera_rays, step, spp, certificate)

    def share(self, part: str) -> float:
        """Return the largest error of a part of the estimate."""
        return SHARES[part] * self.tolerance

    def rest(self, *errors: float) -> float:
        """Return what other ``errors`` leave of the tolerance."""
        return float(np.sqrt(max(0.99 * self.tolerance**2 - np.square(errors).sum(), 0)))

    # Caches

    def _begin(self, scene: mi.Scene, progress: Progress | None) -> None:
        """Bring the coarsest cache up to date; discard all others if the scene has changed."""
        resolution = self._settings.resolution
        if not self._levels:
            self._levels = [self.level(max(resolution // 2, 1) if resolution else COARSEST)]
        first = self._levels[0].builder
        before = first.revision
        first.fit(scene)
        if first.revision != before:
            del self._levels[1:]
            self._levels[0].reset(first.settings.samples)
            self._view = ()
        first.update(scene, progress)

    @property
    def least_part(self) -> int:
        """Least samples of a part of a cache."""
        return LEAST_PART_ONCE if self._settings.max_depth == 2 else LEAST_PART

    def level(self, resolution: int, samples: int = 0) -> Level:
        """Return a level whose cache is empty, and has this number of samples in its first part;
        0: the least.
        """
        given = self._settings.samples
        samples = -(-given // 2) if given else samples or self.least_part
        settings = replace(
            self._settings, resolution=resolution, samples=samples, file="", warns=False
        )
        return Level(resolution, self._new_builder(settings), self._camera_rays)

    def _closed_form(self, scene: mi.Scene) -> str | None:
        """Return why no cache is needed; None if one is."""
        builder, depth = self._levels[0].builder, self._settings.max_depth
        if depth in (0, 1) or not builder.parts:
            return "nothing is scattered" if builder.parts else "no medium is visible"
        if len(builder.parts) > 1:
            return None
        return needs_no_cache(scene, builder.medium, depth, self._settings.resolution)

    def _without_cache(
        self, scene: mi.Scene, sensor: mi.Sensor, spp: int, reason: str, progress: Progress | None
    ) -> Found:
        """Return the result of `find` for a scene without a cache."""
        builder = self._new_builder(replace(self._settings, file=""))
        builder.update(scene, progress)
        step = self._step or 1.0
        spp = spp or sensor.sampler().sample_count()
        settings, notes = {"step": step, "spp": spp}, (f"no estimate, since {reason}",)
        certificate = Certificate(self.tolerance, self._of, {}, settings, notes)
        return Found(builder, None, step, spp, certificate)

    # March

    def _fit_step(self, level: Level, fit: _CacheFit) -> tuple[float, float]:
        """Choose the longest step whose error has its share; return both."""
        images = {1.0: level.radiance} if self._step is None else {self._step: level.radiance}

        def error(step: float) -> float:
            for each in (step, step / 2):
                if each not in images:
                    images[each] = fit.probe(level, each)
            difference = _rms(images[step] - images[step / 2])
            return difference / fit.mean / (1 - 2.0**-STEP_ORDER)

        if self._step is not None:
            return self._step, error(self._step)
        step, largest = 2.0, self.share("steps")
        found = error(step)
        while found > largest and step > STEPS[1]:
            step /= 2
            found = error(step)
        while step >= 2 and step < STEPS[0]:
            longer = error(2 * step)
            if longer > largest:
                break
            step, found = 2 * step, longer
        return step, found

    # Pixels

    def _fit_pixels(
        self,
        sensor: mi.Sensor,
        scene: mi.Scene,
        pixels: SampledPixels,
        camera_rays: CameraRays,
        spp: int,
        parts: dict[str, float],
        mean: float,
    ) -> tuple[int, float]:
        """Choose the samples per pixel, unless ``spp`` is given; return their number and error."""
        largest = max(self.rest(*parts.values()), self.share("pixels"))
        tried = pixels.rounded(spp or sensor.sampler().sample_count())
        while True:
            if isinstance(camera_rays, TracedCameraRays):
                camera_rays.prepare_view(scene, sensor, tried, self._settings.seed)
            error = pixels.standard_error(camera_rays, tried) / mean
            if spp or error <= largest:
                return tried, error
            if tried >= MOST_PIXEL_SAMPLES:
                self._notes.append(f"more than {tried} samples per pixel were not tried")
                return tried, error
            wanted = tried * (error / largest) ** 2
            tried = int(2 ** np.ceil(np.log2(np.clip(wanted, 2 * tried, 8 * tried))))
            tried = pixels.rounded(min(tried, MOST_PIXEL_SAMPLES))


class _CacheFit:
    """Refines the caches of a ``search`` for a view, given by its probe rays."""

    def __init__(
        self,
        search: ToleranceSearch,
        scene: mi.Scene,
        rays: ProbeRays,
        mean: float,
        progress: Progress | None,
    ) -> None:
        self._search, self._scene, self._rays = search, scene, rays
        self.mean, self._progress = mean, progress
        self._levels, self._settings = search._levels, search._settings
        self._notes = search._notes

    def refine_voxels(self) -> float:
        """Add finer caches until the error of the voxels is within its limit; return it."""
        for level in self._levels:
            self._complete(level)
        if self._settings.resolution:
            if len(self._levels) == 1:
                self._add(self._settings.resolution)
        else:
            self._add_levels()
        return self._error_of_voxels(self._levels)

    def probe(self, level: Level, step: float | None = None) -> np.ndarray:
        """Return the radiance (pixel, channel) of the media along the probe rays."""
        step = step or self._search._step or 1.0
        return self._rays.radiance(self._scene, level.camera_rays(step))

    def _stop(self, what: str) -> None:
        """Note for ``what`` the time did not suffice."""
        self._search.is_stopped = True
        self._notes.append(f"the time did not suffice {what}")

    def _add(self, resolution: int, samples: int = 0) -> None:
        """Add a level of another resolution."""
        level = self._search.level(resolution, samples)
        level.builder.update(self._scene, self._progress)
        self._complete(level)
        # Parts of few directions may differ less than usual by chance.
        before = self._levels[-1]
        expected = before.scatter * np.sqrt(before.builder.done / level.builder.done)
        level.scatter = max(level.scatter, LEAST_DECREASE * float(expected))
        self._levels.append(level)

    def _complete(self, level: Level) -> None:
        """Fill a level to at least two parts, and measure its images along the probe rays."""
        builder = level.builder
        if level.scatter is not None:  # of another view
            level.radiance = level.first = self.probe(level)
            return
        level.first, level.part = self.probe(level), builder.done
        builder.samples = 2 * level.part
        # docs/primer, eq. (7.5)
        builder.update(self._scene, self._progress)
        level.radiance = self.probe(level)
        level.scatter = _rms(level.radiance - level.first) / self.mean

    # Voxels

    def _add_levels(self) -> None:
        """Add finer levels until the error of the voxels is within its limit, or others end it."""
        while True:
            error = self._error_of_voxels(self._levels)
            if self._is_fine_enough(error):
                return
            earlier = [self._error_of_voxels(self._levels[:-n]) for n in (1, 2)]
            if len(self._levels) > 4 and error > max(earlier):
                self._notes.append("the error does not decrease with the resolution")
                return
            resolution = self._next_resolution(error / self._search.share("voxels"))
            if resolution > self._finest:
                self._notes.append(f"resolutions above {self._finest} were not tried")
                return
            try:
                self._add(resolution, self._size_of_parts())
            except Stopped:
                self._stop(f"for resolution {resolution}")
                return
            except IrrcacheError as problem:
                self._notes.append(f"resolution {resolution} is not possible: {problem}")
                return

    def _is_fine_enough(self, error: float) -> bool:
        """Return whether no finer voxels are needed: their ``error`` is within its share, or it is
        cheaper to reduce that of the directions instead.
        """
        last, search = self._levels[-1], self._search
        if error <= search.share("voxels"):
            return True
        rest = search.rest(error, search.share("steps"), search.share("pixels"))
        if rest < LEAST_OF_DIRECTIONS * search.tolerance:
            return False
        # Work in units of that for the last level.
        more_directions = max((last.scatter / rest) ** 2 - 1, 0.0)
        finer = self._next_resolution(error / search.share("voxels")) / last.resolution
        return more_directions <= finer**3 * (last.scatter / search.share("directions")) ** 2

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

    def _difference(self, coarse: Level, fine: Level) -> float:
        """Return the RMS difference of the images of two levels without their noise.

        The differences that two independent parts have between the levels contain independent
        noise, so that it vanishes in their product.
        """
        whole = fine.radiance - coarse.radiance
        if fine.noise_free is None:
            first = fine.first - coarse.first
            second = 2 * whole - first
            noise = np.square(first - second).mean() / 4  # variance of the mean of both
            product = max(float(np.mean(first * second)), 0.0) + noise / INDEPENDENT**0.5
            fine.noise_free = min(float(np.sqrt(product)) / max(_rms(whole), 1e-30), 1.0)
        return fine.noise_free * _rms(whole)

    def _order(self, levels: list[Level]) -> float:
        """Estimate the order of the error in the voxel edge from the last three levels."""
        # docs/primer, eq. (7.4)
        if len(levels) < 3:
            return FIRST_ORDER
        if levels[-3].resolution < FEWEST:
            return ASSUMED_ORDER
        a, b, c = levels[-3:]
        coarse, fine = self._difference(a, b), self._difference(b, c)
        orders = np.linspace(*ORDERS, 61)
        # I(h) - I(r h) is in proportion to (r^p - 1) h^p.
        u, v = b.resolution / a.resolution, c.resolution / b.resolution
        ratios = (u**orders - 1) * v**orders / (v**orders - 1)
        return float(orders[np.abs(ratios - coarse / max(fine, 1e-30)).argmin()])

    def _error_of_voxels(self, levels: list[Level]) -> float:
        """Estimate the error of the finest level due to its voxels."""
        if len(levels) < 2:
            return float("inf")
        coarse, fine = levels[-2:]
        ratio = fine.resolution / coarse.resolution
        if ratio == 1:
            return float("inf")
        difference = self._difference(coarse, fine) / self.mean
        return max(difference / (ratio ** self._order(levels) - 1), fine.error_of_detail())

    # Directions

    def _size_of_parts(self) -> int:
        """Return the samples of a part of the next level's cache: half of those that its share of
        the error is predicted to need.

        It is the same for all levels but the first ones: their noise is then similar, and hardly
        contained in their differences.
        """
        last = self._levels[-1]
        if len(self._levels) < 2:
            return self._search.least_part
        if len(self._levels) > 2:
            return last.part
        excess = LESS_SCATTER * last.scatter / self._search.share("directions")
        needed = max(last.builder.done * excess**2, 1.0)
        return int(
            2 ** np.round(np.log2(np.clip(needed / 2, self._search.least_part, LARGEST_PART)))
        )

    def refine_directions(self, others: dict[str, float]) -> float:
        """Add parts to the finest cache until the error of the directions is at most what the
        ``others`` leave of the tolerance; return it.
        """
        last, search = self._levels[-1], self._search
        rest = search.rest(others["voxels"], others["steps"], search.share("pixels"))
        largest = max(rest, LEAST_OF_DIRECTIONS * search.tolerance)
        while not self._settings.samples and last.scatter > largest:
            done = last.builder.done
            if done >= MOST_SAMPLES:
                self._notes.append(f"more than {done} samples per voxel were not tried")
                break
            wanted = done * (last.scatter / largest) ** 2
            last.builder.samples = int(min(np.clip(wanted, 1.2 * done, 8 * done), MOST_SAMPLES))
            try:
                last.builder.update(self._scene, self._progress)
            except Stopped:
                self._stop("for more samples per voxel")
                break
            now = last.builder.done
            if now == done:
                break
            before, last.radiance = last.radiance, self.probe(last)
            # The mean of all parts differs from that of the first m of n by sqrt(1 / m - 1 / n).
            change = _rms(last.radiance - before) / self.mean / np.sqrt(1 / done - 1 / now)
            last.scatter = float(np.sqrt(0.5 * (last.scatter**2 * done + change**2) / now))
        return last.scatter


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
