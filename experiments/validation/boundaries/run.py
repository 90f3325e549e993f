"""Unusual boundaries, placements and media compared with volpath: rendered or refused.

    python -m experiments.validation.boundaries.run [--only TEXT] [--force] [-o output]

Every case is a small scene of `cases`, all orders of scattering. If ``irrcache`` accepts it, its
images (solver ``auto``, caches of different seeds) are compared with volpath's: the difference of
the means and the RMSE of blocks of 4 x 4 pixels, both in units of the mean radiance, with the
standard error that the images' own noise implies for each. If it refuses, the message is shown. A
row with a difference of more than four standard errors and 1 % is marked.

Rows are saved in output/boundaries/results.json. No data are needed.
"""

from __future__ import annotations

from functools import partial

import mitsuba as mi
import numpy as np

from experiments.support.options import Options, begin, parser_of
from experiments.support.store import Store
from experiments.validation.boundaries.cases import CLASSES, scene
from mitsuba_irrcache.errors import IrrcacheError, origin

PIXELS, BLOCK = 24, 4
#: Images, and samples per pixel of each.
OURS, OUR_SPP = 2, 64
THEIRS, THEIR_SPP = 4, 256
DEPTH = {"max_depth": -1, "rr_depth": 50}
#: Threshold of a difference: standard errors, and fraction of the mean radiance.
SIGMAS, PART = 4.0, 0.01


def measure(objects: dict) -> dict:
    """Return a row: the message of a refused scene, or differences and their standard errors."""
    ours = {"type": "irrcache", "resolution": 16, "cache_spp": 64} | DEPTH
    try:
        mine = [
            image(scene(objects, ours | {"cache_seed": seed}, PIXELS), OUR_SPP, seed)
            for seed in range(OURS)
        ]
    except RuntimeError as error:
        if not isinstance(origin(error), IrrcacheError):
            raise
        return {"refused": str(error)}
    theirs = scene(objects, {"type": "volpath"} | DEPTH, PIXELS)
    theirs = [image(theirs, THEIR_SPP, 100 + seed) for seed in range(THEIRS)]
    return compared(np.array(mine), np.array(theirs))


def image(loaded: mi.Scene, spp: int, seed: int) -> np.ndarray:
    """Return block means of the image."""
    pixels = np.array(mi.render(loaded, spp=spp, seed=seed), dtype=np.float64)[..., :3]
    n = PIXELS // BLOCK
    return pixels.reshape(n, BLOCK, n, BLOCK, 3).mean(axis=(1, 3))


def compared(mine: np.ndarray, theirs: np.ndarray) -> dict:
    """Return differences between the means of images (n, y, x, channel) and their standard
    errors.

    Both are in units of the mean radiance.
    """
    scale = max(theirs.mean(), 1e-12)
    apart = (mine.mean(axis=0) - theirs.mean(axis=0)) / scale
    means = [images.mean(axis=(1, 2, 3)) / scale for images in (mine, theirs)]
    error = np.sqrt(sum(m.var(ddof=1) / len(m) for m in means))
    noise = sum((i / scale).var(axis=0, ddof=1).mean() / len(i) for i in (mine, theirs))
    return {
        "mean": float(apart.mean()), "mean_error": float(error),
        "rmse": float(np.sqrt(np.mean(apart**2))), "rmse_noise": float(np.sqrt(noise)),
    }  # fmt: skip


def differs(row: dict) -> bool:
    """Return whether an accepted case differs from volpath."""
    if "refused" in row:
        return False
    mean = abs(row["mean"]) > max(SIGMAS * row["mean_error"], PART)
    return mean or row["rmse"] > max(2 * row["rmse_noise"], 2 * PART)


def run() -> None:
    """Compute missing rows and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    args = parser.parse_args()
    begin()
    options = Options(output=args.output, force=args.force)
    store = Store(options.folder("boundaries") / "results.json", options.force)
    for kind, cases in CLASSES.items():
        for name, objects in cases().items():
            if args.only in f"{kind}: {name}":
                row = store.row(f"{kind}: {name}", partial(measure, objects))
                print(line(f"{kind}: {name}", row), flush=True)


def line(name: str, row: dict) -> str:
    """Return a row of the table."""
    if "refused" in row:
        return f"{name:55} refused: {row['refused']}"
    mark = "  DIFFERS" if differs(row) else ""
    return (
        f"{name:55} accepted: mean {row['mean']:+8.2%} (error {row['mean_error']:.2%}), blocks "
        f"{row['rmse']:7.2%} (noise {row['rmse_noise']:.2%}){mark}"
    )


if __name__ == "__main__":
    run()
