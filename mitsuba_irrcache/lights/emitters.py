"""Emitters infinitely far away, and placements of theirs that Mitsuba itself does not get right."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import UnsupportedSceneError

#: How far columns of a rotation may be from unit length, and from right angles.
ORTHONORMAL = 2e-3


def check_placement(emitter: mi.Emitter) -> None:
    """Raises UnsupportedSceneError for an emitter infinitely far away whose ``to_world`` is
    more than a rotation and a mirror, and for a cylinder that is not round.

    Environments in Mitsuba are then evaluated and sampled differently (``volpath`` converges to a
    mixture of both), and the directions that they or suns are sampled in are not of unit length,
    which surfaces and phase functions rely on.
    """
    flags = emitter.flags()
    if mi.has_flag(flags, mi.EmitterFlags.Surface):
        _check_shape(emitter)
    if not (
        mi.has_flag(flags, mi.EmitterFlags.Infinite)
        or mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
    ):
        return
    params = mi.traverse(emitter)
    if "to_world" not in params:
        return
    linear = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    if np.abs(linear.T @ linear - np.eye(3)).max() <= ORTHONORMAL:
        return
    lengths = ", ".join(f"{n:.3g}" for n in np.linalg.norm(linear, axis=0))
    raise UnsupportedSceneError(
        f'irrcache: emitter "{emitter.id()}" ({emitter.class_name()}) has a to_world that is no '
        f"rotation (its axes have the lengths {lengths}, or are not at right angles), and Mitsuba "
        "evaluates and samples it differently then. Take scale and shear out of it: distances mean "
        "nothing for what is infinitely far away. (rotate needs an axis of length 1.) A mirror may "
        'stay. Otherwise render this scene with "volpath".'
    )


def _check_shape(emitter: mi.Emitter) -> None:
    """Refuses an emissive cylinder that is not round: Mitsuba samples it as if it was, and
    ``volpath`` converges to a mixture of that and of what rays meet.
    """
    shape = emitter.get_shape()
    if shape is None or shape.class_name() != "Cylinder":
        return
    matrix = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    x, y, z = matrix[:3, :3].T
    radius = np.linalg.norm(x)
    uneven = abs(np.linalg.norm(y) - radius) > ORTHONORMAL * radius
    cosines = [
        abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b) for a, b in ((x, y), (x, z), (y, z))
    ]
    if uneven or max(cosines) > ORTHONORMAL:
        raise UnsupportedSceneError(
            f'irrcache: shape "{shape.id()}" (Cylinder) is an emitter and not round: its to_world '
            f"has the radii {radius:.3g} and {np.linalg.norm(y):.3g}, or a shear, and Mitsuba "
            "evaluates and samples it differently then. Give it the same scale along x and y, or "
            'use a mesh. Otherwise render this scene with "volpath".'
        )


def point_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a scene that have a place and no size."""
    flag = mi.EmitterFlags.DeltaPosition
    return [e for e in scene.emitters() if mi.has_flag(e.flags(), flag)]


def position_of(emitter: mi.Emitter) -> np.ndarray:
    """Where a point-like emitter is (3), world space."""
    params = mi.traverse(emitter)
    position = params["position"] if "position" in params else params["to_world"].translation()
    return np.array(position, dtype=np.float64).ravel()


def spot_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a scene whose intensity depends on the direction and that have no size."""
    return [e for e in point_lights(scene) if e.class_name() != "PointLight"]


def is_sun(emitter: mi.Emitter) -> bool:
    """Whether an emitter is infinitely far away, in a single direction."""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
