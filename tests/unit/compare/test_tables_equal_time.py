"""The table of errors after equal time includes early and late images, with their time."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.compare.summary import TOLERANCE, Curve
from mitsuba_irrcache.compare.tables import equal_time_table


def curve(name: str, times: list[float], errors: list[float]) -> Curve:
    return Curve(name, np.array(times), np.array(errors), np.zeros(len(times)))


def table(budgets, *curves):
    found = equal_time_table(list(curves), budgets)
    return {row[0]: row[1:] for row in found.rows}, found.best


@pytest.mark.parametrize("late", [TOLERANCE * 1.001, 1.2, 3.0, 40.0])
def test_a_late_snapshot_is_shown_with_its_time(late):
    """A late snapshot is shown with its time, and is not a candidate for the best value."""
    slow = curve("slow", [late, 10 * late], [0.25, 0.01])
    fast = curve("fast", [1.0, 10.0], [0.3, 0.1])
    other = curve("other", [1.0, 10.0], [0.4, 0.2])
    rows, best = table([1.0], slow, fast, other)
    assert rows["1 s"][0].startswith("25 % (") and rows["1 s"][0].endswith(" s)")
    assert float(rows["1 s"][0][6:-3]) == pytest.approx(late, rel=0.01)
    assert rows["1 s"][1:] == ["30 %", "40 %"] and best == {(0, 2)}


def test_within_the_tolerance_nothing_is_added():
    rows, _ = table([1.0], curve("a", [TOLERANCE * 0.999], [0.5]))
    assert rows["1 s"] == ["50 %"]


def test_a_run_that_ended_early_is_shown_with_its_time():
    rows, _ = table([1.0, 12.0], curve("a", [1.0, 3.0], [0.5, 0.25]))
    assert rows == {"1 s": ["50 %"], "12 s": ["25 % (3 s)"]}


def test_no_image_is_a_dash():
    rows, best = table([1.0], curve("a", [], []), curve("b", [1.0], [0.5]))
    assert rows == {"1 s": ["—", "50 %"]} and not best
