"""Scenes with surfaces, area emitters and several media against ``volpath``.

Block means of two images by each integrator, within what coarse caches may err plus the statistical
error that the two images of each tell; see `check`.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

SIZE, BLOCK = 24, 6
#: Error allowed in the mean of a block, relative to the mean radiance, beside 4.5 standard errors,
#: which must not be larger than a few times that: what coarse caches leave.
TOLERANCE, NOISE = 0.02, 0.02


def colour(*rgb: float) -> dict:
    return {"type": "rgb", "value": [float(v) for v in rgb]}


def fog(extinction=(1.0, 1.0, 1.0), albedo=(0.9, 0.9, 0.9)) -> dict:
    scale = max(extinction)
    sigma_t = colour(*(v / scale for v in extinction))
    return {
        "type": "homogeneous", "sigma_t": sigma_t, "albedo": colour(*albedo), "scale": scale,
    }  # fmt: skip


def ref(name: str) -> dict:
    return {"type": "ref", "id": name}


def placed(center=(0, 0, 0), scale=(1, 1, 1), towards=None):
    transform = mi.ScalarTransform4f
    if towards is not None:
        return transform().look_at(list(center), list(towards), [0.1, 1, 0.2]).scale(list(scale))
    return transform().translate(list(center)).scale(list(scale))


def bound(kind="cube", interior=None, center=(0, 0, 0), scale=(1, 1, 1), **more) -> dict:
    """A null boundary."""
    place = placed(center, scale)
    return {"type": kind, "to_world": place, "bsdf": {"type": "null"}, "interior": interior} | more


def ball(center=(0, 0, 0), radius=0.4, **more) -> dict:
    return {"type": "sphere", "center": list(center), "radius": radius} | more


def lamp(center, towards, size=0.5, radiance=(12, 10, 8)) -> dict:
    emitter = {"type": "area", "radiance": colour(*radiance)}
    place = placed(center, (size, size, 1), towards)
    return {"type": "rectangle", "to_world": place, "emitter": emitter}


def diffuse(*rgb: float) -> dict:
    return {"type": "diffuse", "reflectance": colour(*rgb)}


def ground(height=-1.1, bsdf=None) -> dict:
    place = placed((0, height, 0), (5, 5, 1), (0, height + 1, 0.001))
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or diffuse(0.6, 0.5, 0.4)}


def tetrahedron(folder, interior: dict) -> dict:
    """A closed mesh, from a file."""
    corners = [[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]
    faces = [[1, 3, 2], [1, 2, 4], [1, 4, 3], [2, 3, 4]]
    rows = [("v", *c) for c in corners] + [("f", *f) for f in faces]
    (folder / "mesh.obj").write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    mesh = {"type": "obj", "filename": str(folder / "mesh.obj"), "bsdf": {"type": "null"}}
    return mesh | {"interior": interior}


def images(scenes, objects: dict, settings: dict, depth: dict, spp: tuple) -> list[np.ndarray]:
    """Two by irrcache, two by volpath."""
    objects = {"emitter": scenes.sky, "sun": scenes.sun} | objects
    found = []
    for name, samples in zip(("irrcache", "volpath"), spp, strict=True):
        own = {"resolution": 20, "cache_spp": 64} | settings if name == "irrcache" else {}
        scene = scenes.load({"type": name, **depth, **own}, None, SIZE, **objects)
        found += [scenes.image(scene, spp=samples, seed=seed) for seed in (1, 2)]
    return found


def blocks(image: np.ndarray) -> np.ndarray:
    n = SIZE // BLOCK
    return image.reshape(n, BLOCK, n, BLOCK, -1).mean(axis=(1, 3))


def check(x, y, p, q, tolerance=TOLERANCE, noise=NOISE) -> None:
    scale = 0.5 * (p + q)[..., :3].mean()
    assert scale > 0
    difference = blocks(0.5 * (x + y - p - q)) / scale
    errors = [np.sqrt(blocks((0.5 * (a - b)) ** 2) / BLOCK**2) / scale for a, b in ((x, y), (p, q))]
    error = np.hypot(*errors)
    assert np.median(error) < noise, "too noisy to say"
    excess = np.abs(difference) - 4.5 * error
    assert excess.max() < tolerance, (difference, error)


def scene_ground(scenes) -> dict:
    """A cloud over the ground, which it shades, and which lights it."""
    to_world = scenes.placement(turn=20)
    cloud = scenes.medium(scenes.texture((5, 6, 7), 0, 3, 4), 0.9, to_world)
    return {"cloud": scenes.boundary(cloud, to_world), "ground": ground()}


def scene_ball(scenes) -> dict:
    """An opaque ball in fog: its shadow, and the light it reflects."""
    return {
        "fog": fog(),
        "box": bound(interior=ref("fog")),
        "ball": ball(bsdf=diffuse(0.9, 0.2, 0.1)),
    }


def scene_mirror(scenes) -> dict:
    mirror = {"type": "rectangle", "to_world": placed((0, 0, 1.5), (2, 2, 1), (0.2, 0, 0))}
    return {"box": bound(interior=fog()), "mirror": mirror | {"bsdf": {"type": "conductor"}}}


def scene_glass(scenes) -> dict:
    """Glass behind a medium, and glass in it."""
    glass = {"bsdf": {"type": "dielectric"}}
    return {
        "box": bound(interior=fog((0.7, 0.7, 0.7))),
        "behind": ball((-0.6, 0, 2.0), 0.7, **glass),
        "inside": ball((0.2, 0, 0), 0.4, **glass),
        "sun": None,
    }


def scene_lamp_outside(scenes) -> dict:
    return {
        "box": bound(interior=fog()), "ground": ground(),
        "lamp": lamp((0.5, 2.2, -0.5), (0, 0, 0)), "emitter": None, "sun": None,
    }  # fmt: skip


def scene_lamp_inside(scenes) -> dict:
    """A lamp in the medium: bright on one side, dark on the other, the one that is seen."""
    return {
        "box": bound(interior=fog()), "lamp": lamp((0, 0.2, 0), (0, -1, 0.3), 0.4),
        "emitter": {"type": "constant", "radiance": 0.1}, "sun": None,
    }  # fmt: skip


def scene_apart(scenes) -> dict:
    """Two media that light each other; one of them absorbs colours differently."""
    return {
        "left": bound(interior=fog(), center=(-0.7, 0, 0), scale=(0.6, 0.6, 0.6)),
        "right": bound("sphere", fog((1, 2, 3), (0.9, 0.7, 0.5)), (0.8, 0, 0), (0.7, 0.7, 0.7)),
    }


def scene_touching(scenes) -> dict:
    return {
        "left": bound(interior=fog(), center=(-0.5, 0, 0), scale=(0.5, 0.8, 0.8)),
        "right": bound(interior=fog((3, 1, 0.5)), center=(0.502, 0, 0), scale=(0.5, 0.8, 0.8)),
    }


def scene_nested(scenes) -> dict:
    """A medium in another, whose edge is the other's too."""
    inner = bound("sphere", fog((1, 2, 4)), (0.1, 0, 0), (0.6, 0.6, 0.6), exterior=ref("fog"))
    return {"fog": fog((0.4, 0.4, 0.4)), "outer": bound(interior=ref("fog")), "inner": inner}


def scene_camera_inside(scenes) -> dict:
    sensor = scenes.description({}, None, SIZE)["sensor"]
    look = mi.ScalarTransform4f().look_at([0.3, 0.4, -1.5], [0, 0, 0], [0, 1, 0])
    return {
        "fog": fog((0.5, 0.6, 0.8)), "box": bound(interior=ref("fog"), scale=(2, 2, 2)),
        "ball": ball(bsdf=diffuse(0.8, 0.8, 0.8), exterior=ref("fog")), "sun": None,
        "sensor": sensor | {"to_world": look, "fov": 60.0, "medium": ref("fog")},
    }  # fmt: skip


def scene_glass_boundary(scenes) -> dict:
    """A medium in glass has no cache, and is lit and seen by paths; one beside it has one."""
    glass = {"bsdf": {"type": "dielectric"}, "interior": fog((1, 1, 1))}
    return {
        "jar": ball((-0.8, 0, 0), 0.7, **glass),
        "box": bound(interior=fog(), center=(0.8, 0, 0), scale=(0.6, 0.6, 0.6)), "sun": None,
    }  # fmt: skip


def scene_mask(scenes) -> dict:
    half = {
        "type": "mask",
        "opacity": 0.5,
        "bsdf": {"type": "twosided", "d": diffuse(0.7, 0.5, 0.3)},
    }
    veil = {
        "type": "rectangle",
        "to_world": placed((0, 0, -1.4), (1, 1, 1), (0, 0, -3)),
        "bsdf": half,
    }
    return {"box": bound(interior=fog()), "veil": veil}


SCENES = {
    "ground": (scene_ground, {}),
    "opaque ball in fog": (scene_ball, {"tolerance": 0.03}),
    "mirror": (scene_mirror, {}),
    "glass": (scene_glass, {}),
    "lamp outside": (scene_lamp_outside, {"tolerance": 0.03}),
    "lamp inside": (scene_lamp_inside, {"tolerance": 0.05, "noise": 0.05}),
    "two media": (scene_apart, {}),
    "touching media": (scene_touching, {}),
    "nested media": (scene_nested, {}),
    "camera inside": (scene_camera_inside, {"tolerance": 0.03}),
    "glass boundary": (scene_glass_boundary, {}),
    "mask": (scene_mask, {}),
}


@pytest.mark.parametrize(("build", "bounds"), SCENES.values(), ids=SCENES)
def test_scenes(scenes, build, bounds):
    depth = {"max_depth": -1, "rr_depth": 50}
    check(*images(scenes, build(scenes), {}, depth, (64, 256)), **bounds)
