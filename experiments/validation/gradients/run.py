"""Gradients against finite differences of the image, and beside those of ``prbvolpath``.

    python -m experiments.validation.gradients.run [--case NAME] [--document docs/validation.md]

The first table has for each case and parameter the relative error and the cosine of directional
derivatives along smooth perturbations (`differences`), and the error in forward mode, the second
one has those among surfaces, the third one errors by voxel at equal CPU time (`beside_prb`).
``--case`` runs the cases of the first two whose names contain it.
"""

from __future__ import annotations

import argparse
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
    compare,
    derivatives,
    directions,
    gradients,
    key_of,
    pixel_weights,
)
from mitsuba_irrcache.compare.tables import Table

#: Perturbations of each parameter among surfaces.
FEWER_BLOBS = 3


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", default="", help="part of the names of the cases to run")
    parser.add_argument("--only", choices=("isolated", "surfaces", "prbvolpath"), help="one table")
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
            scene = case.load()
            weights = pixel_weights(scene)
            begun = process_time()
            found = gradients(scene, case.parameters, weights)
            seconds = process_time() - begun
            for parameter, gradient in found.items():
                result = compare(scene, case, parameter, weights, gradient, FEWER_BLOBS)
                row = f"{result.error:.2%}", f"{result.cosine:.5f}", f"{seconds:.2f}"
                cells.append([name, parameter, *row])
                print("  ".join(cells[-1]), flush=True)
    head = ["case", "parameter", "error", "cosine", "CPU s"]
    return Table("Gradients among surfaces and several media", head, cells)


def _rows(name: str, case: Case) -> list[list[str]]:
    scene = case.load()
    weights = pixel_weights(scene)
    begun = process_time()
    found = gradients(scene, case.parameters, weights)
    seconds = process_time() - begun
    rows = []
    for parameter, gradient in found.items():
        result = compare(scene, case, parameter, weights, gradient)
        params = mi.traverse(scene)
        value = np.array(params[key_of(params, parameter)], dtype=np.float64)
        steps = directions(case, parameter, value, BLOBS)
        forward = replace(result, adjoint=derivatives(scene, parameter, weights, steps))
        cells = f"{result.error:.2%}", f"{result.cosine:.5f}", f"{forward.error:.2%}"
        rows.append([name, parameter, *cells, f"{seconds:.2f}"])
    return rows


if __name__ == "__main__":
    main()
