"""Classification of emitters, and rejection of placements that Mitsuba handles inconsistently."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import UnsupportedSceneError

#: Tolerated deviation of the columns of a rotation from orthonormality.
ORTHONORMAL_TOLERANCE = 2e-3


def check_placement(emitter: mi.Emitter) -> None:
    """Reject emitters whose ``to_world`` Mitsuba evaluates and samples inconsistently.

    Raises UnsupportedSceneError for distant emitters whose ``to_world`` is more than a rotation
    with an optional reflection: ``volpath`` converges to a mixture of two different environments,
    and the sampled directions are not of unit length, which BSDFs and phase functions rely on.
    Likewise for emissive cylinders that are not circular.
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


def point_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a scene with a position but no extent."""
    flag = mi.EmitterFlags.DeltaPosition
    return [e for e in scene.emitters() if mi.has_flag(e.flags(), flag)]


def position_of(emitter: mi.Emitter) -> np.ndarray:
    """World position (3) of a point-like emitter."""
    params = mi.traverse(emitter)
    position = params["position"] if "position" in params else params["to_world"].translation()
    return np.array(position, dtype=np.float64).ravel()


def spot_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """The point-like emitters of a scene whose intensity depends on the direction."""
    return [e for e in point_lights(scene) if e.class_name() != "PointLight"]


def is_sun(emitter: mi.Emitter) -> bool:
    """Whether an emitter is infinitely distant with a single direction."""
    return mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
