"""Gradients voxel by voxel beside those of ``prbvolpath``, at equal error.

``python -m experiments.gradients.noise`` prints for each parameter the relative error of both, and
how many times the CPU time of this integrator ``prbvolpath`` would need for the same error. Times
include the image and, for this integrator, the cache.

The reference is a gradient of this integrator with many more samples and ordinates, so its error is
that of a single gradient beside it; what both have in common is told by finite differences (`run`).
The error of ``prbvolpath`` is that between two gradients with other seeds: what it has in common
with itself, as at voxels without matter, is not counted.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from time import process_time

import mitsuba as mi
import numpy as np

#: Extinction, relative to the largest, from which on voxels are counted apart from the others.
DENSE = 0.1


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--voxels", type=int, default=32, help="along each side")
    parser.add_argument("--spp", type=int, default=64, help="camera samples of this integrator")
    parser.add_argument("--prb-spp", type=int, default=64)
    options = parser.parse_args()
    mi.set_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    print("| scattering | parameter | error | CPU s | error of prbvolpath | CPU s | times |")
    print("|---|---|---|---|---|---|---|")
    for max_depth in (2, -1):
        for row in rows(max_depth, options):
            print(row, flush=True)


def rows(max_depth: int, options: argparse.Namespace) -> list[str]:
    """Lines of the table for single scattering or all orders."""
    from experiments.gradients.cases import Case
    from experiments.gradients.differences import gradients, pixel_weights

    case = Case(options.voxels, options.voxels, depth=6.0 / options.voxels, max_depth=max_depth)
    names = case.parameters
    scene = case.load()
    weights = pixel_weights(scene)

    def timed(settings: dict, spp: int, seed: int) -> tuple[dict, float]:
        own = case.load(**settings)
        gradients(own, names, weights, spp=4, seed=99)  # kernels are compiled
        own = case.load(**settings)
        begun = process_time()
        found = gradients(own, names, weights, spp=spp, seed=seed)
        return found, process_time() - begun

    fine = replace(case).load(cache_spp=1024, cache_seed=5)
    reference = gradients(fine, names, weights, spp=16 * options.spp, seed=17)
    ours, seconds = timed({}, options.spp, 3)
    stock = {"type": "prbvolpath", "max_depth": max_depth}
    halves = [timed(stock, options.prb_spp, seed) for seed in (1, 2)]
    prb_seconds = np.mean([time for _, time in halves])
    dense = case.sigma_t() >= DENSE * case.sigma_t().max()
    return [
        _line(
            max_depth, f"{name}, {where}", [f[name] * mask for f in found], (seconds, prb_seconds)
        )
        for name in names
        for where, mask in (("all voxels", 1), (f"where sigma_t > {DENSE:.0%}", dense))
        for found in [(reference, ours, *(half for half, _ in halves))]
    ]


def _line(max_depth: int, name: str, found: list[np.ndarray], seconds: tuple) -> str:
    """A line of the table for a reference, our gradient, and two of ``prbvolpath``."""
    reference, ours, *halves = found
    norm = np.linalg.norm(reference)
    error = np.linalg.norm(ours - reference) / norm
    prb_error = np.linalg.norm(halves[0] - halves[1]) / np.sqrt(2) / norm
    own, prb = seconds
    times = prb * (prb_error / error) ** 2 / own
    label = "single" if max_depth == 2 else "all orders"
    return (
        f"| {label} | {name} | {error:.2%} | {own:.2f} | {prb_error:.0%} | {prb:.2f} "
        f"| {float(f'{times:.2g}'):g} |"
    )


if __name__ == "__main__":
    main()
