"""Emitters infinitely far away, and placements of theirs that Mitsuba itself does not get right."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .errors import UnsupportedSceneError

#: How far columns of a rotation may be from unit length, and from right angles.
ORTHONORMAL = 2e-3


def check_placement(emitter: mi.Emitter) -> None:
    """Raises UnsupportedSceneError for an emitter infinitely far away whose ``to_world`` is
    more than a rotation and a mirror.

    Environments in Mitsuba are then evaluated and sampled differently (``volpath`` converges to a
    mixture of both), and the directions that they or suns are sampled in are not of unit length,
    which surfaces and phase functions rely on.
    """
    flags = emitter.flags()
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
