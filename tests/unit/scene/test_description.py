"""The description of a scene is complete once it is made, and does not change."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.lights.emitters import EmitterKind
from mitsuba_irrcache.media.bake_emission import bake_emission
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.transport.path import Media

pytestmark = pytest.mark.usefixtures("rgb")


def several(scenes) -> mi.Scene:
    """Three cubes beside each other, the last within glass."""
    boxes = {
        name: scenes.boundary(
            scenes.medium(1.0 + i, 0.5), scenes.placement((1, 1, 1), center=(3 * i, 0, 0))
        )
        for i, name in enumerate("abc")
    }
    boxes["c"]["bsdf"] = {"type": "dielectric"}
    return scenes.load({"type": "volpath"}, None, **boxes)


@pytest.mark.parametrize(("max_depth", "visible"), [(-1, 3), (5, 2)])
def test_several_media(scenes, max_depth, visible):
    """A medium in glass has a cache if that holds all orders, with which paths can end."""
    description = compile_scene(several(scenes), max_depth=max_depth)
    grids = description.media.grids
    assert [grid.number for grid in grids] == [0, 1, 2]
    assert len({grid.name for grid in grids}) == 3
    assert len(description.visible) == visible and description.refracts == (visible == 3)
    for grid in grids:
        assert grid.is_traced and not grid.is_isolated and grid.has_exact_boundary
        around = Media.around(grid).grids
        assert around[grid.number] is grid
        assert [other.name for other in around] == [other.name for other in grids]
    assert float(description.brightest[0]) > 0


def test_the_radiance_behind_media_is_bounded(scenes):
    """The bound includes a sun of one texel, and walls next to a point light: rays that end where
    what remains is negligible must not let such radiance pass through opaque media.
    """
    texels = np.ones((128, 256, 3), dtype=np.float32)
    texels[40, 30] = 1e5
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels)}
    shape = scenes.boundary(scenes.medium(1.0, 0.5))
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3])}
    point = {"type": "point", "position": [0, 0, 2.9], "intensity": 10.0}
    for emitter, least in ((sky, 0.9e5), (point, 100)):
        objects = {"emitter": emitter, "sun": None, "wall": wall}
        description = compile_scene(scenes.load({"type": "volpath"}, shape, **objects))
        assert float(description.background_bound[0]) > least


def test_isolated_medium(scenes):
    scene = scenes.load({"type": "volpath"}, scenes.boundary(scenes.medium(1.0, 0.5)))
    emission = bake_emission(0.25, 2.0)
    description = compile_scene(scene, emission)
    (medium,) = description.visible
    assert description.media.grids == (medium,)
    assert medium.is_isolated and not medium.is_traced and medium.others == ()
    assert medium.emission is emission
    assert description.emitters.of(EmitterKind.CONSTANT_ENVIRONMENT)
    assert description.emits and description.brightest is None


def test_nothing_can_be_changed(scenes):
    description = compile_scene(several(scenes))
    medium = description.visible[0]
    with pytest.raises(FrozenInstanceError):
        description.visible = ()
    for made in (medium, description.media, description.emitters):
        for name in vars(made):
            with pytest.raises(AttributeError, match="immutable"):
                setattr(made, name, None)
    other = medium.replaced(emission=bake_emission(1.0, 1.0))
    assert medium.emission is None and other.emission is not None
    assert other.macrocells is medium.macrocells
    denser = medium.replaced(sigma_t=type(medium.sigma_t)(np.array([9.0])))
    assert denser.macrocells is not medium.macrocells


@pytest.mark.parametrize(("weight", "expected"), [(0.0, 1), (2.0, 0)])
def test_emitters_that_are_never_sampled_are_noted(scenes, logged, weight, expected):
    lamp = {"type": "point", "position": [2, 0, 0], "sampling_weight": weight}
    shape = scenes.boundary(scenes.medium(1.0, 0.5))
    compile_scene(scenes.load({"type": "volpath"}, shape, lamp=lamp))
    found = [text for text in logged if "sampling_weight 0" in text]
    assert len(found) == expected
    assert all('"lamp"' in text for text in found)


@pytest.mark.parametrize("face_normals", [False, True])
def test_emissive_meshes_with_interpolated_normals_are_noted(
    scenes, logged, tmp_path, face_normals
):
    """Mitsuba samples their emission inconsistently: the images of volpath are 10 % too dark."""
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=np.float32)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    mesh = mi.Mesh("box", 8, 12)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(corners.ravel())
    params["faces"] = mi.UInt32(np.ravel(triangles).astype(np.uint32))
    params.update()
    mesh.write_ply(str(tmp_path / "box.ply"))
    lamp = {"type": "ply", "filename": str(tmp_path / "box.ply"), "face_normals": face_normals}
    place = mi.ScalarTransform4f().translate([0, 3, 0])
    lamp |= {"to_world": place, "emitter": {"type": "area", "radiance": 2.0}}
    cube = {"type": "cube", "to_world": place.translate([0, 3, 0]), "emitter": lamp["emitter"]}
    shape = scenes.boundary(scenes.medium(1.0, 0.5))
    compile_scene(scenes.load({"type": "volpath"}, shape, lamp=lamp, cube=cube))
    found = [text for text in logged if "face_normals" in text]
    assert len(found) == (not face_normals)
    assert all('"lamp"' in text for text in found)


@pytest.mark.parametrize("solver", ["sweep", "path"])
@pytest.mark.parametrize("max_depth", [2, -1])
def test_emitters_that_are_never_sampled_do_not_illuminate(scenes, solver, max_depth):
    """As with Mitsuba's integrators; solvers disagreed about them."""
    look = mi.ScalarTransform4f().look_at([0, 3, 0], [0, 0, 0], [1, 0, 0])
    emitters = {
        "a": {"type": "point", "position": [2, 0, 0], "intensity": 50.0},
        "b": {"type": "spot", "to_world": look, "intensity": 50.0},
        "c": {"type": "directional", "direction": [0, -1, 0], "irradiance": 50.0},
    }
    never = {name: emitter | {"sampling_weight": 0.0} for name, emitter in emitters.items()}
    settings = {"type": "irrcache", "resolution": 8, "solver": solver, "max_depth": max_depth}
    shape = scenes.boundary(scenes.medium(1.0, 0.5))
    with_them, without = (
        np.array(mi.render(scenes.load(settings, shape, 8, **more), spp=16, seed=1))
        for more in (never, {})
    )
    np.testing.assert_allclose(with_them, without, rtol=1e-5, atol=1e-6)


def test_shapes_without_sampled_positions_are_described(scenes):
    """Mitsuba samples no positions on instances and signed distance fields."""
    beside = mi.ScalarTransform4f().translate([3, 0, 0])
    values = np.linspace(-0.5, 0.5, 64, dtype=np.float32).reshape(4, 4, 4, 1)
    objects = {
        "group": {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.4}},
        "copy": {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": beside,
        },
        "field": {"type": "sdfgrid", "grid": mi.TensorXf(values), "to_world": beside},
    }
    scene = scenes.load({"type": "volpath"}, scenes.boundary(scenes.medium(1.0, 0.5)), **objects)
    assert len(compile_scene(scene).visible) == 1


def test_sizes_of_objects_are_those_within_the_medium(scenes):
    """Neither the length of a rod nor the thickness of a sheet is the size of an object."""

    def placed(*scale: float) -> object:
        return mi.ScalarTransform4f().translate((0.5, 0.5, 0.5)).scale(scale)

    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    rod = {"type": "cylinder", "p0": [0.5, 0.5, 0], "p1": [0.5, 0.5, 1], "radius": 0.05}
    objects = {
        "floor": {"type": "rectangle", "to_world": placed(9, 0.2, 1), "bsdf": bsdf},
        "rod": rod | {"bsdf": bsdf},
        "outside": {"type": "sphere", "center": [3, 0, 0], "radius": 0.5, "bsdf": bsdf},
    }
    box = {
        "type": "cube",
        "to_world": placed(0.5, 0.5, 0.5),
        "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5},
    }
    description = compile_scene(mi.load_dict({"type": "scene", "box": box} | objects))
    (medium,) = description.visible
    np.testing.assert_allclose(medium.object_sizes, [0.1, 0.4], rtol=1e-5)


@pytest.mark.parametrize(("distance", "floor", "warns"), [(0, 500, 0), (100, 5, 1)])
def test_media_far_from_the_origin_are_noted(monkeypatch, distance, floor, warns):
    """Rays skip a part of a medium by its own distance from the origin, not that of other shapes:
    a large floor is no reason for a warning.
    """
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    transform = mi.ScalarTransform4f
    box = {
        "type": "cube",
        "to_world": transform().translate((distance, 0, 0)),
        "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5},
    }
    place = transform().translate((0, -2, 0)).rotate((1, 0, 0), -90).scale(floor)
    ground = {"type": "rectangle", "to_world": place}
    compile_scene(mi.load_dict({"type": "scene", "box": box, "ground": ground}))
    assert sum("rays that leave surfaces near it skip" in text for text in messages) == warns


def test_emitters_that_mitsuba_samples_as_black_are_refused(scenes, tmp_path):
    """Mitsuba evaluates vertex colours to 0 at sampled positions. Media near such a lamp were black
    without a message.
    """
    mesh = mi.Mesh("quad", 3, 1)
    mesh.add_attribute("vertex_color", 3, [4.0] * 9)
    values = mi.traverse(mesh)
    values["vertex_positions"], values["faces"] = [0, 3, 0, 1, 3, 0, 0, 3, 1], [0, 1, 2]
    values.update()
    mesh.write_ply(str(tmp_path / "lamp.ply"))
    radiance = {"type": "mesh_attribute", "name": "vertex_color"}
    area = {"type": "area", "radiance": radiance}
    lamp = {"type": "ply", "filename": str(tmp_path / "lamp.ply"), "emitter": area}
    scene = scenes.load(
        {"type": "volpath"},
        None,
        box=scenes.boundary(scenes.medium(1.0, 0.5), scenes.placement()),
        lamp=lamp,
    )
    with pytest.raises(UnsupportedSceneError, match=r'"lamp".*"mesh_attribute"'):
        compile_scene(scene)
