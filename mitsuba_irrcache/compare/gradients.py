"""Error of gradients against CPU time, of any integrators with ``render_backward``.

    python -m mitsuba_irrcache.compare.gradients scene.xml -p sigma_t -i irrcache{solver=sweep}
        -i prbvolpath --reference irrcache{solver=sweep,cache_spp=1024} --budget 1,4

The objective is the mean of an image. Gradients with new seeds are averaged until each time is
spent; the first one includes the cache of an integrator that has one. The reference is an average
of gradients in two independent halves, whose noise is no part of the errors; those of irrcache have
caches of their own. Errors are relative to the root mean square of the reference: voxel by voxel,
and of means over blocks of voxels, which noise affects less.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.argument_types import whole
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.scene_files import key_of, parse_parameters, unknown_properties
from mitsuba_irrcache.machine.variants import select_variant

from .command import budgets_of
from .metrics import net_mse, root
from .runners import Subject
from .tables import Table, percent, seconds

#: Edge of the blocks of voxels.
BLOCK = 4
#: First seeds of the halves of the reference.
HALVES = (1_000_000_000, 2_000_000_000)


@dataclass(frozen=True)
class GradientErrors:
    """Errors after a number of ``seconds`` of CPU time, relative to the reference.

    Attributes:
        error: root mean square over voxels; the root of a negative estimate is negative.
        uncertainty: standard error of ``error``, for independent voxels.
        blocks: error of means over blocks; NaN if the parameter is no grid of several blocks.
    """

    seconds: float
    error: float
    uncertainty: float
    blocks: float


def gradient(
    scene: mi.Scene, name: str, spp: int, seed: int, sensor: int = 0
) -> tuple[np.ndarray, float]:
    """Return the gradient of the mean of an image, and the CPU time for both.

    ``name`` abbreviates the parameter as in `key_of`.
    """
    params = mi.traverse(scene)
    key, begun = key_of(params, name), process_time()
    found = gradients_of(scene, params, [key], dr.mean, sensor=sensor, spp=spp, seed=seed)
    return found[key], process_time() - begun


def gradients_of(
    scene: mi.Scene,
    params: mi.SceneParameters,
    keys: Sequence[str],
    objective: Callable[[mi.TensorXf], mi.Float],
    **options: int,
) -> dict[str, np.ndarray]:
    """Return the gradients of an ``objective`` of the image with respect to the parameters of these
    ``keys``; ``options`` are those of `mi.render`. Afterwards the parameters have no gradients.
    """
    # Environments keep another array than they are given.
    leaves = {key: type(params[key])(dr.detach(params[key])) for key in keys}
    for key, leaf in leaves.items():
        dr.enable_grad(leaf)
        params[key] = leaf
    params.update()
    dr.backward(objective(mi.render(scene, params, **options)))
    found = {key: np.array(dr.grad(leaf), dtype=np.float64) for key, leaf in leaves.items()}
    for key, leaf in leaves.items():
        params[key] = dr.detach(leaf)
    params.update()
    return found


def averages(
    subject: Subject, name: str, spp: int, budgets: Sequence[float]
) -> Iterator[tuple[float, np.ndarray]]:
    """Average gradients until each of the ``budgets`` is spent; yield times and averages."""
    gradient(subject.load(), name, spp, 0, subject.sensor)  # compiles the kernels
    scene, total, count, spent = subject.load(), 0.0, 0, 0.0
    for budget in budgets:
        while spent < budget:
            count += 1
            found, own = gradient(scene, name, spp, count, subject.sensor)
            total, spent = total + found, spent + own
        yield spent, total / count


def reference_halves(
    subject: Subject, name: str, spp: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return two independent averages of ``count`` gradients each."""
    halves = []
    for first in HALVES:
        found = []
        for number in range(count):
            own = {"cache_seed": (first + number) & 0xFFFFFFFF}
            named = subject.specification(**own)
            scene = subject.load(**({} if "cache_seed" in unknown_properties(named) else own))
            found.append(gradient(scene, name, spp, first + number, subject.sensor)[0])
        halves.append(np.mean(found, axis=0))
    return halves[0], halves[1]


def errors(found: np.ndarray, a: np.ndarray, b: np.ndarray, spent: float) -> GradientErrors:
    """Return the errors of a gradient against the halves ``a`` and ``b`` of the reference.

    Raises IrrcacheError if the reference is noise.
    """
    scale = float(np.mean(a * b))
    if not scale > 0:
        raise IrrcacheError(
            "the halves of the reference have nothing in common: take more --reference-gradients."
        )
    square, noise = net_mse(found, a, b)
    error = root(square / scale)
    uncertainty = noise / scale / (2 * abs(error)) if error else float("inf")
    own = [_block_means(values) for values in (found, a, b)]
    blocks = float("nan")
    if own[0].size > found.shape[-1]:
        blocks = root(net_mse(*own)[0] / float(np.mean(own[1] * own[2])))
    return GradientErrors(spent, error, uncertainty, blocks)


def _block_means(values: np.ndarray) -> np.ndarray:
    """Return means over blocks of a grid (z, y, x, channel); incomplete ones are ignored."""
    if values.ndim != 4:
        return values[..., :0].reshape(-1)
    counts = [n // BLOCK for n in values.shape[:3]]
    cropped = values[tuple(slice(n * BLOCK) for n in counts)]
    split = [size for n in counts for size in (n, BLOCK)]
    return cropped.reshape(*split, values.shape[3]).mean(axis=(1, 3, 5))


def table(
    subjects: Sequence[Subject],
    reference: Subject,
    name: str,
    spp: int,
    budgets: Sequence[float],
    gradients: int,
) -> Table:
    """Return the errors of all ``subjects`` after each of the ``budgets``.

    The ``reference`` has 2 x ``gradients`` gradients; all have ``spp`` samples per pixel.
    """
    halves, rows = reference_halves(reference, name, spp, gradients), []
    for subject in subjects:
        for spent, found in averages(subject, name, spp, budgets):
            own = errors(found, *halves, spent)
            cells = f"{percent(own.error)} ± {percent(own.uncertainty)}", percent(own.blocks)
            rows.append([subject.integrator, seconds(own.seconds), *cells])
    head = ["integrator", "CPU s", "error by voxel", f"error of means over {BLOCK}^3 voxels"]
    note = f"Reference: {2 * gradients} gradients by {reference.integrator}."
    return Table(f"Gradients by {name}", head, rows, note)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", help="scene XML")
    parser.add_argument("-p", "--parameter", default="sigma_t", help="as for irrcache fit")
    parser.add_argument("-i", "--integrator", action="append", required=True)
    parser.add_argument("--reference", required=True, help="integrator of the reference")
    parser.add_argument("--reference-gradients", type=whole(1), default=4, metavar="N")
    parser.add_argument("--spp", type=whole(1), default=64, help="samples per pixel")
    parser.add_argument("--budget", default="1,4", metavar="SECONDS,...")
    parser.add_argument("-s", "--sensor", type=whole(0), default=0)
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="variant of Mitsuba")
    parser.add_argument("-D", "--define", action="append", default=[], metavar="KEY=VALUE")
    options = parser.parse_args(arguments)
    select_variant(options.mode)
    mi.set_log_level(mi.LogLevel.Error)
    *subjects, reference = (
        Subject(Path(options.scene), parse_parameters(options.define), own, options.sensor)
        for own in (*options.integrator, options.reference)
    )
    budgets, count = budgets_of(options.budget), options.reference_gradients
    found = table(subjects, reference, options.parameter, options.spp, budgets, count)
    print(f"{found.as_text()}\n{found.note}")


if __name__ == "__main__":
    main()
