"""A medium among surfaces or other media: its fluence, and what radiance in it is worth.

Where scattering is isotropic, both the fluence and its adjoint have one component; otherwise they
have those of `scattering`: moments, and the irradiance of each narrow source.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.border import BorderProfile
from mitsuba_irrcache.cache.direct_light import DirectLight, spread
from mitsuba_irrcache.cache.lookups import root_field
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.fluence import cached_components
from mitsuba_irrcache.gradients.forward_peak import changes_without_peak, with_forward_peak
from mitsuba_irrcache.gradients.medium import (
    MARGIN,
    PAIRS,
    SHARP_PAIRS,
    field_of,
    means_over_collisions,
    splat_of,
    sums_for,
)
from mitsuba_irrcache.gradients.parameters import ALBEDO, EMISSION, MEAN_COSINE, SIGMA_T
from mitsuba_irrcache.gradients.phase_function import NeighbouringPhases
from mitsuba_irrcache.gradients.replay import CameraReplay, CameraSplats, InScattering
from mitsuba_irrcache.gradients.resampling import VoxelQuadrature, volume_of
from mitsuba_irrcache.gradients.scattering import Components, IsotropicScattering
from mitsuba_irrcache.gradients.source_weights import SourceDepths, SourceWeights
from mitsuba_irrcache.gradients.splatting import ConstantSplat, VoxelSums
from mitsuba_irrcache.gradients.tangent_fields import MediumChanges
from mitsuba_irrcache.gradients.transport import AdjointTransport, TransportSettings
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.narrow_sources import Source, sources_of
from mitsuba_irrcache.media.phase import Phase
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium


@dataclass
class AdjointFluence:
    """The adjoint fluence of collisions in the voxels of a medium, by channel.

    Attributes:
        camera: the components of that of rays from outside.
        travelled: the components of that which has travelled between voxels.
    """

    camera: list[Components]
    travelled: list[Components]

    def __add__(self, other: AdjointFluence) -> AdjointFluence:
        pairs = (self.camera, other.camera), (self.travelled, other.travelled)
        return AdjointFluence(*(added_components(*pair) for pair in pairs))


def added_components(first: list[Components], second: list[Components]) -> list[Components]:
    """Return the sums of all components of each channel."""
    return [[a + b for a, b in zip(*own, strict=True)] for own in zip(first, second, strict=True)]


class KnownFluence:
    """The fluence of a medium on the grid of its cache, see `FluenceAlongRays`.

    ``values`` are the components of each channel; ``basis`` is None for isotropic scattering;
    ``depths`` are None without a truncated forward peak.
    """

    falloff = None

    def __init__(
        self,
        grid: Grid,
        values: list[Components],
        border: BorderProfile | None,
        basis: AngularBasis | None,
        depths: SourceDepths | None,
    ) -> None:
        irradiance = [components[0] for components in values]
        roots = [dr.sqrt(dr.maximum(v, 0)) for v in irradiance]
        flat, known = interleaved(roots, grid.voxel_count), dr.full(mi.Bool, True, grid.voxel_count)
        self.irradiance = root_field(grid, flat, known, len(values), border)
        self.direct_lights, self.angular = [], None
        if basis is not None:
            higher = zip(*(components[1:] for components in values), strict=True)
            moments = [layer for channels in higher for layer in channels]
            field = AngularField(basis, grid, irradiance, moments)
            weights = SourceWeights(basis, depths, visible=True)
            self.angular = InScattering(field, basis, weights)
        self._basis = basis

    def scattered_by(self, phase: Phase) -> KnownFluence:
        """Return this fluence with another ``phase`` function for scattering into rays."""
        fluence, own = copy(self), self._basis
        basis = AngularBasis(phase, own.sources, order=own.order)
        fluence.angular = self.angular.in_basis(basis)
        return fluence


class Importance:
    """Derivative of an objective with respect to the radiance that is incident in voxels.

    Args:
        scattering: the components.
        scale: for each channel, scattering coefficient times volume of the voxels.
        adjoint: the adjoint fluence.
    """

    # docs/primer, eq. (8.21)

    def __init__(
        self, scattering: IsotropicScattering, scale: list[mi.Float], adjoint: AdjointFluence
    ) -> None:
        self._scattering, factors = scattering, scattering.product_factors()
        #: the products of each channel, for each part of the radiance
        self._parts = [
            [
                [factor * own * layer for factor, layer in zip(factors, components, strict=True)]
                for components in scattering.of_parts(camera, travelled)
            ]
            for own, camera, travelled in zip(scale, adjoint.camera, adjoint.travelled, strict=True)
        ]
        dr.eval(self._parts)

    @cached_property
    def magnitude(self) -> mi.Float:
        """The order of what radiance from any direction is worth in each voxel."""
        norms = self._scattering.norms()
        total = sum(
            norm * dr.abs(layer)
            for (smooth, *_) in self._parts
            for norm, layer in zip(norms, smooth, strict=True)
        )
        # Components of narrow sources differ from the smooth ones in the first one only.
        total += sum(
            dr.abs(own[0] - smooth[0]) for (smooth, *narrow) in self._parts for own in narrow
        )
        dr.eval(total)
        return total

    def of(self, voxel: mi.UInt32, towards: mi.Vector3f) -> mi.Spectrum:
        """Return the derivative with respect to irradiance from the direction ``towards``."""
        return self._of_part(0, voxel, self._scattering.moments.basis(towards))

    def of_emitters(self, voxel: mi.UInt32, p: mi.Point3f, towards: mi.Vector3f) -> mi.Spectrum:
        """Return the derivative with respect to irradiance of emitters at ``p``, seen in the
        direction ``towards``.
        """
        basis = self._scattering.moments.basis(towards)
        found = self._of_part(0, voxel, basis)
        for number, source in enumerate(self._scattering.sources, 1):
            direction, cosine = source.seen_from(p)
            own = dr.dot(towards, direction) >= cosine
            found = dr.select(own, self._of_part(number, voxel, basis), found)
        return found

    def _of_part(self, number: int, voxel: mi.UInt32, basis: list[mi.Float]) -> mi.Spectrum:
        values = []
        for parts in self._parts:
            pairs = zip(parts[number], basis, strict=True)
            values.append(sum(dr.gather(mi.Float, layer, voxel) * y for layer, y in pairs))
        return mi.Spectrum(*values)


class CoupledMedium:
    """A medium with its fluence, and the adjoint of transport within its box."""

    def __init__(
        self, scene: mi.Scene, part: CachedMedium, wanted: dict[str, int], step: float, seed: int
    ) -> None:
        self.medium, self.step = part.medium, step
        #: numbers of channels of the derivatives to return and of the sums for them, by role
        self.wanted, self._summed = wanted, sums_for(part.medium, wanted)
        self.cache, self.grid = part.cache, part.cache.grid
        #: for derivatives with respect to the mean cosine
        self._phases = NeighbouringPhases(part.medium.phase) if MEAN_COSINE in wanted else None
        #: whether radiance is scattered once only
        self.single = part.settings.max_depth == 2
        settings = TransportSettings(
            (part.settings.seed, seed),
            SHARP_PAIRS if part.medium.phase.forward else PAIRS,
            single=self.single,
            has_dense_boundary=self.cache.interpolation.border is not None,
        )
        self.transport = AdjointTransport(scene, part.medium, self.grid, (), settings)
        found = VoxelQuadrature(part.medium, self.grid).extinction()
        self.channels = self.transport.channels
        self.extinction = list(found)[: self.channels]
        dr.eval(self.extinction)
        self._depths: SourceDepths | None = None
        if part.medium.original is not None:
            self._depths = SourceDepths(part.medium, self.grid, self.basis.sources)
        # The cached moments exclude what camera rays evaluate in closed form.
        lights = self.cache.direct_lights if self.basis is not None else ()
        known = [(light, sources_of(scene, [light.emitter])[1][0]) for light in lights]
        self.values = [self._cached(known, channel) for channel in range(self.channels)]
        self._update()

    @property
    def basis(self) -> AngularBasis | None:
        """The angular basis of the components; None for isotropic scattering."""
        return self.transport.scattering.basis

    @property
    def components(self) -> int:
        """Number of components of the adjoint fluence of rays from outside."""
        return self.transport.scattering.camera_count

    def _cached(self, lights: list[tuple[DirectLight, Source]], channel: int) -> Components:
        """Return the components of the fluence of a channel, 0 at inactive voxels: those of the
        cache, and those of the ``lights`` that it lacks.
        """
        cache, known = self.cache, cached_components(self.cache, channel)
        if self.basis is None:
            return known
        count = self.transport.scattering.count
        values, sources = known[:count], self.basis.sources
        narrow = [dr.zeros(mi.Float, self.grid.voxel_count) for _ in sources]
        for own, irradiance in zip(cache.directional.sources, known[count:], strict=True):
            narrow[_index(sources, own)] = irradiance
        active = cache.active
        for light, own in lights:
            irradiance = spread(self.grid, active, [light.irradiance[channel]], None)
            if not light.is_wide:
                narrow[_index(sources, own)] = irradiance
            if not own.sharp:
                means = [
                    spread(self.grid, active, [mean[channel]], None)
                    for mean in light.angular_means()
                ]
                higher = zip(values[1:], means, strict=False)
                values[1:] = [a + irradiance * mean for a, mean in higher]
        dr.eval(values, narrow)
        return values + narrow

    @property
    def unknown(self) -> mi.UInt32:
        """The voxels without a cached fluence."""
        known = dr.opaque(mi.Bool, False, self.grid.voxel_count)
        if self.cache.active_count and self.cache.samples:
            dr.scatter(known, mi.Bool(True), self.cache.active)
        return dr.compress(~known)

    def complete(self, voxels: mi.UInt32, values: list[Components]) -> None:
        """Set the components of the fluence of ``voxels``, by channel."""
        for own, components in zip(self.values, values, strict=True):
            for layer, value in zip(own, components, strict=True):
                dr.scatter(layer, value, voxels)
        dr.eval(self.values)
        self._update()

    def _update(self) -> None:
        fluence = KnownFluence(self.grid, self.values, self.cache.border, self.basis, self._depths)
        neighbours = None
        if self._phases is not None:
            marches = [
                CameraReplay(self.medium, fluence.scattered_by(phase), None, self.step)
                for phase in (self._phases.below, self._phases.above)
            ]
            neighbours = (*marches, self._phases.step)
        self.march = CameraReplay(self.medium, fluence, None, self.step, neighbours)

    def moments(
        self, p: mi.Point3f, contributions: list[tuple[mi.Vector3f, mi.Spectrum, mi.Spectrum]]
    ) -> list[mi.Spectrum]:
        """Return the components of the fluence at ``p``, given irradiance from directions, straight
        from emitters and scattered.
        """
        total = sum((a + b for _, a, b in contributions), mi.Spectrum(0))
        return [total] if self.basis is None else [total, *self.basis.moments(p, contributions)]

    @property
    def scattering_voxels(self) -> mi.UInt32:
        """The voxels that scatter."""
        pairs = zip(self.extinction, self.transport.albedo, strict=False)
        return dr.compress(sum((s * a for s, a in pairs), mi.Float(0)) > 0)

    def no_irradiance(self) -> list[list[Components]]:
        """Return, for each channel and each part of the radiance, components of 0."""
        scattering, voxels = self.transport.scattering, self.grid.voxel_count
        found = [
            [
                [dr.opaque(mi.Float, 0, voxels) for _ in range(scattering.count)]
                for _ in range(1 + len(scattering.sources))
            ]
            for _ in range(self.channels)
        ]
        dr.eval(found)
        return found

    def by_part(
        self, p: mi.Point3f, contributions: list[tuple[mi.Vector3f, mi.Spectrum, mi.Spectrum]]
    ) -> list[list[mi.Spectrum]]:
        """Return the components of the irradiance at ``p`` for each part of the radiance, given
        irradiance from directions, straight from emitters and scattered.
        """
        scattering = self.transport.scattering
        parts = range(1 + len(scattering.sources))
        found = [[mi.Spectrum(0)] * scattering.count for _ in parts]
        for towards, emitted, scattered in contributions:
            part = mi.UInt32(0)
            for number, source in enumerate(scattering.sources, 1):
                direction, cosine = source.seen_from(p)
                part = dr.select(dr.dot(towards, direction) >= cosine, number, part)
            basis = scattering.moments.basis(towards)
            for number, components in enumerate(found):
                own = dr.select(part == number, emitted, 0)
                own = own + scattered if number == 0 else own
                components[:] = [a + y * own for a, y in zip(components, basis, strict=True)]
        return found

    def scattered(self, camera: list[Components]) -> AdjointFluence:
        """Return the adjoint fluence with all scattering within the box, given that of rays from
        outside.
        """
        return AdjointFluence(camera, self.transport.adjoint(camera)[1])

    def entering(self, camera: list[Components]) -> AdjointFluence:
        """Return the adjoint fluence before any scattering within the box, given that of rays from
        outside.
        """
        count = self.transport.scattering.count
        none = [[0 * layer for layer in components[:count]] for components in camera]
        return AdjointFluence(camera, none)

    def importance(self, adjoint: AdjointFluence) -> Importance:
        """Return what radiance in the voxels is worth."""
        volume = dr.opaque(mi.Float, volume_of(self.grid))
        pairs = zip(self.extinction, self.transport.albedo, strict=False)
        return Importance(self.transport.scattering, [volume * s * a for s, a in pairs], adjoint)

    def mean(self, sums: VoxelSums) -> list[Components]:
        """Return the adjoint fluence of the collisions that are summed in ``sums``, by channel."""
        return means_over_collisions(self.grid, sums, self.extinction, self.components)

    def splats(
        self, largest: float, count: float, collisions: bool, derivatives: bool
    ) -> CameraSplats:
        """Return sums, 0 at first, for the ``count`` paths with this ``largest`` weighted radiance.

        ``collisions`` and ``derivatives`` select the sums.
        """
        sums, peak = None, self.medium.phase.peak
        if collisions:
            bound = largest * count * MARGIN * peak
            sums = VoxelSums(self.grid, self.channels * self.components, bound)
        found = dict.fromkeys((SIGMA_T, ALBEDO, EMISSION, MEAN_COSINE))
        if derivatives:
            length = float(np.linalg.norm(self.grid.side_lengths))
            mean = self.march.irradiance.maximum * peak / (4 * np.pi)
            emission = self.medium.emission
            emitted = 0.0 if emission is None else emission.maximum * length
            bounds = {
                SIGMA_T: largest * (1 + mean + emitted) * length,
                ALBEDO: largest * mean,
                EMISSION: largest * length,
            }
            for role, own in self._summed.items():
                if role == MEAN_COSINE:
                    found[role] = ConstantSplat(1, largest * mean * count * MARGIN**2)
                    continue
                bound = bounds[role] * count * MARGIN
                found[role] = splat_of(field_of(self.medium, role), own, bound)
        sigma_t, albedo, emission, g = found.values()
        return CameraSplats(sigma_t, albedo, sums, emission, g=g)

    def derivatives(self, splats: CameraSplats) -> dict[str, mi.Float]:
        """Return the ``wanted`` derivatives with respect to the scene's medium, by role, at the
        voxels of its data, given those with respect to the medium as it is rendered.
        """
        sums = {
            SIGMA_T: splats.sigma_t,
            ALBEDO: splats.albedo,
            EMISSION: splats.emission,
            MEAN_COSINE: splats.g,
        }
        found = {role: sums[role].values() for role in self._summed}
        if self.medium.original is None or found.keys() <= {EMISSION}:
            return found
        change = self._phases.forward if self._phases is not None else 0.0
        return with_forward_peak(self.medium, found, self._summed[SIGMA_T], self.wanted, change)

    def remove_peak(self, changes: MediumChanges) -> None:
        """Replace ``changes`` of the scene's medium by those of the medium as it is rendered."""
        if self.medium.original is None:
            return
        fields = changes.fields
        share = changes.g * self._phases.forward if self._phases is not None else 0.0
        scaled = changes_without_peak(self.medium, fields.get(SIGMA_T), fields.get(ALBEDO), share)
        fields |= dict(zip((SIGMA_T, ALBEDO), scaled, strict=True))


def _index(sources: list[Source], source: Source) -> int:
    """Return the index of the same source among ``sources``."""
    return next(i for i, other in enumerate(sources) if other.is_same(source))
