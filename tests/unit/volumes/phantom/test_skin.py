"""The optical depth of the phantom's skin does not depend on its position between voxel centres.

Otherwise rings would be visible.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mitsuba_irrcache.volumes import processing
from mitsuba_irrcache.volumes.phantom import thorax
from mitsuba_irrcache.volumes.transfer import load_preset

#: Parts of the outermost tissue in mm: its optical depth is that of the skin and the fat below.
DEPTH = 10.0


@pytest.mark.parametrize(
    ("shape", "bound"),
    # Measured: 0.030 and 0.083; with an edge of one voxel 0.158 and 0.181.
    [((165, 120, 190), 0.05), ((96, 72, 112), 0.1)],
    ids=["make demo", "coarse"],
)
def test_optical_depth_of_the_skin_is_uniform(shape, bound):
    """The optical depth of the skin along x at the flank varies little between neighbouring
    rays.

    The transfer function is that of ``make demo``; the variation is relative to the mean.
    """
    volume = thorax(shape)
    z, y, x = shape
    flank = [(0, x // 3), (round(0.48 * y), round(0.6 * y)), (round(0.18 * z), round(0.67 * z))]
    part = processing.crop(volume, flank)
    _, sigma_t, _ = processing.bake(part, load_preset("ct-chest"), part.size, 2)
    surface = (part.values > -500).argmax(axis=2) + round(DEPTH / part.spacing[0])
    depths = np.take_along_axis(sigma_t.cumsum(axis=2), surface[..., None], 2)[..., 0]
    rings = depths - ndimage.gaussian_filter(depths, 4, mode="nearest")
    assert rings.std() < bound * depths.mean()
    assert depths.mean() > 0  # where there is skin
