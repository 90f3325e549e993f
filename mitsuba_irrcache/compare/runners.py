"""Strategies by which integrators spend time budgets.

A runner is a generator: given a `Subject` and budgets in seconds it yields pairs (snapshot, image).
It is selected by the methods that an integrator offers, never by the integrator's name:

* ``progressive(scene, sensor, seed, spp, times)`` iterates over frames while a cache is refined,
  one at each of the ``times``; each has an ``image``, ``samples`` of the cache, and ``seconds`` by
  stage since the beginning, excluding time between frames. Images that are rendered during the
  iteration use the cache as it is. All snapshots are of one run.
* ``depends_on_view`` is true: the integrator chooses its effort for a stated error, and afterwards
  has a ``certificate`` with the estimated ``error``. There is one image, whatever the budgets.
* ``prepare(scene)`` builds a cache; images are averaged after it.
* Others have images only, which are averaged.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.io.scene_files import (
    describe_integrator,
    has_cache,
    load_scene,
    parse_integrator,
    unknown_properties,
)

from .metrics import colours
from .results import Snapshot

#: The property that sets the effort for an integrator's cache, and its minimum.
EFFORT = "cache_spp"
LEAST_EFFORT = 8
#: The property of integrators with a filter; images of others are averaged and filtered here.
FILTER = ("filter", "bilateral")
#: Share of the time for refining the cache and for images meanwhile; the rest goes into more camera
#: samples of the snapshots.
CACHE_SHARE = 0.7
#: A frame counts for a budget from this share of its time on.
REACHED = 0.95
#: Maximum samples per pixel of one launch.
MOST_SPP = 64

Frames = Iterator[tuple[Snapshot, np.ndarray]]


@dataclass
class Subject:
    """An integrator on a scene, as seen by one sensor.

    ``folder`` is that of `load_scene`; ``filter_seconds`` is the duration of the last filtering.
    """

    scene_file: Path
    parameters: dict[str, str]
    integrator: str
    sensor: int = 0
    folder: str = ""
    launches: int = field(default=0, init=False)
    filter_seconds: float = field(default=0.0, init=False)

    @cached_property
    def is_filtered_here(self) -> bool:
        """Return whether a filter is requested that the integrator does not have."""
        name, value = FILTER
        asked = parse_integrator(self.integrator)[1].get(name) == value
        return asked and name in unknown_properties(self.integrator)

    def specification(self, **properties: object) -> str:
        """Return the specification of the integrator with additional properties."""
        name, given = parse_integrator(self.integrator)
        if self.is_filtered_here:
            del given[FILTER[0]]
        return describe_integrator(name, given | properties)

    def load(self, **properties: object) -> mi.Scene:
        """Load the scene with the integrator and its additional properties."""
        specification = self.specification(**properties)
        return load_scene(self.scene_file, self.parameters, specification, folder=self.folder)

    def render(self, scene: mi.Scene, spp: int) -> tuple[np.ndarray, dict[str, float]]:
        """Render an image with a new seed; return it with the seconds by stage."""
        self.launches += 1
        return render(scene, self.sensor, spp, self.launches)

    def finish(self, average: Average) -> tuple[np.ndarray, dict[str, float]]:
        """Return the averaged image, filtered if that is done here, and the seconds for it."""
        if not self.is_filtered_here:
            return average.mean, {}
        from mitsuba_irrcache.render.denoise import denoise

        started = time.perf_counter()
        image = denoise(colours(average.mean), average.standard_error)
        self.filter_seconds = time.perf_counter() - started
        return image, {"filter": self.filter_seconds}


class Average:
    """The mean of images, and its standard error estimated from their scatter."""

    def __init__(self) -> None:
        self.count = 0
        self._total, self._grey, self._squares = 0.0, 0.0, 0.0

    def add(self, image: np.ndarray) -> None:
        """Add one image (height, width, channel), independent of the others."""
        grey = colours(image).mean(axis=-1, dtype=np.float64)
        self.count += 1
        self._total = self._total + image.astype(np.float64)
        self._grey, self._squares = self._grey + grey, self._squares + grey**2

    @property
    def mean(self) -> np.ndarray:
        """Return the mean (height, width, channel), float64."""
        return self._total / self.count

    @property
    def standard_error(self) -> np.ndarray:
        """Return the standard error of the mean over colours, (height, width)."""
        variance = self._squares / self.count - (self._grey / self.count) ** 2
        return np.sqrt(np.maximum(variance, 0) / (self.count - 1))


def render(
    scene: mi.Scene, sensor: int, spp: int, seed: int
) -> tuple[np.ndarray, dict[str, float]]:
    """Render an image (height, width, channel), float32; return it with the seconds by stage.

    The stages are image and, if the integrator reports it, filter.
    """
    started = time.perf_counter()
    image = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed))
    seconds = time.perf_counter() - started
    filtering = getattr(scene.integrator(), "seconds", {}).get("filter", 0.0)
    stages = {"image": seconds - filtering}
    return image, stages | ({"filter": filtering} if filtering else {})


def prepare(scene: mi.Scene) -> float:
    """Build the integrator's cache; return the seconds."""
    started = time.perf_counter()
    scene.integrator().prepare(scene)
    dr.sync_thread()
    return time.perf_counter() - started


def is_progressive(scene: mi.Scene) -> bool:
    """Return whether the integrator renders images while it refines its cache."""
    return callable(getattr(scene.integrator(), "progressive", None))


def states_error(scene: mi.Scene) -> bool:
    """Return whether the integrator chooses its effort for an error that the user states."""
    return bool(getattr(scene.integrator(), "depends_on_view", False))


def effort_is_free(subject: Subject) -> bool:
    """Return whether the effort for the cache may be chosen here.

    The integrator must have the property, and the user must not have set it.
    """
    if EFFORT in parse_integrator(subject.integrator)[1]:
        return False
    return EFFORT not in unknown_properties(subject.specification(**{EFFORT: LEAST_EFFORT}))


def run(subject: Subject, scene: mi.Scene, budgets: list[float]) -> Frames:
    """Return the runner that suits the integrator of ``scene``.

    The integrator must have rendered an image already, so that its kernels are compiled.
    """
    if states_error(scene):
        yield _certified(subject, budgets)
        return
    if is_progressive(scene) and effort_is_free(subject) and not subject.is_filtered_here:
        yield from _refined(subject, scene, budgets)
        return
    spp = _samples_per_launch(subject, scene, min(budgets))
    if subject.is_filtered_here:
        _warm_up_filter(subject, scene, spp)
    if not has_cache(scene):
        yield from accumulate(subject, scene, budgets, spp, {})
    else:
        scene = subject.load()
        yield from accumulate(subject, scene, budgets, spp, {"cache": prepare(scene)})


def _certified(subject: Subject, budgets: list[float]) -> tuple[Snapshot, np.ndarray]:
    """Return an image of a stated error, with its estimate, for the first budget that suffices."""
    scene = subject.load()
    image, seconds = subject.render(scene, 0)
    spent = sum(seconds.values())
    budget = min((b for b in budgets if b >= spent), default=max(budgets))
    certificate = scene.integrator().certificate
    if certificate is None:  # stopped by a timeout
        return Snapshot(budget, seconds, 0), image
    spp, error = int(certificate.settings["spp"]), certificate.error
    estimate = error if np.isfinite(error) else None
    return Snapshot(budget, seconds, spp, note=str(certificate), estimate=estimate), image


def accumulate(
    subject: Subject,
    scene: mi.Scene,
    budgets: list[float],
    spp: int,
    spent: dict[str, float],
) -> Frames:
    """Average images of ``spp`` samples and different seeds; yield a snapshot at each budget.

    ``spent`` are the seconds of earlier stages. If they exceed several budgets, the first image is
    reported for the largest of these. A filter needs two images to estimate their noise.
    """
    waiting, average, seconds = sorted(budgets), Average(), dict(spent)
    while waiting:
        image, took = subject.render(scene, spp)
        average.add(image)
        seconds = _sum(seconds, took)
        expected = sum(seconds.values()) + 0.5 * sum(took.values()) + subject.filter_seconds
        reached = [b for b in waiting if expected >= b]
        if reached and average.count >= 1 + subject.is_filtered_here:
            waiting = waiting[len(reached) :]
            image, filtering = subject.finish(average)
            yield Snapshot(reached[-1], seconds | filtering, spp * average.count), image


def follow(
    subject: Subject, scene: mi.Scene, frames: Iterable, budgets: list[float], spp: int
) -> Frames:
    """Yield snapshots of a progressive run, whose frames have ``spp`` samples.

    For each budget, the first frame that reaches `CACHE_SHARE` of it is averaged with further
    images until the budget is spent.
    """
    waiting, between = sorted(budgets), {}
    for frame in frames:
        elapsed = sum(frame.seconds.values())
        reached = [b for b in waiting if elapsed >= REACHED * CACHE_SHARE * b]
        if reached:
            waiting = waiting[len(reached) :]
            average, took = Average(), {}
            average.add(np.array(frame.image))
            while elapsed + sum(between.values()) + 0.5 * sum(took.values()) < reached[-1]:
                image, took = subject.render(scene, spp)
                average.add(image)
                between = _sum(between, took)
            note = f"{frame.samples} samples per voxel"
            seconds = _sum(frame.seconds, between)
            yield Snapshot(reached[-1], seconds, spp * average.count, note=note), average.mean
        if not waiting:
            return


def _refined(subject: Subject, scene: mi.Scene, budgets: list[float]) -> Frames:
    """Yield the snapshots of one progressive run.

    If the run ends early because the cache is complete, further images are averaged.
    """
    times = [CACHE_SHARE * b for b in budgets]

    def frames(scene: mi.Scene, spp: int) -> Iterator:
        return scene.integrator().progressive(
            scene, sensor=subject.sensor, seed=0, spp=spp, times=times
        )

    # Compiles the kernels that only a progressive run has, and measures the time to its first
    # image.
    first = next(iter(frames(subject.load(), 1)))
    spp = _samples_per_launch(subject, scene, max(min(budgets), sum(first.seconds.values())))
    scene, last = subject.load(), 0.0
    for snapshot, image in follow(subject, scene, frames(scene, spp), budgets, spp):
        last = snapshot.budget
        yield snapshot, image
    if left := [b for b in budgets if b > last]:
        yield from accumulate(subject, scene, left, spp, {"cache": prepare(scene)})


def _sum(a: dict[str, float], b: dict[str, float]) -> dict[str, float]:
    return {key: a.get(key, 0.0) + b.get(key, 0.0) for key in a | b}


def _warm_up_filter(subject: Subject, scene: mi.Scene, spp: int) -> None:
    """Compile the filter's kernels and measure the filter's duration."""
    average = Average()
    for _ in range(2):
        average.add(subject.render(scene, spp)[0])
    for _ in range(2):
        subject.finish(average)


def _samples_per_launch(subject: Subject, scene: mi.Scene, budget: float) -> int:
    """Return the samples per launch, and compile the kernels for them.

    It is a power of two whose launch takes about a tenth of the smallest budget, or 50 ms if that
    is longer.
    """
    once, more = (min(sum(subject.render(scene, n)[1].values()) for _ in range(2)) for n in (1, 4))
    rate = max((more - once) / 3, 1e-4)
    # The fixed cost of a launch, for example of a filter, should be less than half of it.
    wanted = max(1 + (max(0.1 * budget, 0.05) - once) / rate, once / rate)
    spp = 2 ** int(np.log2(np.clip(wanted, 1, MOST_SPP)))
    subject.render(scene, spp)
    return spp
