"""Boundaries are recognised from any plugin, and intersections agree with Mitsuba's."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.boundary import Boundary, boundary_of, orientation

pytestmark = pytest.mark.usefixtures("rgb")

PLACEMENTS = [
    {},
    {"turn": 35.0, "edges": (0.3, 2.0, 1.0)},
    {"mirror": True, "turn": 10.0, "center": (2.0, -1.0, 0.5)},
]


def rays(count: int = 2048) -> tuple[np.ndarray, np.ndarray]:
    """Return rays from a sphere around the origin towards points near it, (3, n) each, float32."""
    rng = np.random.default_rng(3)
    origin = rng.normal(size=(3, count))
    origin *= 5 / np.linalg.norm(origin, axis=0)
    direction = rng.uniform(-1.5, 1.5, (3, count)) - origin
    return np.float32(origin), np.float32(direction / np.linalg.norm(direction, axis=0))


@pytest.mark.parametrize("kind", ["cube", "sphere"])
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_intersections_equal_mitsubas(scenes, kind, placement):
    """Entry and exit distances equal those of ray tracing against the shape."""
    if kind == "sphere":
        placement = {k: v for k, v in placement.items() if k == "center"}
    shape = scenes.boundary(scenes.medium(1.0, 0.5), scenes.placement(**placement), kind)
    scene = scenes.load({"type": "volpath"}, shape)
    boundary = boundary_of(scene, scene.shapes()[0])
    origin, direction = rays()
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
    hit, near, far = boundary.intersect(ray)
    hit, near, far = np.array(hit), np.array(near), np.array(far)
    front = scene.ray_intersect_preliminary(ray)
    back = scene.ray_intersect_preliminary(mi.Ray3f(ray(20.0), -ray.d))
    first, last = np.array(front.t), 20.0 - np.array(back.t)
    grazing = np.isfinite(first) & (last - first < 1e-3)
    seen = np.isfinite(first) & ~grazing
    assert 0.1 < seen.mean() < 0.99
    assert (hit[seen]).all() and not (hit & ~np.isfinite(first)).mean() > 1e-3
    np.testing.assert_allclose(near[seen], first[seen], atol=2e-4)
    np.testing.assert_allclose(far[seen], last[seen], atol=2e-4)


@pytest.mark.parametrize("kind", ["box", "sphere"])
def test_intersections_from_inside(kind):
    """From inside, the entry lies behind and the exit ahead."""
    boundary = Boundary(kind, np.eye(4))
    ray = mi.Ray3f(mi.Point3f(0.25, 0, 0), mi.Vector3f(1, 0, 0))
    hit, near, far = boundary.intersect(ray)
    assert hit[0]
    assert near[0] == pytest.approx(-1.25) and far[0] == pytest.approx(0.75)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_any_scale(scale):
    """Intersections are the same at any scale, in units of the size."""
    boundary = Boundary("box", np.diag([scale, scale, scale, 1.0]))
    origin, direction = rays(256)
    ray = mi.Ray3f(mi.Point3f(origin * np.float32(scale)), mi.Vector3f(direction))
    unit = Boundary("box", np.eye(4)).intersect(
        mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
    )
    hit, near, far = boundary.intersect(ray)
    seen = np.array(unit[0])
    np.testing.assert_array_equal(np.array(hit), seen)
    for mine, theirs in ((near, unit[1]), (far, unit[2])):
        np.testing.assert_allclose(np.array(mine)[seen] / scale, np.array(theirs)[seen], rtol=1e-4)


def test_a_box_from_another_plugin(scenes, tmp_path):
    """A PLY of the rotated cube's mesh gives the same boundary."""
    place = scenes.placement((1.0, 2.0, 3.0), turn=50)
    shape = scenes.boundary(scenes.medium(1.0, 0.5), place)
    cube = scenes.load({"type": "volpath"}, shape)
    cube.shapes()[0].write_ply(str(tmp_path / "box.ply"))
    again = shape | {"type": "ply", "filename": str(tmp_path / "box.ply")}
    del again["to_world"]
    mesh = scenes.load({"type": "volpath"}, again)
    expected, measured = (boundary_of(s, s.shapes()[0]).to_world for s in (cube, mesh))
    np.testing.assert_allclose(measured, expected, atol=1e-5)


def test_caches_of_other_shapes_are_not_merged(scenes):
    shape = scenes.boundary(scenes.medium(1.0, 0.5)) | {"type": "cylinder"}
    scene = scenes.load({"type": "volpath"}, shape)
    with pytest.raises(UnsupportedSceneError, match=r"Cylinder.*boxes"):
        boundary_of(scene, scene.shapes()[0])


def test_inward_normals_are_refused(scenes):
    """Inward normals are refused: Mitsuba fills the outside of a mirrored cube."""
    shape = scenes.boundary(scenes.medium(1.0, 0.5))
    shape["to_world"] = mi.ScalarTransform4f(np.diag([-1.0, 1, 1, 1]))
    scene = scenes.load({"type": "volpath"}, shape)
    with pytest.raises(UnsupportedSceneError, match="normals"):
        boundary_of(scene, scene.shapes()[0])


def test_walls_that_touch_a_box(scenes):
    """Behind a wall that touches a face, Mitsuba's ray offset steps over the face, so that some
    rays only leave the box: its normals are not at fault.
    """
    look = mi.ScalarTransform4f().look_at
    walls = {
        f"wall{i}": {
            "type": "rectangle",
            "to_world": look([0, y, 0], [0, 0, 0.001], [0, 0, 1]).scale(2),
        }
        for i, y in enumerate((-1.0005, 1.0005))
    }
    null = {"type": "null"}
    box = {"type": "cube", "bsdf": null, "interior": scenes.medium(1.0, 0.5), "id": "box"}
    scene = scenes.load({"type": "volpath"}, box, **walls)
    (shape,) = (s for s in scene.shapes() if s.id() == "box")
    assert 0.02 < orientation(scene, shape)[0] < 0.5
    np.testing.assert_allclose(boundary_of(scene, shape).to_world, np.eye(4), atol=1e-6)


def test_some_inward_normals_are_refused(scenes, tmp_path):
    """A box of which two triangles are wound the other way is not a boundary."""
    shape = scenes.boundary(scenes.medium(1.0, 0.5))
    cube = scenes.load({"type": "volpath"}, shape)
    values = mi.traverse(cube.shapes()[0])
    points = np.array(values["vertex_positions"]).reshape(-1, 3)
    faces = np.array(values["faces"]).reshape(-1, 3)
    faces[:2] = faces[:2, ::-1]
    lines = [f"v {x} {y} {z}" for x, y, z in points]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    (tmp_path / "box.obj").write_text("\n".join(lines) + "\n")
    again = shape | {"type": "obj", "filename": str(tmp_path / "box.obj"), "face_normals": True}
    del again["to_world"]
    scene = scenes.load({"type": "volpath"}, again)
    with pytest.raises(UnsupportedSceneError, match=r"% of the normals"):
        boundary_of(scene, scene.shapes()[0])
