"""Ten cases for each of six classes of wrong images that tests from outside have found.

Numbers are drawn once from fixed seeds: nobody has chosen them by the results.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.validation.random_scenes.generate import icosahedron

SKY = {"sky": {"type": "constant", "radiance": 1.0}}
SUN = {"sun": {"type": "directional", "direction": [-0.5, -1, -0.3], "irradiance": 3.0}}
NULL, DIFFUSE, GLASS = {"type": "null"}, {"type": "diffuse"}, {"type": "dielectric"}
Objects = dict[str, dict]


def identity() -> mi.ScalarTransform4f:
    """Return a transformation to begin with."""
    return mi.ScalarTransform4f()


def grid(values: np.ndarray, edges=(1.0, 1.0, 1.0)) -> dict:
    """Return a volume of voxels (z, y, x[, channel]) in a box with these half edges."""
    values = np.float32(values.reshape(*values.shape[:3], -1))
    place = identity().scale(list(map(float, edges))).translate(-1).scale(2)
    return {"type": "gridvolume", "raw": True, "grid": mi.VolumeGrid(values), "to_world": place}


def fog(sigma_t: float = 1.0, albedo: float = 0.8) -> dict:
    """Return a homogeneous medium."""
    return {"type": "homogeneous", "sigma_t": sigma_t, "albedo": albedo}


def bounded(interior: dict, shape: str = "cube", place=None, **more) -> dict:
    """Return a shape that bounds a medium."""
    place = identity() if place is None else place
    return {"type": shape, "to_world": place, "bsdf": NULL, "interior": interior} | more


def lamp(shape: str, position, size: float, target=(0.0, 0.0, 0.0), **more) -> dict:
    """Return an area emitter that faces ``target``."""
    look = (
        identity().look_at(list(map(float, position)), list(target), [0.12, 0.9, 0.31]).scale(size)
    )
    emitter = {"type": "area", "radiance": 4.0 / size**2}
    return {"type": shape, "to_world": look, "emitter": emitter} | more


def beam(cutoff: float, position, target=(0.1, 0.0, -0.1)) -> dict:
    """Return a spot light."""
    look = identity().look_at(list(map(float, position)), list(target), [0.12, 0.9, 0.31])
    return {"type": "spot", "to_world": look, "cutoff_angle": cutoff, "intensity": 8.0}


def floor(height: float = -1.5) -> dict:
    """Return a diffuse floor."""
    place = identity().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(4)
    return {"type": "rectangle", "to_world": place, "bsdf": DIFFUSE}


# -- edits -----------------------------------------------------------------------------------------


def yard() -> Objects:
    """Return a scene with objects of many kinds, whose parameters are edited."""
    random = np.random.default_rng(811)
    interior = {
        "type": "heterogeneous", "scale": 2.0, "phase": {"type": "hg", "g": 0.3},
        "sigma_t": grid(random.uniform(0.1, 1, (3, 4, 5))),
        "albedo": grid(random.uniform(0.5, 0.95, (2, 3, 2, 3))),
    }  # fmt: skip
    ball = {"type": "sphere", "center": [1.2, -0.6, 1.6], "radius": 0.3}
    return {
        "box": bounded(interior),
        "ball": ball | {"bsdf": DIFFUSE | {"reflectance": {"type": "rgb", "value": 0.6}}},
        "floor": floor(),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.float32(random.random((6, 12, 3))))},
        "sun": {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": 2.0},
        "bulb": {"type": "point", "position": [-1.3, 1.2, 0.4], "intensity": 2.0},
        "lamp": lamp("disk", (1.7, 1.9, 0), 0.4),
    }


def _sigma_t(shape: tuple[int, ...]) -> np.ndarray:
    return np.float32(np.random.default_rng(812).uniform(0.1, 1, (*shape, 1)))


def _within(params: mi.SceneParameters, key: str, values: np.ndarray) -> None:
    """Write values into an array in place."""
    flat = np.float32(values).ravel()
    array = params[key].array if isinstance(params[key], mi.TensorXf) else params[key]
    array[:] = type(array)(flat)


def _replace(objects: Objects, name: str, *path: str, value: object) -> None:
    """Replace an entry of the description."""
    found = objects[name]
    for key in path[:-1]:
        found = found[key]
    found[path[-1]] = value


#: Edits one after the other: the assigned parameter, its value, and the same in the description.
#: Without the latter (Mitsuba rounds the inverses of assigned transformations differently) the new
#: scene gets the same assignment before it renders.
EDITS: dict[str, tuple[str, Callable[[], object], Callable[[Objects], None] | None]] = {
    "voxels": (
        "box.interior_medium.sigma_t.data", lambda: mi.TensorXf(_sigma_t((3, 4, 5))),
        lambda o: _replace(o, "box", "interior", "sigma_t", value=grid(_sigma_t((3, 4, 5)))),
    ),
    "voxels of another shape": (
        "box.interior_medium.sigma_t.data", lambda: mi.TensorXf(_sigma_t((2, 7, 3))),
        lambda o: _replace(o, "box", "interior", "sigma_t", value=grid(_sigma_t((2, 7, 3)))),
    ),
    "scale of the extinction": (
        "box.interior_medium.scale", lambda: 3.5,
        lambda o: _replace(o, "box", "interior", "scale", value=3.5),
    ),
    "anisotropy": (
        "box.interior_medium.phase_function.g", lambda: -0.25,
        lambda o: _replace(o, "box", "interior", "phase", "g", value=-0.25),
    ),
    "direction of the sun": (
        "sun.to_world", lambda: mi.Transform4f().look_at([0, 0, 0], [0.8, -1, 0.1], [0, 0, 1]),
        None,
    ),
    "position of a point": (
        "bulb.position", lambda: mi.Point3f(1.2, 1.4, -0.5),
        lambda o: _replace(o, "bulb", "position", value=[1.2, 1.4, -0.5]),
    ),
    "scale of the environment": (
        "sky.scale", lambda: mi.Float(0.25), lambda o: _replace(o, "sky", "scale", value=0.25),
    ),
    "reflectance of the ball": (
        "ball.bsdf.reflectance.value", lambda: mi.Color3f(0.9, 0.2, 0.1),
        lambda o: _replace(
            o, "ball", "bsdf", "reflectance", value={"type": "rgb", "value": [0.9, 0.2, 0.1]}
        ),
    ),
    "placement of the ball": (
        "ball.to_world", lambda: mi.Transform4f().translate([0.2, 1.5, 1.0]).scale(0.4), None,
    ),
    "size and place of the lamp": (
        "lamp.to_world",
        lambda: mi.Transform4f().look_at([-1.7, 1.5, 0.5], [0, 0, 0], [0, 0, 1]).scale(0.6), None,
    ),
    "radiance of the lamp": (
        "lamp.emitter.radiance.value", lambda: mi.Color3f(2.0, 8.0, 40.0),
        lambda o: _replace(
            o, "lamp", "emitter", "radiance",
            value={"type": "rgb", "value": [2.0, 8.0, 40.0]},
        ),
    ),
    "turn of the environment": (
        "sky.to_world", lambda: mi.Transform4f().rotate([0, 1, 0], 70.0), None,
    ),
}  # fmt: skip


# -- emitters near coarse, dense data; default resolutions -----------------------------------------


def near_lights() -> dict[str, tuple[Objects, int]]:
    """Return points, spots and area emitters close to few, dense voxels."""
    random = np.random.default_rng(821)
    found = {}
    for i in range(10):
        kind = ("point", "spot", "rectangle", "disk", "sphere")[i % 5]
        shape = tuple(int(n) for n in random.integers(1, 6, 3))
        values = random.random(shape) ** 4 + 1e-3
        depth, far = float(np.exp(random.uniform(np.log(5), np.log(40)))), random.uniform(0.15, 0.6)
        beside, axis = random.uniform(-0.8, 0.8, 3), int(random.integers(3))
        beside[axis] = 1 + far
        if kind == "point":
            light = {"type": kind, "position": beside.tolist(), "intensity": 8.0}
        elif kind == "spot":
            light = beam(float(random.uniform(8, 35)), beside)
        else:
            light = lamp(kind, beside, 0.1 * min(1.0, far / 0.2))
        orders = 2 if i % 4 < 2 else -1
        size = " x ".join(map(str, shape[::-1]))
        name = f"{kind} {far:.2f} beside {size}, depth {depth:.0f}, {_orders(orders)}"
        matter = _matter(values, depth, 0.85)
        found[name] = {"box": bounded(matter), "light": light}, orders
    return found


def coarse_grids() -> dict[str, tuple[Objects, int]]:
    """Return few voxels of all proportions, optically thick, in all kinds of light."""
    random = np.random.default_rng(831)
    found = {}
    for i in range(10):
        shape = tuple(int(n) for n in random.integers(1, 8, 3))
        edges = random.uniform(0.3, 1.2, 3)
        values = random.random(shape) ** (1 + i % 4) + 10.0 ** -(1 + i % 3)
        depth = float(np.exp(random.uniform(np.log(5), np.log(60))))
        light = ("sky", "sun", "side", "lamp", "point")[i % 5]
        orders = -1 if i % 3 else 2
        size = " x ".join(map(str, shape[::-1]))
        box = " x ".join(f"{2 * edge:.1f}" for edge in edges)
        name = f"{size} in {box}, depth {depth:.0f}, {light}, {_orders(orders)}"
        matter = _matter(values, depth, float(random.uniform(0.5, 0.99)), edges)
        place = identity().scale(list(map(float, edges)))
        found[name] = {"box": bounded(matter, place=place)} | _light(light), orders
    return found


def cutting_objects() -> dict[str, tuple[Objects, int]]:
    """Return homogeneous media whose faces are cut by one to three objects at odd angles."""
    random = np.random.default_rng(841)
    found = {}
    for i in range(10):
        objects: Objects = {}
        for k in range(1 + i % 3):
            kind = ("cube", "rectangle", "sphere", "disk", "cylinder")[int(random.integers(5))]
            center = random.uniform(-0.9, 0.9, 3)
            center[int(random.integers(3))] = random.choice([-1, 1]) * random.uniform(0.75, 1.05)
            place = identity().translate(center.tolist())
            axis = random.normal(size=3)
            axis = (axis / np.linalg.norm(axis)).tolist()  # Mitsuba would shear with a longer one
            place = place.rotate(axis, float(random.uniform(0, 90)))
            sizes = random.uniform(0.15, 0.6, 3)
            sizes = np.full(3, sizes[0]) if kind in ("sphere", "cylinder") else sizes
            sheet = {"type": "twosided", "bsdf": DIFFUSE}
            place = place.scale(sizes.tolist())
            objects[f"object{k}"] = {"type": kind, "to_world": place, "bsdf": sheet}
        depth = float(np.exp(random.uniform(np.log(0.5), np.log(12))))
        albedo = float(random.choice([0.3, 0.8, 0.97]))
        light, orders = ("sun", "sky", "point", "side")[i % 4], -1 if i % 3 else 2
        kinds = ", ".join(each["type"] for each in objects.values())
        name = f"{kinds} in depth {depth:.1f}, albedo {albedo:.2g}, {light}, {_orders(orders)}"
        box = bounded(fog(depth / 2, albedo))
        found[name] = {"box": box} | objects | _light(light), orders
    return found


def _matter(values: np.ndarray, depth: float, albedo: float, edges=(1.0, 1.0, 1.0)) -> dict:
    """Return a medium whose densest voxel has this optical depth over an edge of 2."""
    sigma_t = grid(values / values.max(), edges)
    return {"type": "heterogeneous", "sigma_t": sigma_t, "albedo": albedo, "scale": depth / 2}


def _light(kind: str) -> Objects:
    if kind == "side":
        texels = np.full((8, 16, 3), 0.1, np.float32)
        texels[2:5, 3:8] = 4.0
        return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(texels)}}
    lights = {
        "sky": SKY["sky"], "sun": SUN["sun"], "lamp": lamp("rectangle", (1.5, 2.4, 1.9), 0.5),
        "point": {"type": "point", "position": [1.4, 1.9, 1.2], "intensity": 12.0},
    }  # fmt: skip
    return {kind: lights[kind]}


def _orders(depth: int) -> str:
    return "single" if depth == 2 else "all orders"


# -- threads ---------------------------------------------------------------------------------------

AOV = {"type": "aov", "aovs": "d:depth"}
MOMENT = {"type": "moment"}


def shared() -> dict[str, tuple[dict | None, dict, Objects]]:
    """Return scenes that threads share: a wrapper of the integrator, settings, objects."""
    lump = bounded(_matter(np.random.default_rng(841).random((4, 3, 5)) + 0.1, 6, 0.9))
    second = bounded(fog(2.0), "sphere", identity().translate([1.6, 0.9, 0.4]).scale(0.4))
    peak = bounded(fog(1.5) | {"phase": {"type": "hg", "g": 0.8}})
    ball = {"type": "sphere", "center": [0.4, 1.4, 1.0], "radius": 0.3, "bsdf": DIFFUSE}
    glass = {"glass": bounded(fog(2.0), "sphere") | {"bsdf": GLASS}}
    return {
        "defaults": (None, {}, {"box": lump} | SKY | SUN),
        "floor, ball and sun": (None, {}, {"box": lump, "ball": ball, "floor": floor()} | SUN),
        "lamp": (None, {}, {"box": lump, "lamp": lamp("rectangle", (1.5, 2, 1), 0.4)}),
        "narrow spot": (None, {}, {"box": bounded(fog()), "spot": beam(3.0, (0.3, 2.2, 0.1))}),
        "two media by path": (
            None, {"solver": "path", "max_depth": 4}, {"box": lump, "second": second} | SUN,
        ),
        "sharp scattering": (None, {}, {"box": peak} | SUN),
        "glass": (None, {}, glass | SKY),
        "in aov": (AOV, {}, {"box": lump} | SKY | SUN),
        "in moment": (MOMENT, {"max_depth": 2}, {"box": lump} | SUN),
        "image filter": (None, {"filter": "bilateral"}, {"box": lump} | SKY | SUN),
    }  # fmt: skip


# -- scenes to accept and to refuse ----------------------------------------------------------------


def _mirrored() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(np.diag([-1.0, 1, 1, 1]))


def _map(place: mi.ScalarTransform4f) -> Objects:
    texels = np.random.default_rng(851).uniform(0.2, 1.0, (5, 9, 3)).astype(np.float32)
    return {"sky": {"type": "envmap", "bitmap": mi.Bitmap(texels), "to_world": place}}


def walls(gap: float) -> Objects:
    """Return a floor and two walls at this distance from the faces of the cube."""
    back = identity().translate([0, 0, -1 - gap]).scale(3)
    left = identity().translate([-1 - gap, 0, 0]).rotate([0, 1, 0], 90).scale(3)
    wall = {"type": "rectangle", "bsdf": DIFFUSE}
    return {
        "floor": floor(-1 - gap),
        "back": wall | {"to_world": back},
        "left": wall | {"to_world": left},
    }


#: Objects and ``max_depth`` of scenes whose images are those of volpath.
ACCEPTED: dict[str, Callable[[], tuple[Objects, int]]] = {
    "sphere with an uneven placement": lambda: (
        {"a": bounded(fog(), "sphere", identity().scale([0.5, 1.3, 0.9]))} | SKY | SUN, 2,
    ),
    "cube 1e-4 from a floor and two walls": lambda: (
        {"a": bounded(fog())} | walls(1e-4) | SUN | SKY, -1,
    ),
    "closed glass ball with a medium": lambda: (
        {"a": bounded(fog(2.0), "sphere") | {"bsdf": GLASS}} | SKY, -1,
    ),
    "beam of 2 degrees": lambda: (
        {"a": bounded(fog(1.5)), "spot": beam(2.0, (0.3, 2.2, 0.1))}, -1,
    ),
    "mirrored cube with flip_normals": lambda: (
        {"a": bounded(fog(), place=_mirrored(), flip_normals=True)} | SUN, -1,
    ),
    "environment turned and moved": lambda: (
        {"a": bounded(fog())} | _map(identity().translate([3, 1, -2]).rotate([0, 0.6, 0.8], 130)),
        2,
    ),
}  # fmt: skip

#: Objects of scenes that are refused, and what the message contains.
REFUSED: dict[str, tuple[Callable[[Path], Objects], str]] = {
    "cubes that overlap in a corner": (
        lambda _: {
            "a": bounded(fog()), "b": bounded(fog(2.0), place=identity().translate(1.7)),
        } | SKY, '"a".*"b"|"b".*"a"',
    ),
    "sphere half in a cube": (
        lambda _: {
            "a": bounded(fog()),
            "b": bounded(fog(2.0), "sphere", identity().translate([0, 1, 0]).scale(0.4)),
        } | SKY, '"a".*"b"|"b".*"a"',
    ),
    "mesh with flip_normals": (
        lambda folder: {"a": _icosahedron(folder) | {"flip_normals": True}} | SKY,
        'normals.*"a".*flip_normals',
    ),
    "environment 5 % too large": (
        lambda _: {"a": bounded(fog())} | _map(identity().scale(1.05)), '"sky".*to_world',
    ),
    "lamp outside with the fog as its exterior": (
        lambda _: {
            "fog": fog() | {"id": "fog"}, "a": bounded({"type": "ref", "id": "fog"}),
            "lamp": lamp("disk", (1.5, 2, 1), 0.4, exterior={"type": "ref", "id": "fog"}),
        }, '"lamp".*exterior',
    ),
}  # fmt: skip

#: Objects that differ in ``flip_normals``, or in a shape's medium alone: one cache file must not
#: serve both.
FILES: dict[str, tuple[Callable[[], Objects], Callable[[], Objects]]] = {
    "cache file of a lamp with flip_normals": (
        lambda: {"a": bounded(fog()), "lamp": lamp("rectangle", (1.5, 2, 1), 0.4)} | SKY,
        lambda: {
            "a": bounded(fog()),
            "lamp": lamp("rectangle", (1.5, 2, 1), 0.4, flip_normals=True),
        } | SKY,
    ),
}  # fmt: skip


def _icosahedron(folder: Path) -> dict:
    path = folder / "icosahedron.obj"
    path.write_text(icosahedron())
    return {"type": "obj", "filename": str(path), "bsdf": NULL, "interior": fog()}
