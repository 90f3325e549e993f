"""Area emitters inside and beside a medium in the cube [-1, 1]^3."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from experiments.validation.thick.cases import contrast, floor, medium, objects


def lamp(shape: str, place: mi.ScalarTransform4f, radiance: float = 10.0, **more) -> dict:
    """Return a shape that emits on its front."""
    emitter = {"type": "area", "radiance": radiance}
    return {"lamp": {"type": shape, "to_world": place, "emitter": emitter} | more}


def flat(shape: str, size: float, centre=(0.0, 0.0, 0.0), towards=(0.4, 1.0, 0.3), **more) -> dict:
    """Return a flat emitter of half-width ``size`` that faces the direction ``towards``."""
    target = [float(c + t) for c, t in zip(centre, towards, strict=True)]
    look = mi.ScalarTransform4f().look_at(list(centre), target, [0, 0.3, 1])
    return lamp(shape, look.scale(size), **more)


def fog(sigma_t: float, albedo: float = 0.9) -> dict:
    """Return a homogeneous medium."""
    return medium(None, 2 * sigma_t, albedo)


def ball() -> dict:
    """Return an opaque ball above an emitter at the centre."""
    place = {"center": [0.25, 0.45, 0.2], "radius": 0.15}
    return {"ball": {"type": "sphere", "bsdf": {"type": "diffuse"}} | place}


def sphere(radius: float, centre=(0.0, 0.0, 0.0)) -> dict:
    """Return a spherical emitter."""
    place = mi.ScalarTransform4f().translate(list(centre)).scale(radius)
    return lamp("sphere", place)


#: Emitters (with further objects), the medium, and ``max_depth``.
CASES: dict[str, Callable[[], tuple[dict, dict, int]]] = {
    "square 1.0, thin fog, single": lambda: (flat("rectangle", 0.5), fog(0.5), 2),
    "square 1.0, thin fog, all orders": lambda: (flat("rectangle", 0.5), fog(0.5), -1),
    "square 1.6 near the floor, fog, single": lambda: (
        flat("rectangle", 0.8, (0, -0.7, 0), (0, 1, 0)), fog(1.0), 2,
    ),
    "square 0.2, fog, single": lambda: (flat("rectangle", 0.1, (0.2, -0.3, 0.1)), fog(1.0), 2),
    "square 1.0, dense fog, all orders": lambda: (flat("rectangle", 0.5), fog(6.0), -1),
    "square 1.0, 4^3 grid, single": lambda: (
        flat("rectangle", 0.5), medium(contrast(), 8, 0.9), 2,
    ),
    "disk 0.8, fog, all orders": lambda: (
        flat("disk", 0.4, (0.1, 0.2, -0.2), (1, 0.5, 0.6)), fog(1.0), -1,
    ),
    "square 1.0 and a ball, fog, single": lambda: (
        flat("rectangle", 0.5) | ball(), fog(1.0), 2,
    ),
    "sphere 0.5, fog, single": lambda: (sphere(0.25, (0.1, -0.2, 0)), fog(1.0), 2),
    "square 1.6 above the cube, fog, single": lambda: (
        flat("rectangle", 0.8, (0, 1.3, 0), (0, -1, 0)), fog(1.0), 2,
    ),
    "square 1.6 above the cube over a floor, fog, all orders": lambda: (
        flat("rectangle", 0.8, (0, 1.3, 0), (0, -1, 0)) | floor(), fog(1.0), -1,
    ),
    "square 3.0 above, dense fog, single": lambda: (
        flat("rectangle", 1.5, (0, 1.3, 0), (0, -1, 0)), fog(6.0), 2,
    ),
    "square 3.0 above, dense fog, all orders": lambda: (
        flat("rectangle", 1.5, (0, 1.3, 0), (0, -1, 0)), fog(6.0), -1,
    ),
    "disk 4.0 beside, denser fog, single": lambda: (
        flat("disk", 2.0, (-1.4, 0.2, 0.1), (1, 0, 0)), fog(12.0), 2,
    ),
    "sphere 6.0 above, denser fog, single": lambda: (sphere(3.0, (0, 4.5, 0)), fog(12.0), 2),
}  # fmt: skip


def build(name: str) -> tuple[dict, int]:
    """Return the objects of a case and its ``max_depth``.

    Emitters within the medium have it on both sides, as Mitsuba requires.
    """
    lights, interior, depth = CASES[name]()
    shared = {"fog": interior | {"id": "fog"}}
    within = {"type": "ref", "id": "fog"}
    lights = {key: _in_medium(value, within) for key, value in lights.items()}
    return shared | objects(within, {}) | lights, depth


def _in_medium(shape: dict, within: dict) -> dict:
    """Return a shape with ``within`` as its exterior if it lies in the cube."""
    bounds = mi.load_dict(shape).bbox()
    if np.abs([np.array(bounds.min), np.array(bounds.max)]).max() > 1:
        return shape
    sides = {"exterior": within}
    if shape["type"] in ("rectangle", "disk"):
        sides["interior"] = within
    return shape | sides
