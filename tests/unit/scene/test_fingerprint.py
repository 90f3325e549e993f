"""Which scene changes invalidate a cache, and which do not."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.scene.fingerprint import SceneVersion, digests

pytestmark = pytest.mark.usefixtures("rgb")


def cloud_scene(scenes, seed=1, albedo=0.8, scale=1.0, turn=0.0, integrator="volpath", **objects):
    to_world = scenes.placement(turn=turn)
    medium = scenes.medium(scenes.texture((4, 4, 4), 0, 2, seed), albedo, to_world, scale=scale)
    return scenes.load(
        {"type": integrator}, scenes.boundary(medium, to_world), **objects, default_solver="path"
    )


def named(scene: mi.Scene, ending: str) -> tuple[mi.SceneParameters, str]:
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith(ending)]
    return params, key


EDITS = {
    "sigma_t.data": lambda v: mi.TensorXf(np.array(v) * 2),
    "medium.scale": lambda v: v * 2,
    "albedo.value.value": lambda v: v * 0.5,
    "sun.irradiance.value": lambda v: v * 2,
    "emitter.radiance.value": lambda v: v * 0.5,
    "sun.to_world": lambda v: (
        mi.AffineTransform4f(v @ mi.ScalarTransform4f().rotate([1, 0, 0], 30))
        if hasattr(mi, "AffineTransform4f")
        else v @ mi.ScalarTransform4f().rotate([1, 0, 0], 30)
    ),
    "shape.vertex_positions": lambda v: v * 0.5,
}


@pytest.mark.parametrize("ending", EDITS)
def test_edits_of_emitters_are_detected(scenes, ending):
    """Each edit that affects the irradiance is reported by its parameter's name and no other.

    Parameters that Mitsuba derives from it are excepted.
    """
    scene = cloud_scene(scenes)
    before = SceneVersion(scene)
    assert SceneVersion(scene).changes(before) == []
    params, key = named(scene, ending)
    params[key] = EDITS[ending](params[key])
    params.update()
    assert key in SceneVersion(scene).changes(before)


@pytest.mark.parametrize(
    ("ending", "value"), [("sensor.x_fov", 12.0), ("sensor.film.size", [8, 8])]
)
def test_edits_of_the_camera_are_ignored(scenes, ending, value):
    scene = cloud_scene(scenes)
    before = SceneVersion(scene)
    params, key = named(scene, ending)
    params[key] = value
    params.update()
    assert SceneVersion(scene).changes(before) == []


def test_comparing_snapshots_runs_no_kernel(scenes, kernels):
    scene = cloud_scene(scenes)
    before = SceneVersion(scene)
    assert kernels(lambda: SceneVersion(scene).changes(before)) == []


def bitmap() -> dict:
    pixels = mi.TensorXf(np.full((4, 4, 3), 0.5, np.float32))
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


def above() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at([0, 4, 0.1], [0, 0, 0], [0, 0, 1])


#: Emitters of each kind; functions, since they are made in the variant of the test.
EMITTERS: dict[str, Callable[[], dict]] = {
    "constant": lambda: {"type": "constant", "radiance": 0.5},
    "envmap": lambda: {"type": "envmap", "bitmap": bitmap()["bitmap"], "scale": 2.0},
    "sunsky": lambda: {"type": "sunsky"},
    "directional": lambda: {"type": "directional", "direction": [0, -1, 0.2]},
    "point": lambda: {"type": "point", "position": [0, 4, 0]},
    "spot": lambda: {"type": "spot", "texture": bitmap(), "to_world": above()},
    "projector": lambda: {"type": "projector", "irradiance": bitmap(), "to_world": above()},
    "area": lambda: {
        "type": "sphere", "center": [0, 4, 0], "radius": 0.5,
        "emitter": {"type": "area", "radiance": bitmap()},
    },
}  # fmt: skip


def literals(scene: mi.Scene) -> list[str]:
    """Return the names of the parameters that are constants without memory."""
    return [
        key
        for key, value in mi.traverse(scene)
        if dr.is_jit_v(value)
        and dr.depth_v(value) == 1
        and not dr.is_tensor_v(value)
        and value.state == dr.VarState.Literal
    ]


@pytest.mark.parametrize("kind", EMITTERS)
def test_computing_digests_is_no_edit(scenes, kind):
    scene = cloud_scene(scenes, emitter=EMITTERS[kind]())
    before, constants = SceneVersion(scene), literals(scene)
    digest(scene)
    assert SceneVersion(scene).changes(before) == [] and literals(scene) == constants


@pytest.mark.parametrize("kind", EMITTERS)
def test_a_second_image_needs_no_new_cache(scenes, refine_calls, kind):
    """Nor is one needed after the fingerprint was computed, and all parameters were read."""
    integrator = {"type": "irrcache", "resolution": 4, "cache_spp": 32, "max_depth": 2}
    scene = scenes.load(
        integrator, scenes.boundary(scenes.medium(2.0, 0.8)), 4, "path", emitter=EMITTERS[kind]()
    )
    (medium,) = scene.integrator().cached_media(scene)
    medium.fingerprint(scene)
    for _ in range(2):
        scenes.image(scene, spp=1)
        assert scene.integrator().cached_media(scene) == [medium] and len(refine_calls) == 1
        for key, value in mi.traverse(scene):
            if dr.is_array_v(value) and "vertex" not in key:
                np.array(value)


def test_a_parameter_that_is_read_is_not_edited(scenes):
    scene = cloud_scene(scenes, emitter=EMITTERS["envmap"]())
    before = SceneVersion(scene)
    params, key = named(scene, "emitter.scale")
    np.array(params[key])
    dr.make_opaque(params[key])  # reading does this on the CPU
    assert params[key].state != dr.VarState.Literal
    assert SceneVersion(scene).changes(before) == []
    params[key] = mi.Float(3)
    params.update()
    assert SceneVersion(scene).changes(before) == [key]


def digest(scene) -> dict[str, str]:
    media = compile_scene(scene).media
    return digests(scene, media, media.grids[0])


def test_digests_are_those_of_the_contents(scenes):
    """A scene loaded twice has equal fingerprints, whatever its integrator or sensor."""
    first = digest(cloud_scene(scenes))
    assert first == digest(cloud_scene(scenes))
    sensor = scenes.description({}, None, size=5)["sensor"] | {"fov": 10.0}
    assert first == digest(cloud_scene(scenes, integrator="irrcache", sensor=sensor))


SUNS = {
    "direction": {"direction": [0.4, -1.0, 0.5]},
    "irradiance": {"irradiance": 2.0},
}
OTHERS = {
    "data": ({"seed": 2}, {"medium"}),
    "scale": ({"scale": 1.01}, {"medium"}),
    "albedo": ({"albedo": 0.81}, {"medium"}),
    "placement": ({"turn": 1.0}, {"medium", "boundary"}),
}


@pytest.mark.parametrize(("change", "parts"), OTHERS.values(), ids=OTHERS)
def test_digests_distinguish_media(scenes, change, parts):
    a, b = digest(cloud_scene(scenes)), digest(cloud_scene(scenes, **change))
    assert {k for k in a if a[k] != b[k]} == parts


@pytest.mark.parametrize("change", SUNS.values(), ids=SUNS)
def test_digests_distinguish_emitters(scenes, change):
    a = digest(cloud_scene(scenes, emitter=scenes.sky, sun=scenes.sun))
    b = digest(cloud_scene(scenes, emitter=scenes.sky, sun=scenes.sun | change))
    assert {k for k in a if a[k] != b[k]} == {"emitters"}


def test_digests_include_the_environment_map(scenes):
    pixels = scenes.texture((4, 8, 3), 0, 1, 1)
    maps = [{"type": "envmap", "bitmap": mi.Bitmap(p)} for p in (pixels, pixels[::-1].copy())]
    turned = maps[0] | {"to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90)}
    found = {digest(cloud_scene(scenes, emitter=m))["emitters"] for m in (*maps, turned)}
    assert len(found) == 3
