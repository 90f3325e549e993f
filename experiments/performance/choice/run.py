"""Does `auto` choose the faster one of a cache and Mitsuba's integrators?

    python -m experiments.performance.choice.run [--only TEXT] [--seconds S] [--force] [-o output]
        [--document docs/performance.md]

Scenes of other experiments, in images of several sizes with 16 samples per pixel, are rendered with
default properties, and with one that requests a cache. The table shows what was chosen, processor
seconds and RMSE of both images in % of the mean radiance (net of the noise of a reference of
``--seconds`` processor seconds by volpath), and by what factor the choice needs more or less
time for the same error. For the image with a cache it is that of volpath with its better
``rr_depth``, whose time follows from its variance. Kernels are warm, loading is excluded.

Rows are saved in output/choice. No data are needed.
"""

from __future__ import annotations

import gc
from functools import partial
from time import process_time

import mitsuba as mi
import numpy as np

from experiments.performance.kinds.scenes import KINDS, film, sensor
from experiments.support.documents import plain_number, replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from experiments.validation.glass.cases import CASES as GLASS
from mitsuba_irrcache.compare.tables import Table

SPP, STOCK_SPP, RR_DEPTHS = 16, 64, (5, 50)
#: Scene and pixels of a side.
ROWS = (
    ("closed cylinder of milk, sky", 64), ("closed cylinder of milk, sky", 256),
    ("rough jade, mesh, sky", 64), ("rough jade, hg 0.3, map", 64), ("rough jade, hg 0.3, map", 16),
    ("white furnace, nested glass", 64), ("smoke in a hollow globe, sky", 16),
    ("medium in a mesh", 64), ("medium in a mesh", 16), ("nested media", 64), ("nested media", 16),
    ("two media, environment and sun", 32), ("room with smoke, lamp visible", 16),
    ("cloud over textured ground, environment and sun", 16),
    ("camera in fog, before a ball", 16), ("Cornell box full of fog, with objects", 16),
    ("ball, rod and sheet inside smoke", 16), ("jade behind rough glass, lamp", 16),
)  # fmt: skip


def load(name: str, integrator: dict, pixels: int) -> mi.Scene:
    """Load a scene anew."""
    gc.collect()
    objects = (KINDS if name in KINDS else GLASS)[name]()
    look = mi.ScalarTransform4f().look_at([2.2, 1.9, 3.0], [0, 0, 0], [0, 1, 0])
    camera = sensor() | ({} if name in KINDS else {"to_world": look})
    camera |= objects.pop("sensor", {}) | {"film": film(pixels)}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera} | objects)


def image(scene: mi.Scene, spp: int, seed: int) -> tuple[np.ndarray, float]:
    """Render an image (y, x, channel); return it with the processor seconds."""
    started = process_time()
    rendered = np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float64)[..., :3]
    return rendered, process_time() - started


def reference(name: str, pixels: int, seconds: float) -> tuple[np.ndarray, float]:
    """Return two independent means of images by volpath, and the product of the variance of a
    sample per pixel and its processor seconds.
    """
    costs, scenes = [], []
    for rr_depth in RR_DEPTHS:
        stock = {"type": "volpath", "max_depth": -1, "rr_depth": rr_depth}
        scenes.append(load(name, stock, pixels))
        image(scenes[-1], STOCK_SPP, 1)
        several = [image(scenes[-1], STOCK_SPP, seed) for seed in (2, 3, 4)]
        images, times = zip(*several, strict=True)
        costs.append(float(np.var(images, axis=0, ddof=1).mean() * min(times)))
    scene, halves, begun = scenes[int(np.argmin(costs))], [[], []], process_time()
    while process_time() - begun < seconds or len(halves[1]) < 1:
        for half in halves:
            half.append(image(scene, STOCK_SPP, 100 + len(halves[0]) * 2 + len(halves[1]))[0])
    return np.array([np.mean(half, axis=0) for half in halves]), float(min(costs))


def measure(name: str, pixels: int, seconds: float) -> dict:
    """Return the row of a scene."""
    halves, stock = reference(name, pixels, seconds)
    mean, row = halves.mean(), {}
    noise = np.sqrt(np.square(halves[0] - halves[1]).mean()) / 2 / mean
    floor = noise / halves[0].size ** 0.25
    for key, settings in (("auto", {}), ("cache", {"step": 1.0})):
        image(load(name, {"type": "irrcache"} | settings, pixels), SPP, 0)  # compiles
        scene = load(name, {"type": "irrcache"} | settings, pixels)
        chose_cache = scene.integrator().uses_cache(scene, 0, SPP)
        scene = load(name, {"type": "irrcache"} | settings, pixels)
        found, took = image(scene, SPP, 5)
        square = ((found - halves[0]) * (found - halves[1])).mean() / mean**2
        row[key] = {"seconds": took, "rmse": float(np.sqrt(max(square, floor**2)))}
        row[key]["cache"] = bool(chose_cache)
    row["stock"] = stock / mean**2
    return row


def cells(name: str, pixels: int, row: dict) -> list[str]:
    """Return the cells of a row."""
    auto, cache = row["auto"], row["cache"]
    if auto["cache"]:
        gain = row["stock"] / auto["rmse"] ** 2 / auto["seconds"]
    else:  # the time that the image by volpath would need for the error of the one with a cache
        gain = cache["seconds"] / (auto["seconds"] * (auto["rmse"] / cache["rmse"]) ** 2)
    return [
        name, f"{pixels} x {pixels}", "cache" if auto["cache"] else "volpath",
        f"{auto['seconds']:.2g} s, {auto['rmse']:.2%}", f"{cache['seconds']:.2g} s, "
        f"{cache['rmse']:.2%}", f"{plain_number(gain)} x",
    ]  # fmt: skip


def main() -> None:
    """Compute missing rows."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", default="", help="scenes whose names contain this")
    parser.add_argument("--seconds", type=float, default=20, help="of a reference")
    add_document(parser)
    args = parser.parse_args()
    begin()
    folder = args.output / "choice"
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / "results.json")
    done = []
    for name, pixels in ROWS:
        if args.only not in name:
            continue
        key = f"{name} {pixels}"
        if args.force:
            store.rows.pop(key, None)
        store.row(key, partial(measure, name, pixels, args.seconds))
        done.append(cells(name, pixels, store.rows[key]))
        print(" | ".join(done[-1]), flush=True)
    head = ["scene", "pixels", "auto", "time, RMSE", "with a cache", "gain of the choice"]
    table = Table("Choices of auto", head, done)
    if args.document:
        replace_tables(args.document, {"choice": table})


if __name__ == "__main__":
    main()
