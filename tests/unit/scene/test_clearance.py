"""Scenes in which surfaces lie in faces of boxes that bound media."""

from __future__ import annotations

from threading import Thread

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.scene.clearance import (
    CLEARANCE,
    SeparatedScene,
    mark_as_moved,
    separated,
)
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.scene.consistency import RAY_OFFSET
from tests.support.surfaces import bound, fog, lamp, placed, ref

pytestmark = pytest.mark.usefixtures("rgb")


def floor(height: float = -1.0) -> dict:
    place = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(4)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}}


def loaded(box: dict | None = None, **objects) -> mi.Scene:
    """Return a scene with a box of fog, by default [-1, 1]^3, and an environment."""
    box = box or bound(interior=fog())
    sky = {"type": "constant", "radiance": 0.5}
    return mi.load_dict({"type": "scene", "box": box, "sky": sky} | objects, optimize=False)


def shape(scene: mi.Scene, name: str) -> mi.Shape:
    return next(s for s in scene.shapes() if s.id() == name)


@pytest.mark.parametrize("height", [-1.0, -1.00015, -0.99985])
def test_the_touched_face_is_moved_inwards(height):
    """Only the box is another object, whatever its distance from the floor within the offset."""
    scene = loaded(floor=floor(height), lamp=lamp((0, 3, 0), (0, 0, 0)))
    result = separated(scene)
    old, new = (shape(s, "box").bbox() for s in (scene, result))
    gap = max(height + 1, 0) + CLEARANCE * 2 * RAY_OFFSET
    np.testing.assert_allclose(new.min, [-1, -1 + gap, -1], rtol=1e-5)
    np.testing.assert_array_equal(new.max, old.max)
    assert [s.id() for s in result.shapes()] == [s.id() for s in scene.shapes()]
    assert {s for s in scene.shapes() if s not in result.shapes()} == {shape(scene, "box")}
    assert shape(result, "box").interior_medium() == shape(scene, "box").interior_medium()
    assert set(result.emitters()) == set(scene.emitters())
    assert result.sensors() == scene.sensors()
    assert separated(result) is None


def test_the_bounds_of_the_environment_are_unchanged():
    scene = loaded(floor=floor(), far={"type": "sphere", "center": [90, 0, 0]})
    before = str(scene.environment())
    assert separated(scene) is not None
    assert str(scene.environment()) == before


@pytest.mark.parametrize("turn", [0.0, 35.0])
def test_faces_of_a_room(turn):
    """A box in a room whose walls all touch it is smaller on all sides, in its own frame."""
    place = mi.ScalarTransform4f().rotate([0, 0, 1], turn).scale([1, 2, 0.5])
    box = bound(interior=fog()) | {"to_world": place}
    walls = {"type": "cube", "to_world": place, "flip_normals": True, "bsdf": {"type": "diffuse"}}
    result = separated(loaded(box, walls=walls))
    corners = np.array(mi.traverse(shape(result, "box"))["vertex_positions"]).reshape(-1, 3)
    local = (np.linalg.inv(np.array(place.matrix)[:3, :3]) @ corners.T).T * [1, 2, 0.5]
    sides = np.abs(local).max(axis=0)
    assert (np.abs(np.abs(local) - sides) < 1e-5).all()
    gap = [1, 2, 0.5] - sides
    assert (gap > 5e-4).all() and np.ptp(gap) < 1e-5


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(lambda: loaded(floor=floor(-1.01)), id="a gap"),
        pytest.param(lambda: loaded(floor=floor(-0.9)), id="a floor within"),
        pytest.param(loaded, id="no surface"),
        pytest.param(lambda: loaded(bound("sphere", fog()), floor=floor()), id="a sphere"),
        pytest.param(
            lambda: loaded(bound(interior=fog()) | {"bsdf": {"type": "dielectric"}}, floor=floor()),
            id="glass",
        ),
    ],
)
def test_other_scenes_remain_as_they_are(scene):
    scene = scene()
    assert separated(scene) is None
    assert SeparatedScene().of(scene) is scene


def test_reversed_normals_are_refused(logged):
    """A box with reversed normals does not become another one."""
    box = bound(interior=fog()) | {"to_world": mi.ScalarTransform4f().scale([-1, 1, 1])}
    scene = SeparatedScene().of(loaded(box, floor=floor()))
    with pytest.raises(UnsupportedSceneError, match="inwards"):
        compile_scene(scene)


def corner_mesh(vertices: np.ndarray, faces: list, **properties) -> mi.Mesh:
    """Return a mesh with other properties of shapes."""
    props = mi.Properties()
    for key, value in properties.items():
        props[key] = value
    mesh = mi.Mesh("mesh", len(vertices), len(faces), props=props)
    values = mi.traverse(mesh)
    values["vertex_positions"] = mi.Float(np.float32(vertices.ravel()))
    values["faces"] = mi.UInt32(np.ravel(faces).astype(np.uint32))
    values.update()
    return mesh


@pytest.mark.parametrize("height", [0.35, 1.2, 5.0])
def test_attics(height):
    """At acute edges, where moves of both faces add up, all faces end at the distance."""
    flat = np.array([(-2, -1), (2, -1), (0, height - 1)])
    vertices = np.array([(*p, z) for z in (-1, 1) for p in flat])
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    medium, null = mi.load_dict(fog()), mi.load_dict({"type": "null"})
    box = corner_mesh(vertices, faces, bsdf=null, interior=medium)
    grey = mi.load_dict({"type": "diffuse"})
    room = corner_mesh(vertices, faces, bsdf=grey, flip_normals=True)
    made = mi.traverse(shape(separated(loaded(box, room=room)), "box"))
    moved = np.array(made["vertex_positions"]).reshape(-1, 3) - vertices
    expected = CLEARANCE * (1 + np.abs(vertices).max()) * RAY_OFFSET
    for corners in faces:
        a, b, c = vertices[corners]
        normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        np.testing.assert_allclose(moved[corners] @ normal, -expected, rtol=0.01)


def test_opposite_faces_in_one_plane():
    """Two boxes in one mesh, of which one ends where the other one begins, move apart."""
    null = {"type": "null"}
    low = bound(interior=ref("fog"), center=(-1.5, -0.5, 0), scale=(1, 0.5, 1))
    high = bound(interior=ref("fog"), center=(1.5, 0.5, 0), scale=(1, 0.5, 1))
    plate = {"type": "rectangle", "to_world": placed(scale=(4, 4, 1)).rotate([1, 0, 0], -90)}
    objects = {"low": low | {"bsdf": ref("null")}, "high": high | {"bsdf": ref("null")}}
    both_sides = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    scene = mi.load_dict(
        {"type": "scene", "fog": fog(), "null": null, "plate": plate | {"bsdf": both_sides}}
        | objects
    )
    (merged,) = [s for s in separated(scene).shapes() if s.interior_medium() is not None]
    y = np.array(mi.traverse(merged)["vertex_positions"]).reshape(-1, 3)[:, 1]
    gap = CLEARANCE * 3.5 * RAY_OFFSET
    np.testing.assert_allclose(np.sort(np.unique(y.round(6))), [-1, -gap, gap, 1], atol=2e-6)


def test_large_media_elsewhere_do_not_matter():
    """The distance is that of a boundary's own coordinates."""
    cloud = bound(interior=fog(), center=(0, 80, 0), scale=(500, 20, 500))
    box = bound(interior=fog((2, 2, 2)))
    result = separated(loaded(box, cloud=cloud, floor=floor()))
    gap = CLEARANCE * 2 * RAY_OFFSET
    assert abs(shape(result, "box").bbox().min.y - (-1 + gap)) < 1e-5


def test_threads_do_not_see_other_names():
    scene = loaded(floor=floor(), lamp=lamp((0, 3, 0), (0, 0, 0)))
    ids = [s.id() for s in scene.shapes()]
    threads = [Thread(target=lambda: [separated(scene) for _ in range(5)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [s.id() for s in scene.shapes()] == ids


def test_meshes_without_area_are_left_to_other_checks():
    medium, null = mi.load_dict(fog()), mi.load_dict({"type": "null"})
    flat = corner_mesh(np.zeros((3, 3)), [[0, 1, 2]], bsdf=null, interior=medium)
    assert separated(loaded(flat=flat, floor=floor(-5.0))) is None


def test_names_remain():
    """Mitsuba renames objects that are passed to it in a dictionary."""
    smoke = bound(interior=fog() | {"id": "smoke"}) | {"bsdf": {"type": "null", "id": "clear"}}
    scene = loaded(smoke, floor=floor() | {"bsdf": {"type": "diffuse", "id": "grey"}})
    keys = set(mi.traverse(scene).keys())
    result = separated(scene)
    assert set(mi.traverse(scene).keys()) == keys
    for used in (scene, result):
        box = shape(used, "box")
        assert (box.interior_medium().id(), box.bsdf().id()) == ("smoke", "clear")


@pytest.mark.parametrize("merged", [False, True])
def test_small_parts_of_large_meshes(merged):
    """A table is a small part of the mesh into which Mitsuba merges it and the ground, and the ends
    of a corridor are small compared to its sides.
    """
    grey = ref("grey")
    table = {"type": "cube", "to_world": placed((0, -1.1, 0), (1.5, 0.1, 1.5)), "bsdf": grey}
    ground = {"type": "cube", "to_world": placed((0, -4, 0), (9, 1, 9)), "bsdf": grey}
    place = placed((0, 5, 0), (16, 1, 1))
    walls = {"type": "cube", "to_world": place, "flip_normals": True, "bsdf": {"type": "conductor"}}
    hall = bound(interior=fog((2, 2, 2))) | {"to_world": place}
    objects = {"box": bound(interior=fog()), "table": table, "ground": ground}
    objects["grey"] = {"type": "diffuse"}
    scene = mi.load_dict({"type": "scene", "hall": hall, "walls": walls} | objects, optimize=merged)
    assert len(scene.shapes()) == 5 - merged
    result = separated(scene)
    for name, faces in (("box", 1), ("hall", 6)):
        old, new = (shape(s, name).bbox() for s in (scene, result))
        moved = np.abs(np.array([old.min, old.max]) - np.array([new.min, new.max]))
        assert np.count_nonzero(moved > 3e-4) == faces


def test_nested_boxes_on_a_floor():
    """The inner box stays within the outer one."""
    names = ("box", "inner", "core")
    media = {f"m{i}": fog((1 + i,) * 3) for i in range(3)}
    boxes = {}
    for i, name in enumerate(names):
        size = 0.5**i
        around = {"exterior": ref(f"m{i - 1}")} if i else {}
        box = bound(
            interior=ref(f"m{i}"), center=(0, size / 2 - 1, 0), scale=(size, size / 2, size)
        )
        boxes[name] = box | around
    result = separated(loaded(floor=floor(), **media, **boxes))
    low = [shape(result, name).bbox().min.y for name in names]
    assert (np.diff([-1, *low]) > 3 * RAY_OFFSET).all()
    assert len(compile_scene(result).media.grids) == 3


@pytest.mark.parametrize("tilt", [2e-4, 1e-3, 3e-3])
def test_tilted_floors(tilt):
    """A floor that crosses a face at a small angle ends up outside of the whole box."""
    place = placed((0, -1, 0), (3, 3, 1), (0, 0, tilt))
    scene = loaded(floor={"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}})
    assert shape(separated(scene), "box").bbox().min.y > -1 + 0.99 * tilt + 3 * RAY_OFFSET


def test_prisms_on_a_floor(tmp_path):
    """A mesh that is no box keeps its form, but for the vertices in the plane of the floor."""
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.array([np.cos(turns), np.zeros(24), -np.sin(turns)]).T
    up = np.array([0, 1, 0])
    vertices = np.concatenate([ring - up, ring + up, [-up, up]])
    faces = []
    for a in range(24):
        b = (a + 1) % 24
        faces += [[a, b, 24 + b], [a, 24 + b, 24 + a], [48, b, a], [49, 24 + a, 24 + b]]
    corner_mesh(vertices, faces).write_ply(str(tmp_path / "prism.ply"))
    box = {"type": "ply", "filename": str(tmp_path / "prism.ply"), "interior": fog()}
    scene = loaded(box | {"bsdf": {"type": "null"}}, floor=floor())
    made = mi.traverse(shape(separated(scene), "box"))
    moved = np.array(made["vertex_positions"]).reshape(-1, 3) - vertices
    lowest = vertices[:, 1] < 0
    np.testing.assert_allclose(moved[lowest, 1], CLEARANCE * 2 * RAY_OFFSET, rtol=1e-3)
    assert np.abs(moved[:, [0, 2]]).max() < 1e-6 and np.abs(moved[~lowest]).max() < 1e-6


def test_instances_remain():
    """A second scene has the groups of shapes of its instances."""
    tree = {"type": "shapegroup", "trunk": {"type": "cube", "to_world": placed(scale=(0.1,) * 3)}}
    place = placed((2, 0, 0))
    instance = {"type": "instance", "to_world": place, "group": ref("tree")}
    result = separated(loaded(tree=tree, instance=instance, floor=floor()))
    si = result.ray_intersect(mi.Ray3f([2, 5, 0], [0, -1, 0]))
    assert abs(float(si.t[0]) - 4.9) < 1e-5


def test_shapes_marked_as_moved_stay():
    """Neither the positions of shapes of a group nor normals that a user has set change."""
    group = mi.load_dict({
        "type": "shapegroup", "trunk": {"type": "cube"}, "crown": {"type": "sphere", "radius": 0.4}
    })  # fmt: skip
    params = mi.traverse(group)
    params["trunk.vertex_normals"] = mi.Float(np.tile([0.0, 0.6, 0.8], 24))
    params.update()
    keys = [k for k in params.keys() if k.startswith(("trunk", "crown")) and "bsdf" not in k]
    before = {key: np.array(params[key]) for key in keys if key != "crown.to_world"}
    box = [np.array(group.bbox().min), np.array(group.bbox().max)]
    mark_as_moved(group)
    params = mi.traverse(group)
    for key, value in before.items():
        assert (np.array(params[key]) == value).all(), key
    assert (np.array([group.bbox().min, group.bbox().max]) == np.array(box)).all()


def test_thin_boxes_are_named(logged):
    """A face is not moved by a considerable share of the box."""
    box = bound(interior=fog(), scale=(1, 1e-3, 1))
    assert separated(loaded(box, floor=floor(-1e-3))) is None
    (text,) = logged
    assert 'shape "box"' in text and "lie in a face" in text


def test_the_second_scene_is_reused_until_shapes_move():
    scene = loaded(floor=floor(), sun={"type": "directional", "direction": [0, -1, 0]})
    separation = SeparatedScene()
    first = separation.of(scene)
    assert first is not scene and separation.of(scene) is first
    params = mi.traverse(scene)

    def edited(key: str, value: object) -> mi.Scene:
        params[key] = value
        params.update()
        return separation.of(scene)

    # Objects that both scenes share.
    assert edited("sky.radiance.value", 2.0) is first
    assert edited("floor.bsdf.reflectance.value", 0.1) is first
    assert edited("box.interior_medium.sigma_t.value.value", mi.Color3f(2.0)) is first
    # Each scene has its own distribution of emitters.
    second = edited("sun.sampling_weight", 3.0)
    assert second is not first
    up, down = (placed((0, y, 0)).rotate([1, 0, 0], -90).scale(4) for y in (-1.0, -1.5))
    assert edited("floor.to_world", mi.Transform4f(mi.Matrix4f(np.array(down.matrix)))) is scene
    third = edited("floor.to_world", mi.Transform4f(mi.Matrix4f(np.array(up.matrix))))
    assert third is not scene and separation.of(scene) is third
    assert separation.of(loaded(floor=floor())) is not third


def closed_cylinder(height: float) -> dict:
    """Return a cylinder of fog on ``y = height`` that two disks close."""
    part = {"bsdf": {"type": "null"}, "interior": fog()}
    up = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    down = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], 90)
    side = {"type": "cylinder", "p0": [0, height, 0], "p1": [0, 1, 0]} | part
    top = {"type": "disk", "to_world": mi.ScalarTransform4f().translate([0, 1, 0]) @ up} | part
    return {"side": side, "top": top, "bottom": {"type": "disk", "to_world": down} | part}


@pytest.mark.parametrize(("height", "named"), [(0.0, ["bottom"]), (0.01, [])])
def test_disks_on_a_floor_are_named(logged, height, named):
    """Shapes without vertices are not moved."""
    objects = closed_cylinder(height) | {"floor": floor(0), "sky": {"type": "constant"}}
    assert separated(mi.load_dict({"type": "scene"} | objects, optimize=False)) is None
    assert len(logged) == len(named)
    assert all(f'face of shape "{name}" (Disk)' in logged[0] for name in named)


@pytest.mark.parametrize(("radius", "named"), [(1.0, True), (1.00015, True), (1.01, False)])
def test_spherical_rooms_are_named(logged, radius, named):
    """A sphere of fog within walls of the same radius, and within wider ones."""
    box = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog()}
    scene = loaded(box, walls={"type": "sphere", "radius": radius, "flip_normals": True})
    assert separated(scene) is None
    assert any("(Sphere)" in text for text in logged) == named
