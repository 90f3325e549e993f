"""Solid angles of area emitters: against Mitsuba's sampling, and which emitters are supported."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.sequences import kronecker
from mitsuba_irrcache.lights.solid_angle import SolidAngle

pytestmark = pytest.mark.usefixtures("rgb")

PLACES, SAMPLES = 256, 8192
SHAPES = {
    "rectangle": {"type": "rectangle"},
    "flipped rectangle": {"type": "rectangle", "flip_normals": True},
    "disk": {"type": "disk"},
    "sphere": {"type": "sphere"},
    "cube": {"type": "cube"},
}
QUAD = {
    "vertex_positions": [[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]],
    "faces": [[0, 1, 2], [0, 2, 3]],
}


def emitter(shape: dict, **more) -> mi.Emitter:
    place = mi.ScalarTransform4f().translate([0.1, -0.2, 0.3]).rotate([0.48, 0.64, 0.6], 50)
    scale = 0.4 if shape["type"] in ("sphere", "disk") else [0.5, 0.3, 0.4]
    area = {"type": "area", "radiance": 1.0} | more
    scene = {"type": "scene", "lamp": shape | {"to_world": place.scale(scale), "emitter": area}}
    emitter.scene = mi.load_dict(scene)  # keeps the shape alive
    return emitter.scene.emitters()[0]


def places() -> mi.Point3f:
    return mi.Point3f(np.float32(np.random.default_rng(1).uniform(-1.5, 1.5, (3, PLACES))))


def sampled(light: mi.Emitter, p: mi.Point3f) -> np.ndarray:
    """Return the solid angle at each place: the mean of Mitsuba's own samples."""
    lane = dr.repeat(dr.arange(mi.UInt32, PLACES), SAMPLES)
    rng, vertex = mi.PCG32(PLACES * SAMPLES), dr.zeros(mi.Interaction3f, PLACES * SAMPLES)
    vertex.p = dr.gather(mi.Point3f, p, lane)
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    record, weight = light.sample_direction(vertex, sample)
    seen = ~emitter.scene.ray_test(vertex.spawn_ray_to(record.p))
    weight = dr.select(seen & (dr.dot(record.n, record.d) < 0), weight[0], 0)
    return np.array(dr.block_sum(weight, SAMPLES)) / SAMPLES


@pytest.mark.parametrize("name", SHAPES)
def test_solid_angle(name):
    """The closed form agrees with sampling; flat emitters have none behind them."""
    light, p = emitter(SHAPES[name]), places()
    angle = SolidAngle.of(light)
    found, expected = np.array(angle.at(p)), sampled(light, p)
    far = np.array(dr.norm(angle.closest(p) - p)) > 0.15
    np.testing.assert_allclose(found[far], expected[far], rtol=0.15, atol=0.01)
    assert found[far].sum() == pytest.approx(expected[far].sum(), rel=0.01)
    assert ((found == 0) == (expected == 0))[far].mean() > 0.98
    assert found.max() < 2 * np.pi + 1e-4


@pytest.mark.parametrize("name", SHAPES)
def test_closest_point(name):
    """No sampled point of the shape is closer than the closest one, which lies on the shape."""
    light, p = emitter(SHAPES[name]), places()
    angle, sample = SolidAngle.of(light), np.float32(np.random.default_rng(2).random((2, 4096)))
    points = np.array(light.get_shape().sample_position(0.0, mi.Point2f(sample)).p)
    distance = np.array(dr.norm(angle.closest(p) - p))
    nearest = np.linalg.norm(np.array(p)[:, :, None] - points[:, None], axis=0).min(axis=1)
    outside = distance > 1e-3
    assert (distance[outside] <= nearest[outside] + 1e-4).all()
    assert np.abs(distance - nearest)[outside].max() < 0.05


@pytest.mark.parametrize("name", ["rectangle", "disk", "cube"])
@pytest.mark.parametrize("sheared", [False, True])
def test_sampled_points(name, sheared):
    """Sampled points lie on the shape, where they are seen; their mean weight is the solid angle,
    from the back of flat shapes too, and no weight is much larger. Inside of a cube all are 0.
    """
    frame = SolidAngle.of(emitter(SHAPES[name])).frame
    if sheared:
        frame = frame @ np.array([[1, 0.6, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    angle = SolidAngle(name.replace("cube", "box"), frame, None if name == "cube" else frame[:3, 2])
    count = 1 << 18
    lane = dr.arange(mi.UInt32, count)
    sample = mi.Point2f(mi.Float(lane) / count, kronecker(lane, 1)[0])
    for p in ([0.6, 0.9, 0.1], [-0.5, -0.6, 0.9], [0.3, 0.1, 1.4], [0.2, 0.0, 0.6]):
        position = mi.Point3f(*(dr.full(mi.Float, v, count) for v in p))
        shares = angle.shares(position)
        direction, distance, weight = angle.sample(position, shares, sample)
        local = np.linalg.inv(frame) @ [*np.array(position + distance * direction), np.ones(count)]
        if name == "cube":
            np.testing.assert_allclose(np.abs(local[:3]).max(axis=0), 1, atol=1e-4)
        else:
            extent = np.hypot(*local[:2]) if name == "disk" else np.abs(local[:2]).max(axis=0)
            assert np.abs(local[2]).max() < 1e-5 and extent.max() < 1 + 1e-4
        seen = max(float(angle.at(mi.Point3f(p))[0]), _behind(angle, p))
        # The solid angle of a disk is that of a polygon.
        assert float(dr.mean(weight)[0]) == pytest.approx(
            seen, rel=0.02 if name == "disk" else 1e-3
        )
        assert float(dr.max(weight)[0]) < 3 * seen or not dr.any(weight != 0)


@pytest.mark.parametrize("name", ["rectangle", "disk", "cube"])
def test_sampled_points_of_positions_in_a_plane(name):
    """In the plane of a flat shape, on it and inside of a box, samples are finite and lie on it."""
    angle = SolidAngle.of(emitter(SHAPES[name]))
    rng, count = mi.PCG32(1 << 12), 1 << 12
    sample = mi.Point2f(rng.next_float32(), rng.next_float32())
    local = ([0, 0, 0], [0.3, -0.2, 0], [2, 0, 0], [0, 40, 0], [1, 1, 0])
    for place in local:
        p = (angle.frame @ [*place, 1])[:3]
        position = mi.Point3f(*(dr.full(mi.Float, float(v), count) for v in p))
        direction, distance, weight = angle.sample(position, angle.shares(position), sample)
        assert np.isfinite(np.array(weight)).all() and np.array(weight).min() >= 0
        at = np.array(position + distance * direction)
        assert np.abs(np.linalg.inv(angle.frame) @ [*at, np.ones(count)]).max() < 1 + 1e-3


def _behind(angle: SolidAngle, p: list[float]) -> float:
    """Return the solid angle of a flat shape seen from the mirror image of a position."""
    if not angle.is_flat:
        return 0.0
    normal, centre = np.cross(*angle.frame[:3, :2].T), angle.frame[:3, 3]
    normal /= np.linalg.norm(normal)
    mirrored = np.array(p) - 2 * normal * (normal @ (np.array(p) - centre))
    return float(np.array(angle.at(mi.Point3f(*map(float, mirrored))))[0])


def mesh(vertices: list, faces: list, scene_name: str = "mesh") -> mi.Emitter:
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "area", "radiance": 1.0})
    found = mi.Mesh(scene_name, len(vertices), len(faces), props=props)
    params = mi.traverse(found)
    params["vertex_positions"] = np.float32(vertices).ravel()
    params["faces"] = np.uint32(faces).ravel()
    params.update()
    mesh.kept = found
    return found.emitter()


def test_flat_meshes():
    """A mesh of two triangles is a rectangle if its corners form a parallelogram."""
    angle = SolidAngle.of(mesh(QUAD["vertex_positions"], QUAD["faces"]))
    assert angle.kind == "rectangle"
    above = np.array(angle.at(mi.Point3f(0.5, 1.0, 0.01)))[0]
    below = np.array(angle.at(mi.Point3f(0.5, 1.0, -0.01)))[0]
    assert sorted([above, below]) == pytest.approx([0.0, 2 * np.pi], abs=0.1)
    kite = [[0, 0, 0], [1, 0, 0], [2, 2, 0], [0, 1, 0]]
    assert SolidAngle.of(mesh(kite, QUAD["faces"])) is None
    assert SolidAngle.of(mesh(QUAD["vertex_positions"], QUAD["faces"][:1])) is None


def test_unsupported_emitters():
    """Emitters of other shapes, with textured radiance, or that emit inwards are not supported."""
    texture = {"type": "checkerboard"}
    assert SolidAngle.of(emitter({"type": "rectangle"}, radiance=texture)) is None
    assert SolidAngle.of(emitter({"type": "cylinder"})) is None
    assert SolidAngle.of(emitter({"type": "sphere", "flip_normals": True})) is None
    point = mi.load_dict({"type": "point", "intensity": 1.0, "position": [0, 0, 0]})
    assert SolidAngle.of(point) is None
