"""Progressive rendering gives the cache of a single build, whenever and however a run ends."""

from __future__ import annotations

import math
from itertools import islice, pairwise

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline import builder, progressive
from mitsuba_irrcache.pipeline.progressive import render_progressive
from mitsuba_irrcache.solvers.path import solver as path_solver

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.fixture
def cloud(scenes):
    """Return a function that loads a small cloud with the integrator ``irrcache``."""
    to_world = scenes.placement(turn=20)
    medium = scenes.medium(scenes.texture((6, 5, 7), 0.2, 2.0, 1), 0.8, to_world)

    def make(type="irrcache", shape=True, **properties) -> mi.Scene:
        integrator = {"type": type, "max_depth": 3} | properties
        if type == "irrcache":
            integrator = {"resolution": 8, "cache_spp": 64} | integrator
        return scenes.load(
            integrator, scenes.boundary(medium, to_world) if shape else None, default_solver="path"
        )

    return make


def statistics(cache: IrradianceCache) -> list[np.ndarray]:
    return [np.array(t) for t in (cache.uncollided, cache.scattered, cache.standard_error)]


def assert_same(a: IrradianceCache, b: IrradianceCache) -> None:
    """Assert equality bit by bit."""
    assert a.streams == b.streams
    for mine, theirs in zip(statistics(a), statistics(b), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_final_cache_equals_a_single_build(scenes, cloud):
    """The final cache and image equal those of a single build bit by bit, with other passes.

    The first frame has a few samples of two batches; each further frame has more samples and a
    smaller error.
    """
    scene, plain = cloud(), cloud()
    frames = list(render_progressive(scene, spp=2, seed=3))
    expected = scenes.image(plain, spp=2, seed=3)
    assert_same(scene.integrator().cache, plain.integrator().cache)
    np.testing.assert_array_equal(np.array(frames[-1].image, dtype=np.float64), expected)
    assert [f.samples for f in frames[:3]] == [4, 8, 16] and frames[-1].samples == 64
    for before, after in pairwise(frames):
        assert after.samples > before.samples
        assert 0 < after.standard_error < before.standard_error < 0.5
        assert after.elapsed > before.elapsed
        assert not np.array_equal(np.array(after.image), np.array(before.image))
        assert set(after.seconds) == {"cache", "image"}


def test_the_relative_error_is_that_of_the_voxels(cloud):
    scene = cloud()
    scene.integrator().prepare(scene)
    cache = scene.integrator().cache
    active = np.array(cache.active)
    error, mean = (
        np.array(t, dtype=np.float64).reshape(-1, 3)[active].mean(axis=1)
        for t in (cache.standard_error, cache.irradiance)
    )
    expected = np.sqrt(np.mean(error**2)) / mean.mean()
    assert cache.relative_error == pytest.approx(expected, rel=1e-4)


def test_images_between_frames_use_the_current_cache(scenes, cloud, refine_calls):
    """Rendering other views between frames takes no cache samples, and shows the current cache."""
    scene = cloud()
    run = render_progressive(scene, spp=2, seed=3, cache_spp=math.inf)
    frame = next(run)
    np.testing.assert_array_equal(scenes.image(scene, spp=2, seed=3), np.array(frame.image))
    assert refine_calls == []
    run.close()
    assert scene.integrator().cache_spp == 64


@pytest.mark.parametrize(
    ("targets", "samples"),
    [({"cache_spp": 8}, [8]), ({"cache_spp": 12}, [16]), ({"cache_spp": 24}, [4, 8, 16, 24])],
)
def test_few_samples(cloud, targets, samples):
    """A single batch has no error estimate; requested samples are rounded up to batches."""
    frames = list(render_progressive(cloud(), spp=1, **targets))
    assert [f.samples for f in frames] == samples
    assert math.isnan(frames[0].standard_error) == (samples == [8])


def test_a_wanted_error_ends_it(cloud):
    first = next(render_progressive(cloud(), spp=1))
    wanted = 0.6 * first.standard_error
    *_, before, last = render_progressive(cloud(), spp=1, standard_error=wanted)
    assert last.standard_error <= wanted < before.standard_error
    assert last.samples < 2 * 16 / 0.6**2


def test_without_an_end(cloud):
    """Without a limit, frames continue beyond the integrator's own number of samples."""
    frames = list(islice(render_progressive(cloud(cache_spp=16), spp=1, cache_spp=math.inf), 6))
    assert frames[5].samples > frames[4].samples > 16


class Clock:
    """A simulated clock, advanced by samples and images only."""

    def __init__(self, monkeypatch, sample: float, image: float) -> None:
        self.now = 0.0
        monkeypatch.setattr(progressive, "perf_counter", lambda: self.now)
        monkeypatch.setattr(builder, "perf_counter", lambda: self.now)
        refine = path_solver.PathSolver.refine

        def slow_refine(solver, samples, *args):
            refine(solver, samples, *args)
            self.now += sample * samples

        grow = path_solver.Opening.grow

        def slow_grow(opening, size, *args):
            self.now += sample * 2 * (size - opening.size)
            grow(opening, size, *args)

        monkeypatch.setattr(path_solver.PathSolver, "refine", slow_refine)
        monkeypatch.setattr(path_solver.Opening, "grow", slow_grow)
        self.image = image

    def slow_images(self, scene: mi.Scene) -> None:
        integrator = scene.integrator()
        render = integrator.render

        def slow_render(*args, **kwargs):
            self.now += self.image
            return render(*args, **kwargs)

        integrator.render = slow_render


@pytest.mark.parametrize("seconds", [0.5, 3.0, 7.0])
def test_a_budget_is_kept(cloud, monkeypatch, seconds):
    """The last image is complete within the budget, most of which is used.

    The first image is always rendered.
    """
    clock, scene = Clock(monkeypatch, sample=0.05, image=0.1), cloud()
    clock.slow_images(scene)
    *_, last = render_progressive(scene, spp=1, seconds=seconds)
    assert last.elapsed == pytest.approx(clock.now)
    assert 0.6 * seconds < last.elapsed <= seconds + 1e-9


def test_a_budget_is_kept_with_a_cache_from_a_file(cloud, monkeypatch, tmp_path):
    """Samples loaded from a file do not affect the estimated time per sample."""
    file = str(tmp_path / "light.npz")
    list(render_progressive(cloud(cache_file=file), spp=1, cache_spp=256))
    clock, scene = Clock(monkeypatch, sample=0.05, image=0.1), cloud(cache_file=file)
    clock.slow_images(scene)
    first, *_, last = render_progressive(scene, spp=1, seconds=6)
    assert (first.samples, first.elapsed) == (256, pytest.approx(0.1))
    assert last.samples > 256 and 4 < last.elapsed <= 6


def test_wanted_times(cloud, monkeypatch):
    """Frames are rendered at the requested times of 2 s and 4 s after the first one, and no
    others.
    """
    clock, scene = Clock(monkeypatch, sample=0.01, image=0.1), cloud()
    clock.slow_images(scene)
    frames = list(render_progressive(scene, spp=1, times=[4, 2]))
    assert [round(f.elapsed, 1) for f in frames] == pytest.approx([0.1, 2, 4], abs=0.15)


def test_time_of_the_caller_does_not_count(cloud, monkeypatch):
    clock, scene = Clock(monkeypatch, sample=0.01, image=0.1), cloud()
    clock.slow_images(scene)
    elapsed = []
    for frame in render_progressive(scene, spp=1):
        clock.now += 1000
        elapsed.append(frame.elapsed)
    assert max(elapsed) < 10


# Files


def test_stopped_and_continued(cloud, tmp_path):
    """A run closed after its third frame and continued from the file equals an uninterrupted
    one.

    It is continued by another process; the equality is bit by bit. Before the third frame there is
    no complete batch to save.
    """
    file = str(tmp_path / "light.npz")
    run = render_progressive(cloud(cache_file=file), spp=1)
    stopped = [f.samples for f in islice(run, 3)][-1]
    run.close()
    assert IrradianceCache.load(file).samples == stopped == 16
    scene, whole = cloud(cache_file=file), cloud()
    frames = list(render_progressive(scene, spp=1))
    assert frames[0].samples == 16 and frames[-1].samples == 64
    whole.integrator().prepare(whole)
    assert_same(scene.integrator().cache, whole.integrator().cache)
    assert_same(IrradianceCache.load(file), whole.integrator().cache)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_stopped_within_a_pass(cloud, tmp_path, monkeypatch, error):
    """When a pass is interrupted, its complete launches are in cache and file, and no incomplete
    one.

    The remaining samples complete it to the cache of a single build.
    """
    monkeypatch.setattr(path_solver, "LANES", 1 << 12)
    file = tmp_path / "light.npz"
    scene, whole = cloud(cache_file=str(file)), cloud()
    integrator, frames = scene.integrator(), []

    def stop(stage, done, total):
        if integrator.cache.samples > 16 and done > total / 2:
            raise error

    integrator.progress = stop
    with pytest.raises(error):
        for frame in render_progressive(scene, spp=1):
            frames.append(frame)
    integrator.progress = None
    assert 16 < integrator.cache.samples < 64
    assert_same(IrradianceCache.load(file), integrator.cache)
    mi.render(scene, spp=1)
    whole.integrator().prepare(whole)
    assert_same(integrator.cache, whole.integrator().cache)


def test_file_is_written_at_intervals(cloud, tmp_path, monkeypatch):
    """Files are written at most every 30 s and at the end, after passes of 8 s or more.

    A render that is not progressive saves at its end only.
    """
    saved = []
    save = IrradianceCache.save

    def noted(cache, path):
        saved.append(cache.samples)
        save(cache, path)

    monkeypatch.setattr(IrradianceCache, "save", noted)
    Clock(monkeypatch, sample=1.0, image=0.0)
    scene = cloud(cache_file=str(tmp_path / "light.npz"))
    passes = [f.samples for f in islice(render_progressive(scene, cache_spp=math.inf, spp=1), 9)]
    assert saved[-1] == passes[-1]
    assert all(after - before >= 30 for before, after in pairwise(saved[:-1]))
    assert len(passes) > len(saved) >= 3
    saved.clear()
    scene.integrator().cache_spp = passes[-1] + 8
    mi.render(scene, spp=1)
    assert saved == [passes[-1] + 8]


def test_writing_takes_a_tenth_at_most(cloud, tmp_path, monkeypatch):
    """Saving takes at most a tenth of the time: with 10 s per save, after 100 s of passes."""
    clock = Clock(monkeypatch, sample=1.0, image=0.0)
    ended = []

    def slow_save(cache, path):
        clock.now += 10
        ended.append(clock.now)

    monkeypatch.setattr(IrradianceCache, "save", slow_save)
    scene = cloud(cache_file=str(tmp_path / "light.npz"))
    for _ in islice(render_progressive(scene, cache_spp=math.inf, spp=1), 16):
        pass
    *regular, _ = ended
    assert len(regular) >= 3
    assert min(np.diff(regular)[1:]) >= 110


# Changes of the integrator


def test_a_raised_target_refines(scenes, cloud, refine_calls):
    """Raising the target computes only the missing samples; lowering it computes none."""
    scene, whole = cloud(cache_spp=32), cloud(cache_spp=64)
    before = scenes.image(scene, spp=2)
    scene.integrator().cache_spp = 64
    after = scenes.image(scene, spp=2)
    scene.integrator().cache_spp = 8
    scenes.image(scene, spp=2)
    assert refine_calls == [32, 32]
    assert not np.array_equal(before, after)
    np.testing.assert_array_equal(after, scenes.image(whole, spp=2))
    assert "cache_spp = 8" in str(scene.integrator())


@pytest.mark.parametrize("samples", [-8, 2.5, True, math.inf])
def test_invalid_target(cloud, samples):
    integrator = cloud().integrator()
    with pytest.raises(IrrcacheError, match="cache_spp is"):
        integrator.cache_spp = samples
    assert integrator.cache_spp == 64


def test_passes_and_frames_compile_nothing(cloud, kernels):
    """All passes, of one or many batches, and their images use the kernels of the first two
    frames.
    """
    scene = cloud()

    def frames(*targets):
        return [list(render_progressive(scene, spp=2, cache_spp=n)) for n in targets]

    known = {k["hash"] for k in kernels(lambda: frames(16, 32))}
    later = kernels(lambda: frames(40, 64, 72, 200))
    assert later and {k["hash"] for k in later} <= known


# Scenes without a cache


@pytest.mark.parametrize("why", ["no scattering", "no paths", "no medium", "black", "no light"])
def test_one_frame_where_nothing_is_cached(scenes, cloud, why):
    """Without a cache there is one frame, the image of mi.render, even without a limit."""
    if why in ("black", "no light"):
        shape = scenes.boundary(scenes.medium(1.0, 0.0 if why == "black" else 0.5))
        lights = {} if why == "black" else {"emitter": None}
        scene = scenes.load({"type": "irrcache", "solver": "path"}, shape, **lights)
    else:
        lacking = {"no scattering": {"max_depth": 1}, "no paths": {"max_depth": 0}}
        scene = cloud(**lacking.get(why, {"shape": False}))
    (frame,) = render_progressive(scene, spp=2, seed=5, cache_spp=math.inf)
    assert frame.standard_error == 0
    expected = np.array(mi.render(scene, spp=2, seed=5))
    np.testing.assert_array_equal(np.array(frame.image), expected)


def test_other_integrators_are_named(cloud):
    """Other integrators are refused by name when the function is called, not at the first frame."""
    with pytest.raises(IrrcacheError, match=r"VolumetricPathIntegrator.*irrcache"):
        render_progressive(cloud("volpath"))


@pytest.mark.parametrize(
    "targets",
    [
        {"cache_spp": -1}, {"cache_spp": 2.5}, {"cache_spp": math.nan}, {"standard_error": -0.1},
        {"standard_error": math.inf}, {"seconds": 0}, {"seconds": math.nan}, {"times": [1, -1]},
    ],
)  # fmt: skip
def test_invalid_targets(cloud, targets):
    """Invalid targets are refused when the function is called, with their value and the remedy."""
    (name,) = targets
    with pytest.raises(IrrcacheError, match=f"{name} is .*must be"):
        render_progressive(cloud(), **targets)
