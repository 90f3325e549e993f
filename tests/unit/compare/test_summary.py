"""Times to equal error and errors at equal time, on curves with known results."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.compare.metrics import net_mse
from mitsuba_irrcache.compare.report import _ratio
from mitsuba_irrcache.compare.summary import (
    Curve,
    curves,
    equal_time,
    maximum_depths,
    targets,
    time_to,
    uncertainty,
)

TIMES = np.array([1.0, 3.0, 10.0])


def curve(errors, resolved=0.0, times=TIMES):
    errors = np.asarray(errors, dtype=float)
    return Curve("x", np.asarray(times, dtype=float), errors, np.full(len(errors), resolved))


def noise(times=TIMES):
    return curve(0.1 / np.sqrt(times), times=times)


@pytest.mark.parametrize("error", [0.09, 0.06, 0.04])
def test_between_snapshots(error):
    """Interpolation is exact on a power law, wherever the snapshots are."""
    reached = time_to(noise(), error)
    assert reached.how == "measured"
    assert reached.seconds == pytest.approx((0.1 / error) ** 2)


def test_beyond_the_measurement():
    """Monte Carlo noise is extrapolated, and marked as extrapolated."""
    reached = time_to(noise(), 0.01)
    assert (reached.how, reached.seconds) == ("extrapolated", pytest.approx(100))
    assert time_to(noise(), 1e-4).how == "never"  # a million seconds: too far to extrapolate


@pytest.mark.parametrize("errors", [[0.1, 0.05, 0.049], [0.1, 0.05, 0.001]])
def test_bias_is_not_extrapolated(errors):
    """Curves that level out, or fall faster than noise, are not extrapolated."""
    assert time_to(curve(errors), 5e-4).how == "never"


def test_unresolved_errors_are_not_extrapolated():
    assert time_to(curve(0.1 / np.sqrt(TIMES), resolved=0.05), 0.01).how == "never"


def test_better_from_the_start():
    reached = time_to(noise(), 0.5)
    assert (reached.how, reached.seconds) == ("at most", 1)


def test_equal_time():
    """Errors are interpolated between snapshots, with none before the first or after the last."""
    table = equal_time([noise(), curve([0.2], times=[5])], [20, 0.5, 2, 5])
    assert table[0] == [None, None]
    assert table[1] == [pytest.approx(0.1 / np.sqrt(2)), None]
    assert table[2] == [pytest.approx(0.1 / np.sqrt(5)), pytest.approx(0.2)]
    assert table[3] == [None, None]


@pytest.mark.parametrize("spread", [1.2, 4, 100, 1e5])
def test_targets_lie_within_the_curves(spread):
    found = targets([curve([0.3, 0.3 / spread], times=[1, 2])])
    assert 1 <= len(found) <= 6
    assert found == sorted(found, reverse=True)
    assert all(0.3 / spread * 0.999 <= t <= 0.3 for t in found)


def test_curves_of_rows_are_in_order_of_time():
    rows = [
        {"integrator": name, "seconds": s, "rmse": 1 / s, "rmse_resolved": 0.0}
        for name, s in (("b", 3.0), ("a", 2.0), ("b", 1.0))
    ]
    first, second = curves(rows)
    assert (first.integrator, second.integrator) == ("b", "a")
    np.testing.assert_array_equal(first.seconds, [1, 3])
    np.testing.assert_array_equal(first.errors, [1, 1 / 3])


def test_depths_are_compared_as_numbers():
    """max_depth is compared as a number; Mitsuba prints -1 as an unsigned integer."""
    described = {"a": "A[ max_depth = 4294967295, rr_depth = 5 ]", "b": "B[max_depth = -1]"}
    assert maximum_depths(described | {"c": "C[max_depth = 6]", "d": "D[]"}) == {
        "a": -1,
        "b": -1,
        "c": 6,
    }


def test_uncertainty_of_the_last_error():
    """The stated uncertainty of the last RMSE is its scatter over many images."""
    truth = np.zeros((64, 64, 1))
    stated, errors = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        image, a, b = (rng.normal(0, s, truth.shape) for s in (0.1, 0.03, 0.03))
        square, of_square = net_mse(image, a, b)
        errors.append(np.sqrt(square))
        last = curve([np.sqrt(square)], resolved=np.sqrt(2 * of_square), times=[1])
        stated.append(uncertainty(last))
    assert np.std(errors) == pytest.approx(np.mean(stated), rel=0.3)


def test_a_first_image_that_is_better_states_no_ratio_of_one():
    """A lower bound of the ratio that is about 1 says nothing."""
    best = Curve("a", np.array([2.0]), np.array([0.005]), np.zeros(1))
    other = Curve("b", np.array([0.5, 2.0]), np.array([0.17, 0.08]), np.zeros(2))
    assert "The first image of a, after 2 s, is better" in _ratio(best, 0.005, other, 0.08, 2.0)
    early = Curve("a", np.array([0.2]), np.array([0.005]), np.zeros(1))
    assert _ratio(early, 0.005, other, 0.08, 2.0).endswith("at least 10 times faster.")


def test_ratios_are_those_at_the_budget_of_the_errors():
    """The error after 3 s is not compared with the time of an image after 12 s."""
    times = np.array([1.0, 3.0, 12.0])
    best = Curve("a", times, 0.05 / np.sqrt(times), np.zeros(3))
    other = Curve("b", times, 0.1 / np.sqrt(times), np.zeros(3))
    said = _ratio(best, best.errors[1], other, other.errors[1], 3.0)
    assert "has after 3 s" in said and said.endswith("3 times faster.")
