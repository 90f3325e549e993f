"""What irrcache finds in a scene, and what it has to refuse."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .boundary import Boundary, boundary_of
from .errors import UnsupportedSceneError
from .medium import MediumGrid, bake


def find_medium(scene: mi.Scene) -> tuple[mi.Medium, mi.Shape] | None:
    """The one medium of a scene and the shape around it; None for a scene without media.

    Raises UnsupportedSceneError, naming the object, for what would not be rendered right.
    """
    bounded = [s for s in scene.shapes() if s.interior_medium() or s.exterior_medium()]
    if not bounded:
        for sensor in scene.sensors():
            if sensor.get_medium() is not None:
                _refuse(f'sensor "{sensor.id()}" is in a medium that no shape bounds')
        return None
    for shape in scene.shapes():
        _check_shape(shape)
    if len(bounded) > 1:
        names = ", ".join(f'"{s.id()}"' for s in bounded)
        _refuse(f"{len(bounded)} shapes bound media ({names}), and only one is supported so far")
    (shape,) = bounded
    medium = shape.interior_medium()
    for sensor in scene.sensors():
        if sensor.get_medium() not in (None, medium):
            _refuse(
                f'sensor "{sensor.id()}" is in another medium than the interior of "{shape.id()}"'
            )
    return medium, shape


def _check_shape(shape: mi.Shape) -> None:
    name = f'shape "{shape.id()}" ({shape.class_name()})'
    if shape.exterior_medium() is not None:
        _refuse(f"{name} has an exterior medium")
    if shape.is_emitter():
        _refuse(f"{name} is an area emitter")
    if shape.is_sensor():
        _refuse(f"{name} is a sensor")
    bsdf = shape.bsdf()
    if bsdf is None or int(bsdf.flags()) & int(mi.BSDFFlags.All) & ~int(mi.BSDFFlags.Null):
        hint = (
            ' If it only bounds the medium, add <bsdf type="null"/> to it.'
            if shape.interior_medium() is not None
            else ""
        )
        kind = bsdf.class_name() if bsdf is not None else "none"
        _refuse(f"{name} is a surface that light interacts with (BSDF: {kind})", hint)


def _refuse(reason: str, hint: str = "") -> None:
    raise UnsupportedSceneError(
        f"irrcache: {reason}, which would be rendered wrongly.{hint} Otherwise render this scene "
        'with "volpath".'
    )


def bake_scene(scene: mi.Scene) -> MediumGrid | None:
    """The scene's medium on its grids, or None where there is none."""
    found = find_medium(scene)
    if found is None:
        return None
    medium, shape = found
    boundary = boundary_of(scene, shape)
    for emitter in scene.emitters():
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
            _check_point_light(emitter, boundary)
    return bake(medium, boundary)


def _check_point_light(emitter: mi.Emitter, boundary: Boundary) -> None:
    """Refuses a point-like light inside the medium: no grid can hold its 1/r^2."""
    params = mi.traverse(emitter)
    position = params["position"] if "position" in params else params["to_world"].translation()
    position = np.array(position, dtype=np.float64).ravel()
    if boundary.contains(position):
        _refuse(
            f'emitter "{emitter.id()}" ({emitter.class_name()}) is inside the medium, at {position}'
        )
