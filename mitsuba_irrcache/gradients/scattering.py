"""Angular representation of fluence and adjoint fluence: *layers* of one value for each voxel.

Where scattering is isotropic there is one layer. Otherwise the layers are spherical-harmonic
moments by the direction from which radiance, or the importance of camera rays, arrives. Camera rays
scatter the irradiance of narrow sources by the exact phase function, which moments do not
represent. So the radiance has *parts* whose importance differs: part 0, and one for each narrow
source.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.lights.narrow_sources import sources_of
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.anisotropic import directions_of
from mitsuba_irrcache.solvers.discrete_ordinates.layout import interleaved_channels
from mitsuba_irrcache.solvers.discrete_ordinates.moments import AnisotropicMultigridLevel, Moments
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Values of a channel at all voxels (mi.Float), layer by layer.
Layers = list


class OrdinatePart:
    """The ordinates along which radiance of a part enters or is scattered.

    ``rows`` (n) are their numbers in the whole set; ``mask`` (n, 2) tells along which of both ways
    of each pair what enters belongs to the part.
    """

    def __init__(self, ordinates: Ordinates, rows: np.ndarray, mask: np.ndarray) -> None:
        self.ordinates, self.rows, self.mask = ordinates, rows, mask

    def of_channels(self, channels: Sequence[int]) -> Ordinates:
        """The ordinates, with what enters along them in these channels."""
        return of_channels(self.ordinates, channels)


def split(values: mi.Float, count: int) -> Layers:
    """So many layers that follow each other in an array."""
    voxels = dr.width(values) // count
    place = dr.arange(mi.UInt32, voxels)
    starts = [dr.opaque(mi.UInt32, layer * voxels) for layer in range(count)]
    return [dr.gather(mi.Float, values, place + start) for start in starts]


def of_channels(ordinates: Ordinates, channels: Sequence[int]) -> Ordinates:
    """``ordinates`` with what enters along them in these channels; one may stand for all."""
    incoming = ordinates.incoming
    if incoming.shape[-1] > 1:
        incoming = incoming[..., list(channels)]
    return ordinates._replace(incoming=incoming)


class IsotropicScattering:
    """Scattering into all directions alike: order 0 of `AnisotropicScattering`."""

    #: layers of the fluence, and of the adjoint fluence of camera rays
    count = camera_count = 1
    #: whether channels of the same extinction are swept at once
    joins_channels = True
    #: pairs of ordinates along which the adjoint equation is solved
    solving_pairs = 16

    # Levels and their arrays

    def new_level(
        self, sigma_t: mi.Float, albedo: list[mi.Float], tracks: Tracks
    ) -> MultigridLevel:
        """The transport equation of channels with this ``albedo``."""
        return MultigridLevel(sigma_t, interleaved_channels(albedo), tracks)

    def joined(self, channels: list[Layers]) -> mi.Float:
        """Layers of channels as an array of the level's sweeps."""
        return interleaved_channels([layers[0] for layers in channels])

    def apart(self, values: mi.Float, channels: int) -> list[Layers]:
        """Inverse of `joined`."""
        if channels == 1:
            return [[values]]
        place = dr.arange(mi.UInt32, dr.width(values) // channels) * channels
        found = [dr.gather(mi.Float, values, place + i) for i in range(channels)]
        dr.eval(found)
        return [[layer] for layer in found]

    # Parts of the radiance

    def parts(self, ordinates: Ordinates) -> list[OrdinatePart]:
        """The parts of what enters along ``ordinates``."""
        count = len(ordinates.directions)
        return [OrdinatePart(ordinates, np.arange(count), np.ones((count, 2), bool))]

    def point_parts(self, lights: int) -> list[int]:
        """The number of the part of each of so many point-like lights."""
        return [0] * lights

    def from_direction(self, irradiance: mi.Float, towards: mi.Vector3f) -> Layers:
        """Layers of an irradiance that comes from the direction ``towards``."""
        return [irradiance]

    def of_parts(self, camera: Layers, travelled: Layers) -> list[Layers]:
        """The adjoint fluence for each part of the radiance: that of ``camera`` rays, and that
        which has ``travelled`` between voxels.
        """
        return [[travelled[0] + camera[0]]]

    # Scattering

    def scattered(self, layers: Layers, scale: mi.Float) -> Layers:
        """Layers of what a fluence scatters; ``scale`` is the scattering coefficient over 4 pi."""
        return [scale * layers[0]]

    def product(self, fluence: Layers, adjoint: Layers) -> mi.Float:
        """The integral over all directions of what is scattered, for a scattering coefficient of
        1, times the importance that travels against it.
        """
        return fluence[0] * adjoint[0] * dr.inv_four_pi

    def into(self, scattered: Layers, direction: mi.Vector3f) -> mi.Float:
        """Radiance that is scattered into a ``direction``."""
        return scattered[0]

    def along(self, level: MultigridLevel, scattered: Layers, group: PairGroup) -> mi.Float:
        """Radiance that is scattered along both ways of all pairs of a group, pair by pair."""
        voxels = level.grid.voxel_count
        index = dr.arange(mi.UInt32, 2 * len(group) * voxels) % dr.opaque(mi.UInt32, voxels)
        result = dr.gather(mi.Float, scattered[0], index)
        dr.eval(result)
        return result


class AnisotropicScattering(IsotropicScattering):
    """Scattering of moments of the radiance up to the order of ``basis``, whose sources are all
    narrow sources of the scene.
    """

    joins_channels = False

    def __init__(self, basis: AngularBasis) -> None:
        self.basis, self._moments = basis, Moments(basis)
        self.count = self._moments.count
        self.camera_count = self.count + len(basis.sources)
        self.solving_pairs = directions_of(basis.order) // 2
        moments = [float(basis.phase.moments[degree]) for degree in self._moments.degrees]
        self._factors = [dr.opaque(mi.Float, 4 * np.pi * g) for g in moments]

    def new_level(
        self, sigma_t: mi.Float, albedo: list[mi.Float], tracks: Tracks
    ) -> MultigridLevel:
        return AnisotropicMultigridLevel(sigma_t, *albedo, tracks, moments=self._moments)

    def joined(self, channels: list[Layers]) -> mi.Float:
        (layers,) = channels
        return concatenated(layers[: self.count])

    def apart(self, values: mi.Float, channels: int) -> list[Layers]:
        found = split(values, self.count)
        dr.eval(found)
        return [found]

    def parts(self, ordinates: Ordinates) -> list[OrdinatePart]:
        directions, incoming, weights, _ = ordinates
        masks = self.basis.split_by_source(directions, np.ones((*incoming.shape[:2], 1)))
        found = []
        for number, mask in enumerate(masks):
            own = incoming * mask
            used = own.any(axis=(1, 2)) | (mask.any(axis=(1, 2)) if number else weights != 0)
            # Radiance of the voxels is scattered along the ordinates of part 0.
            share = np.zeros_like(weights) if number else weights
            each = Ordinates(directions, own, share, ordinates.offsets)
            each = Ordinates(*(values[used] for values in each))
            found.append(OrdinatePart(each, np.flatnonzero(used), mask[used, :, 0] > 0))
        return found

    def point_parts(self, lights: int) -> list[int]:
        return [n for n, source in enumerate(self.basis.sources, 1) if not source.far]

    def from_direction(self, irradiance: mi.Float, towards: mi.Vector3f) -> Layers:
        return [irradiance * y for y in self._moments.basis(towards)]

    def of_parts(self, camera: Layers, travelled: Layers) -> list[Layers]:
        smooth = [a + b for a, b in zip(travelled, camera, strict=False)]
        # A narrow source is scattered towards the camera exactly, and further by moments.
        exact = [[travelled[0] + own, *travelled[1:]] for own in camera[self.count :]]
        return [smooth, *exact]

    def scattered(self, layers: Layers, scale: mi.Float) -> Layers:
        return [scale * g * layer for g, layer in zip(self._factors, layers, strict=True)]

    def product(
        self, fluence: Layers, adjoint: Layers, moments: np.ndarray | None = None
    ) -> mi.Float:
        """As for isotropic scattering; by another phase function if its ``moments`` are given."""
        # docs/primer, eq. (8.13)
        moments = self.basis.phase.moments if moments is None else moments
        # What travels against a direction has moments of the opposite sign if they are odd.
        factors = [
            dr.opaque(mi.Float, (-1) ** n * float(moments[n]) / (1 if n else 4 * np.pi))
            for n in self._moments.degrees
        ]
        triples = zip(factors, fluence, adjoint, strict=True)
        return sum(factor * a * b for factor, a, b in triples)

    def into(self, scattered: Layers, direction: mi.Vector3f) -> mi.Float:
        first, *higher = scattered
        _, *basis = self._moments.basis(-direction)
        return first * dr.inv_four_pi + sum(s * y for s, y in zip(higher, basis, strict=True))

    def along(self, level: MultigridLevel, scattered: Layers, group: PairGroup) -> mi.Float:
        return level.source_along(concatenated(scattered), group)


def scattering_of(scene: mi.Scene, medium: MediumGrid) -> IsotropicScattering:
    """The representation that the phase function of ``medium`` needs."""
    if medium.phase.is_isotropic:
        return IsotropicScattering()
    sources, _ = sources_of(scene)
    return AnisotropicScattering(AngularBasis(medium.phase, sources))
