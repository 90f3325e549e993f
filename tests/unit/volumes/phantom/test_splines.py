"""Curves of the phantoms are those of SciPy."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.volumes.phantom.splines import monotone, smooth

interpolate = pytest.importorskip("scipy.interpolate")


@pytest.mark.parametrize("count", [2, 3, 4, 5, 9])
@pytest.mark.parametrize("components", [(), (3,)])
def test_curves_are_those_of_scipy(count, components):
    """Through random points, and beyond their ends."""
    rng = np.random.default_rng(count)
    places, values = np.sort(rng.uniform(0, 10, count)), rng.normal(size=(count, *components))
    at = np.linspace(places[0] - 1, places[-1] + 1, 101)
    expected = interpolate.CubicSpline(places, values)(at)
    np.testing.assert_allclose(smooth(places, values)(at), expected, rtol=1e-9, atol=1e-9)
    if count > 2:
        curve, expected = monotone(places, values), interpolate.PchipInterpolator(places, values)
        np.testing.assert_allclose(curve(at), expected(at), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(curve.slope(at), expected(at, 1), rtol=1e-9, atol=1e-9)


def test_phantoms_need_no_scipy():
    """Its import would take longer than a small phantom."""
    import subprocess
    import sys

    code = (
        "import sys; from mitsuba_irrcache.volumes.phantom import thorax; thorax((9, 8, 8)); "
        "sys.exit('scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
