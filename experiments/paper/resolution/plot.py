"""Draws what run.py left: output/resolution/resolution.png.

python -m experiments.paper.resolution.plot [--full]
"""

from __future__ import annotations

from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section
from mitsuba_irrcache.compare.tables import Table, percent, seconds

KINDS = ("equal samples per voxel", "equal samples in all")


def plot(options: Options) -> Section:
    """Plot errors against resolution, and tabulate them."""
    folder = options.folder("resolution")
    results = read_json(folder / "results.json")
    path = folder / "resolution.png"
    with style.figure(path, 1, 2, figsize=(8.5, 3.4), sharey=True) as (_, axes):
        for ax, kind in zip(axes[0], KINDS, strict=True):
            rows = [row for row in results.values() if row.get("kind") == kind]
            for index, key in enumerate(("net_rmse", "discretisation", "noise")):
                label = "RMSE" if key == "net_rmse" else key
                values = [100 * row[key] for row in rows]
                ax.plot([r["resolution"] for r in rows], values, label=label, **style.line(index))
            ax.set_xscale("log", base=2)
            ax.set_yscale("log")
            ax.set_xlabel("cache voxels along the longest side")
            ax.set_title(kind)
        axes[0, 0].set_ylabel("% of the mean radiance")
        axes[0, 0].legend()
    caption = (
        "What the paper suggests for later: a cache coarser than the data "
        f"({options.size.longest} voxels along the longest side). What two caches of different "
        "seeds share is discretisation, what they do not is noise."
    )
    return Section("Resolution of the cache", [Figure(path, caption), _table(results)])


def _table(results: dict) -> Table:
    peaks = {row["resolution"]: row["bytes"] for row in results.values() if "bytes" in row}
    cells = [
        [row["kind"], str(row["resolution"]), str(row["active_voxels"]), str(row["samples"]),
         percent(row["net_rmse"]), f"{100 * row['mean_error']:+.2f} %",
         f"{seconds(row['cache_seconds'])} s", f"{peaks[row['resolution']] / 2**20:.0f} MiB"]
        for row in results.values() if "kind" in row
    ]  # fmt: skip
    note = (
        "Errors in units of the mean radiance, sky included, net of the reference's noise. Voxels: "
        "those that see the medium. Memory: peak of a process that renders one image."
    )
    head = ["", "voxels", "active", "samples", "RMSE", "mean error", "time", "peak memory"]
    return Table("Error, time and memory by resolution", head, cells, note)


if __name__ == "__main__":
    plot(parse(__doc__))
