"""Gradients against finite differences of the image, and beside those of ``prbvolpath``.

    python -m experiments.validation.gradients.run [--case NAME] [--document docs/validation.md]

The first table has for each case and parameter the relative error and the cosine of directional
derivatives along smooth perturbations (`differences`), and the error in forward mode, the second
one has those among surfaces, the third and the fourth one errors by voxel at equal CPU time
(`beside_prb`), of a synthetic and of real volumes.
``--case`` runs the cases of the first two whose names contain it.
"""

from __future__ import annotations

import argparse
import gc
from dataclasses import replace
from time import process_time

import mitsuba as mi
import numpy as np

from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin
from experiments.validation.gradients import beside_prb
from experiments.validation.gradients.cases import CASES, SURROUNDED, Case
from experiments.validation.gradients.differences import (
    BLOBS,
    SPP_GRAD,
    compare,
    derivatives,
    directions,
    first_key,
    gradients,
    mean_of,
    pixel_weights,
)
from mitsuba_irrcache.compare.tables import Table

#: Perturbations of each parameter among surfaces.
FEWER_BLOBS = 3


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", default="", help="part of the names of the cases to run")
    kinds = ("isolated", "surfaces", "prbvolpath", "real")
    parser.add_argument("--only", choices=kinds, help="one table")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--voxels", type=int, default=32, help="along a side, beside prbvolpath")
    add_document(parser)
    options = parser.parse_args()
    begin()
    mi.set_variant(options.variant)
    mi.set_log_level(mi.LogLevel.Error)
    tables = {}
    if options.only in (None, "isolated"):
        tables["gradients"] = differences(options.case)
    if options.only in (None, "surfaces"):
        tables["gradients-surfaces"] = among_surfaces(options.case)
    if options.only in (None, "prbvolpath") and not options.case:
        tables["gradients-prb"] = beside_prb.table(options.voxels)
        print(tables["gradients-prb"].as_text())
    if options.only in (None, "real") and not options.case:
        tables["gradients-real"] = beside_prb.real_table((32, 64))
        print(tables["gradients-real"].as_text())
    if options.document:
        replace_tables(options.document, tables)


def differences(chosen: str) -> Table:
    """The table of finite differences."""
    cells = []
    for name, case in CASES.items():
        if chosen in name:
            for row in _rows(name, case):
                print("  ".join(row), flush=True)
                cells.append(row)
    head = ["case", "parameter", "error", "cosine", "forward mode", "CPU s"]
    return Table("Gradients against finite differences", head, cells)


def among_surfaces(chosen: str) -> Table:
    """The table of finite differences among surfaces, area emitters and several media."""
    cells = []
    for name, case in SURROUNDED.items():
        if chosen in name:
            for row in _rows_among_surfaces(name, case):
                cells.append(row)
                print("  ".join(row), flush=True)
    head = ["case", "parameter", "error", "noise", "cosine", "CPU s (cold image)"]
    caches = SURROUNDED["room, sky"].caches
    note = (
        f"Times of image and gradient with {SPP_GRAD} samples, after the first, and of a cache and "
        f"its image. Room: means over {caches} caches, whose noise is given."
    )
    return Table("Gradients among surfaces and several media", head, cells, note)


def _rows_among_surfaces(name: str, case: Case) -> list[list[str]]:
    found: dict[str, list] = {parameter: [] for parameter in case.parameters}
    for seed in range(case.caches):
        scene = case.load(cache_seed=seed)
        weights = pixel_weights(scene)
        own = gradients(scene, case.parameters, weights, case.samples, 3 + seed)
        for parameter, gradient in own.items():
            result = compare(scene, case, parameter, weights, gradient, FEWER_BLOBS)
            found[parameter].append(result)
    rows, seconds = [], _seconds(case)
    for parameter, results in found.items():
        mean, noise = mean_of(results)
        shown = "" if np.isnan(noise) else f"{noise:.2%}"
        cells = f"{mean.error:.2%}", shown, f"{mean.cosine:.5f}", seconds
        rows.append([name, parameter, *cells])
    return rows


def _seconds(case: Case) -> str:
    """Measure the CPU time of an image with its gradient, and of a cache and its image, with
    compiled kernels.
    """
    scene = None
    for _ in range(2):
        del scene
        gc.collect()  # kernels depend on all objects that exist
        scene = case.load()
        begun = process_time()
        mi.render(scene, spp=SPP_GRAD).numpy()
        cold = process_time() - begun
    weights = pixel_weights(scene)
    for seed in range(2):
        begun = process_time()
        gradients(scene, case.parameters, weights, SPP_GRAD, seed)
    return f"{process_time() - begun:.1f} ({cold:.1f})"


def _rows(name: str, case: Case) -> list[list[str]]:
    scene = case.load()
    weights = pixel_weights(scene)
    begun = process_time()
    found = gradients(scene, case.parameters, weights, case.samples)
    seconds = process_time() - begun
    rows = []
    for parameter, gradient in found.items():
        result = compare(scene, case, parameter, weights, gradient)
        params = mi.traverse(scene)
        value = np.array(params[first_key(params, parameter)], dtype=np.float64)
        steps = directions(case, parameter, value, BLOBS)
        forward = replace(
            result, adjoint=derivatives(scene, parameter, weights, steps, case.samples)
        )
        cells = f"{result.error:.2%}", f"{result.cosine:.5f}", f"{forward.error:.2%}"
        rows.append([name, parameter, *cells, f"{seconds:.2f}"])
    return rows


if __name__ == "__main__":
    main()
