"""Draws what run.py left: output/scaling/scaling.png.

python -m experiments.performance.scaling.plot [--full]
"""

from __future__ import annotations

from experiments.performance.scaling.run import STEP_BYTES, floor, images_table, rate, sizes_table
from experiments.support.options import Options, parse
from experiments.support.store import read_json
from mitsuba_irrcache.compare import style
from mitsuba_irrcache.compare.report import Figure, Section


def plot(options: Options) -> Section:
    """Plot throughput against the size of the volume, and time against that of the image."""
    folder = options.folder("scaling")
    results = read_json(folder / "results.json")
    sizes = sorted(
        (row for key, row in results.items() if key.startswith("size ")), key=lambda r: r["voxels"]
    )
    images = [row for key, row in results.items() if key.startswith("pixels ")]
    path = folder / "scaling.png"
    with style.figure(path, 1, 2, figsize=(8.5, 3.4)) as (_, axes):
        left, right = axes[0]
        voxels = [row["voxels"] for row in sizes]
        for index, (kind, label) in enumerate(
            (("seconds_more", "sweeps alone"), ("seconds", "whole cache"))
        ):
            rates = [rate(row, kind) / 1e6 for row in sizes]
            left.plot(voxels, rates, label=label, **style.line(index))
        floors = [floor(row) / 1e6 for row in sizes]
        label = f"bandwidth / {STEP_BYTES} bytes"
        left.plot(voxels, floors, "--", color=style.GREY, label=label)
        loads = [row["loads"] / 1e6 for row in sizes]
        left.plot(voxels, loads, ":", color=style.GREY, label="its loads and stores")
        left.set_xlabel("voxels")
        left.set_ylabel("million voxels × directions per second")
        right.plot(
            [row["pixels"] for row in images],
            [row["seconds"] for row in images],
            **style.line(0),
        )
        right.set_xlabel("pixels")
        right.set_ylabel("seconds of an image")
        for ax in (left, right):
            ax.set_xscale("log")
            ax.set_yscale("log")
        left.legend()
    caption = (
        "Single scattering by sweeps, grey. Left: clouds and the thorax of the paper's size; the "
        "lines in grey are a kernel y = a x, and one of the loads and stores of a sweep alone, in "
        "the same process. Right: images of the 128³ cloud from a cache that is there."
    )
    return Section("Scaling", [Figure(path, caption), sizes_table(sizes), images_table(images)])


if __name__ == "__main__":
    plot(parse(__doc__))
