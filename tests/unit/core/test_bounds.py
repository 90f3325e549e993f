"""Bounding boxes of scenes whose meshes Mitsuba has merged."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.bounds import bounds_of_shapes, correct_mesh_bounds, lost_extent

pytestmark = pytest.mark.usefixtures("rgb")


def shape(kind: str, x: float) -> dict:
    place = mi.ScalarTransform4f().translate([x, 0, 0])
    return {"type": kind, "to_world": place, "bsdf": {"type": "diffuse"}}


@pytest.mark.parametrize(
    ("kinds", "places", "lost"),
    [
        (["cube", "cube"], (0, 9), 0),
        (["rectangle", "cube"], (-9, 0), 9),
        (["cube", "rectangle"], (0, 9), 9),
        (["cube", "rectangle", "cube"], (0, 9, 4), 5),
        (["rectangle", "rectangle"], (0, 9), np.inf),
        (["rectangle"], (9,), 0),
    ],
)
def test_bounds_contain_every_merged_mesh(kinds, places, lost):
    shapes = {f"shape{n}": shape(*own) for n, own in enumerate(zip(kinds, places, strict=True))}
    scene = mi.load_dict({"type": "scene"} | shapes)
    assert len(scene.shapes()) == 1  # otherwise Mitsuba has merged nothing, and nothing is tested
    correct_mesh_bounds(scene)
    depth = max(kind == "cube" for kind in kinds)
    expected = [[min(places) - 1, -1, -depth], [max(places) + 1, 1, depth]]
    np.testing.assert_allclose(bounds_of_shapes(scene), expected, atol=1e-5)
    box = scene.shapes()[0].bbox()
    np.testing.assert_allclose([np.array(box.min), np.array(box.max)], expected, atol=1e-5)
    assert lost_extent(scene) == pytest.approx(lost)


def test_bounds_of_unmerged_shapes_are_not_lost():
    sphere = {"type": "sphere", "radius": 3}
    scene = mi.load_dict({"type": "scene", "a": shape("cube", 0), "b": sphere})
    correct_mesh_bounds(scene)
    assert lost_extent(scene) == 0
    assert lost_extent(mi.load_dict({"type": "scene"})) == 0
