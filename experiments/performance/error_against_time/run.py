"""Error against time: ``irrcache`` and Mitsuba's own integrators.

    python -m experiments.performance.error_against_time.run
        [--scenes procedural head cloud chest] [--depths 2 -1]
        [--seconds 90] [--force]

White sky of radiance 1; RMSE is absolute and net of the noise of the reference, which gets
``--seconds``. A stock integrator's time to an error is its variance over the square of the error,
times the duration of a sample. ``irrcache`` is run with many settings; reported is the least time
of any that reaches the error, one standard error of its measurement added: with a cold cache
(kernels warm, loading excluded), with a moved camera, and in a new process, all included, that
finds its kernels on disk. So these settings are the best of a grid, selected with knowledge of the
reference; the row "defaults" of the table is the result without any settings, with the stock
integrator's time to the same error. Errors are in units of the sky's radiance and of the mean
radiance of the volume alone: of the image without the unscattered radiance.

Finished results are saved: the script can be stopped and run again. ``--force`` discards
``irrcache``'s rows of these scenes and depths (output/performance/irrcache.json); those of the
stock integrators remain until stock.json is deleted. Prints a table and writes
output/performance/results.json, which plot.py draws.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.documents import replace_tables
from experiments.support.methods import specify
from experiments.support.options import add_document
from experiments.support.scenes import available, scene_file
from experiments.support.store import Store
from mitsuba_irrcache.compare import metrics
from mitsuba_irrcache.compare.reference import Reference, reference
from mitsuba_irrcache.compare.results import write_json
from mitsuba_irrcache.compare.tables import Table, percent, seconds
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.scene_files import load_scene, parse_integrator
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.solvers.discrete_ordinates.solver import SMALLEST_BATCH

#: Variant and further parameters of each scene: clouds are grey.
SCENES = {
    "procedural": ("llvm_ad_mono", {}),
    "head": ("llvm_ad_rgb", {}),
    "cloud": ("llvm_ad_mono", {}),
    "chest": ("llvm_ad_rgb", {"scale": "0.5"}),
}
TARGETS = (1e-2, 4e-3)
STOCK = ("volpath", "volpathmis", "prbvolpath")
#: Depth at which Russian roulette starts. It does not affect single scattering.
RR_DEPTHS = (5, 20, 1000)
#: Images for a variance, and most samples per pixel of one: bounds memory.
STOCK_IMAGES, STOCK_SPP = 4, 128

RESOLUTIONS = (32, 48, 64, 96, 0)
BATCHES = (1, 2, 4)
#: Resolution and samples per voxel of ``solver=path``.
PATH = ((32, 8), (64, 8), (64, 16))
SPP, STEPS = (1, 2, 4, 16), (1.0, 2.0, 4.0)
#: Number of the best caches that are rendered with further image settings.
FIRST_SPP, FIRST_STEP = 4, 1.0
COLD_RUNS, MOVED_RUNS, PROCESS_RUNS = 3, 5, 5
#: Samples per pixel of the scenes.
DEFAULT_SPP = 64
UNSCATTERED_SPP = 64
#: Settings slower than this many seconds are not repeated, and costlier ones are not tried.
PATIENCE = 10.0
#: A stock integrator in a process of its own: variant, scene, image, integrator, parameters.
STOCK_PROCESS = """
import json, sys
import mitsuba as mi
variant, scene, image, integrator, parameters = sys.argv[1:]
mi.set_variant(variant)
scene = mi.load_file(scene, integrator=integrator, **json.loads(parameters))
mi.util.write_bitmap(image, mi.render(scene, spp=1), write_async=False)
"""


@dataclass(frozen=True)
class Case:
    """A scene at one depth."""

    name: str
    depth: int
    pixels: int
    variant: str
    scene: Path
    parameters: dict[str, str]

    @classmethod
    def of(cls, name: str, depth: int, pixels: int, output: Path) -> Case:
        """Return the case of a scene, or of its substitute if its data are missing."""
        variant, further = SCENES[name]
        sides = {"max_depth": str(depth), "width": str(pixels), "height": str(pixels)}
        found = available(name)
        return cls(found, depth, pixels, variant, scene_file(found, output), sides | further)

    @property
    def key(self) -> str:
        return f"{self.name} {self.depth} {self.pixels}"

    def load(self, integrator: str) -> mi.Scene:
        """Load the scene anew, with a cold cache."""
        gc.collect()
        scene = load_scene(self.scene, self.parameters, integrator)
        dr.sync_thread()
        return scene


def main() -> None:
    """Measure missing results, case by case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--depths", nargs="+", type=int, default=[2, -1])
    parser.add_argument("--seconds", type=float, default=90, help="of a reference")
    parser.add_argument("--stock-seconds", type=float, default=5, help="of a stock image")
    parser.add_argument("--pixels", type=int, default=256, help="per side")
    parser.add_argument(
        "--resolutions", nargs="*", type=int, default=RESOLUTIONS, help="none: defaults alone"
    )
    parser.add_argument("--batches", nargs="+", type=int, default=BATCHES)
    parser.add_argument("--spp", nargs="+", type=int, default=SPP, help="of the best caches")
    parser.add_argument("--steps", nargs="+", type=float, default=STEPS, help="likewise")
    parser.add_argument("-o", "--output", type=Path, default=Path("output"))
    parser.add_argument("--force", action="store_true", help="measure irrcache again")
    add_document(parser)
    args = parser.parse_args()

    require_llvm()
    folder = args.output / "performance"
    folder.mkdir(parents=True, exist_ok=True)
    stock = Store(folder / "stock.json")
    points = Store(folder / "irrcache.json")
    results = Store(folder / "results.json")
    cases = []
    for name in args.scenes:
        for depth in args.depths:
            mi.set_variant(SCENES[name][0])
            mi.set_log_level(mi.LogLevel.Error)
            case = Case.of(name, depth, args.pixels, args.output)
            if args.force:
                kept = {k: v for k, v in points.rows.items() if not k.startswith(f"{case.key} ")}
                points.rows = kept
            results.rows[case.key] = measure(case, args, stock, points)
            write_json(results.path, results.rows)
            cases.append(results.rows[case.key])
            print(table(cases[-1:]).as_text(), flush=True)
    whole = table(cases)
    print(f"\n{whole.as_text()}\n  {whole.note}\n\n{defaults(cases).as_text()}")
    if args.document:
        tables = {
            "times-of-defaults": table(cases, "defaults"),
            "default-settings": defaults(cases),
        }
        if args.resolutions:
            tables["error-against-time"] = table(cases, "best")
        replace_tables(args.document, tables)


def measure(case: Case, args: argparse.Namespace, stock: Store, points: Store) -> dict:
    """Return all measurements of a case."""
    rivals = [
        stock.row(f"{case.key} {name}", partial(stock_row, case, name, args.stock_seconds))
        for name in stock_integrators(case.depth)
    ]
    judge = reference_integrator(case.depth, rivals)
    say(case, f"reference by {judge}, {args.seconds:g} s")
    truth = reference(
        case.scene, case.parameters, judge, args.output / "references", seconds=args.seconds
    )
    mean, noise = float(truth.mean.mean()), metrics.noise(truth.a, truth.b)
    # Square root of the standard error of the mean square error of a perfect image.
    least = float(noise / case.pixels**0.5)
    say(case, f"errors from {least:.1e} on can be told from none; more --seconds, smaller ones")

    def point(spp: int, **properties: object) -> dict:
        setting = specify("irrcache", **properties)
        key = f"{case.key} {args.seconds:g} {setting} spp {spp}"
        return points.row(key, partial(point_row, case, truth, setting, spp))

    found = explore(case.depth, args, point) if args.resolutions else []
    default = point(DEFAULT_SPP)
    try:
        twice = point(DEFAULT_SPP, resolution=2 * default["longest"])
    except IrrcacheError as error:
        say(case, str(error))
        twice = None
    about = asdict(case) | {"scene": str(case.scene), "mean": mean}
    about |= {
        "reference": judge,
        "reference_seconds": truth.seconds,
        "reference_noise": noise / 2**0.5,
    }
    about["resolved"] = least
    key = f"{case.key} unscattered"
    unscattered = stock.row(key, partial(unscattered_row, case, judge))["mean"]
    about["volume"] = mean - unscattered
    reached = [reach(case, target, rivals, [*found, default], stock, points) for target in TARGETS]
    by_default = reach(case, default["at_most"], rivals, [default], stock, points)
    reached.append(by_default | {"defaults": True})
    known = {"stock": rivals, "points": found, "default": default, "twice": twice}
    return about | known | {"targets": reached}


def stock_integrators(depth: int) -> list[str]:
    """Return the integrators that are compared."""
    rr_depths = RR_DEPTHS[-1:] if depth == 2 else RR_DEPTHS
    return [specify(name, rr_depth=rr_depth) for name in STOCK for rr_depth in rr_depths]


def reference_integrator(depth: int, rivals: list[dict]) -> str:
    """Return the integrator for the reference, the cheapest if there is a choice.

    In dense media of albedo 1, Russian roulette would cause prohibitive noise.
    """
    if depth == 2:
        return specify("volpath", rr_depth=1000)
    return min(rivals, key=cost)["integrator"]


def cost(rival: dict) -> float:
    """Return the seconds to an RMSE of 1; divide by the square of another RMSE."""
    return rival["variance"] * rival["seconds_per_sample"]


def stock_row(case: Case, integrator: str, wanted: float) -> dict:
    """Return variance and duration of a sample per pixel, from images of about ``wanted``
    seconds.
    """
    say(case, integrator)
    scene = case.load(integrator)
    picture(scene, 1, 0)  # compiles kernels
    spp = 1
    for share in (0.2, 1.0):
        took = picture(scene, spp, 1)[1]
        spp = int(np.clip(share * wanted * spp / took, 1, STOCK_SPP))
    images, times = zip(
        *(picture(scene, spp, seed) for seed in range(2, 2 + STOCK_IMAGES)), strict=True
    )
    return {
        "integrator": integrator,
        "spp": spp,
        "variance": float(np.var(images, axis=0, ddof=1).mean()) * spp,
        "seconds_per_sample": float(np.median(times)) / spp,
        "mean": float(np.mean(images)),
        "load": os.getloadavg()[0],
    }


def unscattered_row(case: Case, integrator: str) -> dict:
    """Return the mean radiance of the emitters behind the volume, attenuated by it."""
    scene = case.load(specify(integrator, max_depth=1))
    return {"mean": float(picture(scene, UNSCATTERED_SPP, 0)[0].mean())}


def picture(scene: mi.Scene, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Render colours, float64, and measure the seconds; values that are not finite are set to 0."""
    started = time.perf_counter()
    image = np.array(mi.render(scene, spp=spp, seed=seed))
    took = time.perf_counter() - started
    return np.nan_to_num(metrics.colours(image).astype(np.float64), posinf=0, neginf=0), took


def explore(depth: int, args: argparse.Namespace, point: Callable) -> list[dict]:
    """Measure caches of all resolutions and samples first, then images from the best two of
    them.
    """
    series = [
        [
            {"resolution": r, "cache_spp": n * SMALLEST_BATCH, "solver": "sweep"}
            for n in args.batches
        ]
        for r in args.resolutions
    ]
    series.append([{"resolution": r, "cache_spp": n, "solver": "path"} for r, n in PATH])
    caches = []
    for group in series:
        for properties in group:
            row = point(FIRST_SPP, step=FIRST_STEP, **properties)
            caches.append((row, properties))
            if row["cold"] > PATIENCE:
                break
    found = {id(row): row for row, _ in caches}
    for _, properties in finalists(caches):
        for step in args.steps:
            for spp in args.spp:
                row = point(spp, step=step, **properties)
                found[id(row)] = row
    return list(found.values())


def finalists(caches: list[tuple[dict, dict]]) -> list[tuple[dict, dict]]:
    """Return, for each target, the fastest setting that reaches it, or else the most accurate.

    Settings selected for another target are skipped.
    """
    chosen: list[tuple[dict, dict]] = []
    for target in TARGETS:
        rest = [c for c in caches if c not in chosen]
        reaching = [c for c in rest if c[0]["at_most"] <= target]
        if reaching:
            chosen.append(min(reaching, key=lambda c: c[0]["cold"]))
        elif rest:
            chosen.append(min(rest, key=lambda c: c[0]["rmse"]))
    return chosen


def point_row(case: Case, truth: Reference, integrator: str, spp: int) -> dict:
    """Return the error, and seconds with a cold cache and with a moved camera."""
    first, seconds_first = cold_start(case, integrator, spp)[1:]  # compiles new kernels
    runs = COLD_RUNS if sum(seconds_first) < PATIENCE else 1
    times = []
    for _ in range(runs):
        scene, _, stages = cold_start(case, integrator, spp)
        times.append(stages)
    cache, image = (float(t) for t in np.median(times, axis=0))
    square, uncertainty = net_mse(first, truth)
    row = {
        "integrator": integrator,
        "spp": spp,
        "rmse": metrics.net_rmse(first, truth.a, truth.b),
        "at_most": float(np.sqrt(max(square, 0) + uncertainty)),
        "mean_error": metrics.mean_error(first, truth.a, truth.b),
        "cold": float(np.median(np.sum(times, axis=1))),
        "cold_cache": cache,
        "cold_image": image,
        "moved": float(np.median([move(scene, spp, i) for i in range(1, 1 + MOVED_RUNS)])),
        "voxels": scene.integrator().cache.grid.voxel_count,
        "longest": max(scene.integrator().cache.grid.shape),
        "samples": scene.integrator().cache.samples,
        "load": os.getloadavg()[0],
    }
    say(
        case,
        f"{integrator} spp {spp}: RMSE {row['rmse']:.2e} (at most {row['at_most']:.2e}), "
        f"cold {row['cold']:.3f} s, moved {row['moved']:.3f} s, load {row['load']:.1f}",
    )
    return row


def net_mse(image: np.ndarray, truth: Reference) -> tuple[float, float]:
    """Return the mean square error net of the reference's noise, and its standard error.

    The channels of a pixel, which share their paths, count as one.
    """
    products = ((image - truth.a) * (image - truth.b)).mean(axis=-1)
    return float(products.mean()), float(products.std() / np.sqrt(products.size))


def cold_start(
    case: Case, integrator: str, spp: int
) -> tuple[mi.Scene, np.ndarray, tuple[float, float]]:
    """Return a scene with a new cache, its image, and seconds of cache and image."""
    scene = case.load(integrator)
    started = time.perf_counter()
    scene.integrator().prepare(scene)
    dr.sync_thread()
    filled = time.perf_counter() - started
    image, took = picture(scene, spp, 0)
    return scene, image, (filled, took)


def move(scene: mi.Scene, spp: int, number: int) -> float:
    """Return the seconds to rotate the camera a little and to render with another seed."""
    parameters = mi.traverse(scene.sensors()[0])
    started = time.perf_counter()
    placed = parameters["to_world"]
    parameters["to_world"] = placed @ type(placed)().rotate([0, 1, 0], 0.1)
    parameters.update()
    picture(scene, spp, number)
    return time.perf_counter() - started


def reach(
    case: Case, target: float, rivals: list[dict], points: list[dict], stock: Store, own: Store
) -> dict:
    """Return the least times to an error of ``target``; None for ``irrcache`` if not reached."""
    rival = min(rivals, key=cost)
    stock_seconds = cost(rival) / target**2
    row = {"target": target, "stock": rival["integrator"], "stock_seconds": stock_seconds}
    row |= dict.fromkeys(("cold", "moved", "process"))
    reaching = [p for p in points if p["at_most"] <= target]
    if not reaching:
        return row
    cold, moved = (min(reaching, key=lambda p, k=k: p[k]) for k in ("cold", "moved"))

    def started(store: Store, point: dict, command: Callable) -> float:
        spp = point["spp"] if store is own else 1
        key = f"{case.key} process {point['integrator']} spp {spp}"
        compute = partial(process_row, key, partial(command, case, point))
        return store.row(key, compute)["seconds"]

    rival_process = started(stock, rival, stock_command) + stock_seconds
    process = started(own, cold, own_command)
    return row | {
        "cold": entry(cold, cold["cold"], stock_seconds),
        "moved": entry(moved, moved["moved"], stock_seconds),
        "process": entry(cold, process, rival_process) | {"stock_seconds": rival_process},
    }


def entry(point: dict, took: float, rival: float) -> dict:
    """Format a setting, its seconds, and its speed-up over ``rival``."""
    setting = f"{point['integrator']} spp {point['spp']}"
    return {"setting": setting, "seconds": took, "ratio": rival / took}


def own_command(case: Case, point: dict, image: str) -> list[str]:
    """Return the ``irrcache render`` command of a setting."""
    defined = [part for k, v in case.parameters.items() for part in ("-D", f"{k}={v}")]
    command = [sys.executable, "-m", "mitsuba_irrcache", "render", str(case.scene), *defined]
    command += ["-m", case.variant, "-i", point["integrator"], "--spp", str(point["spp"])]
    return [*command, "-o", image]


def stock_command(case: Case, rival: dict, image: str) -> list[str]:
    """Return the command for Mitsuba alone with one sample per pixel and the default
    ``rr_depth``.
    """
    name = parse_integrator(rival["integrator"])[0]
    command = [sys.executable, "-c", STOCK_PROCESS, case.variant, str(case.scene), image, name]
    return [*command, json.dumps(case.parameters)]


def process_row(what: str, command: Callable[[str], list[str]]) -> dict:
    """Return the seconds of a process after a first one that saved its kernels to disk."""
    times = []
    with tempfile.TemporaryDirectory() as folder:
        while len(times) < 2 or (len(times) <= PROCESS_RUNS and sum(times) < PATIENCE):
            started = time.perf_counter()
            subprocess.run(command(f"{folder}/x.exr"), check=True, stdout=subprocess.DEVNULL)
            times.append(time.perf_counter() - started)
    took = float(np.median(times[1:]))
    print(f"{what}: {took:.2f} s", flush=True)
    return {"seconds": took, "load": os.getloadavg()[0]}


def say(case: Case, text: str) -> None:
    """Print a line of progress."""
    print(f"{case.key}: {text}", flush=True)


def table(cases: list[dict], settings: str = "all") -> Table:
    """Tabulate seconds to each error, and speed-ups over the best stock integrator.

    ``settings``: rows of the "best" ones, of "defaults", or "all".
    """
    error = "RMSE, at most" if settings == "defaults" else "RMSE"
    head = ["scene", "depth", error, "of the volume", "stock", "s", "cold cache", "camera moved"]
    head += ["new process", "setting with a cold cache"]
    cells = []
    for case in cases:
        for row in case["targets"]:
            if settings not in ("all", "defaults" if row.get("defaults") else "best"):
                continue
            stages = (row[k] for k in ("cold", "moved", "process"))
            setting = row["cold"]["setting"] if row["cold"] else "—"
            cells.append([
                case["name"], str(case["depth"]), f"{row['target']:.3g}",
                of_the_volume(row["target"], case), row["stock"], seconds(row["stock_seconds"]),
                *(f"{seconds(x['seconds'])} s ({x['ratio']:.3g} x)" if x else "—" for x in stages),
                "defaults" if row.get("defaults") else setting,
            ])  # fmt: skip
    note = (
        "Settings of irrcache are the fastest of a grid of settings that reaches the error, "
        "selected with the reference at hand, which a user does not have. So are those of the "
        "stock integrators: the best of volpath, volpathmis and prbvolpath and of several "
        "rr_depth. Rows of defaults: the largest error of default settings that the noise of the "
        "reference leaves possible, and the time of the stock integrator to it. RMSE: the radiance "
        "of the sky is 1; of the volume: in units of the mean radiance of the image without the "
        "light that comes to the camera without being scattered."
    )
    return Table("Time to an error, and ratio to the best stock integrator", head, cells, note)


def of_the_volume(error: float, case: dict) -> str:
    """Format in percent of the mean radiance of the volume alone.

    A dash if nothing is scattered, or if the results are older than this measurement.
    """
    volume = case.get("volume", 0.0)
    return percent(error / volume) if volume > 1e-3 * case["mean"] else "—"


def defaults(cases: list[dict]) -> Table:
    """Measure ``irrcache`` with default settings, and with twice the voxels along each axis."""
    head = ["scene", "depth", "voxels", "RMSE", "% of the mean", "of the volume", "at most"]
    head += ["mean error", "cold cache", "camera moved"]
    cells = [
        [c["name"], str(c["depth"]), str(row["longest"]), f"{row['rmse']:.2e}",
         percent(row["rmse"] / c["mean"]), of_the_volume(row["rmse"], c),
         percent(row["at_most"] / c["mean"]),
         percent(row["mean_error"] / c["mean"]), f"{seconds(row['cold'])} s",
         f"{seconds(row['moved'])} s"]
        for c in cases for row in (c["default"], c["twice"]) if row
    ]  # fmt: skip
    title = f"Default settings and twice their resolution, {DEFAULT_SPP} samples per pixel"
    return Table(title, head, cells)


if __name__ == "__main__":
    main()
