"""Classification of emitters, and rejection of placements that Mitsuba handles inconsistently."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.errors import UnsupportedSceneError

#: Tolerated deviation of the columns of a rotation from orthonormality.
ORTHONORMAL_TOLERANCE = 2e-3


class EmitterKind(Enum):
    """Kind of an emitter, by its extent and its directional distribution.

    To add a kind, extend this class and `kind_of`. The solver ``sweep`` rejects it until
    ``solvers/sweep.EMITTERS`` and `DistantIllumination` support it, `half_space` is not used with
    it until it is in ``half_space.EMITTERS``, and gradients of scenes without surfaces are refused
    until it is in ``gradients/backward.EMITTERS``. The solver ``path`` samples all kinds through
    Mitsuba's interface; for anisotropic scattering, narrow kinds have to be added to `sources_of`.
    """

    #: infinitely far away, with the same radiance from all directions
    CONSTANT_ENVIRONMENT = "constant environment"
    #: infinitely far away, with a radiance that depends on the direction
    ENVIRONMENT_MAP = "environment map"
    #: infinitely far away, from a single direction, with the same irradiance across the beam
    SUN = "sun"
    #: at a position, with the same intensity in all directions
    POINT = "point"
    #: at a position, within a cone
    SPOT = "spot"
    #: at a position, with an intensity that depends on the direction in any other way
    PROJECTOR = "projector"
    #: on a surface, in all directions
    AREA = "area"
    #: on a surface, in a single direction
    DIRECTIONAL_AREA = "directional area"
    UNKNOWN = "unknown"

    @property
    def is_environment(self) -> bool:
        """Whether rays that leave the scene hit it."""
        return self in (EmitterKind.CONSTANT_ENVIRONMENT, EmitterKind.ENVIRONMENT_MAP)

    @property
    def has_one_direction(self) -> bool:
        """Whether it emits in a single direction."""
        return self in (EmitterKind.SUN, EmitterKind.DIRECTIONAL_AREA)

    @property
    def is_point_like(self) -> bool:
        """Whether it has a position and no extent."""
        return self in POINT_LIKE


#: Kinds without extent at a finite position, and the subset whose intensity depends on direction.
POINT_LIKE = (EmitterKind.POINT, EmitterKind.SPOT, EmitterKind.PROJECTOR)
SPOT_LIKE = (EmitterKind.SPOT, EmitterKind.PROJECTOR)


def kind_of(emitter: mi.Emitter) -> EmitterKind:
    """Classify an emitter by Mitsuba's flags and, if these are ambiguous, by its plugin."""
    flags, name = emitter.flags(), emitter.class_name()
    if mi.has_flag(flags, mi.EmitterFlags.Surface):
        if mi.has_flag(flags, mi.EmitterFlags.DeltaDirection):
            return EmitterKind.DIRECTIONAL_AREA
        if mi.has_flag(flags, mi.EmitterFlags.DeltaPosition):
            return EmitterKind.UNKNOWN
        return EmitterKind.AREA
    if mi.has_flag(flags, mi.EmitterFlags.DeltaDirection):
        return EmitterKind.UNKNOWN if varies_in_space(emitter) else EmitterKind.SUN
    if mi.has_flag(flags, mi.EmitterFlags.DeltaPosition):
        kinds = {"PointLight": EmitterKind.POINT, "SpotLight": EmitterKind.SPOT}
        return kinds.get(name, EmitterKind.PROJECTOR)
    if mi.has_flag(flags, mi.EmitterFlags.Infinite):
        is_constant = name == "ConstantBackgroundEmitter"
        return EmitterKind.CONSTANT_ENVIRONMENT if is_constant else EmitterKind.ENVIRONMENT_MAP
    return EmitterKind.UNKNOWN


def emits_in_one_direction(emitter: mi.Emitter) -> bool:
    """Return whether its radiance has the same single direction everywhere, whatever its kind."""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)


def are_distant(emitters: mi.EmitterPtr) -> mi.Bool:
    """Return whether emitters are at an infinite distance: environments and suns."""
    return mi.has_flag(emitters.flags(), mi.EmitterFlags.Infinite)


def varies_in_space(emitter: mi.Emitter) -> bool:
    """Return whether the radiance of a surface, or the irradiance of a beam, depends on the
    position.
    """
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


class EmittersByKind(Immutable):
    """The emitters of a scene, in the order of the scene, with their kinds."""

    def __init__(self, emitters: Sequence[mi.Emitter]) -> None:
        self._emitters = tuple((emitter, kind_of(emitter)) for emitter in emitters)

    def __len__(self) -> int:
        return len(self._emitters)

    def __iter__(self) -> Iterator[tuple[mi.Emitter, EmitterKind]]:
        return iter(self._emitters)

    def of(self, *kinds: EmitterKind) -> list[mi.Emitter]:
        """Return the emitters of these kinds, in the order of the scene."""
        return [emitter for emitter, kind in self._emitters if kind in kinds]


def check_placement(emitter: mi.Emitter) -> None:
    """Reject emitters whose ``to_world`` Mitsuba evaluates and samples inconsistently.

    Raises UnsupportedSceneError for distant emitters whose ``to_world`` is more than a rotation
    with an optional reflection: ``volpath`` converges to a mixture of two different environments,
    and the sampled directions are not of unit length, which BSDFs and phase functions rely on.
    Likewise for emissive cylinders that are not circular.
    """
    kind = kind_of(emitter)
    if kind in (EmitterKind.AREA, EmitterKind.DIRECTIONAL_AREA):
        _check_shape(emitter)
    if not (kind.is_environment or kind.has_one_direction):
        return
    params = mi.traverse(emitter)
    if "to_world" not in params:
        return
    linear = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    if np.abs(linear.T @ linear - np.eye(3)).max() <= ORTHONORMAL_TOLERANCE:
        return
    lengths = ", ".join(f"{n:.3g}" for n in np.linalg.norm(linear, axis=0))
    raise UnsupportedSceneError(
        f'irrcache: emitter "{emitter.id()}" ({emitter.class_name()}) has a to_world that is not '
        f"a rotation (its axes have the lengths {lengths}, or are not orthogonal), which Mitsuba "
        "evaluates and samples inconsistently. Remove scale and shear, which have no meaning for a "
        "distant emitter; a reflection is supported. (rotate needs an axis of length 1.) Otherwise "
        'render this scene with "volpath".'
    )


def _check_shape(emitter: mi.Emitter) -> None:
    """Reject emissive cylinders that are not circular.

    Mitsuba samples them as if they were circular, and ``volpath`` converges to a mixture of that
    and of the shape that rays intersect.
    """
    shape = emitter.get_shape()
    if shape is None or shape.class_name() != "Cylinder":
        return
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    x, y, z = matrix[:3, :3].T
    radius = np.linalg.norm(x)
    uneven = abs(np.linalg.norm(y) - radius) > ORTHONORMAL_TOLERANCE * radius
    cosines = [
        abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b) for a, b in ((x, y), (x, z), (y, z))
    ]
    if uneven or max(cosines) > ORTHONORMAL_TOLERANCE:
        raise UnsupportedSceneError(
            f'irrcache: shape "{shape.id()}" (Cylinder) is an emitter and not round: its to_world '
            f"has the radii {radius:.3g} and {np.linalg.norm(y):.3g}, or a shear, which Mitsuba "
            "evaluates and samples inconsistently. Give it the same scale along x and y, or "
            'use a mesh. Otherwise render this scene with "volpath".'
        )


def illuminating(scene: mi.Scene) -> list[mi.Emitter]:
    """Return the emitters that illuminate a scene: all but those without extent, or in a single
    direction, whose ``sampling_weight`` is 0, because no integrator's paths can reach these.
    """
    return [emitter for emitter in scene.emitters() if not is_never_sampled(emitter)]


def is_never_sampled(emitter: mi.Emitter) -> bool:
    """Return whether no path can reach an emitter: it has to be sampled, with probability 0."""
    if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta):
        return False
    return not np.any(np.array(mi.traverse(emitter).get("sampling_weight", 1.0)))


def point_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """Return the emitters of a scene that have a finite position and no extent."""
    return EmittersByKind(illuminating(scene)).of(*POINT_LIKE)


def spot_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """Return the point-like emitters of a scene whose intensity depends on the direction."""
    return EmittersByKind(illuminating(scene)).of(*SPOT_LIKE)


def suns(scene: mi.Scene) -> list[mi.Emitter]:
    """Return the emitters of a scene that emit in a single direction from infinitely far away."""
    return EmittersByKind(illuminating(scene)).of(EmitterKind.SUN)


def position_of(emitter: mi.Emitter) -> np.ndarray:
    """Return the world position (3) of a point-like emitter."""
    params = mi.traverse(emitter)
    position = params["position"] if "position" in params else params["to_world"].translation()
    return np.array(position, dtype=np.float64).ravel()
