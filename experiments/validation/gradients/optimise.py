"""A density from eight views, with this integrator and with ``prbvolpath``.

    python -m experiments.validation.gradients.optimise [--seconds 24] [--voxels 24] [--volume FILE]

Adam fits the extinction of a cube, or that of a ``--volume`` (.vol) in means over its voxels, under
a sky and a sun, from a start without structure. Prints the error of two views that the optimisation
does not see, relative to their mean, against CPU time; ``prbvolpath`` with several numbers of
samples and step sizes, of which the best counts. The same by ``fit`` with L-BFGS and with Adam, and
then the error of the extinction, relative to its mean.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from time import process_time

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.support.options import begin
from experiments.validation.gradients.cases import EDGE, SKY, SUN, Case
from experiments.validation.gradients.differences import key_of
from mitsuba_irrcache.gradients.fit import fit as run_fit
from mitsuba_irrcache.gradients.fit_state import Result, Settings, View
from mitsuba_irrcache.io.mitsuba_vol import read_vol

VIEWS, UNSEEN = 8, 2
SIZE = 64


@dataclass(frozen=True)
class Method:
    """An integrator, camera samples of each pixel, the step size of Adam relative to the largest
    extinction, and the directions of the cache (0: the default).
    """

    integrator: str
    spp: int
    rate: float
    directions: int = 0


METHODS = (
    Method("irrcache", 4, 0.02),
    Method("irrcache", 4, 0.05),
    Method("irrcache", 4, 0.1),
    Method("irrcache", 4, 0.1, 32),
    Method("prbvolpath", 4, 0.005),
    Method("prbvolpath", 4, 0.02),
    Method("prbvolpath", 16, 0.02),
    Method("prbvolpath", 16, 0.05),
    Method("prbvolpath", 64, 0.05),
)


@dataclass(frozen=True)
class RealCase(Case):
    """A case whose density is that of a ``file``, in means over blocks of its voxels."""

    file: str = ""

    def sigma_t(self) -> np.ndarray:
        """Extinction (z, y, x, channel)."""
        values = read_vol(self.file)[0][..., 0]
        longest = max(values.shape)
        ends = np.linspace(0, longest, self.data + 1).round().astype(int)
        gaps = [((longest - n) // 2, longest - n - (longest - n) // 2) for n in values.shape]
        values = np.pad(values, gaps).astype(np.float64)
        for axis in range(3):
            sums = np.add.reduceat(values, ends[:-1], axis=axis)
            values = sums / np.diff(ends).reshape([-1 if a == axis else 1 for a in range(3)])
        values *= self.depth * self.data / EDGE / values.max()
        return values[..., None].astype(np.float32)


def main() -> None:
    """Run all methods."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--voxels", type=int, default=24)
    parser.add_argument("--seconds", type=float, default=24.0, help="CPU time of each method")
    parser.add_argument("--volume", default="", metavar="FILE", help="a .vol of the density")
    parser.add_argument("--methods", default="", help="part of the names of integrators to run")
    options = parser.parse_args()
    begin()
    mi.set_variant("llvm_ad_mono")
    mi.set_log_level(mi.LogLevel.Error)
    settings = {
        "depth": 8.0 / options.voxels,
        "albedo": (0.82,),
        "emitters": lambda: {"sky": SKY, "sun": SUN},
    }
    case = Case(options.voxels, options.voxels, **settings)
    if options.volume:
        case = RealCase(options.voxels, options.voxels, file=options.volume, **settings)
    scene = case.load(type="volpath", max_depth=-1)
    truth = [np.array(mi.render(scene, sensor=view, spp=512)) for view in views()]
    for method in METHODS:
        if options.methods not in f"{method.integrator} {method.spp} {method.rate}":
            continue
        marks = fit(case, method, truth, options.seconds)
        text = ", ".join(f"{error:.3f} after {time:.0f} s" for time, error in marks)
        name = f"{method.integrator}{{cache_spp={method.directions}}}"
        print(f"{name:24} spp {method.spp:2} rate {method.rate:5}: {text}", flush=True)
    for own in (Settings(40), Settings(40, "adam", rate=0.4)):
        marks, density = by_fit(case, own, truth)
        text = ", ".join(f"{error:.4f} after {time:.0f} s" for time, error in marks)
        error = np.sqrt(np.mean(np.square(density - case.sigma_t()))) / case.sigma_t().mean()
        print(f"fit, {own.method}: {text}; extinction {error:.2f}", flush=True)


def sensor(number: int) -> dict:
    """A sensor around the medium, without a film."""
    turn, height = 2 * np.pi * (number * 0.618), 0.8 * np.cos(2.4 * number)
    origin = 5 * np.array([np.cos(turn), height, np.sin(turn)]) / np.hypot(1, height)
    look = mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 32.0, "to_world": look}


def film(count: int) -> dict:
    """A film for so many views beside each other."""
    size = {"width": SIZE * count, "height": SIZE}
    form = {"component_format": "float32", "rfilter": {"type": "box"}}
    return {"film": {"type": "hdrfilm"} | size | form}


def views() -> list[mi.Sensor]:
    """All sensors; the last ones are those that are not fitted."""
    return [mi.load_dict(sensor(number) | film(1)) for number in range(VIEWS + UNSEEN)]


def together() -> mi.Sensor:
    """The views that are fitted in one image: they share one cache and one adjoint solve."""
    return mi.load_dict(
        {"type": "batch"} | film(VIEWS) | {f"view{i}": sensor(i) for i in range(VIEWS)}
    )


def fit(case: Case, method: Method, truth: list, seconds: float) -> list[tuple[float, float]]:
    """Times and errors of unseen views."""
    own = {"type": method.integrator, "max_depth": -1}
    if method.integrator == "irrcache":  # all views at once; else one of them for each step
        own |= {"solver": "sweep", "resolution": case.cache, "cache_spp": method.directions}
        sensors = [together()]
        targets = [mi.TensorXf(np.concatenate(truth[:VIEWS], axis=1))]
    else:
        sensors, targets = views()[:VIEWS], [mi.TensorXf(image) for image in truth[:VIEWS]]
    scene = case.load(**own)
    params, peak = mi.traverse(scene), float(case.sigma_t().max())
    key = key_of(params, "sigma_t")
    optimizer = mi.ad.Adam(lr=method.rate * peak)
    optimizer[key] = dr.full(mi.TensorXf, 0.1 * peak, params[key].shape)
    params.update(optimizer)
    marks, spent, step, following = [], 0.0, 0, seconds / 4
    while spent < seconds:
        begun, number = process_time(), step % len(sensors)
        view = sensors[number]
        image = mi.render(scene, params, sensor=view, spp=method.spp, seed=step)
        dr.backward(dr.mean(dr.square(image - targets[number])))
        optimizer.step()
        optimizer[key] = dr.clip(optimizer[key], 0, 3 * peak)
        params.update(optimizer)
        dr.eval(params[key])
        dr.sync_thread()
        spent, step = spent + (process_time() - begun if step else 0.0), step + 1
        if spent >= following:
            marks.append((spent, unseen_error(case, params[key], truth)))
            following += seconds / 4
    return marks


def by_fit(
    case: Case, settings: Settings, truth: list
) -> tuple[list[tuple[float, float]], np.ndarray]:
    """Times and errors of unseen views, and the extinction that `fit` ends with."""
    scene, marks, spent = case.load(), [], [0.0, process_time()]
    params, peak = mi.traverse(scene), float(case.sigma_t().max())
    key = key_of(params, "sigma_t")
    params[key] = dr.full(mi.TensorXf, 0.1 * peak, params[key].shape)
    params.update()

    def report(result: Result) -> None:
        spent[0] += process_time() - spent[1]
        if result.step % (settings.steps // 4) == 0:
            density = mi.TensorXf(result.values["sigma_t"])
            marks.append((spent[0], unseen_error(case, density, truth)))
        spent[1] = process_time()

    seen = [View(view, image) for view, image in zip(views()[:VIEWS], truth, strict=False)]
    result = run_fit(scene, seen, ["sigma_t"], settings, report=report)
    return marks, result.values["sigma_t"]


def unseen_error(case: Case, density: mi.TensorXf, truth: list) -> float:
    """Relative error of the images of a ``density`` that were not fitted, by volpath."""
    scene = case.load(type="volpath", max_depth=-1)
    params = mi.traverse(scene)
    params[key_of(params, "sigma_t")] = dr.detach(density)
    params.update()
    errors = [
        np.array(mi.render(scene, sensor=view, spp=256)) - image
        for view, image in zip(views()[VIEWS:], truth[VIEWS:], strict=True)
    ]
    return float(np.sqrt(np.mean(np.square(errors))) / np.mean(truth[VIEWS:]))


if __name__ == "__main__":
    main()
