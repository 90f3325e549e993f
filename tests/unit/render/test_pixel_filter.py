"""Reconstruction of pixels from samples without Mitsuba's image blocks."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

FILTERS = ["box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"]
CROP = {"crop_offset_x": 2, "crop_offset_y": 3, "crop_width": 4, "crop_height": 7}


def film_of(name: str, **properties) -> mi.Film:
    description = {"type": "hdrfilm", "width": 11, "height": 12, "pixel_format": "rgba"}
    description |= {"component_format": "float32", "rfilter": {"type": name}}
    return mi.load_dict(description | properties)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("crop", [{}, CROP, CROP | {"sample_border": True}], ids=str)
@pytest.mark.parametrize("per_pixel", [1, 3])
def test_sums_are_those_of_mitsuba(name, crop, per_pixel):
    """Sums for all of Mitsuba's filters agree within 1e-5 of the largest."""
    from mitsuba_irrcache.render.pixel_filter import reconstructed

    film = film_of(name, **crop)
    border = film.rfilter().border_size() if film.sample_border() else 0
    width, height = (int(n) + 2 * border for n in film.crop_size())
    rng = np.random.default_rng(7)
    corner = np.array(film.crop_offset(), int) - border
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2)
    places = (corner + pixels + rng.uniform(0.01, 0.99, (len(pixels), per_pixel, 2))).reshape(-1, 2)
    position = mi.Point2f(np.float32(places.T))
    values = [mi.Float(np.float32(rng.uniform(0.5, 2, len(places)))) for _ in range(6)]
    film.prepare(["more", "and.more"])
    block = film.create_block()
    block.set_offset(film.crop_offset())
    block.put(position, [*values[:4], mi.Float(1), *values[4:]])
    film.put_block(block)
    developed = np.array(film.develop())

    sums = reconstructed(film, border, per_pixel, position, values)
    assert len(sums) == 7 and all(dr.width(s) == np.prod(film.crop_size()) for s in sums)
    found = np.array([np.array(s) for s in sums], dtype=np.float64)
    means = (found[:6] / found[6]).T.reshape(*np.array(film.crop_size())[::-1], 6)
    colours = developed.shape[-1] - 2
    # GPUs approximate the sine of lanczos.
    tolerance = {"rtol": 1e-7 if mi.variant().startswith("llvm") else 3e-6, "atol": 1e-5}
    np.testing.assert_allclose(developed[..., :colours], means[..., :colours], **tolerance)
    np.testing.assert_allclose(developed[..., colours:], means[..., 4:], **tolerance)


@pytest.mark.parametrize("name", ["box", "gaussian", "lanczos"])
@pytest.mark.parametrize("crop", [{}, CROP | {"sample_border": True}], ids=str)
def test_further_samples_replace_halves_of_pixels(name, crop):
    """Samples given again as further ones, each twice, do not change the sums; others replace those
    of their half of a pixel.
    """
    from mitsuba_irrcache.render.pixel_filter import FurtherSamples, reconstructed

    film, per_pixel = film_of(name, **crop), 6
    border = film.rfilter().border_size() if film.sample_border() else 0
    width, height = (int(n) + 2 * border for n in film.crop_size())
    rng = np.random.default_rng(8)
    corner = np.array(film.crop_offset(), int) - border
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2)
    places = corner + pixels + rng.uniform(0.01, 0.99, (len(pixels), per_pixel, 2))
    values = rng.uniform(0.5, 2, (4, len(pixels), per_pixel))

    def of(array: np.ndarray) -> mi.Float:
        return mi.Float(np.float32(array.ravel()))

    def sums(places, values, further=None):
        position = mi.Point2f(of(places[..., 0]), of(places[..., 1]))
        found = reconstructed(film, border, per_pixel, position, [of(v) for v in values], further)
        return np.array([np.array(s) for s in found])

    halves = (2 * len(pixels), per_pixel // 2)
    chosen = np.sort(rng.choice(halves[0], len(pixels) // 2, replace=False))
    twice = np.repeat(places.reshape(*halves, 2)[chosen], 2, axis=1)
    position = mi.Point2f(of(twice[..., 0]), of(twice[..., 1]))
    again = [of(np.repeat(v.reshape(halves)[chosen], 2, axis=1)) for v in values]
    further = FurtherSamples(mi.UInt32(chosen), per_pixel, 2, position, again)

    expected = sums(places, values)
    np.testing.assert_allclose(sums(places, values, further), expected, atol=5e-5)
    other = values.copy()
    other.reshape(-1, *halves)[:, chosen] = 1e3
    np.testing.assert_allclose(sums(places, other, further), expected, atol=5e-5)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 12, 16, 30])
def test_cells_of_a_pixel(count):
    """Cells have the same area and are disjoint; together they are the pixel."""
    from mitsuba_irrcache.render.film import PixelCells

    cells, index = PixelCells(count), dr.arange(mi.UInt32, count)
    lower, upper = (np.array(cells.position(index, mi.Point2f(at))).T for at in (0, 1))
    np.testing.assert_allclose(np.prod(upper - lower, axis=1), 1 / count, rtol=1e-5)
    points = np.random.default_rng(9).random((5000, 1, 2))
    assert (((lower <= points) & (points < upper)).all(axis=-1).sum(axis=1) == 1).all()
