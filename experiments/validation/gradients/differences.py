"""Finite differences of the integrator's own image along smooth perturbations of a parameter."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.validation.gradients.cases import EDGE, Case, blob
from mitsuba_irrcache.compare.gradients import gradients_of

#: Camera samples of each pixel for gradients, if nothing else is said.
SPP_GRAD = 64
#: Perturbations of a grid, their width in edges of it, and the largest change of an albedo; of
#: emission, it is ten times as much of the maximum.
BLOBS, WIDTH, STEP = 6, 0.12, 0.03


@dataclass(frozen=True)
class Comparison:
    """Directional derivatives by finite differences and by the adjoint."""

    differences: np.ndarray
    adjoint: np.ndarray

    @property
    def error(self) -> float:
        """Relative error."""
        return float(
            np.linalg.norm(self.adjoint - self.differences) / np.linalg.norm(self.differences)
        )

    @property
    def cosine(self) -> float:
        norms = np.linalg.norm(self.adjoint) * np.linalg.norm(self.differences)
        return float(self.adjoint @ self.differences / norms)


def first_key(params: mi.SceneParameters, name: str) -> str:
    """The key of a parameter of the medium or of another object, part of which is ``name``.

    If several fit, it is that of the first medium or of the radiance of an emitter.
    """
    keys = [key for key in params.keys() if key.endswith((".value", ".data", ".g"))]
    keys = [key for key in keys if f".{name}." in f".{key}."]
    if len(keys) > 1:
        keys = [key for key in keys if key.startswith("shape.") or ".emitter." in key]
    (key,) = keys
    return key


def pixel_weights(scene: mi.Scene) -> np.ndarray:
    """Smooth weights of the pixels: the objective is their scalar product with the image."""
    shape = np.array(mi.render(scene, spp=1)).shape
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    plane = 1 + 0.5 * np.cos(columns / shape[1] * 4 + 1) * np.sin(rows / shape[0] * 3)
    channels = np.linspace(1.0, 0.6, shape[2])
    return plane[..., None] * channels / np.prod(shape[:2])


def gradients(
    scene: mi.Scene, names: tuple[str, ...], weights: np.ndarray, spp: int = SPP_GRAD, seed: int = 3
) -> dict[str, np.ndarray]:
    """Gradients of the objective by the parameters of these names."""
    params = mi.traverse(scene)
    keys = {name: first_key(params, name) for name in names}
    weighted = mi.TensorXf(weights.astype(np.float32))
    found = gradients_of(
        scene,
        params,
        list(keys.values()),
        lambda image: dr.sum(image * weighted),
        spp=spp,
        seed=seed,
    )
    return {name: found[key] for name, key in keys.items()}


def derivatives(
    scene: mi.Scene,
    name: str,
    weights: np.ndarray,
    steps: list[np.ndarray],
    spp: int = SPP_GRAD,
) -> np.ndarray:
    """Derivatives of the objective along ``steps`` of a parameter, by forward mode."""
    params = mi.traverse(scene)
    key, found = first_key(params, name), []
    kind, shape = type(params[key]), np.array(params[key]).shape
    for step in steps:
        leaf = kind(dr.detach(params[key]))
        dr.enable_grad(leaf)
        params[key] = leaf
        params.update()
        flat = np.broadcast_to(step, shape).astype(np.float32)
        dr.set_grad(leaf, kind(flat if len(shape) != 1 else flat.ravel()))
        change = dr.forward_to(mi.render(scene, params, spp=spp, seed=3))
        found.append(float((np.array(change, dtype=np.float64) * weights).sum()))
        params[key] = dr.detach(leaf)
        params.update()
    return np.array(found)


def directions(case: Case, name: str, value: np.ndarray, count: int) -> list[np.ndarray]:
    """Perturbations of a parameter: ``count`` smooth ones of a grid, each channel of a constant."""
    if value.ndim == 3:  # an environment map
        rows, columns = np.mgrid[: value.shape[0], : value.shape[1]]
        turns = 2 * np.pi * columns / (value.shape[1] - 2)  # two columns are repeated
        waves = [0.3 * (1 + np.cos(k * turns + rows * 0.1 * k)) for k in range(count)]
        return [wave[..., None] * value.mean() for wave in waves]
    if value.ndim < 3:
        # The order of the moments should not change with a phase function.
        share = 0.03 if name == "g" else 0.05
        return [share * value * row.reshape(value.shape) for row in np.eye(value.size)]
    rng = np.random.default_rng(3)
    found = []
    for _ in range(count):
        centre = rng.uniform(*case.changed), *rng.uniform(0.25, 0.75, 2)
        plane = blob(case.data, centre, WIDTH)[..., None]
        # Without the far tails: one-sided differences are for what would become negative.
        plane = np.where(plane < 1e-2, 0, plane)
        colour = rng.uniform(0.3, 1.0, value.shape[-1])
        peak = case.depth * case.data / EDGE
        steps = {"sigma_t": case.step * peak, "albedo": STEP}
        # Images depend linearly on emission, and change little with it.
        step = steps.get(name, 10 * STEP * value.max())
        found.append(step * plane * colour / colour.max())
    return found


def compare(
    scene: mi.Scene,
    case: Case,
    name: str,
    weights: np.ndarray,
    gradient: np.ndarray,
    count: int = BLOBS,
) -> Comparison:
    """Compare a ``gradient`` with central differences; with one-sided ones, of second order too,
    where a parameter would become negative.
    """
    params = mi.traverse(scene)
    key = first_key(params, name)
    kind, value = type(params[key]), np.array(params[key], dtype=np.float64)

    def objective(changed: np.ndarray) -> float:
        flat = changed.astype(np.float32)
        params[key] = kind(flat if value.ndim != 1 else flat.ravel())
        params.update()
        image = np.array(mi.render(scene, spp=case.samples, seed=7), dtype=np.float64)
        return float((image * weights).sum())

    found = []
    for step in directions(case, name, value, count):
        worth = float((gradient.reshape(value.shape) * step.astype(np.float32)).sum())
        if (value - step < 0).any():
            values = [objective(value + k * step) for k in range(3)]
            difference = -1.5 * values[0] + 2 * values[1] - 0.5 * values[2]
        else:
            difference = 0.5 * (objective(value + step) - objective(value - step))
        found.append((difference, worth))
    objective(value)
    return Comparison(*np.array(found).T)


def mean_of(found: list[Comparison]) -> tuple[Comparison, float]:
    """Average comparisons with other random numbers.

    Returns also the standard error of the difference between both means, relative to these; NaN
    for a single comparison.
    """
    differences, adjoint = (
        np.array([getattr(each, name) for each in found]) for name in ("differences", "adjoint")
    )
    mean = Comparison(differences.mean(axis=0), adjoint.mean(axis=0))
    if len(found) == 1:
        return mean, float("nan")
    deviations = (adjoint - differences).std(axis=0, ddof=1) / np.sqrt(len(found))
    return mean, float(np.linalg.norm(deviations) / np.linalg.norm(mean.differences))
