"""Images and gradients of a variant of Mitsuba, compared with those of another one.

    python -m experiments.validation.backends.run VARIANT [--than FOLDER] [--only TEXT] [-o FOLDER]

The scenes are those of `experiments.validation.lamps`, `objects`, `glass` and `gradients`, with
equal seeds, so that images differ by rounding only. Run it with ``llvm_ad_rgb``, copy the folder
to a machine with a GPU if necessary, and run it there with ``cuda_ad_rgb --than FOLDER``. It prints
the RMSE and the largest difference in % of the mean magnitude, and the seconds of the first
rendering, which compiles kernels, and of the second one.

Results are saved in output/backends/VARIANT, one file per scene. No data are needed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

if TYPE_CHECKING:  # these modules are imported when a variant is set
    from experiments.validation.gradients.cases import Case

PIXELS, SPP = 48, 32


def scenes() -> Iterator[tuple[str, Callable[[], mi.Scene]]]:
    """Yield names and loaders of scenes whose images are compared."""
    from experiments.validation.glass import cases as glass
    from experiments.validation.lamps import cases as lamps
    from experiments.validation.objects import cases as objects
    from experiments.validation.thick.cases import scene

    def loaded(module, name: str) -> mi.Scene:
        found, depth = module.build(name)
        return mi.load_dict(scene(found, {"type": "irrcache", "max_depth": depth}, PIXELS))

    for module in (lamps, objects):
        for name in module.CASES:
            yield name, lambda module=module, name=name: loaded(module, name)
    for name in glass.CASES:
        yield name, lambda name=name: glass.build(name, {"type": "irrcache"}, PIXELS)


def images(load: Callable[[], mi.Scene]) -> dict[str, np.ndarray]:
    """Render a scene twice; return the image and the times [s]."""
    scene, seconds = load(), []
    for _ in range(2):
        begun = time.perf_counter()
        image = np.array(mi.render(scene, spp=SPP, seed=1))
        seconds.append(time.perf_counter() - begun)
    return {"image": image, "seconds": np.array(seconds)}


def gradients(case: Case) -> dict[str, np.ndarray]:
    """Return the gradients of a case by the parameters that it names, and the time [s]."""
    from experiments.validation.gradients import differences

    begun, scene = time.perf_counter(), case.load()
    weights = differences.pixel_weights(scene)
    found = differences.gradients(scene, case.parameters, weights)
    seconds = time.perf_counter() - begun
    return {key: np.array(value) for key, value in found.items()} | {"seconds": np.array([seconds])}


def compared(mine: dict[str, np.ndarray], theirs: Path) -> str:
    """Return a text with the differences of all arrays from those of a file."""
    if not theirs.is_file():
        return "nothing to compare with"
    texts = []
    with np.load(theirs) as other:
        for key in mine.keys() - {"seconds"}:
            x, y = np.float64(mine[key]), np.float64(other[key])
            scale = max(np.abs(y).mean(), 1e-30)
            rmse, largest = np.sqrt(np.square(x - y).mean()), np.abs(x - y).max()
            texts.append(
                f"{key}: RMSE {100 * rmse / scale:.3f} %, max {100 * largest / scale:.2f} %"
            )
    return "; ".join(sorted(texts))


def main() -> None:
    """Parse the arguments, render, and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("variant")
    parser.add_argument("--than", type=Path, help="folder of the results of another variant")
    parser.add_argument("--only", default="", help="part of the names of scenes")
    parser.add_argument("-o", "--output", type=Path, default=Path("output/backends"))
    args = parser.parse_args()

    mi.set_variant(args.variant)
    import mitsuba_irrcache  # noqa: F401 (registers the plugin)
    from experiments.validation.gradients.cases import CASES

    tasks = {name: lambda load=load: images(load) for name, load in scenes()}
    tasks |= {
        f"gradients, {name}": lambda case=case: gradients(case) for name, case in CASES.items()
    }
    folder = args.output / args.variant
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, task) in enumerate(tasks.items()):
        if args.only not in name:
            continue
        found, file = task(), f"{number:03}.npz"
        np.savez_compressed(folder / file, **found)
        seconds = ", ".join(f"{s:.2f} s" for s in found["seconds"])
        difference = f" | {compared(found, args.than / file)}" if args.than else ""
        print(f"{name} | {seconds}{difference}", flush=True)


if __name__ == "__main__":
    main()
