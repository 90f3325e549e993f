"""Coverage of the error bars ``noise`` and ``bias`` with both solvers.

    python -m experiments.validation.error_bars.coverage [--only TEXT] [--budget 400] [--force]
        [-o output] [--document FILE]

Images of 24 x 24 pixels with caches of 24 voxels and eight seeds, the same camera samples, and one
with a fine cache. The table has, for pixels that see the medium and all seeds, in %: the RMS of the
actual noise (differences from the mean of the seeds) and of the predicted one, and the shares of
pixels within 1, 2, 3 predicted standard errors (68, 95 and 99.7 if predictions are true); and the
same for the whole error, which is compared with the root of the squares of ``noise`` and ``bias``.

Rows are saved in output/coverage/results.json; no case is started after ``--budget`` seconds.
"""

from __future__ import annotations

import gc

import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.analysis import rms
from experiments.support.case_rows import CaseRows, with_budget
from experiments.validation.defaults.cases import Case, cumulus, haze, smoke
from mitsuba_irrcache.compare.tables import Table

SEEDS, RESOLUTION, FINE = 8, 24, 72
SAMPLES = {"sweep": 128, "path": 64}
SPP = 36
CASES = [
    Case(haze, 3.0, max_depth=2), Case(cumulus, 6.0, "sky"), Case(smoke, 3.0, "sun"),
    Case(smoke, 3.0, "side", max_depth=2),
]  # fmt: skip
HEAD = [
    "scene", "solver", "noise", "predicted", "within 1, 2, 3", "error", "predicted ",
    "within 1, 2, 3 ",
]  # fmt: skip


def images(case: Case, solver: str, seeds: range, resolution: int, samples: int) -> list[dict]:
    """Return luminance, noise and bias of each seed's image."""
    found = []
    for seed in seeds:
        gc.collect()
        scene = case.scene(
            solver=solver, resolution=resolution, cache_spp=samples, cache_seed=seed,
            aovs="noise,bias,transmittance",
        )  # fmt: skip
        film = mi.traverse(scene.sensors()[0])
        film["film.size"], film["film.crop_size"] = (24, 24), (24, 24)
        film.update()
        values = np.array(mi.render(scene, spp=SPP, seed=7), dtype=np.float64)
        names = scene.integrator().aov_names()
        layers = dict(zip(names, np.moveaxis(values[..., -len(names) :], -1, 0), strict=True))
        found.append({"image": values[..., 0]} | layers)
    return found


def measure(case: Case, solver: str) -> dict:
    """Return a row."""
    found = images(case, solver, range(1, 1 + SEEDS), RESOLUTION, SAMPLES[solver])
    # The reference is by `sweep`, whose noise is smaller.
    truth = np.mean([f["image"] for f in images(case, "sweep", range(90, 92), FINE, 256)], axis=0)
    x, noise, bias = (np.array([f[n] for f in found]) for n in ("image", "noise.Y", "bias.Y"))
    seen = np.broadcast_to(found[0]["transmittance.G"] < 0.999, x.shape)
    # The mean of all seeds contains a part of each one's noise.
    deviation = (x - x.mean(axis=0)) * np.sqrt(SEEDS / (SEEDS - 1))
    error, predicted, mean = x - truth, np.hypot(noise, bias), truth.mean()

    def inside(values: np.ndarray, bars: np.ndarray) -> list[float]:
        return [float(np.mean(np.abs(values) <= k * bars, where=seen)) for k in (1, 2, 3)]

    return {
        "noise": rms(deviation[seen]) / mean, "noise_predicted": rms(noise[seen]) / mean,
        "noise_inside": inside(deviation, noise),
        "error": rms(error[seen]) / mean, "error_predicted": rms(predicted[seen]) / mean,
        "error_inside": inside(error, predicted),
    }  # fmt: skip


def cells(case: Case, solver: str, row: dict) -> list[str]:
    """Return the cells of a row of the table."""
    found = [case.name, solver]
    for part in ("noise", "error"):
        found += [f"{100 * row[part]:.2f}", f"{100 * row[f'{part}_predicted']:.2f}"]
        found.append(", ".join(f"{100 * share:.0f}" for share in row[f"{part}_inside"]))
    return found


def run() -> None:
    """Compute missing rows, and print the table."""
    rows = CaseRows(__doc__, "coverage", with_budget(400), "llvm_ad_mono")
    titled = ((f"{case.name}, {solver}", (case, solver)) for case in CASES for solver in SAMPLES)
    table = [
        cells(*case, row)
        for case, row in rows.rows(
            titled,
            lambda case: measure(*case),
            lambda title, case, row: " | ".join(cells(*case, row)),
        )
    ]
    rows.write({"coverage": Table("", HEAD, table)})


if __name__ == "__main__":
    run()
