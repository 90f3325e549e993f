"""Scenes that are edited between renderings show what they hold now, and nothing else: every
parameter that Mitsuba exposes, assigned several times in one process, with both solvers.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

#: Values that a parameter is given one after the other, in units of the one of before.
FACTORS = (0.9, 0.75)
CAMERA_SIDE = ("PerspectiveCamera", "HDRFilm")
RED = {"type": "rgb", "value": [0.9, 0.3, 0.2]}


def placed(*offset: float, size: float = 1.0):
    return mi.ScalarTransform4f().translate(list(offset)).scale(size)


def bitmap(scenes) -> dict:
    pixels = mi.Bitmap(scenes.texture((4, 8, 3), 0.2, 0.8, 3))
    return {"type": "bitmap", "bitmap": pixels, "raw": True}


def cloud(scenes, **properties) -> dict:
    """A cube of 3^3 voxels, in colour."""
    sigma_t = scenes.texture((3, 3, 3, 3), 0.2, 1.0, 1)
    medium = scenes.medium(sigma_t, [0.9, 0.8, 0.5], scenes.placement(), **properties)
    return scenes.boundary(medium)


def fog(scenes, **properties) -> dict:
    medium = scenes.medium([0.5, 0.8, 1.0], [0.9, 0.8, 0.5]) | properties
    return scenes.boundary(medium)


def worlds(scenes) -> dict[str, dict]:
    """Shape of the medium and other objects; together all plugins that irrcache supports."""
    sphere = {"type": "sphere", "bsdf": {"type": "null"}}
    lamp = {
        "type": "rectangle",
        "to_world": placed(0, 0, -3),
        "emitter": {"type": "area", "radiance": RED},
    }
    albedo = scenes.volume(scenes.texture((3, 3, 3), 0.2, 0.9, 2), scenes.placement())
    phases = {"a": {"type": "hg", "g": 0.4}, "b": {"type": "rayleigh"}, "weight": 0.3}
    lobes = {"type": "tabphase", "values": "0.5,1,1.5"}
    return {
        "lights": {
            "shape": cloud(scenes),
            "emitter": {"type": "constant", "radiance": RED},
            "sun": {"type": "directional", "direction": [0, -1, 0.2], "irradiance": RED},
            "point": {"type": "point", "position": [0, 3, -1], "intensity": RED},
            "spot": {
                "type": "spot",
                "cutoff_angle": 40.0,
                "beam_width": 15.0,
                "intensity": RED,
                "to_world": mi.ScalarTransform4f().look_at([2, 3, -3], [0, 0, 0], [0, 1, 0]),
            },
        },
        "envmap": {
            "shape": fog(scenes, albedo=albedo),
            "emitter": {"type": "envmap", "bitmap": bitmap(scenes)["bitmap"]},
        },
        "phases": {
            "shape": fog(scenes, phase={"type": "blendphase"} | phases),
            "emitter": scenes.sun,
        },
        "table": {"shape": cloud(scenes, phase=lobes), "emitter": scenes.sky},
        "ball": {
            "shape": sphere | {"interior": scenes.medium(1.5, 0.8)},
            "emitter": {"type": "constant", "radiance": 0.7},
        },
        "surfaces": {
            "shape": fog(scenes),
            "emitter": lamp,
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, -1.5, 0]).rotate([1, 0, 0], -90),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": RED}},
            },
            "ball": {
                "type": "sphere",
                "center": [2, 0, 0],
                "radius": 0.5,
                "bsdf": {"type": "diffuse", "reflectance": bitmap(scenes)},
            },
            "disk": {"type": "disk", "to_world": placed(-2, 0, 0), "bsdf": {"type": "conductor"}},
            "pole": {"type": "cylinder", "to_world": placed(0, 2, 0, size=0.3)},
        },
    }


WORLDS = ("lights", "envmap", "phases", "table", "ball", "surfaces")
SOLVERS = ("sweep", "path")


def settings(solver: str, **others) -> dict:
    return {"type": "irrcache", "solver": solver, "resolution": 2, "cache_spp": 8} | others


def loaded(scenes, world: str, solver: str) -> mi.Scene:
    objects = dict(worlds(scenes)[world])
    return scenes.load(settings(solver), objects.pop("shape"), size=6, **objects)


def image(scene: mi.Scene, **options) -> np.ndarray:
    return np.array(mi.render(scene, spp=2, seed=1, **options))


def image_without_past(scene: mi.Scene, solver: str) -> np.ndarray:
    """By an integrator that has rendered nothing before."""
    return image(scene, integrator=mi.load_dict(settings(solver)))


def plain(value):
    """A parameter's value in the form that a script has it: numbers, lists, arrays of NumPy, and
    transformations.
    """
    if isinstance(value, (bool, int, float)) or not (dr.is_array_v(value) or is_placed(value)):
        return value
    if is_placed(value):
        return value
    values = np.array(value)
    return float(values.ravel()[0]) if values.size == 1 else values


def is_placed(value) -> bool:
    return "Transform" in type(value).__name__


def scaled(value, factor: float):
    """A plain ``value`` that is another one for each ``factor``."""
    if isinstance(value, bool):
        return not value
    if is_placed(value):
        kind = type(value)
        size = value.matrix.shape[0] - 1 if hasattr(value.matrix, "shape") else 3
        if size == 2:
            return value @ kind().scale([factor, factor])
        return value @ kind().scale([factor, factor, factor])
    if isinstance(value, np.ndarray) and value.dtype.kind in "ui":
        raise AssertionError("no factor makes other indices of these")
    return value * factor


def assign(params, key: str, value) -> None:
    kind = type(params[key])
    if isinstance(value, np.ndarray) and value.ndim == 2 and not dr.is_tensor_v(kind):
        value = value.ravel().tolist()  # a colour or a point
    elif isinstance(value, np.ndarray):
        value = kind(value)
    params[key] = value


def edited_keys(scene: mi.Scene) -> list[str]:
    """All parameters but those of the camera's side."""
    params = mi.traverse(scene)
    entries = params.properties.items()
    keys = [k for k, entry in entries if entry[2].class_name() not in CAMERA_SIDE]
    return [k for k in keys if not k.endswith(".faces")]  # others bound no medium


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("world", WORLDS)
def test_every_parameter_that_is_assigned_shows(scenes, world, solver):
    """One after the other, each several times in a row. Each image is that of an integrator which
    has not rendered before, and the last one that of a scene which was loaded with these values,
    to the last bit.
    """
    scene = loaded(scenes, world, solver)
    builder = scene.integrator()._builder
    params, old = mi.traverse(scene), image(scene)
    given, shown = {}, 0
    for key in edited_keys(scene):
        original = plain(params[key])
        for factor in FACTORS:
            given[key] = scaled(original, factor)
            assign(params, key, given[key])
            params.update()
            found = image(scene)
            expected = image_without_past(scene, solver)
            np.testing.assert_array_equal(found, expected, err_msg=f"{key} times {factor}")
            shown += not np.array_equal(found, old)
            old, revision = found, builder.revision
            scene.integrator().prepare(scene)
            assert builder.revision == revision, "a cache was made for nothing"
    assert shown > len(FACTORS)  # edits change the image at all
    fresh = loaded(scenes, world, solver)
    params = mi.traverse(fresh)
    for key, value in given.items():
        assign(params, key, value)
    params.update()
    np.testing.assert_array_equal(image(fresh), old)


@pytest.mark.parametrize("world", ["lights", "surfaces"])
def test_arrays_that_are_edited_in_place_show(scenes, world):
    """By ``dr.scatter``, as Mitsuba's documentation has it; and through a view of NumPy's."""
    scene = loaded(scenes, world, "path")
    params, old = mi.traverse(scene), image(scene)
    shown = 0
    for key in edited_keys(scene):
        value = params[key]
        flat = value.array if dr.is_tensor_v(value) else value
        if not dr.is_jit_v(flat) or dr.depth_v(flat) != 1 or "faces" in key:
            continue
        for factor in FACTORS:
            last = dr.width(flat) - 1
            dr.scatter(flat, factor * flat[last], mi.UInt32(last))
            params.set_dirty(key)
            params.update()
            found = image(scene)
            expected = image_without_past(scene, "path")
            np.testing.assert_array_equal(found, expected, err_msg=f"{key} times {factor}")
            shown += not np.array_equal(found, old)
            old = found
            value = params[key]
            flat = value.array if dr.is_tensor_v(value) else value
    assert shown > len(FACTORS)


def test_writing_through_a_view_shows(scenes):
    """Memory that NumPy writes to belongs to the same variable as before, also to what a snapshot
    holds.
    """
    scene = loaded(scenes, "lights", "path")
    params, old = mi.traverse(scene), image(scene)
    for key in ("point.intensity.value", "shape.interior_medium.sigma_t.data"):
        value = params[key]
        (value.array if dr.is_tensor_v(value) else value.x).numpy()[:] *= 0.7
        if dr.is_tensor_v(value):  # Mitsuba has another copy, for lookups
            params.set_dirty(key)
            params.update()
        found = image(scene)
        np.testing.assert_array_equal(found, image_without_past(scene, "path"), err_msg=key)
        assert not np.array_equal(found, old), key
        old = found


CAMERA_EDITS = {
    "sensor.to_world": lambda v: mi.ScalarTransform4f().look_at([4, 0, 3], [0, 0, 0], [0, 1, 0]),
    "sensor.x_fov": lambda v: 20.0,
    "sensor.near_clip": lambda v: 0.1,
    "sensor.film.size": lambda v: [5, 7],
}


@pytest.mark.parametrize("world", ["lights", "surfaces"])
def test_a_moved_camera_makes_no_cache(scenes, world, kernels):
    """And none of Mitsuba's parameters is looked at by a kernel."""
    scene = loaded(scenes, world, "path")
    image(scene)
    integrator, params = scene.integrator(), mi.traverse(scene)
    revision = integrator._builder.revision
    for key, edit in CAMERA_EDITS.items():
        params[key] = edit(params[key])
        params.update()
        assert kernels(lambda: integrator.prepare(scene)) == []
        image(scene)
    assert integrator._builder.revision == revision


def test_the_value_of_before_makes_no_cache(scenes):
    """Assigned as an array of its own."""
    scene = loaded(scenes, "lights", "path")
    image(scene)
    builder = scene.integrator()._builder
    revision = builder.revision
    params = mi.traverse(scene)
    for key in ("point.position", "sun.irradiance.value", "shape.interior_medium.sigma_t.data"):
        value = params[key]
        params[key] = type(value)(np.array(value)) * 1
        params.set_dirty(key)
        params.update()
        image(scene)
    assert builder.revision == revision


def test_emission_of_the_integrator_is_a_parameter_too(scenes):
    volume = scenes.volume(scenes.texture((2, 2, 2), 0.1, 1, 5), scenes.placement())
    scene = scenes.load(settings("path", emission=volume), fog(scenes), size=6)
    params, old = mi.traverse(scene), image(scene)
    (key,) = [k for k in params.keys() if k.endswith("emission.data")]
    for factor in FACTORS:
        params[key] = mi.TensorXf(np.array(params[key]) * factor)
        params.update()
        found = image(scene)
        assert found.sum() < old.sum()
        old = found
    fresh = scenes.load(settings("path", emission=volume), fog(scenes), size=6)
    others = mi.traverse(fresh)
    others[key] = params[key]
    others.update()
    np.testing.assert_array_equal(image(fresh), old)


def test_another_bsdf_shows(scenes):
    """Objects can be exchanged, without any parameter of the old ones being edited."""
    scene = loaded(scenes, "surfaces", "path")
    old = image(scene)
    (ball,) = [s for s in scene.shapes() if s.class_name() == "Sphere"]
    ball.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": 0.05}))
    found = image(scene)
    np.testing.assert_array_equal(found, image_without_past(scene, "path"))
    assert not np.array_equal(found, old)
