"""Images after scene edits equal those of freshly loaded scenes, for every exposed parameter.

Each parameter is assigned several times in one process, with both solvers.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.slow import with_slow

pytestmark = pytest.mark.usefixtures("rgb")

#: Values assigned to a parameter one after the other, in units of its initial value.
FACTORS = (0.8, 1)
#: Parameters that may have no effect on the image of these scenes.
UNSEEN = (
    "allow_thread_reordering",
    "emitter.bsdf.reflectance.value",
    "sampling_weight",
    "vertex_normals",
    "vertex_texcoords",
)
CAMERA_SIDE = ("PerspectiveCamera", "HDRFilm")
RED = {"type": "rgb", "value": [0.9, 0.3, 0.2]}


def placed(*offset: float, size: float = 1.0):
    return mi.ScalarTransform4f().translate(list(offset)).scale(size)


def bitmap(scenes) -> dict:
    pixels = mi.Bitmap(scenes.texture((4, 8, 3), 0.2, 0.8, 3))
    return {"type": "bitmap", "bitmap": pixels, "raw": True}


def cloud(scenes, **properties) -> dict:
    """Return a cube of 3^3 coloured voxels."""
    sigma_t = scenes.texture((3, 3, 3, 3), 0.2, 1.0, 1)
    medium = scenes.medium(sigma_t, [0.9, 0.8, 0.5], scenes.placement(), **properties)
    return scenes.boundary(medium)


def fog(scenes, **properties) -> dict:
    medium = scenes.medium([0.5, 0.8, 1.0], [0.9, 0.8, 0.5]) | properties
    return scenes.boundary(medium)


def worlds(scenes) -> dict[str, dict]:
    """Return the medium's shape and other objects; together they use all supported plugins."""
    sphere = {"type": "sphere", "bsdf": {"type": "null"}}
    lamp = {
        "type": "rectangle",
        "to_world": placed(0, 3, 0).rotate([1, 0, 0], 90),
        "bsdf": {"type": "diffuse"},  # by default Mitsuba's area lights have a black BSDF
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
                "cutoff_angle": 20.0,
                "beam_width": 5.0,
                "intensity": RED,
                "texture": bitmap(scenes),
                "to_world": mi.ScalarTransform4f().look_at([2, 3, -3], [0, 0, 0], [0, 1, 0]),
            },
        },
        "envmap": {
            "shape": fog(scenes, albedo=albedo),
            "emitter": {"type": "envmap", "bitmap": bitmap(scenes)["bitmap"]},
        },
        "sunsky": {
            "shape": fog(scenes),
            "emitter": {"type": "sunsky", "sun_direction": [0.2, 0.3, 0.9]},
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
                "center": [1.2, -0.6, 2.2],
                "radius": 0.5,
                "bsdf": {"type": "diffuse", "reflectance": bitmap(scenes)},
            },
            "disk": {
                "type": "disk",
                "to_world": placed(-1.6, -0.3, 2).rotate([0, 1, 0], 180),
                "bsdf": {"type": "roughconductor", "eta": 1.5, "k": 3.0, "alpha": 0.5},
            },
            "pole": {"type": "cylinder", "p0": [-0.3, 0.6, 2], "p1": [0.9, 0.6, 2], "radius": 0.4},
        },
    }


WORLDS = ("lights", "envmap", "sunsky", "phases", "table", "ball", "surfaces")
#: Rendered by `sweep` with single scattering, which is faster.
SWEPT_ONCE = ("lights", "envmap", "sunsky", "phases", "table", "surfaces")


def settings(solver: str, **others) -> dict:
    return {"type": "irrcache", "solver": solver, "resolution": 2, "cache_spp": 8} | others


def loaded(scenes, world: str, solver: str) -> mi.Scene:
    objects = dict(worlds(scenes)[world])
    depth = 2 if solver == "sweep" and world in SWEPT_ONCE else -1
    shape, chosen = objects.pop("shape"), settings(solver, max_depth=depth)
    return scenes.load(chosen, shape, size=10, **objects, default_solver="path")


def image(scene: mi.Scene, **options) -> np.ndarray:
    return np.array(mi.render(scene, spp=2, seed=1, **options))


def image_without_past(scene: mi.Scene) -> np.ndarray:
    """Render with a new integrator of the same settings."""
    same = scene.integrator()._options.settings
    return image(scene, integrator=mi.load_dict(settings(same.solver, max_depth=same.max_depth)))


def plain(value):
    """Copy a parameter's value to plain numbers, lists, NumPy arrays and transformations."""
    if is_transform(value):
        return type(value)(value)  # traversed values are references into the scene
    if not dr.is_array_v(value):
        return value
    values = np.array(value)
    return float(values.ravel()[0]) if values.size == 1 else values


def is_transform(value) -> bool:
    return "Transform" in type(value).__name__


def edited(value, factor: float, plugin: mi.Object):
    """Return a plain value that differs for each ``factor``, and equals ``value`` for 1."""
    if factor == 1:
        return value
    if isinstance(value, bool):
        return not value
    if is_transform(value):
        kind = type(value)
        if isinstance(plugin, mi.Emitter):  # an infinitely distant emitter has no scale
            return value @ kind().rotate([0.48, 0.64, 0.6], 40 * (1 - factor))
        return value @ kind().scale(factor)
    if isinstance(plugin, mi.PhaseFunction) and isinstance(value, np.ndarray):
        return value**factor  # a tabulated phase function is normalised
    return value * factor


def assign(params, key: str, value) -> None:
    kind = type(params[key])
    if isinstance(value, np.ndarray) and value.ndim == 2 and not dr.is_tensor_v(kind):
        value = value.ravel().tolist()  # a colour or a point
    elif isinstance(value, np.ndarray):
        value = kind(value)
    params[key] = value


def edited_keys(scene: mi.Scene) -> dict[str, tuple]:
    """Return all parameters except those of the sensor, with a key for each kind.

    The key consists of the classes of the plugin and of its top-level object, and of the name in
    it.
    """
    params = mi.traverse(scene)
    roots = {o.id(): o.class_name() for o in (*scene.emitters(), *scene.shapes())}
    kinds = {}
    for key, entry in params.properties.items():
        plugin, (root, _, name) = entry[2].class_name(), key.partition(".")
        # Meshes with other faces would not bound the medium.
        if plugin not in CAMERA_SIDE and not key.endswith(".faces"):
            kinds[key] = (roots.get(root, root), name, plugin)
    return kinds


def own_keys(scenes, world: str, solver: str) -> list[str]:
    """Return parameters that occur in no earlier scene."""
    known = set()
    for name in WORLDS[: WORLDS.index(world)]:
        known |= {*edited_keys(loaded(scenes, name, solver)).values()}
    kinds = edited_keys(loaded(scenes, world, solver))
    return [key for key, kind in kinds.items() if kind not in known]


# The many parameters of surfaces and of suns in skies are assigned together below, and one by one
# in `tests/unit/scene/test_fingerprint_of_every_plugin.py`, without images.
@pytest.mark.parametrize("world", with_slow(WORLDS, "surfaces", "sunsky"))
def test_every_assigned_parameter_changes_the_image(scenes, world):
    """Every assigned parameter changes the image, and its previous value restores it.

    Parameters are changed one by one and all at once. Each image equals, bit by bit, that of an
    integrator that has not rendered before; the last one also equals that of a newly loaded scene.
    """
    scene = loaded(scenes, world, "path")
    builder = scene.integrator()._builder
    params, old = mi.traverse(scene), image(scene)
    first, given = old, {}
    for key in own_keys(scenes, world, "path"):
        original, plugin = plain(params[key]), params.properties[key][2]
        for factor in FACTORS:
            assign(params, key, edited(original, factor, plugin))
            params.update()
            found = image(scene)
            # Mitsuba rounds the inverse of an assigned transformation differently.
            same = factor == 1 and not is_transform(original)
            expected = first if same else image_without_past(scene)
            np.testing.assert_array_equal(found, expected, err_msg=f"{key} times {factor}")
            assert key.endswith(UNSEEN) or not np.array_equal(found, old), f"{key} shows nowhere"
            old, revision = found, builder.revision
            scene.integrator().prepare(scene)
            assert builder.revision == revision, "a cache was made for nothing"
        first, given[key] = old, edited(original, FACTORS[0], plugin)

    found = edited_image(scene, given)
    del scene, builder, params, plugin  # kernels differ where there are two scenes
    np.testing.assert_array_equal(found, edited_image(loaded(scenes, world, "path"), given))


def edited_image(scene: mi.Scene, values: dict) -> np.ndarray:
    """Assign ``values`` to parameters and render."""
    params = mi.traverse(scene)
    for key, value in values.items():
        assign(params, key, value)
    params.update()
    return image(scene)


@pytest.mark.parametrize("world", WORLDS)
def test_parameters_assigned_together_change_the_image_by_sweep(scenes, world):
    """Edits are found in the same way whatever the solver; what follows from them depends on it."""
    scene = loaded(scenes, world, "sweep")
    old, params, given = image(scene), mi.traverse(scene), {}
    for key in own_keys(scenes, world, "sweep"):
        plugin = params.properties[key][2]
        given[key] = edited(plain(params[key]), FACTORS[0], plugin)
    found = edited_image(scene, given)
    assert not np.array_equal(found, old)
    np.testing.assert_array_equal(found, image_without_past(scene))
    del scene, params, plugin  # kernels differ where there are two scenes
    np.testing.assert_array_equal(found, edited_image(loaded(scenes, world, "sweep"), given))


@pytest.mark.parametrize("world", with_slow(WORLDS, "surfaces"))
def test_arrays_edited_in_place_change_the_image(scenes, world):
    """Edits in place by ``dr.scatter``, as documented by Mitsuba, change the image."""
    scene = loaded(scenes, world, "path")
    params, old = mi.traverse(scene), image(scene)
    for key in own_keys(scenes, world, "path"):
        for _ in range(2):
            value = params[key]
            flat = value.array if dr.is_tensor_v(value) else value
            if not dr.is_jit_v(flat) or dr.depth_v(flat) != 1:
                continue
            plugin = params.properties[key][2]
            new = flat**0.8 if isinstance(plugin, mi.PhaseFunction) else 0.8 * flat
            dr.scatter(flat, new, dr.arange(mi.UInt32, dr.width(flat)))
            params.set_dirty(key)
            params.update()
            found = image(scene)
            np.testing.assert_array_equal(found, image_without_past(scene), err_msg=key)
            assert key.endswith(UNSEEN) or not np.array_equal(found, old), f"{key} shows nowhere"
            old = found


def _skip_where_numpy_copies() -> None:
    if not mi.variant().startswith("llvm"):
        pytest.skip("NumPy reads copies of the arrays of a GPU")


def test_writing_through_a_view_changes_the_image(scenes):
    """Edits through a NumPy view change the image.

    Such memory still belongs to the same variable, which a snapshot of the scene may hold, too.
    """
    _skip_where_numpy_copies()
    scene = loaded(scenes, "lights", "path")
    params, old = mi.traverse(scene), image(scene)
    for key in ("point.intensity.value", "shape.interior_medium.sigma_t.data"):
        value = params[key]
        (value.array if dr.is_tensor_v(value) else value.x).numpy()[:] *= 0.7
        if dr.is_tensor_v(value):  # Mitsuba copies the data for its lookups
            params.set_dirty(key)
            params.update()
        found = image(scene)
        np.testing.assert_array_equal(found, image_without_past(scene), err_msg=key)
        assert not np.array_equal(found, old), key
        old = found


def test_data_written_without_set_dirty_are_refused(scenes):
    """Data that were written without ``set_dirty`` are refused.

    Mitsuba copies the data for its lookups, and updates the copy only in ``params.update``.
    """
    _skip_where_numpy_copies()
    scene = loaded(scenes, "lights", "path")
    image(scene)
    params, key = mi.traverse(scene), "shape.interior_medium.sigma_t.data"
    params[key].array.numpy()[:] *= 0.7
    with pytest.raises(RuntimeError, match=r"edited in place.*set_dirty.*update"):
        image(scene)
    params.set_dirty(key)
    params.update()
    np.testing.assert_array_equal(image(scene), image_without_past(scene))


CAMERA_EDITS = {
    "sensor.to_world": lambda v: mi.ScalarTransform4f().look_at([4, 0, 3], [0, 0, 0], [0, 1, 0]),
    "sensor.x_fov": lambda v: 20.0,
    "sensor.near_clip": lambda v: 0.1,
    "sensor.film.size": lambda v: [5, 7],
}


# `test_surface_irradiance.py::test_nodes_are_reused_by_another_camera` moves one among surfaces.
@pytest.mark.parametrize("world", with_slow(["lights", "surfaces"], "surfaces"))
def test_moved_camera_rebuilds_no_cache(scenes, world, kernels):
    """Moving the camera rebuilds no cache, and launches no kernel to inspect parameters."""
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


def test_equal_value_rebuilds_no_cache(scenes):
    """Assigning an equal value in a new array rebuilds no cache."""
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
    scene = scenes.load(
        settings("path", emission=volume), fog(scenes), size=6, default_solver="path"
    )
    params, old = mi.traverse(scene), image(scene)
    (key,) = [k for k in params.keys() if k.endswith("emission.data")]
    for factor in (0.9, 0.75):
        params[key] = mi.TensorXf(np.array(params[key]) * factor)
        params.update()
        found = image(scene)
        assert found.sum() < old.sum()
        old = found
    fresh = scenes.load(
        settings("path", emission=volume), fog(scenes), size=6, default_solver="path"
    )
    others = mi.traverse(fresh)
    others[key] = params[key]
    others.update()
    np.testing.assert_array_equal(image(fresh), old)


def test_replaced_bsdf_is_detected(scenes):
    """Replacing an object is detected, although no parameter of the old one was edited."""
    scene = loaded(scenes, "surfaces", "path")
    old = image(scene)
    (ball,) = [s for s in scene.shapes() if s.class_name() == "Sphere"]
    ball.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": 0.05}))
    found = image(scene)
    np.testing.assert_array_equal(found, image_without_past(scene))
    assert not np.array_equal(found, old)
