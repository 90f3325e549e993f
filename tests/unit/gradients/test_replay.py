"""The factors of the march of camera rays."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.fast_math import absorptance
from mitsuba_irrcache.gradients.replay import (
    _derivative_of_mean_transmittance,
    _mean_transmittance,
)

pytestmark = pytest.mark.usefixtures("mono")


def test_the_mean_transmittance_of_a_step_and_its_derivative():
    """They are accurate from thin to opaque steps, beside double precision."""
    tau = np.concatenate([[0.0], np.geomspace(1e-7, 50, 400)])
    depth = mi.Spectrum(mi.Float(tau.astype(np.float32)))
    absorbed = absorptance(depth)
    mean = np.array(_mean_transmittance(depth, absorbed)).ravel()
    derivative = np.array(_derivative_of_mean_transmittance(depth, absorbed)).ravel()
    tau = np.maximum(tau.astype(np.float32).astype(np.float64), 1e-9)
    exact = -np.expm1(-tau) / tau
    np.testing.assert_allclose(mean, exact, rtol=1e-4)
    thin = tau < 1e-3
    slope = np.where(thin, -0.5 + tau / 3, (np.exp(-tau) - exact) / tau)
    np.testing.assert_allclose(derivative, slope, rtol=2e-4)
