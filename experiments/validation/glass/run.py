"""Errors of media behind boundaries that refract.

    python -m experiments.validation.glass.run [--only TEXT] [--seconds S] [--solver NAME]
        [--force] [-o output] [--document FILE]

Every case of `cases` is rendered at default settings and 64 samples per pixel, and compared with
two independent images of volpath, of ``--seconds`` of processor time together. The table shows the
difference of the means, the RMSE and the largest difference of blocks of 8 x 8 pixels, in % of the
mean radiance, with the noise of the reference in parentheses, which is subtracted from the RMSE;
the processor seconds of the first image, and those that volpath needs for the same RMSE. Both
images of each case are saved as ``NAME.png`` side by side.

Rows, references and images are saved in output/glass; ``--force`` discards the rows. No data are
needed.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from time import process_time

import mitsuba as mi
import numpy as np

from experiments.support.documents import plain_number, replace_tables
from experiments.support.options import Options, add_document, begin, parser_of
from experiments.support.store import Store
from experiments.validation.glass.cases import CASES, build
from mitsuba_irrcache.compare.tables import Table

PIXELS, BLOCK, SPP, STOCK_SPP = 64, 8, 64, 64
HEAD = ["scene", "solver", "mean [%]", "RMSE [%]", "worst block [%]", "cold s", "volpath s"]


def image(scene: mi.Scene, spp: int, seed: int) -> np.ndarray:
    """Return the rendered image (y, x, channel)."""
    return np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float64)


def reference(name: str, seconds: float) -> dict[str, np.ndarray]:
    """Render two independent images of volpath, of ``seconds`` of processor time together.

    Also returns the variance of a sample per pixel, and the seconds that it takes.
    """
    loaded = build(name, {"type": "volpath", "max_depth": -1, "rr_depth": 50}, PIXELS)
    image(loaded, STOCK_SPP, 999)  # compiles
    images, begun = [], process_time()
    while len(images) < 2 or len(images) % 2 or process_time() - begun < seconds:
        images.append(image(loaded, STOCK_SPP, 1000 + len(images)))
    each = (process_time() - begun) / len(images) / STOCK_SPP
    images = np.array(images)
    halves = np.array([images[0::2].mean(axis=0), images[1::2].mean(axis=0)])
    variance = images.var(axis=0, ddof=1).mean() * STOCK_SPP
    return {"halves": halves, "variance": variance, "each": each}


def blocks(image: np.ndarray) -> np.ndarray:
    """Return means over blocks of pixels and the channels."""
    n = PIXELS // BLOCK
    return image.mean(axis=2).reshape(n, BLOCK, n, BLOCK).mean(axis=(1, 3))


def measure(name: str, solver: str, seconds: float, file: Path) -> dict:
    """Return a row; the reference and the images are saved beside ``file``."""
    if not file.exists():
        np.savez(file, **reference(name, seconds))
    known = np.load(file)
    (a, b), middle = known["halves"], known["halves"].mean(axis=0)
    settings = {"type": "irrcache", "solver": solver}
    image(build(name, settings | {"resolution": 8}, PIXELS), SPP, 0)  # compiles
    ours, started = build(name, settings | {"cache_seed": 1}, PIXELS), process_time()
    x = image(ours, SPP, 1)
    cold, scale = process_time() - started, middle.mean()
    pair = np.concatenate([middle, x], axis=1).astype(np.float32)
    mi.util.write_bitmap(str(file.with_suffix(".png")), mi.Bitmap(pair))
    squared = ((x - a) * (x - b)).mean()
    rmse = np.sign(squared) * np.sqrt(abs(squared)) / scale
    noise = np.sqrt(np.square(a - b).mean()) / 2 / scale
    resolved = max(rmse, noise / (a.size / 2) ** 0.25)
    apart, block_noise = blocks(x - middle), blocks(0.5 * (a - b))
    row = {
        "mean": (x - middle).mean() / scale,
        "mean_noise": noise / a.size**0.5 * 3**0.5,
        "rmse": rmse,
        "rmse_noise": noise,
        "worst": apart.flat[np.abs(apart).argmax()] / scale,
        "block_noise": block_noise.std() / scale,
    }
    row = {key: 100 * float(value) for key, value in row.items()}
    stock = float(known["variance"]) / scale**2 / resolved**2 * float(known["each"])
    solvers = "+".join(dict.fromkeys(p.solver.name for p in ours.integrator()._builder.parts))
    return row | {"cold": cold, "stock": stock, "solver": solvers or "volpath"}


def cells(name: str, row: dict) -> list[str]:
    """Return the cells of a row of the table, noise in parentheses."""
    return [
        name, row["solver"],
        f"{row['mean']:+.2f} ({row['mean_noise']:.2f})",
        f"{row['rmse']:.2f} ({row['rmse_noise']:.2f})",
        f"{row['worst']:+.1f} ({row['block_noise']:.1f})",
        f"{row['cold']:.1f}", f"{row['stock']:.0f} ({plain_number(row['stock'] / row['cold'])} x)",
    ]  # fmt: skip


def main() -> None:
    """Compute missing rows."""
    parser = parser_of(__doc__)
    add_document(parser)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--solver", default="auto", help="property of irrcache")
    parser.add_argument("--seconds", type=float, default=40.0, help="of volpath for each case")
    args = parser.parse_args()
    begin()
    folder = Options(output=args.output, force=args.force).folder("glass")
    store, rows = Store(folder / "results.json", args.force), []
    for name in CASES:
        if args.only not in name:
            continue
        file = folder / f"{re.sub('[^0-9a-z]+', '-', name)}.npz"
        key = name if args.solver == "auto" else f"{name}: {args.solver}"
        row = store.row(key, partial(measure, name, args.solver, args.seconds, file))
        rows.append(cells(name, row))
        print(" | ".join(rows[-1]), flush=True)
    if args.document:
        replace_tables(args.document, {"glass": Table("", HEAD, rows)})


if __name__ == "__main__":
    main()
