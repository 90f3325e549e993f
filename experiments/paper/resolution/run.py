"""A cache that is coarser than the data: error, time and memory.

    python -m experiments.paper.resolution.run [--full] [--force]

Varies the cache voxels along the longest side of the chest, with equal samples per voxel, and with
equal samples in all. Writes output/resolution/results.json.
"""

from __future__ import annotations

from functools import partial

from experiments.paper.memory.peak import measure_peak
from experiments.support.cached import measure
from experiments.support.methods import specify
from experiments.support.options import FULL, Options, parse
from experiments.support.recording import Subject
from experiments.support.store import Store
from mitsuba_irrcache.cache.statistics import BATCH

QUICK_RESOLUTIONS = (16, 32, 64, 96)
FULL_RESOLUTIONS = (16, 32, 64, 96, 128)
#: Samples per voxel if these are equal.
SAMPLES = 16


def run(options: Options) -> None:
    """Measure missing rows."""
    store = Store(options.folder("resolution") / "results.json", options.force)
    subject = Subject.of("chest", options)
    truth = subject.reference(options.output, options.size.reference)
    resolutions = FULL_RESOLUTIONS if options.size == FULL else QUICK_RESOLUTIONS

    def row(kind: str, resolution: int, samples: int) -> dict:
        print(f"resolution: {resolution}, {samples} samples per voxel", flush=True)
        properties = {"solver": "path", "resolution": resolution, "cache_spp": samples}
        errors = measure(subject.scene, subject.parameters, truth, **properties)
        return {"kind": kind, "resolution": resolution} | errors

    def peak(resolution: int) -> dict:
        integrator = specify("irrcache{solver=path}", resolution=resolution, cache_spp=BATCH)
        pixels = options.size.pixels
        return {"resolution": resolution, "bytes": measure_peak(subject.scene, pixels, integrator)}

    found = [
        store.row(f"voxel {n}", partial(row, "equal samples per voxel", n, SAMPLES))
        for n in resolutions
    ]
    total = BATCH * found[-1]["active_voxels"]
    for n, other in zip(resolutions, found, strict=True):
        samples = BATCH * max(1, round(total / other["active_voxels"] / BATCH))
        store.row(f"total {n}", partial(row, "equal samples in all", n, samples))
        store.row(f"peak {n}", partial(peak, n))


if __name__ == "__main__":
    run(parse(__doc__))
