"""Media behind boundaries that refract."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from experiments.validation.thick.cases import SKY, SUN, lamp, scene

GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
ROUGH = {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.6, "ext_ior": 1.0}
NULL = {"type": "null"}
DIM = {"sky": {"type": "constant", "radiance": 0.3}}


def placed(centre: tuple = (0, 0, 0), scale: tuple = (1, 1, 1)) -> mi.ScalarTransform4f:
    """Return a translation after a scaling."""
    return mi.ScalarTransform4f().translate(list(centre)).scale(list(scale))


def colour(*rgb: float) -> dict:
    """Return a colour."""
    return {"type": "rgb", "value": list(rgb)}


def fluid(depth: float, albedo=0.99, **more) -> dict:
    """Return a homogeneous medium of this optical depth over 2 units."""
    value = colour(*albedo) if np.ndim(albedo) else albedo
    return {"type": "homogeneous", "sigma_t": 0.5 * depth, "albedo": value} | more


def smoke(scale: float, albedo: float = 0.9) -> dict:
    """Return a heterogeneous medium in the cube [-1, 1]^3: a blob with noise."""
    z, y, x = (np.indices((48,) * 3) + 0.5) / 48 * 2 - 1
    wisps = 0.6 + 0.4 * np.sin(7 * x + 3 * np.sin(5 * y)) * np.sin(6 * z + 2 * x) * np.sin(5 * y)
    density = np.clip(1.1 - np.sqrt(x**2 + 1.4 * y**2 + z**2), 0, 1) * wisps
    grid = mi.VolumeGrid(density[..., None].astype(np.float32))
    place = placed((-1, -1, -1), (2, 2, 2))
    sigma_t = {"type": "gridvolume", "grid": grid, "raw": True, "to_world": place}
    uniform = {"type": "constvolume", "value": albedo}
    return {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": uniform, "scale": scale}


def ball(interior: dict, bsdf: dict = GLASS, radius: float = 1.0, centre=(0, 0, 0), **more) -> dict:
    """Return a sphere filled with a medium."""
    shape = {"type": "sphere", "radius": radius, "center": list(centre), "bsdf": bsdf}
    return shape | {"interior": interior} | more


def cube(interior: dict, bsdf: dict = GLASS, centre=(0, 0, 0), scale=(0.8, 0.8, 0.8)) -> dict:
    """Return a cube filled with a medium."""
    place = placed(centre, scale)
    return {"type": "cube", "to_world": place, "bsdf": bsdf, "interior": interior}


def globe() -> dict:
    """Return smoke in a hollow ball of glass."""
    inwards = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}
    outer = {"type": "sphere", "radius": 1.0, "bsdf": GLASS}
    return {"outer": outer, "inner": ball(smoke(10.0), inwards, 0.93)}


def tumbler() -> dict:
    """Return a closed glass cylinder filled with milk."""
    milk = {"milk": fluid(8.0) | {"id": "milk"}}
    inside = {"bsdf": GLASS, "interior": {"type": "ref", "id": "milk"}}
    wall = {"type": "cylinder", "p0": [0, -0.8, 0], "p1": [0, 0.8, 0], "radius": 0.6} | inside
    ends = {
        f"end{i}": {
            "type": "disk",
            "to_world": mi.ScalarTransform4f()
            .look_at([0, y, 0], [0, 2 * y, 0], [0, 0, 1])
            .scale(0.6),
        }
        | inside
        for i, y in enumerate((-0.8, 0.8))
    }
    return milk | {"wall": wall} | ends


def torus(interior: dict, bsdf: dict) -> mi.Mesh:
    """Return a mesh without UVs, filled with a medium."""
    n, m, large, small = 48, 24, 0.7, 0.35
    a, b = np.meshgrid(np.arange(n) / n * 2 * np.pi, np.arange(m) / m * 2 * np.pi, indexing="ij")
    ring = large + small * np.cos(b)
    points = np.stack([ring * np.cos(a), small * np.sin(b), -ring * np.sin(a)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    corner = [(i + k) % n * m + (j + h) % m for k, h in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate(
        [np.stack([corner[k] for k in t], -1).reshape(-1, 3) for t in ((0, 1, 2), (0, 2, 3))]
    )
    properties = mi.Properties()
    properties["bsdf"], properties["interior"] = mi.load_dict(bsdf), mi.load_dict(interior)
    mesh = mi.Mesh("torus", len(points), len(faces), props=properties)
    values = mi.traverse(mesh)
    values["vertex_positions"] = points.astype(np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    values.update()
    return mesh


def jade() -> dict:
    """Return a green medium."""
    return fluid(15, (0.9, 0.98, 0.93))


def map_of_the_sky() -> dict:
    """Return an environment map with a bright, wide region."""
    v, u = np.meshgrid(np.linspace(0, 1, 32), np.linspace(0, 1, 64), indexing="ij")
    values = 0.4 + 0.4 * np.stack([1 - v, 1 - 0.5 * v, np.ones_like(v)], -1)
    values += 6 * np.exp(-(((u - 0.3) / 0.06) ** 2 + ((v - 0.3) / 0.12) ** 2))[..., None]
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(values.astype(np.float32))}}


def floor(height: float = -0.81) -> dict:
    """Return a diffuse ground."""
    look = mi.ScalarTransform4f().look_at([0, height, 0], [0, 0, 0.001], [0, 0, 1]).scale(4)
    grey = {"type": "diffuse", "reflectance": colour(0.6, 0.5, 0.4)}
    return {"floor": {"type": "rectangle", "to_world": look, "bsdf": grey}}


def inside() -> dict:
    """Return a camera in a ball of glass that is filled with fog, before a small one."""
    fog = {"fog": fluid(1.5, 0.9) | {"id": "fog"}}
    reference = {"type": "ref", "id": "fog"}
    look = mi.ScalarTransform4f().look_at([0.3, 0.4, 0.8], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 70, "to_world": look, "medium": reference}
    grey = {"type": "diffuse", "reflectance": 0.6}
    small = {"type": "sphere", "radius": 0.3, "bsdf": grey, "exterior": reference}
    return fog | {"ball": ball(reference, radius=1.2), "small": small, "sensor": sensor}


HG = {"phase": {"type": "hg", "g": 0.3}}
CASES: dict[str, Callable[[], dict]] = {
    "smoke in a hollow globe, sky": lambda: globe() | SKY,
    "smoke in a hollow globe, map": lambda: globe() | map_of_the_sky(),
    "milk of depth 10, sky": lambda: {"a": ball(fluid(10))} | SKY,
    "milk of depth 40, sky": lambda: {"a": ball(fluid(40))} | SKY,
    "milk of depth 20, map": lambda: {"a": ball(fluid(20))} | map_of_the_sky(),
    "milk of depth 20, lamp": lambda: {"a": ball(fluid(20))} | DIM | lamp(),
    "rough jade, sky": lambda: {"a": ball(jade(), ROUGH)} | SKY,
    "rough jade, hg 0.3, map": lambda: {"a": ball(fluid(10, 0.97, **HG), ROUGH)}
    | map_of_the_sky(),
    "rough jade, cube, lamp": lambda: {"a": cube(jade(), ROUGH)} | DIM | lamp(),
    "rough jade, mesh, sky": lambda: {"a": torus(fluid(8, 0.95), ROUGH)} | SKY,
    "glass cube on a floor, lamp": lambda: {"a": cube(fluid(6, 0.95))} | floor() | DIM | lamp(),
    "smoke in a glass cube, map": lambda: {"a": cube(smoke(15.0), scale=(1, 1, 1))}
    | map_of_the_sky(),
    "hg 0.5 in a glass cube, sky": lambda: {
        "a": cube(fluid(6, 0.95, phase={"type": "hg", "g": 0.5}))
    }
    | SKY,
    "coloured albedo and extinction, sky": lambda: {
        "a": ball(
            fluid(18, (0.95, 0.9, 0.8), sigma_t=colour(0.6, 0.7, 0.9), scale=8.0)
        )
    }
    | SKY,
    "thin dielectric, sun and sky": lambda: {
        "a": ball(fluid(6, 0.95), {"type": "thindielectric"})
    }
    | DIM
    | SUN,
    "smooth glass, sun and sky": lambda: {"a": ball(fluid(6, 0.95))} | DIM | SUN,
    "rough glass, sun and sky": lambda: {"a": ball(fluid(6, 0.95), ROUGH)} | DIM | SUN,
    "milk beside smoke, sky": lambda: {
        "a": ball(fluid(12), GLASS, 0.5, (0.6, 0, 0)),
        "b": cube(fluid(3, 0.9), NULL, (-0.6, 0, 0), (0.45, 0.45, 0.45)),
    }
    | SKY,
    "two balls of glass, lamp": lambda: {
        "a": ball(fluid(12), GLASS, 0.5, (0.6, 0, 0)),
        "b": ball(fluid(8, (0.95, 0.7, 0.5)), ROUGH, 0.5, (-0.55, 0, 0)),
    }
    | DIM
    | lamp(),
    "smoke within water, null, sky": lambda: {
        "a": {"type": "sphere", "bsdf": GLASS},
        "b": cube(fluid(8, 0.9), NULL, (0, 0, 0), (0.45, 0.45, 0.45)),
    }
    | SKY,
    "closed cylinder of milk, sky": lambda: tumbler() | SKY,
    "camera inside, sky": lambda: inside() | SKY,
    "black ball within milk, sky": lambda: {
        "a": ball(fluid(4, 0.95)),
        "b": {
            "type": "sphere", "radius": 0.3, "center": [0.2, 0.2, 0.3],
            "bsdf": {"type": "diffuse", "reflectance": 0.05},
        },
    }
    | SKY,
    "lamp within milk": lambda: {
        "a": ball(fluid(4, 0.95)),
        "b": {
            "type": "sphere", "radius": 0.2, "center": [0.2, 0.2, 0.3],
            "emitter": {"type": "area", "radiance": 5.0},
        },
    }
    | DIM,
    "white furnace, nested glass": lambda: {
        "a": ball(fluid(4, 1.0)),
        "b": {"type": "sphere", "radius": 0.3, "center": [0.2, 0, 0.3], "bsdf": GLASS},
    }
    | SKY,
}  # fmt: skip


def build(name: str, integrator: dict, pixels: int) -> mi.Scene:
    """Load the scene of a case."""
    found = CASES[name]()
    own = found.pop("sensor", {})
    described = scene(found, integrator, pixels)
    look = mi.ScalarTransform4f().look_at([2.2, 1.9, 3.0], [0, 0, 0], [0, 1, 0])
    described["sensor"] |= {"to_world": look} | own
    return mi.load_dict(described)
