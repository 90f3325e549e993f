"""How time budgets are spent, with a simulated clock and integrator."""

from __future__ import annotations

import itertools
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from mitsuba_irrcache.compare import runners
from mitsuba_irrcache.compare.runners import Average, accumulate, follow


class Renderer(runners.Subject):
    """A subject whose n-th image has the value n and takes a given time."""

    def __init__(self, seconds: float, **stages: float) -> None:
        super().__init__(None, {}, "nothing")
        self.took = {"image": seconds} | stages
        self.numbers = itertools.count(1)

    def render(self, scene, spp):
        return np.full((1, 1, 1), float(next(self.numbers))), self.took


def spend(budgets, seconds=0.1, spent=None):
    return list(accumulate(Renderer(seconds), None, budgets, 4, spent or {}))


def test_snapshots_are_means_of_all_images_so_far():
    frames = spend([1.0, 0.3])
    assert [s.budget for s, _ in frames] == [0.3, 1.0]
    assert [s.spp for s, _ in frames] == [12, 40]
    assert [float(i.mean()) for _, i in frames] == [2.0, 5.5]


@pytest.mark.parametrize("seconds", [0.03, 0.07, 0.25])
def test_a_budget_is_met_to_half_a_launch(seconds):
    for snapshot, _ in spend([0.5, 2.0], seconds):
        assert abs(snapshot.total - snapshot.budget) <= 0.5 * seconds + 1e-9


def test_budgets_shorter_than_the_cache():
    """If the cache takes longer than several budgets, the first image counts for the largest of
    them.

    It has its actual time.
    """
    frames = spend([1.0, 2.0, 5.0, 8.0], seconds=0.5, spent={"cache": 6.0})
    assert [s.budget for s, _ in frames] == [5.0, 8.0]
    assert frames[0][0].seconds == {"cache": 6.0, "image": 0.5}
    assert frames[1][0].total == pytest.approx(8.0, abs=0.25)


def test_stages_of_images_are_separate():
    """Times of image and filter are separate if the integrator filters its images itself."""
    ((snapshot, _),) = accumulate(Renderer(0.3, filter=0.2), None, [2.0], 4, {"cache": 1.0})
    assert snapshot.seconds == pytest.approx({"cache": 1.0, "image": 0.6, "filter": 0.4})


def test_error_of_an_average():
    """The standard error of means of 8 images is their scatter, and alpha has none.

    The bound is for 4096 pixels; the error is that of the mean over the colours.
    """
    images = np.random.default_rng(1).normal(1.0, [0.1, 0.2, 0.3, 9.0], (8, 64, 64, 4))
    average = Average()
    for image in images:
        average.add(image.astype(np.float32))
    expected = np.sqrt(0.1**2 + 0.2**2 + 0.3**2) / 3 / np.sqrt(8)
    assert average.standard_error.shape == (64, 64)
    assert np.sqrt(np.mean(average.standard_error**2)) == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(average.mean, images.mean(axis=0), rtol=1e-4, atol=1e-5)


# External filter


class Filtered(Renderer):
    """A subject whose images have an alpha channel, which is not filtered."""

    is_filtered_here = True

    def render(self, scene, spp):
        image, took = super().render(scene, spp)
        return np.dstack([image] * 3 + [np.ones((1, 1))]), took


@pytest.fixture
def denoise(monkeypatch):
    """Record the calls of a fake filter that halves the image and takes 0.25 s."""
    calls, now = [], [0.0]

    def halve(image, standard_error):
        calls.append((image, standard_error))
        now[0] += 0.25
        return 0.5 * image

    module = ModuleType("filtering")
    module.denoise = halve
    monkeypatch.setitem(sys.modules, "mitsuba_irrcache.render.denoise", module)
    monkeypatch.setattr(runners.time, "perf_counter", lambda: now[0])
    return calls


def test_averages_are_filtered(denoise):
    """Averages of at least two images are filtered once per snapshot, with the error of their
    mean.

    The filter's time is counted once.
    """
    subject = Filtered(0.1)
    subject.filter_seconds = 0.25
    first, second = accumulate(subject, None, [0.2, 2.0], 4, {})
    assert [s.spp for s, _ in (first, second)] == [8, 68]
    assert first[0].seconds == {"image": pytest.approx(0.2), "filter": 0.25}
    assert second[0].total == pytest.approx(2.0, abs=0.06)
    image, error = denoise[0]
    assert image.ravel().tolist() == [1.5] * 3 and error == pytest.approx(0.5)
    assert first[1].mean() == 0.75 and len(denoise) == 2


@pytest.mark.usefixtures("rgb")
@pytest.mark.parametrize(
    ("integrator", "expected"),
    [
        ("volpath{filter=bilateral}", True),
        ("volpath{filter=bilateral,max_depth=3}", True),
        ("irrcache{filter=bilateral}", False),
        ("volpath", False),
        ("volpath{filter=blur}", False),
    ],
)
def test_which_integrators_are_filtered_here(tmp_path, integrator, expected):
    """Images are filtered here if the integrator lacks the property, which it is not given then."""
    subject = runners.Subject(tmp_path, {}, integrator)
    assert subject.is_filtered_here is expected
    assert ("filter" in subject.specification(max_depth=3)) == (
        "filter" in integrator and not expected
    )
    assert "max_depth=3" in subject.specification(max_depth=3)


# Progressive runs


def frame(seconds: float, number: int = 0) -> SimpleNamespace:
    stages = {"cache": 0.75 * seconds, "image": 0.25 * seconds}
    return SimpleNamespace(image=np.full((1, 1, 1), number), samples=8 * number, seconds=stages)


def followed(times, budgets, seconds=0.01):
    """Return (budget, cache samples, camera samples, seconds) of each snapshot.

    An image takes ``seconds``.
    """
    frames = (frame(t, i) for i, t in enumerate(times))
    snapshots = [s for s, _ in follow(Renderer(seconds), None, frames, budgets, 4)]
    return [(s.budget, s.note.split()[0], s.spp, s.total) for s in snapshots]


def test_snapshots_of_a_run():
    """A snapshot is the first frame that reaches its share of a budget, and further images.

    These use the rest of the budget, to half an image, and also count for later budgets.
    """
    first, second = followed([0.3, 0.85, 1.5, 2.56, 9.0], [3, 1])
    assert first == (1, "8", 4 * 16, pytest.approx(1.0, abs=0.006))
    assert second == (3, "24", pytest.approx(4 * 30, abs=4), pytest.approx(3.0, abs=0.006))


def test_snapshots_are_means_of_one_cache():
    """A snapshot is the mean of its frame's image and the images after it, none of earlier
    frames.
    """
    frames = [frame(0.85, 7), frame(1.7, 9)]
    snapshots = follow(Renderer(0.05), None, frames, [1.0, 2.0], 4)
    means = [float(image.mean()) for _, image in snapshots]
    assert means == [pytest.approx((7 + 1 + 2 + 3) / 4), pytest.approx((9 + 4 + 5 + 6) / 4)]


def test_budgets_shorter_than_a_frame():
    """If a frame takes longer than several budgets, it counts for the largest of them,
    unchanged.
    """
    first, second = followed([2.5, 3.9], [1, 2, 4], seconds=0.5)
    assert first == (2, "0", 4, 2.5)
    assert second == (4, "8", 8, pytest.approx(4.4))


def test_no_frame_is_requested_after_the_last_budget():
    """No frame is requested after the last budget."""

    def frames():
        yield frame(1.0)
        raise AssertionError

    assert len(list(follow(Renderer(1.0), None, frames(), [0.5], 4))) == 1


class Refining:
    """A third-party integrator with a cache that is complete after four samples."""

    def prepare(self, scene):
        self.prepared = True

    def progressive(self, scene, sensor, seed, spp, times):
        assert (sensor, times) == (3, pytest.approx([0.7, 1.4, 6.3]))
        assert spp in (1, 4)  # to measure the time of a first image, and then as many as fit
        yield frame(0.1, 1)
        yield frame(0.9, 2)
        yield frame(1.2, 4)


def test_third_party_progressive_integrator(monkeypatch):
    """Once the cache is complete, further images use the rest of the budgets."""
    integrator = Refining()
    scene = SimpleNamespace(integrator=lambda: integrator)
    subject = Renderer(0.5)
    subject.sensor = 3
    monkeypatch.setattr(subject, "load", lambda **properties: scene, raising=False)
    monkeypatch.setattr(runners, "_samples_per_launch", lambda *_: 4)
    monkeypatch.setattr(runners, "effort_is_free", lambda _: True)
    monkeypatch.setattr(runners, "prepare", lambda _: 1.4)
    snapshots = [s for s, _ in runners.run(subject, scene, [1.0, 2.0, 9.0])]
    assert [s.budget for s in snapshots] == [1.0, 2.0, 9.0]
    assert [s.note for s in snapshots] == ["16 samples per voxel", "", ""]
    assert snapshots[0].spp == 8
    assert snapshots[1].seconds == {"cache": 1.4, "image": 0.5}
    assert snapshots[2].total == pytest.approx(9.0, abs=0.25)


# Detection of an integrator's methods


@pytest.mark.usefixtures("rgb")
@pytest.mark.parametrize(
    ("integrator", "expected"), [("irrcache", True), ("volpath", False), ("prbvolpath", False)]
)
def test_which_integrators_have_a_cache(scenes, integrator, expected):
    """The method "prepare" of Mitsuba's differentiable integrators is not taken for a cache
    build.
    """
    scene = scenes.load(
        {"type": integrator}, scenes.boundary(scenes.medium(1.0, 0.5)), default_solver="path"
    )
    assert runners.has_cache(scene) is expected


@pytest.mark.usefixtures("rgb")
def test_which_integrators_accept_an_effort(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.0.0"><integrator type="volpath"/></scene>')
    for integrator, expected in (
        ("irrcache", True),
        ("irrcache{step=0.5}", True),
        ("irrcache{cache_spp=64}", False),
        ("volpath", False),
    ):
        subject = runners.Subject(scene, {}, integrator)
        assert runners.effort_is_free(subject) is expected, integrator


def test_relative_names_are_those_in_a_folder(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.0.0"><integrator type="volpath"/></scene>')
    integrator = "irrcache{cache_file=light.cache}"
    loaded = runners.Subject(scene, {}, integrator, folder=str(tmp_path / "own")).load()
    assert f"cache_file = {tmp_path / 'own' / 'light.cache'}" in str(loaded.integrator())


@pytest.mark.parametrize(("seconds", "budget"), [(0.5, 1.0), (2.0, 4.0), (9.0, 4.0)])
def test_a_stated_error_has_one_image_with_its_estimate(seconds, budget):
    """It counts for the first budget that suffices, and its samples are those it has chosen."""
    integrator = SimpleNamespace(
        depends_on_view=True,
        certificate=SimpleNamespace(settings={"spp": 8}, error=0.004, __str__=lambda: "parts"),
    )
    scene, subject = SimpleNamespace(integrator=lambda: integrator), Renderer(seconds)
    subject.load = lambda: scene
    ((snapshot, _),) = runners.run(subject, scene, [1.0, 4.0])
    assert (snapshot.budget, snapshot.spp, snapshot.estimate) == (budget, 8, 0.004)
    integrator.certificate = None  # a search that was stopped
    ((snapshot, _),) = runners.run(subject, scene, [1.0, 4.0])
    assert snapshot.estimate is None
