"""``make demo``: render a procedural chest CT, and compare the result with volpath.

Creates the thorax phantom, imports it with a transfer function, renders it with ``irrcache``, and
prints the error of ``irrcache`` and of ``volpath`` after the same time, against a volpath
reference.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cli.main import main as irrcache
from mitsuba_irrcache.cli.render import progress_bar
from mitsuba_irrcache.compare import metrics
from mitsuba_irrcache.io.images import write_image
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.machine.llvm import require_llvm

INTEGRATOR = "irrcache{step=0.5}"
SCENE = {"max_depth": "2", "hide_emitters": "true", "radiance": "2"}


def main() -> None:
    """Run the demo; all its files are below the output folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("output/demo"))
    parser.add_argument("--phantom", default="phantom:thorax:190,120,165", help="volume")
    parser.add_argument("--preset", default="ct-chest", help="transfer function")
    parser.add_argument("--size", type=int, default=512, help="pixels of the picture, per side")
    parser.add_argument(
        "--compared", type=int, default=160, help="pixels of the comparison, per side"
    )
    parser.add_argument("--reference-spp", type=int, default=128, help="volpath samples per pixel")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)

    require_llvm()
    mi.set_variant("llvm_ad_rgb")
    folder = args.output / "scene"
    status = irrcache(
        [
            *("import", args.phantom, "--preset", args.preset, "--supersample", "2"),
            *("-o", str(folder), "--overwrite"),
        ]
    )
    if status:
        raise SystemExit(status)
    picture(folder / "scene.xml", args.output / "chest.exr", args.size)
    compare(folder / "scene.xml", args.output, args.compared, args.reference_spp)


def picture(scene_file: Path, output: Path, size: int) -> None:
    """Render the full-size image."""
    scene = load_scene(scene_file, _sized(size), INTEGRATOR)
    with progress_bar(scene.integrator()):
        scene.integrator().prepare(scene)
    image = np.array(mi.render(scene, spp=16))
    png = write_image(output, image, {"integrator": INTEGRATOR})
    print(f"\npicture        {png} ({size} x {size})")


def compare(scene_file: Path, output: Path, size: int, reference_spp: int) -> None:
    """Compare errors after the same time, with compiled kernels for both; print and save them."""
    ours = load_scene(scene_file, _sized(size), INTEGRATOR)
    theirs = load_scene(scene_file, _sized(size), "volpath{rr_depth=1000}")
    _render(
        load_scene(scene_file, _sized(size), INTEGRATOR.replace("cache_spp=16", "cache_spp=8")), 16
    )
    _, probe = _render(theirs, 4)
    _, probe = _render(theirs, 4)

    started = time.perf_counter()
    ours.integrator().prepare(ours)
    cache_seconds = time.perf_counter() - started
    image, projection_seconds = _render(ours, 16)
    budget = cache_seconds + projection_seconds
    equal_spp = max(1, round(4 * budget / probe))
    print(f"reference      volpath, {reference_spp} samples per pixel ...", flush=True)
    halves = [_render(theirs, reference_spp // 2, seed=1000 + k)[0] for k in range(2)]
    stock, stock_seconds = _render(theirs, equal_spp, seed=1)

    mean = np.mean(halves)
    rows = [
        ("irrcache", f"{cache_seconds:.2f}", f"{projection_seconds:.2f}", image),
        (f"volpath, {equal_spp} spp", "-", f"{stock_seconds:.2f}", stock),
    ]
    print(f"\n{'':<20}{'cache [s]':>12}{'image [s]':>12}{'RMSE':>10}{'mean error':>12}")
    for name, cache, projection, result in rows:
        rmse = metrics.net_rmse(result, *halves) / mean
        bias = metrics.mean_error(result, *halves) / mean
        # The estimate of a small square may be negative, within the noise of the reference.
        error = f"{rmse:.2%}" if rmse > 0 else f"< {-rmse:.2%}"
        print(f"{name:<20}{cache:>12}{projection:>12}{error:>10}{bias:>12.2%}")
    print(
        f"(in units of the mean radiance, {size} x {size} pixels; the reference's noise is removed)"
    )
    strip = np.concatenate([image, stock, np.mean(halves, axis=0)], axis=1)
    png = write_image(output / "comparison.exr", strip, {"order": "irrcache, volpath, reference"})
    print(f"comparison     {png} (irrcache, volpath in the same time, reference)")


def _sized(size: int) -> dict[str, str]:
    return SCENE | {"width": str(size), "height": str(size)}


def _render(scene: mi.Scene, spp: int, seed: int = 0) -> tuple[np.ndarray, float]:
    started = time.perf_counter()
    image = mi.render(scene, spp=spp, seed=seed)
    dr.eval(image)
    dr.sync_thread()
    return np.array(image), time.perf_counter() - started


if __name__ == "__main__":
    main()
