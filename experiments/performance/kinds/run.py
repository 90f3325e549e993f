"""Time to an error for each kind of scene, including those where irrcache is slower.

    python -m experiments.performance.kinds.run [--kinds NAME ...] [--pixels 128] [--seconds 10]
        [--budget 1200] [--variant cuda_ad_rgb] [--force] [-o output]
        [--document docs/performance.md]

Each scene is rendered by ``irrcache`` with all orders of scattering, with default properties and
with coarser ones (COARSER), with 1, 4, 16 and 64 samples per pixel until the smallest target is
reached. Errors are RMSE in units
of the mean radiance, net of the noise of a reference of two halves (``--seconds`` each, by volpath
unless another stock integrator is much faster). Beside them the best of volpath, volpathmis and
prbvolpath at its best ``rr_depth``, whose time to an error is its variance over the square of the
error, times the duration of a sample. Kernels are warm, loading is excluded.

Rows are saved in output/kinds/VARIANT.json; none is started after ``--budget`` seconds: run it
again for the others.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from functools import partial
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.performance.kinds.scenes import KINDS, film, sensor
from experiments.support.documents import plain_number, replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from mitsuba_irrcache.compare.tables import Table

TARGETS = (1e-2, 3e-3)
SPP = (1, 4, 16, 64)
#: Coarser settings: resolution in units of the default one, and ``cache_spp``, 0 for the default.
COARSER = tuple(product((1, 1 / 2, 1 / 3), (0, 64, 32)))[1:]
#: Samples per pixel of the column "defaults"; Mitsuba's samplers have 4.
DEFAULT_SPP = 16
STOCK, RR_DEPTHS = ("volpath", "volpathmis", "prbvolpath"), (5, 1000)
#: Images of a stock integrator for its variance, and seconds of one.
STOCK_IMAGES, STOCK_SECONDS = 3, 1.0
#: Most samples of an image of a stock integrator: bounds the memory of wavefronts on GPUs.
STOCK_SAMPLES = 1 << 26
#: Ratio of the costs of volpath and of the best integrator above which the latter makes references.
MUCH_FASTER = 3.0
#: Relative difference of their means, and standard errors of it, beyond which one is wrong.
BIAS, SIGMAS = 0.01, 6
#: Images by irrcache with independent caches; seconds of an image above which there is only one.
RUNS, PATIENCE = 2, 20.0
#: Pixels of a side of the blocks whose means are compared.
BLOCK = 8


def load(
    build: Callable[[], dict], pixels: int, integrator: str, rr_depth: int = 5, **properties: float
) -> mi.Scene:
    """Load the scene anew, with a cold cache."""
    gc.collect()
    properties |= {"type": integrator, "max_depth": -1, "rr_depth": rr_depth}
    scene = {"type": "scene", "integrator": properties, "sensor": sensor()} | build()
    scene["sensor"] |= {"film": film(pixels)}
    scene = mi.load_dict(scene)
    dr.sync_thread()
    return scene


def picture(scene: mi.Scene, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Render colours, float64, and measure the seconds."""
    started = time.perf_counter()
    image = np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float64)
    return image[..., :3], time.perf_counter() - started


def compute(build: Callable[[], dict], pixels: int, reference_seconds: float) -> dict:
    """Return all measurements of a kind of scene."""
    stock = [stock_row(build, pixels, *settings) for settings in product(STOCK, RR_DEPTHS)]
    best = min(unbiased(stock), key=lambda row: row["cost"])
    # The means of others may differ from that of volpath by up to half a percent.
    volpath = min((row for row in stock if row["name"] == "volpath"), key=lambda row: row["cost"])
    used = volpath if volpath["cost"] < MUCH_FASTER * best["cost"] else best
    halves = reference(load(build, pixels, used["name"], used["rr_depth"]), used, reference_seconds)
    mean = float(np.mean(halves))
    ours = irrcache_rows(build, pixels, halves, DEFAULT_SPP)
    solver, resolution = choice_of(build, pixels)
    coarser = []
    for share, samples in COARSER:
        settings = {"resolution": max(round(share * resolution), 2), "cache_spp": samples}
        coarser += irrcache_rows(build, pixels, halves, 1, **settings)
    return {
        "stock": best, "resolved": ours[-1]["resolved"], "mean": mean, "irrcache": ours,
        "coarser": coarser, "solver": solver,
    }  # fmt: skip


def stock_row(build: Callable[[], dict], pixels: int, name: str, rr_depth: int) -> dict:
    """Return relative variance and seconds of a sample per pixel, and their product."""
    scene = load(build, pixels, name, rr_depth)
    picture(scene, 1, 0)
    _, once = picture(scene, 1, 1)
    spp = int(np.clip(STOCK_SECONDS / once, 1, STOCK_SAMPLES / pixels**2))
    images, times = zip(
        *(picture(scene, spp, seed) for seed in range(2, 2 + STOCK_IMAGES)), strict=True
    )
    variance = float(np.var(images, axis=0, ddof=1).mean()) * spp / np.mean(images) ** 2
    each = float(np.median(times)) / spp
    means = np.mean(images, axis=(1, 2, 3))
    return {
        "name": name, "rr_depth": rr_depth, "spp": spp, "seconds": each, "cost": variance * each,
        "mean": float(means.mean()), "error": float(means.std(ddof=1) / np.sqrt(len(means))),
    }  # fmt: skip


def unbiased(stock: list[dict]) -> list[dict]:
    """Return the rows whose mean is that of volpath: prbvolpath ignores the medium that a sensor
    is in.
    """
    (expected, *_) = (row for row in stock if row["name"] == "volpath")
    return [
        row
        for row in stock
        if abs(row["mean"] - expected["mean"])
        <= BIAS * expected["mean"] + SIGMAS * np.hypot(row["error"], expected["error"])
    ]


def reference(scene: mi.Scene, stock: dict, seconds: float) -> list[np.ndarray]:
    """Return two independent means of images, each rendered within the ``seconds``."""
    count = max(1, int(seconds / (stock["seconds"] * stock["spp"])))
    return [
        np.mean(
            [picture(scene, stock["spp"], 1000 + 2 * i + half)[0] for i in range(count)], axis=0
        )
        for half in range(2)
    ]


def irrcache_rows(
    build: Callable[[], dict], pixels: int, halves: list[np.ndarray], least: int, **settings: int
) -> list[dict]:
    """Return rows for increasing samples per pixel, until there are ``least`` of them and the
    smallest target is reached.
    """
    rows = []
    for spp in SPP:
        rows.append(irrcache_row(build, pixels, spp, halves, settings))
        if rows[-1]["rmse"] < min(TARGETS) and spp >= least:
            break
    return rows


def irrcache_row(
    build: Callable[[], dict],
    pixels: int,
    spp: int,
    halves: list[np.ndarray],
    settings: dict[str, int],
) -> dict:
    """Return errors of the image with ``spp`` samples per pixel, and its times."""
    scene = load(build, pixels, "irrcache", **settings)
    picture(scene, spp, 0)  # compiles kernels
    mean, rows = np.mean(halves), []
    for seed in range(RUNS):
        # Free the scene before: Dr.Jit's kernels contain the numbers of the scene's objects, which
        # are others while the old ones exist.
        scene = None
        scene = load(build, pixels, "irrcache", **settings)
        image, cold = picture(scene, spp, seed)
        moved = picture(scene, spp, seed + 100)[1]
        a, b = (image - half for half in halves)
        product = (a * b).mean(axis=2)
        # Standard error of the mean product, with outliers of the reference.
        spread = product.std() / np.sqrt(product.size)
        rows.append([cold, moved, product.mean(), (a + b).mean() / 2, block_error(a, b), spread])
        if cold > PATIENCE:
            break
    cold, moved = np.median(rows, axis=0)[:2]
    square, bias, blocks, spread = np.mean(rows, axis=0)[2:]
    return {
        **settings, "spp": spp, "cold": float(cold), "moved": float(moved),
        "rmse": float(np.sqrt(max(square, 0)) / mean), "mean": float(bias / mean),
        "blocks": float(np.sqrt(max(blocks, 0)) / mean), "resolved": float(np.sqrt(spread) / mean),
    }  # fmt: skip


def block_error(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean product of the means over blocks of two errors."""
    rows, columns, channels = (side // BLOCK for side in (*a.shape[:2], BLOCK * a.shape[2]))
    shape = rows, BLOCK, columns, BLOCK, channels
    a, b = (e[: rows * BLOCK, : columns * BLOCK].reshape(shape).mean((1, 3)) for e in (a, b))
    return float((a * b).mean())


def choice_of(build: Callable[[], dict], pixels: int) -> tuple[str, int]:
    """Return the solver that was selected, and the default resolution."""
    scene = load(build, pixels, "irrcache")
    scene.integrator().prepare(scene)
    builder = scene.integrator()._builder
    caches = [part.cache for part in builder.parts if part.cache is not None]
    return builder.solver, max(max(cache.grid.shape) for cache in caches)


def table(rows: dict[str, dict], pixels: int, variant: str) -> Table:
    """Tabulate the rows; errors below the resolution of the reference count as that, and targets
    below it are not resolved.
    """
    head = ["scene", "solver"]
    head += [f"RMSE {target:.1%}" for target in TARGETS]
    head += [f"camera moved, {min(TARGETS):.1%}"]
    head += [f"best settings, {target:.1%}" for target in TARGETS]
    head += ["faster below"]
    head += [f"RMSE at {DEFAULT_SPP} spp", f"of {BLOCK} x {BLOCK} blocks", "mean"]
    cells = [[name, row["solver"], *_speeds(row), *_errors(row)] for name, row in rows.items()]
    title = f"Ratios to the best stock integrator, {pixels} x {pixels} pixels, {variant}"
    return Table(title, head, cells)


def _speeds(row: dict) -> list[str]:
    """Format the ratios of the times to each target, and the error below which a cache pays."""
    cells, cost = [], row["stock"]["cost"]
    default, coarser = row["irrcache"], row["coarser"]
    wanted = [(default, target, "cold") for target in TARGETS]
    wanted += [(default, min(TARGETS), "moved")]
    wanted += [(default + coarser, target, "cold") for target in TARGETS]
    for rows, target, key in wanted:
        found = [r for r in rows if max(r["rmse"], row["resolved"]) <= target]
        if row["resolved"] > target:
            cells.append("not resolved")
        elif not found:
            cells.append("not reached")
        else:
            best = min(found, key=lambda r, key=key: r[key])
            ratio = plain_number(cost / target**2 / best[key])
            cells.append(f"{ratio} x, {best[key]:.2g} s{_settings(best)}")
    # An image of error e takes the cache's time and that of its samples, which goes with e^-2.
    last = row["irrcache"][-1]
    error, once = max(last["rmse"], row["resolved"]), max(last["cold"] - last["moved"], 1e-3)
    saved = cost - last["moved"] * error**2
    return [*cells, f"{np.sqrt(saved / once):.1%}" if saved > 0 else "never"]


def _settings(row: dict) -> str:
    """Format resolution, directions and samples per pixel if they are not the defaults."""
    if "resolution" not in row:
        return ""
    return f" ({row['resolution']}, {row['cache_spp'] or 'default'}, {row['spp']})"


def _errors(row: dict) -> list[str]:
    """Format the errors with the default number of samples per pixel."""
    found = next(r for r in row["irrcache"] if r["spp"] == DEFAULT_SPP)
    rmse = (
        f"{'below ' * (found['rmse'] < row['resolved'])}{max(found['rmse'], row['resolved']):.2%}"
    )
    return [rmse, f"{found['blocks']:.2%}", f"{found['mean']:+.2%}"]


def main() -> None:
    """Compute missing rows within the budget."""
    parser = parser_of(__doc__)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--pixels", type=int, default=128, help="per side")
    parser.add_argument("--budget", type=float, default=1200, help="no row is begun later")
    parser.add_argument("--seconds", type=float, default=10, help="of half a reference")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    add_document(parser)
    args = parser.parse_args()
    begin(args.variant)
    folder = args.output / "kinds"
    folder.mkdir(parents=True, exist_ok=True)
    store, started = Store(folder / f"{args.variant}.json"), time.perf_counter()
    for name in args.kinds:
        key = f"{name} {args.pixels}"
        if (args.force or key not in store.rows) and time.perf_counter() - started > args.budget:
            print(f"{name}: not computed yet; run again")
            continue
        if args.force:  # the others are kept
            store.rows.pop(key, None)
        store.row(key, partial(compute, KINDS[name], args.pixels, args.seconds))
        print(table({name: store.rows[key]}, args.pixels, args.variant).as_text(), flush=True)
    found = {name: store.rows.get(f"{name} {args.pixels}") for name in KINDS}
    whole = table({name: row for name, row in found.items() if row}, args.pixels, args.variant)
    print(whole.as_text())
    if args.document:
        on_gpu = args.variant.startswith("cuda")
        replace_tables(args.document, {"kinds-on-a-gpu": whole} if on_gpu else {"kinds": whole})


if __name__ == "__main__":
    main()
