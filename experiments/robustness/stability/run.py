"""Every hazard with every solver and quadrature, grey and in colour: failures and their size.

    python -m experiments.robustness.stability.run [--only HAZARD] [-o output]      (make stress)

Writes output/stability/results.json and prints a table: for each hazard the number of cases and
failures, the property with the smallest margin (or largest violation), and the first failure. Exits
with 1 if anything failed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
from tqdm import tqdm

from experiments.robustness.stability.case import Case, clear
from experiments.robustness.stability.hazards import cases
from mitsuba_irrcache.compare.results import write_json
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import original_message
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.render.quadrature import QUADRATURES

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono")


def main() -> int:
    """Run all cases, write and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", default=[], help="a hazard; repeatable")
    parser.add_argument("-o", "--output", type=Path, default=Path("output"))
    args = parser.parse_args()
    require_llvm()
    started, rows = time.perf_counter(), []
    for variant in VARIANTS:
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
        chosen = [c for c in cases() if not args.only or c.hazard in args.only]
        for case in tqdm(chosen, variant, disable=None):
            rows += run_case(case, variant)
            clear()
    folder = args.output / "stability"
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "results.json", rows)
    print(tabulated(rows).as_text())
    failed = [row for row in rows if not row["held"]]
    print(f"\n{summary(rows)}; {time.perf_counter() - started:.0f} s")
    for row in failed[:40]:
        print("  " + described(row))
    return 1 if failed else 0


def run_case(case: Case, variant: str, quadratures: Sequence[str] = QUADRATURES) -> list[dict]:
    """Return a row for each property with each solver and each of ``quadratures`` of the case."""
    rows = []
    for solver in case.solvers:
        for quadrature in (q for q in case.quadratures if q in quadratures):
            try:
                verdicts = case.judge({"solver": solver, "quadrature": quadrature})
            except Exception as error:  # any exception is a failure of this case
                verdicts = [(f"raised {type(error).__name__}: {original_message(error)}", 1.0, 0.0)]
            about = {"hazard": case.hazard, "case": case.name, "variant": variant}
            about |= {"solver": solver, "quadrature": quadrature}
            for name, error, admitted in verdicts:
                held = bool(error <= admitted)
                rows.append(
                    about
                    | {
                        "property": name,
                        "error": float(error),
                        "admitted": float(admitted),
                        "held": held,
                    }
                )
    return rows


def summary(rows: list[dict]) -> str:
    """Summarise the rows in one line."""
    runs = {
        tuple(r[k] for k in ("hazard", "case", "variant", "solver", "quadrature")) for r in rows
    }
    failed = sum(not row["held"] for row in rows)
    return f"{len(runs)} runs, {len(rows)} properties checked, {failed} failures"


def described(row: dict) -> str:
    """Describe a failure with everything needed to reproduce it."""
    return (
        f"{row['hazard']}: {row['case']} [{row['solver']}, {row['quadrature']}, "
        f"{row['variant']}]: {row['property']}: {row['error']:.3g}, admitted {row['admitted']:.3g}"
    )


def tabulated(rows: list[dict]) -> Table:
    """Tabulate a row for each hazard."""
    cells = []
    for hazard in dict.fromkeys(row["hazard"] for row in rows):
        own = [row for row in rows if row["hazard"] == hazard]
        failed = [row for row in own if not row["held"]]
        bounded = [row for row in own if row["admitted"] > 0]
        worst = max(bounded, key=lambda r: r["error"] / r["admitted"], default=None)
        near = "" if worst is None else f"{worst['error']:.1e} of {worst['admitted']:.1e}"
        what = "" if worst is None else f"{worst['property']} ({worst['case']})"
        names = {row["case"] for row in own}
        first = described(failed[0]) if failed else "none"
        cells.append([hazard, str(len(names)), str(len(own)), str(len(failed)), near, what, first])
    head = ["hazard", "cases", "checked", "failed", "worst error", "of", "first failure"]
    return Table("Stability", head, cells)


if __name__ == "__main__":
    sys.exit(main())
