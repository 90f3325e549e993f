"""Errors of recorded images and conclusions: times to an error, and the verdict on the filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.support.recording import Recording
from mitsuba_irrcache.compare import metrics
from mitsuba_irrcache.compare.metrics import block_means
from mitsuba_irrcache.compare.perceptual import display
from mitsuba_irrcache.compare.reference import Reference
from mitsuba_irrcache.compare.summary import Curve, Reached, time_to

#: Requirement for the fading filter: at most this factor above the better of the two others.
CLOSE = 1.1
#: Standard errors within which two errors count as equal; several pairs are compared.
NOISE = 2.0


def errors(recording: Recording, truth: Reference) -> dict[str, list[float]]:
    """Compute the errors of all snapshots, by name and in the order of time.

    ``display``: RMSE of the sRGB image in [0, 1], the paper's measure, against the independent
    reference and net of its noise; ``linear``: net RMSE of radiance in units of its mean; each with
    the smallest error that is detectable with the reference. ``own``: the paper's criterion,
    display RMSE against the method's own last image.
    """
    halves = [metrics.colours(half) for half in (truth.a, truth.b)]
    shown = [_displayed(half) for half in halves]
    mean = float(np.mean(halves))
    images = [recording.image(s) for s in recording.measurement.snapshots]
    last = _displayed(images[-1])
    rows = []
    for snapshot, image in zip(recording.measurement.snapshots, images, strict=True):
        own = _displayed(image)
        rows.append(
            {
                "seconds": snapshot.total,
                "display": metrics.net_rmse(own, *shown),
                "display_resolved": _resolved(own, *shown),
                "linear": metrics.net_rmse(image, *halves) / mean,
                "linear_resolved": _resolved(image, *halves) / mean,
                "own": rms(own - last),
            }
        )
    rows.sort(key=lambda row: row["seconds"])  # the filter's duration varies
    return {key: [row[key] for row in rows] for key in rows[0]}


def curve(label: str, errors: dict[str, list[float]], kind: str) -> Curve:
    """Return a curve of ``errors`` (see `recording.errors`) for `compare.summary`."""
    columns = (errors["seconds"], errors[kind], errors.get(f"{kind}_resolved", [0.0]))
    seconds, values, resolved = (np.asarray(c, dtype=float) for c in columns)
    return Curve(label, seconds, values, np.broadcast_to(resolved, values.shape))


def time_to_converged(errors: dict[str, list[float]], level: float) -> Reached:
    """Return the paper's criterion: seconds until the RMSE to the own last image is below
    ``level``.

    The last image itself has no error, so it is ignored; nothing is extrapolated.
    """
    before = {key: errors[key][:-1] for key in ("seconds", "own")}
    if not before["own"]:
        return Reached(np.inf, "never")
    reached = time_to(curve("", before, "own"), level)
    return Reached(np.inf, "never") if reached.how == "extrapolated" else reached


def speed_up(stock: Reached, other: Reached) -> float | None:
    """Return the speed-up over ``other``; None if it is unknown."""
    if not np.isfinite([stock.seconds, other.seconds]).all() or stock.how == "at most":
        return None
    return stock.seconds / other.seconds


def difference_of_squares(
    x: np.ndarray, y: np.ndarray, a: np.ndarray, b: np.ndarray
) -> tuple[float, float]:
    """Return the mean square error of x minus that of y, and its standard error.

    The noise of the reference's halves a and b cancels; the standard error is from the spread over
    about 64 blocks.
    """
    products = (x - a) * (x - b) - (y - a) * (y - b)
    means = block_means(products, max(1, min(x.shape[:2]) // 8)).mean(axis=-1)
    return float(products.mean()), float(means.std() / np.sqrt(means.size))


@dataclass(frozen=True)
class Verdict:
    """The comparison of the fading filter with the others at one time.

    Attributes:
        ratio: its error over that of the better of unfiltered and fixed filter.
        worse: whether it is worse than unfiltered beyond noise.
        close: whether it is within 10 % of the better one.
    """

    ratio: float
    worse: bool
    close: bool


def judge(
    unfiltered: float, fixed: float, fading: float, difference: float, uncertainty: float
) -> Verdict:
    """Return the verdict on three errors.

    ``difference`` is fading minus unfiltered, in squares, with its standard error.
    """
    ratio = fading / min(unfiltered, fixed)
    return Verdict(ratio, difference > NOISE * uncertainty, ratio <= CLOSE)


def fit_memory(rows: list[dict]) -> tuple[float, float, float]:
    """Fit peak = base + a n^3 + b m^2 by least squares.

    Returns base, bytes per voxel of the volume and bytes per pixel; rows have "voxels", "pixels"
    and "bytes".
    """
    columns = np.array([[1.0, row["voxels"], row["pixels"]] for row in rows])
    scale = columns.max(axis=0)
    found = np.linalg.lstsq(columns / scale, [row["bytes"] for row in rows], rcond=None)[0]
    return tuple(float(v) for v in found / scale)


def orders(steps: list[float], errors: list[float]) -> list[float]:
    """Return the slopes of log error over log step between neighbours."""
    return [float(s) for s in np.diff(np.log(errors)) / np.diff(np.log(steps))]


def rms(x: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def _displayed(image: np.ndarray) -> np.ndarray:
    return display(image).astype(np.float64)


def _resolved(image: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the smallest RMSE that is detectable with the reference."""
    return float(np.sqrt(2 * metrics.net_mse(image, a, b)[1]))
