"""The fluence of a cache in single precision at all voxels, including voxels without extinction."""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.direct_light import DirectLight, DirectLightAlongRays
from mitsuba_irrcache.cache.lookups import root_field
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.replay import InScattering
from mitsuba_irrcache.gradients.scattering import Components
from mitsuba_irrcache.gradients.source_weights import SourceDepths, SourceWeights
from mitsuba_irrcache.gradients.transport import AdjointTransport
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.media.phase import Phase


class FluenceFields:
    """Fields of the fluence for lookups along camera rays, and the fluence of collisions.

    Attributes:
        irradiance: the irradiance without that of `direct_lights`, divided by `falloff`.
        falloff: inverse-square factor of emitters nearby; None if there are none.
        direct_lights: emitters whose irradiance is evaluated along camera rays.
        angular: anisotropic scattering into camera rays; None if scattering is isotropic.
        collided: for each channel of ``transport``, the components of the fluence weighted by
            collisions, one value per voxel.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        cache: IrradianceCache,
        transport: AdjointTransport,
    ) -> None:
        grid = cache.grid
        self._cache, self._transport = cache, transport
        voxels = dr.arange(mi.UInt32, grid.voxel_count)
        lights = [
            DirectLight(scene, light.emitter, medium, grid, voxels) for light in cache.direct_lights
        ]
        channels, colour = transport.channels, transport.colour
        # The brightest of several channels that differ by a constant factor represents all.
        own = range(channels) if channels == cache.channels else [int(colour.argmax())]
        cached = [self._cached(c) for c in own]
        swept, self.collided = transport.irradiance(
            [self._with_narrow_sources(c, k, lights) for c, k in zip(own, cached, strict=True)]
        )
        has_value = dr.zeros(mi.Bool, grid.voxel_count)
        if cache.active_count and cache.samples:
            dr.scatter(has_value, mi.Bool(True), cache.active)
        swept = [self._as_in_cache(components) for components in swept]
        total = [
            [dr.select(has_value, a, b) for a, b in zip(*pair, strict=True)]
            for pair in zip(cached, swept, strict=True)
        ]
        brightest = max(
            (float(dr.max(dr.abs(components[0]))[0]) for components in total), default=0.0
        )
        for light in lights:
            for c, components in zip(own, total, strict=True):
                components[0] = dr.maximum(components[0] - self._scaled(light.irradiance[c], c), 0)
        self.angular, basis = None, None
        if cache.directional is not None:
            moments = [values for each in zip(*total, strict=True) for values in each][channels:]
            irradiance = [components[0] for components in total]
            field = AngularField(cache.directional, grid, irradiance, moments)
            every, depths = transport.scattering.basis, None
            if medium.original is not None:
                depths = SourceDepths(medium, grid, every.sources)
            self.angular = InScattering(field, every, SourceWeights(every, depths))
            basis = AngularBasis(medium.phase, [])
        falloff = InverseSquareFactor.of(scene, grid, [light.emitter for light in lights])
        roots = [dr.sqrt(dr.maximum(components[0], 0)) for components in total]
        if falloff is not None:
            smooth = dr.rsqrt(falloff.of_voxels(voxels))
            roots = [r * smooth for r in roots]
        values = interleaved(roots, grid.voxel_count)
        known = dr.full(mi.Bool, True, grid.voxel_count)
        self.irradiance = root_field(grid, values, known, channels, cache.border)
        self.falloff = falloff
        if falloff is not None:
            self.irradiance.maximum *= falloff.maximum(voxels)
        maxima = [self.irradiance.maximum, brightest, *(light.maximum for light in lights)]
        self.irradiance.maximum = max(maxima)
        self._lights = lights
        self.direct_lights = [DirectLightAlongRays(light, basis) for light in lights]

    def scattered_by(self, phase: Phase) -> FluenceFields:
        """Return these fields with another ``phase`` function for scattering into camera rays."""
        fields, own = copy(self), self._cache.directional
        basis = AngularBasis(phase, own.sources, order=own.order)
        fields.angular = self.angular.in_basis(basis)
        basis = AngularBasis(phase, [], order=own.order)
        factor = phase.peak_ratio / own.phase.peak_ratio if phase.forward else 1.0
        fields.direct_lights = [
            DirectLightAlongRays(light, basis, peak_factor=factor) for light in self._lights
        ]
        return fields

    def _cached(self, channel: int) -> Components:
        """Return `cached_components` of a channel divided by the factor of its colour."""
        return [self._scaled(values, channel) for values in cached_components(self._cache, channel)]

    def _scaled(self, values: mi.Float, channel: int) -> mi.Float:
        """Return ``values`` of a channel divided by the factor of its colour."""
        return values * dr.opaque(mi.Float, 1 / float(self._transport.colour[channel]))

    def _with_narrow_sources(
        self, channel: int, components: Components, lights: list[DirectLight]
    ) -> Components:
        """Return the moments of all radiance.

        ``components`` are those that `_cached` returns, which lack the higher moments of narrow
        sources and of direct ``lights``.
        """
        scattering, p = self._transport.scattering, self._transport.lights.positions
        result = components[: scattering.count]
        if self._cache.directional is None:
            return result
        narrow = [
            (irradiance, source.seen_from(p)[0])
            for source, irradiance in zip(
                self._cache.directional.sources, components[scattering.count :], strict=True
            )
        ]
        narrow += [
            (self._scaled(light.irradiance[channel], channel), light.towards(p)) for light in lights
        ]
        for irradiance, towards in narrow:
            _, *higher = scattering.from_direction(irradiance, towards)
            result[1:] = [a + b for a, b in zip(result[1:], higher, strict=True)]
        return result

    def _as_in_cache(self, components: Components) -> Components:
        """Return ``components`` without narrow sources that the cache does not distinguish."""
        if self._cache.directional is None:
            return components
        scattering = self._transport.scattering
        sources = list(zip(scattering.basis.sources, components[scattering.count :], strict=True))
        result = components[: scattering.count]
        for own in self._cache.directional.sources:
            number = next(i for i, (source, _) in enumerate(sources) if source.is_same(own))
            result.append(sources.pop(number)[1])
        return result


def cached_components(cache: IrradianceCache, channel: int) -> Components:
    """Return the values of a channel of ``cache`` at all voxels, 0 at inactive ones.

    These are the irradiance, its moments, and the irradiance of each narrow source of the cache.
    """
    place = dr.arange(mi.UInt32, cache.grid.voxel_count) * cache.channels + channel
    components = [dr.gather(mi.Float, cache.irradiance.array, place)]
    if cache.directional is not None:
        for values in cache.moment_means()[channel :: cache.channels]:
            spread = dr.zeros(mi.Float, cache.grid.voxel_count)
            if cache.active_count:
                dr.scatter(spread, values, cache.active)
            components.append(spread)
        dr.eval(components)
    return components
