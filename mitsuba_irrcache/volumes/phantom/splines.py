"""Piecewise cubic curves through points, as in SciPy, whose import takes longer than a phantom."""

from __future__ import annotations

import numpy as np


class Curve:
    """A piecewise cubic curve with ``values`` (n[, component]) and ``slopes`` at ``places`` (n).

    The first and last piece are continued beyond the ends.
    """

    def __init__(self, places: np.ndarray, values: np.ndarray, slopes: np.ndarray) -> None:
        steps = _beside(np.diff(places), values)
        mean = np.diff(values, axis=0) / steps
        bend = (slopes[:-1] + slopes[1:] - 2 * mean) / steps
        self._places = places
        self._powers = values[:-1], slopes[:-1], (mean - slopes[:-1]) / steps - bend, bend / steps

    def __call__(self, places: np.ndarray | float) -> np.ndarray:
        """Return the values at ``places``, of their shape, with the components last."""
        t, (constant, linear, square, cubic) = self._at(places)
        return constant + t * (linear + t * (square + t * cubic))

    def slope(self, places: np.ndarray | float) -> np.ndarray:
        """Return the derivative, of the shape of the values."""
        t, (_, linear, square, cubic) = self._at(places)
        return linear + t * (2 * square + t * 3 * cubic)

    def _at(self, places: np.ndarray | float) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the distance from the beginning of the piece at ``places``, and its powers."""
        places = np.asarray(places, dtype=np.float64)
        last = len(self._places) - 2
        piece = np.clip(np.searchsorted(self._places, places, side="right") - 1, 0, last)
        powers = [part[piece] for part in self._powers]
        t = places - self._places[piece]
        return t.reshape(t.shape + (1,) * (powers[0].ndim - t.ndim)), powers


def monotone(places: np.ndarray, values: np.ndarray) -> Curve:
    """Return a curve with a continuous derivative and without extrema between the points.

    Fritsch and Butland, *A method for constructing local monotone piecewise cubic interpolants*
    (1984).
    """
    places, values = (np.asarray(a, dtype=np.float64) for a in (places, values))
    steps = _beside(np.diff(places), values)
    mean = np.diff(values, axis=0) / steps
    before, after = mean[:-1], mean[1:]
    weights = 2 * steps[1:] + steps[:-1], steps[1:] + 2 * steps[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        harmonic = sum(weights) / (weights[0] / before + weights[1] / after)
    inner = np.where(before * after > 0, harmonic, 0.0)
    ends = (
        _end_slope(steps[0], steps[1], mean[0], mean[1]),
        _end_slope(steps[-1], steps[-2], mean[-1], mean[-2]),
    )
    return Curve(places, values, np.concatenate([ends[0][None], inner, ends[1][None]]))


def smooth(places: np.ndarray, values: np.ndarray) -> Curve:
    """Return the curve with two continuous derivatives, and one piece over the first two intervals
    as over the last two ("not-a-knot"). Of three points it is a parabola, of two a line.
    """
    places, values = (np.asarray(a, dtype=np.float64) for a in (places, values))
    n, steps = len(places), np.diff(places)
    if n < 4:
        fitted = np.polyfit(places, values, n - 1)  # exact: as many coefficients as points
        slopes = sum(
            power * factor * _beside(places, values) ** (power - 1)
            for power, factor in zip(range(n - 1, 0, -1), fitted, strict=False)
        )
        return Curve(places, values, slopes + np.zeros_like(values))
    mean = np.diff(values, axis=0) / _beside(steps, values)
    matrix, right = np.zeros((n, n)), np.zeros_like(values)
    for k in range(1, n - 1):
        matrix[k, k - 1 : k + 2] = steps[k], 2 * (steps[k - 1] + steps[k]), steps[k - 1]
        right[k] = 3 * (steps[k] * mean[k - 1] + steps[k - 1] * mean[k])
    for row, (a, b), (m, o) in (
        (0, steps[:2], mean[:2]),
        (-1, steps[:-3:-1], mean[:-3:-1]),
    ):
        width = a + b
        matrix[row, [row, 1 if row == 0 else -2]] = b, width
        right[row] = ((a + 2 * width) * b * m + a**2 * o) / width
    return Curve(places, values, np.linalg.solve(matrix, right))


def _beside(numbers: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return one number per row of ``values``, with axes for its components."""
    return numbers.reshape(-1, *(1,) * (values.ndim - 1))


def _end_slope(
    near: np.ndarray, far: np.ndarray, mean: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Return the slope at an end by three points, limited so that the curve stays monotone."""
    slope = ((2 * near + far) * mean - near * other) / (near + far)
    slope = np.where(slope * mean <= 0, 0.0, slope)
    steep = (mean * other < 0) & (np.abs(slope) > 3 * np.abs(mean))
    return np.where(steep, 3 * mean, slope)
