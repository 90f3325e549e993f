"""Errors at default settings for thick voxels, coarse data, or narrow spot lights.

    python -m experiments.validation.thick.run [--only TEXT] [--seconds S] [--force] [-o output]
        [--document FILE]

Every case of `cases` is rendered with ``irrcache`` at default settings and compared with two
independent images of volpath, of ``--seconds`` of processor time together. The table shows the
difference of the means, the RMSE and the largest difference of a block of 4 x 4 pixels in units of
the mean radiance, with the noise of the reference, which is subtracted from the RMSE; and the
processor time of a cold image. volpath offsets rays at surfaces by about 2e-4 here: its images of
media with 300 mean free paths are too dark by 2 % under a sky, by 9 % in the sun; these rows are
marked.

Rows and references are saved in output/thick; ``--force`` discards the rows. ``--document`` writes
the number of cases of each class, the median and the largest RMSE, and the largest block into a
marked table, without the marked rows. No data are needed.
"""

from __future__ import annotations

from pathlib import Path
from time import process_time

import mitsuba as mi
import numpy as np

from experiments.support.case_rows import CaseRows, with_reference
from experiments.validation.thick.cases import CLASSES, scene
from mitsuba_irrcache.compare.tables import Table

PIXELS, BLOCK, SPP = 48, 4, 256
#: Largest ratio of volpath's ray offset to a mean free path.
OFFSET, TRUSTED = 1.8e-4, 0.01


def reference(objects: dict, depth: int, seconds: float) -> np.ndarray:
    """Render two independent images (2, y, x, channel) of volpath, of ``seconds`` together."""
    integrator = {"type": "volpath", "max_depth": depth, "rr_depth": 50}
    shape = objects["shape"]
    if shape["type"] == "cube" and shape["interior"]["type"] == "heterogeneous":
        # The medium ends with its grid; volpath offsets rays at the boundary, not into matter.
        objects = objects | {"shape": shape | {"to_world": mi.ScalarTransform4f().scale(1.002)}}
    loaded = mi.load_dict(scene(objects, integrator, PIXELS))
    halves, count, begun = [0.0, 0.0], 0, process_time()
    while count < 2 or count % 2 or process_time() - begun < seconds:
        halves[count % 2] += image(loaded, 64, 1000 + count)
        count += 1
    return np.array(halves) / (count // 2)


def measure(objects: dict, depth: int, seconds: float, file: Path) -> dict:
    """Return a row; the reference is saved in ``file``."""
    if not file.exists():
        np.save(file, reference(objects, depth, seconds))
    a, b = np.load(file)
    ours = mi.load_dict(scene(objects, {"type": "irrcache", "max_depth": depth}, PIXELS))
    begun = process_time()
    x = image(ours, SPP, 1)
    seconds, interior = process_time() - begun, objects["shape"]["interior"]
    # In grids the offset does not reach matter, see `reference`.
    offset = OFFSET * interior["scale"] if interior["type"] == "homogeneous" else 0.0
    row = {"seconds": seconds, "offset": offset}
    scale = 0.5 * (a.mean() + b.mean())
    squared = ((x - a) * (x - b)).mean()
    apart = blocks(x - 0.5 * (a + b))
    row |= {
        "mean": (x.mean() / scale - 1) * 100,
        "mean_noise": abs((a - b).mean()) / scale * 50,
        "rmse": float(np.sign(squared) * np.sqrt(abs(squared)) / scale * 100),
        "rmse_noise": float(np.sqrt(np.square(a - b).mean()) / 2 / scale * 100),
        "block": np.abs(apart).max() / scale * 100,
        "block_noise": float(blocks(a - b).std() / 2 / scale * 100),
    }
    return {key: float(value) for key, value in row.items()}


def image(scene: mi.Scene, spp: int, seed: int) -> np.ndarray:
    """Return the rendered image."""
    return np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float64)


def blocks(image: np.ndarray) -> np.ndarray:
    """Return means over blocks of pixels and the channels."""
    n = PIXELS // BLOCK
    return image.mean(axis=2).reshape(n, BLOCK, n, BLOCK).mean(axis=(1, 3))


def line(name: str, row: dict) -> str:
    """Return a row of the table, noise in parentheses."""
    mark = "  volpath is biased here" if row["offset"] > TRUSTED else ""
    mean, rmse, block = (
        f"{key} {row[key]:+6.2f} % ({row[f'{key}_noise']:.2f})" for key in ("mean", "rmse", "block")
    )
    return f"{name:58} {mean}, {rmse}, {block}, {row['seconds']:.1f} s{mark}"


def classes(rows: dict[str, dict]) -> Table:
    """Return a table with one row for each class of cases."""
    body = []
    for kind in CLASSES:
        own = {
            key.removeprefix(f"{kind}: "): row
            for key, row in rows.items()
            if key.startswith(f"{kind}: ") and row["offset"] <= TRUSTED
        }
        if not own:
            continue
        largest = [max(own, key=lambda key, x=x: own[key][x]) for x in ("rmse", "block")]
        worst = [
            f"{own[key][x]:.1f} ({own[key][f'{x}_noise']:.1f}), {key}"
            for key, x in zip(largest, ("rmse", "block"), strict=True)
        ]
        median = np.median([row["rmse"] for row in own.values()])
        body.append([kind, str(len(own)), f"{median:.2f}", *worst])
    return Table("", ["class", "cases", "median RMSE [%]", "largest RMSE", "largest block"], body)


def run() -> None:
    """Compute missing rows and print the table."""
    rows = CaseRows(__doc__, "thick", with_reference(20.0))
    titled = (
        (title := f"{kind}: {name}", (*case, rows.args.seconds, rows.file(title)))
        for kind, cases in CLASSES.items()
        for name, case in cases().items()
    )
    for _ in rows.rows(titled, lambda case: measure(*case), lambda title, _, row: line(title, row)):
        pass
    rows.write({"thick": classes(rows.store.rows)})


if __name__ == "__main__":
    run()
