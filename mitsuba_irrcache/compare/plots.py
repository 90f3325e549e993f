"""Curves and bar charts of a comparison.

Each function returns the values of its markers as texts, which the report displays on hover.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from . import style
from .results import Measurement
from .scores import METRICS
from .summary import Curve
from .tables import STAGES, percent, seconds

#: Errors other than RMSE that are plotted against time.
SMALL = ("relative_mse", "display_rmse", "block_rmse", "ciede2000", "flip")

STAGE_COLOURS = dict(
    zip(STAGES, ("#c8c8c8", "#9a9a9a", "#E69F00", "#009E73", "#0072B2", "#CC79A7"), strict=True)
)


#: Texts for the markers of a plot, by the id of their group in the SVG.
Points = dict[str, list[str]]


def error_over_time(path: Path, curves: list[Curve], noise: float) -> Points:
    """Plot RMSE against seconds, both logarithmic, with the slope of Monte Carlo noise."""
    points: Points = {}
    with style.figure(path, figsize=(8.4, 4.0)) as (_, axes):
        ax = axes[0, 0]
        for index, curve in enumerate(curves):
            look = style.line(index)
            ax.plot(
                curve.seconds,
                100 * curve.shown,
                label=curve.integrator,
                gid=f"rmse-{index}",
                **look,
            )
            points[f"rmse-{index}"] = [
                f"{curve.integrator}\n{seconds(t)} s, RMSE {percent(e)}"
                + (" or less" if e > measured else "")
                for t, e, measured in zip(curve.seconds, curve.shown, curve.errors, strict=True)
            ]
            hidden = curve.errors < curve.resolved
            ax.plot(
                curve.seconds[hidden], 100 * curve.shown[hidden],
                look["marker"], color=look["color"], markerfacecolor="white", linestyle="none",
            )  # fmt: skip
        _noise_slope(ax, curves)
        ax.axhline(100 * noise, color=style.GREY, linewidth=0.8, linestyle=":")
        ax.annotate(
            "noise of the reference (removed from the errors)", (1, 100 * noise),
            xycoords=("axes fraction", "data"), xytext=(-2, 2), textcoords="offset points",
            ha="right", color=style.GREY, fontsize=7,
        )  # fmt: skip
        _logarithmic(ax)
        ax.set_xlabel("seconds, kernels compiled beforehand")
        ax.set_ylabel("RMSE, % of the mean radiance")
        ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1))
    return points


def small_multiples(path: Path, rows: list[dict]) -> Points:
    """Plot the other errors against seconds, one panel each."""
    points: Points = {}
    names = [n for n in SMALL if any(_drawable(row[n]) for row in rows)]
    integrators = list(dict.fromkeys(row["integrator"] for row in rows))
    columns = 3
    lines = -(-len(names) // columns)
    with style.figure(path, lines, columns, figsize=(9, 2.5 * lines)) as (_, axes):
        for ax, name in zip(axes.flat, names, strict=False):
            label, unit, _ = METRICS[name]
            scale = 100 if unit == "%" else 1
            for index, integrator in enumerate(integrators):
                own = [r for r in rows if r["integrator"] == integrator and _drawable(r[name])]
                own.sort(key=lambda r: r["seconds"])
                ax.plot(
                    [r["seconds"] for r in own], [scale * r[name] for r in own],
                    **style.line(index), label=integrator, gid=f"{name}-{index}",
                )  # fmt: skip
                points[f"{name}-{index}"] = [
                    f"{integrator}\n{seconds(r['seconds'])} s, {label} {scale * r[name]:.3g}"
                    + (f" {unit}" if unit else "")
                    for r in own
                ]
            _logarithmic(ax)
            ax.set_title(f"{label}, %" if unit == "%" else label)
        for ax in axes.flat[len(names) :]:
            ax.axis("off")
        handles, labels = axes.flat[0].get_legend_handles_labels()
        if len(names) < axes.size:
            axes.flat[-1].legend(handles, labels, loc="center")
        else:
            axes.flat[0].legend(handles, labels)
    return points


def stages(path: Path, measurements: list[Measurement]) -> Points:
    """Plot the seconds to a first image by stage: cold, and with compiled kernels."""
    points: Points = {}
    bars = [
        (f"{m.integrator}\n{label}", values)
        for m in measurements
        for label, values in (("cold", m.cold), ("warm kernels", m.warm), ("next view", m.again))
        if values
    ]
    with style.figure(path, figsize=(7.5, 0.9 + 0.42 * len(bars))) as (_, axes):
        ax = axes[0, 0]
        left = np.zeros(len(bars))
        for stage, colour in STAGE_COLOURS.items():
            width = np.array([values.get(stage, 0.0) for _, values in bars])
            if width.any():
                drawn = ax.barh(
                    range(len(bars)), width, left=left, color=colour, label=stage, height=0.7
                )
                for number, (bar, value) in enumerate(zip(drawn, width, strict=True)):
                    bar.set_gid(f"{stage}-{number}")
                    text = bars[number][0].replace("\n", ", ")
                    points[bar.get_gid()] = [f"{text}\n{stage}: {seconds(value)} s"]
                left += width
        ax.set_yticks(range(len(bars)), [label for label, _ in bars], fontsize=7.5)
        ax.invert_yaxis()
        ax.grid(False, axis="y")
        ax.set_xlabel("seconds to a first image")
        ax.legend(ncols=len(STAGES), loc="lower left", bbox_to_anchor=(0, 1))
    return points


def _noise_slope(ax: Axes, curves: list[Curve]) -> None:
    """Draw a line proportional to 1 / sqrt(time) through the first point with the largest error."""
    starts = [(c.seconds[0], c.shown[0]) for c in curves if len(c.seconds)]
    end = max((c.seconds[-1] for c in curves if len(c.seconds)), default=0)
    if not starts:
        return
    t, e = max(starts, key=lambda point: point[1])
    x = np.array([t, max(end, 2 * t)])
    ax.plot(x, 100 * 1.35 * e * np.sqrt(t / x), "--", color=style.GREY, linewidth=0.8)
    ax.annotate(
        "noise: 1/√time", (x[0], 135 * e), xytext=(4, 3), textcoords="offset points",
        color=style.GREY, fontsize=7,
    )  # fmt: skip


def _logarithmic(ax: Axes) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.autoscale_view()
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        low, high = axis.get_view_interval()
        if high < 100 * low:  # an axis too short for two powers of ten needs more labels
            axis.set_minor_formatter(FuncFormatter(_minor_label))
        else:
            axis.set_minor_formatter(NullFormatter())
        axis.set_tick_params(which="minor", labelsize=7)


def _minor_label(value: float, _: int) -> str:
    digit = round(value / 10 ** np.floor(np.log10(value)))
    return f"{value:g}" if digit in (2, 5) else ""


def _drawable(value: float | None) -> bool:
    return value is not None and np.isfinite(value) and value > 0
