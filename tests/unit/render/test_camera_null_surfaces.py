"""Media that a camera sees in several parts: with null surfaces, and behind one another."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

#: Without scattering only the extinction matters.
SETTINGS = {"type": "irrcache", "solver": "auto", "max_depth": 1}


def ahead(scenes) -> dict:
    """Return an orthographic sensor at z = -5 that looks along +z at a small square."""
    look = mi.ScalarTransform4f().look_at([0.02, 0.03, -5], [0.02, 0.03, 0], [0, 1, 0])
    film = scenes.description({}, None, 2)["sensor"]["film"]
    return {"type": "orthographic", "to_world": look.scale(0.02), "film": film}


@pytest.mark.parametrize("varies", [False, True])
def test_null_surfaces_within_a_medium_change_nothing(scenes, varies):
    """Null surfaces in a medium do not change the image, which is e^-tau of the sky.

    They are a sphere and a rectangle; the scene also has an opaque surface outside of the image.
    """
    density = 0.6 * np.ones((4, 4, 4), np.float32) if varies else 0.6
    place = scenes.placement()
    shape = scenes.boundary(scenes.medium(density, 0.5, place), place)
    sheet = mi.ScalarTransform4f().translate([0, 0, 0.7]).scale(0.5)
    objects = {
        "beside": {"type": "sphere", "center": [4, 0, 0], "radius": 0.5},
        "ball": {"type": "sphere", "radius": 0.4, "bsdf": {"type": "null"}},
        "sheet": {"type": "rectangle", "to_world": sheet, "bsdf": {"type": "null"}},
        "emitter": {"type": "constant", "radiance": 2.0},
        "sun": None,
        "sensor": ahead(scenes),
    }
    found = scenes.image(scenes.load(SETTINGS, shape, 2, **objects, default_solver="path"), spp=16)
    np.testing.assert_allclose(found, 2 * np.exp(-1.2), rtol=1e-3)


def test_depth_of_a_medium_behind_another(scenes):
    """The depth of two slabs is int (-dT/dt) t dt over the total opacity.

    The optical depths are 0.7 and 1.1 at the distances 4 and 6.
    """
    slabs = []
    for z, depth in ((-1.0, 0.7), (1.0, 1.1)):
        place = scenes.placement((2.0, 2.0, 0.01), center=(0, 0, z))
        slabs.append(scenes.boundary(scenes.medium(depth / 0.01, 0.5), place))
    objects = {"behind": slabs[1], "emitter": None, "sun": None, "sensor": ahead(scenes)}
    objects["emitter"] = {"type": "constant", "radiance": 2.0}
    scene = scenes.load(SETTINGS | {"aovs": "depth"}, slabs[0], 2, **objects, default_solver="path")
    found = scenes.image(scene, spp=4)[..., -1]
    first, second = 1 - np.exp(-0.7), np.exp(-0.7) * (1 - np.exp(-1.1))
    expected = (4 * first + 6 * second) / (first + second)
    np.testing.assert_allclose(found, expected, atol=0.01)
