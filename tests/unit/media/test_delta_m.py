"""Delta-M scaling of media: similarity relations, phase functions, and refused settings."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.media.phase import LARGEST_PEAK, PEAK, Phase, legendre_moments
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.transport.path import Media

pytestmark = pytest.mark.usefixtures("rgb")


def hg(g: float) -> dict:
    return {"type": "hg", "g": g}


def moments(g: float) -> Phase:
    return Phase(None, g ** np.arange(32), 1.0)


@pytest.mark.parametrize("g", [0.6, 0.75, 0.77, 0.85])
def test_scaled_phase_function_plus_peak_has_the_original_moments(g):
    """A forward delta function plus the scaled phase function has the original moments.

    They agree up to the order of truncation.
    """
    whole, rest = moments(g), moments(g).without_peak()
    assert whole.has_peak and rest.moments[0] == 1
    both = rest.forward + (1 - rest.forward) * rest.moments
    known = rest.order + 1
    np.testing.assert_allclose(both[:known], whole.moments[:known], rtol=1e-12)
    assert rest.forward == pytest.approx(g**known) and rest.forward <= LARGEST_PEAK
    assert rest.forward <= PEAK or rest.order == 6


def test_only_forward_peaks_are_scaled():
    for g in (0.5, -0.8, 0.9, 0.0):
        assert not moments(g).has_peak


TABLES = {
    "step": (lambda c: np.where(c > 0.5, 1, 0.05), False),
    "sideways": (lambda c: np.exp(-8 * c**2) + 0.02, False),
    "rainbow": (lambda c: 0.2 + 3 * np.exp(-(((c + 0.74) / 0.08) ** 2)), False),
    "corona and glory": (lambda c: 0.1 + 8 * np.exp((c - 1) / 0.05) + np.exp(-(1 + c) * 10), True),
}


@pytest.mark.parametrize(("values", "has_peak"), TABLES.values(), ids=TABLES)
def test_other_sharp_phase_functions_have_no_forward_peak(values, has_peak):
    """A moment of any sign beyond the order counted as a peak: images had half their radiance."""
    table = ",".join(f"{v:.5f}" for v in values(np.linspace(-1, 1, 33)))
    plugin = mi.load_dict({"type": "tabphase", "values": table})
    phase = Phase(plugin, *legendre_moments(plugin, 32))
    assert phase.order is None
    assert phase.has_peak == has_peak


def scene_of(scenes, settings: dict, **objects) -> mi.Scene:
    medium = scenes.medium(1.0, 0.9) | {"phase": hg(0.8)}
    return scenes.load(
        {"type": "irrcache", "solver": "path"} | settings, scenes.boundary(medium), 8, **objects
    )


def grid(values) -> dict:
    data = mi.VolumeGrid(np.float32(values))
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale([2, 2, 2])
    return {"type": "gridvolume", "grid": data, "raw": True, "to_world": place}


RNG = np.random.default_rng(1)
FIELDS = {
    "constants": (1.5, 0.9),
    "colours": (1.5, (0.9, 0.5, 0.7)),
    "grid of extinction": (RNG.uniform(0, 3, (4, 5, 6, 1)), 0.8),
    "grid of extinction, coloured albedo": (RNG.uniform(0, 3, (4, 5, 6, 1)), (0.9, 0.5, 0.7)),
    "two grids": (RNG.uniform(0, 3, (4, 5, 6, 1)), RNG.uniform(0, 1, (4, 5, 6, 3))),
}


@pytest.mark.parametrize(("sigma_t", "albedo"), FIELDS.values(), ids=FIELDS)
def test_absorption_is_preserved(scenes, sigma_t, albedo):
    """Scaling preserves the absorption at voxel centres, and reduces sigma_s by the peak."""
    medium = {"type": "heterogeneous" if np.ndim(sigma_t) > 1 else "homogeneous", "phase": hg(0.8)}
    for name, value in (("sigma_t", sigma_t), ("albedo", albedo)):
        if np.ndim(value) > 1:
            medium[name] = grid(value)
        else:
            plain = np.ndim(value) == 0
            colour = value if plain else {"type": "rgb", "value": list(value)}
            volume = {"type": "constvolume", "value": colour}
            medium[name] = volume if medium["type"] == "heterogeneous" else colour
    scene = scenes.load({"type": "irrcache", "solver": "path"}, scenes.boundary(medium), 8)
    found = compile_scene(scene).visible[0]
    z, y, x = (np.ravel(i) for i in np.indices((4, 5, 6)))
    centres = np.float32([(x + 0.5) / 3 - 1, (y + 0.5) / 2.5 - 1, (z + 0.5) / 2 - 1])

    def at(field) -> np.ndarray:
        value = mi.Color3f(field.at_world(mi.Point3f(centres)))
        return np.array(value + dr.zeros(mi.Float, centres.shape[1])).T

    def before(value) -> np.ndarray:
        flat = np.reshape(value, (-1, np.shape(value)[-1])) if np.ndim(value) > 1 else value
        return np.broadcast_to(flat, (centres.shape[1], 3))

    extinction, scattered = before(sigma_t), before(sigma_t) * before(albedo)
    share = found.phase.forward
    assert share == pytest.approx(0.8**7, rel=1e-3)
    new = at(found.sigma_t) * at(found.albedo)
    np.testing.assert_allclose(new, (1 - share) * scattered, rtol=2e-5, atol=1e-6)
    np.testing.assert_allclose(
        at(found.sigma_t) - new, extinction - scattered, rtol=1e-4, atol=1e-5
    )


ALBEDOS = np.indices((4, 4, 4)).sum(axis=0)[..., None] % 2 * 1.0
COARSE = {
    "grids of the same voxels": RNG.uniform(0.1, 3, (4, 4, 4, 1)),
    "one voxel of extinction": np.ones((1, 1, 1, 1)),
    "constant extinction": 1.5,
}


@pytest.mark.parametrize("sigma_t", COARSE.values(), ids=COARSE)
def test_scattering_is_preserved_between_voxels(scenes, sigma_t):
    """Scaling preserves absorption and scattering also between voxels whose albedo differs.

    The scaled albedo is not linear in the albedo.
    """
    extinction = grid(sigma_t) if np.ndim(sigma_t) else {"type": "constvolume", "value": sigma_t}
    medium = {"type": "heterogeneous", "phase": hg(0.85), "sigma_t": extinction}
    medium["albedo"] = grid(ALBEDOS)
    scene = scenes.load({"type": "irrcache", "solver": "sweep"}, scenes.boundary(medium), 8)
    found = compile_scene(scene).visible[0]
    p = mi.Point3f(np.float32(RNG.uniform(-1, 1, (3, 4096))))

    def scattering_and_absorption(of) -> np.ndarray:
        sigma_t = np.array(mi.Color3f(of.sigma_t.at_world(p)))[0] + np.zeros(4096)
        albedo = np.array(mi.Color3f(of.albedo.at_world(p)))[0]
        return np.array([sigma_t * albedo, sigma_t * (1 - albedo)])

    new, old = scattering_and_absorption(found), scattering_and_absorption(found.original)
    old[0] *= 1 - found.phase.forward
    assert (np.abs(new - old).mean(axis=1) < 0.004 * old.mean(axis=1)).all()


REFUSED = {
    "path": ({"solver": "path"}, r"sharply.*0\.80.*path.*auto.*volpath"),
    "an order": ({"solver": "auto", "max_depth": 3}, r"sharply.*0\.80.*max_depth 3.*-1.*volpath"),
}


@pytest.mark.parametrize(("settings", "message"), REFUSED.values(), ids=REFUSED)
def test_settings_are_refused(scenes, settings, message):
    """Settings are refused for which paths would scale the peak, or that separate scattering
    orders.
    """
    scene = scene_of(scenes, settings)
    with pytest.raises(UnsupportedSceneError, match=message):
        scene.integrator().prepare(scene)


def prepared(scenes, ball: dict) -> mi.Scene:
    scene = scene_of(scenes, {"solver": "auto", "resolution": 6, "cache_spp": 64}, ball=ball)
    scene.integrator().prepare(scene)
    return scene


def test_forward_scattering_media_with_surfaces_are_refused(scenes):
    """Forward scattering media with surfaces are refused if paths would scale the peak.

    Media without surfaces in them are accepted.
    """
    ball = {"type": "sphere", "radius": 0.3}
    with pytest.raises(UnsupportedSceneError, match=r'sharply.*0\.80.*"ball".*reaches.*volpath'):
        prepared(scenes, ball)
    aside = prepared(scenes, ball | {"center": [0, 2, 0]})
    assert aside.integrator().cache.samples == 128


def test_other_media_are_not_scaled(scenes):
    """Paths through several media scale one of them; the others are unscaled."""
    place = scenes.placement((1, 1, 1), center=(3, 0, 0))
    other = scenes.boundary(scenes.medium(2.0, 0.5) | {"phase": hg(0.7)}, place)
    sharp, medium = compile_scene(scene_of(scenes, {}, other=other)).visible
    around = Media.around(medium).grids
    assert around == (sharp.original, medium)
    assert around[0].sigma_t.maximum == pytest.approx(2.0)
    left = 2.0 * (1 - sharp.phase.forward * 0.5)
    assert sharp.sigma_t.maximum == pytest.approx(left, rel=1e-5)
