"""The schedule of refinement and rendering in progressive runs, on simulated machines."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from mitsuba_irrcache.cache.statistics import BATCH
from mitsuba_irrcache.pipeline.progressive import (
    EARLY_FRAMES,
    FIRST,
    IMAGE_SHARE,
    OPENING,
    Schedule,
    Targets,
    _Run,
)


def play(schedule, fixed=0.01, each=0.01, image=0.05, compile=0.0, noise=0.0, frames=40):
    """Run a schedule with passes of ``fixed`` seconds plus ``each`` per sample.

    Yields (elapsed, samples, seconds of images) of every frame.
    """
    rng = random.Random(1)

    def took(seconds):
        return seconds * (1 + noise * rng.uniform(-1, 1))

    done = FIRST
    schedule.note_pass(done, took(fixed + each * done) + compile)
    for frame in itertools.count():
        while samples := schedule.next_pass(done, math.inf):
            assert samples > 0 and samples % (BATCH if done >= OPENING else FIRST) == 0
            if done < OPENING:
                samples = min(samples, OPENING - done)
            done += samples
            schedule.note_pass(samples, took(fixed + each * samples))
        schedule.note_image(took(image) + (compile if frame == 0 else 0))
        yield schedule.elapsed, done, schedule.seconds["image"]
        if schedule.is_over or frame + 1 == frames:
            return


COSTS = [(0.01, 0.01, 0.05), (0.0, 1e-4, 3.0), (0.2, 0.001, 0.01), (0.0, 0.5, 0.2)]


@pytest.mark.parametrize("costs", COSTS)
def test_images_take_a_fifth_of_the_time(costs):
    """After the first frames, images take a fifth of the time, and each shows more samples."""
    frames = list(play(Schedule(), *costs))
    assert len(frames) == 40
    start, _, images = frames[EARLY_FRAMES - 1]
    for elapsed, _, seconds in frames[EARLY_FRAMES:]:
        assert seconds - images <= IMAGE_SHARE * (elapsed - start) * 1.001
    samples = [n for _, n, _ in frames]
    assert samples == sorted(set(samples)) and samples[0] == FIRST


def test_compiling_does_not_delay_the_next_frames():
    """Compilation in the first pass and image does not delay the second and third frame."""
    (first, _, _), _, (third, _, _) = play(Schedule(), compile=5.0, frames=3)
    assert third - first < 2


@pytest.mark.parametrize("costs", COSTS)
@pytest.mark.parametrize("limit", [0.1, 5.0, 60.0, 1000.0])
@pytest.mark.parametrize("compile", [0.0, 4.0])
def test_a_time_limit_is_kept(costs, limit, compile):
    """With costs that vary by 5 %, a run ends within its limit, unless the first frame exceeds
    it.

    It does not stop while another batch would easily fit.
    """
    frames = list(play(Schedule(limit), *costs, compile=compile, noise=0.05, frames=1000))
    assert frames[-1][0] <= limit or len(frames) == 1
    fixed, each, image = costs
    if len(frames) > 4:
        assert limit - frames[-1][0] < 0.1 * limit + 1.3 * (fixed + BATCH * each + image)


@pytest.mark.parametrize("each", [0.001, 0.004])
def test_wanted_times_are_met(each):
    """Frames meet requested times to a tenth if batches are short; the last one ends the run."""
    times = [1.0, 1.5, 12.0, 13.0, 100.0]
    frames = list(play(Schedule(times=times), each=each, noise=0.03))
    assert len(frames) <= len(times) + 2
    for wanted in times:
        assert min(abs(elapsed - wanted) for elapsed, _, _ in frames) <= 0.1 * wanted


def test_times_that_passes_are_too_coarse_for():
    """If passes are longer than the intervals, each frame follows the first batch past its time.

    The last one ends the run.
    """
    frames = list(play(Schedule(times=[1, 2, 30, 31]), each=1.0))
    reached = [next(e for e, _, _ in frames if e >= 0.97 * t) for t in (1, 2, 30, 31)]
    assert reached[0] == reached[1] == frames[0][0]
    assert reached[3] == frames[-1][0] < 31 + BATCH + 1


def test_needed_samples_are_not_exceeded():
    schedule = Schedule()
    schedule.note_pass(FIRST, 0.1)
    schedule.note_image(0.01)
    assert schedule.next_pass(64, 8) == BATCH
    assert schedule.next_pass(64, 20.5) == 3 * BATCH
    assert schedule.next_pass(64, math.inf) == 64


def test_a_cache_from_a_file_is_shown_at_once():
    """The first pass on a loaded cache is small, since no pass has been measured yet."""
    schedule = Schedule(limit=10)
    schedule.note_pass(0, 0.01)
    assert schedule.next_pass(512, math.inf) == 0
    schedule.note_image(0.1)
    assert 0 < schedule.next_pass(512, math.inf) <= 512


class RefinedByOthers:
    """A builder whose cache another thread refines by a batch after each look at its samples."""

    is_dark = False

    def __init__(self):
        self._done = 0

    @property
    def done(self) -> int:
        self._done += BATCH
        return self._done


@pytest.mark.parametrize("goal", [4 * BATCH, 5 * BATCH, 9 * BATCH])
def test_passes_of_other_threads_do_not_add_up(goal):
    """The samples after the next pass do not exceed the target, however often other threads refine
    the cache meanwhile.
    """
    run = _Run(RefinedByOthers(), None, None, Targets(cache_spp=goal), None)
    run.goal = goal
    run.schedule.note_pass(BATCH, 0.1)
    run.schedule.note_image(0.01)
    asked = []
    run._update = lambda samples, _: asked.append(samples)
    while samples := run.next_pass():
        run.refine(samples, None)
    assert asked and max(asked) <= goal
