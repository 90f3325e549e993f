"""How far ``irrcache`` is from volpath: bias, RMSE, and what of it is noise and what
discretisation.

    python -m experiments.accuracy.run [--scenes phantom cloud head] [--depths 2 -1] [--force]

For every scene, depth and cache resolution two caches of different seeds are built: what their
images share is discretisation, what they do not is noise. Prints a table and writes
output/accuracy/results.json; finished rows are kept.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.scenes import IMPORTS, scene_file
from mitsuba_irrcache.compare import metrics
from mitsuba_irrcache.compare.reference import reference
from mitsuba_irrcache.loading import load_scene
from mitsuba_irrcache.runtime import require_llvm

REFERENCE = {2: "volpath{rr_depth=1000}", -1: "volpath{rr_depth=20}"}


def main() -> None:
    """Computes the rows that are missing and prints all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(IMPORTS), choices=list(IMPORTS))
    parser.add_argument("--depths", nargs="+", type=int, default=[2, -1])
    parser.add_argument("--resolutions", nargs="+", type=int, default=[32, 64, 128])
    parser.add_argument("--cache-spp", type=int, default=16)
    parser.add_argument("--size", type=int, default=96, help="pixels per side")
    parser.add_argument("--reference-spp", type=int, default=256, help="per half")
    parser.add_argument("--output", type=Path, default=Path("output/accuracy"))
    parser.add_argument("--force", action="store_true", help="compute all rows again")
    args = parser.parse_args()

    require_llvm()
    mi.set_variant("llvm_ad_rgb")
    args.output.mkdir(parents=True, exist_ok=True)
    store = args.output / "results.json"
    rows = json.loads(store.read_text()) if store.exists() and not args.force else {}
    for name in args.scenes:
        path = scene_file(name, args.output)
        if path is None:
            continue
        for depth in args.depths:
            for resolution in args.resolutions:
                key = (
                    f"{name} {depth} {resolution} {args.cache_spp} {args.size} {args.reference_spp}"
                )
                if key not in rows:
                    rows[key] = measure(path, depth, resolution, args)
                    store.write_text(json.dumps(rows, indent=1))
                print_row(name, depth, resolution, rows[key])


def measure(path: Path, depth: int, resolution: int, args: argparse.Namespace) -> dict[str, float]:
    """Errors in units of the mean reference radiance of all pixels, and seconds."""
    parameters = {"max_depth": str(depth), "width": str(args.size), "height": str(args.size)}
    truth = reference(
        path, parameters, REFERENCE[depth], args.output / "references", args.reference_spp
    )
    a, b = truth.a, truth.b
    images, cache_seconds, image_seconds = [], 0.0, 0.0
    for seed in (1, 2):
        integrator = (
            f"irrcache{{resolution={resolution},cache_spp={args.cache_spp},cache_seed={seed}}}"
        )
        scene = load_scene(path, parameters, integrator)
        started = time.perf_counter()
        scene.integrator().prepare(scene)
        cache_seconds = time.perf_counter() - started
        started = time.perf_counter()
        images.append(np.array(mi.render(scene, spp=64, seed=seed), dtype=np.float64))
        dr.sync_thread()
        image_seconds = time.perf_counter() - started
    x, y = images
    mean = float(np.mean(0.5 * (a + b)))
    return {
        "mean_error": metrics.mean_error(0.5 * (x + y), a, b) / mean,
        "net_rmse": metrics.net_rmse(x, a, b) / mean,
        "noise": metrics.noise(x, y) / mean,
        "discretisation": metrics.discretisation_error(x, y, a, b) / mean,
        "blocks": metrics.block_error(x, a, b) / mean,
        "reference_noise": metrics.noise(a, b) / 2**0.5 / mean,
        "cache_seconds": cache_seconds,
        "image_seconds": image_seconds,
    }


def print_row(name: str, depth: int, resolution: int, row: dict[str, float]) -> None:
    """One line of the table; the heading goes with it, so that every line can be read alone."""
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
