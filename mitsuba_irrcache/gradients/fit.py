"""Fit parameters of a scene to images of it, by Adam or L-BFGS.

    views = [View(sensor, image) for sensor, image in zip(scene.sensors(), images)]
    result = fit(scene, views[:-1], ["sigma_t"], held_out=views[-1:])
    result.values["sigma_t"]  # (z, y, x, channel)

D. P. Kingma and J. Ba, *Adam: A Method for Stochastic Optimization*, ICLR 2015; R. H. Byrd, P. Lu,
J. Nocedal and C. Zhu, *A Limited Memory Algorithm for Bound Constrained Optimization*, SIAM Journal
on Scientific Computing 16, 1995 (SciPy's L-BFGS-B).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.fit_ranges import Range, Ranges, check_parameter
from mitsuba_irrcache.gradients.fit_state import (
    LOSSES,
    Result,
    Settings,
    View,
    comparable_colours,
    in_colours,
)
from mitsuba_irrcache.io.scene_files import key_of
from mitsuba_irrcache.machine.extras import require

#: Directions of the cache, if the integrator does not set ``cache_spp``, by the fraction of all
#: steps from which each number is used. Early steps do not need exact gradients.
DIRECTIONS = ((0.0, 32), (0.6, 64), (0.85, 128))
#: Directions of the cache for L-BFGS: the same in all steps, since a line search compares values of
#: one objective.
LBFGS_DIRECTIONS = 64
#: Adam: decay rates of both moments, epsilon, and ratio of the last step size to the first.
DECAY, EPSILON, LAST_RATE = (0.9, 0.99), 1e-8, 0.1


def fit(
    scene: mi.Scene,
    views: Sequence[View],
    names: Sequence[str],
    settings: Settings | None = None,
    held_out: Sequence[View] = (),
    start: Result | None = None,
    report: Callable[[Result], None] | None = None,
    every: int = 10,
) -> Result:
    """Fit the parameters of ``scene`` with the given ``names`` (see `key_of`) to ``views``.

    The scene's integrator is ``irrcache`` or one of Mitsuba's that have gradients.

    The fit starts from the scene's current values, or from those of ``start``, a result of fewer
    steps with the same settings, and leaves the last values in the scene. ``report`` is called
    after each step; the error of ``held_out`` views is computed every ``every`` steps. An exception
    raised by ``report`` ends the fit. Equal settings give bit-identical results, also when the fit
    continues from ``start``, except with L-BFGS, whose history is not part of a result.

    Raises IrrcacheError if a parameter or an image does not fit the scene, or has no gradients.
    """
    run = _Fit(scene, views, names, settings or Settings(), held_out, start, report, every)
    return run.with_adam() if run.settings.method == "adam" else run.with_lbfgs()


class _Fit:
    """A fit in progress; the arguments are those of `fit`."""

    def __init__(
        self,
        scene: mi.Scene,
        views: Sequence[View],
        names: Sequence[str],
        settings: Settings,
        held_out: Sequence[View],
        start: Result | None,
        report: Callable[[Result], None] | None,
        every: int,
    ) -> None:
        self.scene, self.settings = scene, settings
        self._report, self._every = report or (lambda result: None), every
        self._params = mi.traverse(scene)
        self._keys = {name: key_of(self._params, name) for name in names}
        if not views or not names:
            raise IrrcacheError("fit: give at least one view and one parameter.")
        if settings.views > len(views):
            raise IrrcacheError(
                f"fit: views is {settings.views}, but {len(views)} image(s) are to be fitted; set "
                "it to at most that number, or to 0 for all of them."
            )
        integrator = scene.integrator()
        has_cache = hasattr(integrator, "cache_spp")
        if not (has_cache or isinstance(integrator, mi.CppADIntegrator)):
            raise IrrcacheError(
                f"fit: the scene's integrator is {integrator.class_name()}, which has no "
                "gradients; use irrcache."
            )
        self._chooses_directions = has_cache and integrator.cache_spp == 0
        for key in self._keys.values():
            check_parameter(self._params, key, has_cache)
        self._kinds = {name: type(self._params[key]) for name, key in self._keys.items()}
        first = {n: np.array(self._params[k], dtype=np.float32) for n, k in self._keys.items()}
        ranges = Ranges(scene, self._params, has_cache, settings.scale)
        self._ranges = {name: ranges.of(key, first[name]) for name, key in self._named()}
        first = {name: self._ranges[name].nearest(value) for name, value in first.items()}
        self.result = start or Result(0, first)
        if start is not None:
            self._check_start(start, first)
        if start is not None and has_cache:
            # The grid of the cache follows from the first values, and stays.
            integrator.prepare(scene)
        self._views = [self._target(view) for view in views]
        self._held_out = [self._target(view) for view in held_out]
        # Losses have the units of these.
        units = {"l2": np.square, "l1": np.abs, "relative": np.ones_like}[settings.loss]
        level = np.mean([units(np.array(image, np.float64)).mean() for _, image in self._views])
        self._smoothness = settings.smoothness * float(level)

    def _named(self) -> list[tuple[str, str]]:
        return list(self._keys.items())

    def _check_start(self, start: Result, first: dict[str, np.ndarray]) -> None:
        shapes = {name: value.shape for name, value in first.items()}
        found = {name: value.shape for name, value in start.values.items()}
        if shapes != found:
            raise IrrcacheError(f"fit: the start has parameters {found}, the scene has {shapes}.")

    def _target(self, view: View) -> tuple[mi.Sensor, mi.TensorXf]:
        film = view.sensor.film()
        size = film.crop_size()
        image = np.asarray(view.image, dtype=np.float32)
        if image.ndim != 3 or image.shape[:2] != (int(size.y), int(size.x)):
            raise IrrcacheError(
                f"fit: {view.name} has shape {image.shape}, but the film of its sensor is "
                f"{int(size.x)} x {int(size.y)} pixels; scale one of them."
            )
        if not np.isfinite(image).all():
            raise IrrcacheError(f"fit: {view.name} has pixels that are NaN or infinite; clean it.")
        if "pixel_format = xyz" in str(film):  # no other sign of it
            raise IrrcacheError(
                f"fit: {view.name} is compared with a film whose pixel_format is xyz or xyza, but "
                'images are RGB or luminance; set pixel_format to "rgb" or "luminance".'
            )
        film.prepare([])
        count = film.develop().shape[2]
        colours = comparable_colours(count, image.shape[2])
        if not colours:
            raise IrrcacheError(
                f"fit: {view.name} has {image.shape[2]} channel(s), but the film of its sensor has "
                f"{count}; both need 1 (luminance) or 3 (RGB), or one more for alpha."
            )
        return view.sensor, in_colours(mi.TensorXf(image), colours)

    # Images

    def _set(self, values: dict[str, np.ndarray], attached: bool) -> dict[str, object]:
        """Assign ``values`` to the parameters, with gradients enabled if ``attached``; return the
        parameters by name.
        """
        for name, key in self._named():
            value = values[name].astype(np.float32)
            # Not from NumPy's memory, which would be borrowed.
            self._params[key] = dr.copy(self._kinds[name](value))
            if attached:
                dr.enable_grad(self._params[key])
        self._params.update()
        return {name: self._params[key] for name, key in self._named()}

    def _objective(
        self, values: dict[str, np.ndarray], views: list[tuple], seed: int
    ) -> tuple[float, dict[str, np.ndarray]]:
        """Return the loss and its gradient. All images share one cache and one adjoint solve."""
        leaves, settings = self._set(values, attached=True), self.settings
        function, total = LOSSES[settings.loss], 0.0
        for number, (sensor, target) in enumerate(views):
            own = (seed * len(views) + number) & 0x7FFFFFFF
            image = mi.render(self.scene, self._params, sensor=sensor, spp=settings.spp, seed=own)
            total += dr.mean(function(in_colours(image, target.shape[2]), target)) / len(views)
        dr.backward(total)
        loss, gradient = float(np.array(total).item()), {}
        for name, leaf in leaves.items():
            gradient[name] = np.array(dr.grad(leaf), dtype=np.float64).reshape(values[name].shape)
            roughness, change = _roughness(values[name] / self._ranges[name].scale)
            loss += self._smoothness * roughness
            gradient[name] += self._smoothness / self._ranges[name].scale * change
        return loss, gradient

    def _held_out_error(self) -> float:
        """Return the root mean square error of the held-out views, relative to their mean."""
        if not self._held_out:
            return math.nan
        square = mean = 0.0
        for sensor, target in self._held_out:
            image = mi.render(self.scene, sensor=sensor, spp=self.settings.spp)
            target = np.array(target, dtype=np.float64)
            square += np.mean(np.square(np.array(in_colours(image, target.shape[2])) - target))
            mean += np.mean(target)
        count = len(self._held_out)
        return float(np.sqrt(square / count) / max(mean / count, 1e-30))

    def _step_done(self, loss: float) -> None:
        result, settings = self.result, self.settings
        result.step += 1
        last = result.step == settings.steps
        error = math.nan
        if last or result.step % self._every == 0:
            self._set(result.values, attached=not last)
            error = self._held_out_error()
        result.history.append((result.step, loss, error))
        self._report(result)

    # Methods

    def with_adam(self) -> Result:
        settings, result = self.settings, self.result
        while result.step < settings.steps:
            done = result.step / settings.steps
            if self._chooses_directions:
                self.scene.integrator().cache_spp = max(n for s, n in DIRECTIONS if s <= done)
            loss, gradient = self._objective(result.values, self._chosen(result.step), result.step)
            _check_finite(loss, gradient, result.step)
            rate = settings.rate * (
                LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * done))
            )
            for name, value in result.values.items():
                step = self._adam_step(name, gradient[name] * self._ranges[name].scale)
                changed = value - rate * self._ranges[name].scale * step
                result.values[name] = self._ranges[name].nearest(changed)
            self._step_done(loss)
        return result

    def _adam_step(self, name: str, gradient: np.ndarray) -> np.ndarray:
        zero = np.zeros_like(gradient)
        first, second = self.result.moments.get(name, (zero, zero))
        (a, b), count = DECAY, self.result.step + 1
        first, second = a * first + (1 - a) * gradient, b * second + (1 - b) * gradient**2
        self.result.moments[name] = first, second
        scale = np.sqrt(second / (1 - b**count)) + EPSILON
        return first / (1 - a**count) / scale

    def _chosen(self, step: int) -> list[tuple]:
        """Return the views of a step: all views in turn, in a random order for each turn."""
        count = self.settings.views
        if not 0 < count < len(self._views):
            return self._views
        numbers = range(step * count, (step + 1) * count)
        orders = {}
        for number in numbers:
            turn = number // len(self._views)
            if turn not in orders:
                rng = np.random.default_rng((self.settings.seed, turn))
                orders[turn] = rng.permutation(len(self._views))
        return [self._views[orders[n // len(self._views)][n % len(self._views)]] for n in numbers]

    def with_lbfgs(self) -> Result:
        require("scipy", "volumes", "the method lbfgs")
        from scipy.optimize import minimize

        settings, result = self.settings, self.result
        if self._chooses_directions:
            self.scene.integrator().cache_spp = LBFGS_DIRECTIONS
        shapes = {name: value.shape for name, value in result.values.items()}
        ends = np.cumsum([0, *(value.size for value in result.values.values())])

        def of_each(number: Callable[[Range], float]) -> np.ndarray:
            parts = [np.full(v.size, number(self._ranges[n])) for n, v in result.values.items()]
            return np.concatenate(parts)

        scale = of_each(lambda own: own.scale)

        def by_name(x: np.ndarray) -> dict[str, np.ndarray]:
            parts = (x[a:b] for a, b in pairwise(ends))
            return {
                name: self._ranges[name].nearest(part.reshape(shape))
                for (name, shape), part in zip(shapes.items(), parts, strict=True)
            }

        first: list[float] = []

        def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
            loss, gradient = self._objective(by_name(x * scale), self._views, settings.seed)
            _check_finite(loss, gradient, result.step)
            first.append(loss or 1.0)
            flat = np.concatenate([g.ravel() for g in gradient.values()]) * scale
            return loss / first[0], flat / first[0]  # tolerances are for values around 1

        def iterated(intermediate_result) -> None:
            result.values = by_name(intermediate_result.x * scale)
            self._step_done(float(intermediate_result.fun) * first[0])

        left = settings.steps - result.step
        if left > 0:
            x = np.concatenate([v.ravel() for v in result.values.values()]) / scale
            lower = of_each(lambda own: own.lower / own.scale)
            upper = of_each(lambda own: own.upper / own.scale)
            bounds = list(zip(lower, upper, strict=True))
            # The loss is smooth to single precision.
            options = {"maxiter": left, "maxfun": 4 * left + 20, "gtol": 0, "ftol": 1e-7}
            minimize(
                objective, x, jac=True, method="L-BFGS-B", bounds=bounds,
                callback=iterated, options=options,
            )  # fmt: skip
        self._set(result.values, attached=False)
        return result


def _roughness(values: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the mean squared difference between neighbouring voxels (z, y, x, channel), and its
    gradient; both are 0 if the values are no grid.
    """
    total, gradient = 0.0, np.zeros(values.shape)
    for axis in range(3 if values.ndim == 4 else 0):
        difference = np.diff(values.astype(np.float64), axis=axis) / values.size
        total += float(np.square(difference).sum()) * values.size
        ends = [[(0, 0)] * 4, [(0, 0)] * 4]
        ends[0][axis], ends[1][axis] = (1, 0), (0, 1)
        gradient += 2 * (np.pad(difference, ends[0]) - np.pad(difference, ends[1]))
    return total, gradient


def _check_finite(loss: float, gradient: dict[str, np.ndarray], step: int) -> None:
    bad = [name for name, values in gradient.items() if not np.isfinite(values).all()]
    if bad or not math.isfinite(loss):
        what = f'the gradient of "{bad[0]}"' if bad else f"the loss {loss}"
        raise IrrcacheError(f"fit: {what} is not finite at step {step + 1}; lower the rate.")
