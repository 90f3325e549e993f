"""Radiance of dense media under a uniform environment, against the half-space in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.validation.dense_faces.run import radiance, rendered
from mitsuba_irrcache.cache import border

pytestmark = pytest.mark.usefixtures("mono")


@pytest.mark.parametrize("mu", [1.0, 0.5])
@pytest.mark.parametrize(
    ("albedo", "max_depth", "depth", "bound"),
    [
        (0.8, 2, 0.5, 0.03),
        (0.8, 2, 1.0, 0.07),
        (0.8, 2, 2.0, 0.11),
        (0.5, -1, 0.5, 0.043),
        (0.8, -1, 0.5, 0.036),
        (0.8, -1, 1.0, 0.063),
        (0.95, -1, 1.0, 0.031),
        (0.8, -1, 2.0, 0.15),
    ],
)
def test_half_space(mu, albedo, max_depth, depth, bound):
    """The face of an opaque cube agrees with a half-space.

    When the outermost values were extrapolated by their ratio, and the mean over a voxel was
    taken as the value at its centre, single scattering was 7, 39 and 107 % too bright with optical
    depths of 0.5, 1 and 2 per voxel, all orders with an albedo of 0.8 by 2, 9 and 29 %.
    """
    expected = radiance(albedo, max_depth, mu)
    found = rendered(depth, albedo, max_depth, mu)
    assert found == pytest.approx(expected, rel=bound)


def test_tables():
    """The tables agree with published values of E_2 and E_3, and with the equation of the decay."""
    e2, e3 = border._exponential_integrals(1.0)
    assert e2 == pytest.approx(0.148496, rel=1e-4)  # Abramowitz and Stegun, table 5.4
    assert e3 == pytest.approx(0.109692, rel=1e-4)
    decay, root = border._decay_table().astype(float), np.linspace(0, 1, border.ALBEDOS)
    clear = (root > 0) & (decay < 0.999)  # closer to 1, single precision does not suffice
    albedo, k = 1 - root[clear] ** 2, decay[clear]
    np.testing.assert_allclose(albedo * np.arctanh(k) / k, 1, rtol=1e-4)
    assert clear.sum() > 60
