"""Scenes with unusual boundaries, placements and media, including invalid ones."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

NULL = {"type": "null"}
GLASS = {"type": "dielectric"}
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}}
SUN = {"type": "directional", "direction": [0.4, -1.0, 0.55], "irradiance": 3.0}
UNIT = np.eye(4)


def matrix(array: object) -> mi.ScalarTransform4f:
    """Return a ``to_world``."""
    return mi.ScalarTransform4f(np.asarray(array, dtype=np.float64))


def placed(centre=(0, 0, 0), scale=(1, 1, 1), turn: float = 0.0) -> np.ndarray:
    """Return a scaling, then a rotation about an oblique axis, then a translation."""
    transform = mi.ScalarTransform4f().translate(list(centre)).rotate([0.48, 0.64, 0.6], turn)
    return np.array(transform.scale(list(scale)).matrix, dtype=np.float64)


def sheared(amount: float = 0.5) -> np.ndarray:
    """Return a shear of x along y."""
    result = np.eye(4)
    result[0, 1] = amount
    return result


def fog(extinction: float = 1.0, albedo: float = 0.8, **more: object) -> dict:
    """Return a homogeneous medium."""
    return {"type": "homogeneous", "sigma_t": extinction, "albedo": albedo} | more


def smoke(place: np.ndarray | None = None, seed: int = 1, **more: object) -> dict:
    """Return a heterogeneous medium of 6^3 voxels over the cube [-1, 1]^3, or ``place`` of it."""
    unit = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]])
    values = np.random.default_rng(seed).uniform(0, 2.5, (6, 6, 6, 1)).astype(np.float32)
    to_world = matrix(unit if place is None else place @ unit)
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True, "to_world": to_world}
    return {"type": "heterogeneous", "sigma_t": grid, "albedo": 0.8} | more


def bound(interior: dict, place: np.ndarray = UNIT, kind: str = "cube", **more: object) -> dict:
    """Return a null boundary."""
    return {"type": kind, "to_world": matrix(place), "bsdf": NULL, "interior": interior} | more


def ref(name: str) -> dict:
    """Return a reference to an object of the scene."""
    return {"type": "ref", "id": name}


def tin(bsdf: dict, place: np.ndarray = UNIT) -> dict:
    """Return a closed cylinder about the z axis: three shapes with the interior medium "A"."""
    lid = np.diag([1.0, -1.0, -1.0, 1.0])
    parts = {"side": ("cylinder", placed((0, 0, -1), (1, 1, 2)))}
    parts |= {"top": ("disk", placed((0, 0, 1))), "base": ("disk", placed((0, 0, -1)) @ lid)}
    return {
        name: {"type": kind, "to_world": matrix(place @ own), "bsdf": bsdf, "interior": ref("A")}
        for name, (kind, own) in parts.items()
    }


def room(half: float, **more: object) -> dict:
    """Return six walls that face inwards."""
    walls = {}
    for axis in range(3):
        for sign in (-1, 1):
            place = np.zeros((4, 4))
            place[(axis + 1) % 3, 0], place[(axis + 2) % 3, 1] = half, -sign * half
            place[axis, 2], place[axis, 3], place[3, 3] = -sign, sign * half, 1
            wall = {"type": "rectangle", "to_world": matrix(place)} | more
            walls[f"wall{'xyz'[axis]}{'+' if sign > 0 else '-'}"] = wall
    return walls


def ground(height: float) -> dict:
    """Return a large diffuse square."""
    turned = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(5)
    return {"ground": {"type": "rectangle", "to_world": turned}}


def lamp(kind: str, place: np.ndarray, radiance: float = 6.0, **more: object) -> dict:
    """Return an area emitter."""
    emitter = {"type": "area", "radiance": radiance}
    return {"lamp": {"type": kind, "to_world": matrix(place), "emitter": emitter} | more}


def environment(height: int, width: int, place: np.ndarray = UNIT, bright: float = 0.0) -> dict:
    """Return a random environment map, with a ``bright`` texel if requested."""
    texels = np.random.default_rng(3).uniform(0.2, 1.0, (height, width, 3)).astype(np.float32)
    if bright:
        texels[height // 3, width // 3] = bright
    bitmap = mi.Bitmap(texels)
    return {"sky": {"type": "envmap", "bitmap": bitmap, "to_world": matrix(place)}, "sun": None}


def camera(origin=(1.0, 1.5, -6.0), **more: object) -> dict:
    """Return another sensor."""
    look = mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 1, 0])
    return {"sensor": {"type": "perspective", "fov": 38.0, "to_world": look} | more}


def open_box() -> dict:
    """Return a cube without one face, as a mesh."""
    cube = mi.load_dict({"type": "cube"})
    vertices = np.array(mi.traverse(cube)["vertex_positions"])
    faces = np.array(mi.traverse(cube)["faces"]).reshape(-1, 3)[:-2]
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(NULL)
    props["interior"] = mi.load_dict(fog())
    mesh = mi.Mesh("open", len(vertices) // 3, len(faces), props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = vertices.ravel(), faces.ravel()
    params.update()
    return {"box": mesh}


def overlaps() -> dict[str, dict]:
    """Return boundaries that overlap, touch, or contain each other."""
    a, b = {"A": fog()}, fog(2.0, 0.6)
    box = {"a": bound(ref("A"))} | a
    small = placed((0.1, 0, 0), (0.4, 0.4, 0.4))
    inner = {"b": bound(b, small, exterior=ref("A"))}
    return {
        "apart": box | {"b": bound(b, placed((2.6, 0, 0)))},
        "touching, gap 2e-3": box | {"b": bound(b, placed((2.002, 0, 0)))},
        "touching, gap 1e-4": box | {"b": bound(b, placed((2.0001, 0, 0)))},
        "common face": box | {"b": bound(b, placed((2, 0, 0)))},
        "common face, each the exterior of the other": {
            "A": fog(), "B": b, "a": bound(ref("A"), exterior=ref("B")),
            "b": bound(ref("B"), placed((2, 0, 0)), exterior=ref("A")),
        },
        "half overlap": box | {"b": bound(b, placed((1, 0, 0)))},
        "thin overlap": box | {"b": bound(b, placed((1.98, 0, 0)))},
        "overlap at a corner": box | {"b": bound(b, placed((1.8, 1.8, 1.8)))},
        "spheres overlap": {
            "a": bound(fog(), kind="sphere"), "b": bound(b, placed((1.6, 0, 0)), "sphere"),
        },
        "turned cube through a sphere": box
        | {"b": bound(b, placed((0.9, 0, 0), (0.5, 0.5, 0.5), 30), "sphere")},
        "nested": box | inner,
        "nested, no exterior": box | {"b": bound(b, small)},
        "tiny one nested, no exterior": box | {"b": bound(b, placed(scale=[0.02] * 3))},
        "nested in a box that it reaches out of": box
        | {"b": bound(b, placed((0.8, 0, 0), (0.4, 0.4, 0.4)), exterior=ref("A"))},
        "nested three times": {
            "A": fog(0.5), "B": b, "a": bound(ref("A")),
            "b": bound(ref("B"), placed(scale=[0.7] * 3), exterior=ref("A")),
            "c": bound(fog(4.0), placed(scale=[0.3] * 3), "sphere", exterior=ref("B")),
        },
        "sphere that touches its cube from within": box
        | {"b": bound(b, kind="sphere", exterior=ref("A"))},
        "hollow": box | {"hole": {"type": "sphere", "radius": 0.6, "bsdf": NULL,
                                  "exterior": ref("A")}},
        "one medium in two overlapping boxes": box
        | {"b": bound(ref("A"), placed((0.7, 0.6, 0)))},
        "one medium in two boxes apart": box | {"b": bound(ref("A"), placed((2.4, 0.2, 0)))},
        "two media in one sphere": {"a": bound(fog(), kind="sphere"), "b": bound(b, kind="sphere")},
        "a null shape without media overlaps": box
        | {"b": {"type": "sphere", "center": [1, 0, 0], "bsdf": NULL}},
    }  # fmt: skip


def shapes() -> dict[str, dict]:
    """Return unusual shapes and placements of boundaries."""
    uneven = placed(scale=(1.3, 0.8, 0.5))
    a = {"A": fog()}
    return {
        "sphere, uneven scale": {"a": bound(fog(), uneven, "sphere")},
        "sphere, uneven scale, turned": {
            "a": bound(fog(), placed((0.2, 0, 0), (0.7, 1.4, 1), 50), "sphere")
        },
        "sphere, shear": {"a": bound(fog(), sheared(), "sphere")},
        "sphere, mirrored": {"a": bound(fog(), placed(scale=(-1, 1, 1)), "sphere")},
        "sphere, mirrored and flipped": {
            "a": bound(fog(), placed(scale=(-1, 1, 1)), "sphere", flip_normals=True)
        },
        "sphere, uneven scale, smoke": {"a": bound(smoke(), uneven, "sphere")},
        "cube, shear": {"a": bound(fog(), sheared())},
        "cube, mirrored": {"a": bound(fog(), placed(scale=(-1, 1, 1)))},
        "cube, flipped": {"a": bound(fog(), flip_normals=True)},
        "cube, mirrored and flipped": {
            "a": bound(fog(), placed(scale=(-1, 1, 1)), flip_normals=True)
        },
        "cube, flat": {"a": bound(fog(20.0), placed(scale=(1, 1, 0.02)))},
        "cube, turned in turned smoke": {
            "a": bound(smoke(placed(turn=40)), placed(scale=(0.8, 0.8, 0.8), turn=-30))
        },
        "cube, larger than its smoke": {"a": bound(smoke(placed(scale=(0.6, 0.6, 0.6))))},
        "cube without a face": open_box(),
        "rectangle": {"a": bound(fog(), kind="rectangle")},
        "mirrored cube with a null sphere at its centre": {
            "a": bound(fog(), placed(scale=(-1, 1, 1))),
            "b": {"type": "sphere", "radius": 0.3, "bsdf": NULL},
        },
        "cube with a null sphere at its centre": {
            "a": bound(fog()), "b": {"type": "sphere", "radius": 0.3, "bsdf": NULL},
        },
        "tin of three shapes": a | tin(NULL),
        "tin, uneven": a | tin(NULL, placed(scale=(1.2, 0.7, 0.8), turn=35)),
        "tin, sheared": a | tin(NULL, sheared()),
        "cylinder without lids": a | {"side": tin(NULL)["side"]},
        "glass tin": a | tin(GLASS),
        "glass tin in fog": {"B": fog(0.3), "outer": bound(ref("B"), placed(scale=[1.6] * 3))}
        | a | {name: part | {"exterior": ref("B")} for name, part in tin(GLASS).items()},
        "glass ball in fog, with a medium, no exterior": {
            "outer": bound(fog(0.3), placed(scale=[1.6] * 3)),
            "ball": {"type": "sphere", "bsdf": GLASS, "interior": fog(2.0)},
        },
        "glass ball in fog": {
            "outer": bound(fog(0.5), placed(scale=[1.6] * 3)),
            "ball": {"type": "sphere", "radius": 0.7, "bsdf": GLASS},
        },
        "cube 1e-4 above the ground": {"a": bound(fog())} | ground(-1.0001),
        "cube 1e-2 above the ground": {"a": bound(fog())} | ground(-1.01),
        "cube through the ground": {"a": bound(fog())} | ground(-0.5),
        "room, fog 1e-4 from the walls": {"a": bound(fog())} | room(1.0001)
        | camera((0.3, 0.2, -0.8), fov=80.0) | lamp("sphere", placed((0, 0.6, 0), [0.1] * 3)),
        "room, fog beyond the walls": {"a": bound(fog(), placed(scale=[1.2] * 3))} | room(1.0)
        | {"A": fog()} | camera((0.3, 0.2, -0.8), fov=80.0)
        | lamp("sphere", placed((0, 0.6, 0), [0.1] * 3)),
        "room, fog as exterior of its walls": a | room(1.0, exterior=ref("A"))
        | camera((0.3, 0.2, -0.8), fov=80.0, medium=ref("A"))
        | lamp("sphere", placed((0, 0.6, 0), [0.1] * 3)),
        "lids of ground: box without a bottom": {
            "a": bound(fog(), placed(scale=(1, 1, 1))), **ground(-0.999),
        },
    }  # fmt: skip


def lights() -> dict[str, dict]:
    """Return unusual emitters and placements of them."""
    box = {"a": bound(smoke())}
    uneven, none = placed(scale=(1, 2, 0.5)), {"sky": None, "sun": None}
    above = placed((0, 2.2, 0)) @ np.array(
        mi.ScalarTransform4f().rotate([1, 0, 0], 90).matrix, dtype=np.float64
    )
    maps = {
        "turned": environment(8, 16, placed(turn=40)),
        "moved": environment(8, 16, placed((5, 1, 2))),
        "mirrored": environment(8, 16, placed(scale=(-1, 1, 1))),
        "mirrored twice and turned": environment(8, 16, placed(scale=(1, -1, -1), turn=70)),
        "all mirrored": environment(8, 16, placed(scale=(-1, -1, -1))),
        "twice as large": environment(8, 16, placed(scale=(2, 2, 2))),
        "uneven": environment(8, 16, uneven),
        "sheared": environment(8, 16, sheared()),
        "turned about an axis longer than 1": environment(
            8, 16, np.array(mi.ScalarTransform4f().rotate([1, 1, 0], 30).matrix)
        ),
        "1 x 1": environment(1, 1),
        "2 x 1": environment(1, 2),
        "1 x 2": environment(2, 1),
        "3 x 5": environment(5, 3),
        "2 x 2": environment(2, 2),
        "17 x 9, a texel of 500": environment(9, 17, bright=500.0),
        "64 x 3, mirrored, a texel of 50": environment(3, 64, placed(scale=(1, 1, -1)), 50.0),
    }
    found = {f"envmap, {name}": box | light for name, light in maps.items()}
    inside = placed((0.2, 0.1, 0), [0.2] * 3)
    return found | {
        "sun, uneven": box | {"sun": {"type": "directional", "to_world": matrix(uneven)}},
        "sunsky": box | {"sky": {"type": "sunsky"}, "sun": None},
        "spot, uneven": box | none | {"spot": {
            "type": "spot", "cutoff_angle": 35.0, "intensity": 20.0,
            "to_world": matrix(above @ placed(scale=(1, 3, 2))),
        }},
        "disk lamp, uneven": box | none | lamp("disk", above @ placed(scale=(1.5, 0.5, 1))),
        "disk lamp, sheared": box | none | lamp("disk", above @ sheared()),
        "rectangle lamp, sheared": box | none | lamp("rectangle", above @ sheared(1.0)),
        "rectangle lamp, flipped away": box | none
        | lamp("rectangle", above, flip_normals=True),
        "rectangle lamp, mirrored": box | none
        | lamp("rectangle", above @ placed(scale=(-1, 1, 1))),
        "sphere lamp, uneven": box | none | lamp("sphere", placed((0, 2.2, 0), (0.4, 0.8, 0.2))),
        "sphere lamp, mirrored": box | none
        | lamp("sphere", placed((0, 2.2, 0), (-0.4, 0.4, 0.4))),
        "cylinder lamp": box | none | lamp("cylinder", placed((-1, 1.7, 0), (0.3, 0.3, 1.5))),
        "cylinder lamp, uneven": box | none
        | lamp("cylinder", placed((0, 2, -1), (0.2, 0.5, 1.5))),
        "cube lamp, sheared": box | none
        | lamp("cube", placed((0, 2.2, 0), (0.5, 0.2, 0.5)) @ sheared()),
        "sphere lamp inside": {"a": bound(fog())} | none | lamp("sphere", inside),
        "sphere lamp inside, uneven": {"a": bound(fog())} | none
        | lamp("sphere", placed((0.2, 0.1, 0), (0.2, 0.6, 0.1))),
        "point inside": {"a": bound(fog())} | none
        | {"point": {"type": "point", "position": [0.3, 0.2, 0], "intensity": 2.0}},
        "emissive boundary": {"a": bound(fog(), kind="sphere")
                                 | {"emitter": {"type": "area", "radiance": 0.5}}},
    }  # fmt: skip


def sensors() -> dict[str, dict]:
    """Return sensors inside and outside of media, with and without a declared medium."""
    a, near = {"A": fog()}, (0.2, 0.1, -0.6)
    box, vapour = a | {"a": bound(ref("A"))}, {"A": smoke()}
    ball = {"ball": {"type": "sphere", "radius": 0.2, "center": [0, 0, 0.4]}}
    return {
        "in fog": box | camera(near, medium=ref("A")),
        "in fog, without saying so": box | camera(near),
        "in fog, without saying so, beside a ball": box | ball | camera(near),
        "in fog, beside a ball": box | ball | camera(near, medium=ref("A")),
        "outside, says fog": box | camera(medium=ref("A")),
        "outside, says fog, a ball": box | ball | camera(medium=ref("A")),
        "outside, says smoke": vapour | {"a": bound(ref("A"))} | camera(medium=ref("A")),
        "outside, says smoke that reaches beyond": {"A": smoke(placed(scale=[2.5] * 3))}
        | {"a": bound(ref("A"))} | camera(medium=ref("A")),
        "in a hole of the fog": box | camera((0, 0, -0.2)) | {"hole": {
            "type": "sphere", "radius": 0.5, "bsdf": NULL, "exterior": ref("A")}},
        "in nested fog, says the outer": box | camera((0, 0, -0.2), medium=ref("A"))
        | {"b": bound(fog(3.0), placed(scale=[0.5] * 3), exterior=ref("A"))},
        "in nested fog": box | {"B": fog(3.0)} | camera((0, 0, -0.2), medium=ref("B"))
        | {"b": bound(ref("B"), placed(scale=[0.5] * 3), exterior=ref("A"))},
        "in the face of the fog": box | camera((0, 0, -1.0), medium=ref("A")),
        "smoke outside of all, as exterior": vapour
        | {"hole": {"type": "sphere", "radius": 0.5, "bsdf": NULL, "exterior": ref("A")}}
        | camera(medium=ref("A")),
    }  # fmt: skip


CLASSES = {"overlap": overlaps, "boundary": shapes, "emitter": lights, "sensor": sensors}


def scene(objects: dict, integrator: dict, pixels: int) -> mi.Scene:
    """Return the scene of a case."""
    film = {
        "type": "hdrfilm", "width": pixels, "height": pixels, "component_format": "float32",
        "rfilter": {"type": "box"},
    }  # fmt: skip
    described = {"type": "scene", "integrator": integrator, "sky": SKY, "sun": SUN} | camera()
    described |= objects
    # References must follow the objects.
    media = {k: v for k, v in described.items() if k in ("A", "B")}
    described = {"type": "scene"} | media | described
    described["sensor"] = described["sensor"] | {"film": film}
    return mi.load_dict({k: v for k, v in described.items() if v is not None})
