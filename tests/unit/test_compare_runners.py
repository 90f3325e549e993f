"""How budgets are spent, with a clock and an integrator that are made up."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mitsuba_irrcache.compare import runners
from mitsuba_irrcache.compare.runners import accumulate, choose_effort, without_unreachable


class Renderer:
    """Stands for a `Subject`: an image of the next number, in a time that is given."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.numbers = seconds, itertools.count(1)

    def render(self, scene, spp):
        return np.full((1, 1, 1), float(next(self.numbers))), self.seconds


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


def test_budgets_that_the_cache_outlasts():
    """The first image stands for the largest of them, with its true time."""
    frames = spend([1.0, 2.0, 5.0, 8.0], seconds=0.5, spent={"cache": 6.0})
    assert [s.budget for s, _ in frames] == [5.0, 8.0]
    assert frames[0][0].seconds == {"cache": 6.0, "image": 0.5}
    assert frames[1][0].total == pytest.approx(8.0, abs=0.25)


def test_effort_on_a_straight_line():
    """Measured costs of 1 s + 0.01 s per unit give back the line, down to whole steps."""
    costs = [(n, 1 + 0.01 * n) for n in (8, 64, 512)]
    assert choose_effort(costs, 3.0) == 200
    assert choose_effort(costs, 1.0) == runners.LEAST_EFFORT
    assert choose_effort(costs[:1], 1e9) == 32 * 8  # one point is no reason to go far


def test_early_budgets():
    assert without_unreachable([8, 0.5, 3, 1], 2.0) == [1, 3, 8]
    assert without_unreachable([3, 8], 2.0) == [3, 8]


@pytest.mark.usefixtures("rgb")
@pytest.mark.parametrize(
    ("integrator", "expected"), [("irrcache", True), ("volpath", False), ("prbvolpath", False)]
)
def test_who_has_a_cache(scenes, integrator, expected):
    """Mitsuba's differentiable integrators have a method "prepare" too, but it is another one."""
    scene = scenes.load({"type": integrator}, scenes.boundary(scenes.medium(1.0, 0.5)))
    assert runners.has_cache(scene) is expected


@pytest.mark.usefixtures("rgb")
def test_who_lets_the_effort_be_chosen(tmp_path):
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
