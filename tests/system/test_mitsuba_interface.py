"""``irrcache`` through Mitsuba's interfaces: films, sensors, wrappers, cancellation, seeds,
gradients.

Images are compared with those of ``volpath``.
"""

from __future__ import annotations

import threading

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache import render_progressive
from mitsuba_irrcache.errors import IrrcacheError

pytestmark = pytest.mark.usefixtures("rgb")

SIZE = 12
DEPTH = {"max_depth": 3, "rr_depth": 1000}
#: Difference allowed relative to the mean, in addition to 4.5 standard errors: the bias of a coarse
#: cache.
TOLERANCE = 0.015


def ours(**settings) -> dict:
    return {"type": "irrcache", **DEPTH, "resolution": 16, "cache_spp": 64} | settings


STOCK = {"type": "volpath", **DEPTH}


def cloud(scenes) -> dict:
    """Return a cloud that is smooth enough for a coarse cache."""
    to_world = scenes.placement(turn=20)
    return scenes.boundary(
        scenes.medium(scenes.texture((5, 6, 7), 0.6, 1.4, 4), 0.9, to_world), to_world
    )


def pair(scenes, wrap=lambda inner: inner, settings=None, **objects) -> list[mi.Scene]:
    """Return the same scene with both integrators."""
    mine = ours(**(settings or {}))
    return [
        scenes.load(wrap(i), cloud(scenes), SIZE, **objects, default_solver="path")
        for i in (mine, STOCK)
    ]


def agree(both: list[mi.Scene], spp=(32, 256), channels=None, **options) -> np.ndarray:
    """Compare the means of all ``channels``; return the first image by irrcache."""
    images = [
        [np.array(mi.render(s, spp=n, seed=seed, **options), np.float64) for seed in (1, 2)]
        for s, n in zip(both, spp, strict=True)
    ]
    assert images[0][0].shape == images[1][0].shape and np.isfinite(images[0]).all()
    (x, y), (a, b) = np.array(images)[..., :channels]
    scale = np.abs(0.5 * (a + b)).mean((0, 1))
    pixels = a.shape[0] * a.shape[1]
    spread = np.hypot((x - y).std((0, 1)), (a - b).std((0, 1))) / 2 / np.sqrt(pixels)
    assert (spread < 0.01 * scale).all(), "too noisy to say"
    difference = np.abs(0.5 * (x + y - a - b).mean((0, 1)))
    assert (scale > 0).all()
    assert (difference < TOLERANCE * scale + 4.5 * spread).all(), (difference / scale, spread)
    return images[0][0]


def camera(scenes, **film) -> dict:
    sensor = scenes.description({}, None, SIZE)["sensor"]
    return sensor | {"film": sensor["film"] | film}


# Films


@pytest.mark.parametrize("layers", [{}, {"filter": "bilateral"}], ids=["plain", "filtered"])
def test_pixel_formats(scenes, layers):
    """Each pixel format of hdrfilm has the same channel means as with volpath."""
    formats = ("rgb", "rgba", "xyz", "xyza", "luminance", "luminance_alpha")
    films = {f: camera(scenes, pixel_format=f) for f in formats}
    films["sensor"] = films.pop("rgb")
    pictures = [
        scenes.load(i, cloud(scenes), SIZE, **films, default_solver="path")
        for i in (ours(**layers), STOCK)
    ]
    for number in range(len(formats)):
        agree(pictures, sensor=number)


@pytest.mark.parametrize("rfilter", ["tent", "gaussian", "lanczos"])
def test_reconstruction_filters(scenes, rfilter):
    """Reconstruction filters agree with volpath on a crop window with border samples."""
    crop = {"crop_offset_x": 2, "crop_offset_y": 3, "crop_width": 7, "crop_height": 6}
    film = {"rfilter": {"type": rfilter}, "sample_border": True, **crop}
    assert agree(pair(scenes, sensor=camera(scenes, **film))).shape == (6, 7, 3)


@pytest.mark.parametrize("sampler", ["stratified", "multijitter"])
def test_samplers(scenes, sampler):
    sensor = camera(scenes) | {"sampler": {"type": sampler, "sample_count": 16}}
    agree(pair(scenes, sensor=sensor), spp=(16, 256))


# Sensors


def test_cameras(scenes):
    """Several sensors share one cache: thin lens, orthographic, with a shutter, and a batch."""
    plain = camera(scenes)
    wide = plain["film"] | {"width": 2 * SIZE}
    zoom = plain["to_world"] @ mi.ScalarTransform4f().scale([1.7, 1.7, 1])
    lens = plain | {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 5.0}
    both = pair(
        scenes,
        lens=lens,
        orthographic={"type": "orthographic", "to_world": zoom, "film": plain["film"]},
        shutter=plain | {"shutter_open": 0.1, "shutter_close": 0.6},
        batch={"type": "batch", "film": wide, "a": plain, "b": plain | {"fov": 50.0}},
    )
    for number in range(5):
        agree(both, sensor=number)
    assert both[0].integrator().cache.samples == 64


@pytest.mark.parametrize("far", [3.0, 4.3, 100.0])
def test_far_planes(scenes, far):
    """Media whose boundary is beyond the far plane are not visible, as with volpath."""
    cube = scenes.boundary(scenes.medium(1.0, 0.5))
    settings = {"type": "irrcache", "resolution": 12, "solver": "sweep"}
    sensor = {
        "type": "perspective", "fov": 20, "far_clip": far,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
    }  # fmt: skip
    sensor, means = mi.load_dict(sensor), []
    for integrator, spp in ((settings, 64), ({"type": "volpath"}, 4096)):
        scene = scenes.load(integrator, cube, 8)
        means.append(np.array(mi.render(scene, sensor=sensor, spp=spp))[..., :3].mean())
    assert means[0] == pytest.approx(means[1], rel=0.01)


@pytest.mark.parametrize("has_ground", [False, True])
@pytest.mark.parametrize(("far", "is_warned"), [(0.5, True), (1.2, True), (6.0, False)])
def test_far_planes_of_sensors_in_a_medium(scenes, logged, has_ground, far, is_warned):
    """Rays that end at the far plane before they leave the medium see nothing behind it, as with
    volpath: neither medium, nor surfaces, nor an environment. They did: a haze in metres that is
    larger than 10 km, the default far plane, was 2.7 times too bright.
    """
    cube = scenes.boundary(scenes.medium(1.0, 0.5) | {"id": "fog"})
    objects = {"cube": cube, "sky": {"type": "constant"}}
    if has_ground:
        place = mi.ScalarTransform4f().translate([0, -1.5, 0]).rotate([1, 0, 0], -90).scale(4)
        objects["ground"] = {"type": "rectangle", "to_world": place}
    sensor = {
        "type": "perspective", "fov": 70, "far_clip": far, "near_clip": 0.01,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0.5], [0, -0.3, -1], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        "medium": {"type": "ref", "id": "fog"},
    }  # fmt: skip
    settings = {"type": "irrcache", "resolution": 16, "solver": "sweep"}
    means = []
    for integrator, spp in ((settings, 64), ({"type": "volpath", "max_depth": 2}, 4096)):
        scene = mi.load_dict(
            {"type": "scene", "integrator": integrator | {"max_depth": 2}, **objects}
            | {"sensor": sensor},
            optimize=False,
        )
        image = np.array(mi.render(scene, spp=spp))[..., :3]
        means.append(np.array([image[:4].mean(), image[4:].mean()]))
    np.testing.assert_allclose(means[0], means[1], rtol=0.02)
    assert any("far plane" in message for message in logged) == is_warned


def test_the_warning_of_a_far_plane_names_one_that_suffices(scenes, logged):
    """Also where rays begin at a near plane that is far away."""
    sensor = {
        "type": "perspective",
        "fov": 20,
        "near_clip": 2.5,
        "far_clip": 3.0,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 8, "height": 8},
    }
    settings = {"type": "irrcache", "solver": "sweep", "resolution": 8}
    scene = scenes.description(settings, scenes.boundary(scenes.medium(1.0, 0.5)))
    mi.render(mi.load_dict(scene | {"sensor": sensor}), spp=1)
    (warning,) = (message for message in logged if "far plane" in message)
    sensor["far_clip"] = 1.001 * float(warning.rsplit("more than ", 1)[1].rstrip("."))
    assert sensor["far_clip"] == pytest.approx(4, rel=0.01)
    logged.clear()
    mi.render(mi.load_dict(scene | {"sensor": sensor}), spp=1)
    assert not any("far plane" in message for message in logged)


def test_radiance_and_irradiance_meters(scenes):
    """Radiance and irradiance meters agree with volpath.

    A radiance meter has the noise of few voxels, since it measures along a single ray.
    """
    film = camera(scenes, width=4, height=4)["film"]
    target = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.4)}
    patch = mi.ScalarTransform4f().look_at([0.3, 0, -3.0], [0, 0, 0], [0, 1, 0])
    one = camera(scenes, width=1, height=1)["film"]
    sensors = {
        "ray": {
            "type": "radiancemeter", "origin": [1, 1.5, -5], "direction": [-1, -1.4, 5],
            "film": one,
        },
        "parallel": {"type": "distant", "direction": [-0.2, -0.3, 1], "film": one},
        "target": {
            "type": "distant", "direction": [-0.2, -0.3, 1], "film": one, "target": target,
        },
    }  # fmt: skip
    both = pair(scenes, settings={"resolution": 32, "cache_spp": 256}, **sensors)
    for number in (1, 2, 3):
        agree(both, (2048, 32768), sensor=number)
    meter = {"type": "rectangle", "to_world": patch}
    meter["sensor"] = {"type": "irradiancemeter", "film": film}
    agree(pair(scenes, meter=meter), (64, 1024), sensor=1)


# Wrappers


def test_in_aov_and_moment(scenes):
    """Nested in ``aov`` and ``moment``, the channels agree with those of volpath.

    The second moments differ: they are of irrcache's own samples, which have less noise.
    """

    def aov(inner):
        return {"type": "aov", "aovs": "z:depth", "first": inner, "second": dict(inner)}

    film = camera(scenes, pixel_format="rgba")
    agree(pair(scenes, aov, sensor=film))
    both = pair(scenes, lambda inner: {"type": "moment", "inner": inner})
    picture = agree(both, channels=6)
    mean, square = picture[..., 3:6], picture[..., 6:9]
    assert (square > 0.999 * mean**2).all()


# Cancellation


def slow(scenes, **settings) -> mi.Scene:
    """Return a scene that renders for half a minute."""
    return scenes.load(
        ours(solver="path", resolution=32, cache_spp=4096) | settings,
        cloud(scenes),
        default_solver="path",
    )


def test_cancelled_while_the_cache_is_built(scenes):
    """``cancel`` from another thread stops the cache build; the next image continues from there.

    The image shows the incomplete cache.
    """
    scene = slow(scenes)
    integrator, seen = scene.integrator(), []

    def progress(stage, done, total):
        seen.append(done)
        if len(seen) == 2:
            thread = threading.Thread(target=integrator.cancel)
            thread.start()
            thread.join()

    integrator.progress = progress
    picture = scenes.image(scene, spp=4)
    assert len(seen) == 2 and 0 < integrator.cache.samples < 4096
    assert integrator.should_stop() and picture.mean() > 0.3
    samples = integrator.cache.samples
    seen.clear()
    scenes.image(scene, spp=4)
    assert samples < integrator.cache.samples < 4096


def test_cancelled_while_the_image_is_rendered(scenes, monkeypatch):
    """``cancel`` stops after the current pass, as in volpath, and does not affect later
    renderings.
    """
    from mitsuba_irrcache.render import film as rendering

    monkeypatch.setattr(rendering, "LANES", SIZE**2 * 4)
    scene, passes = scenes.load(ours(), cloud(scenes), SIZE, default_solver="path"), []
    integrator = scene.integrator()
    sampled = rendering._sampled

    def counted(*args):
        passes.append(args)
        if len(passes) == 2:
            integrator.cancel()
        return sampled(*args)

    monkeypatch.setattr(rendering, "_sampled", counted)
    stopped = scenes.image(scene, spp=32)
    assert len(passes) == 2
    whole = scenes.image(scene, spp=32)
    assert len(passes) == 2 + 8 and not integrator.should_stop()
    assert abs(stopped.mean() - whole.mean()) < 0.02 * whole.mean()


def test_timeout(scenes):
    scene = slow(scenes, timeout=0.01)
    assert scenes.image(scene, spp=4).mean() > 0.3
    assert 0 < scene.integrator().cache.samples < 4096
    empty = scenes.load(ours(timeout=0.01), None, SIZE, default_solver="path")
    assert scenes.image(empty, spp=4).mean() > 0.3


def test_a_progressive_run_is_cancelled(scenes):
    scene = slow(scenes)
    frames = []
    for frame in render_progressive(scene, spp=1, cache_spp=4096):
        frames.append(frame)
        scene.integrator().cancel()
    assert len(frames) == 1 and scene.integrator().cache.samples < 4096


# Arguments


def test_seeds_and_samples(scenes):
    """Equal seeds of any type give equal images; spp defaults to the sampler's, which is not
    changed.
    """
    sampler = {"type": "independent", "sample_count": 6}
    scene = scenes.load(
        ours(),
        cloud(scenes),
        SIZE,
        sensor=camera(scenes) | {"sampler": sampler},
        default_solver="path",
    )
    first = scenes.image(scene, spp=6, seed=3)
    for options in ({"spp": 6, "seed": mi.UInt32(3)}, {"seed": 3}, {"seed": 3, "sensor": 0}):
        np.testing.assert_array_equal(scenes.image(scene, **options), first)
    assert (scenes.image(scene, spp=6, seed=4) != first).any()
    assert np.isfinite(scenes.image(scene, spp=5, seed=2**32 - 1)).all()
    scenes.image(scene, spp=9)
    assert scene.sensors()[0].sampler().sample_count() == 6


def test_develop_and_evaluate_arguments(scenes):
    scene = scenes.load(ours(), cloud(scenes), SIZE, default_solver="path")
    integrator = scene.integrator()
    expected = scenes.image(scene, spp=4)
    assert np.array(integrator.render(scene, 0, spp=4, develop=False)).size == 0
    np.testing.assert_array_equal(np.array(scene.sensors()[0].film().develop()), expected)
    lazy = integrator.render(scene, scene.sensors()[0], spp=4, evaluate=False)
    assert lazy.state != dr.VarState.Evaluated
    np.testing.assert_array_equal(np.array(lazy), expected)


def test_separately_loaded_integrator_and_sensor(scenes):
    scene = scenes.load(STOCK, cloud(scenes), SIZE)
    integrator, sensor = mi.load_dict(ours()), mi.load_dict(camera(scenes))
    found = scenes.image(scene, sensor=sensor, integrator=integrator, spp=4)
    np.testing.assert_array_equal(found, scenes.image(scene, integrator=integrator, spp=4))


def test_to_string(scenes):
    """to_string lists the user's settings in Mitsuba's format, also as part of the scene's
    string.
    """
    text = str(mi.load_dict(ours(aovs="far:depth,noise", step=0.5)))
    assert text.startswith("IrradianceCachingIntegrator[\n  max_depth = 3,") and text.endswith("]")
    assert "aovs = far:depth, noise:noise," in text and "step = 0.5," in text
    assert "IrradianceCachingIntegrator[" in str(
        scenes.load(ours(), cloud(scenes), default_solver="path")
    )


# Parameters and gradients


def test_parameters_without_gradients(scenes):
    scene = scenes.load(ours(), cloud(scenes), SIZE, default_solver="path")
    expected = scenes.image(scene, spp=4)
    params = mi.traverse(scene)
    np.testing.assert_array_equal(scenes.image(scene, params=params, spp=4), expected)
    assert not mi.traverse(scene.integrator()).keys()


KEYS = ("sigma_t.data", "albedo.value.value", "sun.irradiance.value", "reflectance.value")


@pytest.mark.parametrize("wrapped", [False, True], ids=["simple", "surfaces, in aov"])
def test_gradients_are_refused(scenes, wrapped):
    """Scenes with gradients render, but differentiating the image with the solver `path` raises an
    error that names prbvolpath.
    """
    ball = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "diffuse"}} if wrapped else None
    integrator = ours(solver="path", resolution=8, cache_spp=16)
    if wrapped:
        integrator = {"type": "aov", "aovs": "z:depth", "inner": integrator}
    scene = scenes.load(integrator, cloud(scenes), SIZE, ball=ball, default_solver="path")
    expected = scenes.image(scene, spp=2)
    params = mi.traverse(scene)
    for key in (k for k in params.keys() if k.endswith(KEYS)):
        dr.enable_grad(params[key])
    params.update()
    np.testing.assert_allclose(scenes.image(scene, spp=2), expected, rtol=1e-4, atol=1e-5)
    with pytest.raises(IrrcacheError, match="prbvolpath"):
        dr.backward(dr.mean(mi.render(scene, params, spp=2)))
    with pytest.raises(IrrcacheError, match="prbvolpath"):
        dr.forward_to(mi.render(scene, params, spp=2))
