"""Derivatives by the mean cosine g of the phase function ``hg``.

Images depend on it by the phase function alone, whose derivative is a difference between two others
beside it. Where a forward peak is truncated, its share, and with it extinction and albedo, change.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.media.phase import Phase

#: Half the difference of the mean cosines; and the largest mean cosine.
STEP, LARGEST = 0.005, 0.99


class PhasesBeside:
    """Phase functions with a slightly smaller and larger mean cosine than ``phase`` has, with as
    many moments.

    Attributes:
        below, above: these phase functions.
        step: difference between their mean cosines.
        moments: derivatives of the moments of the phase function.
        forward: derivative of the share of a truncated forward peak.
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
    """The phase function ``hg`` with another mean cosine, with the order of ``phase``."""
    plugin = mi.load_dict({"type": "hg", "g": g})
    moments = g ** np.arange(len(phase.moments), dtype=np.float64)
    if not phase.forward:
        return Phase(plugin, moments, 2 * phase.peak)
    share, known = moments[phase.order + 1], np.arange(len(moments)) <= phase.order
    truncated = np.where(known, (moments - share) / (1 - share), 0)
    return Phase(plugin, truncated, 2 * phase.peak, float(share), moments)
