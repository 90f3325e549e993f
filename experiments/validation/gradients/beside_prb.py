"""Gradients voxel by voxel beside those of ``prbvolpath``, at equal error.

CPU times include the image and, for this integrator, its cache. The reference is a gradient of this
integrator with many more samples and ordinates, so its error here is that of a single gradient
beside it; what both have in common is told by finite differences. The error of ``prbvolpath`` is
that between two of its gradients: what these have in common, as where there is no matter, is not
counted.
"""

from __future__ import annotations

from time import process_time

import mitsuba as mi
import numpy as np

from experiments.validation.gradients.cases import Case
from experiments.validation.gradients.differences import gradients, pixel_weights
from mitsuba_irrcache.compare.tables import Table

#: Extinction, relative to the largest, from which on voxels are counted apart from the others.
DENSE = 0.1
#: Camera samples of each pixel of both integrators, and of the reference.
SPP, PRB_SPP, REFERENCE_SPP = 64, 256, 1024


def table(voxels: int) -> Table:
    """The table for so many ``voxels`` along each side, in a monochromatic variant."""
    before = mi.variant()
    mi.set_variant("llvm_ad_mono" if before.startswith("llvm") else "cuda_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    cells = [row for max_depth in (2, -1) for row in _rows(voxels, max_depth)]
    mi.set_variant(before)
    head = ["scattering", "parameter", "error", "CPU s", "error of prbvolpath", "CPU s"]
    head += ["CPU time of prbvolpath for the same error"]
    note = f"{voxels}^3 voxels, 32 x 32 pixels with {SPP} samples, {PRB_SPP} of prbvolpath."
    return Table("Gradients beside prbvolpath", head, cells, note)


def _rows(voxels: int, max_depth: int) -> list[list[str]]:
    """The rows for single scattering or all orders."""
    case = Case(voxels, voxels, depth=6.0 / voxels, max_depth=max_depth)
    names, weights = case.parameters, pixel_weights(case.load())

    def timed(settings: dict, spp: int, seed: int) -> tuple[dict, float]:
        gradients(case.load(**settings), names, weights, spp=4, seed=99)  # compiles the kernels
        scene = case.load(**settings)
        begun = process_time()
        found = gradients(scene, names, weights, spp=spp, seed=seed)
        return found, process_time() - begun

    fine = case.load(cache_spp=1024, cache_seed=5)
    reference = gradients(fine, names, weights, spp=REFERENCE_SPP, seed=17)
    ours, seconds = timed({}, SPP, 3)
    stock = {"type": "prbvolpath", "max_depth": max_depth}
    (first, one), (second, two) = (timed(stock, PRB_SPP, seed) for seed in (1, 2))
    dense = case.sigma_t() >= DENSE * case.sigma_t().max()
    label = "single" if max_depth == 2 else "all orders"
    rows = []
    for name in names:
        for where, mask in (("all voxels", 1), (f"where sigma_t > {DENSE:.0%}", dense)):
            found = [f[name] * mask for f in (reference, ours, first, second)]
            rows.append([label, f"{name}, {where}", *_cells(found, seconds, 0.5 * (one + two))])
    return rows


def _cells(found: list[np.ndarray], seconds: float, prb_seconds: float) -> list[str]:
    """Errors, times and their ratio, for a reference, our gradient, and two of ``prbvolpath``."""
    reference, ours, first, second = found
    norm = np.linalg.norm(reference)
    error = np.linalg.norm(ours - reference) / norm
    prb_error = np.linalg.norm(first - second) / np.sqrt(2) / norm
    times = prb_seconds * (prb_error / error) ** 2 / seconds
    return [
        f"{error:.1%}",
        f"{seconds:.2f}",
        f"{prb_error:.0%}",
        f"{prb_seconds:.2f}",
        f"{float(f'{times:.2g}'):,.0f} x",
    ]
