"""Threads that share scenes, caches, films and files get the results of a single thread."""

from __future__ import annotations

import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache import render_progressive
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.io.files import atomic_write

pytestmark = pytest.mark.usefixtures("rgb")

THREADS, REPETITIONS = 3, 6
SOLVERS = ("sweep", "path")


@pytest.fixture(autouse=True)
def impatient():
    """Switch threads a thousand times as often as usual."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(interval)


def together(*actions) -> list:
    """Start functions at once, each in a thread of its own; return their results."""
    barrier, variant = Barrier(len(actions)), mi.variant()

    def begin(action):
        mi.set_variant(variant)
        barrier.wait()
        return action()

    with ThreadPoolExecutor(len(actions)) as pool:
        return [f.result(timeout=120) for f in [pool.submit(begin, a) for a in actions]]


@pytest.fixture
def make(scenes):
    """Return a function that loads a scene with a different cloud for each ``seed``."""

    def scene(solver="path", seed=1, **settings) -> mi.Scene:
        settings = {"solver": solver, "resolution": 3, "cache_spp": 32} | settings
        cloud = scenes.medium(scenes.texture((3, 3, 3), 0, 2, seed), 0.8, scenes.placement())
        shape = scenes.boundary(cloud)
        # Different film sizes, because Mitsuba shares one object between equal films.
        others = {
            f"sensor{i}": scenes.description({}, None, size=6 + i)["sensor"]
            for i in range(1, THREADS)
        }
        return scenes.load(
            {"type": "irrcache", "solver": "path"} | settings, shape, size=6, **others
        )

    return scene


@pytest.fixture
def slow_sums(monkeypatch):
    """Delay the addition of samples to a cache, so that other threads can interfere."""
    add = IrradianceCache.add

    def slowly(cache: IrradianceCache, *args: object) -> None:
        time.sleep(0.02)
        add(cache, *args)

    monkeypatch.setattr(IrradianceCache, "add", slowly)


def image(scene: mi.Scene, **options) -> np.ndarray:
    return np.array(mi.render(scene, spp=2, **options))


@pytest.mark.parametrize("films", ["one film", "several films"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_one_scene_in_several_threads(make, slow_sums, solver, films):
    """Concurrent renderings of one scene build one cache, of a single random stream."""
    sensors = range(THREADS) if films == "several films" else [0] * THREADS
    alone = make(solver)
    assert len({sensor.film() for sensor in alone.sensors()}) == THREADS
    expected = [image(alone, sensor=i, seed=seed) for seed, i in enumerate(sensors)]
    for _ in range(REPETITIONS):
        scene = make(solver)
        renders = [
            lambda i=i, seed=seed, c=scene: image(c, sensor=i, seed=seed)
            for seed, i in enumerate(sensors)
        ]
        for found, wanted in zip(together(*renders), expected, strict=True):
            np.testing.assert_array_equal(found, wanted)
        assert scene.integrator().cache.streams == {0: 32}


def test_several_scenes_in_several_threads(make):
    expected = [image(make(seed=seed)) for seed in range(THREADS)]
    for _ in range(REPETITIONS):
        made = [make(seed=seed) for seed in range(THREADS)]
        found = together(*(lambda s=scene: image(s) for scene in made))
        np.testing.assert_array_equal(found, expected)


def test_two_integrators_that_render_to_one_film(make):
    scene = make()
    others = [
        mi.load_dict({"type": "irrcache", "resolution": 3, "cache_spp": 32, "max_depth": depth})
        for depth in (2, 3)
    ]
    expected = [image(scene, integrator=integrator) for integrator in others]
    for _ in range(REPETITIONS):
        found = together(*(lambda i=other: image(scene, integrator=i) for other in others))
        np.testing.assert_array_equal(found, expected)


def test_two_scenes_with_one_integrator(make):
    """One integrator rendering two scenes concurrently has a valid cache for each in turn."""
    made = [make(seed=seed) for seed in (1, 2)]
    expected = [image(scene) for scene in made]
    integrator = made[0].integrator()
    for _ in range(REPETITIONS):
        renders = [lambda s=scene: image(s, integrator=integrator) for scene in made]
        np.testing.assert_array_equal(together(*renders), expected)


def test_a_progressive_run_beside_renderings(make):
    """Concurrent renderings during a progressive run show whole batches of one random stream.

    The final cache is that of a single thread.
    """
    expected = make()
    last = image(expected)
    for _ in range(REPETITIONS):
        scene = make()
        runs = [lambda s=scene: [f.samples for f in render_progressive(s, spp=1, cache_spp=32)]] * 2
        renders = [lambda s=scene: image(s)]
        *samples, _ = together(*runs, *renders)
        assert all(counts[-1] == 32 for counts in samples)
        np.testing.assert_array_equal(image(scene), last)
        assert scene.integrator().cache.streams == {0: 32}


def test_cache_is_consistent_while_refined(make):
    """A cache that is read while other threads refine it has sums that match its number of
    samples.
    """
    exact = make(cache_spp=4096)
    exact.integrator().prepare(exact)
    mean = np.array(exact.integrator().cache.irradiance).mean()
    scene = make(cache_spp=8)
    integrator = scene.integrator()

    def refine() -> list:
        for samples in range(8, 400, 8):
            integrator.cache_spp = samples
            integrator.prepare(scene)
        return []

    integrator.prepare(scene)
    cache = integrator.cache

    def look() -> list:
        means = []
        while cache.samples < 392:
            means.append(np.array(cache.irradiance).mean())
            assert integrator.cache is cache
        return means

    _, means = together(refine, look)
    assert means and np.abs(np.array(means) / mean - 1).max() < 0.1


@pytest.mark.parametrize("solver", SOLVERS)
def test_scenes_that_share_a_cache_file(make, tmp_path, solver):
    """Scenes that share a cache file render correctly; the file is complete and of one stream."""
    expected = image(make(solver))
    for number in range(REPETITIONS):
        file = tmp_path / f"{number}.cache"
        made = [make(solver, cache_file=str(file)) for _ in range(THREADS)]
        for found in together(*(lambda s=scene: image(s) for scene in made)):
            np.testing.assert_array_equal(found, expected)
        again = make(solver, cache_file=str(file))
        np.testing.assert_array_equal(image(again), expected)
        assert again.integrator().cache.streams == {0: 32}
    assert len([*tmp_path.iterdir()]) == REPETITIONS


def test_a_failure_in_one_thread_leaves_the_others_their_cache(make):
    scene = make()
    expected = image(make())
    # Loaded beforehand: Dr.Jit traces the methods of all shapes that exist, also of those which
    # another thread is just creating.
    wrong = [make(emission=-1.0) for _ in range(2)]

    def fail(number: int) -> None:
        with pytest.raises(RuntimeError):
            image(wrong[number])

    found = together(lambda: fail(0), lambda: image(scene), lambda: fail(1))[1]
    np.testing.assert_array_equal(found, expected)


def test_umask_is_unchanged(tmp_path):
    """The umask is unchanged by concurrent saves, although reading it requires setting it."""
    before = os.umask(0o027)
    try:

        def write(number: int) -> None:
            for _ in range(200):
                with atomic_write(tmp_path / f"{number}") as file:
                    file.write(b"x")

        together(*(lambda n=number: write(n) for number in range(THREADS)))
        assert os.umask(0o027) == 0o027
        assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o640}
    finally:
        os.umask(before)
