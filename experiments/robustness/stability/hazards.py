"""The hazards: everything in a scene that may break arithmetic, each with what must hold of it.

Every case runs with both solvers, all quadratures, grey and in colour, unless it says otherwise.
"""

from __future__ import annotations

from experiments.robustness.stability import media, views
from experiments.robustness.stability.case import Case


def cases() -> list[Case]:
    """All of them, hazard by hazard."""
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
