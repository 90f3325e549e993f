"""The ranges in which parameters are fitted (`fit`), by what they are in the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.parameters import MEAN_COSINE, SIGMA_T
from mitsuba_irrcache.media.bake import children
from mitsuba_irrcache.media.phase import LARGEST_PEAK, MAX_ORDER, MAX_TAIL, TAIL_ORDER

#: Optical depth of the scene's diagonal by which the extinction is scaled if the start is thinner.
DEPTH = 4.0
#: Names of volumes and textures, in the media and BSDFs that have them, of values from 0 to 1.
FRACTIONS = (
    "albedo", "base_color", "diffuse_reflectance", "diffuse_transmittance", "opacity",
    "reflectance", "specular_reflectance", "specular_transmittance", "weight",
)  # fmt: skip
#: Smallest reflectance with irrcache, which has no gradient of a reflectance of 0.
BLACKEST = 1e-3
#: Largest |g| of ``hg`` with integrators of Mitsuba, whose ``hg`` is undefined at 1.
SHARPEST = 0.99
#: Mean cosines of ``hg`` that irrcache supports backwards and forwards. The margin is for the
#: differences by g in its gradients.
BACKWARDS = 0.01 - MAX_TAIL ** (1 / (TAIL_ORDER + 1))
FORWARDS = LARGEST_PEAK ** (1 / (MAX_ORDER + 1)) - 0.01
#: Smallest |g| with irrcache, which has no gradient by g where a medium scatters isotropically.
ISOTROPIC = 1e-4
#: Scale of g, about the length of the first step of L-BFGS. Larger ones often end at a bound.
MEAN_COSINE_SCALE = 0.25
#: Parameters of shapes that are no values of a material, and move what is visible.
GEOMETRY = ("vertex_positions", "vertex_normals", "vertex_texcoords")


@dataclass(frozen=True)
class Range:
    """The bounds between which a parameter is fitted, the ``scale`` by which it is divided, and its
    ``smallest`` magnitude.
    """

    lower: float
    upper: float
    scale: float
    smallest: float = 0.0

    def nearest(self, value: np.ndarray) -> np.ndarray:
        """Return the values in the range that are nearest to these."""
        found = np.clip(value, self.lower, self.upper)
        tiny = np.copysign(self.smallest, found)
        return np.where(np.abs(found) < self.smallest, tiny, found).astype(np.float32)


class Ranges:
    """The `Range` of parameters of a ``scene``, by what they are.

    They are the same for all integrators, except that ``irrcache``, which ``has_cache``, supports
    not all phase functions and reflectances. ``scale`` is that of `Settings`.
    """

    def __init__(
        self, scene: mi.Scene, params: mi.SceneParameters, has_cache: bool, scale: float
    ) -> None:
        self._scene, self._params = scene, params
        self._has_cache, self._scale = has_cache, scale
        self._names: dict[mi.Object, set[str]] = {}
        self._collect(scene, set())

    def _collect(self, node: mi.Object, names: set[str]) -> None:
        """Collect the names that media, BSDFs and emitters have for their volumes and textures.

        Keys do not have these names where a volume or texture has an id.
        """
        for name, child in children(node).items():
            # What is within a volume or texture is part of its value.
            within = isinstance(node, mi.Volume | mi.Texture)
            own = names if within else {name}
            if not own <= self._names.get(child, set()) or child not in self._names:
                self._names[child] = self._names.get(child, set()) | own
                self._collect(child, own)

    def of(self, key: str, value: np.ndarray) -> Range:
        """Return the range of the parameter ``key``, given its first ``value``.

        Raises IrrcacheError if the value is not within it.
        """
        found = self._range(key, value)
        low, high = float(value.min()), float(value.max())
        tolerance = 1e-6 * found.scale
        if low < found.lower - tolerance or high > found.upper + tolerance:
            raise IrrcacheError(
                f'fit: the parameter "{key}" starts at values from {low:.3g} to {high:.3g}, but is '
                f"fitted between {found.lower:.3g} and {found.upper:.3g}; start within these."
            )
        return found

    def _range(self, key: str, value: np.ndarray) -> Range:
        node, last = self._params.properties[key][2], key.rpartition(".")[2]
        names = self._names.get(node, set())
        if node.class_name() == "HGPhaseFunction" and last == MEAN_COSINE:
            if not self._has_cache:
                return Range(-SHARPEST, SHARPEST, MEAN_COSINE_SCALE)
            return Range(BACKWARDS, FORWARDS, MEAN_COSINE_SCALE, ISOTROPIC)
        if last == "position":
            return Range(-math.inf, math.inf, self._distance(value))
        if names.intersection(FRACTIONS):
            reflects = self._has_cache and "reflectance" in names
            return Range(BLACKEST if reflects else 0.0, 1.0, 1.0)
        if self._scale:
            return Range(0.0, math.inf, self._scale)
        largest = float(np.abs(value).max())
        if SIGMA_T not in names:
            return Range(0.0, math.inf, largest or 1.0)
        box = self._scene.bbox()
        return Range(0.0, math.inf, max(largest, DEPTH / float(dr.norm(box.max - box.min))))

    def _distance(self, position: np.ndarray) -> float:
        """Return half the distance of a ``position`` from the box of the scene, but at least a
        twentieth of the diagonal.

        The first step of L-BFGS has about this length, and must not end in a medium. Images change
        little with the position of a light that is far away.
        """
        box = self._scene.bbox()
        low, high, place = (np.array(p).ravel() for p in (box.min, box.max, position))
        outside = np.maximum(np.maximum(low - place, place - high), 0)
        return max(0.5 * float(np.linalg.norm(outside)), 0.05 * float(np.linalg.norm(high - low)))


def check_parameter(params: mi.SceneParameters, key: str, has_cache: bool) -> None:
    """Raise IrrcacheError if the parameter ``key`` cannot be fitted."""
    value, (_, _, node, flags) = params[key], params.properties[key]
    last = key.rpartition(".")[2]
    why = ""
    if not dr.is_array_v(value) and hasattr(value, "matrix"):
        why = "it is a transform, whose elements are not independent of each other"
    elif not dr.is_array_v(value) or not dr.is_float_v(value):
        why = f"it is of type {type(value).__name__}, not an array of floating-point numbers"
    elif isinstance(node, mi.Sensor) or last in GEOMETRY:
        why = f'"{last}" belongs to the geometry of the {node.class_name()}'
    elif not has_cache and flags & int(mi.ParamFlags.NonDifferentiable):
        why = "Mitsuba's integrators have no gradient of it; use the integrator irrcache"
    if why:
        raise IrrcacheError(
            f'fit: the parameter "{key}" cannot be fitted: {why}. Fit extinction, albedo, '
            "emission, g of hg, reflectances, radiances, or positions of points."
        )
