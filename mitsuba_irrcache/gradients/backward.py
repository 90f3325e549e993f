"""Propagate derivatives of an objective with respect to pixels back to the scene's parameters."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.gradients.beams import check_beams
from mitsuba_irrcache.gradients.emitter_tangents import EmitterTangents
from mitsuba_irrcache.gradients.emitters import EmitterAdjoint
from mitsuba_irrcache.gradients.film import LANES, FilmAdjoint
from mitsuba_irrcache.gradients.medium import MediumAdjoint, field_of, original_of
from mitsuba_irrcache.gradients.parameters import (
    MEAN_COSINE,
    SIGMA_T,
    Placement,
    by_parameter,
    channels_of,
    check_role,
    nodes_of_emission,
    refuse,
    refuse_all,
    roles_of,
    shaped_like,
)
from mitsuba_irrcache.gradients.tangent import ImageTangent, changed_field
from mitsuba_irrcache.gradients.traced import check as check_traced
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import POINT_LIKE, EmitterKind, kind_of
from mitsuba_irrcache.lights.falloff import lies_in
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.render.camera import ClosedFormCameraRays
from mitsuba_irrcache.scene.compile import media_of
from mitsuba_irrcache.solvers.base import registered

#: Kinds of emitters whose radiance the adjoint equation and the derivatives of images include.
EMITTERS = frozenset(
    (
        EmitterKind.CONSTANT_ENVIRONMENT,
        EmitterKind.ENVIRONMENT_MAP,
        EmitterKind.SUN,
        *POINT_LIKE,
    )
)


def needs_paths(
    parts: list[CachedMedium], params: mi.SceneParameters, keys: list[str], emission: object
) -> bool:
    """Return whether `TracedAdjoint` computes the derivatives with respect to ``keys``.

    ``emission`` is the integrator's property. `ParameterAdjoint` needs an isolated medium, and has
    no derivatives of emissive media but those with respect to the emission.
    """
    if not parts or not parts[0].medium.is_isolated:
        return bool(parts)
    if parts[0].medium.emission is None:
        return False
    own = nodes_of_emission(emission)
    return any(params.properties[key][2] not in own for key in keys)


def check(parts: list[CachedMedium], keys: list[str], layered: bool, traced: bool) -> None:
    """Raise IrrcacheError for scenes and settings in which no gradients are computed.

    ``traced`` is the result of `needs_paths`.
    """
    if not parts:
        refuse_all(
            keys,
            "no medium is visible, and Mitsuba's volpath renders the scene",
            "Give the shape of the medium a null BSDF",
        )
    if layered:
        refuse_all(keys, "the image is filtered or has aovs", "Set filter to none and no aovs")
    part, medium = parts[0], parts[0].medium
    if traced:
        check_traced(parts, keys)
        return
    name = f'medium "{medium.name}"'
    if part.half_space is not None:
        refuse_all(keys, f"{name} is opaque and homogeneous, and has no cache", "Set resolution")
    if not part.solver.has_gradients:
        others = " or ".join(f'"{s.name}"' for s in registered() if s.has_gradients)
        refuse_all(keys, f'the solver is "{part.solver.name}"', f"Set solver to {others}")
    for emitter, kind in part.description.emitters:
        if kind not in EMITTERS:
            refuse_all(
                keys,
                f'emitter "{emitter.id()}" ({emitter.class_name()}) is neither an environment nor '
                "a sun nor point-like (point, spot or projector)",
                "Remove it",
            )
    depth = part.settings.max_depth
    if depth > 2:
        refuse_all(keys, f"max_depth is {depth}", "Set max_depth to 1, 2 or -1")
    if part.cache is None:
        return
    check_beams(part, keys)
    if medium.phase.forward:
        for light in part.description.emitters.of(*POINT_LIKE):
            # Irradiance and scattering into rays vary too much within the voxels around it.
            if lies_in(light, part.cache.grid):
                refuse_all(
                    keys,
                    f'emitter "{light.id()}" is in {name}, which scatters sharply',
                    "Move it out of the medium, or make the phase function broader",
                )


class ParameterAdjoint:
    """Derivatives of objectives of images with respect to the parameters ``keys`` of ``scene``.

    They have the types of these parameters, and are the sum of two terms: `view`, at a fixed
    irradiance, for each view; and `transport`, through the irradiance, once for all views.

    ``part`` is the scene's only medium, with its cache; ``image`` holds the camera rays of the
    scene and the integrator's properties ``step`` and ``emission``; ``seed`` determines the
    ordinates.
    """

    #: camera samples of a launch
    lanes = LANES

    def __init__(
        self,
        scene: mi.Scene,
        params: mi.SceneParameters,
        keys: list[str],
        part: CachedMedium,
        image: tuple[ClosedFormCameraRays, float, object],
        seed: int,
    ) -> None:
        self._scene, self._params, self._part, self._seed = scene, params, part, seed
        self._camera_rays, self._step, emission = image
        (medium,) = media_of(scene)
        roles = roles_of(params, keys, medium, scene, emission)
        self._keys, self._roles = keys, roles
        self._of_medium = {k: role for k, role in roles.items() if isinstance(role, str)}
        for key, role in self._of_medium.items():
            check_role(key, role, part.medium)
        self._placed = {k: role for k, role in roles.items() if isinstance(role, Placement)}
        if part.cache is not None:
            check_placements(self._placed, part.cache.grid)
        emitters = [role for role in roles.values() if isinstance(role, mi.Emitter)]
        self._emitters = EmitterAdjoint(scene, emitters)

    @property
    def parts_by_extinction(self) -> list[CachedMedium]:
        """The medium if derivatives by its extinction are wanted."""
        is_wanted = SIGMA_T in self._of_medium.values() and self._part.cache is not None
        return [self._part] if is_wanted else []

    def view(self, film: FilmAdjoint) -> tuple[dict[str, object], list[mi.Float] | None]:
        """Return the derivatives of the objective of one view at fixed irradiance, and the adjoint
        fluence that the camera rays deposit per channel, None without a cache. ``film`` holds the
        derivatives with respect to the pixels.
        """
        if film.largest == 0:
            return {}, None
        found, fluence = self._adjoint.replayed(film)
        return self._by_parameters(found), fluence

    def transport(self, fluence: list[mi.Float]) -> dict[str, object]:
        """Return the derivatives of the objective through the irradiance, given the adjoint
        ``fluence`` summed over all views.
        """
        return self._by_parameters(self._adjoint.transported(fluence))

    def along(self, changes: Mapping[str, object]) -> ImageTangent:
        """Return the derivatives of images along ``changes`` of the parameters, by key."""
        if self._placed:
            refuse(next(iter(self._placed)), "dr.forward was called")
        medium, fields, g, by_emitter = self._new_medium(channels_apart=True), {}, 0.0, {}
        for key in self._keys:
            change, value = changes[key], self._params[key]
            role = self._roles[key]
            if isinstance(role, mi.Emitter):
                by_emitter[role] = change, value, key
            elif role == MEAN_COSINE:
                g = float(np.array(change).ravel()[0])
            else:
                fields[role] = changed_field(value, change, medium, role)
        is_coloured = self._part.medium.sigma_t.channels > 1
        emitters = EmitterTangents(self._scene, by_emitter, is_coloured)
        return ImageTangent(medium, fields, g, emitters)

    @cached_property
    def _adjoint(self) -> MediumAdjoint:
        medium = self._new_medium(channels_apart=bool(self._placed))
        medium.placements = list(self._placed.values())
        return medium

    def _new_medium(self, channels_apart: bool = False) -> MediumAdjoint:
        wanted: dict[str, int] = {}
        for key, role in self._of_medium.items():
            if role == MEAN_COSINE:
                wanted[role] = 1
                continue
            field = field_of(original_of(self._part.medium), role)
            own = field.channels if field.grid is not None else channels_of(self._params[key])
            wanted[role] = max(wanted.get(role, 1), own)
        march = self._camera_rays, self._step
        of = self._emitters, self._seed, channels_apart
        return MediumAdjoint(self._scene, self._part, march, wanted, *of)

    def _placement(self, key: str, values: np.ndarray) -> object:
        """Return derivatives with respect to a position, or to the matrix of a transform."""
        value = self._params[key]
        if values.ndim == 1:
            return type(value)(*(float(v) for v in values))
        return type(value.matrix)(values.astype(np.float32))

    def _by_parameters(self, found: dict[str, mi.Float]) -> dict[str, object]:
        placed = {key: found[role] for key, role in self._placed.items() if role in found}
        result = {key: self._placement(key, values) for key, values in placed.items()}
        for key, role in self._of_medium.items():
            value = self._params[key]
            if role == MEAN_COSINE:
                result[key] = shaped_like(value, found[role])
                continue
            field = field_of(original_of(self._part.medium), role)
            result[key] = shaped_like(value, by_parameter(value, field, found[role]))
        return result


def check_placements(placed: dict[str, Placement], grid: Grid) -> None:
    """Refuse derivatives with respect to the position of a light in the medium."""
    for key, role in placed.items():
        if kind_of(role.emitter) is EmitterKind.SUN:
            continue
        if lies_in(role.emitter, grid):
            refuse(key, "the light is in the medium, or within a voxel of it")
