"""Media whose boundary refracts: caches inside of glass, and camera paths that end in them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import UnsupportedSceneError
from tests.support.surfaces import ball, bound, check, fog, images, lamp, placed

pytestmark = pytest.mark.usefixtures("rgb")

GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
ROUGH = {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.5, "ext_ior": 1.0}
WHITE = {"emitter": {"type": "constant", "radiance": 1.0}, "sun": None}


def milk(depth: float = 4.0, albedo: float = 1.0, **more) -> dict:
    return fog((0.5 * depth,) * 3, (albedo,) * 3) | more


def cube(interior: dict, **more) -> dict:
    return {"type": "cube", "to_world": placed(scale=(0.8, 0.8, 0.8)), "interior": interior} | more


def globe() -> dict:
    """Return a hollow ball of glass with a medium in it."""
    hollow = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}
    return {
        "outer": ball(radius=1.0, bsdf=GLASS),
        "inner": ball(radius=0.9, bsdf=hollow, interior=milk()),
    }


def coloured() -> dict:
    return {"a": ball(radius=1.0, bsdf=GLASS, interior=fog((1, 2, 4), (1, 1, 1)))}


def rendered(scenes, objects: dict, settings: dict, **options) -> tuple[mi.Scene, np.ndarray]:
    integrator = {"type": "irrcache", "rr_depth": 1000} | settings
    scene = scenes.load(integrator, None, 16, default_solver="auto", **objects)
    return scene, scenes.image(scene, **options)


FURNACES = {
    "sphere": (lambda: {"a": ball(radius=1.0, bsdf=GLASS, interior=milk())}, "sweep", 2.25),
    "coloured extinction": (coloured, "sweep", 2.25),
    "cube": (lambda: {"a": cube(milk(), bsdf=GLASS)}, "sweep", 2.25),
    "hollow globe": (globe, "sweep", 1.0),
    "anisotropic": (
        lambda: {"a": cube(milk(phase={"type": "hg", "g": 0.4}), bsdf=GLASS)}, "sweep", 2.25,
    ),
    "path": (lambda: {"a": ball(radius=1.0, bsdf=GLASS, interior=milk())}, "path", 2.25),
}  # fmt: skip


@pytest.mark.parametrize(("build", "solver", "inside"), FURNACES.values(), ids=FURNACES)
def test_white_furnace(scenes, build, solver, inside):
    """Without absorption, in uniform radiance 1, the radiance is 1 everywhere, and n^2 in glass of
    the refractive index n; without noise by `sweep` if all channels have the same extinction.
    """
    settings = {"solver": solver, "resolution": 12}
    scene, image = rendered(scenes, build() | WHITE, settings, spp=8)
    tolerance = 0.005 if solver == "path" else 0.001
    if build is coloured:  # paths choose collisions of one channel at random
        tolerance = 0.015
    np.testing.assert_allclose(image, 1, atol=3 * tolerance)
    assert abs(image.mean() - 1) < tolerance
    values = np.array(scene.integrator().cache.irradiance)
    assert abs(values[values > 0].mean() / (4 * np.pi * inside) - 1) < 2 * tolerance


def smooth() -> dict:
    return {"a": ball(radius=1.0, bsdf=GLASS, interior=milk(8, 0.98))}


def several() -> dict:
    """Return three media in glass of three kinds under a lamp."""
    thin = {"type": "thindielectric"}
    return {
        "a": ball((-0.5, 0.5, 0), 0.45, bsdf=ROUGH, interior=milk(12, 0.95)),
        "b": ball((0.5, 0.5, 0), 0.45, bsdf=thin, interior=milk(8, 0.9)),
        "c": ball((0, -0.5, 0), 0.45, bsdf=GLASS, interior=milk(8, 0.9)),
        "lamp": lamp((0.5, 2.2, -1.5), (0, 0, 0)),
    }


@pytest.mark.parametrize("build", [smooth, several])
def test_scenes(scenes, build):
    depth = {"max_depth": -1, "rr_depth": 50}
    settings = {"solver": "auto", "resolution": 24}
    check(*images(scenes, build() | {"sun": None}, settings, depth, (16, 512)))


def test_a_lamp_reflected_by_glass_before_a_medium_with_a_forward_peak(scenes):
    """The reflected path waits until the transmitted one has crossed the medium, which attenuated
    the lamp of the reflection: the pane was 40 % too dark.
    """
    plate = milk(0.04, 0.5)
    pane = {"type": "cube", "to_world": placed((0, 0, -0.8), (1.2, 1.2, 0.2)), "bsdf": GLASS}
    cloud = milk(2.0, 0.9, phase={"type": "hg", "g": 0.85})
    objects = {
        "pane": pane | {"interior": plate},
        "cloud": bound(interior=cloud, center=(0, 0, 1.0), scale=(1.5, 1.5, 0.8)),
        "lamp": lamp((-0.4, -0.6, -4.0), (0.2, 0.3, -1.0), 0.7),
        "sun": None,
    }
    settings = {"solver": "auto", "resolution": 12}
    check(*images(scenes, objects, settings, {"max_depth": -1, "rr_depth": 50}, (64, 512)))


@pytest.mark.parametrize("bsdf", [GLASS, ROUGH])
def test_the_image_is_free_of_noise(scenes, bsdf):
    """Media behind glass are ray marched, and what glass reflects is followed apart."""
    objects = {"a": ball(radius=1.0, bsdf=bsdf, interior=milk(20, 0.9))} | WHITE
    settings = {"resolution": 12}
    scene, image = rendered(scenes, objects, settings, spp=16)
    other = scenes.image(scene, spp=16, seed=7)
    centre = np.s_[6:10, 6:10]
    assert image[centre].mean() < 0.9
    np.testing.assert_allclose(image[centre], other[centre], rtol=0.005)


def test_what_is_rendered_by_volpath_instead(scenes):
    """No cache holds single orders or sharp scattering behind glass; emission is refused then."""
    sharp = ball(radius=1.0, bsdf=GLASS, interior=milk(phase={"type": "hg", "g": 0.9}))
    broad = ball(radius=1.0, bsdf=GLASS, interior=milk())
    for shape, depth in ((sharp, -1), (broad, 3)):
        scene, _ = rendered(scenes, {"a": shape} | WHITE, {"max_depth": depth}, spp=1)
        assert not scene.integrator().caches
    settings = {"type": "irrcache", "max_depth": 3, "emission": 1.0}
    scene = scenes.load(settings, None, default_solver="auto", a=broad)
    with pytest.raises(UnsupportedSceneError, match=r"max_depth 3.*emission"):
        scene.integrator().prepare(scene)
