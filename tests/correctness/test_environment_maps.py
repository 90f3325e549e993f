"""Noise of the directions of a cache under environment maps with angular detail."""

from __future__ import annotations

import pytest

from experiments.validation.maps.run import bodies, maps, noise

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize(
    ("name", "body", "bound"),
    # One map with a part that is much brighter than the rest, and one without.
    [
        ("bright block", "ball of depth 40", 0.9),
        pytest.param("window", "ball of depth 40", 1.4, marks=pytest.mark.slow),
        pytest.param("upper half", "cube of depth 20", 0.6, marks=pytest.mark.slow),
        ("texture", "smoke of depth 2", 0.05),
    ],
)
def test_noise_between_seeds(name, body, bound):
    """Images of caches with different seeds agree to ``bound`` % of the mean radiance of the body.

    With half a sample of the map per pair of ordinates, or none where its largest radiance was
    less than 4 times its mean, the noise was 2.0, 2.7, 0.8 and 1.1 %. Without the exact moments of
    the map, the last one is 0.17 %.
    """
    found, _ = noise(bodies()[body], maps()[name], seeds=4)
    assert found < bound
