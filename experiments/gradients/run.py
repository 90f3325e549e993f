"""Gradients against finite differences of the image.

``python -m experiments.gradients.run`` prints for each case and parameter the relative error and
the cosine of directional derivatives along smooth perturbations. ``--case NAME`` runs one case.
"""

from __future__ import annotations

import argparse
from time import perf_counter, process_time

import mitsuba as mi


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--case", default="", help="part of the names of the cases to run")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    mi.set_log_level(mi.LogLevel.Error)
    from experiments.gradients.cases import CASES
    from experiments.gradients.differences import compare, gradients, pixel_weights

    print("| case | parameter | error | cosine | seconds (CPU seconds) of the gradient |")
    print("|---|---|---|---|---|")
    for name, case in CASES.items():
        if options.case not in name:
            continue
        scene = case.load()
        weights = pixel_weights(scene)
        wall, cpu = perf_counter(), process_time()
        found = gradients(scene, case.parameters, weights)
        wall, cpu = perf_counter() - wall, process_time() - cpu
        for parameter, gradient in found.items():
            result = compare(scene, case, parameter, weights, gradient)
            print(
                f"| {name} | {parameter} | {result.error:.2%} | {result.cosine:.5f} "
                f"| {wall:.2f} ({cpu:.2f}) |",
                flush=True,
            )


if __name__ == "__main__":
    main()
