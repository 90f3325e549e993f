"""Real volumes as the truth of optimisations."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.validation.gradients.real_volumes import means


@pytest.mark.parametrize("axis", [0, 1])
def test_means_over_voxels_are_those_of_the_data_in_the_middle(axis):
    """Data that fill half of the axis, in voxels that divide them or not."""
    rng = np.random.default_rng(3)
    values = rng.random((6, 6))
    for voxels in (4, 5, 12):
        found = means(values, axis, 0.5, voxels)
        assert found.shape[axis] == voxels
        integral = found.sum(axis=axis) / voxels
        np.testing.assert_allclose(integral, 0.5 * values.mean(axis=axis), rtol=1e-12)
    # A voxel of the data is one of these, and beyond a quarter on both sides there is nothing.
    found = np.moveaxis(means(values, axis, 0.5, 12), axis, 0)
    np.testing.assert_allclose(found[3:9], np.moveaxis(values, axis, 0), rtol=1e-12)
    assert not found[:3].any() and not found[9:].any()
