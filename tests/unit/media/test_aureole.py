"""The aureole against sums that are computed in another way."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.media.aureole import MAX_DEPTH, PEAK_MOMENTS, Aureole

pytestmark = pytest.mark.usefixtures("rgb")

ANGLES = np.linspace(0.01, 1.5, 40)


def peak_moments(g: float, order: int) -> tuple[np.ndarray, float]:
    """Return the moments of the peak of hg beyond ``order``, and its share."""
    moments = g ** np.arange(PEAK_MOMENTS)
    return np.minimum(moments / moments[order + 1], 1), moments[order + 1]


def series(moments: np.ndarray, angles: np.ndarray) -> np.ndarray:
    terms = (2 * np.arange(len(moments)) + 1) * moments
    return np.polynomial.legendre.legvander(np.cos(angles), len(moments) - 1) @ terms


def corrections(g: float, order: int, depth: float, variance: float | None = None) -> np.ndarray:
    moments, share = peak_moments(g, order)
    aureole = Aureole(moments, share / (1 - share))
    cosine = mi.Float(np.cos(ANGLES).astype(np.float32))
    blur = None if variance is None else mi.Float(variance)
    found = aureole.correction(cosine, dr.full(mi.Float, depth, len(ANGLES)), blur)
    return np.array(found) * (1 - share) / share


@pytest.mark.parametrize("depth", [0.3, 2.0, 9.0])
@pytest.mark.parametrize(("g", "order"), [(0.7, 4), (0.85, 6)])
def test_sum_over_numbers_of_scattering_events(g, order, depth):
    """The moments of n events are powers, weighted by a Poisson distribution; the first one without
    the correction counts n times.
    """
    moments, _ = peak_moments(g, order)
    several, probability = np.zeros(PEAK_MOMENTS), np.exp(-depth)
    for events in range(1, 80):
        probability *= depth / events
        several += probability * moments**events
    expected = series(several / depth - moments, ANGLES)
    peak = series(moments, ANGLES)
    np.testing.assert_allclose(
        corrections(g, order, depth), expected, atol=0.01 * np.abs(peak).max()
    )
    near = ANGLES < 0.3
    error = corrections(g, order, depth)[near] - expected[near]
    assert np.abs(error).max() < 0.01 * np.abs(peak[near]).mean()


def test_nothing_is_corrected_without_scattering():
    assert np.abs(corrections(0.85, 6, 0.0)).max() < 1e-3


def test_more_events_than_the_table_has():
    np.testing.assert_array_equal(
        corrections(0.85, 6, MAX_DEPTH), corrections(0.85, 6, 3 * MAX_DEPTH)
    )


def test_a_source_with_extent_is_blurred():
    """A degree l of a source with this variance of angles is attenuated by e^-l(l+1) v / 4."""
    depth, variance = 3.0, 0.04
    moments, _ = peak_moments(0.85, 6)
    degrees = np.arange(PEAK_MOMENTS)
    several = np.exp(-depth) * np.expm1(depth * moments) / depth
    blur = np.exp(-0.25 * degrees * (degrees + 1) * variance)
    expected = series((several - moments) * blur, ANGLES)
    found = corrections(0.85, 6, depth, variance)
    assert np.abs(found - expected).max() < 0.01 * np.abs(series(moments * blur, ANGLES)).max()


def test_channels_have_depths_of_their_own():
    moments, share = peak_moments(0.85, 6)
    aureole = Aureole(moments, share / (1 - share))
    cosine = mi.Float(0.99)
    found = aureole.correction(cosine, mi.Color3f(0.5, 2.0, 7.0))
    for channel, depth in zip(found, (0.5, 2.0, 7.0), strict=True):
        assert channel[0] == pytest.approx(aureole.correction(cosine, mi.Float(depth))[0])


@pytest.mark.parametrize("depth", [0.3, 2.0, 9.0])
def test_changes_are_derivatives_with_respect_to_the_depth(depth):
    """The table agrees with finite differences of the depth times the moments."""
    moments, share = peak_moments(0.7, 4)
    step = 1e-4 * depth
    several = [np.exp(-d) * np.expm1(d * moments) for d in (depth - step, depth + step)]
    expected = series((several[1] - several[0]) / (2 * step) - moments, ANGLES)
    aureole = Aureole(moments, share / (1 - share), of_changes=True)
    cosine = mi.Float(np.cos(ANGLES).astype(np.float32))
    found = np.array(aureole.correction(cosine, dr.full(mi.Float, depth, len(ANGLES))))
    largest = np.abs(series(moments, ANGLES)).max()
    np.testing.assert_allclose(found * (1 - share) / share, expected, atol=0.01 * largest)
