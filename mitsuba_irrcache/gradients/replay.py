"""Derivatives of camera rays by path replay, and the adjoint fluence of the rays in the medium.

A ray's radiance is L = sum_k T_k [(1 - e^-tau_k) q_k + s(tau_k) l_k j_k] + T B, with the source
q = albedo Phi / (4 pi) and the emission j in the middle of each step of length l, the mean
transmittance s of a step, and the radiance B behind the medium. Each ray is marched twice: first
to compute L, then to compute derivatives, which depend on the radiance ahead of each step: L minus
the contributions of the previous steps. Like path replay backpropagation (Vicini, Speierer and
Jakob 2021), this needs no memory per step.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.direct_light import DirectLightAlongRays
from mitsuba_irrcache.core.fast_math import absorptance, minimum
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.gradients.points import add_paths_to_light
from mitsuba_irrcache.gradients.source_weights import SourceWeights
from mitsuba_irrcache.gradients.splatting import (
    ConstantSplat,
    GridSplat,
    VoxelSums,
    summed_to_channels,
)
from mitsuba_irrcache.gradients.tangent_fields import CameraReaders
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.media.medium import MediumGrid

#: Transmittance below which the march of a ray ends.
OPAQUE = 1e-6
#: Number of lines to each light that the derivatives with respect to the extinction need for each
#: voxel of the cache, about, and from each camera ray, at most. Noise of derivatives in voxels.
PATHS_PER_VOXEL, MOST_PATHS_PER_RAY = 20, 8


class RaySegments(NamedTuple):
    """Camera rays within the medium.

    Attributes:
        ray: the rays.
        near, far: the distances at which they enter and leave the medium.
        adjoint: derivative of the objective with respect to the radiance of each ray.
        offset: length of the first step, in steps, in (0, 1].
        active: the rays that hit the medium.
    """

    ray: mi.Ray3f
    near: mi.Float
    far: mi.Float
    adjoint: mi.Spectrum
    offset: mi.Float
    active: mi.Bool


class CameraSplats:
    """Sums to which the replay adds derivatives; None for those that are not wanted.

    Not a dataclass, because Dr.Jit would make its fields state variables of the recorded loop.

    Attributes:
        sigma_t, albedo, emission: with respect to these fields.
        collisions: the adjoint fluence of collisions in voxels, all components of each channel in
            turn.
        unscattered: with respect to the extinction before delta-M scaling, which attenuates narrow
            sources behind the medium.
        g: with respect to the mean cosine of the phase function.
    """

    def __init__(
        self,
        sigma_t: GridSplat | ConstantSplat | None,
        albedo: GridSplat | ConstantSplat | None,
        collisions: VoxelSums | None,
        emission: GridSplat | ConstantSplat | None = None,
        unscattered: GridSplat | ConstantSplat | None = None,
        g: ConstantSplat | None = None,
    ) -> None:
        self.sigma_t, self.albedo, self.emission = sigma_t, albedo, emission
        self.collisions, self.unscattered, self.g = collisions, unscattered, g

    def without_scattering(self) -> CameraSplats:
        """Return the sums for rays into which the medium scatters nothing."""
        return CameraSplats(self.sigma_t, None, None, self.emission)

    def attenuation(self) -> CameraSplats:
        """Return the sums for radiance that the medium only attenuates."""
        return CameraSplats(self.sigma_t, None, None)


class ScatteringAt(NamedTuple):
    """Anisotropic scattering at a position into a ray.

    Attributes:
        factor: the factor by which it differs from isotropic scattering.
        changed: the factor that takes its place in derivatives with respect to the scattering
            coefficient, see `source_weights`.
        gains: for each channel, or for all of them, the weight of the irradiance of each source.
    """

    factor: mi.Float | mi.Color3f
    changed: mi.Float | mi.Color3f
    gains: list[list[mi.Float]]


class InScattering:
    """Anisotropic scattering into camera rays.

    ``field`` has the moments; ``basis`` has all narrow sources of the scene, whose weights are
    ``weights``. If ``indirect``, the factor is an estimate from one voxel, and a truncated forward
    peak scatters no radiance of narrow sources.
    """

    def __init__(
        self,
        field: AngularField,
        basis: AngularBasis,
        weights: SourceWeights,
        indirect: bool = False,
    ) -> None:
        self._field, self._basis = field, basis
        self._weights, self._indirect = weights, indirect
        # The field may lack sources whose irradiance is evaluated along rays.
        self._own = [
            next(i for i, each in enumerate(basis.sources) if each.is_same(source))
            for source in field.directional.sources
        ]

    def in_basis(self, basis: AngularBasis) -> InScattering:
        """Return the scattering by another phase function, that of ``basis``."""
        weights = self._weights.scattered_by(basis.phase)
        return InScattering(self._field.in_basis(basis), self._basis, weights, self._indirect)

    def indirect(self) -> InScattering:
        """Return the scattering into rays that the camera does not follow."""
        return InScattering(self._field, self._basis, self._weights, indirect=True)

    def without_visible(self) -> InScattering:
        """Return the scattering into rays that do not see narrow sources."""
        weights = self._weights.without_visible()
        return InScattering(self._field, self._basis, weights, self._indirect)

    def view(self, direction: mi.Vector3f) -> tuple:
        """Evaluate what depends on the ``direction`` of rays only; an argument of other methods."""
        moments = list(dr.sh_eval(-direction, self._basis.order))[1:]
        return direction, self._field.directional.basis(direction), moments

    def at(
        self, p: mi.Point3f, view: tuple, active: mi.Bool, peak_depth: mi.Float | mi.Color3f
    ) -> ScatteringAt:
        """Evaluate the scattering at ``p``, where ``peak_depth`` is the optical depth of the
        forward peak between ``p`` and the camera.
        """
        direction, basis, _ = view
        if self._indirect:
            factor = self._field.sampled_factor(p, direction, basis, active)
            gains = self._basis.gains(p, direction, active, with_peak=False)
            return ScatteringAt(factor, factor, [gains])
        weights = self._weights.at(p, direction, active, peak_depth)
        narrow = [[channel[i] for i in self._own] for channel in weights]
        values = self._field.factor_and_change(p, basis, active, narrow)
        gains = [[own.gain - own.excluded for own in channel] for channel in weights]
        return ScatteringAt(*values, gains)

    def importance(self, view: tuple, gains: list[mi.Float]) -> list[mi.Float]:
        """Return the components of the importance of rays, given the weights of narrow sources.

        These are the spherical harmonics of their direction, followed by the weight with which the
        irradiance of each narrow source is scattered into it.
        """
        # docs/primer, eq. (8.12)
        *_, moments = view
        return [mi.Float(1), *moments, *(1 + gain for gain in gains)]


def _mean_transmittance(tau: mi.Spectrum, absorbed: mi.Spectrum) -> mi.Spectrum:
    """Return the mean transmittance (1 - e^-tau) / tau from positions within a step to its start.

    ``absorbed`` is 1 - e^-tau.
    """
    thin = tau < 1e-4
    return dr.select(thin, 1 - 0.5 * tau, absorbed / dr.select(thin, 1, tau))


def _derivative_of_mean_transmittance(tau: mi.Spectrum, absorbed: mi.Spectrum) -> mi.Spectrum:
    """Return the derivative of `_mean_transmittance` with respect to ``tau``."""
    thin = tau < 0.05
    series = dr.fma(tau, dr.fma(tau, dr.fma(tau, 1 / 30, -1 / 8), 1 / 3), -1 / 2)
    exact = (dr.fma(1 - absorbed, 1 + tau, -1)) / dr.square(dr.select(thin, 1, tau))
    return dr.select(thin, series, exact)


class FluenceAlongRays(Protocol):
    """Fields of the fluence, see `FluenceFields`."""

    irradiance: GridField
    falloff: InverseSquareFactor | None
    direct_lights: list[DirectLightAlongRays]
    angular: InScattering | None


class CameraReplay:
    """The march of camera rays through a medium.

    Args:
        medium: the medium.
        fluence: its fluence; None if nothing is scattered.
        colour: factors of the channels, if the fluence has one channel for all; else None.
        step: the integrator's property.
        neighbours: marches with phase functions of slightly smaller and larger mean cosine, and the
            difference between these; None if no derivative with respect to it is wanted.
        shorter: number of steps of camera rays in place of one.
    """

    def __init__(
        self,
        medium: MediumGrid,
        fluence: FluenceAlongRays | None,
        colour: mi.Spectrum | None,
        step: float,
        neighbours: tuple[CameraReplay, CameraReplay, float] | None = None,
        shorter: int = 1,
    ) -> None:
        self.medium, self.colour, self._neighbours = medium, colour, None
        if neighbours is not None:
            *marches, difference = neighbours
            self._neighbours = marches, dr.opaque(mi.Float, 1 / difference)
        self.irradiance = self._falloff = self._angular = None
        self.direct_lights: list[DirectLightAlongRays] = []
        if fluence is not None:
            self.irradiance, self._falloff = fluence.irradiance, fluence.falloff
            self.direct_lights, self._angular = fluence.direct_lights, fluence.angular
        irradiance = self.irradiance
        fields = medium.sigma_t, medium.albedo, irradiance
        edges = [f.grid.voxel_size.min() for f in fields if f is not None and f.grid is not None]
        length = min(edges, default=float(max(abs(medium.frame[:3, :3]).max(), 1e-30) / 64))
        self.step = dr.opaque(mi.Float, float(length) * step / shorter)
        #: ratio of the extinction of the truncated forward peak to the scattering coefficient
        self._peak_ratio = dr.opaque(mi.Float, medium.phase.peak_ratio)
        #: step along lines to lights
        self.path_step = dr.opaque(mi.Float, float(length) * step)

    def without_scattering(self) -> CameraReplay:
        """Return a march with the same steps along which the medium scatters nothing."""
        march = copy(self)
        march.irradiance = march._falloff = march._angular = march._neighbours = None
        march.direct_lights = []
        return march

    def indirect(self) -> CameraReplay:
        """Return the march of rays that the camera does not follow, see `InScattering`."""
        return self._with_scattering(InScattering.indirect)

    def without_visible(self) -> CameraReplay:
        """Return the march of rays that do not see narrow sources, see `InScattering`."""
        return self._with_scattering(InScattering.without_visible)

    def _with_scattering(self, change: Callable[[InScattering], InScattering]) -> CameraReplay:
        if self._angular is None:
            return self
        march = copy(self)
        march._angular = change(self._angular)
        if self._neighbours is not None:
            marches, factor = self._neighbours
            march._neighbours = [each._with_scattering(change) for each in marches], factor
        return march

    def sigma_t(self, p: mi.Point3f, active: mi.Bool) -> mi.Spectrum:
        return mi.Spectrum(self.medium.sigma_t.at_world(p, active))

    def albedo(self, p: mi.Point3f, active: mi.Bool) -> mi.Spectrum:
        return mi.Spectrum(self.medium.albedo.at_world(p, active))

    def emitted(self, p: mi.Point3f, length: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """Return the radiance that an emissive medium emits along a step around ``p``."""
        return mi.Spectrum(self.medium.emission.at_world(p, active)) * length

    def view(self, direction: mi.Vector3f) -> tuple:
        """Evaluate what `mean_radiance` needs of the ``direction`` of rays."""
        return () if self._angular is None else self._angular.view(direction)

    def mean_radiance(
        self, p: mi.Point3f, active: mi.Bool, view: tuple, peak_depth: mi.Float | mi.Color3f
    ) -> tuple[mi.Spectrum, mi.Spectrum, list[list[mi.Float]]]:
        """Return Phi / (4 pi), times the factor of anisotropic scattering into the rays; the value
        that takes its place in derivatives with respect to the scattering coefficient; and the
        weights of narrow sources, see `ScatteringAt`.

        ``peak_depth`` is the optical depth of the forward peak between ``p`` and the camera.
        """
        if self.irradiance is None:
            return mi.Spectrum(0), mi.Spectrum(0), [[]]
        phi, gains, direction = mi.Spectrum(self.irradiance.at_world(p, active)), [[]], None
        changed = mi.Spectrum(phi)
        if self._angular is not None:
            direction = view[0]
            factor, of_changes, gains = self._angular.at(p, view, active, peak_depth)
            phi, changed = phi * factor, changed * of_changes
        scale = mi.Spectrum(1) if self.colour is None else self.colour
        if self._falloff is not None:
            scale = scale * self._falloff.at(p)
        phi, changed = phi * scale, changed * scale
        for light in self.direct_lights:
            own, of_changes = light.at_with_change(p, active, direction, peak_depth)
            phi, changed = phi + own, changed + of_changes
        return phi * dr.inv_four_pi, changed * dr.inv_four_pi, gains

    def peak_depth(self, scattering: mi.Spectrum) -> mi.Float | mi.Color3f:
        """Return the optical depth of the forward peak, given that of ``scattering``."""
        depth = scattering * self._peak_ratio
        return depth if self.medium.channels > 1 else depth[0]

    def neighbour_views(self, direction: mi.Vector3f) -> list[tuple]:
        """Return `view` of both neighbours."""
        return [] if self._neighbours is None else [m.view(direction) for m in self._neighbours[0]]

    def by_mean_cosine(
        self,
        p: mi.Point3f,
        active: mi.Bool,
        views: list[tuple],
        peak_depth: mi.Float | mi.Color3f,
    ) -> mi.Spectrum:
        """Return the derivative of `mean_radiance` with respect to the mean cosine."""
        if self._neighbours is None:
            return mi.Spectrum(0)
        marches, factor = self._neighbours
        below, above = (
            march.mean_radiance(p, active, view, peak_depth)[0]
            for march, view in zip(marches, views, strict=True)
        )
        return (above - below) * factor

    def collisions(
        self, collided: mi.Spectrum, view: tuple, gains: list[list[mi.Float]]
    ) -> list[mi.Float]:
        """Return the components of the importance that collides, channel after channel.

        ``gains`` are the weights of narrow sources, see `ScatteringAt`.
        """
        values = list(collided) if self.colour is None else [dr.sum(collided * self.colour)]
        if self._angular is None:
            return values
        channels = [self._angular.importance(view, own) for own in gains]
        channels *= len(values) // len(channels)
        return [
            value * layer
            for value, components in zip(values, channels, strict=True)
            for layer in components
        ]

    def evaluates(self, emitter: mi.Emitter) -> bool:
        """Return whether the irradiance of ``emitter`` is evaluated along rays."""
        return any(light.light.emitter is emitter for light in self.direct_lights)

    def replay_light_paths(
        self, segments: RaySegments, random: mi.Float, splats: CameraSplats | CameraReaders
    ) -> CameraSplats | CameraReaders:
        """Add derivatives with respect to the extinction between the rays and the lights whose
        irradiance is evaluated along them, and return ``splats``.

        From some positions on each ray, there are lines to the lights. The positions are chosen in
        proportion to the radiance of a light that is scattered into the ray there, stratified, with
        uniform numbers ``random`` in [0, 1).
        """
        # docs/primer, below eq. (8.9)
        for light in self.direct_lights:
            paths = self._paths_per_ray(light, dr.width(segments.near))
            total, _, _ = self._scattered_along(light, segments, [])
            dr.eval(total)
            targets = [total * ((random + n) * (1 / paths)) for n in range(paths)]
            _, places, colours = self._scattered_along(light, segments, targets)
            dr.eval(places, colours)
            for place, colour in zip(places, colours, strict=True):
                splats.sigma_t = add_paths_to_light(
                    self.medium,
                    light.light.emitter,
                    segments.ray(place),
                    -colour * total * (1 / paths),
                    self.path_step,
                    splats.sigma_t,
                )
                dr.eval(splats.sigma_t)
        return splats

    def _paths_per_ray(self, light: DirectLightAlongRays, rays: int) -> int:
        """Return the number of lines to a light from each of so many ``rays``."""
        voxels = light.light.extinction.grid.voxel_count
        return int(np.clip(np.ceil(PATHS_PER_VOXEL * voxels / rays), 1, MOST_PATHS_PER_RAY))

    @symbolic
    def _scattered_along(
        self, light: DirectLightAlongRays, segments: RaySegments, targets: list[mi.Float]
    ):
        """Return the radiance of ``light`` that is scattered into rays, times their ``adjoint``.

        It is the sum of the magnitudes in all channels. For each of the ``targets`` the results
        also include the distance along the ray up to which so much is scattered, to within a step,
        and the colour there: the radiance that the step scatters, over its sum.
        """
        ray, near, far, adjoint, offset, active = segments
        k, t, passed = mi.Float(0), mi.Float(near), mi.Spectrum(adjoint)
        transmittance, active = mi.Spectrum(1), mi.Bool(active) & (near < far)
        view, total = self.view(ray.d), mi.Float(0)
        direction = view[0] if view else None
        scattering = mi.Spectrum(0)
        places = [mi.Float(near) for _ in targets]
        colours = [mi.Spectrum(dr.zeros(mi.Float, dr.width(near))) for _ in targets]
        while dr.hint(active, label="camera rays"):
            end = minimum(dr.fma(k + offset, self.step, near), far)
            middle = 0.5 * (t + end)
            p = ray(middle)
            tau, albedo = self.sigma_t(p, active) * (end - t), self.albedo(p, active)
            absorbed, step = absorptance(tau), albedo * tau
            depth = self.peak_depth(scattering + 0.5 * step)
            irradiance, _ = light.at_with_change(p, active, direction, depth)
            value = passed * absorbed * albedo * irradiance * dr.inv_four_pi
            scattering += step
            weight = dr.sum(dr.abs(value))
            for number, target in enumerate(targets):
                # The last step with radiance, if rounding errors leave a target beyond it.
                chosen = active & (weight > 0) & (target >= total)
                places[number] = dr.select(chosen, middle, places[number])
                colours[number] = dr.select(chosen, value / weight, colours[number])
            total += weight
            passed *= 1 - absorbed
            transmittance *= 1 - absorbed
            t = end
            k += 1
            active &= (t < far) & (dr.max(transmittance) > OPAQUE)
        return total, places, colours

    @symbolic
    def radiance(self, segments: RaySegments):
        """Return the radiance that the medium scatters into rays, and its transmittance.

        The radiance is multiplied by the derivative of the objective with respect to it.
        """
        ray, near, far, adjoint, offset, active = segments
        view = self.view(ray.d)
        k, t, total = mi.Float(0), mi.Float(near), mi.Spectrum(0)
        transmittance, active = mi.Spectrum(1), mi.Bool(active) & (near < far)
        scattering = mi.Spectrum(0)
        while dr.hint(active, label="camera rays"):
            end = minimum(dr.fma(k + offset, self.step, near), far)
            p, length = ray(0.5 * (t + end)), end - t
            tau, albedo = self.sigma_t(p, active) * length, self.albedo(p, active)
            absorbed, step = absorptance(tau), albedo * tau
            depth = self.peak_depth(scattering + 0.5 * step)
            mean, _, _ = self.mean_radiance(p, active, view, depth)
            total += transmittance * absorbed * albedo * mean
            scattering += step
            if dr.hint(self.medium.emission is not None, mode="scalar"):
                emitted = self.emitted(p, length, active)
                total += transmittance * _mean_transmittance(tau, absorbed) * emitted
            transmittance *= 1 - absorbed
            t = end
            k += 1
            active &= (t < far) & (dr.max(transmittance) > OPAQUE)
        return total * adjoint, transmittance

    @symbolic
    def transmittance(self, ray: mi.Ray3f, near: mi.Float, far: mi.Float, active: mi.Bool):
        """Return the transmittance of rays between two distances, by the rule of the radiance."""
        k, t, depth = mi.Float(0), mi.Float(near), mi.Spectrum(0)
        active = mi.Bool(active) & (near < far)
        while dr.hint(active, label="transmittance"):
            end = minimum(dr.fma(k + 1, self.step, near), far)
            depth += self.sigma_t(ray(0.5 * (t + end)), active) * (end - t)
            t = end
            k += 1
            active &= t < far
        return dr.exp(-depth)

    @symbolic
    def replay(
        self,
        segments: RaySegments,
        ahead: mi.Spectrum,
        unscattered: mi.Spectrum,
        splats: CameraSplats | CameraReaders,
    ):
        """March the rays again, add derivatives to ``splats``, and return these.

        Args:
            segments: the rays.
            ahead: their radiance, times their ``adjoint``: the result of `radiance`, and the
                attenuated radiance behind the medium.
            unscattered: radiance behind the medium, times ``adjoint``, that is attenuated by the
                extinction before delta-M scaling and is no part of ``ahead``.
            splats: the sums to which derivatives are added.
        """
        # docs/primer, eqs. (8.2), (8.3)
        ray, near, far, adjoint, offset, active = segments
        k, t, ahead = mi.Float(0), mi.Float(near), mi.Spectrum(ahead)
        passed, active = mi.Spectrum(adjoint), mi.Bool(active) & (near < far)
        transmittance, view, scattering = mi.Spectrum(1), self.view(ray.d), mi.Spectrum(0)
        neighbours = (
            self.neighbour_views(ray.d) if dr.hint(splats.g is not None, mode="scalar") else []
        )
        while dr.hint(active, label="camera rays"):
            end = minimum(dr.fma(k + offset, self.step, near), far)
            p, length = ray(0.5 * (t + end)), end - t
            tau = self.sigma_t(p, active) * length
            absorbed, albedo = absorptance(tau), self.albedo(p, active)
            depth = self.peak_depth(scattering + 0.5 * albedo * tau)
            mean, changed, gains = self.mean_radiance(p, active, view, depth)
            ahead -= passed * absorbed * albedo * mean
            share, emitted = mi.Spectrum(1), mi.Spectrum(0)
            if dr.hint(self.medium.emission is not None, mode="scalar"):
                share = _mean_transmittance(tau, absorbed)
                emitted = passed * self.emitted(p, length, active)
                ahead -= share * emitted
            following = passed * (1 - absorbed)
            if dr.hint(splats.sigma_t is not None, mode="scalar"):
                change = length * (following * albedo * changed - ahead)
                if dr.hint(self.medium.emission is not None, mode="scalar"):
                    change += length * emitted * _derivative_of_mean_transmittance(tau, absorbed)
                splats.sigma_t.add(p, summed_to_channels(change, splats.sigma_t.channels), active)
            if dr.hint(splats.albedo is not None, mode="scalar"):
                change = passed * absorbed * changed
                splats.albedo.add(p, summed_to_channels(change, splats.albedo.channels), active)
            if dr.hint(splats.emission is not None, mode="scalar"):
                change = summed_to_channels(passed * share * length, splats.emission.channels)
                splats.emission.add(p, change, active & self.medium.emission.covers(p))
            if dr.hint(splats.collisions is not None, mode="scalar"):
                values = self.collisions(passed * absorbed, view, gains)
                splats.collisions.add(p, values, active)
            if dr.hint(splats.g is not None, mode="scalar"):
                change = self.by_mean_cosine(p, active, neighbours, depth)
                change *= passed * absorbed * albedo
                splats.g.add(p, summed_to_channels(change, splats.g.channels), active)
            if dr.hint(splats.unscattered is not None, mode="scalar"):
                change = summed_to_channels(-length * unscattered, splats.unscattered.channels)
                splats.unscattered.add(p, change, active)
            passed = following
            scattering += albedo * tau
            transmittance *= 1 - absorbed
            t = end
            k += 1
            active &= (t < far) & (dr.max(transmittance) > OPAQUE)
        return splats
