"""Narrow emitters seen through a delta-M scaled medium: Beer's law."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.scene.compile import compile_scene

pytestmark = pytest.mark.usefixtures("rgb")

PHASE = {"type": "hg", "g": 0.8}
DENSITY = np.random.default_rng(3).uniform(0.2, 1.5, (4, 5, 6)).astype(np.float32)


def sky() -> dict:
    """Return a dark sky with one spot ahead of a camera that looks along z, and one behind it."""
    pixels = np.full((32, 64, 3), 0.05, np.float32)
    pixels[15:17, [31, 32, 63, 0]] = 60.0
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels)}


@pytest.mark.parametrize("density", [1.2, DENSITY], ids=["constant", "grid"])
@pytest.mark.parametrize("albedo", [1.0, 0.6])
def test_exponent_recovers_the_original_transmittance(scenes, density, albedo):
    """The exponent converts the transmittance of the scaled medium to that of the original one.

    This is exact for a constant albedo.
    """
    place = scenes.placement((2.0, 1.0, 1.5))
    medium = scenes.medium(density, albedo, place) | {"phase": PHASE}
    scene = scenes.load({"type": "irrcache", "solver": "auto"}, scenes.boundary(medium, place), 8)
    found = compile_scene(scene).visible[0]
    x = mi.Float(np.linspace(-0.99, 0.99, 2001))
    line = mi.Point3f(x, 0.2, -0.3)
    less, whole = (
        1.98 * np.array(dr.mean(grid.sigma_t.at_world(line) + 0 * x))[0]
        for grid in (found, found.original)
    )
    assert less < 0.95 * whole
    assert np.exp(-less) ** found.unscattered_exponent == pytest.approx(np.exp(-whole), rel=1e-4)


def test_bright_spot_of_the_sky_is_attenuated_by_the_original_extinction(scenes):
    """The spot of a sky seen through a medium is attenuated by e^-tau of the original
    extinction.
    """
    look = mi.ScalarTransform4f().look_at([0, 0, -5], [0, 0, 0], [0, 1, 0])
    film = scenes.description({}, None, 2)["sensor"]["film"]
    sensor = {"type": "perspective", "fov": 0.2, "to_world": look, "film": film}
    objects = {"emitter": sky(), "sun": None, "sensor": sensor}
    settings = {"solver": "auto", "resolution": 6, "cache_spp": 64, "aovs": "background"}
    seen = []
    for extinction in (1e-6, 0.9):
        medium = scenes.medium(extinction, 0.9) | {"phase": PHASE}
        scene = scenes.load(
            {"type": "irrcache", "solver": "path", **settings},
            scenes.boundary(medium),
            2,
            **objects,
        )
        seen.append(scenes.image(scene, spp=4)[..., -3:].mean())
    assert seen[0] > 20
    assert seen[1] / seen[0] == pytest.approx(np.exp(-2 * 0.9), rel=2e-3)


def test_single_scattering_of_narrow_emitters(scenes):
    """Single scattering of the scaled medium is extinction times albedo times Henyey-Greenstein.

    It equals that of the original medium.
    """
    medium = scenes.medium(1.3, 0.7) | {"phase": PHASE}
    scene = scenes.load({"type": "irrcache", "solver": "auto"}, scenes.boundary(medium), 8)
    found = compile_scene(scene).visible[0]
    assert found.phase.forward > 0.1
    cosine = np.linspace(-0.99, 0.99, 50)
    towards = mi.Vector3f(np.float32([np.sqrt(1 - cosine**2), 0 * cosine, cosine]))
    # Radiance from ``towards`` that reaches the camera along a ray was scattered by the angle
    # between.
    gain = np.array(found.phase.gain(mi.Point3f(0), mi.Vector3f(0, 0, 1), towards), np.float64)
    scattered = float(found.sigma_t.value[0] * found.albedo.value[0]) * gain
    g = PHASE["g"]
    expected = 1.3 * 0.7 * (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5
    np.testing.assert_allclose(scattered, expected, rtol=1e-4)
