"""Derivatives with respect to the mean cosine g of the phase function ``hg``.

The derivative of the phase function with respect to g is approximated by a central difference. If
a forward peak is truncated, its share depends on g, and so do the scaled extinction and albedo.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.media.phase import Phase

#: Half the difference between the mean cosines, and their largest absolute value.
STEP, LARGEST = 0.005, 0.99


class NeighbouringPhases:
    """Two phase functions ``hg`` whose mean cosines are slightly below and above that of ``phase``.

    They have the same number of moments as ``phase``.

    Attributes:
        below, above: these phase functions.
        step: difference between their mean cosines.
        moments: derivatives of the moments with respect to the mean cosine.
        forward: derivative of the share of a truncated forward peak with respect to it.
    """

    # docs/primer, eq. (8.15)

    def __init__(self, phase: Phase) -> None:
        g = float(np.array(mi.traverse(phase.plugin)["g"]).ravel()[0])
        ends = [float(np.clip(g + step, -LARGEST, LARGEST)) for step in (-STEP, STEP)]
        self.below, self.above = (_with_mean_cosine(phase, end) for end in ends)
        self.step = ends[1] - ends[0]
        self.moments = (self.above.moments - self.below.moments) / self.step
        self.forward = (self.above.forward - self.below.forward) / self.step


def _with_mean_cosine(phase: Phase, g: float) -> Phase:
    """Return the phase function ``hg`` with mean cosine ``g`` and the order of ``phase``."""
    plugin = mi.load_dict({"type": "hg", "g": g})
    params = mi.traverse(plugin)
    params["g"] = dr.opaque(mi.Float, g)  # kernels do not depend on its value
    params.update()
    moments = g ** np.arange(len(phase.moments), dtype=np.float64)
    if not phase.forward:
        return Phase(plugin, moments, 2 * phase.peak)
    share, is_kept = moments[phase.order + 1], np.arange(len(moments)) <= phase.order
    truncated = np.where(is_kept, (moments - share) / (1 - share), 0)
    return Phase(plugin, truncated, 2 * phase.peak, float(share), moments)
