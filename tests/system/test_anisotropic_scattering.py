"""Anisotropically scattering media against ``volpath`` and closed forms."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import CacheFileError
from mitsuba_irrcache.solvers.discrete_ordinates import incident, solver
from tests.support.slow import with_slow
from tests.support.surfaces import bound, check, diffuse, fog, ground, images, lamp

pytestmark = pytest.mark.usefixtures("rgb")

POINT = {"type": "point", "position": [1.5, 2.0, -1.0], "intensity": 20.0}
RAYLEIGH = {"type": "rayleigh"}


def hg(g: float) -> dict:
    return {"type": "hg", "g": g}


def envmap(sun: float) -> dict:
    """Return an environment that is brighter above, with a bright texel."""
    texels = np.float32(np.ones((32, 64, 3)) * [0.5, 0.6, 0.8])
    texels[:16] *= 3
    texels[10, 52] = sun
    return {"emitter": {"type": "envmap", "bitmap": mi.Bitmap(texels)}, "sun": None}


SCENES = {
    "hg 0.3, single": (hg(0.3), 2, {}, {}),
    "hg 0.5": (hg(0.5), -1, {}, {}),
    "hg -0.3, two orders": (hg(-0.3), 3, {}, {}),
    "rayleigh": (RAYLEIGH, -1, {}, {}),
    "rayleigh, point": (RAYLEIGH, 3, {"emitter": POINT, "sun": None}, {"tolerance": 0.04}),
    "hg 0.5, sun of an envmap": (hg(0.5), -1, "envmap", {"tolerance": 0.03}),
    "hg 0.75": (hg(0.75), -1, {}, {}),
    "hg 0.85, sun of an envmap": (hg(0.85), -1, "envmap", {"tolerance": 0.03}),
}
BY_PATH = "hg 0.3, single", "hg 0.5, sun of an envmap"
CASES = [("sweep", name) for name in SCENES] + [("path", name) for name in BY_PATH]
#: Between cases with the same sky, or the same map, and smaller and larger g.
SLOW = [("sweep", name) for name in ("hg 0.5", "hg 0.75", "hg 0.5, sun of an envmap")]


@pytest.mark.parametrize(("solver", "name"), with_slow(CASES, *SLOW))
def test_phase_functions(scenes, solver, name):
    phase, depth, lights, bounds = SCENES[name]
    lights = envmap(800.0) if lights == "envmap" else lights
    medium = scenes.medium((1.0, 1.2, 1.4), (0.9, 0.8, 0.95)) | {"phase": phase}
    objects = {"cloud": scenes.boundary(medium)} | lights
    depths, ours = {"max_depth": depth, "rr_depth": 1000}, {"cache_spp": 128, "solver": solver}
    check(*images(scenes, objects, ours, depths, (64, 512)), **bounds)


def half_sky() -> dict:
    """Return an environment that is black below."""
    texels = np.zeros((32, 64, 3), np.float32)
    texels[:16] = 1
    return {"type": "envmap", "bitmap": mi.Bitmap(texels)}


def ratio_to_isotropic(
    scenes, g: float, to: list, surroundings: dict, integrator: dict, spp: int = 256
) -> float:
    """Return the ratio of radiance that a thin medium scatters with ``g`` to that with 0; rays go
    in the direction ``to``, with black behind the medium.
    """
    found = []
    for phase in ({"type": "isotropic"}, hg(g)):
        scene = thin_medium(scenes, phase, to, surroundings, integrator)
        found.append(np.array(mi.render(scene, spp=spp), dtype=np.float64).mean())
    return found[1] / found[0]


def thin_medium(
    scenes, phase: dict, to: list, surroundings: dict, integrator: dict, **properties
) -> mi.Scene:
    """Return a cube of optical depth 0.02 that parallel rays cross in the direction ``to``."""
    origin = -3 * np.array(to) / np.linalg.norm(to)
    camera = {
        "type": "orthographic",
        "to_world": mi.ScalarTransform4f().look_at(origin.tolist(), [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
    }
    medium = scenes.medium(0.01, 0.8) | {"phase": phase} | properties
    boundary = scenes.boundary(medium, scenes.placement((2, 2, 2)))
    scene = {"type": "scene", "cloud": boundary, "sensor": camera} | surroundings
    integrator = {"type": "irrcache", "resolution": 4} | integrator
    return mi.load_dict(scene | {"integrator": integrator})


def ratio_below_half_a_sky(g: float, to: list) -> float:
    """Return the integral of phase function and half a sky over that of isotropic scattering."""
    nodes, weights = np.polynomial.legendre.leggauss(256)
    z, angle = 0.5 * (nodes + 1), (np.arange(1024) + 0.5) * 2 * np.pi / 1024
    cosine = np.array(to) / np.linalg.norm(to)
    across = np.sqrt(1 - z**2)[:, None] * np.cos(angle) * np.hypot(cosine[0], cosine[2])
    cosines = z[:, None] * cosine[1] + across
    phase = (1 - g**2) / (1 + g**2 - 2 * g * cosines) ** 1.5
    return float(0.5 * (weights[:, None] * phase).sum() / 1024)


@pytest.mark.parametrize("solver", ["sweep", "path"])
@pytest.mark.parametrize("g", [0.3, 0.5])
def test_light_of_half_a_sky_that_is_scattered_backwards(scenes, solver, g):
    """A thin medium scatters the integral of phase function and sky into every ray; the ratio to
    isotropic scattering does not depend on its shape. The camera looks down on it, with black
    behind: with too few moments or directions the ratio had errors of 6 to 16 %.
    """
    to, integrator = [0, -3, -2], {"max_depth": 2, "solver": solver}
    found = ratio_to_isotropic(scenes, g, to, {"sky": half_sky()}, integrator)
    assert found == pytest.approx(ratio_below_half_a_sky(g, to), rel=0.02)


#: Each background, mean cosine and height is in one of these. Those above ground have the largest
#: errors if forward peaks scatter nothing of the environment in front of surfaces.
QUICK_PEAKS = (
    ("map", 0.6, -0.15),
    ("ground", 0.7, -0.15),
    ("ground", 0.85, -0.3),
    ("ceiling", 0.85, -0.15),
)
PEAKS = list(itertools.product(("map", "ground", "ceiling"), (0.6, 0.7, 0.85), (-0.15, -0.3)))


@pytest.mark.parametrize(
    ("behind", "g", "height"), with_slow(PEAKS, *(p for p in PEAKS if p not in QUICK_PEAKS))
)
def test_a_forward_peak_scatters_light_from_above_the_horizon(scenes, g, height, behind):
    """The same ratio slightly below the horizon, where most of the light comes from above it. The
    peak counted as unscattered and let black through: errors of up to 70 %. Behind the medium is
    the environment, ground in front of a surrounding sky, or ground below a ceiling that emits.
    """
    surroundings, spp = {"sky": half_sky()}, 256
    if behind == "ground":
        surroundings = {"sky": {"type": "constant", "radiance": 1.0}, "ground": black_ground()}
    elif behind == "ceiling":
        # Each camera ray follows a path to one surface only.
        surroundings, spp = {"ceiling": bright_ceiling(), "ground": black_ground()}, 1 << 14
    to = [0, height, -1]
    found = ratio_to_isotropic(scenes, g, to, surroundings, {"cache_spp": 2048}, spp)
    assert found == pytest.approx(ratio_below_half_a_sky(g, to), rel=0.04)


# A peak of 0.7 is treated in the same way; `test_a_wide_emitter_behind_a_forward_peak` has it.
@pytest.mark.parametrize("g", with_slow([0.7, 0.85], 0.7))
def test_a_forward_peak_scatters_radiance_of_another_surface(scenes, g):
    """The ratio to isotropic scattering above ground that is black where x > 0 and white elsewhere,
    in a uniform environment, on rays that end on black. Radiance behind the peak was assumed not to
    vary between surfaces.
    """
    surroundings = {"sky": {"type": "constant", "radiance": 1.0}}
    for side, value in ((-1, 1.0), (1, 0.0)):
        place = mi.ScalarTransform4f().translate([3000 * side, -60, 0]).rotate([1, 0, 0], -90)
        diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}
        half = {"type": "rectangle", "to_world": place.scale(3000), "bsdf": diffuse}
        surroundings[f"ground_{side}"] = half
    to = np.array([0.15, -0.5, -1]) / np.linalg.norm([0.15, -0.5, -1])
    nodes, weights = np.polynomial.legendre.leggauss(1024)
    angle = (np.arange(2048) + 0.5) * 2 * np.pi / 2048
    radius = np.sqrt(1 - nodes**2)[:, None]
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), nodes[:, None]
    phase = (1 - g**2) / (1 + g**2 - 2 * g * (x * to[0] + y * to[1] + z * to[2])) ** 1.5
    shares = weights[:, None] / (2 * 2048) * ((x < 0) | (y > 0))
    expected = (shares * phase).sum() / shares.sum()
    found = ratio_to_isotropic(
        scenes, g, to.tolist(), surroundings, {"cache_spp": 2048}, spp=1 << 14
    )
    assert found == pytest.approx(expected, rel=0.04)


# A peak of 0.85 is in `test_a_forward_peak_scatters_radiance_of_another_surface`.
@pytest.mark.parametrize("g", with_slow([0.7, 0.85], 0.85))
def test_a_wide_emitter_behind_a_forward_peak(scenes, g):
    """A medium in front of a ceiling that emits, seen from below: by how much it is darker, over
    the same with isotropic scattering. Light of such an emitter that the peak scatters is part of
    the scattered radiance, and counted as transmitted, too.
    """
    to, deficits = [0, 0.3, -1], []
    surroundings = {"ceiling": bright_ceiling(), "ground": black_ground()}
    for phase in ({"type": "isotropic"}, hg(g)):
        scene = thin_medium(scenes, phase, to, surroundings, {"cache_spp": 2048})
        deficits.append(1 - np.array(mi.render(scene, spp=1 << 14), dtype=np.float64).mean())
    expected = (1 - 0.4 * ratio_below_half_a_sky(g, to)) / 0.6  # the albedo is 0.8
    assert deficits[1] / deficits[0] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("parameter", ["sky.data", "cloud.interior_medium.sigma_t.value.value"])
@pytest.mark.parametrize("forward", [False, True])
def test_derivatives_of_light_from_above_the_horizon(scenes, parameter, forward):
    """Radiance that a thin medium scatters in front of black is proportional to its extinction, and
    to the radiance of the sky: its derivative with respect to a factor of either is its value.
    """
    to, properties = [0, -0.15, -1], {"cache_spp": 512}
    scene = thin_medium(scenes, hg(0.85), to, {"sky": half_sky()}, properties)
    parameters = mi.traverse(scene)
    expected = np.array(mi.render(scene, spp=1024), dtype=np.float64).sum()
    factor = mi.Float(1)
    dr.enable_grad(factor)
    parameters[parameter] = parameters[parameter] * factor
    parameters.update()
    image = mi.render(scene, parameters, spp=1024, seed=1)
    if forward:
        dr.forward(factor)
        found = np.array(dr.grad(image), dtype=np.float64).sum()
    else:
        dr.backward(dr.sum(image))
        found = float(dr.grad(factor)[0])
    assert found == pytest.approx(expected, rel=0.03)


def black_ground() -> dict:
    """Return a rectangle below the medium that hides the lower half of the environment."""
    placement = mi.ScalarTransform4f().translate([0, -3, 0]).rotate([1, 0, 0], -90).scale(3000)
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    return {"type": "rectangle", "to_world": placement, "bsdf": black}


def bright_ceiling() -> dict:
    """Return a rectangle that emits a radiance of 1 from above."""
    placement = mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(3000)
    return {
        "type": "rectangle",
        "to_world": placement,
        "emitter": {"type": "area", "radiance": 1.0},
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
    }


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_sky_above_black_ground_that_is_scattered_backwards(scenes, seed):
    """Ground occludes half of the sky: with 64 directions that are even in all of it, the ratio had
    a noise of 6 %.
    """
    to, sky = [0, -3, -2], {"type": "constant", "radiance": 1.0}
    surroundings = {"sky": sky, "ground": black_ground()}
    found = ratio_to_isotropic(scenes, 0.3, to, surroundings, {"max_depth": 2, "cache_seed": seed})
    assert found == pytest.approx(ratio_below_half_a_sky(0.3, to), rel=0.02)


def test_noise_of_backward_scattering_above_ground(scenes):
    """Parts of an image of a cube above black ground, by two seeds: they differed by 2.1 % (and by
    15 % at silhouettes of larger scenes), because few directions sample the moments of half a sky
    badly.
    """
    surroundings = {"sky": {"type": "constant", "radiance": 1.0}, "ground": black_ground()}
    # On a coarser grid two seeds differ by less, whatever the directions.
    fine = {"resolution": 24}
    check_seeds(
        lambda seed: in_surroundings(scenes, 0.85, surroundings, cache_seed=seed, **fine), 0.012
    )


def in_surroundings(scenes, g: float, surroundings: dict, **properties) -> mi.Scene:
    """Return a cube with these surroundings, seen slightly from above."""
    camera = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([1.8, 1.8, 5.6], [0, 0, 0], [0, 1, 0]),
        "fov": 24,
        "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
    }
    medium = scenes.medium(1.5, 0.9) | {"phase": hg(g) if g else {"type": "isotropic"}}
    cloud = scenes.boundary(medium, scenes.placement((2, 2, 2)))
    integrator = {"type": "irrcache", "resolution": 12} | properties
    scene = {"type": "scene", "cloud": cloud, "sensor": camera, "integrator": integrator}
    return mi.load_dict(scene | surroundings)


def check_seeds(build, tolerance: float) -> None:
    """Assert that blocks of images by two seeds of a cache differ by less than ``tolerance``."""
    images = [np.array(mi.render(build(seed), spp=64), dtype=np.float64) for seed in (1, 2)]
    first, second = (i[8:24, 8:24].mean(axis=2).reshape(4, 4, 4, 4).mean((1, 3)) for i in images)
    np.testing.assert_allclose(first, second, rtol=tolerance)


def ground_with_a_hole() -> dict:
    """Return four rectangles around a hole, and a sky that is bright below."""
    texels = np.full((32, 64, 3), 0.02, np.float32)
    texels[16:] = 1
    found = {"sky": {"type": "envmap", "bitmap": mi.Bitmap(texels)}}
    for number, (x, z) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
        centre, scale = [3.2 * x, -1.05, 3.2 * z], [2.8, 6, 1] if x else [0.4, 2.8, 1]
        place = mi.ScalarTransform4f().translate(centre).rotate([1, 0, 0], -90).scale(scale)
        side = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}}
        found[f"side_{number}"] = side
    return found


# Anisotropic scattering always has more ordinates, in
# `test_noise_of_backward_scattering_above_ground`.
@pytest.mark.parametrize("g", with_slow([0, 0.5], 0.5))
def test_noise_of_light_through_a_hole(scenes, g):
    """Light that enters through a hole in the ground, two seeds: parts of the image differed by
    10 to 14 %, because few ordinates pass the edges of the hole.
    """
    hole = ground_with_a_hole()
    check_seeds(lambda seed: in_surroundings(scenes, g, hole, cache_seed=seed), 0.04)


@pytest.mark.parametrize("g", [0, 0.5])
def test_noise_of_light_through_a_hole_is_warned_of(scenes, logged, monkeypatch, g):
    """The same with as few ordinates as elsewhere: a warning, also with anisotropic scattering."""
    monkeypatch.setattr(incident, "_further_ordinates", lambda *_: 0)
    mi.render(in_surroundings(scenes, g, ground_with_a_hole()), spp=1)
    assert any("neighbouring voxels share" in message for message in logged)


def test_more_directions_are_no_worse_in_dense_media(scenes):
    """Single scattering in voxels that are optically dense, up to the face of the grid. Single
    ordinates miss voxels there, whose values had been extrapolated: +65 % of the mean, and five
    times the radiance in parts.
    """
    look = mi.ScalarTransform4f().look_at([3, 2.2, 5], [0, -0.2, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    found = []
    for directions in (64, 256):
        integrator = {"type": "irrcache", "max_depth": 2, "solver": "sweep", "resolution": 24}
        scene = {
            "type": "scene",
            "cube": scenes.boundary(scenes.medium(10.0, 0.9) | {"phase": hg(0.5)}),
            "sky": half_sky(),
            "sensor": {"type": "perspective", "fov": 32, "to_world": look, "film": film},
            "integrator": integrator | {"cache_spp": directions},
        }
        image = mi.render(mi.load_dict(scene), spp=64, seed=1)
        found.append(np.array(image, dtype=np.float64))
    few, many = found
    assert many.mean() == pytest.approx(few.mean(), rel=0.04)
    assert np.abs(many - few).max() < 0.2 * few.max()


def test_neglected_moments_are_warned_of(scenes, logged):
    """Where a camera sees hardly any of the radiance of the sky; not where it looks up."""
    warned = []
    for height in (3, -3):
        logged.clear()
        cube = scenes.boundary(scenes.medium(1.0, 0.8) | {"phase": hg(0.85)})
        look = mi.ScalarTransform4f().look_at([0, height, 2], [0, 0, 0], [0, 1, 0])
        film = {"type": "hdrfilm", "width": 4, "height": 4}
        scene = {
            "type": "scene",
            "cloud": cube,
            "sky": half_sky(),
            "sensor": {"type": "perspective", "to_world": look, "film": film},
            "integrator": {"type": "irrcache", "resolution": 8},
        }
        mi.render(mi.load_dict(scene), spp=1)
        warned.append(any("Legendre moments" in message for message in logged))
    assert warned == [True, False]


def two_kinds(scenes) -> dict:
    return {
        "a": scenes.boundary(fog(), scenes.placement((0.9, 1.6, 1.6), center=(-0.5, 0, 0))),
        "b": scenes.boundary(
            fog() | {"phase": hg(0.5)}, scenes.placement((0.9, 1.6, 1.6), center=(0.5, 0, 0))
        ),
    }


@pytest.mark.parametrize("solver", with_slow(["path", "sweep"], "path"))
def test_two_media_of_two_kinds(scenes, solver):
    depth, ours = {"max_depth": -1, "rr_depth": 50}, {"solver": solver}
    check(*images(scenes, two_kinds(scenes), ours, depth, (64, 256)))


def sharp_beside(scenes) -> dict:
    """Return a strongly forward scattering medium beside another one, over the ground."""
    thin = fog() | {"phase": hg(0.7)}
    beside = scenes.boundary(thin, scenes.placement((0.9, 1.6, 1.6), center=(0.8, 0, 0)))
    place = scenes.placement((1.0, 1.6, 1.6), center=(-0.5, 0, 0))
    cloud = scenes.medium(scenes.texture((6, 6, 6), 0, 4, 4), 0.95, place) | {"phase": hg(0.85)}
    return {"cloud": scenes.boundary(cloud, place), "beside": beside, "ground": ground()}


def lamps(scenes) -> dict:
    """Return two area lights, one large and close, one small, and a point light above a medium."""
    return {
        "cloud": scenes.boundary(scenes.medium((1.0, 1.2, 1.4), 0.9) | {"phase": hg(0.5)}),
        "wide": lamp((0.2, 1.6, 0.1), (0, 0, 0), 0.6, (3, 3, 3)),
        "small": lamp((-1.5, 1.6, -1.0), (0, 0, 0), 0.1, (60, 50, 40)),
        "emitter": POINT | {"intensity": 5.0}, "sun": None, "ground": ground(),
    }  # fmt: skip


AMONG_SURFACES = {
    "hg 0.85, hg 0.7, sun": (sharp_beside, -1, {}),
    "lamps, single": (lamps, 2, {}),
    "lamps": (lamps, -1, {}),
}


# The one that is always run has the lamps; others have two media and a forward peak.
@pytest.mark.parametrize(
    ("build", "depth", "bounds"),
    [
        pytest.param(*case, id=name, marks=[pytest.mark.slow] * (name != "lamps, single"))
        for name, case in AMONG_SURFACES.items()
    ],
)
def test_with_surfaces(scenes, build, depth, bounds):
    """``sweep`` agrees with volpath if the ground and another medium scatter radiance back."""
    depths, ours = {"max_depth": depth, "rr_depth": 50}, {"cache_spp": 128, "solver": "sweep"}
    check(*images(scenes, build(scenes), ours, depths, (64, 512)), **bounds)


@pytest.mark.parametrize(
    "extinction", [pytest.param((1.0, 1.0, 1.0), marks=pytest.mark.slow), (0.4, 1.5, 3.0)]
)
def test_lamps_of_two_colours_add_up(extinction):
    """The image under two lamps, each of a colour of its own, is the sum of those under one."""
    medium = fog(extinction) | {"phase": hg(0.5)}
    lamps = {
        "red": lamp((0, 0.3, -3), (0, 0, 0), 1, (12, 1, 0.1)),
        "blue": lamp((0, 0.3, 3), (0, 0, 0), 1, (0.1, 1, 12)),
    }
    place = mi.ScalarTransform4f().look_at([6, 0, -2.5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 26, "to_world": place, "film": film}
    ours = {"type": "irrcache", "max_depth": 2, "resolution": 16, "cache_spp": 32}
    objects = {"type": "scene", "sensor": camera, "integrator": ours, "box": bound(interior=medium)}
    both, *single = (
        np.array(mi.render(mi.load_dict(objects | chosen), spp=16))
        for chosen in (lamps, *({name: one} for name, one in lamps.items()))
    )
    np.testing.assert_allclose(both, sum(single), rtol=0.02, atol=0.03 * both.mean())


def test_furnace_with_surfaces(scenes):
    """With an albedo of 1 everywhere, a forward scattering medium on the ground is invisible."""
    medium = scenes.medium(3.0, 1.0) | {"phase": hg(0.8)}
    objects = {"emitter": {"type": "constant", "radiance": 1.0}, "sun": None}
    objects["ground"] = ground(bsdf=diffuse(1.0, 1.0, 1.0))
    integrator = {"type": "irrcache", "solver": "auto", "resolution": 12, "rr_depth": 1000}
    scene = scenes.load(integrator, scenes.boundary(medium), 16, **objects, default_solver="path")
    image = scenes.image(scene, spp=64)
    assert image.mean() == pytest.approx(1, abs=5e-3) and np.abs(image - 1).max() < 0.1


@pytest.mark.parametrize("g", [0.5, -0.4])
def test_thin_slab(scenes, g):
    """A thin slab scatters once: its radiance is sigma_s p(cos) E t, to 1 %."""
    sun = scenes.sun | {"irradiance": 2.0, "direction": [1.0, 0.0, 1.0]}
    medium = scenes.medium(1e-3, 0.8) | {"phase": hg(g)}
    shape = scenes.boundary(medium, scenes.placement((4.0, 4.0, 0.5)))
    sensor = scenes.description({}, None, 4)["sensor"]
    look = mi.ScalarTransform4f().look_at([0, 0, -50], [0, 0, 0], [0, 1, 0])
    sensor = sensor | {"to_world": look, "fov": 0.5}
    scene = scenes.load(
        {"type": "irrcache", "solver": "path", "resolution": 8, "cache_spp": 16}, shape, 4,
        emitter=sun, sun=None, sensor=sensor,
    )  # fmt: skip
    cosine = -(0.5**0.5)  # of both path segments
    p = (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * cosine) ** 1.5)
    expected = 0.8e-3 * p * 2.0 * 0.5
    np.testing.assert_allclose(scenes.image(scene, spp=16), expected, rtol=0.01)


def test_furnace(scenes):
    """With albedo 1 under a white sky, all pixels are 1."""
    medium = scenes.medium(1.0, 1.0) | {"phase": hg(0.5)}
    sky = {"type": "constant", "radiance": 1.0}
    integrator = {"type": "irrcache", "resolution": 10, "cache_spp": 512, "rr_depth": 100000}
    scene = scenes.load(
        integrator, scenes.boundary(medium), 16, emitter=sky, sun=None, default_solver="path"
    )
    image = scenes.image(scene, spp=16)
    assert image.mean() == pytest.approx(1, abs=3e-3) and np.abs(image - 1).max() < 0.05


def loaded(scenes, phase: dict, **settings) -> mi.Scene:
    integrator = {"type": "irrcache", "max_depth": 3, "resolution": 6, "cache_spp": 16} | settings
    shape = scenes.boundary(scenes.medium(1.0, 0.9) | {"phase": phase})
    return scenes.load(integrator, shape, 8, default_solver="path")


@pytest.mark.parametrize(("g", "lamps"), with_slow([(0.85, 9), (0.85, 8), (0.5, 9)], (0.5, 9)))
def test_sharp_shadows_on_surfaces_are_announced(scenes, monkeypatch, g, lamps):
    """A forward peak counts as unscattered if there are more lamps than are treated as narrow."""
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    cloud = scenes.boundary(scenes.medium(1.0, 0.9) | {"phase": hg(g)})
    objects = {"cloud": cloud, "ground": ground()}
    for k in range(lamps):
        place = mi.ScalarTransform4f().translate((0.5 * k - 2, 3, 0)).scale(0.1)
        lamp = {"type": "area", "radiance": 1.0}
        objects[f"lamp{k}"] = {"type": "sphere", "to_world": place, "emitter": lamp}
    settings = {
        "type": "irrcache",
        "solver": "auto",
        "resolution": 4,
        "cache_spp": 16,
        "max_depth": -1,
    }
    scene = scenes.load(settings, None, 8, **objects)
    scene.integrator().prepare(scene)
    announced = any("shadows on surfaces" in text for text in messages)
    assert announced == (lamps > 8 and g > 0.8)


@pytest.mark.parametrize("surfaces", [False, True])
def test_channels_together_or_apart(scenes, monkeypatch, surfaces):
    medium = scenes.medium(1.0, (0.9, 0.6, 0.8)) | {"phase": hg(0.5)}
    objects = {"cloud": scenes.boundary(medium)} | ({"ground": ground()} if surfaces else {})
    settings = {"type": "irrcache", "solver": "sweep", "resolution": 8, "cache_seed": 3}
    found = []
    for most in (1 << 24, 0):
        monkeypatch.setattr(solver, "MOST_SWEPT_TOGETHER", most)
        scene = scenes.load(settings, None, 8, emitter=scenes.sky, sun=scenes.sun, **objects)
        found.append(scenes.image(scene, spp=4, seed=0))
    np.testing.assert_allclose(*found, rtol=1e-3, atol=1e-4 * found[0].mean())


def test_files(scenes, tmp_path):
    """Angular moments are saved, loaded and merged; a file of another phase function is refused."""
    file = str(tmp_path / "light.npz")
    first = loaded(scenes, hg(0.4), cache_file=file)
    before = scenes.image(first, spp=2)
    again = loaded(scenes, hg(0.4), cache_file=file)
    np.testing.assert_array_equal(scenes.image(again, spp=2), before)
    other = loaded(scenes, hg(0.4), cache_seed=1, cache_file=str(tmp_path / "other.npz"))
    other.integrator().prepare(other)
    cache, more = first.integrator().cache, other.integrator().cache
    means = [np.array(m) for m in (cache._sums.moments[3], more._sums.moments[3])]
    cache.merge(more)
    np.testing.assert_allclose(np.array(cache._sums.moments[3]), sum(means), rtol=1e-5)
    foreign = loaded(scenes, hg(0.3), cache_file=file)
    with pytest.raises(CacheFileError, match="medium"):
        foreign.integrator().prepare(foreign)


@pytest.mark.parametrize("g", [0.4, 0.75])
def test_equilibrium(scenes, g):
    """With emission equal to absorption and a sky of 1, all radiance is 1."""
    medium = scenes.medium(2.0, 0.6) | {"phase": hg(g)}
    integrator = {"type": "irrcache", "solver": "auto", "emission": 0.8, "resolution": 10}
    sky = {"type": "constant", "radiance": 1.0}
    scene = scenes.load(
        integrator, scenes.boundary(medium), 16, emitter=sky, sun=None, default_solver="path"
    )
    image = scenes.image(scene, spp=16)
    assert scene.integrator()._builder.solver == "sweep"
    assert image.mean() == pytest.approx(1, abs=3e-3) and np.abs(image - 1).max() < 0.05


def test_layers_add_up(scenes):
    scene = loaded(scenes, hg(0.4), aovs="colour,illumination,background,noise")
    values = scenes.image(scene, spp=8)
    image, colours, illumination, background = (values[..., i : i + 3] for i in (0, 3, 6, 9))
    np.testing.assert_allclose(colours * illumination + background, image, rtol=1e-4, atol=1e-5)
