"""Containment of points in a boundary agrees with the back faces of Mitsuba's shape."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.boundary import boundary_of

pytestmark = pytest.mark.usefixtures("rgb")

PLACES = {
    "cube": {"edges": (1.0, 2.0, 0.5), "turn": 35.0, "center": (0.3, -1.0, 2.0)},
    "sphere": {"edges": (1.4, 1.4, 1.4), "turn": 35.0, "center": (0.3, -1.0, 2.0)},
}


@pytest.mark.parametrize("kind", PLACES)
def test_containment_equals_mitsubas_shape(scenes, kind):
    """Points are inside if rays along three oblique directions leave the shape through back
    faces.

    The points lie within 5 % of the size of the surface and farther away.
    """
    place = scenes.placement(**PLACES[kind])
    scene = scenes.load({"type": "volpath"}, scenes.boundary(scenes.medium(1.0, 0.5), place, kind))
    boundary = boundary_of(scene, scene.shapes()[0])
    rng = np.random.default_rng(6)
    local = rng.uniform(-0.3, 1.3, (3, 4096))
    near = rng.normal(size=(3, 4096))  # on the surface of the unit shape, displaced by up to 5 %
    near /= np.linalg.norm(near, axis=0, ord=np.inf if kind == "cube" else 2)
    near = 0.5 + 0.5 * near * rng.uniform(0.95, 1.05, 4096)
    local = np.concatenate([local, near], axis=1)
    points = mi.Point3f(np.float32(place[:3, :3] @ local + place[:3, 3:]))
    found = np.array(boundary.surrounds(points))
    votes = np.zeros(found.shape, int)
    for way in ((0.48, 0.64, 0.6), (-0.36, 0.48, -0.8), (0.6, -0.8, 0.0)):
        direction = mi.Vector3f(*way)
        hit = scene.ray_intersect(mi.Ray3f(points, direction))
        votes += np.array(hit.is_valid() & (dr.dot(hit.n, direction) > 0))
    known = (votes == 0) | (votes == 3)  # rays through edges may disagree
    assert known.mean() > 0.99 and 0.2 < found.mean() < 0.8
    np.testing.assert_array_equal(found[known], votes[known] == 3)
    # Expected values: distances from the centre in units of the shape's half width.
    order = np.inf if kind == "cube" else 2
    distance = np.linalg.norm(2 * local - 1, axis=0, ord=order)
    clear = np.abs(distance - 1) > 1e-4
    np.testing.assert_array_equal(found[clear], distance[clear] < 1)
    world = np.array(points).T[:64]
    inside = [boundary.contains(np.float64(p)) for p in world]
    np.testing.assert_array_equal(inside, found[:64])
