"""Test that the filter fades out: never worse than no filter, and close to the better of none
and a filter of fixed strength.

    python -m experiments.paper.fading.run [--full] [--force]

One cache of the chest is refined; after each pass it is rendered without a filter, with one of
fixed strength and with the fading one, all with the same camera samples, so that only the filter
differs. Figure 2 has the same methods against time. Writes output/fading/results.json.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support import methods
from experiments.support.analysis import difference_of_squares, judge
from experiments.support.options import Options, parse
from experiments.support.recording import Subject
from experiments.support.store import Store
from mitsuba_irrcache.compare import metrics
from mitsuba_irrcache.compare.reference import Reference
from mitsuba_irrcache.io.scene_files import load_scene

#: Samples per cache voxel: 1, 4, 16 and 64 passes.
SAMPLES = (16, 64, 256, 1024)
#: A coarse cache has few enough voxels for this many samples, and equal noise in each.
RESOLUTION = 48
PIXEL_SAMPLES = 64


def run(options: Options) -> None:
    """Measure all numbers of samples unless that is done."""
    folder = options.folder("fading")
    subject = Subject.of("chest", options)
    truth = subject.reference(options.output, options.size.reference)
    store = Store(folder / "results.json", options.force)
    store.row("chest", partial(refine, subject, truth, folder / "chest.cache"))


def refine(subject: Subject, truth: Reference, file: Path) -> dict:
    """Compute a row for each number of samples of a cache that is stored in ``file``."""
    file.unlink(missing_ok=True)
    rows = []
    for count in SAMPLES:
        print(f"fading: {count} samples per voxel", flush=True)
        cache = {"resolution": RESOLUTION, "cache_spp": count, "cache_file": file}
        images = [
            render(subject, methods.specify(method.integrator, **cache))
            for method in (methods.CACHE, methods.FIXED, methods.FADING)
        ]
        rows.append({"samples": count} | judged(images, truth))
    file.unlink()
    return {"rows": rows}


def render(subject: Subject, integrator: str) -> np.ndarray:
    """Render an image with `PIXEL_SAMPLES` samples, always the same ones."""
    scene = load_scene(subject.scene, subject.parameters, integrator)
    return np.array(mi.render(scene, spp=PIXEL_SAMPLES), dtype=np.float64)


def judged(images: list[np.ndarray], truth: Reference) -> dict:
    """Return errors in units of the mean radiance, and the verdict on them."""
    a, b = metrics.colours(truth.a), metrics.colours(truth.b)
    mean = float(truth.mean.mean())
    unfiltered, fixed, fading = (metrics.net_rmse(image, a, b) / mean for image in images)
    difference, uncertainty = difference_of_squares(images[2], images[0], a, b)
    return {
        "unfiltered": unfiltered,
        "fixed": fixed,
        "fading": fading,
        "difference": difference / mean**2,
        "uncertainty": uncertainty / mean**2,
    } | asdict(judge(unfiltered, fixed, fading, difference, uncertainty))


if __name__ == "__main__":
    run(parse(__doc__))
