"""Errors of ``irrcache`` against volpath: bias and RMSE, split into noise and discretisation.

    python -m experiments.validation.accuracy.run [--scenes phantom cloud head] [--depths 2 -1]
        [--force]

For every scene, depth and cache resolution two caches of different seeds are built: the common part
of their images' errors is discretisation, the rest is noise. Prints a table and writes
output/accuracy/results.json; finished rows are saved.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import mitsuba as mi

from experiments.support.cached import measure
from experiments.support.documents import replace_tables
from experiments.support.options import add_document
from experiments.support.scenes import SOURCES, scene_file
from experiments.support.store import Store
from mitsuba_irrcache.compare.reference import reference
from mitsuba_irrcache.compare.tables import Table, percent
from mitsuba_irrcache.machine.llvm import require_llvm

SCENES = ["phantom", "cloud", "head"]
REFERENCE = {2: "volpath{rr_depth=1000}", -1: "volpath{rr_depth=20}"}


def main() -> None:
    """Compute missing rows and print all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=list(SOURCES))
    parser.add_argument("--depths", nargs="+", type=int, default=[2, -1])
    parser.add_argument("--resolutions", nargs="+", type=int, default=[32, 64, 0])
    parser.add_argument("--cache-spp", type=int, default=0)
    parser.add_argument("--size", type=int, default=96, help="pixels per side")
    parser.add_argument("--reference-spp", type=int, default=256, help="per half")
    parser.add_argument("--output", type=Path, default=Path("output/accuracy"))
    parser.add_argument("--force", action="store_true", help="compute all rows again")
    add_document(parser)
    args = parser.parse_args()

    require_llvm()
    mi.set_variant("llvm_ad_rgb")
    args.output.mkdir(parents=True, exist_ok=True)
    store, rows = Store(args.output / "results.json", args.force), []
    for name in args.scenes:
        path = scene_file(name, args.output)
        if path is None:
            continue
        for depth in args.depths:
            for resolution in args.resolutions:
                key = (
                    f"{name} {depth} {resolution} {args.cache_spp} {args.size} {args.reference_spp}"
                )
                row = store.row(key, partial(compute, path, depth, resolution, args))
                print_row(name, depth, resolution, row)
                rows.append((name, depth, resolution, row))
    if args.document:
        replace_tables(args.document, {"accuracy": table(rows)})


def table(rows: list[tuple[str, int, int, dict[str, float]]]) -> Table:
    """All rows: the scene, its depth, voxels of the cache (0: chosen), and errors."""
    head = ["scene", "depth", "cache voxels", "mean error", "RMSE", "of it noise"]
    head += ["of it discretisation"]
    cells = [
        [name, str(depth), str(resolution or "chosen"), f"{row['mean_error']:+.2%}"]
        + [percent(row[key]) for key in ("net_rmse", "noise", "discretisation")]
        for name, depth, resolution, row in rows
    ]
    return Table("Errors in units of the mean radiance", head, cells)


def compute(path: Path, depth: int, resolution: int, args: argparse.Namespace) -> dict[str, float]:
    """Compute one row, with the reference that it needs."""
    parameters = {"max_depth": str(depth), "width": str(args.size), "height": str(args.size)}
    truth = reference(
        path, parameters, REFERENCE[depth], args.output / "references", args.reference_spp
    )
    return measure(path, parameters, truth, resolution=resolution, cache_spp=args.cache_spp)


def print_row(name: str, depth: int, resolution: int, row: dict[str, float]) -> None:
    """Print one row of the table, with its headings, so that every line is self-contained."""
    print(
        f"{name:8} depth {depth:2} cache {resolution:3}: mean error {row['mean_error']:+.2%}  "
        f"RMSE {row['net_rmse']:.2%} (noise {row['noise']:.2%}, discretisation "
        f"{row['discretisation']:.2%})  "
        f"blocks {row['blocks']:.2%}  cache {row['cache_seconds']:.1f} s, image "
        f"{row['image_seconds']:.1f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
