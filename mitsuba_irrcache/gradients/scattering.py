"""Angular representation of fluence and adjoint fluence by *components* with one value per voxel.

Where scattering is isotropic there is one component, the fluence. Otherwise the components are the
spherical-harmonic moments of the radiance, or of the importance of camera rays, over the direction
from which it arrives. Camera rays scatter the irradiance of narrow sources by the exact phase
function, which the moments do not represent. So the radiance is divided into *parts* whose
importance differs: part 0, and one part for each narrow source.
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
from mitsuba_irrcache.solvers.discrete_ordinates.moments import (
    DIFFUSING,
    AnisotropicMultigridLevel,
    Moments,
)
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: The components of one channel: a list of arrays (mi.Float) of one value per voxel.
Components = list


class OrdinatePart:
    """The n pairs of ordinates along which radiance of one part enters or is scattered.

    ``rows`` (n) are their indices in the whole set; ``mask`` (n, 2) states for both directions of
    each pair whether the radiance that enters along it belongs to the part.
    """

    def __init__(self, ordinates: Ordinates, rows: np.ndarray, mask: np.ndarray) -> None:
        self.ordinates, self.rows, self.mask = ordinates, rows, mask

    def with_channels(self, channels: Sequence[int]) -> Ordinates:
        """Return the ordinates with the incoming radiance of these channels only."""
        return with_channels(self.ordinates, channels)

    def before(self, end: int, channels: Sequence[int]) -> Ordinates:
        """Return the ordinates that precede index ``end`` of the whole set, as `with_channels`."""
        own = Ordinates(*(values[self.rows < end] for values in self.ordinates))
        return with_channels(own, channels)

    def receives(self, row: int) -> bool:
        """Return whether radiance that enters along an ordinate of the whole set is of the part."""
        return bool(self.ordinates.incoming[self.rows == row].any())


def split(values: mi.Float, count: int) -> Components:
    """Return ``count`` components that are stored one after the other in an array."""
    voxels = dr.width(values) // count
    place = dr.arange(mi.UInt32, voxels)
    starts = [dr.opaque(mi.UInt32, layer * voxels) for layer in range(count)]
    return [dr.gather(mi.Float, values, place + start) for start in starts]


def with_channels(ordinates: Ordinates, channels: Sequence[int]) -> Ordinates:
    """Return ``ordinates`` with the incoming radiance of these channels only.

    Incoming radiance of a single channel is the same in all channels.
    """
    incoming = ordinates.incoming
    if incoming.shape[-1] > 1:
        incoming = incoming[..., list(channels)]
    return ordinates._replace(incoming=incoming)


class OneMoment:
    """The irradiance as the only moment of the radiance, see `Moments`."""

    count, degrees = 1, (0,)

    def basis(self, direction: mi.Vector3f) -> list[mi.Float]:
        """Return the moments of an irradiance of 1 from ``direction``."""
        return [mi.Float(1)]


class IsotropicScattering:
    """Isotropic scattering: order 0 of `AnisotropicScattering`."""

    #: numbers of components of the fluence, and of the adjoint fluence of camera rays
    count = camera_count = 1
    #: the basis of the components; narrow sources
    moments, sources = OneMoment(), ()
    #: the basis of the fluence; None for a single component
    basis: AngularBasis | None = None
    #: whether channels of the same extinction are swept together
    joins_channels = True
    #: number of pairs of ordinates with which the adjoint equation is solved
    solving_pairs = 16

    # Levels and their arrays

    def new_level(
        self, sigma_t: mi.Float, albedo: list[mi.Float], tracks: Tracks
    ) -> MultigridLevel:
        """Return the transport equation of channels with this ``albedo`` (one array each)."""
        return MultigridLevel(sigma_t, interleaved_channels(albedo), tracks)

    def joined(self, channels: list[Components]) -> mi.Float:
        """Return the components of channels as one array, as sweeps of the level take it."""
        return interleaved_channels([components[0] for components in channels])

    def separated(self, values: mi.Float, channels: int) -> list[Components]:
        """Return the components of each channel of an array; the inverse of `joined`."""
        if channels == 1:
            return [[values]]
        place = dr.arange(mi.UInt32, dr.width(values) // channels) * channels
        found = [dr.gather(mi.Float, values, place + i) for i in range(channels)]
        dr.eval(found)
        return [[layer] for layer in found]

    # Parts of the radiance

    def parts(self, ordinates: Ordinates) -> list[OrdinatePart]:
        """Divide the radiance that enters along ``ordinates`` into its parts."""
        count = len(ordinates.directions)
        return [OrdinatePart(ordinates, np.arange(count), np.ones((count, 2), bool))]

    def point_parts(self, lights: int) -> list[int]:
        """Return the index of the part of each of ``lights`` point-like lights."""
        return [0] * lights

    def from_direction(self, irradiance: mi.Float, towards: mi.Vector3f) -> Components:
        """Return the components of an ``irradiance`` from the direction ``towards``."""
        return [irradiance]

    def of_parts(self, camera: Components, travelled: Components) -> list[Components]:
        """Return the adjoint fluence for each part of the radiance.

        It is the sum of that of ``camera`` rays and that which has ``travelled`` between voxels.
        """
        return [[travelled[0] + camera[0]]]

    # Scattering

    def scattered(self, components: Components, scale: mi.Float) -> Components:
        """Return the components of the radiance that a fluence scatters.

        ``scale`` is the scattering coefficient divided by 4 pi.
        """
        return [scale * components[0]]

    def source(self, level: MultigridLevel, scattered: Components) -> Components:
        """Return the components of the source of a sweep, given those of scattered radiance."""
        first = [level.antidiffused_layer(values) for values in scattered[:DIFFUSING]]
        return [*first, *scattered[DIFFUSING:]]

    def product(self, fluence: Components, adjoint: Components) -> mi.Float:
        """Return the integral over directions of scattered radiance times opposite importance.

        The radiance is scattered with a scattering coefficient of 1; the importance is that which
        propagates against it.
        """
        return fluence[0] * adjoint[0] * dr.inv_four_pi

    def product_factors(self) -> list[float]:
        """Return the factors of the products of components of which `product` is the sum."""
        return [dr.inv_four_pi]

    def norms(self) -> list[float]:
        """Return the root mean square over directions of the basis of each component."""
        return [1.0]

    def isotropic(self, radiance: mi.Float) -> Components:
        """Return the components of a ``radiance`` that is the same in all directions."""
        return [radiance]

    def into(self, scattered: Components, direction: mi.Vector3f) -> mi.Float:
        """Return the radiance that is scattered into a ``direction``."""
        return scattered[0]

    def along(self, level: MultigridLevel, scattered: Components, group: PairGroup) -> mi.Float:
        """Return the radiance that is scattered along both directions of each pair of a group.

        The array holds one value per voxel for each direction, pair by pair.
        """
        voxels = level.grid.voxel_count
        index = dr.arange(mi.UInt32, 2 * len(group) * voxels) % dr.opaque(mi.UInt32, voxels)
        result = dr.gather(mi.Float, scattered[0], index)
        dr.eval(result)
        return result


class AnisotropicScattering(IsotropicScattering):
    """Anisotropic scattering of the moments of the radiance, up to the order of ``basis``.

    The sources of the basis are all narrow sources of the scene.
    """

    joins_channels = False

    def __init__(self, basis: AngularBasis) -> None:
        self.basis, self.moments, self.sources = basis, Moments(basis), tuple(basis.sources)
        self.count = self.moments.count
        self.camera_count = self.count + len(basis.sources)
        self.solving_pairs = directions_of(basis.order) // 2
        moments = [float(basis.phase.moments[degree]) for degree in self.moments.degrees]
        self._factors = [dr.opaque(mi.Float, 4 * np.pi * g) for g in moments]

    def new_level(
        self, sigma_t: mi.Float, albedo: list[mi.Float], tracks: Tracks
    ) -> MultigridLevel:
        return AnisotropicMultigridLevel(sigma_t, *albedo, tracks, moments=self.moments)

    def joined(self, channels: list[Components]) -> mi.Float:
        (components,) = channels
        return concatenated(components[: self.count])

    def separated(self, values: mi.Float, channels: int) -> list[Components]:
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

    def from_direction(self, irradiance: mi.Float, towards: mi.Vector3f) -> Components:
        return [irradiance * y for y in self.moments.basis(towards)]

    def of_parts(self, camera: Components, travelled: Components) -> list[Components]:
        smooth = [a + b for a, b in zip(travelled, camera, strict=False)]
        # Radiance of a narrow source is scattered into camera rays by the exact phase function, and
        # between voxels by the moments. Those of wide sources are part of the moments for camera
        # rays, too, which the exact phase function exceeds.
        pairs = zip(camera[self.count :], self.sources, strict=True)
        exact = [
            [travelled[0] + own, *(travelled if source.sharp else smooth)[1:]]
            for own, source in pairs
        ]
        return [smooth, *exact]

    def scattered(self, components: Components, scale: mi.Float) -> Components:
        return [scale * g * layer for g, layer in zip(self._factors, components, strict=True)]

    def scattered_by(
        self, components: Components, scale: mi.Float, moments: np.ndarray
    ) -> Components:
        """Return the components that a phase function with other ``moments`` scatters.

        ``scale`` is the scattering coefficient.
        """
        factors = [dr.opaque(mi.Float, float(moments[n])) for n in self.moments.degrees]
        return [scale * g * layer for g, layer in zip(factors, components, strict=True)]

    def product(
        self, fluence: Components, adjoint: Components, moments: np.ndarray | None = None
    ) -> mi.Float:
        """Compute the integral as `IsotropicScattering.product`.

        ``moments`` are those of another phase function, if not that of the medium is meant.
        """
        # docs/primer, eq. (8.13)
        triples = zip(self.product_factors(moments), fluence, adjoint, strict=True)
        return sum(factor * a * b for factor, a, b in triples)

    def product_factors(self, moments: np.ndarray | None = None) -> list[mi.Float]:
        moments = self.basis.phase.moments if moments is None else moments
        # The importance propagates in the opposite direction, where odd moments change their sign.
        return [
            dr.opaque(mi.Float, (-1) ** n * float(moments[n]) / (1 if n else 4 * np.pi))
            for n in self.moments.degrees
        ]

    def norms(self) -> list[float]:
        return [float(np.sqrt(1 / (4 * np.pi))) if n else 1.0 for n in self.moments.degrees]

    def isotropic(self, radiance: mi.Float) -> Components:
        none = dr.zeros(mi.Float, dr.width(radiance))
        return [4 * dr.pi * radiance, *[none] * (self.count - 1)]

    def into(self, scattered: Components, direction: mi.Vector3f) -> mi.Float:
        first, *higher = scattered
        _, *basis = self.moments.basis(-direction)
        return first * dr.inv_four_pi + sum(s * y for s, y in zip(higher, basis, strict=True))

    def along(self, level: MultigridLevel, scattered: Components, group: PairGroup) -> mi.Float:
        return level.source_along(concatenated(scattered), group)


def scattering_of(scene: mi.Scene, medium: MediumGrid) -> IsotropicScattering:
    """Return the angular representation that the phase function of ``medium`` requires."""
    if medium.phase.is_isotropic:
        return IsotropicScattering()
    sources, _ = sources_of(scene)
    return AnisotropicScattering(AngularBasis(medium.phase, sources))
