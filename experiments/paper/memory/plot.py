"""Draws what run.py left: output/memory/memory.png.

python -m experiments.paper.memory.plot [--full]
"""

from __future__ import annotations

from matplotlib.axes import Axes

from experiments.support.analysis import fit_memory
from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section
from mitsuba_irrcache.compare.tables import Table

#: The paper's formulas, for n^3 voxels and m^2 pixels.
PAPER = {
    "path tracing": "O(n³ + m²)",
    "cache": "O(2 n³)",
    "cache + filter": "O(2 n³ + m²)",
}


def plot(options: Options) -> Section:
    """Plot peak memory over voxels and over pixels, with the fitted bytes for each."""
    folder = options.folder("memory")
    rows: dict[str, list[dict]] = {}
    for row in read_json(folder / "results.json").values():
        rows.setdefault(row["label"], []).append(row)
    path = folder / "memory.png"
    with style.figure(path, 1, 2, figsize=(8.5, 3.4), sharey=True) as (_, axes):
        for ax, size, other in zip(
            axes[0], ("voxels", "pixels"), ("pixels", "voxels"), strict=True
        ):
            _panel(ax, rows, size, other)
        axes[0, 0].set_ylabel("peak memory, MiB")
        axes[0, 0].legend()
    caption = (
        "Peak memory of a process that renders one image: left against the voxels of the volume, "
        "with as many in the cache, right against the pixels of the image."
    )
    return Section("Memory", [Figure(path, caption), _table(rows)])


def _panel(ax: Axes, rows: dict[str, list[dict]], size: str, other: str) -> None:
    """Plot the rows whose other size is the smallest."""
    for index, (label, own) in enumerate(rows.items()):
        least = min(row[other] for row in own)
        shown = sorted((r for r in own if r[other] == least), key=lambda r: r[size])
        ax.plot(
            [r[size] / 1e6 for r in shown], [r["bytes"] / 2**20 for r in shown],
            label=label, **style.line(index),
        )  # fmt: skip
    ax.set_xlabel(f"million {size}")
    ax.set_ylim(bottom=0)


def _table(rows: dict[str, list[dict]]) -> Table:
    cells = []
    for label, own in rows.items():
        base, per_voxel, per_pixel = fit_memory(own)
        cells.append(
            [label, f"{base / 2**20:.0f} MiB", f"{per_voxel:.0f}", f"{per_pixel:.0f}", PAPER[label]]
        )
    note = (
        "Least squares: peak = base + a × voxels + b × pixels. The base is Python, Mitsuba and "
        "LLVM. Mitsuba holds four floats for each voxel (extinction and colour), and reads them "
        "through copies; pixels count with one sample each."
    )
    head = ["method", "base", "bytes per voxel", "bytes per pixel", "the paper's"]
    return Table("Bytes for a voxel and for a pixel", head, cells, note)


if __name__ == "__main__":
    plot(parse(__doc__))
