"""True and estimated errors, and times, of images with a tolerance of 40 unseen scenes.

    python -m experiments.validation.tolerance.unseen [--only TEXT] [--tolerances E E ...]
        [--seconds 4] [--timeout 60] [--budget 1500] [--again] [--force] [-o output]
        [--document FILE]

Each scene (scenes.py) is rendered with ``tolerance`` alone, at default settings, and with the
settings of a small grid: resolutions of 16 to 64 voxels, 64 and 256 directions or samples, 16 and
64 samples per pixel. The times are processor times of a cold cache and its image, without the
compilation of kernels. The fastest of these images within the tolerance is the best setting.

Truth is one of two references, whichever is known better: halves of volpath (of volpathmis if that
is cheaper) of ``--seconds`` each, whose noise is subtracted; and an image for a cache of up to 96
voxels along a side and 256 directions, unless it differs significantly from the halves.

Rows are saved in output/unseen/results.json, references in .npz files beside it; no scene is
started after ``--budget`` seconds. ``--again`` renders images with a tolerance again.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable
from functools import partial

import drjit as dr
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.case_rows import CaseRows, with_budget, with_reference
from experiments.validation.random_scenes.references import picture, pilot
from experiments.validation.tolerance.scenes import load, unseen
from mitsuba_irrcache.compare.metrics import net_mse
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.errors import IrrcacheError, origin, original_message

TOLERANCES = (0.02, 0.005, 0.001)
#: Resolutions, directions and samples per pixel of the grid of settings.
RESOLUTIONS, DIRECTIONS, SAMPLES = (16, 32, 64), (64, 256), (16, 64)
#: Samples per pixel at default settings.
DEFAULT_SPP = 64
#: Largest resolution of the fine cache, the same for ``path`` and anisotropic scattering,
#: directions, samples per pixel, and paths of ``path``.
FINEST, FINEST_SLOW, FINE_DIRECTIONS, FINE_SPP, FINE_PATHS = 96, 64, 256, 256, 1024
#: Most samples per pixel of a half at once.
LARGEST_SPP = 1024
SIGMAS = 3.0
#: Share of the time, spent on compiling kernels, above which an image is rendered again.
COMPILED = 0.1
HEAD = [
    "scene", "tolerance [%]", "true [%]", "estimate [%]", "largest part", "chosen", "time [s]",
    "of the best", "of default (its error [%])",
]  # fmt: skip


class Experiment:
    """Scenes, their references, and measurements of images."""

    def __init__(self, rows: CaseRows) -> None:
        self.rows, self.args, self.folder = rows, rows.args, rows.folder
        self._renewed: set[str] = set()

    def measure(self, title: str, case) -> dict | None:
        """Return the results for a scene; None if irrcache refuses it."""
        stored = self.rows.store.row
        reference = stored(f"{title} | reference", partial(self._reference, title, case))
        if "refused" in reference:
            return reference
        settings = stored(f"{title} | settings", partial(self._settings, title, case))
        found = {"reference": reference, "settings": settings["tried"]}
        for tolerance in self.args.tolerances:
            key = f"{title} | {tolerance:g}"
            if self.args.again and key not in self._renewed:
                self.rows.store.rows.pop(key, None)
                self._renewed.add(key)
            found[f"{tolerance:g}"] = stored(key, partial(self._certified, title, case, tolerance))
        return found

    # References

    def _reference(self, title: str, case) -> dict:
        """Render the halves and the fine image; return how well they are known."""
        load_as = partial(load, case, folder=self.folder)
        try:
            picture(load_as("irrcache"), 1, 0)
        except Exception as error:
            if not isinstance(origin(error), IrrcacheError):
                raise
            return {"refused": original_message(error)}
        a, b, judge = self._halves(case)
        fine, seconds = self._fine(case)
        np.savez_compressed(self._file(title), a=a, b=b, fine=fine)
        mean = 0.5 * (a + b).mean()
        square, error = net_mse(fine, a, b)
        noise = net_mse(0.5 * (a + b), a, b)[1]
        return {
            "judge": judge,
            "noise": float(np.sqrt(np.square(a - b).mean()) / 2 / mean),
            "known": float(np.sqrt(max(noise, 0)) / mean),
            "fine": float(np.sqrt(max(square, 0)) / mean),
            "fine_at_least": float(np.sqrt(max(square - SIGMAS * error, 0)) / mean),
            "fine_seconds": seconds,
        }

    def _halves(self, case) -> tuple[np.ndarray, np.ndarray, str]:
        names = ("volpath", "volpathmis") if case.is_chromatic else ("volpath",)
        make = partial(load, case, folder=self.folder, rr_depth=50)
        pilots = {name: pilot(make(name)) for name in names}
        judge = min(pilots, key=lambda name: pilots[name][0] * pilots[name][1])
        samples = int(np.clip(self.args.seconds / 2 / pilots[judge][1], 16, 1 << 17))
        count = -(-samples // LARGEST_SPP)
        scene, spp = make(judge), -(-samples // count)
        halves = [
            np.mean([picture(scene, spp, 1000 + 2 * i + half) for i in range(count)], axis=0)
            for half in range(2)
        ]
        return *halves, judge

    def _fine(self, case) -> tuple[np.ndarray, float]:
        """Render with a fine cache."""
        scene = load(case, "irrcache", self.folder)
        scene.integrator().prepare(scene)
        caches = [c for c in scene.integrator().caches.values() if c is not None]
        size = max([max(c.grid.shape) for c in caches] or [1])
        is_path = scene.integrator()._builder.solver == "path"
        is_slow = is_path or any(cache.directional is not None for cache in caches)
        fine = {
            "resolution": min(2 * size, max(FINEST_SLOW if is_slow else FINEST, size)),
            "cache_spp": FINE_PATHS if is_path else FINE_DIRECTIONS,
            "cache_seed": 99,
        }
        if not caches:
            fine = {}
        return self._timed(case, FINE_SPP, 12345, **fine)[:2]

    def _file(self, title: str):
        return self.rows.file(title).with_suffix(".npz")

    # Images

    def _timed(self, case, spp: int, seed: int, **settings) -> tuple:
        """Render with a cold cache; return image, seconds, and integrator."""

        def prepared() -> Callable:
            scene = load(case, "irrcache", self.folder, **settings)
            return lambda: (picture(scene, spp, seed), scene.integrator())

        (image, integrator), seconds = timed(prepared)
        return image, seconds, integrator

    def _errors(self, title: str, image: np.ndarray) -> dict:
        """Return the RMSE against both references, and that against the better one."""
        with np.load(self._file(title)) as stored:
            a, b, fine = (stored[name] for name in ("a", "b", "fine"))
        mean = 0.5 * (a + b).mean()
        square, error = net_mse(image, a, b)
        found = {
            "halves": float(np.copysign(np.sqrt(abs(square)), square) / mean),
            "fine": float(np.sqrt(np.square(image - fine).mean()) / fine.mean()),
        }
        unsure = np.sqrt(abs(square) + SIGMAS * error) - np.sqrt(abs(square))
        reference = self.rows.store.rows[f"{title} | reference"]
        better = "halves" if unsure / mean < reference["fine_at_least"] else "fine"
        return found | {"truth": better, "true": max(found[better], 0.0)}

    def _settings(self, title: str, case) -> dict:
        """Render at default settings, and with the grid of settings."""
        image, seconds, integrator = self._timed(case, DEFAULT_SPP, 1)
        tried = [{"name": "default", "seconds": seconds} | self._errors(title, image)]
        if not any(cache is not None for cache in integrator.caches.values()):
            return {"tried": tried}
        for resolution in RESOLUTIONS:
            for directions in DIRECTIONS:
                chosen = {"resolution": resolution, "cache_spp": directions}

                def prepared(chosen=chosen) -> Callable:
                    scene = load(case, "irrcache", self.folder, **chosen)
                    return lambda: scene.integrator().prepare(scene) or scene

                scene, cold = timed(prepared)
                for spp in SAMPLES:
                    image, warm = timed(
                        lambda spp=spp, scene=scene: partial(picture, scene, spp, 1)
                    )
                    row = {"name": f"{resolution}, {directions}, {spp}", "seconds": cold + warm}
                    tried.append(row | self._errors(title, image))
        return {"tried": tried}

    def _certified(self, title: str, case, tolerance: float) -> dict:
        """Render with a tolerance."""
        limit = {"timeout": self.args.timeout}
        image, seconds, integrator = self._timed(case, 0, 1, tolerance=tolerance, **limit)
        certificate = integrator.certificate
        row = self._errors(title, image) | {"seconds": seconds}
        if certificate is None:
            return row | {"stopped": True}
        return row | {
            "estimate": certificate.error, "parts": certificate.parts,
            "settings": certificate.settings, "is_met": certificate.is_met,
            "notes": certificate.open_points,
        }  # fmt: skip


def timed(prepared: Callable) -> tuple:
    """Call what ``prepared`` returns; return its result, and its processor time.

    It is prepared and called again if most of the time was spent on compiling kernels.
    """
    for _ in range(2):
        gc.collect()
        work = prepared()
        dr.sync_thread()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            started = time.process_time()
            result = work()
            dr.sync_thread()
            seconds = time.process_time() - started
            compiled = sum(k.get("backend_time", 0) for k in dr.kernel_history()) / 1e3
        if compiled < COMPILED * seconds:
            break
    return result, seconds


def best(settings: list[dict], tolerance: float) -> dict | None:
    """Return the fastest of the ``settings`` within the tolerance; None without any."""
    within = [row for row in settings if row["true"] <= tolerance]
    return min(within, key=lambda row: row["seconds"], default=None)


def cells(title: str, tolerance: str, found: dict) -> list[str]:
    """Return the cells of a row of the table."""
    row, head = found[tolerance], [title, f"{100 * float(tolerance):g}"]
    fastest, default = best(found["settings"], float(tolerance)), found["settings"][0]
    ratio = "none" if fastest is None else f"{row['seconds'] / fastest['seconds']:.1f} x"
    of_default = f"{row['seconds'] / default['seconds']:.1f} x ({100 * default['true']:.2f})"
    times = [f"{row['seconds']:.1f}", ratio, of_default]
    true = f"{100 * row['true']:.2f}"
    if "stopped" in row:
        return [*head, true, "stopped", "", "", *times]
    mark = "" if row["is_met"] else " (not met)"
    part = max(row["parts"], key=row["parts"].get) if row["parts"] else ""
    names = ("resolution", "cache_spp", "step", "spp")
    chosen = ", ".join(f"{row['settings'][n]:g}" for n in names if n in row["settings"])
    return [*head, true, f"{100 * row['estimate']:.2f}{mark}", part, chosen, *times]


def summary(results: list[tuple[str, dict]], tolerance: str) -> list[str]:
    """Return a row of counts for a tolerance."""
    rows = [(found[tolerance], found["settings"]) for _, found in results if tolerance in found]
    limit = float(tolerance)
    known = [r for r, _ in rows if np.isfinite(r.get("estimate", np.nan))]
    met = [r for r in known if r["is_met"]]
    close = sum(1 / 1.5 <= r["estimate"] / max(r["true"], 1e-9) <= 1.5 for r in known)
    safe = sum(r["true"] <= 1.5 * r["estimate"] for r in known)
    fastest = [(r["seconds"], best(s, limit)) for r, s in rows if r.get("is_met")]
    ratios = [seconds / b["seconds"] for seconds, b in fastest if b is not None]
    defaults = [(r["seconds"], s[0]["seconds"]) for r, s in rows]
    return [
        f"{100 * limit:g}", str(len(rows)), str(len(met)),
        f"{sum(r['true'] <= limit for r in met)}",
        f"{max((r['true'] / limit for r in met), default=0):.2f}",
        f"{close} of {len(known)}", f"{safe} of {len(known)}",
        f"{np.median(ratios):.1f}, {sum(r <= 2 for r in ratios)} of {len(ratios)} within 2"
        if ratios else "",
        f"{sum(a for a, _ in defaults):.0f} ({sum(b for _, b in defaults):.0f})",
        f"{sum(s[0]['true'] <= limit for _, s in rows)}",
    ]  # fmt: skip


SUMMARY_HEAD = [
    "tolerance [%]", "scenes", "reported as met", "of these within", "largest true / tolerance",
    "estimate within 1.5 x", "true at most 1.5 x estimate", "time over that of the best (median)",
    "seconds (default settings)", "default settings within",
]  # fmt: skip


def run() -> None:
    """Compute missing rows, and print the tables."""

    def declare(parser: argparse.ArgumentParser) -> None:
        with_budget(1500)(parser)
        with_reference(4)(parser)
        parser.add_argument("--tolerances", type=float, nargs="*", default=TOLERANCES)
        parser.add_argument("--timeout", type=float, default=60, help="of an image, wall seconds")
        parser.add_argument("--again", action="store_true", help="repeat images with a tolerance")

    rows = CaseRows(__doc__, "unseen", declare)
    experiment, names = Experiment(rows), [f"{t:g}" for t in rows.args.tolerances]
    started, results = time.perf_counter(), []
    for title, case in unseen():
        if rows.args.only not in title:
            continue
        keys = [f"{title} | {key}" for key in ("reference", "settings", *names)]
        refused = "refused" in rows.store.rows.get(keys[0], {})
        complete = refused or all(key in rows.store.rows for key in keys)
        if not complete and time.perf_counter() - started > rows.args.budget:
            print(f"{title:55} not computed yet; run again", flush=True)
            continue
        found = experiment.measure(title, case)
        if "refused" in found:
            print(f"{title} | refused: {found['refused'][:150]}", flush=True)
            continue
        results.append((title, found))
        for name in names:
            print(" | ".join(cells(title, name, found)), flush=True)
    short = Table("", SUMMARY_HEAD, [summary(results, name) for name in names])
    print(short.as_text())
    table = [cells(title, name, found) for title, found in results for name in names]
    rows.write({"unseen-summary": short, "unseen": Table("", HEAD, table)})


if __name__ == "__main__":
    run()
