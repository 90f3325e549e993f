"""What lookups in a cache need in addition to its values."""

from __future__ import annotations

from collections.abc import Sequence

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.border import BorderProfile
from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.cache.peak_depths import PeakDepths
from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses


class Interpolation(Immutable):
    """How the irradiance between the voxel centres of a cache is interpolated.

    Attributes:
        directional: basis of the moments of the radiance; None if scattering is isotropic.
        falloff: inverse-square factor of nearby emitters, by which Phi is divided before
            interpolation; None without such emitters.
        direct_lights: emitters whose irradiance camera rays evaluate in closed form. It is excluded
            from lookups, although the arrays of the cache include it (`DirectLight.irradiance`: its
            values at the voxel centres, for spot lights with the mean of E over the voxel).
        peak_depths: optical depths of scattering into a truncated forward peak between the voxels
            and narrow sources; None if no peak is truncated, or there are no such sources.
        voxel_classes: position of the voxels relative to surfaces and media; None if there is no
            surface and no other medium among them.
        border: profile of Phi at the faces of the grid; None if the medium is not dense there.
    """

    def __init__(
        self,
        directional: AngularBasis | None = None,
        falloff: InverseSquareFactor | None = None,
        direct_lights: Sequence[DirectLight] = (),
        voxel_classes: VoxelClasses | None = None,
        peak_depths: PeakDepths | None = None,
        border: BorderProfile | None = None,
    ) -> None:
        self.directional, self.falloff = directional, falloff
        self.direct_lights, self.voxel_classes = tuple(direct_lights), voxel_classes
        self.peak_depths, self.border = peak_depths, border


#: Trilinear interpolation of isotropically scattered radiance, and nothing else.
PLAIN = Interpolation()
