"""Errors at equal time and times to equal error, from curves of error over time."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

#: Factor by which the time of the first and the last snapshot may differ from a budget.
TOLERANCE = 1.1
#: Slopes of log error over log time that are taken for Monte Carlo noise and extrapolated.
NOISE_SLOPES = (-0.65, -0.35)
#: Limit of extrapolation in units of the longest measurement.
FARTHEST = 1e4


@dataclass(frozen=True, eq=False)
class Curve:
    """Errors of one integrator over seconds, sorted by time.

    ``resolved`` is the smallest error that is detectable with this reference.
    """

    integrator: str
    seconds: np.ndarray
    errors: np.ndarray
    resolved: np.ndarray

    @property
    def shown(self) -> np.ndarray:
        """Return the errors, clamped from below to ``resolved``."""
        return np.maximum(self.errors, self.resolved)


@dataclass(frozen=True)
class Reached:
    """Seconds to an error, and how they were obtained.

    ``how`` is "measured", "at most" (the first snapshot is better already), "extrapolated" (as
    Monte Carlo noise), or "never" if nothing can be said.
    """

    seconds: float
    how: str


def curves(rows: list[dict]) -> list[Curve]:
    """Return the curve of every integrator, in the order of the rows."""
    result = []
    for name in dict.fromkeys(row["integrator"] for row in rows):
        own = sorted((r for r in rows if r["integrator"] == name), key=lambda r: r["seconds"])
        columns = (np.array([r[key] for r in own]) for key in ("seconds", "rmse", "rmse_resolved"))
        result.append(Curve(name, *columns))
    return result


def uncertainty(curve: Curve) -> float:
    """Return the standard error of the last error, assuming independent pixels."""
    # resolved = sqrt(2 u) with u, the standard error of the square; d sqrt(s) = ds / (2 sqrt(s))
    return float(curve.resolved[-1] ** 2 / 4 / curve.shown[-1])


def maximum_depths(described: dict[str, str]) -> dict[str, int]:
    """Return ``max_depth`` of each integrator that prints one, -1 for all orders."""
    found = {name: re.search(r"max_depth = (-?\d+)", text) for name, text in described.items()}
    depths = {name: int(match[1]) for name, match in found.items() if match}
    return {name: -1 if depth >= 2**31 else depth for name, depth in depths.items()}


def equal_time(curves: list[Curve], budgets: list[float]) -> list[list[float | None]]:
    """Return a row for each budget with the error of every curve, interpolated in log-log.

    It is None before the first and after the last snapshot.
    """
    return [[_error_at(curve, budget) for curve in curves] for budget in sorted(budgets)]


def equal_error(curves: list[Curve], targets: list[float]) -> list[list[Reached]]:
    """Return a row for each target error with the time of every curve to reach it."""
    return [[time_to(curve, target) for curve in curves] for target in targets]


def targets(curves: list[Curve], count: int = 6) -> list[float]:
    """Return round errors within the range of the curves, in decreasing order.

    They are in steps of 1, 2, 5, or in finer steps if these are few.
    """
    values = np.concatenate([curve.shown for curve in curves]) if curves else np.array([])
    values = values[values > 0]
    if not values.size:
        return []
    decades = range(int(np.floor(np.log10(values.min()))), int(np.ceil(np.log10(values.max()))) + 1)
    for steps in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)):
        inside = [m * 10.0**d for d in decades for m in steps]
        inside = [v for v in inside if values.min() <= v <= values.max()][:count]
        if len(inside) >= 3:
            break
    return inside[::-1] or [float(values.min())]


def time_to(curve: Curve, target: float) -> Reached:
    """Return the seconds until the error is at most ``target``, interpolated in log-log."""
    t, e = curve.seconds, curve.shown
    below = np.flatnonzero(e <= target)
    if not below.size:
        return _extrapolated(curve, target)
    k = below[0]
    if k == 0:
        return Reached(float(t[0]), "measured" if e[0] == target else "at most")
    share = np.log(e[k - 1] / target) / np.log(e[k - 1] / e[k])
    return Reached(float(t[k - 1] * (t[k] / t[k - 1]) ** share), "measured")


def nearest(curve: Curve, budget: float) -> tuple[float, float] | None:
    """Return error and seconds of the first image after a ``budget``, or else of the last one.

    None if there is no image. It is displayed where `equal_time` has no error.
    """
    if not len(curve.seconds):
        return None
    k = min(int(np.searchsorted(curve.seconds, budget)), len(curve.seconds) - 1)
    return float(curve.shown[k]), float(curve.seconds[k])


def _error_at(curve: Curve, budget: float) -> float | None:
    t = curve.seconds
    if not len(t) or not t[0] / TOLERANCE <= budget <= t[-1] * TOLERANCE:
        return None
    logs = np.interp(np.log(budget), np.log(curve.seconds), np.log(curve.shown))
    return float(np.exp(logs))


def _extrapolated(curve: Curve, target: float) -> Reached:
    """Extrapolate as variance ~ 1 / t if the last snapshots decrease like that."""
    t, e = curve.seconds, curve.errors
    resolved = e > curve.resolved
    if len(t) < 2 or not resolved[-2:].all():
        return Reached(np.inf, "never")
    slope = np.log(e[-1] / e[-2]) / np.log(t[-1] / t[-2])
    seconds = float(t[-1] * (e[-1] / target) ** 2)
    if not NOISE_SLOPES[0] <= slope <= NOISE_SLOPES[1] or seconds > FARTHEST * t[-1]:
        return Reached(np.inf, "never")
    return Reached(seconds, "extrapolated")
