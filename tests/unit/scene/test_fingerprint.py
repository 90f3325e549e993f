"""Which scene changes invalidate a cache, and which do not."""

from __future__ import annotations

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
