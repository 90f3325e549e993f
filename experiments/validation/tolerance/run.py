"""True against estimated errors of images with a tolerance.

    python -m experiments.validation.tolerance.run [--only TEXT] [--tolerances E E ...]
        [--budget 280] [--force] [-o output] [--document FILE]

Single scattering in coarse grids of high contrast, every emitter and phase function of
experiments/validation/limits, whose reference is a quadrature without noise. Every image has 16 x
16 pixels and is rendered with ``tolerance`` alone. The table has the true RMSE and the estimate, in
% of the mean; the largest part of the estimate; resolution, cache_spp, step and spp that were
chosen; and the time of the cold image, also over that of default settings, with compiled kernels.

Rows are saved in output/tolerance/results.json; no case is started after ``--budget`` seconds.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.case_rows import CaseRows, with_budget
from experiments.support.store import Store
from experiments.validation.limits.cases import Case, cases
from experiments.validation.limits.reference import single
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import IrrcacheError, origin

TOLERANCES = (0.02, 0.005)
HEAD = ["scene", "tolerance [%]", "true [%]", "estimate [%]", "largest part", "chosen", "time"]


def exact(case: Case) -> list:
    """Return the pixels of the reference."""
    return single(case, 3, 64).tolist()


def measure(case: Case, tolerance: float, store: Store) -> dict:
    """Return a row."""
    pixels = np.array(store.row(f"reference: {case.name}", partial(exact, case)))
    known = pixels < (np.inf if case.position is None else 4 * pixels.mean())
    try:
        # The first image compiles kernels; the second has a cold cache.
        for _ in range(2):
            scene = case.scene(tolerance=tolerance)
            image, seconds = timed(scene)
    except RuntimeError as problem:
        if not isinstance(origin(problem), IrrcacheError):
            raise
        return {"refused": str(origin(problem))}
    certificate = scene.integrator().certificate
    for _ in range(2):
        _, default = timed(case.scene(), certificate.settings["spp"])
    scale = pixels[known].mean()
    return {
        "true": float(np.sqrt(np.square(image - pixels)[known].mean()) / scale),
        "estimate": certificate.error,
        "parts": certificate.parts,
        "settings": certificate.settings,
        "is_met": certificate.is_met,
        "notes": certificate.open_points,
        "seconds": seconds,
        "default_seconds": default,
    }


def timed(scene: mi.Scene, spp: int = 0) -> tuple[np.ndarray, float]:
    """Render; return the image and the seconds that it took."""
    started = time.perf_counter()
    image = np.array(mi.render(scene, spp=spp), dtype=np.float64)[..., 0]
    dr.sync_thread()
    return image, time.perf_counter() - started


def cells(case: Case, tolerance: float, row: dict) -> list[str]:
    """Return the cells of a row of the table."""
    name = case.name.removesuffix(", max_depth 2")
    if "refused" in row:
        return [name, f"{100 * tolerance:g}", "refused", "", "", "", ""]
    part = max(row["parts"], key=row["parts"].get) if row["parts"] else ""
    settings = row["settings"]
    chosen = ", ".join(f"{settings[key]:g}" for key in ("resolution", "cache_spp", "step", "spp"))
    mark = "" if row["is_met"] else " (not met)"
    return [
        name, f"{100 * tolerance:g}", f"{100 * row['true']:.2f}",
        f"{100 * row['estimate']:.2f}{mark}", part, chosen,
        f"{row['seconds']:.1f} s ({row['seconds'] / row['default_seconds']:.1f} x)",
    ]  # fmt: skip


def summary(rows: list[dict], tolerances: list[float]) -> str:
    """Return how often tolerance and estimate hold."""
    pairs = [(r, t) for r, t in zip(rows, tolerances, strict=True) if "refused" not in r]
    met = [(r, t) for r, t in pairs if r["is_met"]]
    within = sum(r["true"] <= t for r, t in met)
    far = max((r["true"] / t for r, t in met), default=0.0)
    close = sum(1 / 1.5 <= r["estimate"] / r["true"] <= 1.5 for r, _ in pairs)
    return (
        f"{len(pairs)} images; tolerance reported as met: {len(met)}, true error within it: "
        f"{within}, at most {far:.2f} times as large; estimate within a factor of 1.5: {close}"
    )


def run() -> None:
    """Compute missing rows, and print the table."""

    def declare(parser: argparse.ArgumentParser) -> None:
        with_budget(280)(parser)
        parser.add_argument("--tolerances", type=float, nargs="+", default=TOLERANCES)

    rows = CaseRows(__doc__, "tolerance", declare, "llvm_ad_mono")
    titled = (
        (f"{case.name}, {tolerance:g}", (case, tolerance))
        for case in cases()
        if case.max_depth == 2
        for tolerance in rows.args.tolerances
    )
    found = list(
        rows.rows(
            titled,
            lambda case: measure(*case, rows.store),
            lambda title, case, row: " | ".join(cells(*case, row)),
        )
    )
    rendered = [(row, tolerance) for (_, tolerance), row in found if "refused" not in row]
    print(summary([row for row, _ in rendered], [tolerance for _, tolerance in rendered]))
    rows.write({"tolerance": Table("", HEAD, [cells(*case, row) for case, row in found])})


if __name__ == "__main__":
    run()
