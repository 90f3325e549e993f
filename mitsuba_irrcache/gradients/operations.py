"""Images as operations of Dr.Jit's AD graph, so that several of them share one adjoint solve.

The irradiance is a variable of the graph: it depends on the parameters, and images depend on it and
directly on the parameters. The derivatives of an objective with respect to the irradiance are the
adjoint fluence of camera rays, which Dr.Jit accumulates over all images. In reverse mode it visits
the irradiance once, after all images, and only then is the adjoint equation solved.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.jit import graph_variables
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.backward import ParameterAdjoint
from mitsuba_irrcache.gradients.film import FilmAdjoint, FilmTangent
from mitsuba_irrcache.gradients.medium import values_per_voxel
from mitsuba_irrcache.gradients.parameters import enabled
from mitsuba_irrcache.gradients.tangent import ImageTangent
from mitsuba_irrcache.scene.fingerprint import SceneVersion, SensorVersion


class DifferentiableIntegrator(Protocol):
    """The interface of the integrator that these operations use."""

    caches: dict[str, IrradianceCache | None]
    emission: tuple[object, float]

    def render(
        self, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int, develop: bool, evaluate: bool
    ) -> mi.TensorXf:
        """Render an image, as Mitsuba's integrators do."""

    def exclusively(self) -> AbstractContextManager:
        """Return a context in which no other thread changes the cache."""

    def adjoint(
        self, scene: mi.Scene, params: mi.SceneParameters, keys: list[str], seed: int
    ) -> ParameterAdjoint:
        """Return the derivatives of images of ``scene`` with respect to the parameters ``keys``."""

    def revision(self, scene: mi.Scene) -> int:
        """Update the cache for ``scene``, and return the number of its state."""


class SceneState:
    """A state of ``scene`` and of its parameters, and the adjoint that images of this state share.

    ``params`` are the parameters, of which some carry gradients. ``alone`` states that there is
    only one image, whose derivatives are solved for immediately.
    """

    def __init__(
        self,
        integrator: DifferentiableIntegrator,
        scene: mi.Scene,
        params: mi.SceneParameters,
        alone: bool = False,
    ) -> None:
        self.integrator, self.scene, self.params = integrator, scene, params
        self._identity, self._revision = _variables(params), integrator.revision(scene)
        self._version = self._present_version
        caches = [cache for cache in integrator.caches.values() if cache is not None]
        counts = [cache.grid.voxel_count * values_per_voxel(cache) for cache in caches]
        #: number of values of the irradiance in each channel
        self.voxels = max(sum(counts), 1)
        self._adjoint: ParameterAdjoint | None = None
        #: state of the cache, derivatives of the parameters, and derivatives of images along them
        self._tangent: tuple[int, dict, ImageTangent] | None = None
        # Dr.Jit forgets edges of its graph once it has followed them.
        self._is_solved = alone

    def is_state_of(self, scene: mi.Scene, params: mi.SceneParameters) -> bool:
        """Return whether another image of ``scene`` and ``params`` may share the adjoint solve."""
        if self._is_solved or self._adjoint is not None:
            return False
        if self.scene is not scene or self.params is not params:
            return False
        return self._identity == _variables(params) and self._is_current

    @property
    def _is_current(self) -> bool:
        return self._revision == self.integrator.revision(self.scene)

    @property
    def _present_version(self) -> SceneVersion:
        volume = self.integrator.emission[0]
        return SceneVersion(self.scene, volume if isinstance(volume, mi.Volume) else None)

    def refuse_changes(self, sensor: mi.Sensor, seen: SensorVersion) -> None:
        """Raise an error if the scene, or the ``sensor`` of an image, which was ``seen`` then, has
        changed since: derivatives would be those of another image.
        """
        changes = self._present_version.changes(self._version)
        changes += SensorVersion(sensor).changes(seen)
        if changes:
            names = ", ".join(f'"{name}"' for name in changes[:4])
            raise IrrcacheError(
                f"irrcache: the scene has changed since the image was rendered ({names}), so that "
                "its derivatives would be wrong; call dr.backward or dr.forward before the scene "
                "is changed, and give each view a sensor of its own."
            )

    def add_image(
        self, grad: mi.TensorXf, sensor: mi.Sensor, seed: int, spp: int
    ) -> mi.Spectrum | None:
        """Accumulate the derivatives of one image in the parameters, at a fixed irradiance.

        ``grad`` holds the derivatives with respect to the pixels. Returns those with respect to the
        irradiance, if the adjoint equation is solved later; otherwise solves it and returns None.
        """
        with dr.suspend_grad(), self.integrator.exclusively():
            shared = not self._is_solved and self._is_current
            adjoint = self._adjoint if shared else None
            if adjoint is None:
                # Wrapping functions pass the seed as an array.
                number = int(np.array(seed).ravel()[0])
                keys = list(self._identity)
                adjoint = self.integrator.adjoint(self.scene, self.params, keys, number)
            film = FilmAdjoint(sensor, grad, seed, spp, adjoint.lanes)
            found, fluence = adjoint.view(film)
            rest = {}
            if not shared and fluence is not None:
                rest = adjoint.transport(fluence)
        self._accumulate(found)
        self._accumulate(rest)
        if not shared or fluence is None:
            return None
        self._adjoint = adjoint
        return mi.Spectrum(*fluence)

    def solve(self, fluence: mi.Spectrum) -> None:
        """Accumulate the derivatives through the irradiance in the parameters.

        ``fluence`` holds the derivatives with respect to the irradiance.
        """
        adjoint, self._adjoint, self._is_solved = self._adjoint, None, True
        if adjoint is None:
            return  # no image depends on the irradiance
        with dr.suspend_grad(), self.integrator.exclusively():
            found = adjoint.transport(list(fluence))
        self._accumulate(found)

    def image_along(self, sensor: mi.Sensor, seed: int, spp: int) -> mi.TensorXf:
        """Return the derivative of an image along the derivatives of the parameters.

        Images that are differentiated one after the other along the same ones share the solve.
        """
        changes = {key: dr.grad(self.params[key]) for key in self._identity}
        with dr.suspend_grad(), self.integrator.exclusively():
            # Further images do not share the irradiance: Dr.Jit forgets its edges.
            self._is_solved = True
            revision, tangent = self.integrator.revision(self.scene), None
            if self._tangent is not None and self._tangent[0] == revision:
                tangent = self._tangent[2] if _same(self._tangent[1], changes) else None
            if tangent is None:
                number = int(np.array(seed).ravel()[0])
                keys = list(changes)
                adjoint = self.integrator.adjoint(self.scene, self.params, keys, number)
                tangent = adjoint.along(changes)
                self._tangent = revision, changes, tangent
            return tangent.image(FilmTangent(sensor, seed, spp))

    def _accumulate(self, found: dict[str, object]) -> None:
        # Gradients must not be suspended, or nothing is added.
        for key, grad in found.items():
            value = self.params[key]
            dr.accum_grad(value if dr.is_array_v(value) else value.matrix, grad)


class Irradiance(dr.CustomOp):
    """The irradiance of a `SceneState` in the AD graph; its values are not used."""

    def eval(self, state: SceneState, parameters: dict) -> mi.Spectrum:
        self._state = state
        return dr.zeros(mi.Spectrum, state.voxels)

    def forward(self) -> None:
        # Images compute what changes through the irradiance: their state has its derivatives.
        self.set_grad_out(dr.zeros(mi.Spectrum, self._state.voxels))

    def backward(self) -> None:
        self._state.solve(self.grad_out())


class SharedIrradiance:
    """The variable of the irradiance that all images of one state of the scene share."""

    def __init__(self, state: SceneState) -> None:
        self.state = state
        self.variable = dr.custom(Irradiance, state, dict(state.params))


class Image(dr.CustomOp):
    """An image in the AD graph, which depends on the ``irradiance`` and on parameters.

    ``seed`` and ``spp`` are pairs: of the image, and of its gradients.
    """

    def eval(
        self,
        shared: SharedIrradiance,
        irradiance: mi.Spectrum,
        parameters: dict,
        sensor: mi.Sensor,
        seed: tuple[int, int],
        spp: tuple[int, int],
    ) -> mi.TensorXf:
        self._shared, self._sensor, self._seed, self._spp = shared, sensor, seed[1], spp[1]
        state, self._seen = shared.state, SensorVersion(sensor)
        with dr.suspend_grad():
            return state.integrator.render(state.scene, sensor, seed[0], spp[0], True, False)

    def forward(self) -> None:
        state = self._shared.state
        state.refuse_changes(self._sensor, self._seen)
        self.set_grad_out(state.image_along(self._sensor, self._seed, self._spp))

    def backward(self) -> None:
        state = self._shared.state
        state.refuse_changes(self._sensor, self._seen)
        found = state.add_image(self.grad_out(), self._sensor, self._seed, self._spp)
        # Dr.Jit visits the irradiance only if it has a gradient.
        self.set_grad_in("irradiance", mi.Spectrum(0) if found is None else found)


def image(
    integrator: DifferentiableIntegrator,
    shared: SharedIrradiance | None,
    scene: mi.Scene,
    params: mi.SceneParameters,
    sensor: mi.Sensor,
    seed: tuple[int, int],
    spp: tuple[int, int],
) -> tuple[mi.TensorXf, SharedIrradiance]:
    """Render an `Image` through which ``params`` receive gradients.

    Returns it and the irradiance that it shares with other images: ``shared`` if that belongs to
    the same state of the scene, otherwise a new one.
    """
    with integrator.exclusively():
        if shared is None or not shared.state.is_state_of(scene, params):
            shared = SharedIrradiance(SceneState(integrator, scene, params))
    arguments = dict(params), sensor, seed, spp
    return dr.custom(Image, shared, shared.variable, *arguments), shared


def _same(first: dict, second: dict) -> bool:
    """Return whether two dictionaries have equal arrays."""
    return all(np.array_equal(np.array(first[key]), np.array(second[key])) for key in second)


def _variables(params: mi.SceneParameters) -> dict[str, list[int]]:
    """Return the indices in the AD graph of all parameters that carry gradients, by key."""
    return {key: graph_variables(params[key]) for key in enabled(params)}
