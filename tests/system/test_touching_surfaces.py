"""Surfaces that lie in faces of the box that bounds a medium.

Rays that Mitsuba offsets from a face skip such a surface: images were wrong by up to 7 % of their
mean, and by 250 % in blocks. With a gap there is no such error.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.surfaces import blocks, bound, diffuse, fog, lamp, placed

pytestmark = pytest.mark.usefixtures("rgb")

#: Distance of the surfaces in the scene to compare with.
GAP = 4e-3


def floor(height: float) -> dict:
    place = placed((0, height, 0), (3, 3, 1), (0, height + 1, 0.001))
    return {"type": "rectangle", "to_world": place, "bsdf": diffuse(0.6, 0.5, 0.4)}


def on_a_floor(gap: float) -> dict:
    return {"smoke": bound(interior=fog()), "floor": floor(-1 - gap)}


def fills_a_room(gap: float) -> dict:
    """Return fog that touches a floor, walls, and a lamp in the ceiling."""
    sides = {
        f"wall{i}": {
            "type": "rectangle",
            "to_world": placed(np.array(p) * (1 + gap), (1 + gap, 1 + gap, 1), (0, 0, 0)),
            "bsdf": diffuse(0.5, 0.6, 0.7),
        }
        for i, p in enumerate([(0, -1, 0.0), (1, 0, 0), (-1, 0, 0), (0, 0, 1)])
    }
    smoke = bound(interior=fog((0.5, 0.5, 0.5)))
    return {"smoke": smoke, "lamp": lamp((0, 1 + gap, 0), (0, 0, 0), 0.4)} | sides


@pytest.mark.parametrize(
    ("solver", "objects"),
    [
        ("sweep", on_a_floor),
        ("sweep", fills_a_room),
        ("path", on_a_floor),
        pytest.param("path", fills_a_room, marks=pytest.mark.slow),
    ],
)
def test_the_image_is_that_with_a_gap(scenes, objects, solver):
    integrator = {"type": "irrcache", "solver": solver, "resolution": 12, "cache_spp": 64}
    images = [
        scenes.image(scenes.load(integrator, None, 24, **objects(gap)), spp=64, seed=3)
        for gap in (0.0, GAP)
    ]
    touching, apart = map(blocks, images)
    np.testing.assert_allclose(touching, apart, rtol=0.02, atol=0.01 * apart.mean())


def test_a_floor_that_is_moved_to_the_medium(scenes):
    """The image after an edit is that of a new scene."""
    integrator = {"type": "irrcache", "solver": "sweep", "resolution": 12, "cache_spp": 16}
    scene = scenes.load(integrator, None, 24, **on_a_floor(0.5))
    params = mi.traverse(scene)
    first = scenes.image(scene, spp=16)
    params["floor.to_world"] = mi.Transform4f(mi.Matrix4f(np.array(floor(-1.0)["to_world"].matrix)))
    params.update()
    fresh = scenes.image(scenes.load(integrator, None, 24, **on_a_floor(0.0)), spp=16)
    np.testing.assert_allclose(scenes.image(scene, spp=16), fresh, rtol=1e-4, atol=1e-5)
    assert np.abs(first - fresh).max() > 0.05


def test_gradients_of_a_medium_on_a_floor(scenes):
    """The radiance is linear in the emitters: their gradients are those of a scene with a gap."""
    found = []
    for gap in (0.0, GAP):
        integrator = {"type": "irrcache", "solver": "sweep", "resolution": 8, "cache_spp": 32}
        scene = scenes.load(integrator | {"max_depth": 2}, None, 16, **on_a_floor(gap))
        params = mi.traverse(scene)
        keys = ["emitter.radiance.value", "smoke.interior_medium.sigma_t.value.value"]
        params.keep(keys)
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, spp=64, seed=1)))
        found.append([np.array(dr.grad(params[key])).ravel() for key in keys])
    for touching, apart in zip(*found, strict=True):
        np.testing.assert_allclose(touching, apart, rtol=0.03)
        assert np.abs(apart).min() > 0
