"""The blur of an environment by a forward peak, against its series of Legendre polynomials."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.sequences import GOLDEN_STEP, lattice_points
from mitsuba_irrcache.media.aureole import MAX_DEPTH, PEAK_MOMENTS
from mitsuba_irrcache.media.peak_blur import DIRECTIONS, PeakBlur

pytestmark = pytest.mark.usefixtures("rgb")

SAMPLES = 1 << 14


def peak_moments(g: float, order: int) -> np.ndarray:
    """Return the moments of the peak of hg beyond ``order``."""
    moments = g ** np.arange(PEAK_MOMENTS)
    return np.minimum(moments / moments[order + 1], 1)


def blurred_hemisphere(moments: np.ndarray, elevation: float) -> float:
    """Return the blur, with these Legendre ``moments``, of a radiance of 1 above the horizon."""
    at_horizon = np.polynomial.legendre.legvander([0.0], PEAK_MOMENTS)[0]
    odd = np.arange(1, PEAK_MOMENTS, 2)
    terms = np.zeros(PEAK_MOMENTS)
    terms[0], terms[odd] = 0.5, 0.5 * (at_horizon[odd - 1] - at_horizon[odd + 1])
    return float(np.polynomial.legendre.legval(np.sin(elevation), terms * moments))


def change(blur: PeakBlur, elevation: float, depth: float) -> float:
    """Return the change of a radiance of 1 above the horizon, in this direction."""
    u = mi.Point2f(np.float32(lattice_points(SAMPLES, GOLDEN_STEP)))
    across, up = float(np.cos(elevation)), float(np.sin(elevation))
    direction = mi.Vector3f(0.6 * across, 0.8 * across, up)
    total, before = mi.Float(0), float(elevation > 0)
    for other, weight in blur.deflected(direction, mi.Float(depth), u):
        total += weight * (dr.select(other.z > 0, mi.Float(1), 0) - before) / DIRECTIONS
    return float(dr.mean(total)[0])


@pytest.mark.parametrize("degrees", [-20.0, -6.0, -1.0, 3.0, 10.0])
@pytest.mark.parametrize("depth", [0.01, 0.9, 4.0])
@pytest.mark.parametrize(("g", "order"), [(0.6, 4), (0.7, 4), (0.85, 6)])
def test_radiance_of_a_hemisphere(g, order, depth, degrees):
    """A sky beside dark ground, seen near the horizon through a medium."""
    peak, elevation = peak_moments(g, order), np.deg2rad(degrees)
    events = np.exp(-depth) * np.expm1(depth * peak) / -np.expm1(-depth)
    before = float(elevation > 0)
    expected = blurred_hemisphere(events, elevation) - before
    found = change(PeakBlur(peak), elevation, depth)
    assert found == pytest.approx(expected, abs=0.04)


def test_nothing_changes_far_from_edges():
    assert change(PeakBlur(peak_moments(0.85, 6)), np.deg2rad(75), 1.0) == 0


def test_depths_that_the_table_lacks():
    blur = PeakBlur(peak_moments(0.85, 6))
    expected = change(blur, -0.1, MAX_DEPTH)
    assert [change(blur, -0.1, depth) for depth in (2 * MAX_DEPTH, np.inf)] == [expected] * 2
    assert np.isfinite(change(blur, -0.1, 0.0))
