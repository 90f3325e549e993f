"""Writing images to a film and reading them back."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

CROP = {"crop_offset_x": 2, "crop_offset_y": 3, "crop_width": 4, "crop_height": 2}
NAMES = ["noise.Y", "light.R", "light.G"]
LUMINANCE = np.array([0.212671, 0.715160, 0.072169])


def rendering():
    """Import the module, which requires a variant."""
    from mitsuba_irrcache.render import film as module

    return module


def film_of(pixel_format: str, **properties) -> mi.Film:
    return mi.load_dict(
        {
            "type": "hdrfilm",
            "width": 7,
            "height": 6,
            "pixel_format": pixel_format,
            "component_format": "float32",
            "rfilter": {"type": "gaussian"},
        }
        | properties
    )


def values(count: int, film: mi.Film) -> list[np.ndarray]:
    """Return a distinct number for each pixel and channel, row by row."""
    pixels = int(film.crop_size().x) * int(film.crop_size().y)
    rng = np.random.default_rng(1)
    return [rng.uniform(0.1, 2, pixels).astype(np.float32) for _ in range(count)]


def filled(film: mi.Film, image: list[np.ndarray], alpha, further: list[np.ndarray]) -> None:
    radiance = mi.Spectrum(*(mi.Float(c) for c in image))
    channels = {name: mi.Float(v) for name, v in zip(NAMES, further, strict=True)}
    rendering().fill_film(film, radiance, None if alpha is None else mi.Float(alpha), channels)


def expected_colour(image: list[np.ndarray], pixel_format: str) -> list[np.ndarray]:
    """Return the film's colour channels of an RGB image in this format."""
    return [LUMINANCE @ np.array(image)] if pixel_format.startswith("lum") else image


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba", "luminance", "luminance_alpha"])
@pytest.mark.parametrize("crop", [{}, CROP], ids=["whole", "crop"])
def test_film_round_trip(rgb, pixel_format, crop):
    """Images read from a film equal those written bit by bit, for every reconstruction filter.

    This covers colour, alpha and further channels: a misplaced weight channel, a transposition or a
    second reconstruction would be detected.
    """
    film = film_of(pixel_format, **crop)
    image, further = values(6, film)[:3], values(6, film)[3:]
    alpha = values(7, film)[6] if pixel_format.endswith(("rgba", "alpha")) else None
    filled(film, image, alpha, further)
    colour, found_alpha, found_further = rendering().planes(film, 3)
    for found, put in zip(colour, expected_colour(image, pixel_format), strict=True):
        np.testing.assert_allclose(np.array(found), put, rtol=2e-7 if len(colour) == 3 else 1e-6)
    assert (found_alpha is None) == (alpha is None)
    if alpha is not None:
        np.testing.assert_array_equal(np.array(found_alpha), alpha)
    np.testing.assert_array_equal(np.array([np.array(v) for v in found_further]), further)


def test_the_image_has_rows_and_columns(rgb):
    """The developed tensor is (height, width, channel), with x varying fastest."""
    film = film_of("rgb", **CROP)
    image, further = values(6, film)[:3], values(6, film)[3:]
    filled(film, image, None, further)
    tensor = np.array(film.develop())
    assert tensor.shape == (2, 4, 6)
    np.testing.assert_allclose(tensor, np.stack(image + further, -1).reshape(2, 4, 6), rtol=2e-7)


@pytest.mark.parametrize("pixel_format", ["rgba", "luminance", "luminance_alpha"])
def test_mono(mono, pixel_format):
    """In mono variants there is one luminance channel, and alpha only if the film has it."""
    film = film_of(pixel_format)
    image, further = values(1, film), values(4, film)[1:]
    has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
    filled(film, image, np.ones(42, np.float32) if has_alpha else None, further)
    colour, found_alpha, found_further = rendering().planes(film, 3)
    assert (found_alpha is not None) == has_alpha
    for channel in colour:
        np.testing.assert_allclose(np.array(channel), image[0], rtol=1e-6)
    np.testing.assert_array_equal(np.array([np.array(v) for v in found_further]), further)


def test_filling_replaces_an_image_and_its_channels(rgb):
    """Writing an image replaces all previous samples and channels of the film."""
    film = film_of("rgb")
    before = values(8, film)
    film.prepare([f"old.{i}" for i in range(5)])
    block = film.create_block()
    dr.eval(block.put(mi.Point2f(3.5, 3.5), [mi.Float(9)] * (4 + 5)))
    film.put_block(block)
    filled(film, before[:3], None, before[3:6])
    colour, _, further = rendering().planes(film, 3)
    np.testing.assert_allclose(np.array([np.array(c) for c in colour]), before[:3], rtol=2e-7)
    np.testing.assert_array_equal(np.array([np.array(c) for c in further]), before[3:6])
    assert [field.name for field in film.bitmap().struct_()] == ["R", "G", "B", *NAMES]


def test_literals_fill_the_image(rgb):
    """A literal, such as the alpha of a scene under a sky, is broadcast to all pixels."""
    film = film_of("rgba")
    rendering().fill_film(film, mi.Color3f(0.5), mi.Float(1), {"noise.Y": mi.Float(0.25)})
    tensor = np.array(film.develop())
    np.testing.assert_array_equal(tensor, np.broadcast_to([0.5, 0.5, 0.5, 1, 0.25], (6, 7, 5)))


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "lanczos"])
def test_further_channels_are_reconstructed_like_the_colour(rgb, rfilter):
    """Further channels are reconstructed exactly like the colour.

    A channel with the red radiance equals the image's red bit by bit, so that layers add up.
    """
    film = film_of("rgba", rfilter={"type": rfilter})
    sensor = mi.load_dict({"type": "perspective", "film": film, "sampler": {"type": "independent"}})

    def radiance(sampler, ray, weight, active):
        red = sampler.next_1d()
        return mi.Color3f(red, 1, 2) * weight, mi.Float(1), [red, red * red]

    rendering().render_film(sensor, radiance, seed=1, spp=5, channels=["a", "b"])
    colour, alpha, (same, other) = rendering().planes(sensor.film(), 2)
    np.testing.assert_array_equal(np.array(colour[0]), np.array(same))
    assert np.abs(np.array(other) - np.array(same)).max() > 0.05
    np.testing.assert_allclose(np.array(alpha), 1, rtol=1e-5)
    np.testing.assert_allclose(np.array(colour[2]), 2, rtol=1e-5)


def positions(spp: int, seed: int = 3, pixels: int = 4096) -> np.ndarray:
    """Return positions within pixels, (sample, pixel, axis)."""
    sampler = mi.load_dict({"type": "independent"})
    spread = rendering().PixelPositions(sampler, seed, spp)
    lane = dr.arange(mi.UInt32, pixels * spp)
    found = np.array(spread.next(lane // spp, lane % spp)).T
    return found.reshape(pixels, spp, 2).transpose(1, 0, 2)


@pytest.mark.parametrize("spp", [1, 2, 5, 16])
def test_samples_mirror_each_other(rgb, spp):
    """Samples are in pairs that are mirrored at the pixel centre; a single one lies there."""
    found = positions(spp)
    paired = spp - spp % 2
    np.testing.assert_allclose(found[0:paired:2] + found[1:paired:2], 1, atol=2e-7)
    if spp == 1:
        np.testing.assert_array_equal(found, 0.5)
    assert (found >= 0).all() and (found < 1).all()


def test_each_sample_of_a_pair_is_uniform(rgb):
    """Each sample of a pair is uniform over pixels and seeds, and differs between seeds.

    The moments agree within 4 standard errors.
    """
    for sample in positions(4):
        assert np.abs(sample.mean(axis=0) - 1 / 2).max() < 4 * np.sqrt(1 / 12 / 4096)
        assert np.abs((sample**2).mean(axis=0) - 1 / 3).max() < 4 * np.sqrt(4 / 45 / 4096)
    assert np.abs(positions(2, seed=3) - positions(2, seed=4)).mean() > 0.2


@pytest.mark.parametrize("count", [2, 3, 5])
def test_all_samples_of_a_pixel_are_uniformly_distributed(count):
    """So is the last one of an odd number: at the centre, it would bias the mean over seeds."""
    for sample in positions(count):
        assert np.abs((sample**2).mean(axis=0) - 1 / 3).max() < 4 * np.sqrt(4 / 45 / 4096)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 16, 37, 64])
def test_permuted_pairs_are_the_same_points(count):
    """A permuted order of pairs has the same points; each pair is symmetric about the centre."""
    from mitsuba_irrcache.render.film import AntitheticPairs

    sequence, number = AntitheticPairs(count), dr.arange(mi.UInt32, count)
    shifts = mi.UInt32(123456789), mi.UInt32(987654321)

    def points(permuted):
        words, is_second, is_paired = sequence.words(number, shifts, permuted)
        assert np.array(is_paired).sum() == count - count % 2
        assert (np.array(is_second) == (np.arange(count) % 2 == 1)).all()
        return np.array(words).T.astype(np.int64)

    plain, permuted = points(False), points(True)
    assert sorted(map(tuple, plain)) == sorted(map(tuple, permuted))
    for found in (plain, permuted):
        even = count - count % 2
        assert (found[0:even:2] + found[1:even:2] == 2**32 - 1).all()
    if count >= 16:
        assert (plain != permuted).any()


@pytest.mark.parametrize("filter_name", ["box", "gaussian"])
def test_refined_pixels_do_not_lose_rare_bright_samples(rgb, filter_name):
    """The mean of an image whose samples are rarely bright is right, although pixels with bright
    samples are refined: otherwise only those without any would remain as they are.
    """
    share, bright, dark, size = 1e-3, 100.0, 0.1, 128
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": filter_name}}
    sensor = mi.load_dict({"type": "perspective", "film": film})

    def radiance(sampler, ray, weight, active):
        value = dr.select(sampler.next_1d() < share, bright, mi.Float(dark))
        return mi.Spectrum(value), mi.Float(1), []

    rendered = rendering().render_film(sensor, radiance, seed=3, spp=16, refine=True)
    mean = np.array(rendered.develop())[..., :3].mean()
    expected = dark + share * (bright - dark)
    noise = (bright - dark) * np.sqrt(share / (16 * size**2))
    assert abs(mean - expected) < 4 * noise
    assert 4 * noise < 0.15 * expected


def test_new_samples_of_refined_pixels_depend_on_the_seed(rgb):
    """At an edge, images with different seeds have independent errors."""
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "film": film})

    def radiance(sampler, ray, weight, active):
        value = dr.select(ray.d.x > 0.3 * ray.d.y + 0.01, mi.Float(1), 0)
        return mi.Spectrum(value), mi.Float(1), []

    images = []
    for seed in range(4):
        rendered = rendering().render_film(sensor, radiance, seed, spp=16, refine=True)
        images.append(np.array(rendered.develop())[..., 0])
    images = np.array(images)
    edge = (images.min(axis=0) < 1) & (images.max(axis=0) > 0)
    assert edge.sum() > 30
    errors = (images - images.mean(axis=0))[:, edge]
    assert (np.ptp(images[:, edge], axis=0) > 0).mean() > 0.7
    assert np.abs(np.corrcoef(errors) + 1 / 3)[~np.eye(4, dtype=bool)].max() < 0.5


@pytest.mark.parametrize("scale", [0.0, 1e-30, 0.3, 1e15])
def test_images_without_noise_need_no_new_samples(rgb, scale):
    """Variances that consist of rounding errors end the choice of pixels, at any scale."""
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "film": film})

    def radiance(sampler, ray, weight, active):
        value = scale * (1 + ray.d.x * 1e-7)
        return mi.Spectrum(value), mi.Float(1), []

    rendered = rendering().render_film(sensor, radiance, seed=1, spp=16, refine=True)
    np.testing.assert_allclose(np.array(rendered.develop())[..., :3], scale, rtol=1e-5)
