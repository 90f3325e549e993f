"""Scenes of each kind, all procedural: no data are needed."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import mitsuba as mi
import numpy as np


def colour(*rgb: float) -> dict:
    """Return a colour."""
    return {"type": "rgb", "value": list(rgb)}


def placed(centre, scale, towards=None):
    """Return a ``to_world``."""
    transform = mi.ScalarTransform4f()
    if towards is not None:
        return transform.look_at(list(centre), list(towards), [0.1, 1, 0.2]).scale(list(scale))
    return transform.translate(list(centre)).scale(list(scale))


def smoke(side: int = 48, scale: float = 6.0, albedo=(0.9, 0.9, 0.9), **more) -> dict:
    """Return a heterogeneous medium in the cube [-1, 1]^3: a blob with noise."""
    z, y, x = (np.indices((side,) * 3) + 0.5) / side * 2 - 1
    wisps = 0.6 + 0.4 * np.sin(7 * x + 3 * np.sin(5 * y)) * np.sin(6 * z + 2 * x) * np.sin(
        5 * y - z
    )
    density = np.clip(1.1 - np.sqrt(x**2 + 1.4 * y**2 + z**2), 0, 1) * wisps
    return medium(density[..., None] * more.pop("tint", np.ones(1)), scale, albedo) | more


def medium(density: np.ndarray, scale: float, albedo) -> dict:
    """Return a medium over the cube [-1, 1]^3."""
    place = placed((-1, -1, -1), (2, 2, 2))
    grid = mi.VolumeGrid(density.astype(np.float32))
    sigma_t = {"type": "gridvolume", "grid": grid, "raw": True, "to_world": place}
    uniform = {"type": "constvolume", "value": colour(*albedo)}
    return {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": uniform, "scale": scale}


def box(interior: dict, centre=(0, 0, 0), scale=(1, 1, 1)) -> dict:
    """Return a null boundary."""
    null = {"type": "null"}
    return {"type": "cube", "to_world": placed(centre, scale), "bsdf": null, "interior": interior}


def diffuse(*rgb: float) -> dict:
    """Return a BSDF."""
    return {"type": "diffuse", "reflectance": colour(*rgb)}


def wall(centre, towards, size=2.0, bsdf=None) -> dict:
    """Return a square."""
    place = placed(centre, (size, size, 1), towards)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or diffuse(0.7, 0.7, 0.7)}


def ground(height: float) -> dict:
    """Return the ground, with squares of two colours."""
    squares = {
        "type": "checkerboard", "color0": colour(0.6, 0.5, 0.4), "color1": colour(0.3, 0.35, 0.2),
        "to_uv": mi.ScalarTransform4f().scale([12, 12, 1]),
    }  # fmt: skip
    return wall((0, height, 0), (0, 5, 0.001), 5.0, {"type": "diffuse", "reflectance": squares})


def sky() -> dict:
    """Return a constant environment."""
    return {"type": "constant", "radiance": colour(0.6, 0.8, 1.0)}


def sun() -> dict:
    """Return a directional emitter."""
    return {"type": "directional", "direction": [0.4, -1.0, 0.55], "irradiance": 3.0}


def kind_cloud() -> dict:
    """Return a cloud alone under a sky."""
    return {"box": box(smoke(albedo=(0.99,) * 3)), "sky": sky()}


def kind_ground() -> dict:
    """Return the cloud over textured ground, with a sun."""
    return kind_cloud() | {"ground": ground(-1.1), "sun": sun()}


def kind_cut() -> dict:
    """Return the cloud with ground that cuts it."""
    return kind_cloud() | {"ground": ground(-0.35), "sun": sun()}


def kind_forward_ground() -> dict:
    """Return the same with a strongly forward scattering cloud."""
    return kind_ground() | kind_forward()


def kind_room() -> dict:
    """Return smoke in a room with an area light under its ceiling."""
    red, green = diffuse(0.6, 0.1, 0.1), diffuse(0.1, 0.5, 0.1)
    area = {"type": "area", "radiance": 12.0}
    return {
        "box": box(smoke()),
        "floor": wall((0, -1.5, 0), (0, 0, 0.001)), "ceiling": wall((0, 1.5, 0), (0, 0, 0.001)),
        "left": wall((-1.5, 0, 0), (0, 0, 0), 2.0, red),
        "right": wall((1.5, 0, 0), (0, 0, 0), 2.0, green), "back": wall((0, 0, 1.5), (0, 0, 0)),
        "lamp": wall((0, 1.45, 0), (0, 0, 0.001), 0.4) | {"emitter": area},
    }  # fmt: skip


def kind_implant() -> dict:
    """Return a dense body with an opaque metal rod in it."""
    _, y, x = (np.indices((48,) * 3) + 0.5) / 48 * 2 - 1
    body = 2.0 * (x**2 + y**2 < 0.7) + 8.0 * (np.hypot(x - 0.35, y) < 0.2)
    metal = {"type": "roughconductor", "alpha": 0.2}
    rod = {"type": "cylinder", "p0": [-0.3, 0, -0.8], "p1": [-0.3, 0, 0.8], "radius": 0.12}
    inside = {"exterior": {"type": "ref", "id": "body"}, "bsdf": metal}
    ends = {
        f"end{i}": {
            "type": "disk", "to_world": placed((-0.3, 0, z), (0.12, 0.12, 1), (-0.3, 0, 2 * z)),
        } | inside
        for i, z in enumerate((-0.8, 0.8))
    }  # fmt: skip
    fluid = medium(body[..., None], 1.0, (0.9, 0.8, 0.7)) | {"id": "body"}
    return (
        {"body": fluid, "box": box({"type": "ref", "id": "body"}), "rod": rod | inside}
        | ends
        | {"sky": sky()}
    )


def kind_two() -> dict:
    """Return two media side by side."""
    other = {"type": "homogeneous", "sigma_t": 2.0, "albedo": colour(0.9, 0.6, 0.3)}
    ball = {"type": "sphere", "center": [1.5, 0.2, 0], "radius": 0.45, "bsdf": {"type": "null"}}
    return {"box": box(smoke()), "ball": ball | {"interior": other}, "sky": sky(), "sun": sun()}


def kind_chromatic() -> dict:
    """Return extinction of 1 : 4 : 10."""
    tint = np.array([0.1, 0.4, 1.0])
    return {"box": box(smoke(scale=12.0, tint=tint, albedo=(0.9, 0.9, 0.9))), "sky": sky()}


def kind_fog() -> dict:
    """Return a camera in fog, before a ball."""
    fog = {"type": "homogeneous", "sigma_t": 0.5, "albedo": 0.9, "id": "fog"}
    reference = {"type": "ref", "id": "fog"}
    ball = {"type": "sphere", "radius": 0.5, "bsdf": diffuse(0.8, 0.3, 0.2), "exterior": reference}
    look = mi.ScalarTransform4f().look_at([0.3, 0.4, -1.8], [0, 0, 0], [0, 1, 0])
    camera = {"to_world": look, "fov": 60.0, "medium": reference}
    return {"fog": fog, "box": box(reference, scale=(2, 2, 2)), "ball": ball, "sky": sky()} | {
        "sensor": sensor() | camera
    }


def kind_anisotropic() -> dict:
    """Return a medium with hg, g = 0.5, under a sky and a sun."""
    return {"box": box(smoke(phase={"type": "hg", "g": 0.5})), "sky": sky(), "sun": sun()}


def kind_forward() -> dict:
    """Return a strongly forward scattering cloud under a sky and a sun."""
    cloud = smoke(albedo=(0.99,) * 3, phase={"type": "hg", "g": 0.85})
    return {"box": box(cloud), "sky": sky(), "sun": sun()}


def kind_fog_room() -> dict:
    """Return a Cornell box that is full of fog, with two objects in it."""
    fog = {"type": "homogeneous", "sigma_t": 0.4, "albedo": 0.9, "id": "fog"}
    room = {k: v for k, v in kind_room().items() if k != "box"}
    filled = box({"type": "ref", "id": "fog"}, scale=(1.499, 1.499, 1.499))
    block = {
        "type": "cube", "to_world": placed((0.6, -1.0, 0.5), (0.4, 0.5, 0.4)),
        "bsdf": diffuse(0.7, 0.7, 0.7),
    }  # fmt: skip
    ball = {
        "type": "sphere", "center": [-0.6, -1.05, 0], "radius": 0.45, "bsdf": diffuse(0.2, 0.3, 0.7)
    }  # fmt: skip
    return {"fog": fog, "filled": filled} | room | {"block": block, "ball": ball}


def kind_objects() -> dict:
    """Return smoke with a coloured ball, a black rod and a thin sheet in it."""
    ball = {
        "type": "sphere", "center": [-0.4, 0.1, -0.2], "radius": 0.25,
        "bsdf": diffuse(0.7, 0.2, 0.1),
    }  # fmt: skip
    rod = {
        "type": "cylinder", "p0": [0.3, -0.7, 0.1], "p1": [0.3, 0.7, 0.1], "radius": 0.06,
        "bsdf": {"type": "twosided", "bsdf": diffuse(0.02, 0.02, 0.02)},
    }  # fmt: skip
    sheet = wall(
        (0, -0.3, 0.2), (0.3, 1, 0.2), 0.35, {"type": "twosided", "b": diffuse(0.3, 0.6, 0.3)}
    )
    return {
        "box": box(smoke()),
        "ball": ball,
        "rod": rod,
        "sheet": sheet,
        "sky": sky(),
        "sun": sun(),
    }


def kind_nested() -> dict:
    """Return a dense ball nested in a fog ball."""
    core = {"type": "homogeneous", "sigma_t": 6.0, "albedo": colour(0.95, 0.7, 0.4), "id": "core"}
    fog = {"type": "homogeneous", "sigma_t": 0.7, "albedo": 0.95, "id": "fog"}
    null = {"type": "null"}
    outer = {
        "type": "sphere", "radius": 1.1, "bsdf": null, "interior": {"type": "ref", "id": "fog"}
    }  # fmt: skip
    inner = {
        "type": "sphere", "center": [0.2, 0.1, -0.1], "radius": 0.4, "bsdf": null,
        "interior": {"type": "ref", "id": "core"}, "exterior": {"type": "ref", "id": "fog"},
    }  # fmt: skip
    return {"core": core, "fog": fog, "outer": outer, "inner": inner, "sky": sky(), "sun": sun()}


def kind_mesh() -> dict:
    """Return a homogeneous medium in a closed mesh with bumps."""
    inside = {"type": "homogeneous", "sigma_t": 4.0, "albedo": colour(0.95, 0.9, 0.8)}
    shape = bumpy_ball()
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "null"})
    props["interior"] = mi.load_dict(inside)
    mesh = mi.Mesh("bumpy", len(shape[0]), len(shape[1]), props=props)
    values = mi.traverse(mesh)
    values["vertex_positions"] = shape[0].ravel()
    values["faces"] = shape[1].ravel()
    values.update()
    return {"mesh": mesh, "sky": sky(), "sun": sun()}


def bumpy_ball(rows: int = 96, columns: int = 192) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of a ball whose radius varies, closed at its poles."""
    theta, phi = np.meshgrid(
        np.arange(1, rows) / rows * np.pi, np.arange(columns) / columns * 2 * np.pi, indexing="ij"
    )
    radius = 0.85 + 0.12 * np.sin(4 * theta) * np.sin(5 * phi) * np.sin(theta)
    x, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
    rings = (radius[..., None] * np.stack([x, np.cos(theta), z], axis=-1)).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0.85, 0]], rings, [[0, -0.85, 0]]])
    a = 1 + np.arange(columns)
    b = 1 + (a % columns)  # the next vertex of a ring
    below = [r * columns for r in range(rows - 1)]
    strips = [
        np.stack(corners, axis=-1)
        for r, s in pairwise(below)
        for corners in ((a + r, b + r, a + s), (b + r, b + s, a + s))
    ]
    top, bottom = np.zeros_like(a), np.full_like(a, len(vertices) - 1)
    caps = [np.stack([top, b, a], -1), np.stack([bottom, a + below[-1], b + below[-1]], -1)]
    return vertices.astype(np.float32), np.concatenate(strips + caps).astype(np.uint32)


def in_glass(radius: float, interior: dict, bsdf: dict | None = None) -> dict:
    """Return a ball of glass that is filled with a medium."""
    glass = bsdf or {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    return {"type": "sphere", "radius": radius, "bsdf": glass, "interior": interior}


def kind_globe() -> dict:
    """Return smoke in a hollow ball of glass."""
    hollow = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}
    outer = {"type": "sphere", "radius": 1.0} | {"bsdf": in_glass(1.0, {})["bsdf"]}
    return {"outer": outer, "inner": in_glass(0.93, smoke(), hollow), "sky": sky()}


def kind_milk() -> dict:
    """Return milk in a ball of glass."""
    milk = {"type": "homogeneous", "sigma_t": 10.0, "albedo": 0.99}
    return {"ball": in_glass(1.0, milk), "sky": sky()}


def kind_jade() -> dict:
    """Return jade behind a rough boundary, under a lamp."""
    jade = {"type": "homogeneous", "sigma_t": 8.0, "albedo": colour(0.9, 0.98, 0.93)}
    rough = {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.6, "ext_ior": 1.0}
    lamp = wall((1.5, 2.5, -2), (0, 0, 0), 0.7) | {"emitter": {"type": "area", "radiance": 12.0}}
    return {"ball": in_glass(1.0, jade, rough), "sky": sky(), "lamp": lamp}


KINDS: dict[str, Callable[[], dict]] = {
    "cloud, environment": kind_cloud,
    "chromatic extinction 1 : 4 : 10, environment": kind_chromatic,
    "hg, g = 0.5, environment and sun": kind_anisotropic,
    "cloud, hg, g = 0.85, environment and sun": kind_forward,
    "cloud over textured ground, environment and sun": kind_ground,
    "the same, hg, g = 0.85": kind_forward_ground,
    "ground cuts the cloud": kind_cut,
    "room with smoke, lamp visible": kind_room,
    "Cornell box full of fog, with objects": kind_fog_room,
    "ball, rod and sheet inside smoke": kind_objects,
    "body with an implant": kind_implant,
    "camera in fog, before a ball": kind_fog,
    "two media, environment and sun": kind_two,
    "nested media": kind_nested,
    "smoke in a hollow globe of glass": kind_globe,
    "milk in a ball of glass": kind_milk,
    "jade behind rough glass, lamp": kind_jade,
    "medium in a mesh": kind_mesh,
}


def film(pixels: int = 64) -> dict:
    """Return a film of so many pixels per side."""
    return {
        "type": "hdrfilm", "width": pixels, "height": pixels, "component_format": "float32",
        "rfilter": {"type": "box"},
    }  # fmt: skip


def sensor() -> dict:
    """Return the sensor."""
    look = mi.ScalarTransform4f().look_at([0.8, 0.9, -4.5], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 36.0, "to_world": look, "film": film()}
