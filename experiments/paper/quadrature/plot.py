"""Draws what run.py left: output/quadrature/orders.png and banding.png.

python -m experiments.paper.quadrature.plot [--full]
"""

from __future__ import annotations

from matplotlib.axes import Axes

from experiments.support.options import Options, parse
from experiments.support.store import read_json
from experiments.support.tiles import crop, read, tiles
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section
from mitsuba_irrcache.compare.tables import Table

#: Detail of the images with banding: position as fractions of width and height, and its height.
CENTRE, SHARE = (0.5, 0.55), 0.35
PANELS = {
    "fog": "smooth fog, no jitter",
    "phantom": "chest phantom, no jitter",
    "jitter": "chest phantom, with jitter",
}


def plot(options: Options) -> Section:
    """Plot errors against step, and the banding."""
    folder = options.folder("quadrature")
    results = read_json(folder / "results.json")
    curves = folder / "orders.png"
    with style.figure(curves, 1, 3, figsize=(10.5, 3.4)) as (_, axes):
        for ax, (name, title) in zip(axes[0], PANELS.items(), strict=True):
            _panel(ax, results[name])
            ax.set_title(title)
        axes[0, 0].set_ylabel("relative RMSE")
        axes[0, 0].legend()
    pictures = folder / "banding.png"
    banding = results["banding"]
    images = [crop(read({"image": i}), CENTRE, SHARE) for i in banding["images"].values()]
    tiles(pictures, [images], [""], [list(banding["images"])], width=2.4)
    parts = [
        Figure(curves, "Error against the same rule at a step of 1/32 voxel edge. The paper's "
               "Riemann sum is of order 1. With jitter, the error is that of the integrator's "
               "image, against the exponential rule at the fine step."),
        Figure(pictures, f"Banding, which the paper shows: steps of {banding['step']:g} voxel "
               "edges without jitter, a detail. The integrator jitters, so that what is left is "
               "noise."),
        _table(results),
    ]  # fmt: skip
    return Section("Quadrature", parts)


def _panel(ax: Axes, found: dict) -> None:
    for index, (quadrature, errors) in enumerate(found["errors"].items()):
        ax.plot(found["steps"], errors, label=quadrature, **style.line(index))
    ax.set_xscale("log", base=2)
    ax.set_yscale("log")
    ax.set_xlabel("step, voxel edges")


def _table(results: dict) -> Table:
    jitter = results["jitter"]
    cells = [
        [quadrature, f"{step:g}", f"{error:.2e}", f"{mean:+.1e}",
         *(f"{results[name]['errors'][quadrature][k]:.1e}" for name in ("fog", "phantom"))]
        for quadrature, errors in jitter["errors"].items()
        for k, (step, error, mean) in enumerate(
            zip(jitter["steps"], errors, jitter["mean_errors"][quadrature], strict=True)
        )
    ]  # fmt: skip
    last = {
        name: ", ".join(f"{q} {o[-1]:.1f}" for q, o in results[name]["orders"].items())
        for name in ("fog", "phantom")
    }
    note = (
        f"Measured orders between the two finest steps: fog {last['fog']}; phantom "
        f"{last['phantom']}, whose data are not smooth."
    )
    head = ["rule", "step", "jitter: RMSE", "jitter: mean error", "fog", "phantom"]
    return Table("Errors of the quadratures", head, cells, note)


if __name__ == "__main__":
    plot(parse(__doc__))
