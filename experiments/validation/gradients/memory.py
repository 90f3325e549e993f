"""Resident memory of a long fit: 16^3 voxels, two views of 32 x 32 pixels, by Adam.

    python -m experiments.validation.gradients.memory [--steps 500]

The fit starts from an even extinction under a sun.
"""

from __future__ import annotations

import argparse
from time import process_time

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil

from experiments.support.options import begin
from experiments.validation.gradients.cases import SUN, Case
from experiments.validation.gradients.differences import first_key
from mitsuba_irrcache.gradients.fit import fit
from mitsuba_irrcache.gradients.fit_state import Result, Settings, View

#: Steps after which memory is printed.
MARKS = (10, 50, 100, 200, 350, 500)


def main() -> None:
    """Print steps, memory, loss and CPU time."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=500)
    steps = parser.parse_args().steps
    begin()
    mi.set_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    scene, film = Case(emitters=lambda: {"sun": SUN}).load(), {"type": "hdrfilm"}
    film |= {"width": 32, "height": 32, "rfilter": {"type": "box"}}
    views = []
    for origin in ([5.0, 1.0, 0.0], [0.0, 2.0, 5.0]):
        look = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])
        own = {"type": "perspective", "fov": 34.0, "to_world": look, "film": film}
        sensor = mi.load_dict(own)
        views.append(View(sensor, np.array(mi.render(scene, sensor=sensor, spp=16))))
    params = mi.traverse(scene)
    key = first_key(params, "sigma_t")
    params[key] = dr.full(mi.TensorXf, 0.3, params[key].shape)
    params.update()
    process = psutil.Process()

    def report(result: Result) -> None:
        if result.step in MARKS or result.step == steps:
            size, loss = process.memory_info().rss / 2**20, result.history[-1][1]
            print(f"{result.step:4} {size:6.0f} MiB  loss {loss:.2e}  {process_time():.0f} s CPU")

    fit(scene, views, ["sigma_t"], Settings(steps, "adam"), report=report)


if __name__ == "__main__":
    main()
