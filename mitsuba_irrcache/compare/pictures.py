"""Strips of images: the image of each integrator after each budget, and its signed error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from . import style
from .metrics import block_means, colours
from .perceptual import display
from .reference import Reference
from .results import Measurement, Snapshot

#: Number of columns of a strip besides the reference.
MOST_COLUMNS = 5


def strip(
    path: Path, measurements: list[Measurement], reference: Reference, folder: Path, exposure: float
) -> None:
    """Draw a strip of tone-mapped images, with the reference on the right."""
    shown = [m for m in measurements if m.snapshots]
    budgets = _columns(shown)
    size = _size(reference.a.shape, len(budgets) + 1, len(shown))
    truth = display(colours(reference.mean), exposure)
    with style.figure(path, len(shown), len(budgets) + 1, figsize=size) as (_, axes):
        for row, measurement in zip(axes, shown, strict=True):
            _label(row, measurement)
            for ax, budget in zip(row, budgets, strict=False):
                snapshot = _snapshot(measurement, budget)
                if snapshot is None:
                    _empty(ax, budget, truth.shape)
                    continue
                image = np.nan_to_num(snapshot.read(folder))
                ax.imshow(display(image, exposure), interpolation="nearest")
                ax.set_title(f"{snapshot.total:.3g} s")
            row[-1].imshow(truth, interpolation="nearest")
            row[-1].set_title("reference")


def differences(
    path: Path, measurements: list[Measurement], reference: Reference, folder: Path, block: int = 1
) -> None:
    """Draw a strip of signed errors, averaged over channels and square blocks of pixels.

    They are in % of the mean radiance of the reference, with one colour scale for all.
    """
    shown = [m for m in measurements if m.snapshots]
    budgets = _columns(shown)
    truth = colours(reference.mean)
    panels = {
        (m.name, b): _signed_error(s.read(folder), truth, block)
        for m in shown for b in budgets if (s := _snapshot(m, b)) is not None
    }  # fmt: skip
    limit = float(np.median([np.quantile(np.abs(p), 0.99) for p in panels.values()])) or 1.0
    size = _size(reference.a.shape, len(budgets), len(shown))
    with style.figure(path, len(shown), len(budgets), figsize=size) as (drawn, axes):
        for row, measurement in zip(axes, shown, strict=True):
            _label(row, measurement)
            for ax, budget in zip(row, budgets, strict=True):
                snapshot = _snapshot(measurement, budget)
                if snapshot is None:
                    _empty(ax, budget, truth.shape)
                    continue
                last = ax.imshow(
                    panels[measurement.name, budget], cmap=style.SIGNED, vmin=-limit, vmax=limit,
                    interpolation="nearest",
                )  # fmt: skip
                ax.set_title(f"{snapshot.total:.3g} s")
        _scale(drawn, axes, last)


def _signed_error(image: np.ndarray, truth: np.ndarray, block: int) -> np.ndarray:
    error = np.nan_to_num(image) - truth
    mean = float(truth.mean()) or 1.0
    return 100 * block_means(error, block).mean(axis=-1) / mean


def _columns(measurements: list[Measurement]) -> list[float]:
    """Return the budgets to show: all, or evenly spaced ones including the first and the last."""
    budgets = sorted({s.budget for m in measurements for s in m.snapshots})
    picked = np.linspace(0, len(budgets) - 1, min(len(budgets), MOST_COLUMNS)).round().astype(int)
    return [budgets[i] for i in picked]


def _snapshot(measurement: Measurement, budget: float) -> Snapshot | None:
    return next((s for s in measurement.snapshots if s.budget == budget), None)


def _size(shape: tuple[int, ...], columns: int, rows: int) -> tuple[float, float]:
    """Return the figure size in inches for images about 1.9 wide, plus space for labels."""
    width = 1.9
    return columns * (width + 0.1) + 0.5, rows * (width * shape[0] / shape[1] + 0.35) + 0.2


def _label(row: np.ndarray, measurement: Measurement) -> None:
    for ax in row:
        ax.set_xticks([])
        ax.set_yticks([])
        ax.grid(False)
        for spine in ax.spines.values():
            spine.set_visible(False)
    text = measurement.integrator
    row[0].set_ylabel(text if len(text) < 24 else text.replace("{", "{\n", 1), fontsize=8)


def _empty(ax: Axes, budget: float, shape: tuple[int, ...]) -> None:
    ax.imshow(np.ones((*shape[:2], 3)))  # occupies the space of an image
    ax.text(
        0.5, 0.5, "no image\nyet", transform=ax.transAxes, ha="center", va="center",
        color=style.GREY, fontsize=8,
    )  # fmt: skip
    ax.set_title(f"{budget:g} s", color=style.GREY)


def _scale(drawn: Figure, axes: np.ndarray, last: object) -> None:
    bar = drawn.colorbar(last, ax=axes, shrink=0.8, aspect=30, pad=0.02)
    bar.set_label("too dark   ←   %   →   too bright", fontsize=8)
    bar.outline.set_visible(False)
