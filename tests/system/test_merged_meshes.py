"""Scenes in which Mitsuba has merged meshes on loading, and lost the bounds of one of them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tests.support.surfaces import bound, colour, diffuse, fog, placed

pytestmark = pytest.mark.usefixtures("rgb")


def cube(center, scale, bsdf) -> dict:
    return {"type": "cube", "to_world": placed(center, (scale,) * 3), "bsdf": bsdf}


def floor_and_cube() -> dict:
    """Return a large floor that hides half of the sky, and a cube with the same BSDF."""
    bsdf = diffuse(0.2, 0.2, 0.2)
    place = placed((0, -1.2, 0), (60, 60, 1), (0, -0.2, 0.001))
    floor = {"type": "rectangle", "to_world": place, "bsdf": bsdf}
    return {"smoke": bound(interior=fog()), "floor": floor, "cube": cube((1.4, -1, 0), 0.2, bsdf)}


def floor_through_smoke() -> dict:
    """Return a floor that cuts smoke, and a cube beside it with the same BSDF."""
    bsdf = diffuse(0.1, 0.1, 0.1)
    place = placed((0, -0.5, 0), (3, 3, 1), (0, 0.5, 0.001))
    floor = {"type": "rectangle", "to_world": place, "bsdf": bsdf}
    beside = cube((2, -0.2, -1), 0.3, bsdf)
    return {"smoke": bound(interior=fog((2, 2, 2))), "floor": floor, "cube": beside}


@pytest.mark.parametrize(
    ("objects", "solver"),
    [
        (floor_and_cube, "sweep"),
        pytest.param(floor_and_cube, "path", marks=pytest.mark.slow),
        (floor_through_smoke, "path"),
        (floor_through_smoke, "sweep"),
    ],
)
def test_the_image_is_that_of_separate_meshes(scenes, monkeypatch, objects, solver):
    """Shadow rays ended at bounds that were too small, so that floors did not hide the sky, and
    floors among voxels were not found.
    """
    integrator = {"type": "irrcache", "solver": solver, "resolution": 12, "cache_spp": 32}
    emitter = {"type": "constant", "radiance": colour(1, 1, 1)}
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    images, warned = [], []
    load_dict = mi.load_dict
    for optimize in (True, False):
        monkeypatch.setattr(
            mi, "load_dict", lambda d, optimize=optimize: load_dict(d, optimize=optimize)
        )
        messages.clear()
        scene = scenes.load(integrator | {"max_depth": -1}, None, 24, emitter=emitter, **objects())
        images.append(scenes.image(scene, spp=64).reshape(4, 6, 4, 6, 3).mean(axis=(1, 3)))
        warned.append(any("has merged meshes" in text for text in messages))
    merged, separate = images
    np.testing.assert_allclose(merged, separate, atol=0.02 * separate.mean())
    assert warned == [True, False]
