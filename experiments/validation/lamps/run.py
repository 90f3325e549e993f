"""Errors around area emitters inside and beside a medium, with all solvers that support the scene.

    python -m experiments.validation.lamps.run [--only TEXT] [--seconds S] [--force] [-o output]
        [--document FILE]

Every case of `cases` is rendered with ``irrcache`` at default settings, and with the solver
``path`` and 32 and 64 voxels. Each image is compared with two independent images of volpath, of
``--seconds`` of processor time together. The table shows the difference of the means, the RMSE,
and the largest differences of blocks of 4 x 4 pixels, in % of the mean radiance, with the noise of
the reference, which is subtracted from the RMSE. Pixels that show the emitter itself are excluded.

Rows and references are saved in output/lamps; ``--force`` discards the rows. No data are needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from time import process_time

import mitsuba as mi
import numpy as np

from experiments.support.case_rows import CaseRows, with_reference
from experiments.validation.lamps.cases import CASES, build
from experiments.validation.thick.cases import scene
from experiments.validation.thick.run import BLOCK, PIXELS, SPP, image, reference
from mitsuba_irrcache.compare.tables import Table

#: Settings of the renderings that are compared.
SETTINGS = {
    "defaults": {},
    "path, 32": {"solver": "path", "resolution": 32, "cache_spp": 128},
    "path, 64": {"solver": "path", "resolution": 64, "cache_spp": 64},
}
HEAD = ["scene", "settings", "solver", "mean [%]", "RMSE [%]", "worst blocks [%]", "cold s"]


def valid_pixels(objects: dict) -> np.ndarray:
    """Return which pixels (y, x) show no emitter, with a margin of one pixel."""
    loaded = mi.load_dict(scene(objects, {"type": "direct", "emitter_samples": 0}, PIXELS))
    lit = np.pad(image(loaded, 64, 5).mean(axis=2) > 0, 1)
    return ~np.any(
        [
            lit[1 + y : PIXELS + 1 + y, 1 + x : PIXELS + 1 + x]
            for y in (-1, 0, 1)
            for x in (-1, 0, 1)
        ],
        axis=0,
    )


def measure(objects: dict, depth: int, settings: dict, seconds: float, file: Path) -> dict:
    """Return a row; the reference is saved in ``file``."""
    if not file.exists():
        np.save(file, reference(objects, depth, seconds))
    a, b = np.load(file).mean(axis=3)
    integrator = {"type": "irrcache", "max_depth": depth} | settings
    ours = mi.load_dict(scene(objects, integrator, PIXELS))
    begun = process_time()
    x = image(ours, SPP, 1).mean(axis=2)
    elapsed, valid = process_time() - begun, valid_pixels(objects)
    scale = (0.5 * (a + b))[valid].mean()
    squared = ((x - a) * (x - b))[valid].mean()
    apart, noise = blocks(x - 0.5 * (a + b), valid), blocks(0.5 * (a - b), valid)
    row = {
        "mean": (x - 0.5 * (a + b))[valid].mean() / scale,
        "mean_noise": abs((a - b)[valid].mean()) / scale / 2,
        "rmse": np.sign(squared) * np.sqrt(abs(squared)) / scale,
        "rmse_noise": np.sqrt(np.square((a - b)[valid]).mean()) / 2 / scale,
        "lowest": np.nanmin(apart) / scale,
        "highest": np.nanmax(apart) / scale,
        "block_noise": np.nanstd(noise) / scale,
        "seconds": elapsed / 100,
    }
    solver = ours.integrator()._builder.solver
    return {key: 100 * float(value) for key, value in row.items()} | {"solver": solver}


def blocks(image: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return means over blocks of pixels; NaN for those with an invalid pixel."""
    n = PIXELS // BLOCK
    masked = np.where(valid, image, np.nan)
    return masked.reshape(n, BLOCK, n, BLOCK).mean(axis=(1, 3))


def cells(name: str, settings: str, row: dict) -> list[str]:
    """Return the cells of a row of the table, noise in parentheses."""
    return [
        name, settings, row["solver"],
        f"{row['mean']:+.2f} ({row['mean_noise']:.2f})",
        f"{row['rmse']:.2f} ({row['rmse_noise']:.2f})",
        f"{row['lowest']:+.1f} to {row['highest']:+.1f} ({row['block_noise']:.1f})",
        f"{row['seconds']:.1f}",
    ]  # fmt: skip


def tabulate(
    description: str,
    name: str,
    cases: Iterable[str],
    build: Callable[[str], tuple[dict, int]],
    settings: dict[str, dict],
) -> None:
    """Compute missing rows of an experiment of this ``name`` and print the table."""
    rows = CaseRows(description, name, with_reference(40.0))

    def titled() -> Iterator[tuple[str, tuple]]:
        for case in cases:
            if rows.args.only in case:
                objects, depth = build(case)
                where = rows.args.seconds, rows.file(case)
                for title, chosen in settings.items():
                    yield f"{case}: {title}", (case, title, (objects, depth, chosen, *where))

    def shown(_: str, case: tuple, row: dict) -> str:
        return " | ".join(cells(case[0], case[1], row))

    found = [
        cells(case, title, row)
        for (case, title, _), row in rows.rows(titled(), lambda case: measure(*case[2]), shown)
    ]
    short = [[r[0], *r[2:]] for r in found if r[1] == "defaults"]
    rows.write({name: Table("", [HEAD[0], *HEAD[2:]], short)})


if __name__ == "__main__":
    tabulate(__doc__, "lamps", CASES, build, SETTINGS)
