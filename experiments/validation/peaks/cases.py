"""Media with a sharp forward peak in the cube [-1, 1]^3, with narrow sources behind and above."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from experiments.validation.thick.cases import floor, medium, objects

#: Direction of the camera from the centre of the cube, see `experiments.validation.thick.cases`.
CAMERA = np.array([2.6, 2.2, 3.6]) / np.linalg.norm([2.6, 2.2, 3.6])
#: Direction across it, in which emitters are shifted.
ACROSS = np.array([3.6, 0.0, -2.6]) / np.linalg.norm([3.6, 2.6])
#: Directions from above.
ABOVE = (-0.3, 1.0, 0.2)


def cloud(g: float, depth: float, albedo: float = 0.95) -> dict:
    """Return 8^3 random voxels of this mean optical depth across the cube."""
    values = np.random.default_rng(4).random((8, 8, 8)) ** 2
    return medium(values, depth * values.max() / values.mean(), albedo) | {
        "phase": {"type": "hg", "g": g}
    }


def behind(angle: float) -> np.ndarray:
    """Return the direction of an emitter at this angle [degrees] from the camera's axis."""
    return -np.cos(np.deg2rad(angle)) * CAMERA + np.sin(np.deg2rad(angle)) * ACROSS


def sun(towards: np.ndarray) -> dict:
    """Return a sun in the direction ``towards``."""
    direction = [-float(c) for c in towards]
    return {"sun": {"type": "directional", "direction": direction, "irradiance": 3.0}}


def point(towards: np.ndarray) -> dict:
    """Return a point emitter 6 units away."""
    position = [6 * float(c) for c in towards]
    return {"point": {"type": "point", "position": position, "intensity": 100.0}}


def lamp(towards: np.ndarray, radius: float = 0.3) -> dict:
    """Return a spherical area emitter 6 units away."""
    place = mi.ScalarTransform4f().translate([6 * float(c) for c in towards]).scale(radius)
    emitter = {"type": "area", "radiance": 100.0}
    return {"lamp": {"type": "sphere", "to_world": place, "emitter": emitter}}


def half_a_sky(degrees: float) -> dict:
    """Return an environment with an edge at this angle above the camera's axis, black below it."""
    texels = np.zeros((64, 128, 3), np.float32)
    texels[:32] = 1
    ahead, angle = -CAMERA, np.deg2rad(degrees)
    up = np.cross(np.cross(ahead, [0, 1, 0]), ahead)
    up = np.cos(angle) * up / np.linalg.norm(up) - np.sin(angle) * ahead
    axis = np.cross([0, 1, 0], up)
    axis, angle = axis / np.linalg.norm(axis), np.rad2deg(np.arccos(up[1]))
    turn = mi.ScalarTransform4f().rotate(axis.tolist(), float(angle))
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(texels), "to_world": turn}}


def sky_above_ground(reflectance: float) -> dict:
    """Return a uniform environment, and ground that ends in the upper part of the image."""
    return {"ground": ground(reflectance), "sky": {"type": "constant", "radiance": 1.0}}


def ground(reflectance: float, x: float = 0.0) -> dict:
    """Return a diffuse square of 16 x 16 slightly below the cube, with its centre at ``x``."""
    place = mi.ScalarTransform4f().translate([x, -1.05, 0]).rotate([1, 0, 0], -90).scale(8)
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}
    return {"type": "rectangle", "to_world": place, "bsdf": diffuse}


def two_grounds() -> dict:
    """Return a uniform environment, and ground of which one half is black and one bright."""
    sky = {"type": "constant", "radiance": 1.0}
    return {"sky": sky, "black": ground(0.0, -8), "bright": ground(0.9, 8)}


def panel() -> dict:
    """Return a wide area emitter behind the cube, which covers most of the image."""
    place = mi.ScalarTransform4f().look_at((-3 * CAMERA).tolist(), [0, 0, 0], [0, 1, 0]).scale(6)
    emitter = {"type": "area", "radiance": 1.0}
    return {"panel": {"type": "rectangle", "to_world": place, "emitter": emitter}}


#: Emitters (with further objects) and the medium; all orders of scattering.
CASES: dict[str, Callable[[], tuple[dict, dict]]] = {
    **{
        f"sun {angle} degrees off the axis, g {g}, depth {depth}": (
            lambda angle=angle, g=g, depth=depth: (sun(behind(angle)), cloud(g, depth))
        )
        for angle, g, depth in (
            (5, 0.85, 1), (5, 0.85, 4), (5, 0.85, 10), (10, 0.85, 4), (20, 0.85, 4),
            (45, 0.85, 4), (120, 0.85, 4), (5, 0.7, 4), (20, 0.7, 4),
        )
    },
    "point 10 degrees off the axis, g 0.85, depth 4": lambda: (
        point(behind(10)), cloud(0.85, 4),
    ),
    "lamp 40 degrees off the axis, g 0.85, depth 4": lambda: (
        lamp(behind(40)), cloud(0.85, 4),
    ),
    **{
        f"{name} above a floor, g {g}, depth {depth}": (
            lambda emitter=emitter, g=g, depth=depth: (
                emitter(np.array(ABOVE) / np.linalg.norm(ABOVE)) | floor(), cloud(g, depth)
            )
        )
        for name, emitter, g, depth in (
            ("sun", sun, 0.85, 1), ("sun", sun, 0.85, 4), ("sun", sun, 0.7, 4),
            ("point", point, 0.85, 4), ("lamp", lamp, 0.85, 4),
        )
    },
    **{
        f"edge of a sky {angle} degrees above the axis, g {g}, depth {depth}": (
            lambda angle=angle, g=g, depth=depth: (half_a_sky(angle), cloud(g, depth))
        )
        for angle, g, depth in (
            (3, 0.85, 1), (3, 0.85, 4), (3, 0.85, 10), (3, 0.7, 4), (15, 0.85, 4), (15, 0.7, 4),
            (60, 0.85, 4),
        )
    },
    **{
        f"sky above ground of albedo {albedo}, g {g}, depth 4": (
            lambda albedo=albedo, g=g: (sky_above_ground(albedo), cloud(g, 4))
        )
        for albedo, g in ((0.0, 0.85), (0.06, 0.85), (0.3, 0.85), (0.06, 0.7))
    },
    "sky above ground of two albedos, g 0.85, depth 4": lambda: (two_grounds(), cloud(0.85, 4)),
    "wide emitter behind, g 0.85, depth 4": lambda: (panel(), cloud(0.85, 4)),
}  # fmt: skip


def build(name: str) -> tuple[dict, int]:
    """Return the objects of a case and its ``max_depth``."""
    lights, interior = CASES[name]()
    return objects(interior, {}) | lights, -1
