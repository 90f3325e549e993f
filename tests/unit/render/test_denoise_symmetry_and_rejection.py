"""The illumination filter is symmetric in rows and columns, and is rejected where it cannot
help.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.render.aovs import Layers
from mitsuba_irrcache.render.denoise import STRIDES, bilateral, filter_illumination

pytestmark = pytest.mark.usefixtures("rgb")

HEIGHT, WIDTH = 30, 37


def flat(values: np.ndarray) -> mi.Float:
    return mi.Float(np.float32(values).ravel())


def layers_of(illumination: np.ndarray, probes: list[np.ndarray], colour: np.ndarray) -> Layers:
    """Return layers of grey images (y, x)."""
    seen = mi.Spectrum(flat(colour))
    nothing = mi.Spectrum(flat(np.zeros_like(colour)))
    errors = [flat(colour * probe) for probe in probes]
    scattered = mi.Spectrum(flat(illumination)) * seen
    return Layers(scattered, seen, nothing, nothing, nothing.x, errors, nothing.x)


@pytest.mark.parametrize("stride", STRIDES)
def test_rows_are_filtered_as_columns(stride):
    """Filtering commutes with transposition of the image, for all spacings of the taps."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = 1 + 0.3 * np.sin(0.5 * x + 0.2 * y) + 0.2 * rng.normal(size=(HEIGHT, WIDTH))
    error = rng.uniform(0.1, 0.3, (HEIGHT, WIDTH))

    def filtered(image: np.ndarray, error: np.ndarray) -> np.ndarray:
        packed = interleaved([flat(image)] * 3 + [flat(error)])
        dr.eval(packed)
        spacing, strength = dr.opaque(mi.Int32, stride), dr.opaque(mi.Float, 2.0)
        pixels = dr.arange(mi.UInt32, image.size)
        result = bilateral(packed, image.shape[::-1], pixels, 0, spacing, strength)
        return np.array(result.x).reshape(image.shape)

    plain = filtered(image, error)
    assert np.abs(plain - image).mean() > 0.05
    np.testing.assert_allclose(filtered(image.T, error.T).T, plain, rtol=1e-4)


def test_an_error_that_all_pixels_share_is_not_filtered():
    """An error that all pixels share is not filtered.

    Averages over pixels do not reduce it but blur the image: by Stein's unbiased risk estimate each
    filter is worse than none.
    """
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = 1 + 0.3 * np.sin(0.7 * x) * np.cos(0.6 * y) + rng.uniform(-0.1, 0.1, (HEIGHT, WIDTH))
    shared = [np.full((HEIGHT, WIDTH), 0.2)] * 4
    layers = layers_of(image, shared, np.ones((HEIGHT, WIDTH)))
    assert filter_illumination("bilateral", layers, (WIDTH, HEIGHT)) is None
    # Independent errors of the same size are filtered.
    own = [0.2 * rng.normal(size=(HEIGHT, WIDTH)) for _ in range(4)]
    layers = layers_of(image + own.pop(), [*own, own[0]], np.ones((HEIGHT, WIDTH)))
    assert filter_illumination("bilateral", layers, (WIDTH, HEIGHT)) is not None


def test_a_fixed_filter_does_not_depend_on_empty_pixels():
    """Adding empty pixels to an image does not change the paper's fixed filter.

    Pixels whose window reaches the border between both are excluded.
    """
    rng = np.random.default_rng(5)
    image = 1 + 0.3 * rng.normal(size=(HEIGHT, WIDTH))
    alone = layers_of(image, [], np.ones_like(image))
    beside = np.concatenate([image, np.ones_like(image)], axis=1)
    colour = np.concatenate([np.ones_like(image), np.zeros_like(image)], axis=1)
    wide = layers_of(beside, [], colour)
    results = [
        np.array(filter_illumination("fixed", layers, (width, HEIGHT)).x).reshape(HEIGHT, width)
        for layers, width in ((alone, WIDTH), (wide, 2 * WIDTH))
    ]
    np.testing.assert_allclose(results[1][:, :WIDTH], results[0], rtol=1e-5)
