"""Convergence of images to exact references as resolution and cache_spp grow and step decreases.

    python -m experiments.validation.limits.run [--only TEXT] [--solver sweep|path] [--budget 280]
        [--force] [--document FILE]

Coarse grids of high contrast, every emitter and phase function, both solvers (see cases.py). For
max_depth 2 the reference is a quadrature without noise; for others Monte Carlo with a standard
error of about 0.05 % (see reference.py). The table has the relative error of the mean of the image,
and the RMSE of its pixels if the reference has no noise, for one setting after the other; the limit
that the last two resolutions imply if the error is of order 2; and the standard error of all this
from caches of other seeds. A case *converges* if the last error, or the limit, is within 0.1 % or
three standard errors.

Rows are saved in output/limits/results.json; no case is started after ``--budget`` seconds.
``--document`` writes the errors of ``sweep`` on the grids of 4^3 voxels into a marked table: the
smaller one of the error at the finest resolution and the limit, with its standard error.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.case_rows import CaseRows, with_budget
from experiments.support.store import Store
from experiments.validation.limits.cases import EMITTERS, Case, cases
from experiments.validation.limits.reference import orders, single
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import IrrcacheError, origin

SOLVERS = ("sweep", "path")
#: Resolutions with samples per voxel; the last two with several seeds. With few samples images of
#: ``path`` are too dark (16 at a resolution of 64: 0.5 to 1 %, some 4 % in a narrow cone), which
#: decreases with the noise of the samples; probably because roots of irradiance are interpolated.
SWEEP = ((16, 512), (32, 512), (64, 512), (128, 512))
PATH = ((16, 64), (32, 64), (64, 64))
#: Settings of slow sweeps: anisotropic phase functions, or many orders of scattering.
LONG_SWEEP = SWEEP[:3]
#: Steps at the second but last resolution, besides 1.
STEPS = (0.5, 0.25)
SEEDS, SPP, PATHS = 2, 256, 1 << 22
BOUND, SIGMAS = 1e-3, 3.0


def measure(case: Case, solver: str, store: Store) -> dict:
    """Return a row: errors by setting, their noise, and the seconds in all."""
    started = time.perf_counter()
    known = store.row(f"reference: {case.name}", partial(reference, case))
    pixels = None if known["pixels"] is None else np.array(known["pixels"])
    settings = SWEEP if solver == "sweep" else PATH
    if solver == "sweep" and (case.max_depth != 2 or case.phase != "isotropic"):
        settings = LONG_SWEEP
    found = []
    for resolution, samples in settings:
        seeds = SEEDS if (resolution, samples) in settings[-2:] else 1
        row = {"resolution": resolution, "cache_spp": samples, "step": 1.0}
        found.append(row | error(case, solver, row, seeds, known["mean"], pixels))
    resolution, samples = settings[-2]
    for step in STEPS:
        row = {"resolution": resolution, "cache_spp": samples, "step": step}
        found.append(row | error(case, solver, row, SEEDS, known["mean"], pixels))
    return {"errors": found, "noise": known["noise"], "seconds": time.perf_counter() - started}


def reference(case: Case) -> dict:
    """Return the mean, its relative standard error, and the pixels if these have no noise."""
    if case.max_depth == 2:
        pixels = single(case, 3, 64)
        return {"mean": pixels.mean(), "noise": 0.0, "pixels": pixels.tolist()}
    mean, noise = orders(case, PATHS)
    return {"mean": mean, "noise": noise / mean, "pixels": None}


def error(case: Case, solver: str, settings: dict, seeds: int, mean: float, pixels) -> dict:
    """Return relative errors of the mean, by cache seeds, and of the pixels of the mean image.

    For a visible point light, pixels next to it are excluded.
    """
    known = None if pixels is None else pixels < (np.inf if case.position is None else 4 * mean)
    images = []
    for seed in range(seeds):
        scene = case.scene(solver=solver, cache_seed=seed, **settings)
        images.append(np.array(mi.render(scene, spp=SPP, seed=seed), dtype=np.float64)[..., 0])
    if known is None:
        return {"means": [float(i.mean() / mean - 1) for i in images], "rmse": None}
    scale = pixels[known].mean()
    apart = np.mean(images, axis=0)[known] - pixels[known]
    means = [float(i[known].mean() / scale - 1) for i in images]
    return {"means": means, "rmse": float(np.sqrt((apart**2).mean()) / scale)}


def summary(row: dict) -> dict:
    """Return the error at the finest resolution, its limit and standard error, and convergence."""
    plain = [e for e in row["errors"] if e["step"] == 1]
    coarse, fine = (float(np.mean(e["means"])) for e in plain[-2:])
    ratio = (plain[-1]["resolution"] / plain[-2]["resolution"]) ** 2
    limit = fine + (fine - coarse) / (ratio - 1)
    spreads = [np.std(e["means"], ddof=1) for e in row["errors"] if len(e["means"]) > 1]
    noise = float(np.hypot(np.sqrt(np.mean(np.square(spreads)) / SEEDS), row["noise"]))
    least = min(abs(fine), abs(limit))
    verdict = "converges" if least < BOUND else "undecided" if least < SIGMAS * noise else "NO"
    return {"fine": fine, "limit": limit, "noise": noise, "verdict": verdict}


def line(name: str, row: dict) -> str:
    """Return a row of the table."""
    if "refused" in row:
        return f"{name:55} refused: {row['refused'][:90]}"
    parts = []
    for e in row["errors"]:
        rmse = "" if e["rmse"] is None else f" ({100 * e['rmse']:.2f})"
        step = "" if e["step"] == 1 else f"/{e['step']:g}"
        parts.append(f"{e['resolution']}{step}: {100 * np.mean(e['means']):+.2f}{rmse}")
    found = summary(row)
    return (
        f"{name:55} {found['verdict']:9} limit {100 * found['limit']:+.3f} +- "
        f"{100 * found['noise']:.3f} | " + ", ".join(parts)
    )


def attempt(case: Case, solver: str, store: Store) -> dict:
    """Return a row, or the reason for which the scene is refused."""
    try:
        return measure(case, solver, store)
    except RuntimeError as problem:
        if not isinstance(origin(problem), IrrcacheError):
            raise
        return {"refused": str(origin(problem))}


#: Columns of the table in a document: phase function and max_depth.
COLUMNS = (
    ("isotropic", 2), ("hg 0.3", 2), ("hg 0.58", 2), ("hg -0.4", 2), ("rayleigh", 2),
    ("isotropic", 3), ("isotropic", -1),
)  # fmt: skip


def matrix(rows: dict[str, dict]) -> Table:
    """Return the errors of ``sweep`` by emitter, phase function and depth, in %."""
    titles = [f"{phase}, {'all' if depth < 0 else depth}" for phase, depth in COLUMNS]
    body = []
    for emitter in EMITTERS:
        cases = [Case(emitter, phase, max_depth=depth) for phase, depth in COLUMNS]
        body.append([emitter, *(cell(rows.get(f"sweep: {case.name}")) for case in cases)])
    return Table("", ["emitter", *titles], body)


def cell(row: dict | None) -> str:
    """Return the error of a case and its standard error, in %."""
    if row is None or "refused" in row:
        return "" if row is None else "refused"
    found = summary(row)
    least = min(found["fine"], found["limit"], key=abs)
    return f"{100 * least:+.2f} ({100 * found['noise']:.2f})"


def run() -> None:
    """Compute missing rows, and print the table."""

    def declare(parser: argparse.ArgumentParser) -> None:
        with_budget(280)(parser)
        parser.add_argument("--solver", choices=SOLVERS, help="one of the two")

    rows = CaseRows(__doc__, "limits", declare, "llvm_ad_mono")
    solvers = (rows.args.solver,) if rows.args.solver else SOLVERS
    titled = ((f"{solver}: {case.name}", (case, solver)) for solver in solvers for case in cases())
    for _ in rows.rows(
        titled,
        lambda case: attempt(*case, rows.store),
        lambda title, _, row: line(title, row),
    ):
        pass
    rows.write({"limits": matrix(rows.store.rows)})


if __name__ == "__main__":
    run()
