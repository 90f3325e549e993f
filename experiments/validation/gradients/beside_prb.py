"""Gradients voxel by voxel beside those of ``prbvolpath``, at equal error.

CPU times include the image and, for this integrator, its cache. The reference is a gradient of this
integrator with many more samples and ordinates, so its error here is that of a single gradient
beside it; what both have in common is told by finite differences. The error of ``prbvolpath`` is
that between two of its gradients: what these have in common, as where there is no matter, is not
counted.
"""

from __future__ import annotations

from time import process_time

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.validation.gradients.cases import Case
from experiments.validation.gradients.differences import first_key, gradients, pixel_weights
from experiments.validation.gradients.real_volumes import VOLUMES, Subject
from mitsuba_irrcache.compare.gradients import gradients_of
from mitsuba_irrcache.compare.tables import Table

#: Extinction, relative to the largest, from which on voxels are counted apart from the others.
DENSE = 0.1
#: Camera samples of each pixel of both integrators, and of the reference.
SPP, PRB_SPP, REFERENCE_SPP = 64, 256, 1024
#: The same for real volumes, of which images have twice as many pixels along a side as voxels.
REAL_SPP, REAL_PRB_SPP, REAL_REFERENCE_SPP = 16, 64, 256
#: Number of scattering events after which Russian roulette ends paths of ``prbvolpath``: its
#: default, and none. That with the smaller product of variance and time is taken.
ROULETTE = (5, 10_000)
#: Edge of the blocks of voxels over which means are taken.
BLOCK = 4


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


def real_table(counts: tuple[int, ...]) -> Table:
    """The table for real volumes in cubes of so many voxels along each side, all orders."""
    before = mi.variant()
    mi.set_variant("llvm_ad_mono" if before.startswith("llvm") else "cuda_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    cells = []
    for name in VOLUMES:
        for voxels in counts:
            subject = Subject(name, voxels, views=1, pixels=2 * voxels)
            if not subject.is_available:
                print(f"{name}: no data")
                continue
            for row in _rows_of(subject):
                print("  ".join(row), flush=True)
                cells.append(row)
    mi.set_variant(before)
    head = ["volume", "voxels", "parameter", "error", "of blocks", "CPU s", "prbvolpath: error"]
    head += ["of blocks", "CPU s", "CPU time for the same error", "of blocks"]
    note = (
        f"Images of twice as many pixels as voxels along a side with {REAL_SPP} samples, "
        f"{REAL_PRB_SPP} of prbvolpath; blocks of {BLOCK}^3 voxels."
    )
    return Table("Gradients of real volumes beside prbvolpath", head, cells, note)


def _rows_of(subject: Subject) -> list[list[str]]:
    """The rows of a real volume, for the extinction and the albedo."""
    names, extinction, sensor = ("sigma_t", "albedo"), subject.sigma_t(), subject.sensors()[0]
    rows, columns = np.mgrid[: subject.pixels, : subject.pixels] / subject.pixels
    plane = 1 + 0.5 * np.cos(4 * columns + 1) * np.sin(3 * rows)
    weights = mi.TensorXf(plane[..., None].astype(np.float32))

    def found(integrator: dict, spp: int, seed: int) -> tuple[dict, float]:
        scene = subject.load(integrator, extinction, albedo_on_grid=True)
        params, begun = mi.traverse(scene), process_time()
        keys = [first_key(params, name) for name in names]
        own = gradients_of(
            scene, params, keys, lambda image: dr.mean(image * weights),
            sensor=sensor, spp=spp, seed=seed,
        )  # fmt: skip
        return dict(zip(names, own.values(), strict=True)), process_time() - begun

    def stock(rr_depth: int, spp: int, seed: int) -> tuple[dict, float]:
        return found({"type": "prbvolpath", "rr_depth": rr_depth}, spp, seed)

    own = {"type": "irrcache", "solver": "sweep", "resolution": subject.voxels}
    found(own, 4, 9)  # compiles the kernels
    reference, _ = found(own | {"cache_spp": 1024, "cache_seed": 5}, REAL_REFERENCE_SPP, 17)
    ours, seconds = found(own, REAL_SPP, 3)
    costs = {}
    for rr_depth in ROULETTE:
        stock(rr_depth, 1, 9)
        (a, one), (b, two) = (stock(rr_depth, REAL_PRB_SPP // 4, seed) for seed in (5, 6))
        square = np.square(a["sigma_t"] - b["sigma_t"]).sum()
        costs[rr_depth] = (one + two) * square
    best = min(costs, key=costs.get)
    (first, one), (second, two) = (stock(best, REAL_PRB_SPP, seed) for seed in (1, 2))
    result = []
    for name in names:
        errors, prb_errors, ratios = [], [], []
        for of in (np.asarray, _block_means):
            r, x, a, b = (of(each[name]) for each in (reference, ours, first, second))
            scale = np.linalg.norm(r)
            errors.append(np.linalg.norm(x - r) / scale)
            prb_errors.append(np.linalg.norm(a - b) / np.sqrt(2) / scale)
            ratios.append(0.5 * (one + two) * (prb_errors[-1] / errors[-1]) ** 2 / seconds)
        cells = [subject.name, str(subject.voxels), name, *(f"{e:.1%}" for e in errors)]
        cells += [f"{seconds:.1f}", *(f"{e:.0%}" for e in prb_errors), f"{0.5 * (one + two):.1f}"]
        result.append(cells + [f"{float(f'{ratio:.2g}'):,.0f} x" for ratio in ratios])
    return result


def _block_means(values: np.ndarray) -> np.ndarray:
    """Means over blocks of ``BLOCK``^3 voxels of a grid (z, y, x, channel)."""
    nz, ny, nx = (n // BLOCK for n in values.shape[:3])
    return values.reshape(nz, BLOCK, ny, BLOCK, nx, BLOCK, -1).mean(axis=(1, 3, 5))
