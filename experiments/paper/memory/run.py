"""Memory against the size of the volume and of the image.

    python -m experiments.paper.memory.run [--full] [--force]

Peak memory of a process that renders one image of a thorax phantom, with a cache as fine as the
data; a process for each method and size. Writes output/memory/results.json.
"""

from __future__ import annotations

import subprocess
from functools import partial
from pathlib import Path

from experiments.paper.memory.peak import measure_peak
from experiments.support import methods
from experiments.support.options import FULL, Options, parse
from experiments.support.scenes import scene_file
from experiments.support.store import Store
from mitsuba_irrcache.io.mitsuba_vol import read_vol

#: Voxels along the longest side and pixels per side: one varies while the other is constant.
QUICK_SIZES = ((48, 128), (96, 128), (144, 128), (48, 512), (48, 1024))
FULL_SIZES = ((64, 256), (128, 256), (192, 256), (256, 256), (64, 1024), (64, 2048))


def run(options: Options) -> None:
    """Measure missing rows; a method that cannot run is omitted."""
    store = Store(options.folder("memory") / "results.json", options.force)
    for longest, pixels in FULL_SIZES if options.size == FULL else QUICK_SIZES:
        scene = scene_file("phantom", options.output, longest)
        for method in methods.PAPER:
            try:
                store.row(
                    f"{method.name} {longest} {pixels}",
                    partial(measure, method, scene, longest, pixels),
                )
            except subprocess.CalledProcessError as error:
                print(f"memory: {method.integrator} ended with status {error.returncode}")


def measure(method: methods.Method, scene: Path, longest: int, pixels: int) -> dict:
    """Return a row: the sizes, and bytes at the peak."""
    print(f"memory: {method.label}, {longest} voxels, {pixels} pixels", flush=True)
    integrator = method.integrator
    if method is not methods.PATH_TRACING:
        integrator = methods.specify(integrator, resolution=longest, cache_spp=8)
    return {
        "label": method.label,
        "voxels": read_vol(scene.parent / "sigma_t.vol")[0].size,
        "pixels": pixels**2,
        "bytes": measure_peak(scene, pixels, integrator),
    }


if __name__ == "__main__":
    run(parse(__doc__))
