"""AOVs, error estimates and the filter of whole images, rendered through the plugin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from mitsuba_irrcache.render import denoise
from mitsuba_irrcache.render.aovs import AOVS, LEAST_COLOUR

pytestmark = pytest.mark.usefixtures("rgb")

ALL = ",".join(AOVS)
SKY = {"type": "constant", "radiance": 1.0}
#: A dark sky with a small bright window, whose irradiance is noisy in the cache.
WINDOW = np.full((8, 16, 3), 0.02, np.float32)
WINDOW[2:4, 5:7] = 12.0


def layered(scene: mi.Scene, **options) -> dict[str, np.ndarray]:
    """Return the image and its AOVs by name; float64."""
    values = np.array(mi.render(scene, **options), dtype=np.float64)
    names = [field.name for field in scene.sensors()[0].film().bitmap().struct_()]
    assert len(names) == values.shape[2]
    found: dict[str, list] = {}
    for i, name in enumerate(names):
        group = "image" if name in "RGBAY" else name.rpartition(".")[0]
        found.setdefault(group, []).append(values[..., i])
    return {name: np.stack(planes, axis=-1) for name, planes in found.items()}


def luminance(image: np.ndarray) -> np.ndarray:
    return image[..., :3] @ [0.212671, 0.715160, 0.072169]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def film_of(scenes, size: int, **properties) -> dict:
    return scenes.description({}, None, size)["sensor"]["film"] | properties


def facing(scenes, size: int = 16, half: float = 0.8, **properties) -> dict:
    """Return an orthographic sensor that looks along +z at the square |x|, |y| < ``half``."""
    look = mi.ScalarTransform4f().look_at([0, 0, -3], [0, 0, 0], [0, 1, 0])
    film = film_of(scenes, size, **properties)
    return {"type": "orthographic", "to_world": look.scale(half), "film": film}


def cloud(scenes, albedo=0.9, **properties) -> dict:
    to_world = scenes.placement(turn=20)
    sigma_t = scenes.texture((6, 5, 7), 0.3, 3.0, 1)
    return scenes.boundary(scenes.medium(sigma_t, albedo, to_world, **properties), to_world)


def noisy(scenes, settings: dict, **objects) -> mi.Scene:
    """Return a cloud under a small bright window: some 30 % of noise in a voxel at 16 samples."""
    integrator = {"type": "irrcache", "max_depth": 3, "resolution": 16} | settings
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(WINDOW)}
    objects = {"emitter": emitter, "size": 24} | objects
    return scenes.load(integrator, cloud(scenes), **objects, default_solver="path")


# Image and AOVs


@pytest.mark.parametrize("pixel_format", ["rgba", "luminance"])
def test_aovs_do_not_change_the_image(scenes, pixel_format):
    """AOVs leave the image unchanged to float32 rounding, including its format and alpha.

    It would change if AOVs consumed random numbers of the ray march, or were added to the film
    twice.
    """
    sensor = scenes.description({}, None, 12)["sensor"]
    sensor["film"] = film_of(
        scenes, 12, pixel_format=pixel_format, rfilter={"type": "gaussian"}, crop_width=9
    )
    images = []
    for aovs in ("", ALL):
        settings = {"type": "irrcache", "resolution": 8, "cache_spp": 16, "aovs": aovs}
        scene = scenes.load(
            settings | {"hide_emitters": True}, cloud(scenes), sensor=sensor, default_solver="path"
        )
        images.append(scenes.image(scene, spp=8, seed=3))
    channels = images[0].shape[2]
    assert images[1].shape[2] == channels + sum(map(len, AOVS.values()))
    assert images[0].mean() > 0.05
    np.testing.assert_allclose(images[1][..., :channels], images[0], rtol=1e-5, atol=1e-6)


def sorted_slab(scenes, albedo, **film) -> mi.Scene:
    """Return a slab and a sensor on the side of the emitter, where the irradiance decays with
    depth.
    """
    to_world = scenes.placement((2.0, 2.0, 1.0))
    sigma_t = scenes.texture((8, 6, 6), 1.0, 3.0, 3)
    settings = {"max_depth": 2, "resolution": 16, "cache_spp": 16, "aovs": ALL}
    return scenes.load(
        {"type": "irrcache", "solver": "path"} | settings,
        scenes.boundary(scenes.medium(sigma_t, albedo, to_world), to_world),
        sensor=facing(scenes, 12, 1.3, **film),
        emitter={"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.4]}},
        sun={"type": "directional", "direction": [0.0, 0.2, 1.0], "irradiance": 4.0},
    )


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "lanczos"])
def test_colour_times_illumination_plus_background_is_the_image(scenes, rfilter):
    """Colour times illumination plus background is the image to float32 rounding, for any film
    filter.

    The albedo increases along the ray while the irradiance decreases, so that a product of separate
    averages of both would be more than 20 % too bright.

    Only where negative lobes cancel the colour (some pixels of Lanczos around the medium), there is
    no illumination, and the scattered radiance is in the image alone.
    """
    rising = np.linspace(0.05, 0.95, 8)[:, None, None, None] * np.ones((8, 6, 6, 3)) * [1, 0.7, 0.4]
    film = {"rfilter": {"type": rfilter}}
    found = layered(sorted_slab(scenes, rising, **film), spp=16)
    product = found["colour"] * found["illumination"]
    shown = product + found["background"]
    usable = (found["colour"] > LEAST_COLOUR) | (found["colour"] == 0)
    assert usable.all() if rfilter != "lanczos" else usable[2:-2, 2:-2].all()
    np.testing.assert_allclose(shown[usable], found["image"][usable], 2e-5, 2e-6)
    white = layered(sorted_slab(scenes, 1.0, **film), spp=16)
    light = white["colour"] * white["illumination"] / np.maximum(1 - white["transmittance"], 1e-3)
    inner = np.s_[4:8, 4:8]
    assert (found["colour"] * light)[inner].mean() > 1.2 * product[inner].mean()


def test_aov_channel_names(scenes):
    """AOV channels follow the film's own ones in the requested order, with the user's names."""
    sensor = scenes.description({}, None, 6)["sensor"]
    sensor["film"] = film_of(scenes, 6, pixel_format="rgba")
    settings = {"resolution": 4, "cache_spp": 16, "aovs": "far:depth, light:illumination, noise"}
    scene = scenes.load(
        {"type": "irrcache", "solver": "path"} | settings, cloud(scenes), sensor=sensor
    )
    mi.render(scene, spp=1)
    names = [field.name for field in scene.sensors()[0].film().bitmap().struct_()]
    further = ["far.T", "light.R", "light.G", "light.B", "noise.Y"]
    assert names == ["R", "G", "B", "A", *further]
    assert scene.integrator().aov_names() == further


def test_wrapped_like_a_stock_integrator(scenes):
    """Nested in ``aov``, the AOVs and their values are the same as without the wrapper.

    As with a nested volpath, the channels follow those of the inner image.
    """
    names, values = {}, {}
    ours = {"type": "irrcache", "solver": "path", "resolution": 8, "cache_spp": 16}
    ours |= {"aovs": "far:depth,c:colour"}
    for kind, inner in (("volpath", {"type": "volpath"}), ("irrcache", ours)):
        inner |= {"max_depth": 2}
        scene = scenes.load({"type": "aov", "aovs": "z:depth", "inner": inner}, cloud(scenes), 8)
        assert np.isfinite(scenes.image(scene, spp=1024)).all()
        bitmap = scene.sensors()[0].film().bitmap()
        names[kind], values[kind] = [f.name for f in bitmap.struct_()], np.array(bitmap)
    further = [f"inner.{name}" for name in ("far.T", "c.R", "c.G", "c.B")]
    after = names["volpath"].index("z.T")
    assert names["irrcache"] == names["volpath"][:after] + further + names["volpath"][after:]
    outside = layered(
        scenes.load(ours | {"max_depth": 2}, cloud(scenes), 8, default_solver="path"), spp=1024
    )
    for wrapped, expected in ((0, outside["image"]), (after + 1, outside["c"])):
        inside = values["irrcache"][..., wrapped : wrapped + 3]
        assert np.abs(inside - expected).mean() < 0.02 * expected.mean()


# Depth and transmittance


def test_depth_of_a_thin_dense_slab(scenes):
    """The depth of a thin dense sheet is that of its front side, to half a voxel; beside it it
    is 0.

    The sheet is 0.1 thick, lies 3.45 in front of the sensor and has an optical depth of 5.
    """
    to_world = scenes.placement((2.0, 2.0, 2.0))
    sigma_t = np.zeros((20, 4, 4), np.float32)
    sigma_t[14] = 50.0
    settings = {"max_depth": 2, "resolution": 20, "cache_spp": 16, "aovs": ALL, "step": 0.25}
    shape = scenes.boundary(scenes.medium(sigma_t, 0.8, to_world), to_world)
    scene = scenes.load(
        {"type": "irrcache", "solver": "path"} | settings, shape, sensor=facing(scenes, 8, 1.5)
    )
    depth = layered(scene, spp=16)["depth"][..., 0]
    assert np.abs(depth[2:-2, 2:-2] - 3.4).max() < 0.03
    assert not depth[0].any() and not depth[:, -1].any()


@pytest.mark.parametrize("kind", ["homogeneous", "heterogeneous"])
def test_transmittance_is_beer_lambert(scenes, kind):
    """Transmittance is exp(-sigma_t d) per channel and colour is albedo (1 - T).

    Beside the medium they are 1 and 0.
    """
    sigma_t, albedo = np.array([0.3, 1.0, 4.0]), np.array([0.9, 0.5, 0.2])
    values = sigma_t if kind == "homogeneous" else sigma_t * np.ones((4, 4, 4, 3))
    to_world = scenes.placement((2.0, 2.0, 1.5))
    settings = {"max_depth": 2, "resolution": 8, "cache_spp": 16, "aovs": ALL}
    shape = scenes.boundary(scenes.medium(values, albedo, to_world), to_world)
    scene = scenes.load(
        {"type": "irrcache", "solver": "path"} | settings, shape, sensor=facing(scenes, 8, 1.5)
    )
    found = layered(scene, spp=4)
    inside, clear = np.s_[2:-2, 2:-2], np.exp(-1.5 * sigma_t)
    expected = np.broadcast_to(clear, (4, 4, 3))
    np.testing.assert_allclose(found["transmittance"][inside], expected, rtol=2e-4)
    expected = np.broadcast_to(albedo * (1 - clear), (4, 4, 3))
    np.testing.assert_allclose(found["colour"][inside], expected, rtol=2e-3)
    assert (found["transmittance"][0] == 1).all() and not found["colour"][0].any()


# Errors


@pytest.mark.parametrize("border", ["soft", "hard"])
def test_noise_is_the_scatter_of_caches(scenes, border):
    """``noise`` is the standard deviation over images of 24 cache seeds with equal camera
    samples.

    The root mean squares of both agree within 10 % (each known to some 2 %) with the medium in the
    middle of its grid; within 15 % if its faces cut the grid, since the noise of extrapolated
    values is an approximation.

    A single probe for all voxels, or signs that are not independent, would change it by 17 % and
    more; errors of layers or channels added wrongly by 20 % and more.
    """
    to_world = scenes.placement(turn=20)
    sigma_t = scenes.texture((9, 9, 9), 1.0, 3.0, 1)
    if border == "soft":
        sigma_t[[0, 1, -2, -1]] = sigma_t[:, [0, 1, -2, -1]] = sigma_t[..., [0, 1, -2, -1]] = 0
    shape = scenes.boundary(scenes.medium(sigma_t, 0.9, to_world), to_world)
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(WINDOW)}
    settings = {"type": "irrcache", "max_depth": 3, "resolution": 14, "cache_spp": 32}
    images, noise = [], []
    for seed in range(24):
        integrator = settings | {"cache_seed": seed, "aovs": "noise"}
        found = layered(
            scenes.load(integrator, shape, 20, emitter=emitter, default_solver="path"), spp=4
        )
        images.append(luminance(found["image"]))
        noise.append(found["noise"][..., 0])
    scatter = np.sqrt(np.var(images, axis=0, ddof=1).mean())
    assert scatter > 0.005 * np.mean(images)
    assert rms(np.array(noise)) == pytest.approx(scatter, rel=0.1 if border == "soft" else 0.15)


def soft_ball(scenes, resolution: int, samples: int) -> dict[str, np.ndarray]:
    """Return a Gaussian sphere in the sun, with smooth irradiance: the cache's noise is 0.03 %."""
    c = np.linspace(-1, 1, 24)
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    to_world = scenes.placement()
    medium = scenes.medium(3 * np.exp(-4 * (x**2 + y**2 + z**2)), 0.9, to_world)
    settings = {"max_depth": 2, "resolution": resolution, "cache_spp": samples, "aovs": "bias"}
    settings["step"] = resolution / 36  # of equal length
    sun = {"type": "directional", "direction": [0.2, -1.0, 0.1], "irradiance": 4.0}
    shape = scenes.boundary(medium, to_world)
    return layered(
        scenes.load({"type": "irrcache", "solver": "path"} | settings, shape, 16, emitter=sun),
        spp=16,
    )


def test_bias_is_what_a_finer_cache_changes(scenes):
    """``bias`` predicts how a finer cache changes the image.

    Its mean at 8 and at 12 voxels an edge, against 36, is predicted with its sign and within a
    factor of 2 (measured: 0.64 and 1.1), and its pixels correlate.
    """
    exact = soft_ball(scenes, 36, 64)
    errors = []
    for resolution, samples in ((8, 1024), (12, 512)):
        found = soft_ball(scenes, resolution, samples)
        error, bias = luminance(found["image"] - exact["image"]), found["bias"][..., 0]
        assert 0.5 * error.mean() < bias.mean() < 2 * error.mean()
        assert np.corrcoef(error.ravel(), bias.ravel())[0, 1] > 0.7
        errors.append(error.mean())
    assert errors[0] > 2 * errors[1] > 0


# Filter


def test_filter_does_not_increase_the_error(scenes, tmp_path):
    """The filter does not increase the error of images with 16, 64 and 256 samples per voxel.

    The error against an image of 1024 samples a voxel is at most 8 % above the unfiltered one's,
    and below it at 16 samples on average over three caches (measured: 0.95). ``fixed`` doubles it
    at 256. Each cache is computed once and shared.
    """
    settings = {"cache_spp": 1024, "cache_seed": 9}
    truth = luminance(scenes.image(noisy(scenes, settings, size=48), spp=8))

    def error(kind: str, samples: int, seed: int) -> float:
        file = tmp_path / f"{samples} {seed}.cache"
        settings = {"cache_spp": samples, "cache_seed": seed, "cache_file": str(file)}
        settings |= {"filter": kind}
        return rms(luminance(scenes.image(noisy(scenes, settings, size=48), spp=8)) - truth)

    for samples in (16, 64, 256):
        seeds = range(3 if samples == 16 else 1)
        ratios = [
            error("bilateral", samples, seed) / error("none", samples, seed) for seed in seeds
        ]
        assert samples > 16 or np.mean(ratios) < 1
        assert max(ratios) < 1.08
    assert error("fixed", 256, 0) > 1.5 * error("none", 256, 0)


def test_a_cache_without_noise_is_not_filtered(scenes):
    """``bilateral`` leaves images of a noiseless cache unchanged; ``fixed`` does not.

    The cache of a sun in a homogeneous medium has no noise.
    """
    sun = {"type": "directional", "direction": [0.3, -1.0, 0.4], "irradiance": 4.0}
    shape = scenes.boundary(scenes.medium(2.0, 0.9), scenes.placement())
    images = {}
    for kind in ("none", "bilateral", "fixed"):
        settings = {"max_depth": 2, "resolution": 12, "cache_spp": 16, "filter": kind}
        scene = scenes.load(
            {"type": "irrcache", "solver": "path"} | settings, shape, 20, emitter=sun
        )
        images[kind] = scenes.image(scene, spp=4)
    np.testing.assert_allclose(images["bilateral"], images["none"], rtol=2e-6, atol=1e-7)
    assert np.abs(images["fixed"] - images["none"]).max() > 0.01 * images["none"].max()


def bone(scenes, settings: dict) -> np.ndarray:
    """Return the luminance of a bright dense rod along y in a dim soft medium."""
    to_world = scenes.placement()
    density, albedo = np.full((20, 4, 20), 0.1), np.full((20, 4, 20), 0.5)
    density[4:16, :, 8:12], albedo[4:16, :, 8:12] = 20.0, 0.95
    shape = scenes.boundary(scenes.medium(density, albedo, to_world), to_world)
    integrator = {"type": "irrcache", "max_depth": 2, "resolution": 16, "hide_emitters": True}
    window = np.full((8, 16, 3), 0.1, np.float32)
    window[1:3, ::4] = 20.0
    objects = {
        "sensor": facing(scenes, 64, 0.7),
        "emitter": {"type": "envmap", "bitmap": mi.Bitmap(window)},
    }
    return luminance(
        scenes.image(
            scenes.load(integrator | settings, shape, **objects, default_solver="path"), spp=16
        )
    )


def edge(profile: np.ndarray) -> tuple[float, float]:
    """Return position and 10 to 90 % width of the rod's edge in pixels."""
    low, high = np.median(profile[8:16]), np.median(profile[28:36])
    crossings = []
    for share in (0.1, 0.5, 0.9):
        level = low + share * (high - low)
        i = 8 + int(np.argmax(profile[8:] > level))
        crossings.append(i - (profile[i] - level) / (profile[i] - profile[i - 1]))
    return crossings[1], crossings[2] - crossings[0]


def test_filter_preserves_an_edge(scenes, monkeypatch):
    """Filtered images preserve the position and width of an edge.

    At 16 samples a voxel, with automatic and given strengths, the edge of the rod is within half a
    pixel of the converged image's, and at most one pixel wider. A Gaussian of the same radius adds
    2.7.
    """
    exact = bone(scenes, {"cache_spp": 256}).mean(axis=0)
    place, width = edge(exact)
    assert edge(gaussian_filter1d(exact, denoise.SPREAD))[1] > width + 2
    plain = bone(scenes, {"cache_spp": 16})
    for strength in (None, 1.0, 2.0):
        if strength is not None:
            monkeypatch.setattr(denoise, "_least_risk", lambda *args, s=strength: (1, s))
        image = bone(scenes, {"cache_spp": 16, "filter": "bilateral"})
        assert strength is None or rms(image - plain) > 0.01 * plain.mean(), "it does nothing"
        found = edge(image.mean(axis=0))
        assert found[0] == pytest.approx(place, abs=0.5)
        assert found[1] < width + 1


@pytest.mark.parametrize("kind", ["bilateral", "fixed"])
def test_few_samples_are_enough_for_an_error(scenes, refine_calls, kind):
    """A cache of 8 samples is one batch without an error estimate: 16 are taken if one is
    needed.
    """
    scenes.image(noisy(scenes, {"cache_spp": 8, "filter": kind}, size=6), spp=1)
    scenes.image(noisy(scenes, {"cache_spp": 8, "aovs": "noise"}, size=6), spp=1)
    assert refine_calls == [16 if kind == "bilateral" else 8, 16]


# Images with few valid pixels


def empty(scenes) -> dict:
    return scenes.boundary(scenes.medium(np.zeros((4, 4, 4), np.float32), 0.9), scenes.placement())


BARE = {
    "max_depth 0": ({"max_depth": 0}, cloud, {}),
    "max_depth 1": ({"max_depth": 1}, cloud, {}),
    "albedo 0": ({}, lambda scenes: cloud(scenes, 0.0), {}),
    "red albedo": ({}, lambda scenes: cloud(scenes, (0.9, 0.0, 0.0)), {}),
    "hidden": ({"hide_emitters": True}, cloud, {}),
    "no emitters": ({}, cloud, {"emitter": None}),
    "empty medium": ({}, empty, {}),
    "no medium": ({}, lambda scenes: None, {}),
    "beside the medium": ({}, lambda scenes: cloud(scenes, scale=0.0), {}),
}


@pytest.mark.parametrize("kind", ["none", "bilateral", "fixed"])
@pytest.mark.parametrize(("settings", "shape", "objects"), BARE.values(), ids=BARE)
def test_no_nan_beside_the_medium(scenes, kind, settings, shape, objects):
    """All layers are finite if all pixels lie beside the medium; the image is unchanged."""
    settings = {"max_depth": 2, "resolution": 6, "cache_spp": 16} | settings
    sensor = scenes.description({}, None, 8)["sensor"]
    sensor["film"] = film_of(scenes, 8, pixel_format="rgba")
    sensor["fov"] = 60.0
    objects = {"sensor": sensor} | objects
    plain = scenes.load({"type": "irrcache", "solver": "path"} | settings, shape(scenes), **objects)
    full = scenes.load(
        {"type": "irrcache", "solver": "path", "filter": kind, "aovs": ALL} | settings,
        shape(scenes),
        **objects,
    )
    found, expected = layered(full, spp=4), scenes.image(plain, spp=4)
    assert all(np.isfinite(values).all() for values in found.values())
    assert {name: v.shape[2] for name, v in found.items() if name != "image"} == {
        name: len(channels) for name, channels in AOVS.items()
    }
    if kind == "none":
        np.testing.assert_allclose(found["image"], expected, rtol=1e-5, atol=1e-6)
    product = found["colour"] * found["illumination"] + found["background"]
    if kind == "none":
        np.testing.assert_allclose(product, found["image"][..., :3], rtol=1e-4, atol=1e-6)


# Amount of work


def test_a_second_filtered_picture_compiles_nothing(scenes, kernels):
    """A second filtered image reuses all kernels.

    It has another seed and camera, and another number of pixels with the medium. Both the kernels
    of an image that is filtered and those of one without a gain by the filter are covered. (dr.mean
    embeds the number of pixels in a kernel.)
    """
    second = scenes.description({}, None, 24)["sensor"] | {"fov": 21.0}
    scene = noisy(scenes, {"cache_spp": 16, "filter": "bilateral", "aovs": ALL}, second=second)
    # By hash: whether a kernel is found on disk depends on earlier runs.
    first = {
        k["hash"]
        for seed in (0, 1)
        for k in kernels(lambda s=seed: scenes.image(scene, spp=2, seed=s))
    }
    for options in ({"seed": 2}, {"seed": 3}, {"sensor": 1}):
        history = kernels(lambda options=options: scenes.image(scene, spp=2, **options))
        assert history and {k["hash"] for k in history} <= first


def test_no_work_for_unused_filter_and_aovs(scenes, monkeypatch):
    """Without filter and AOVs, no errors and layers are computed and no film is developed for
    them.
    """
    from mitsuba_irrcache.imaging import image
    from mitsuba_irrcache.render import camera

    def forbidden(*args, **kwargs):
        raise AssertionError("not asked for")

    monkeypatch.setattr(camera, "uncertainty_of", forbidden)
    for name in ("planes", "fill_film", "filter_illumination", "Layers"):
        monkeypatch.setattr(image, name, forbidden)
    scene = noisy(scenes, {"cache_spp": 8}, size=6)
    assert scenes.image(scene, spp=1).shape == (6, 6, 3)
    assert scene.integrator()._source.latest.projection.channel_count == 0


def test_aovs_without_errors_compute_none(scenes, monkeypatch):
    """Colour alone requires no error estimate of the cache, and no second batch."""
    from mitsuba_irrcache.render import camera

    monkeypatch.setattr(camera, "uncertainty_of", None)
    scene = noisy(scenes, {"cache_spp": 8, "aovs": "colour,depth", "filter": "fixed"}, size=6)
    scenes.image(scene, spp=1)
    assert scene.integrator().cache.samples == 8
    projection = scene.integrator()._source.latest.projection
    assert projection.channel_count == 4 * dr.size_v(mi.Spectrum) + 2


def test_mono(mono, scenes):
    """In a monochromatic variant, filter and AOVs are consistent with the image."""
    scene = noisy(scenes, {"cache_spp": 16, "aovs": ALL}, size=8)
    found = layered(scene, spp=4)
    assert {name: v.shape[2] for name, v in found.items() if name != "image"} == {
        name: len(channels) for name, channels in AOVS.items()
    }
    product = found["colour"] * found["illumination"] + found["background"]
    np.testing.assert_allclose(product[..., :1], found["image"][..., :1], rtol=1e-5, atol=1e-7)
    filtered = scenes.image(noisy(scenes, {"cache_spp": 16, "filter": "bilateral"}, size=8), spp=4)
    assert np.isfinite(filtered).all()
    assert filtered.mean() == pytest.approx(found["image"][..., :1].mean(), rel=0.05)


# Regression tests


@pytest.mark.parametrize("settings", [{"max_depth": 1}, {"albedo": 0.0}])
def test_opacity_without_radiance(scenes, settings):
    """With hidden emitters and no scattering, alpha and transmittance are those of the medium."""
    albedo = settings.get("albedo", 0.9)
    settings = {"max_depth": 2} | {k: v for k, v in settings.items() if k != "albedo"}
    to_world = scenes.placement((2.0, 2.0, 1.5))
    shape = scenes.boundary(scenes.medium(np.ones((8, 8, 8)), albedo, to_world), to_world)
    settings |= {"resolution": 8, "cache_spp": 16, "hide_emitters": True, "aovs": "transmittance"}
    sensor = facing(scenes, 8, pixel_format="rgba")
    found = layered(
        scenes.load({"type": "irrcache", "solver": "path"} | settings, shape, sensor=sensor), spp=4
    )
    np.testing.assert_allclose(found["transmittance"], np.exp(-1.5), rtol=1e-3)
    np.testing.assert_allclose(found["image"][..., 3], 1 - np.exp(-1.5), rtol=1e-3)


def test_smallest_radiance_is_not_nan(scenes):
    """The smallest radiance, 1e-38 behind an optically thick box, gives no NaN."""
    sun = {"type": "directional", "direction": [0.0, 0.0, -1.0], "irradiance": 3.0}
    shape = scenes.boundary(scenes.medium(60.0, 0.9), scenes.placement())
    settings = {"type": "irrcache", "max_depth": 2, "resolution": 32, "cache_spp": 16}
    image = scenes.image(scenes.load(settings, shape, 8, emitter=sun, default_solver="path"), spp=4)
    assert np.isfinite(image).all()


def test_alpha_with_other_sample_counts_compiles_nothing(scenes, kernels):
    """Rendering alpha with other sample counts reuses the kernels of the image without alpha."""
    sensor = scenes.description({}, None, 8)["sensor"]
    sensor["film"] = film_of(scenes, 8, pixel_format="rgba")
    settings = {"type": "irrcache", "resolution": 8, "cache_spp": 8, "hide_emitters": True}
    scene = scenes.load(
        settings | {"max_depth": 2}, cloud(scenes), sensor=sensor, default_solver="path"
    )
    scene.integrator().prepare(scene)
    first, again = (kernels(lambda n=n: scenes.image(scene, spp=n)) for n in (7, 11))
    assert {k["hash"] for k in again} <= {k["hash"] for k in first}


def test_depth_in_one_step(scenes):
    """Depth is correct in one step through a homogeneous box of optical depth 20.

    The front is one mean free path deep; the exponential rule weights the ends of the step to 0.03.
    """
    shape = scenes.boundary(scenes.medium(10.0, 0.9), scenes.placement())
    settings = {"type": "irrcache", "max_depth": 1, "aovs": "depth"}
    found = layered(
        scenes.load(settings, shape, sensor=facing(scenes, 4), default_solver="path"), spp=1
    )
    np.testing.assert_allclose(found["depth"], 2.1, atol=0.06)
