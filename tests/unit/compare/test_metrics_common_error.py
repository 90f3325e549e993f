"""Errors that two runs of one method have in common, and those that each has of its own, where both
are known.
"""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.compare.metrics import discretisation_error, noise


@pytest.mark.parametrize(("own", "reference"), [(0.0, 0.3), (0.2, 0.0), (0.2, 0.3)])
def test_noise_is_separated_from_the_common_error(own, reference):
    """Pixels off by 0.1 in both runs, noise of each run, and of each half of the reference."""
    rng, shape = np.random.default_rng(1), (256, 256, 3)
    truth = rng.uniform(0, 1, shape)
    common = 0.1 * np.where(rng.random(shape) < 0.5, 1, -1)
    x, y = (truth + common + own * rng.normal(size=shape) for _ in range(2))
    a, b = (truth + reference * rng.normal(size=shape) for _ in range(2))
    assert discretisation_error(x, y, a, b) == pytest.approx(0.1, rel=0.03)
    assert noise(x, y) == pytest.approx(own, rel=0.01)
