"""Draws what run.py left: output/performance/performance.png.

python -m experiments.performance.error_against_time.plot
"""

from __future__ import annotations

import numpy as np

from experiments.performance.error_against_time.run import TARGETS, cost, defaults, table
from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section
from mitsuba_irrcache.io.scene_files import parse_integrator

KINDS = (("cold", "irrcache, cold cache"), ("moved", "irrcache, camera moved"))


def plot(options: Options) -> Section:
    """Plot a panel for each scene and depth."""
    folder = options.folder("performance")
    cases = list(read_json(folder / "results.json").values())
    path = folder / "performance.png"
    depths = sorted({case["depth"] for case in cases}, reverse=True)
    names = list(dict.fromkeys(case["name"] for case in cases))
    size = (0.6 + 3 * len(names), 0.6 + 2.8 * len(depths))
    with style.figure(path, len(depths), len(names), figsize=size, sharex=True, sharey=True) as (
        _,
        axes,
    ):
        for case in cases:
            _panel(axes[depths.index(case["depth"]), names.index(case["name"])], case)
        axes[0, 0].legend(fontsize=7)
        for ax in axes[-1]:
            ax.set_xlabel("seconds, kernels compiled beforehand")
        for ax in axes[:, 0]:
            ax.set_ylabel("RMSE, sky = 1")
    caption = (
        "Each point is a setting of irrcache. The lines are of the best stock integrator of each "
        "kind, from its variance and time per sample. Dotted: the errors of the table."
    )
    return Section("Error against time", [Figure(path, caption), table(cases), defaults(cases)])


def _panel(ax, case: dict) -> None:
    every = [*case["points"], case["default"]]
    times = [row[kind] for row in every for kind, _ in KINDS]
    ends = [min(times), max(max(times), max(row["stock_seconds"] for row in case["targets"]))]
    best: dict[str, float] = {}
    for row in case["stock"]:
        name = parse_integrator(row["integrator"])[0]
        best[name] = min(cost(row), best.get(name, np.inf))
    for index, (name, seconds) in enumerate(best.items()):
        colour = style.COLOURS[(index + len(KINDS)) % len(style.COLOURS)]
        ax.plot(ends, np.sqrt(seconds / np.array(ends)), color=colour, label=name, linewidth=1)
    for index, (kind, label) in enumerate(KINDS):
        errors = [max(row["rmse"], row["at_most"] / 2) for row in every]
        look = style.line(index)
        ax.plot(
            [row[kind] for row in every], errors, look["marker"], color=look["color"],
            label=label, markersize=3, linestyle="none",
        )  # fmt: skip
    for target in TARGETS:
        ax.axhline(target, color=style.GREY, linewidth=0.8, linestyle=":")
    ax.set_xscale("log")
    ax.set_yscale("log")
    depth = "all orders" if case["depth"] < 0 else f"depth {case['depth']}"
    ax.set_title(f"{case['name']}, {depth}")


if __name__ == "__main__":
    plot(parse(__doc__))
