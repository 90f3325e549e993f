"""Display of radiance in PNGs: exposure, tone curves, background."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.io.display import TONES, Display, hex_of, linear_colour
from mitsuba_irrcache.io.images import read_image, write_image


@pytest.mark.parametrize("text", ["#0380ff", "#ffffff", "#000000"])
def test_colours_are_read_and_written(text):
    assert hex_of(linear_colour(text)) == text


def test_colours_have_names_of_css():
    assert linear_colour("White") == (1, 1, 1)
    assert hex_of(linear_colour("steelblue")) == "#4682b4"
    for text in ("blurple", "#12", "#12345g", ""):
        with pytest.raises(ValueError):
            linear_colour(text)


def test_transparent_pixels_show_the_background(tmp_path):
    """Exposure changes the image (premultiplied by alpha), and not what is behind it."""
    image = np.array([[[0.25, 0.125, 0.0, 0.5], [0, 0, 0, 0], [0.5, 0.5, 0.5, 1]]], np.float32)
    display = Display(exposure=1, background=(1.0, 0.5, 0.2))
    expected = [[1.0, 0.5, 0.1], [1, 0.5, 0.2], [1, 1, 1]]
    np.testing.assert_allclose(display.apply(image)[0], expected, atol=1e-6)
    assert display.apply(image[..., [0, 3]]).shape == (1, 3, 3)  # luminance and alpha
    write_image(tmp_path / "a.exr", image, {}, display=display)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), image)
    assert read_image(tmp_path / "a.png").shape == (1, 3, 3)
    write_image(tmp_path / "b.exr", image, {})
    assert read_image(tmp_path / "b.png").shape == (1, 3, 4)


@pytest.mark.parametrize("tone", TONES)
def test_tone_curves_grow_from_black(tone):
    values = TONES[tone](np.linspace(0, 8, 100))
    assert values[0] == 0 and (np.diff(values) > 0).all()
