"""Derivatives of images of scenes with surfaces and several media, by parameter."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.gradients.beams import check_beams
from mitsuba_irrcache.gradients.coupled_medium import CoupledMedium
from mitsuba_irrcache.gradients.film import FilmAdjoint
from mitsuba_irrcache.gradients.medium import field_of, original_of
from mitsuba_irrcache.gradients.parameters import (
    EMISSION,
    MEAN_COSINE,
    SIGMA_T,
    add_user,
    by_parameter,
    channels_of,
    check_role,
    is_mean_cosine,
    key_of_node,
    nodes_of_emission,
    nodes_of_emitters,
    nodes_of_medium,
    refuse,
    refuse_all,
    role_of,
    shaped_like,
    users_of,
)
from mitsuba_irrcache.gradients.replay import CameraSplats
from mitsuba_irrcache.gradients.scattering import split
from mitsuba_irrcache.gradients.surroundings import LANES
from mitsuba_irrcache.gradients.surroundings_adjoint import SurroundingsAdjoint
from mitsuba_irrcache.gradients.surroundings_tangent import SurroundingsTangent
from mitsuba_irrcache.gradients.tangent import changed_field
from mitsuba_irrcache.gradients.tangent_fields import (
    AttachedParameters,
    MediumChanges,
    SceneChanges,
)
from mitsuba_irrcache.lights.emitters import POINT_LIKE, EmitterKind
from mitsuba_irrcache.lights.falloff import lies_in
from mitsuba_irrcache.lights.narrow_sources import MAX_LAMPS
from mitsuba_irrcache.media.bake import children
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.scene.compile import media_of

#: BSDFs with respect to whose reflectance there are derivatives, and BSDFs that contain others.
DIFFUSE, NESTING = "SmoothDiffuse", ("TwoSidedBRDF",)


def check(parts: list[CachedMedium], keys: list[str]) -> None:
    """Raise IrrcacheError for scenes with surfaces or several media without gradients."""
    description, settings = parts[0].description, parts[0].settings
    if settings.max_depth not in (2, -1):
        refuse_all(
            keys,
            f"max_depth is {settings.max_depth} and there are surfaces, area lights, several media "
            "or emission",
            "Set max_depth to 2 or -1",
        )
    if len(parts) < len(description.media.grids):
        refuse_all(keys, "a medium is not visible to the camera", "Remove that medium")
    for part in parts:
        _check_medium(part, keys)


def _check_medium(part: CachedMedium, keys: list[str]) -> None:
    medium, name = part.medium, f'medium "{part.medium.name}"'
    among = "among surfaces, area lights or several media"
    lamps = part.description.emitters.of(EmitterKind.AREA)
    if not medium.phase.is_isotropic and len(lamps) > MAX_LAMPS:
        reason = (
            f"{name} scatters anisotropically {among}, and there are {len(lamps)} area emitters"
        )
        refuse_all(keys, reason, f"Use {MAX_LAMPS} at most")
    if medium.refracts:
        refuse_all(keys, f"the boundary of {name} refracts", "Give it a null BSDF")
    if part.shared is not None:
        refuse_all(keys, part.shared, "Use a box or sphere that nothing reaches into")
    if part.cache is None:
        refuse_all(keys, f"{name} is opaque and homogeneous, and has no cache", "Set resolution")
    if not part.solver.has_gradients:
        refuse_all(keys, f'the solver is "{part.solver.name}"', "Set solver to sweep")
    if part.cache.voxel_classes is not None:
        refuse_all(keys, f"a surface reaches into {name}", "Move it out")
    check_beams(part, keys)
    for light in part.description.emitters.of(*POINT_LIKE):
        if lies_in(light, part.cache.grid):
            refuse_all(keys, f'emitter "{light.id()}" is in {name} {among}', "Move it out")


class TracedAdjoint:
    """Derivatives of objectives of images of ``scene`` with respect to the parameters ``keys``.

    The interface is that of `ParameterAdjoint`. ``parts`` are all media of the scene, with their
    caches; ``image`` are the integrator's properties ``step``, ``hide_emitters`` and ``emission``;
    ``seed`` determines random numbers.
    """

    #: camera samples of a launch
    lanes = LANES

    def __init__(
        self,
        scene: mi.Scene,
        params: mi.SceneParameters,
        keys: list[str],
        parts: list[CachedMedium],
        image: tuple[float, bool, object],
        seed: int,
    ) -> None:
        self._scene, self._params, self._parts, self._seed = scene, params, parts, seed
        self._keys, (self._step, self._hides, emission) = keys, image
        media = list(media_of(scene))
        own = [media[part.medium.number] for part in parts]
        self._roles = roles_among(params, keys, own, scene, emission)
        for key, role in self._roles.items():
            if isinstance(role, tuple):
                number, name = role
                check_role(key, name, parts[number].medium)

    @property
    def parts_by_extinction(self) -> list[CachedMedium]:
        """The media by whose extinction derivatives are wanted."""
        roles = [role for role in self._roles.values() if isinstance(role, tuple)]
        numbers = sorted({number for number, name in roles if name == SIGMA_T})
        return [part for part in map(self._parts.__getitem__, numbers) if part.cache is not None]

    def view(self, film: FilmAdjoint) -> tuple[dict[str, object], list[mi.Float] | None]:
        """Return derivatives and adjoint fluence as `ParameterAdjoint.view`; the fluence of all
        media follows each other.
        """
        if film.largest == 0:
            return {}, None
        splats, fluence = self._surroundings.view(film)
        joined = [
            concatenated([layer for components in media for layer in components])
            for media in zip(*fluence, strict=True)
        ]
        return self._by_parameters(splats), joined

    def transport(self, fluence: list[mi.Float]) -> dict[str, object]:
        """Return the derivatives as `ParameterAdjoint.transport`."""
        media = self._surroundings.media
        camera, start = [], 0
        for medium in media:
            count = medium.grid.voxel_count * medium.components
            place = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
            own = [dr.gather(mi.Float, f, place) for f in fluence[: medium.channels]]
            camera.append([split(values, medium.components) for values in own])
            start += count
        return self._by_parameters(self._surroundings.transported(camera))

    def along(self, changes: Mapping[str, object]) -> SurroundingsTangent:
        """Return the derivatives of images along ``changes`` of the parameters, by key."""
        media, *others = self._arguments()
        found = [MediumChanges({}) for _ in media]
        for key, role in self._roles.items():
            if not isinstance(role, tuple):
                continue
            (number, name), value, change = role, self._params[key], changes[key]
            if name == MEAN_COSINE:
                found[number].g = float(np.array(change).ravel()[0])
            else:
                found[number].fields[name] = changed_field(value, change, media[number], name)
        for medium, own in zip(media, found, strict=True):
            medium.remove_peak(own)
        attached = [key for key, role in self._roles.items() if not isinstance(role, tuple)]
        own = AttachedParameters(self._params, attached, changes)
        return SurroundingsTangent(self._scene, media, *others, SceneChanges(found, own))

    @cached_property
    def _surroundings(self) -> SurroundingsAdjoint:
        return SurroundingsAdjoint(self._scene, *self._arguments())

    def _arguments(self) -> tuple[list[CoupledMedium], bool, tuple[bool, bool], int]:
        """Return the arguments of `Surroundings` after the scene."""
        wanted: list[dict[str, int]] = [{} for _ in self._parts]
        for key, role in self._roles.items():
            if isinstance(role, tuple):
                number, name = role
                if name == MEAN_COSINE:
                    wanted[number][name] = 1
                    continue
                field = field_of(original_of(self._parts[number].medium), name)
                own = field.channels if field.grid is not None else channels_of(self._params[key])
                wanted[number][name] = max(wanted[number].get(name, 1), own)
        media = [
            CoupledMedium(self._scene, part, own, self._step, self._seed)
            for part, own in zip(self._parts, wanted, strict=True)
        ]
        users = [user for role in self._roles.values() for user in users_of(role)]
        kinds = tuple(any(isinstance(u, kind) for u in users) for kind in (mi.Emitter, mi.BSDF))
        return media, self._hides, kinds, self._seed

    def _by_parameters(self, splats: list[CameraSplats]) -> dict[str, object]:
        media = self._surroundings.media
        found = [medium.derivatives(own) for medium, own in zip(media, splats, strict=True)]
        result = {}
        for key, role in self._roles.items():
            if not isinstance(role, tuple):
                continue  # accumulated in Dr.Jit's graph
            (number, name), value = role, self._params[key]
            if name == MEAN_COSINE:
                result[key] = shaped_like(value, found[number][name])
                continue
            field = field_of(original_of(self._parts[number].medium), name)
            result[key] = shaped_like(value, by_parameter(value, field, found[number][name]))
        return result


def roles_among(
    params: mi.SceneParameters,
    keys: list[str],
    media: list[mi.Medium],
    scene: mi.Scene,
    emission: object = None,
) -> dict[str, object]:
    """Return the role of each of the parameters ``keys``, by key.

    A role is the number of one of the ``media`` with `SIGMA_T`, `ALBEDO` or, if its phase function
    is ``hg``, `MEAN_COSINE`; 0 and `EMISSION` for the integrator's volume ``emission``; the emitter
    whose
    radiance the parameter is; the diffuse BSDF whose reflectance it is; or a `SharedTexture`.

    Raises IrrcacheError for any other parameter.
    """
    nodes: dict[mi.Object, object] = dict(nodes_of_emitters(scene))
    for number, medium in enumerate(media):
        own = nodes_of_medium(params, keys, medium)
        for node, role in own.items():
            if isinstance(nodes.get(node), tuple):
                refuse(key_of_node(params, keys, node, keys[0]), "several media depend on it")
            nodes[node] = number, role
    for node in nodes_of_emission(emission):
        key = key_of_node(params, keys, node, "")
        if len(media) > 1 and key:
            refuse(key, "several media depend on it")
        nodes[node] = 0, EMISSION
    for shape in scene.shapes():
        if shape.bsdf() is not None:
            for node, bsdf in _reflectances(shape.bsdf()).items():
                add_user(nodes, node, bsdf)
    roles = {key: _mean_cosine(params, key, media) or role_of(params, key, nodes) for key in keys}
    specular = {
        node: user
        for shape in scene.shapes()
        if shape.bsdf() is not None
        for node, user in _specular_textures(shape.bsdf()).items()
    }
    for key, role in roles.items():
        user = specular.get(params.properties[key][2])
        if user is not None:
            refuse(key, f"a {user.class_name()} depends on it, too; give each a texture of its own")
        reflects = any(isinstance(user, mi.BSDF) for user in users_of(role))
        if reflects and not float(np.min(np.array(params[key]))) > 0:
            refuse(key, "it is 0 somewhere, where paths end; start with a small positive value")
    return roles


def _mean_cosine(
    params: mi.SceneParameters, key: str, media: list[mi.Medium]
) -> tuple[int, str] | None:
    """Return the role of a parameter that is the mean cosine of one of the ``media``."""
    own = [number for number, m in enumerate(media) if is_mean_cosine(params, key, m)]
    if len(own) > 1:
        refuse(key, "several media depend on it")
    return (own[0], MEAN_COSINE) if own else None


def _reflectances(bsdf: mi.BSDF) -> dict[mi.Object, mi.BSDF]:
    """Return the textures of the reflectance of diffuse BSDFs."""
    own = children(bsdf)
    if bsdf.class_name() in NESTING:
        return {k: v for nested in own.values() for k, v in _reflectances(nested).items()}
    if bsdf.class_name() != DIFFUSE:
        return {}
    texture = own["reflectance"]
    return dict.fromkeys((texture, *children(texture).values()), bsdf)


def _specular_textures(bsdf: mi.BSDF) -> dict[mi.Object, mi.BSDF]:
    """Return the textures of BSDFs that reflect or transmit in single directions, for which
    `PathAdjoint` has no derivatives.
    """
    found, own = {}, children(bsdf)
    flags = mi.BSDFFlags.Delta | mi.BSDFFlags.Null
    for child in own.values():
        if isinstance(child, mi.BSDF):
            found |= _specular_textures(child)
        elif mi.has_flag(bsdf.flags(), flags):
            found |= dict.fromkeys((child, *children(child).values()), bsdf)
    return found
