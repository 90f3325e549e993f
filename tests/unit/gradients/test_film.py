"""The adjoint of the film is the transpose of rendering to it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.film import LANES, FilmAdjoint
from mitsuba_irrcache.render.film import render_film

pytestmark = pytest.mark.usefixtures("rgb")

FILMS = {
    "box": {},
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "gaussian, border": {"rfilter": {"type": "gaussian"}, "sample_border": True},
    "alpha": {"pixel_format": "rgba"},
    "luminance": {"pixel_format": "luminance"},
    "crop": {"crop_width": 5, "crop_height": 3, "crop_offset_x": 2, "crop_offset_y": 4},
}


def camera(**film) -> mi.Sensor:
    own = {"type": "hdrfilm", "width": 9, "height": 8, "component_format": "float32"}
    own |= {"rfilter": {"type": "box"}} | film
    return mi.load_dict({"type": "perspective", "fov": 40.0, "film": own})


def values_along(ray: mi.Ray3f) -> tuple[mi.Spectrum, mi.Float]:
    """A radiance and an alpha that vary from ray to ray."""
    d = ray.d
    return mi.Spectrum(1 + d.x, 2 - 3 * d.y, 0.5 + d.x * d.y), 0.5 + 0.3 * d.x


@pytest.mark.parametrize("name", FILMS)
def test_film_adjoint_is_the_transpose_of_the_film(name):
    sensor = camera(**FILMS[name])

    def radiance(sampler, ray, weight, active):
        colour, alpha = values_along(ray)
        return colour * weight, alpha, []

    image = np.array(render_film(sensor, radiance, 5, 6).develop(), dtype=np.float64)
    grad = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    total, scale = 0.0, np.abs(image * grad).sum()
    for each in FilmAdjoint(sensor, mi.TensorXf(grad), 5, 6).passes():
        colour, alpha = values_along(each.ray)
        part = dr.dot(each.radiance, colour)
        if each.alpha is not None:
            part += each.alpha * alpha
        total += float(np.array(part, dtype=np.float64).sum())
    assert total == pytest.approx((image * grad).sum(), abs=2e-6 * scale)


def test_passes_are_all_samples():
    """Samples in several launches, with a filter that reaches beyond pixels."""
    sensor = camera(**FILMS["gaussian"])
    grad = np.random.default_rng(1).normal(size=(8, 9, 3)).astype(np.float32)

    def total(lanes: int) -> tuple[int, float]:
        adjoint, found = FilmAdjoint(sensor, mi.TensorXf(grad), 5, 6, lanes), []
        for each in adjoint.passes():
            colour, _ = values_along(each.ray)
            found.append(float(np.array(dr.dot(each.radiance, colour), dtype=np.float64).sum()))
        return len(found), sum(found)

    one, expected = total(LANES)
    several, result = total(2 * 72)
    assert (one, several) == (1, 3)
    assert result == pytest.approx(expected, rel=1e-4)


def test_gradients_that_are_not_finite_name_the_pixel():
    grad = np.zeros((8, 9, 3), dtype=np.float32)
    grad[2, 4, 1] = np.nan
    with pytest.raises(IrrcacheError, match=r"nan at pixel \(4, 2\), channel 1"):
        FilmAdjoint(camera(), mi.TensorXf(grad), 0, 1)


def test_gradients_of_another_size_are_refused():
    with pytest.raises(IrrcacheError, match="2 x 2 pixels with 3 channels do not fit a film of 9"):
        FilmAdjoint(camera(), dr.zeros(mi.TensorXf, (2, 2, 3)), 0, 1)
