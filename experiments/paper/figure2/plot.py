"""Draws figure 2 from what run.py left: output/figure2/figure2.png.

python -m experiments.paper.figure2.plot [--full]
"""

from __future__ import annotations

from matplotlib.axes import Axes

from experiments.support.analysis import curve
from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section

PANELS = {
    "display": "RMSE of the displayed picture (the paper's)",
    "linear": "RMSE of radiance, units of its mean",
}


def plot(options: Options) -> Section:
    """Plot two panels with a common legend."""
    folder = options.folder("figure2")
    results = read_json(folder / "results.json")
    path = folder / "figure2.png"
    with style.figure(path, 1, 2, figsize=(9.5, 3.8)) as (_, axes):
        for ax, (kind, title) in zip(axes[0], PANELS.items(), strict=True):
            _panel(ax, results, kind)
            ax.set_title(title)
        axes[0, 0].legend()
    caption = (
        "The paper's figure 2: error against time. Left its measure, right linear radiance. Both "
        "are against an independent reference whose own noise is removed, so that bias counts; "
        "what the reference cannot resolve is drawn hollow. Kernels are compiled beforehand."
    )
    return Section("Figure 2: error against time", [Figure(path, caption)])


def _panel(ax: Axes, results: dict, kind: str) -> None:
    for index, (label, errors) in enumerate(results.items()):
        line, look = curve(label, errors, kind), style.line(index)
        ax.plot(line.seconds, line.shown, label=label, markersize=4, **look)
        hidden = line.errors < line.resolved
        ax.plot(
            line.seconds[hidden], line.shown[hidden], look["marker"], color=look["color"],
            markerfacecolor="white", linestyle="none",
        )  # fmt: skip
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("seconds")


if __name__ == "__main__":
    plot(parse(__doc__))
