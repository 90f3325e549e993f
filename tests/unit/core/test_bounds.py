"""Bounding boxes of scenes whose meshes Mitsuba has merged."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.bounds import bounds_of_shapes, correct_mesh_bounds, lost_extent

pytestmark = pytest.mark.usefixtures("rgb")


def cube(x: float) -> dict:
    place = mi.ScalarTransform4f().translate([x, 0, 0])
    return {"type": "cube", "to_world": place, "bsdf": {"type": "diffuse"}}


@pytest.mark.parametrize("places", [(0, 9), (9, 0), (-5, 0, 9), (9,)])
def test_bounds_contain_every_merged_mesh(places):
    scene = mi.load_dict({"type": "scene"} | {f"cube{n}": cube(x) for n, x in enumerate(places)})
    assert len(scene.shapes()) == 1  # otherwise Mitsuba has merged nothing, and nothing is tested
    correct_mesh_bounds(scene)
    expected = [[min(places) - 1, -1, -1], [max(places) + 1, 1, 1]]
    np.testing.assert_allclose(bounds_of_shapes(scene), expected, atol=1e-5)
    box = scene.shapes()[0].bbox()
    np.testing.assert_allclose([np.array(box.min), np.array(box.max)], expected, atol=1e-5)
    known = np.array([scene.bbox().min, scene.bbox().max])
    assert lost_extent(scene) == pytest.approx(np.abs(known - expected).max())


def test_bounds_of_unmerged_shapes_are_not_lost():
    sphere = {"type": "sphere", "radius": 3}
    scene = mi.load_dict({"type": "scene", "a": cube(0), "b": sphere})
    correct_mesh_bounds(scene)
    assert lost_extent(scene) == 0
    assert lost_extent(mi.load_dict({"type": "scene"})) == 0
