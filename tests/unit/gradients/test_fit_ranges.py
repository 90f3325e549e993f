"""Bounds and scales of fitted parameters follow from what the parameters are."""

from __future__ import annotations

from math import inf, nan

import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.gradients.cases import POINT, SKY, SUN, Case
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.fit_ranges import (
    BACKWARDS,
    BLACKEST,
    FORWARDS,
    MEAN_COSINE_SCALE,
    SHARPEST,
    Range,
    Ranges,
    check_parameter,
)
from mitsuba_irrcache.gradients.fit_state import comparable_colours, in_colours


def surfaces() -> dict:
    """A floor whose texture has an id, and a sphere with a texture of two colours."""
    bitmap = mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "id": "paint"}
    floor = {"type": "twosided", "side": {"type": "diffuse", "reflectance": texture}}
    ball = {"type": "plastic", "diffuse_reflectance": {"type": "checkerboard"}}
    return {
        "floor": {"type": "rectangle", "bsdf": floor},
        "ball": {"type": "sphere", "bsdf": ball},
    }


CASE = Case(
    data=4,
    cache=4,
    depth=0.5,
    g=0.3,
    emissive=True,
    emitters=lambda: {"sky": SKY, "sun": SUN, "point": {**POINT, "position": [0, -41, 0]}},
    objects=surfaces,
)


@pytest.fixture
def scene(rgb):
    return CASE.load()


def key_ending(params: mi.SceneParameters, end: str) -> str:
    (key,) = [key for key in params.keys() if key.endswith(end)]
    return key


def found(scene: mi.Scene, end: str, has_cache: bool = True, scale: float = 0.0) -> Range:
    params = mi.traverse(scene)
    key = key_ending(params, end)
    check_parameter(params, key, has_cache)
    return Ranges(scene, params, has_cache, scale).of(key, np.array(params[key]))


@pytest.mark.parametrize("has_cache", [True, False])
def test_bounds(scene, has_cache):
    blackest = BLACKEST if has_cache else 0
    cosines = (BACKWARDS, FORWARDS) if has_cache else (-SHARPEST, SHARPEST)
    expected = {
        "sigma_t.data": (0, inf),
        "albedo.data": (0, 1),
        "sky.radiance.value": (0, inf),
        "brdf_0.reflectance.data": (blackest, 1),
        "color0.value": (0, 1),
        "phase_function.g": cosines,
    }
    if has_cache:
        expected |= {"point.position": (-inf, inf), "emission.data": (0, inf)}
    ranges = {end: found(scene, end, has_cache) for end in expected}
    assert {end: (own.lower, own.upper) for end, own in ranges.items()} == expected


def test_bounds_do_not_depend_on_ids(rgb):
    """An id takes the place of the name in a key."""
    medium = {"type": "homogeneous", "sigma_t": 0.9, "albedo": {"type": "constvolume", "id": "a"}}
    sky = {"type": "constant", "radiance": 1.0, "id": "albedo"}
    cube = {"type": "cube", "interior": medium}
    scene = mi.load_dict({"type": "scene", "cube": cube, "sky": sky})
    assert found(scene, "cube.interior_medium.albedo.value.value").upper == 1
    assert found(scene, "radiance.value").upper == inf


def test_irrcache_renders_at_the_bounds_of_g(mono):
    """With the margin of the differences by g."""
    for g in (BACKWARDS - 0.006, FORWARDS + 0.006):
        scene = Case(data=4, cache=4, depth=0.5, g=g).load(cache_spp=16)
        assert np.isfinite(np.array(mi.render(scene, spp=1))).all()


def test_the_nearest_values_in_a_range():
    own = Range(-0.5, 1.0, 1.0, smallest=0.25)
    values = np.array([-9, -0.3, -0.1, 0, 0.1, 0.5, 9], np.float32)
    assert (
        own.nearest(values).tolist() == np.float32([-0.5, -0.3, -0.25, 0.25, 0.25, 0.5, 1]).tolist()
    )
    assert own.nearest(values).dtype == np.float32


def test_scales(scene):
    assert found(scene, "albedo.data", scale=7.0).scale == 1
    assert found(scene, "phase_function.g", scale=7.0).scale == MEAN_COSINE_SCALE
    assert found(scene, "sigma_t.data", scale=7.0).scale == 7
    assert found(scene, "irradiance.value").scale == 3
    # Half the distance from the box of the scene; and in it.
    assert found(scene, "point.position", scale=7.0).scale == pytest.approx(20, abs=1e-4)
    params = mi.traverse(scene)
    inside = Ranges(scene, params, True, 0.0).of("point.position", np.zeros((3, 1), np.float32))
    assert inside.scale == pytest.approx(0.05 * 12**0.5)


@pytest.mark.parametrize(
    ("end", "message"),
    [
        ("sun.to_world", "it is a transform"),
        ("interior_medium.scale", "it is of type float"),
        ("faces", "it is of type UInt"),
        ("vertex_positions", '"vertex_positions" belongs to the geometry of the Cube'),
        ("sensor.x_fov", '"x_fov" belongs to the geometry of the PerspectiveCamera'),
    ],
)
def test_other_parameters_are_refused_by_name(scene, end, message):
    with pytest.raises(IrrcacheError, match=rf'"[\w.]*{end}" cannot be fitted: {message}'):
        found(scene, end)


def test_positions_are_refused_where_mitsuba_has_no_gradient(scene):
    with pytest.raises(IrrcacheError, match=r'"point.position".* use the integrator irrcache'):
        found(scene, "point.position", has_cache=False)


def test_a_start_outside_of_the_bounds_is_refused(rgb):
    scene = Case(data=4, cache=4, g=0.9).load()
    with pytest.raises(IrrcacheError, match=r'phase_function.g" starts at values from 0.9 .*0.844'):
        found(scene, "phase_function.g")


@pytest.mark.parametrize(
    ("film", "image", "expected"),
    [(1, 1, 1), (4, 4, 4), (3, 4, 3), (1, 3, 1), (2, 4, 1), (4, 2, 1), (5, 5, 5), (3, 5, 0)],
)
def test_comparable_colours(film, image, expected):
    assert comparable_colours(film, image) == expected


def test_the_luminance_of_an_image(rgb):
    image = mi.TensorXf(np.array([[[0.5, 0.25, 2.0, nan]]], np.float32))
    grey = np.array(in_colours(image, 1))
    assert grey.shape == (1, 1, 1)
    assert grey.item() == pytest.approx(float(mi.luminance(mi.Color3f(0.5, 0.25, 2.0))[0]), 1e-5)
    assert np.array(in_colours(image, 3)).tolist() == [[[0.5, 0.25, 2.0]]]
