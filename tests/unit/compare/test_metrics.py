"""Errors against a noisy reference, and errors of the tone-mapped image."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.compare import metrics, perceptual
from mitsuba_irrcache.compare.reference import Reference
from mitsuba_irrcache.compare.scores import METRICS, score

SHAPE = (128, 96, 3)


@pytest.fixture
def rng():
    return np.random.default_rng(1)


@pytest.fixture
def truth():
    x = np.linspace(0.1, 0.9, SHAPE[1])
    return np.broadcast_to(x[None, :, None], SHAPE).copy()


def halves(truth, rng, sigma=0.1):
    return [truth + rng.normal(0, sigma, SHAPE) for _ in range(2)]


def test_the_noise_of_the_reference_drops_out(truth, rng):
    """An error five times smaller than the reference's noise is estimated to a few percent."""
    a, b = halves(truth, rng)
    image = truth + rng.normal(0, 0.02, SHAPE)
    square, uncertainty = metrics.net_mse(image, a, b)
    assert abs(square - 0.02**2) < 4 * uncertainty
    assert uncertainty < 0.2 * 0.02**2
    naive = np.sqrt(np.mean((image - 0.5 * (a + b)) ** 2))
    assert naive > 3 * 0.02


def test_uncertainty_is_that_of_repetition(truth):
    """The stated standard error is the scatter over independent references."""
    estimates, stated = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        square, uncertainty = metrics.net_mse(truth, *halves(truth, rng))
        estimates.append(square)
        stated.append(uncertainty)
    assert np.std(estimates) == pytest.approx(np.mean(stated), rel=0.3)  # 3 sigma of 60 draws
    assert abs(np.mean(estimates)) < 4 * np.mean(stated) / np.sqrt(60)


def test_mean_error_with_correlated_noise(truth):
    """The uncertainty of the mean error accounts for noise correlated over 8 x 8 pixels."""
    errors, stated = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        blotches = np.kron(rng.normal(0, 0.05, (16, 12)), np.ones((8, 8)))[..., None]
        a, b = halves(truth, rng, 1e-6)
        errors.append(metrics.mean_error(truth + blotches, a, b))
        stated.append(metrics.mean_error_uncertainty(truth + blotches, a, b))
    assert np.std(errors) == pytest.approx(np.mean(stated), rel=0.4)


def test_block_error_measures_blotches(truth, rng):
    """A blotched error has a block error 8 times that of pixel noise with equal RMSE."""
    a, b = halves(truth, rng, 1e-6)
    fine = truth + rng.normal(0, 0.05, SHAPE)
    blotches = np.kron(rng.normal(0, 0.05, (16, 12)), np.ones((8, 8)))[..., None]
    assert metrics.block_error(fine, a, b) == pytest.approx(0.05 / 8, rel=0.2)
    assert metrics.block_error(truth + blotches, a, b) == pytest.approx(0.05, rel=0.2)
    assert np.isnan(metrics.block_error(fine[:4], a[:4], b[:4]))


def test_relative_mse_weighs_dark_pixels(truth):
    """An equal relative error everywhere gives its square, except in nearly black pixels."""
    assert metrics.relative_mse(1.1 * truth, truth, truth) == pytest.approx(0.01, rel=0.06)


def test_alpha_and_aovs_are_no_colours():
    for channels, expected in ((1, 1), (2, 1), (3, 3), (4, 3), (7, 3)):
        assert metrics.colours(np.zeros((2, 2, channels))).shape[-1] == expected


def test_display_is_srgb():
    """Display values follow IEC 61966-2-1, with clipping, exposure in stops, and repeated grey."""
    image = np.array([[[0.0], [0.214041], [1.0], [7.0]]])
    shown = perceptual.display(image)
    assert shown.shape == (1, 4, 3)
    np.testing.assert_allclose(shown[0, :, 1], [0, 0.5, 1, 1], atol=1e-5)
    np.testing.assert_allclose(perceptual.display(image, 1), perceptual.display(2 * image))


def test_ciede2000_of_known_colours():
    """Equal images differ by 0, white and black by 100."""
    white, black = np.ones((2, 2, 3)), np.zeros((2, 2, 3))
    assert perceptual.ciede2000(white, white) == pytest.approx(np.zeros((2, 2)), abs=1e-9)
    assert perceptual.ciede2000(white, black) == pytest.approx(np.full((2, 2), 100), abs=0.1)


def test_flip_orders_pictures(truth, rng):
    pytest.importorskip("flip_evaluator")
    near, far = (truth + rng.normal(0, s, SHAPE) for s in (0.02, 0.2))
    assert perceptual.flip(truth, truth) == 0
    assert 0 < perceptual.flip(near, truth) < perceptual.flip(far, truth) < 1


def test_openimageio_agrees_with_numpy(truth, rng):
    image = truth + rng.normal(0, 0.1, SHAPE)
    result = perceptual.openimageio(image, truth)
    assert result["oiio_rms"] == pytest.approx(np.sqrt(np.mean((image - truth) ** 2)), rel=1e-4)
    assert result["oiio_mean"] == pytest.approx(np.mean(np.abs(image - truth)), rel=1e-4)
    assert result["oiio_max"] == pytest.approx(np.abs(image - truth).max(), rel=1e-4)


def test_score_of_a_broken_image(truth, rng):
    """A pixel that is not finite is counted and spoils nothing else."""
    image = truth.copy()
    image[3, 4, 1] = np.nan
    result = score(image, Reference(*halves(truth, rng), 1, 1.0))
    assert result["invalid"] == pytest.approx(1 / truth.size)
    assert all(np.isfinite(result[name]) for name in METRICS if result[name] is not None)


def test_score_is_free_of_units(truth, rng):
    """Brighter light changes no error that is given in parts of the mean radiance."""
    a, b = halves(truth, rng)
    image = truth + rng.normal(0, 0.05, SHAPE)
    one = score(image, Reference(a, b, 1, 1.0))
    ten = score(10 * image, Reference(10 * a, 10 * b, 1, 1.0))
    for name in ("rmse", "bias", "block_rmse", "relative_mse", "rmse_resolved"):
        assert ten[name] == pytest.approx(one[name])
