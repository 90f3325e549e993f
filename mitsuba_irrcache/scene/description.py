"""Description of a scene: the result of `compile_scene`, and the input of all later stages."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from mitsuba_irrcache.lights.emitters import EmittersByKind
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.path import Media


@dataclass(frozen=True, eq=False)
class SceneDescription:
    """The media and emitters of a scene. It does not hold the scene itself.

    Attributes:
        media: all media, in the order in which the scene's shapes name them.
        visible: the media that get a cache: those that camera rays can reach without crossing a
            surface, or through glass if all orders of scattering are requested.
        emitters: the emitters by their kind.
        brightest: estimated maximum radiance of all emitters; None if rays are not traced, see
            `MediumGrid.is_traced`.
        background_bound: estimated maximum radiance behind the media, of emitters or reflected by
            surfaces; None if rays are not traced. Rays end where what remains of it is negligible.
        has_surfaces: whether any shape is more than the boundary of a medium.
    """

    media: Media
    visible: tuple[MediumGrid, ...]
    emitters: EmittersByKind
    brightest: mi.Float | None = None
    background_bound: mi.Float | None = None
    has_surfaces: bool = False

    @property
    def refracts(self) -> bool:
        """Whether the boundary of any visible medium refracts."""
        return any(grid.refracts for grid in self.visible)

    @property
    def emits(self) -> bool:
        """Whether there is any source of radiance."""
        return bool(self.emitters) or self.media.is_emissive
