"""Parameters of lookups in a cache, in addition to its values."""

from __future__ import annotations

from collections.abc import Sequence

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.cache.peak_depths import PeakDepths
from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses


class Interpolation(Immutable):
    """How the irradiance between the voxels of a cache follows from that at the voxels.

    Attributes:
        directional: basis of the moments of the radiance; None where scattering is isotropic.
        falloff: factor of emitters nearby that is divided out before interpolation; None where
            there are none.
        direct_lights: emitters whose irradiance camera rays evaluate themselves; the layers of the
            cache hold its means over voxels.
        peak_depths: optical depths of scattering into a truncated forward peak between the voxels
            and narrow sources; None where no peak is truncated, or there are no such sources.
        voxel_classes: where voxels lie among surfaces and media; None where no surface and no other
            medium is among them.
    """

    def __init__(
        self,
        directional: AngularBasis | None = None,
        falloff: InverseSquareFactor | None = None,
        direct_lights: Sequence[DirectLight] = (),
        voxel_classes: VoxelClasses | None = None,
        peak_depths: PeakDepths | None = None,
    ) -> None:
        self.directional, self.falloff = directional, falloff
        self.direct_lights, self.voxel_classes = tuple(direct_lights), voxel_classes
        self.peak_depths = peak_depths


#: Trilinear interpolation of isotropically scattered radiance, and nothing else.
PLAIN = Interpolation()
