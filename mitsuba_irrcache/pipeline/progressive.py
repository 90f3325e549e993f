"""Progressive rendering: an early image, then better ones while the cache is refined.

    for frame in render_progressive(scene, seconds=10):
        mi.util.write_bitmap("image.png", frame.image)

A *pass* adds samples to the cache, a *frame* is an image rendered with the cache. The length of a
pass and the time of the next frame follow from the measured times of earlier passes and frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.statistics import BATCH
from mitsuba_irrcache.core.cancellation import Stopped
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.builder import CacheBuilder, Progress, Stage

#: Samples per voxel of the first pass: two for each of two batches, for a standard error.
FIRST = 4
#: Number of samples per voxel up to which passes may be smaller than a batch.
OPENING = 2 * BATCH
#: Number of first frames, one after each doubling of the samples; later ones have a minimum
#: interval.
EARLY_FRAMES = 3
#: Minimum interval between frames: the time to render an image, divided by this share, ...
IMAGE_SHARE = 0.2
#: ... and the elapsed time times this factor, because later images differ less.
GROWTH = 0.25
#: Assumed ratio of the actual to the predicted duration, when a time limit has to be kept.
SAFETY = 1.1
#: Fraction of the time requested for a frame at which it may be rendered already, since passes have
#: a minimum length.
REACHED = 0.97


@dataclass(frozen=True)
class Targets:
    """When a progressive run ends: as soon as one of the given targets is reached; if none is
    given, at the integrator's ``cache_spp``.

    Attributes:
        cache_spp: samples per voxel, rounded up to batches; math.inf for a run without end.
        standard_error: relative standard error of the cache, see `IrradianceCache.relative_error`.
        seconds: time limit for cache and images, by which the last image is complete. The first
            image is rendered even if it takes longer.
        times: times [s] at which frames are requested, instead of the default intervals. Each frame
            is finished as soon after its time as passes allow; the last one ends the run.
    """

    cache_spp: float = 0
    standard_error: float = 0.0
    seconds: float = math.inf
    times: Sequence[float] = ()

    def __post_init__(self) -> None:
        spp = self.cache_spp
        if not spp >= 0 or (spp != math.inf and spp != int(spp)):
            raise IrrcacheError(
                f"progressive: cache_spp is {spp!r}; it must be a number of samples, math.inf, or "
                "0 (no target)."
            )
        if not 0 <= self.standard_error < math.inf:
            raise IrrcacheError(
                f"progressive: standard_error is {self.standard_error!r}; it must be a fraction of "
                "the mean irradiance, for example 0.01, or 0 (no target)."
            )
        for name, values in (("seconds", [self.seconds]), ("times", self.times)):
            for value in values:
                if not value > 0:
                    raise IrrcacheError(f"progressive: {name} is {value!r}; it must be above 0.")

    @property
    def given(self) -> bool:
        """Whether there is any target."""
        return bool(self.cache_spp or self.standard_error or self.times) or self.seconds < math.inf


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a progressive run.

    Attributes:
        image: (height, width, channel), as ``mi.render`` gives it.
        samples: samples per voxel of the cache so far; 0 if no cache is needed.
        standard_error: relative standard error of the cache, see `IrradianceCache.relative_error`.
        seconds: time spent so far by stage: "cache", "image" (of all frames), and "filter" if the
            integrator filters images. Time that the caller spends between frames does not count.
    """

    image: mi.TensorXf
    samples: int
    standard_error: float
    seconds: dict[str, float]

    @property
    def elapsed(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())


def render_progressive(
    scene: mi.Scene,
    sensor: int | mi.Sensor = 0,
    spp: int = 0,
    seed: int = 0,
    *,
    cache_spp: float = 0,
    standard_error: float = 0.0,
    seconds: float = math.inf,
    times: Sequence[float] = (),
) -> Iterator[Frame]:
    """Render a ``scene`` whose integrator is ``irrcache``; return frames of increasing quality.

    See `Targets` for the last four arguments, which determine when the run ends. Every frame is
    rendered with ``spp`` samples per pixel and ``seed``; the last one uses the final cache. A
    ``cache_file`` is written at intervals and at the end, also after an exception. The integrator
    keeps the cache, and another run continues to refine it. ``cancel()`` of the integrator ends the
    run without another frame. Raises IrrcacheError for other integrators and for invalid targets.
    """
    integrator = scene.integrator()
    if not hasattr(integrator, "progressive"):
        raise IrrcacheError(
            f"render_progressive: the scene's integrator is {integrator.class_name()}, which has "
            "no cache to refine; use irrcache."
        )
    targets = {
        "cache_spp": cache_spp,
        "standard_error": standard_error,
        "seconds": seconds,
        "times": times,
    }
    return integrator.progressive(scene, sensor, seed, spp, **targets)


def frames(
    builder: CacheBuilder,
    scene: mi.Scene,
    image: Callable[[], tuple[mi.TensorXf, float]],
    targets: Targets,
    progress: Progress | None = None,
) -> Iterator[Frame]:
    """Yield the frames of a run.

    ``image`` renders one with the current cache; it returns the image, and how many seconds of its
    duration the filter took.
    """
    with builder.checkpoints() as checkpoint, builder.stage() as stage:
        try:
            run = _Run(builder, stage, scene, targets, progress)
            run.begin()
            while True:
                while samples := run.next_pass():
                    run.refine(samples, checkpoint)
                yield run.frame(image)
                if run.is_over:
                    return
        except Stopped:
            return


class _Run:
    """The stages of a run, and their times."""

    def __init__(
        self,
        builder: CacheBuilder,
        stage: Stage,
        scene: mi.Scene,
        targets: Targets,
        progress: Progress | None,
    ) -> None:
        self.builder, self.stage, self.scene, self.progress = builder, stage, scene, progress
        self.targets = targets
        self.schedule = Schedule(targets.seconds, targets.times)
        self._opening = OPENING  # samples up to which passes may be smaller than a batch
        self.error = math.nan
        self._is_last = False  # whether the last frame fulfils the targets

    def begin(self) -> None:
        """Create or load the cache, with a first pass if it has no samples."""
        goal = self.targets.cache_spp if self.targets.given else self.builder.samples
        self.stage.early = not 0 < goal < OPENING
        self._update(FIRST if self.stage.early else goal, lambda: None)
        if self.builder.cache is not None and not self.builder.has_preview:
            self._opening = 0
            self.schedule.batch = self.schedule.first = self.builder.cache.batch
        self.goal = self.targets.cache_spp or math.inf
        if not self.targets.given and self.builder.cache is not None:
            with self.builder.lock:
                first, self.stage.samples = self.stage.samples, 0
                self.goal, self.stage.samples = self.builder.target, first

    def refine(self, samples: int, checkpoint: Callable[[], None]) -> None:
        """Run a pass, after which the cache has ``samples`` per voxel."""
        self._update(samples, checkpoint)

    def frame(self, image: Callable[[], tuple[mi.TensorXf, float]]) -> Frame:
        """Render an image with the current cache."""
        with self.builder.lock:
            started = perf_counter()  # without the time spent waiting for other threads
            tensor, filtering = image()
            dr.sync_thread()
            # Another thread may refine the cache once the lock is released.
            samples = self._samples
            self._is_last = self._is_fulfilled_by(samples)
        self.schedule.note_image(perf_counter() - started, filtering)
        return Frame(tensor, samples, self.error, dict(self.schedule.seconds))

    def next_pass(self) -> int:
        """Return the samples per voxel after the next pass; 0 if a frame is due."""
        # Another thread may refine the cache between two reads, and a pass on top of its samples
        # would exceed the target.
        done = self._samples
        if self._is_fulfilled_by(done):
            return 0
        needed = self.goal - done
        if self.targets.standard_error and math.isnan(self.error):
            needed = min(needed, 1)
        elif self.targets.standard_error:
            ratio = self.error / self.targets.standard_error
            needed = min(needed, done * (ratio**2 - 1))
        samples = self.schedule.next_pass(done, needed)
        if samples == 0:
            return 0
        # A pass beyond the first two batches would compile kernels of another size.
        return done + samples if done >= self._opening else min(done + samples, self._opening)

    @property
    def is_over(self) -> bool:
        """Whether the latest frame is the last one."""
        return self._is_last or self.schedule.is_over

    @property
    def _samples(self) -> int:
        return self.builder.done

    def _is_fulfilled_by(self, samples: int) -> bool:
        """Return whether a cache with ``samples`` per voxel meets the targets."""
        wanted = self.targets.standard_error
        exact = wanted > 0 and self.error <= wanted
        return exact or samples >= self.goal or self.builder.is_dark

    def _update(self, samples: int, checkpoint: Callable[[], None]) -> None:
        with self.builder.lock:
            self.stage.samples = samples
            started, old, before = perf_counter(), self.builder.cache, self._samples
            self.builder.update(self.scene, self.progress)
            cache = self.builder.cache
            if cache is not old:
                before = self.builder.saved_samples  # a new cache begins with those of its file
            self.error = self.builder.relative_error
        checkpoint()
        self.schedule.note_pass(max(self._samples - before, 0), perf_counter() - started)


class Schedule:
    """Decides when to refine and when to render; all times in seconds since the beginning."""

    def __init__(self, limit: float = math.inf, times: Sequence[float] = ()) -> None:
        self.limit, self.times = limit, sorted(times)
        self.seconds = {"cache": 0.0, "image": 0.0}
        self._passes: list[tuple[int, float]] = []
        self._frames = 0
        self._last_frame = 0.0  # time at which the last frame was finished
        self._image = 0.0  # seconds that it took
        self._fresh = False  # whether there has been a pass since the last frame
        #: samples of the first pass, and of a batch; later passes are whole batches
        self.first, self.batch = FIRST, BATCH
        self._grain = FIRST  # samples of the smallest pass

    @property
    def elapsed(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())

    @property
    def is_over(self) -> bool:
        """Whether no better frame can follow in time, or none is wanted."""
        wanted = not self.times or self._last_frame < REACHED * self.times[-1]
        return not wanted or self._samples_within(self._left) < self._grain

    def note_pass(self, samples: int, seconds: float) -> None:
        """Record the ``seconds`` of a pass of ``samples`` per voxel; 0: loaded from a file."""
        self.seconds["cache"] += seconds
        if samples:
            self._passes.append((samples, seconds))
        self._fresh = True

    def note_image(self, seconds: float, filtering: float = 0.0) -> None:
        """Record the ``seconds`` of an image, of which a filter took ``filtering``."""
        self.seconds["image"] += seconds - filtering
        if filtering:
            self.seconds["filter"] = self.seconds.get("filter", 0.0) + filtering
        self._frames += 1
        self._image, self._last_frame, self._fresh = seconds, self.elapsed, False

    def next_pass(self, done: int, needed: float) -> int:
        """Return the samples per voxel that the next pass should add; 0 if a frame is due.

        The cache has ``done`` samples per voxel, and ``needed`` more are required. After the first
        two batches passes consist of complete batches.
        """
        self._grain = grain = self.batch if done >= 2 * self.batch else self.first
        possible = self._samples_within(self._left)
        possible -= possible % grain if possible < math.inf else 0
        due = self._due
        soonest = due * (REACHED if self.times else 1)
        if possible < grain or (self._fresh and self.elapsed + self._image >= soonest):
            return 0
        # Predictions are not extrapolated beyond twice the samples.
        samples = min(needed, possible, done)
        if self._frames >= EARLY_FRAMES or self.times:
            samples = min(samples, self._samples_within(due - self.elapsed - self._image))
        return max(grain, -(-int(samples) // grain) * grain)

    @property
    def _left(self) -> float:
        """Seconds that passes may take before the last image has to be rendered."""
        return (self.limit - self.elapsed) / SAFETY - self._image

    @property
    def _due(self) -> float:
        """Time at which the next frame should be finished."""
        if not self._frames:
            return 0.0
        if self.times:
            waiting = (t for t in self.times if self._last_frame < REACHED * t)
            return next(waiting, math.inf)
        if self._frames < EARLY_FRAMES:
            return self._last_frame
        interval = max(self._image / IMAGE_SHARE, GROWTH * self._last_frame)
        # After the next frame enough time should be left for another one.
        last = self._last_frame + 2 * interval > self.limit
        return math.inf if last else self._last_frame + interval

    def _samples_within(self, seconds: float) -> float:
        """Predict how many samples per voxel a pass can add in ``seconds``, from earlier passes.

        The prediction is linear between the shortest and the longest pass, and proportional to the
        duration beyond the longest one.
        """
        if seconds == math.inf:
            return math.inf
        if not self._passes:
            return self.batch if seconds > 0 else 0
        measured = self._passes[1:] or self._passes  # the first one may have compiled kernels
        (least, short), (most, long) = min(measured), max(measured)
        if seconds < long and short < long and least < most:
            samples = most - (long - seconds) * (most - least) / (long - short)
        else:
            samples = most * seconds / max(long, 1e-9)
        return samples // self.first * self.first
