"""Errors and times of all orders of scattering, and of one, at default settings.

    python -m experiments.validation.defaults.run [--only TEXT] [--budget 480] [--force]
        [-o output] [--document FILE]

Scenes of many kinds (see cases.py), in smooth light (constant environments, and maps without bright
regions) and in light with detail. Each image of 48 x 48 pixels is compared with one for a cache of
twice as many voxels along each axis as the data or the default have, at most 112, and of 256
directions, with the same camera samples, so that voxels and directions are all that differs. In
smooth light it is also rendered with cubic voxels of the size of the data's, and 128 directions:
what the defaults would be in light with detail, unless the data are dense.

The table has the voxels and directions of the cache, the RMSE and the largest mean error of a block
of 4 x 4 pixels, in % of the mean, and the processor time; with larger voxels in smooth light, also
the error and the time with those of the data.

Rows are saved in output/defaults/results.json; no case is started after ``--budget`` seconds.
"""

from __future__ import annotations

import time

import drjit as dr
import mitsuba as mi
import numpy as np

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from experiments.support.case_rows import CaseRows, with_budget
from experiments.validation.defaults.cases import SMOOTH, Case, cases
from mitsuba_irrcache.compare.metrics import block_means
from mitsuba_irrcache.compare.tables import Table

SPP, BLOCK = 16, 4
#: Cache of the reference: largest number of voxels along an axis, and directions.
FINEST, DIRECTIONS = 112, 256
HEAD = [
    "scene", "voxels", "directions", "RMSE [%]", "largest block [%]", "time [s]",
    "with the voxels of the data",
]  # fmt: skip


def rendered(case: Case, times: int = 2, **settings) -> tuple[np.ndarray, float, mi.Scene]:
    """Return an image, the processor time of a cold cache and it, and the scene.

    The first of several ``times`` compiles kernels.
    """
    for _ in range(times):
        scene = case.scene(**settings)
        started = time.process_time()
        image = np.array(mi.render(scene, spp=SPP), dtype=np.float64)[..., :1]
        dr.sync_thread()
    return image, time.process_time() - started, scene


def measure(case: Case) -> dict:
    """Return a row."""
    image, seconds, scene = rendered(case)
    cache, data = scene.integrator().cache, max(case.extinction().shape)
    size = max(*cache.grid.shape, data)
    fine = {"resolution": min(2 * size, max(FINEST, size)), "cache_spp": DIRECTIONS}
    reference = rendered(case, 1, cache_seed=1, **fine)[0]
    row = {
        "voxels": cache.grid.shape[::-1], "directions": cache.samples, "seconds": seconds,
        "error": error(image, reference), "block": largest_block(image, reference),
    }  # fmt: skip
    if case.emitter in SMOOTH and case.max_depth != 2 and max(cache.grid.shape) < data:
        of_data, row["data_seconds"], _ = rendered(case, resolution=data, cache_spp=128)
        row["data_error"] = error(of_data, reference)
    return row


def error(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the RMSE [%] of the mean."""
    return float(100 * np.sqrt(np.square(image - reference).mean()) / reference.mean())


def largest_block(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the largest mean error of a block of pixels [%]."""
    blocks = block_means(image - reference, BLOCK)
    return float(100 * np.abs(blocks).max() / reference.mean())


def cells(case: Case, row: dict) -> list[str]:
    """Return the cells of a row of the table."""
    of_data = ""
    if "data_error" in row:
        of_data = f"{row['data_error']:.2f} %, {row['data_seconds']:.1f} s"
    return [
        case.name, " x ".join(map(str, row["voxels"])), str(row["directions"]),
        f"{row['error']:.2f}", f"{row['block']:.1f}", f"{row['seconds']:.1f}", of_data,
    ]  # fmt: skip


def run() -> None:
    """Compute missing rows, and print the table."""
    rows = CaseRows(__doc__, "defaults", with_budget(480), "llvm_ad_mono")
    table = [
        cells(case, row)
        for case, row in rows.rows(
            ((case.name, case) for case in cases()),
            measure,
            lambda title, case, row: " | ".join(cells(case, row)),
        )
    ]
    rows.write({"defaults": Table("", HEAD, table)})


if __name__ == "__main__":
    run()
