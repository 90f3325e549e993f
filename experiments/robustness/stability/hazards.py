"""The hazards: scenes that may cause numerical failures, each with the properties that must
hold.

Every case runs with both solvers, all quadratures, grey and in colour, unless it specifies
otherwise.
"""

from __future__ import annotations

from experiments.robustness.stability import media, views
from experiments.robustness.stability.case import Case


def cases() -> list[Case]:
    """Return the cases of all hazards."""
    makers = (
        media.optical_depths,
        media.extinctions,
        media.albedos,
        views.scales,
        views.offsets,
        media.voxels,
        media.grids,
        views.rays,
        views.cameras,
        views.lights,
        media.colours,
        views.films,
        media.empty_media,
        media.phases,
        media.phases_over_the_ground,
        media.many_samples,
        media.refusals,
    )
    return [case for make in makers for case in make()]
