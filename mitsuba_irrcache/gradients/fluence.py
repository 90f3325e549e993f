"""The fluence of a cache in single precision at all voxels, also where there is no matter."""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis, AngularField
from mitsuba_irrcache.cache.conservative import conserving
from mitsuba_irrcache.cache.direct_light import DirectLight, DirectLightAlongRays
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.replay import InScattering
from mitsuba_irrcache.gradients.scattering import Layers
from mitsuba_irrcache.gradients.transport import AdjointTransport
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.media.phase import Phase


class FluenceFields:
    """Fields of the fluence for lookups along camera rays, and the fluence of collisions.

    Attributes:
        irradiance: divided by `falloff`, without that of `direct_lights`.
        falloff: factor of emitters nearby; None without any.
        direct_lights: emitters whose irradiance camera rays evaluate themselves.
        angular: scattering into camera rays; None where it is isotropic.
        collided: layers of the fluence of collisions in each channel of ``transport``.
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
        # The brightest of all channels that differ by a factor.
        own = range(channels) if channels == cache.channels else [int(colour.argmax())]
        known = [self._known(c) for c in own]
        swept, self.collided = transport.irradiance(
            [self._with_narrow_sources(c, k, lights) for c, k in zip(own, known, strict=True)]
        )
        has_value = dr.zeros(mi.Bool, grid.voxel_count)
        if cache.active_count and cache.samples:
            dr.scatter(has_value, mi.Bool(True), cache.active)
        swept = [self._as_in_cache(layers) for layers in swept]
        total = [
            [dr.select(has_value, a, b) for a, b in zip(*pair, strict=True)]
            for pair in zip(known, swept, strict=True)
        ]
        brightest = max((float(dr.max(dr.abs(layers[0]))[0]) for layers in total), default=0.0)
        for light in lights:
            for c, layers in zip(own, total, strict=True):
                layers[0] = dr.maximum(layers[0] - self._scaled(light.irradiance[c], c), 0)
        self.angular, basis = None, None
        if cache.directional is not None:
            moments = [values for each in zip(*total, strict=True) for values in each][channels:]
            irradiance = [layers[0] for layers in total]
            field = AngularField(cache.directional, grid, irradiance, moments)
            self.angular = InScattering(field, transport.scattering.basis)
            basis = AngularBasis(medium.phase, [])
        falloff = InverseSquareFactor.of(scene, grid, [light.emitter for light in lights])
        roots = [dr.sqrt(dr.maximum(layers[0], 0)) for layers in total]
        if falloff is not None:
            smooth = dr.rsqrt(falloff.of_voxels(voxels))
            roots = [r * smooth for r in roots]
        values = interleaved(roots, grid.voxel_count)
        values = conserving(grid, values, dr.full(mi.Bool, True, grid.voxel_count), channels)
        self.irradiance, self.falloff = RootField(grid, values, channels), falloff
        if falloff is not None:
            self.irradiance.maximum *= falloff.maximum(voxels)
        maxima = [self.irradiance.maximum, brightest, *(light.maximum for light in lights)]
        self.irradiance.maximum = max(maxima)
        self._lights = lights
        self.direct_lights = [DirectLightAlongRays(light, basis) for light in lights]

    def scattered_by(self, phase: Phase) -> FluenceFields:
        """The same fluence with another phase function for scattering into camera rays."""
        fields, known = copy(self), self._cache.directional
        basis = AngularBasis(phase, known.sources, order=known.order)
        fields.angular = self.angular.in_basis(basis)
        basis = AngularBasis(phase, [], order=known.order)
        fields.direct_lights = [DirectLightAlongRays(light, basis) for light in self._lights]
        return fields

    def _known(self, channel: int) -> Layers:
        """The layers of a channel of the cache at all voxels: the irradiance, moments, and the
        irradiance of its narrow sources; 0 where it has none.
        """
        cache = self._cache
        place = dr.arange(mi.UInt32, cache.grid.voxel_count) * cache.channels + channel
        irradiance = dr.gather(mi.Float, cache.irradiance.array, place)
        layers = [irradiance]
        if cache.directional is not None:
            for values in cache.moment_means()[channel :: cache.channels]:
                spread = dr.zeros(mi.Float, cache.grid.voxel_count)
                if cache.active_count:
                    dr.scatter(spread, values, cache.active)
                layers.append(spread)
            dr.eval(layers)
        return [self._scaled(values, channel) for values in layers]

    def _scaled(self, values: mi.Float, channel: int) -> mi.Float:
        """``values`` of a channel in units of its colour."""
        return values * dr.opaque(mi.Float, 1 / float(self._transport.colour[channel]))

    def _with_narrow_sources(
        self, channel: int, layers: Layers, lights: list[DirectLight]
    ) -> Layers:
        """Moments of all radiance, from ``layers`` of `_known` and direct ``lights``."""
        scattering, p = self._transport.scattering, self._transport.positions
        result = layers[: scattering.count]
        if self._cache.directional is None:
            return result
        narrow = [
            (irradiance, source.seen_from(p)[0])
            for source, irradiance in zip(
                self._cache.directional.sources, layers[scattering.count :], strict=True
            )
        ]
        narrow += [
            (self._scaled(light.irradiance[channel], channel), light.towards(p)) for light in lights
        ]
        for irradiance, towards in narrow:
            _, *higher = scattering.from_direction(irradiance, towards)
            result[1:] = [a + b for a, b in zip(result[1:], higher, strict=True)]
        return result

    def _as_in_cache(self, layers: Layers) -> Layers:
        """``layers`` with the irradiance of those narrow sources only that the cache has, too."""
        if self._cache.directional is None:
            return layers
        scattering = self._transport.scattering
        sources = list(zip(scattering.basis.sources, layers[scattering.count :], strict=True))
        result = layers[: scattering.count]
        for own in self._cache.directional.sources:
            number = next(i for i, (source, _) in enumerate(sources) if source.is_same(own))
            result.append(sources.pop(number)[1])
        return result
