"""Emissive media, which Mitsuba does not have: closed forms, and enclosures in equilibrium."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.render.quadrature import QUADRATURES
from tests.support.slow import with_slow

pytestmark = pytest.mark.usefixtures("rgb")

SKY = {"type": "constant", "radiance": 1.0}
DARK = {"emitter": None, "sun": None}
DENSITY = (5, 6, 7)
SOLVERS = ["path", "sweep"]


def straight_ahead(scenes, size: int = 8) -> dict:
    """Return an orthographic sensor that looks along z at the square [-0.5, 0.5]^2."""
    look = mi.ScalarTransform4f().look_at([0, 0, -5], [0, 0, 0], [0, 1, 0])
    film = scenes.description({}, None, size)["sensor"]["film"]
    half = mi.ScalarTransform4f().scale([0.5, 0.5, 1])
    return {"type": "orthographic", "to_world": look @ half, "film": film}


def rendered(scenes, shape, emission, spp: int = 4, size: int = 8, objects=None, **settings):
    """Return image and scene, with the orthographic sensor unless ``objects`` has one."""
    integrator = {"type": "irrcache", "emission": emission, "resolution": 16} | settings
    objects = {"sensor": straight_ahead(scenes, size)} | DARK | (objects or {})
    scene = scenes.load(integrator, shape, **objects, default_solver="path")
    return scenes.image(scene, spp=spp), scene


def prepare(scenes, shape, emission, **settings) -> None:
    """Build the cache; its exceptions are not wrapped by Mitsuba, unlike those of rendering."""
    scene = scenes.load(
        {"type": "irrcache", "solver": "path", "emission": emission} | settings, shape, **DARK
    )
    scene.integrator().prepare(scene)


@pytest.mark.parametrize("sigma", [0.0, 1e-3, 0.7, 40.0])
@pytest.mark.parametrize("emission", [2.0, {"type": "rgb", "value": [1.0, 2.0, 0.0]}])
def test_homogeneous_slab(scenes, sigma, emission):
    """Two units of emission j: j / sigma (1 - exp(-sigma s)), or j s without absorption."""
    shape = scenes.boundary(scenes.medium(sigma, 0.0))
    found, _ = rendered(scenes, shape, emission, emission_scale=1.5)
    j = 1.5 * np.array([1.0, 2.0, 0.0] if isinstance(emission, dict) else [2.0] * 3)
    expected = j * (2.0 if sigma == 0 else -np.expm1(-sigma * 2) / sigma)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=2e-5)


@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_heterogeneous_slab(scenes, quadrature):
    """A slab whose coloured extinction and emission vary along the ray agrees with quadrature."""
    z = (np.arange(24) + 0.5) / 24
    column = np.ones((24, 1, 1, 1))
    sigma_t = (6 * z**2)[:, None, None, None] * [1.0, 0.5, 2.0] * column
    j = (4 * z * (1 - z))[:, None, None, None] * [1.0, 2.0, 3.0] * column
    place = scenes.placement()
    shape = scenes.boundary(scenes.medium(sigma_t, 0.0, place), place)
    settings = {"quadrature": quadrature, "step": 0.1}
    found, _ = rendered(scenes, shape, scenes.volume(j, place), spp=16, **settings)
    t = (np.arange(40000) + 0.5) / 20000
    for c in range(3):
        sigma, shine = (np.interp(t / 2, z, v[:, 0, 0, c]) for v in (sigma_t, j))
        depth = np.cumsum(sigma) - 0.5 * sigma
        expected = (np.exp(-depth / 20000) * shine).sum() / 20000
        tolerance = 2e-2 if quadrature == "riemann" else 1e-3
        assert found[..., c].mean() == pytest.approx(expected, rel=tolerance)


def test_emission_in_empty_voxels(scenes):
    """Emission in empty voxels is rendered, and attenuated by the medium in front of it."""
    sigma_t = np.zeros((32, 8, 8), np.float32)
    sigma_t[28:] = 1.0
    place = scenes.placement()
    shape = scenes.boundary(scenes.medium(sigma_t, 0.0, place), place)
    flame = scenes.placement((2.0, 2.0, 0.5), center=(0, 0, -0.3))
    found, _ = rendered(scenes, shape, scenes.volume(np.full((2, 2, 2), 3.0), flame), spp=64)
    np.testing.assert_allclose(found.mean(), 3.0 * 0.5, rtol=5e-3)
    np.testing.assert_allclose(found, 3.0 * 0.5, rtol=0.03)  # the block's faces cut steps
    # Where the emission lies inside of the grid, the medium is there; half of it lies outside.
    behind = scenes.placement((2.0, 2.0, 0.2), center=(0, 0, 1.0))
    light = scenes.volume(np.full((2, 2, 2), 3.0), behind)
    found, _ = rendered(scenes, shape, light, spp=64, step=0.2)
    t = np.linspace(0.9, 1.0, 2001)
    z = np.interp(np.linspace(0, 1.0, 20001), *_profile(sigma_t[:, 0, 0]))
    depth = np.interp(t, np.linspace(0, 1.0, 20001), np.cumsum(z) / 20000)
    assert found.mean() == pytest.approx(3.0 * np.trapezoid(np.exp(-depth), t), rel=5e-3)


def _profile(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres in [-1, 1] and the values of a row of voxels."""
    return (np.arange(len(values)) + 0.5) / len(values) * 2 - 1, values


@pytest.mark.parametrize("solver", SOLVERS)
def test_uncollided_fluence_in_a_sphere(scenes, solver):
    """In an emitting sphere Phi = int_S2 j / sigma (1 - e^(-sigma s)) dw, with s the way out."""
    shape = scenes.boundary(scenes.medium(1.0, 0.5), scenes.placement(), "sphere")
    settings = {"solver": solver, "max_depth": 2, "resolution": 15, "cache_spp": 512}
    _, scene = rendered(scenes, shape, 0.7, size=2, **settings)
    cache = scene.integrator().cache
    z, y, x = np.indices(cache.grid.shape)
    place = (np.stack([x, y, z], axis=-1) + 0.5) / 7.5 - 1
    r = np.linalg.norm(place, axis=-1)
    cosine, weight = np.polynomial.legendre.leggauss(200)
    way = r[..., None] * cosine + np.sqrt(np.maximum(1 - r[..., None] ** 2 * (1 - cosine**2), 0))
    expected = 2 * np.pi * 0.7 * (weight * -np.expm1(-way)).sum(axis=-1)
    inside = r < 0.99
    measured = np.array(cache.uncollided)[..., 0]
    ratio = measured[inside] / expected[inside]
    assert ratio.mean() == pytest.approx(1, abs=2e-3)
    assert ratio.std() < 0.05
    assert not np.array(cache.scattered).any()


@pytest.mark.parametrize("solver", SOLVERS)
def test_equilibrium(scenes, solver):
    """In equilibrium with a sky of radiance 1, all radiance is 1; with finite orders it is less.

    The emission equals the absorption, (1 - albedo) sigma_t, in each colour channel.
    """
    place = scenes.placement(turn=25)
    density, albedo = scenes.texture(DENSITY, 0.0, 3.0, 4), np.array([0.9, 0.6, 0.2])
    shape = scenes.boundary(scenes.medium(density, albedo, place), place)
    j = scenes.volume(density[..., None] * (1 - albedo), place)
    settings = {"solver": solver, "cache_spp": 256, "rr_depth": 1000}
    objects = {"emitter": SKY, "sensor": scenes.description({}, None, 24)["sensor"]}
    found, _ = rendered(scenes, shape, j, 16, objects=objects, **settings)
    assert np.abs(found.mean(axis=(0, 1)) - 1).max() < 4e-3
    assert np.abs(found - 1).max() < 0.05
    less = rendered(scenes, shape, j, 4, objects=objects, max_depth=3, **settings)[0]
    assert less.mean() < found.mean() - 1e-3


def test_equilibrium_with_surfaces(scenes):
    """Equilibrium holds with grey spheres that emit what they do not reflect, and with two
    media.

    One sphere is in the medium, one is outside; one of the media has coloured extinction.
    """
    density, albedo = scenes.texture(DENSITY, 0.5, 2.0, 4), 0.7
    place = scenes.placement()
    fog = scenes.medium(density, albedo, place) | {"id": "fog"}
    glow = {"type": "area", "radiance": 0.5}
    grey = {"type": "diffuse", "reflectance": 0.5}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": grey, "glow": glow}
    other = scenes.medium((1.0, 2.0, 0.5), 1.0)
    objects = {
        "fog": fog,
        "inner": ball | {"center": [0.3, 0.2, 0], "exterior": {"type": "ref", "id": "fog"}},
        "outer": ball | {"center": [-0.8, 1.6, -0.5]},
        "clean": scenes.boundary(other, scenes.placement(center=(2.2, 0, 0))),
        "emitter": SKY,
        "sensor": scenes.description({}, None, 24)["sensor"],
    }
    shape = scenes.boundary({"type": "ref", "id": "fog"}, place)
    # The clear medium absorbs nothing, and the emission volume ends before it.
    j = scenes.volume((1 - albedo) * density, place)
    settings = {"resolution": 16, "cache_spp": 64, "rr_depth": 1000}
    found, _ = rendered(scenes, shape, j, 32, objects=objects, **settings)
    assert np.abs(found.mean(axis=(0, 1)) - 1).max() < 6e-3
    assert np.sqrt(((found - 1) ** 2).mean()) < 0.03


def glowing(bsdf: dict, radiance: float, center, radius: float = 0.5) -> dict:
    """Return an emissive sphere."""
    emitter = {"type": "area", "radiance": radiance}
    ball = {"type": "sphere", "center": list(center), "radius": radius}
    return ball | {"bsdf": bsdf, "emitter": emitter}


def test_equilibrium_by_sweep_with_surfaces(scenes):
    """``sweep`` preserves equilibrium with two media, one of which scatters anisotropically, and a
    grey sphere outside of both.

    The sphere emits what it does not reflect.
    """
    place, beside = scenes.placement(), scenes.placement((0.8, 1, 1), center=(2.0, 0, 0))
    fog = scenes.medium(1.5, 0.6) | {"phase": {"type": "hg", "g": 0.6}}
    objects = {
        "beside": scenes.boundary(scenes.medium(1.5, 0.6), beside),
        "ball": glowing({"type": "diffuse", "reflectance": 0.5}, 0.5, (-0.9, 1.8, -0.5)),
        "emitter": SKY,
        "sensor": scenes.description({}, None, 24)["sensor"],
    }
    settings = {"solver": "auto", "cache_spp": 128, "rr_depth": 1000}
    shape = scenes.boundary(fog, place)
    found, scene = rendered(scenes, shape, 1.5 * 0.4, 32, objects=objects, **settings)
    assert all(cache.correlated for cache in scene.integrator().caches.values())
    assert np.abs(found.mean(axis=(0, 1)) - 1).max() < 4e-3
    assert np.abs(found - 1).max() < 0.05


# The equilibrium above has emission, a surface and two media, too.
@pytest.mark.slow
def test_emission_in_a_room(scenes):
    """``sweep`` agrees with ``path`` on emission that reaches a medium by walls and another
    medium.

    The means over the voxels of both media are compared in each colour channel.
    """
    wall = {"type": "sphere", "radius": 4.0, "flip_normals": True}
    wall["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.6, 0.4]}}
    beside = scenes.boundary(scenes.medium(1.0, 0.5), scenes.placement(center=(2.2, 0, 0)))
    post = glowing({"type": "diffuse"}, 0.2, (1.1, 0.3, 0), 0.08)
    shape, light = flame(scenes)
    objects, found = {"wall": wall, "beside": beside, "post": post}, []
    for solver, spp in (("auto", 256), ("path", 64)):
        settings = {"solver": solver, "cache_spp": spp, "resolution": 16}
        integrator = {"type": "irrcache", "emission": light, "emission_scale": 2.0} | settings
        scene = scenes.load(integrator, shape, 4, **DARK, **objects, default_solver="path")
        scene.integrator().prepare(scene)
        caches = scene.integrator().caches.values()
        assert all(c.correlated == (solver == "auto") for c in caches)
        found.append([np.array(c.irradiance).mean(axis=(0, 1, 2)) for c in caches])
    np.testing.assert_allclose(*found, rtol=0.02)


def flame(scenes) -> tuple[dict, dict]:
    """Return coloured emission in a corner of a cloud, partly in empty voxels."""
    place = scenes.placement()
    density = scenes.texture((8, 8, 8), 0.5, 3.0, 4)
    density[:4, :4] = 0
    shape = scenes.boundary(scenes.medium(density, 0.9, place), place)
    light = scenes.texture((4, 4, 4, 3), 0.0, 1.0, 8) * [9.0, 3.0, 1.0]
    where = scenes.placement((0.9, 0.8, 1.0), turn=30, center=(0.1, -0.2, -0.1))
    return shape, scenes.volume(light, where)


# All orders by each solver: equilibrium.
@pytest.mark.parametrize("max_depth", with_slow([2, 3, -1], 2, -1))
def test_solvers_agree(scenes, max_depth):
    """Both solvers agree for each order and colour; the rays lie outside of all symmetry planes."""
    shape, light = flame(scenes)
    objects = {"sensor": scenes.description({}, None, 24)["sensor"]}
    settings = {"max_depth": max_depth, "resolution": 20, "cache_spp": 384, "rr_depth": 1000}
    settings["objects"] = objects
    images = [rendered(scenes, shape, light, 16, solver=s, **settings)[0] for s in SOLVERS]
    means = [image.mean(axis=(0, 1)) for image in images]
    np.testing.assert_allclose(*means, rtol=0.01)
    assert np.sqrt(((images[0] - images[1]) ** 2).mean()) < 0.02 * images[0].mean()


def test_errors_between_neighbours_are_known(scenes):
    """Emission is sampled from each voxel alone, and lookups need the variance of that: it agrees
    with the differences between two caches.

    A spark in 2^3 of 16^3 voxels, single scattering. When lookups neglected this variance, such an
    image was 2.6 % too bright, with any number of samples.
    """
    values = np.zeros((8, 8, 8))
    values[2:3, 3:4, 5:6] = 1
    place = scenes.placement()
    shape = scenes.boundary(scenes.medium(np.full((8, 8, 8), 2.0), 0.9, place), place)
    found, variances = [], []
    for seed in (1, 2):
        settings = {"solver": "sweep", "max_depth": 2, "cache_spp": 64, "cache_seed": seed}
        integrator = {"type": "irrcache", "emission": scenes.volume(values, place)}
        scene = scenes.load(integrator | settings | {"resolution": 16}, shape, **DARK)
        scene.integrator().prepare(scene)
        (cache,) = scene.integrator().caches.values()
        mean = mi.Float(np.array(cache.irradiance)[..., 0].ravel())
        variances.append(np.array(cache._sums.relative_variance(mi.Float(1), 0)))
        found.append(np.array(mean))
    expected = np.square(found[0] - found[1]).mean() / 2
    assert np.mean(variances) == pytest.approx(expected, rel=0.3)


@pytest.mark.parametrize("edge", [2, 6])
def test_a_small_flame_illuminates_far_voxels(scenes, edge):
    """Far from an emissive block of ``edge``^3 of 32^3 voxels, the irradiance is that of a point of
    the same power, in every voxel: points of the emission are sampled.

    With random directions alone, which rarely hit the block, the relative standard deviation of
    voxels was 1.2 to 12, and images were up to 48 % too dark.
    """
    sigma_t, side = 0.5, 32
    values, centre = np.zeros((side,) * 3), slice((side - edge) // 2, (side + edge) // 2)
    values[centre, centre, centre] = 50
    place = scenes.placement()
    emission = scenes.volume(values, place)
    integrator = {"type": "irrcache", "emission": emission, "solver": "sweep", "max_depth": 2}
    shape = scenes.boundary(scenes.medium(sigma_t, 0.8, place), place)
    scene = scenes.load(integrator | {"resolution": 24}, shape, **DARK)
    scene.integrator().prepare(scene)
    (cache,) = scene.integrator().caches.values()
    p = np.array(cache.grid.centers(cache.active), dtype=np.float64)
    centre = place[:3, :3] @ np.full(3, 0.5) + place[:3, 3]
    distance = np.linalg.norm(p - centre[:, None], axis=0)
    power = values.sum() * abs(np.linalg.det(place[:3, :3])) / side**3
    expected = power * np.exp(-sigma_t * distance) / distance**2
    # The mean over a cube of edge a is larger by a^2 / 24 times the Laplacian.
    laplacian = sigma_t**2 + 2 * sigma_t / distance + 2 / distance**2
    expected *= 1 + laplacian * (2 * edge / side) ** 2 / 24
    far = distance > 4 * edge / side
    ratio = np.array(cache.irradiance)[..., 0].ravel()[far] / expected[far]
    assert far.sum() > 1000
    assert ratio.mean() == pytest.approx(1, abs=0.005)
    assert ratio.std() < 0.05


@pytest.mark.parametrize(("edge", "warns"), [(2, True), (24, False)])
def test_noise_of_a_small_flame_is_warned_of(scenes, monkeypatch, edge, warns):
    """The paths of the solver `path` rarely meet a small flame: images around it are too dark."""
    logged = []
    monkeypatch.setattr(mi, "Log", lambda _, text: logged.append(text))
    values, centre = np.zeros((32,) * 3), slice(16 - edge // 2, 16 + edge // 2)
    values[centre, centre, centre] = 50
    place = scenes.placement()
    shape = scenes.boundary(scenes.medium(0.5, 0.8, place), place)
    settings = {"solver": "path", "max_depth": 2, "resolution": 12}
    prepare(scenes, shape, scenes.volume(values, place), **settings)
    assert any("Raise cache_spp" in text for text in logged) is warns


@pytest.mark.parametrize("density", [0.0, 12.0])
def test_emission_of_coarse_data_is_resolved(scenes, density):
    """Without scattering there is no cache whose voxels shorten the steps of the ray march: in
    coarse data, pixels were 8 % wrong.
    """
    rng, place = np.random.default_rng(4), scenes.placement()
    extinction = np.where(rng.random((6, 6, 6)) > 0.7, density, 0.01)
    shape = scenes.boundary(scenes.medium(extinction, 0.0, place), place)
    light = scenes.volume(rng.random((5, 5, 5)) ** 4, place)
    settings = {"solver": "sweep", "max_depth": 1}
    image, fine = (
        rendered(scenes, shape, light, 64, step=step, **settings)[0] for step in (1.0, 0.05)
    )
    np.testing.assert_allclose(image, fine, atol=0.01 * fine.mean())


def test_orders(scenes):
    """Depth 0 has no emission; depth 1 has the unscattered emission, as background."""
    shape, light = flame(scenes)
    assert not rendered(scenes, shape, light, max_depth=0)[0].any()
    settings = {"aovs": "colour,illumination,background", "solver": "sweep"}
    values = rendered(scenes, shape, light, max_depth=2, cache_spp=64, **settings)[0]
    image, colour, illumination, background = np.split(values, 4, axis=-1)
    np.testing.assert_allclose(colour * illumination + background, image, rtol=1e-4, atol=1e-5)
    seen = rendered(scenes, shape, light, max_depth=1)[0]
    assert background.mean() == pytest.approx(seen.mean(), rel=0.02)  # with other steps
    assert seen.mean() > 0.1 and image.mean() > 1.05 * seen.mean()


def test_mono(mono, scenes):
    shape = scenes.boundary(scenes.medium(0.5, 0.5))
    colour = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
    found, _ = rendered(scenes, shape, colour, max_depth=1)
    np.testing.assert_allclose(found, 2 * -np.expm1(-1.0), rtol=1e-5)


def test_edits_renew_the_cache(scenes, tmp_path):
    shape, light = flame(scenes)
    file = str(tmp_path / "light.npz")
    settings = {"max_depth": 2, "cache_spp": 16, "cache_file": file}
    before, scene = rendered(scenes, shape, light, **settings)
    cache = scene.integrator().cache
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith("emission.data")]
    params[key] = 2 * params[key]
    params.update()
    after = scenes.image(scene, spp=4)
    assert scene.integrator().cache is not cache
    np.testing.assert_allclose(after.mean(), 2 * before.mean(), rtol=1e-4)
    with pytest.raises(CacheFileError, match="medium"):
        prepare(scenes, shape, light, emission_scale=2.0, **settings)


BAD = {
    "negative": (-1.0, {}, "not negative"),
    "infinite": (float("inf"), {}, "finite"),
    "text": ("bright", {}, "must be a number, a colour"),
    "scale": (1.0, {"emission_scale": -2.0}, "emission_scale is -2"),
}


@pytest.mark.parametrize(("emission", "settings", "message"), BAD.values(), ids=BAD)
def test_bad_values_are_refused(scenes, emission, settings, message):
    """Invalid emission raises an error while the scene is loaded, which Mitsuba wraps."""
    with pytest.raises((IrrcacheError, RuntimeError), match=message):
        prepare(scenes, scenes.boundary(scenes.medium(1.0, 0.5)), emission, **settings)


def test_bad_volumes_are_refused(scenes):
    shape, values = scenes.boundary(scenes.medium(1.0, 0.5)), np.ones((3, 3, 3))
    values[1, 2, 0] = -1
    with pytest.raises(IrrcacheError, match=r"emission.*\(z, y, x\) = \(1, 2, 0\)"):
        prepare(scenes, shape, scenes.volume(values))
    values[1, 2, 0] = 5
    with pytest.raises(IrrcacheError, match=r"emission.*trilinear"):
        prepare(scenes, shape, scenes.volume(values, filter_type="nearest"))
    with pytest.raises(IrrcacheError, match=r"no medium.*to_world"):
        prepare(scenes, shape, scenes.volume(values, scenes.placement(center=(5, 0, 0))))
    with pytest.raises(IrrcacheError, match=r"emission.*medium"):
        prepare(scenes, None, 1.0)
