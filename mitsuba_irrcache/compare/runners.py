"""How an integrator spends a time budget: by more samples of the image, or on its cache first.

A runner is a generator: given a `Subject` and budgets in seconds it yields pairs (snapshot, image).
An integrator is told apart by what it offers, never by its name: one with a method
``prepare(scene)`` has a cache.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.loading import load_scene, parse_integrator

from .results import Snapshot

#: The property by which an integrator with a cache is told how much to spend on it, and its
#: smallest value.
EFFORT = "cache_spp"
LEAST_EFFORT = 8
#: Part of a budget that goes into the cache; the rest goes into samples of the image.
CACHE_SHARE = 0.85
#: Most samples per pixel of one launch.
MOST_SPP = 64

Frames = Iterator[tuple[Snapshot, np.ndarray]]


@dataclass
class Subject:
    """An integrator on a scene, seen by one sensor."""

    scene_file: Path
    parameters: dict[str, str]
    integrator: str
    sensor: int = 0
    launches: int = field(default=0, init=False)

    def load(self, **properties: object) -> mi.Scene:
        """The scene with the integrator, which gets some more properties."""
        name, given = parse_integrator(self.integrator)
        body = ",".join(f"{k}={_text(v)}" for k, v in (given | properties).items())
        return load_scene(self.scene_file, self.parameters, f"{name}{{{body}}}")

    def render(self, scene: mi.Scene, spp: int) -> tuple[np.ndarray, float]:
        """An image with a seed of its own, and the seconds it took."""
        self.launches += 1
        return render(scene, self.sensor, spp, self.launches)


def render(scene: mi.Scene, sensor: int, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """An image (height, width, channel), float32, and the seconds until it was there."""
    started = time.perf_counter()
    image = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed))
    return image, time.perf_counter() - started


def prepare(scene: mi.Scene) -> float:
    """Builds the integrator's cache; the seconds it took."""
    started = time.perf_counter()
    scene.integrator().prepare(scene)
    dr.sync_thread()
    return time.perf_counter() - started


def has_cache(scene: mi.Scene) -> bool:
    """Whether the integrator builds a cache before it renders."""
    method = getattr(scene.integrator(), "prepare", None)
    # Mitsuba's differentiable integrators have another method of this name.
    return callable(method) and "scene" in inspect.signature(method).parameters


def effort_is_free(subject: Subject) -> bool:
    """Whether the effort spent on the cache may be chosen to fit a budget: the integrator knows the
    property, and the user has not set it.
    """
    if EFFORT in parse_integrator(subject.integrator)[1]:
        return False
    try:
        subject.load(**{EFFORT: LEAST_EFFORT})
    except RuntimeError:  # Mitsuba refuses a property that the plugin does not read
        return False
    return True


def run(subject: Subject, scene: mi.Scene, budgets: list[float]) -> Frames:
    """The runner that fits the integrator of ``scene``, which has rendered an image already: its
    kernels are compiled.
    """
    spp = _samples_per_launch(subject, scene, min(budgets))
    if not has_cache(scene):
        yield from accumulate(subject, scene, budgets, spp, {})
    elif effort_is_free(subject):
        yield from _fitted(subject, budgets, spp)
    else:
        scene = subject.load()
        yield from accumulate(subject, scene, budgets, spp, {"cache": prepare(scene)})


def accumulate(
    subject: Subject,
    scene: mi.Scene,
    budgets: list[float],
    spp: int,
    spent: dict[str, float],
) -> Frames:
    """Averages images of ``spp`` samples and different seeds; a snapshot at every budget.

    ``spent`` are the seconds of earlier stages. Where they outlast several budgets, the first image
    stands for the largest of these.
    """
    waiting = sorted(budgets)
    total, launches, seconds = 0.0, 0, 0.0
    while waiting:
        image, took = subject.render(scene, spp)
        total, launches, seconds = total + image.astype(np.float64), launches + 1, seconds + took
        reached = [b for b in waiting if sum(spent.values()) + seconds + 0.5 * took >= b]
        if reached:
            waiting = waiting[len(reached) :]
            snapshot = Snapshot(reached[-1], spent | {"image": seconds}, spp * launches)
            yield snapshot, total / launches


def _fitted(subject: Subject, budgets: list[float], spp: int) -> Frames:
    """For each budget a run of its own, with as much effort on the cache as it allows."""
    costs = [_cache_cost(subject, LEAST_EFFORT)]
    for budget in without_unreachable(budgets, costs[0][1]):
        effort = choose_effort(costs, CACHE_SHARE * budget)
        scene = subject.load(**{EFFORT: effort})
        seconds = prepare(scene)
        costs.append((effort, seconds))
        for snapshot, image in accumulate(subject, scene, [budget], spp, {"cache": seconds}):
            snapshot.note = f"{EFFORT}={effort}"
            yield snapshot, image


def without_unreachable(budgets: list[float], least: float) -> list[float]:
    """The budgets in order; of those below ``least`` seconds only the largest, for an image."""
    early = [b for b in budgets if b < least]
    return ([max(early)] if early else []) + sorted(b for b in budgets if b >= least)


def _cache_cost(subject: Subject, effort: int) -> tuple[int, float]:
    return effort, prepare(subject.load(**{EFFORT: effort}))


def choose_effort(costs: list[tuple[int, float]], seconds: float) -> int:
    """The effort that takes about ``seconds``, from pairs (effort, seconds) that were measured; the
    cost is taken to be a constant plus a part proportional to effort.
    """
    (least, base), (most, top) = min(costs), max(costs)
    rate = (top - base) / (most - least) if most > least else base / least
    if rate <= 0:
        return most * 2
    effort = least + (seconds - base) / rate
    limit = 32 * most  # far beyond what was measured the line cannot be trusted
    return int(np.clip(effort // LEAST_EFFORT * LEAST_EFFORT, LEAST_EFFORT, limit))


def _samples_per_launch(subject: Subject, scene: mi.Scene, budget: float) -> int:
    """Samples per launch: a power of two that takes about a tenth of the smallest budget, or 50 ms
    if that is longer. The kernels for it are compiled afterwards.
    """
    _, once = min((subject.render(scene, 1) for _ in range(2)), key=lambda pair: pair[1])
    _, more = min((subject.render(scene, 4) for _ in range(2)), key=lambda pair: pair[1])
    rate = max((more - once) / 3, 1e-4)
    wanted = 1 + (max(0.1 * budget, 0.05) - once) / rate
    spp = 2 ** int(np.log2(np.clip(wanted, 1, MOST_SPP)))
    subject.render(scene, spp)
    return spp


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
