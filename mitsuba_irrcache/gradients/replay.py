"""Replay of camera rays: what an image depends on along them, and the adjoint fluence that they
leave in the medium.

A ray's radiance is L = sum_k T_k (1 - e^-tau_k) q_k + T B, with the source q = albedo Phi / (4 pi)
in the middle of each step, and the radiance B behind the medium. It is marched twice: once for L,
and again with the radiance that is still ahead, which is L minus what was gathered (Vicini et al.
2021 replay paths for the same reason).
"""

from __future__ import annotations

from typing import Protocol

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis, AngularField
from mitsuba_irrcache.cache.direct_light import DirectLightAlongRays
from mitsuba_irrcache.core.fast_math import absorptance, minimum
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, VoxelSums, of_channels
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.media.medium import MediumGrid

#: Transmittance below which nothing ahead matters.
OPAQUE = 1e-6


class CameraSplats:
    """Where the replay adds derivatives: by extinction, albedo and emission at positions, and the
    adjoint fluence of collisions in voxels, layer by layer of each channel. ``unscattered`` is that
    by the extinction before delta-M scaling, which attenuates narrow sources behind the medium;
    ``g`` that by the mean cosine of the phase function. None where a derivative is not wanted.

    It is no dataclass, whose fields would be state of the recorded loop.
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


class InScattering:
    """Anisotropic scattering into camera rays: ``field`` is the factor of the irradiance, and
    ``basis`` has all narrow sources.
    """

    def __init__(self, field: AngularField, basis: AngularBasis) -> None:
        self._field, self._basis = field, basis

    def in_basis(self, basis: AngularBasis) -> InScattering:
        """The same with another phase function of the field."""
        return InScattering(self._field.in_basis(basis), self._basis)

    def view(self, direction: mi.Vector3f) -> tuple:
        """What depends on the ``direction`` of rays alone."""
        moments = list(dr.sh_eval(-direction, self._basis.order))[1:]
        return direction, self._field.directional.basis(direction), moments

    def factor(self, p: mi.Point3f, view: tuple, active: mi.Bool) -> mi.Float | mi.Color3f:
        """`AngularField.factor`."""
        direction, basis, _ = view
        return self._field.factor(p, direction, basis, active)

    def importance(self, p: mi.Point3f, view: tuple, active: mi.Bool) -> list[mi.Float]:
        """Layers of the importance of a ray: moments of its direction, and what the irradiance of
        each narrow source is weighted by.
        """
        # docs/primer, eq. (8.12)
        direction, _, moments = view
        gains = [1 + gain for gain in self._basis.gains(p, direction, active)]
        return [mi.Float(1), *moments, *gains]


class FluenceAlongRays(Protocol):
    """Fields of the fluence, see `FluenceFields`."""

    irradiance: GridField
    falloff: InverseSquareFactor | None
    direct_lights: list[DirectLightAlongRays]
    angular: InScattering | None


class CameraReplay:
    """The march of camera rays through ``medium``, whose ``fluence`` is None where nothing is
    scattered.

    All channels of the fluence are one, times the factors ``colour``, unless that is None. ``step``
    is the integrator's property. ``beside`` are marches with phase functions beside that of the
    medium, and the difference between their mean cosines; None where none is known.
    """

    def __init__(
        self,
        medium: MediumGrid,
        fluence: FluenceAlongRays | None,
        colour: mi.Spectrum | None,
        step: float,
        beside: tuple[CameraReplay, CameraReplay, float] | None = None,
    ) -> None:
        self.medium, self.colour, self._beside = medium, colour, None
        if beside is not None:
            *marches, difference = beside
            self._beside = marches, dr.opaque(mi.Float, 1 / difference)
        self.irradiance = self._falloff = self._angular = None
        self._direct_lights: list[DirectLightAlongRays] = []
        if fluence is not None:
            self.irradiance, self._falloff = fluence.irradiance, fluence.falloff
            self._direct_lights, self._angular = fluence.direct_lights, fluence.angular
        irradiance = self.irradiance
        fields = medium.sigma_t, medium.albedo, irradiance
        edges = [f.grid.voxel_size.min() for f in fields if f is not None and f.grid is not None]
        length = min(edges, default=float(max(abs(medium.frame[:3, :3]).max(), 1e-30) / 64))
        self.step = dr.opaque(mi.Float, float(length) * step)

    def sigma_t(self, p: mi.Point3f, active: mi.Bool) -> mi.Spectrum:
        return mi.Spectrum(self.medium.sigma_t.at_world(p, active))

    def albedo(self, p: mi.Point3f, active: mi.Bool) -> mi.Spectrum:
        return mi.Spectrum(self.medium.albedo.at_world(p, active))

    def view(self, direction: mi.Vector3f) -> tuple:
        """What `mean_radiance` needs of the ``direction`` of rays."""
        return () if self._angular is None else self._angular.view(direction)

    def mean_radiance(self, p: mi.Point3f, active: mi.Bool, view: tuple = ()) -> mi.Spectrum:
        """Phi / (4 pi), with the phase function for scattering into rays."""
        if self.irradiance is None:
            return mi.Spectrum(0)
        phi = mi.Spectrum(self.irradiance.at_world(p, active))
        direction = None
        if self._angular is not None:
            direction = view[0]
            phi = phi * self._angular.factor(p, view, active)
        if self.colour is not None:
            phi = phi * self.colour
        if self._falloff is not None:
            phi = phi * self._falloff.at(p)
        for light in self._direct_lights:
            phi = phi + light.at(p, active, direction, with_peak=True)
        return phi * dr.inv_four_pi

    def views_beside(self, direction: mi.Vector3f) -> list[tuple]:
        """Results of `view` of the marches beside this one."""
        return [] if self._beside is None else [m.view(direction) for m in self._beside[0]]

    def by_mean_cosine(self, p: mi.Point3f, active: mi.Bool, views: list[tuple]) -> mi.Spectrum:
        """The derivative of `mean_radiance` by the mean cosine of the phase function."""
        if self._beside is None:
            return mi.Spectrum(0)
        marches, factor = self._beside
        below, above = (
            march.mean_radiance(p, active, view) for march, view in zip(marches, views, strict=True)
        )
        return (above - below) * factor

    def collisions(
        self, collided: mi.Spectrum, p: mi.Point3f, active: mi.Bool, view: tuple
    ) -> list[mi.Float]:
        """Layers of the importance that collides, channel by channel."""
        values = list(collided) if self.colour is None else [dr.sum(collided * self.colour)]
        if self._angular is None:
            return values
        layers = self._angular.importance(p, view, active)
        return [value * layer for value in values for layer in layers]

    @symbolic
    def radiance(
        self,
        ray: mi.Ray3f,
        span: tuple[mi.Float, mi.Float],
        adjoint: mi.Spectrum,
        offset: mi.Float,
        active: mi.Bool,
    ):
        """The radiance that the medium scatters into rays, times ``adjoint``; and the
        transmittance. ``span`` are the distances at which rays enter and leave, ``offset`` in
        (0, 1] is the first step in steps.
        """
        near, far = span
        view = self.view(ray.d)
        k, t, total = mi.Float(0), mi.Float(near), mi.Spectrum(0)
        transmittance, active = mi.Spectrum(1), mi.Bool(active) & (near < far)
        while dr.hint(active, label="camera rays"):
            end = minimum(dr.fma(k + offset, self.step, near), far)
            p = ray(0.5 * (t + end))
            absorbed = absorptance(self.sigma_t(p, active) * (end - t))
            source = self.albedo(p, active) * self.mean_radiance(p, active, view)
            total += transmittance * absorbed * source
            transmittance *= 1 - absorbed
            t = end
            k += 1
            active &= (t < far) & (dr.max(transmittance) > OPAQUE)
        return total * adjoint, transmittance

    @symbolic
    def replay(
        self,
        ray: mi.Ray3f,
        span: tuple[mi.Float, mi.Float],
        adjoint: mi.Spectrum,
        ahead: mi.Spectrum,
        offset: mi.Float,
        active: mi.Bool,
        splats: CameraSplats,
        unscattered: mi.Spectrum,
    ):
        """March again, and add to ``splats``. ``adjoint`` is the derivative of the objective by
        the rays' radiance; ``ahead`` is the result of `radiance` and what reaches the ray from
        behind the medium, all times ``adjoint``. ``unscattered`` is what is attenuated by the
        extinction before delta-M scaling instead. The other arguments are those of `radiance`.
        """
        # docs/primer, eqs. (8.2), (8.3)
        near, far = span
        k, t, ahead = mi.Float(0), mi.Float(near), mi.Spectrum(ahead)
        passed, active = mi.Spectrum(adjoint), mi.Bool(active) & (near < far)
        transmittance, view = mi.Spectrum(1), self.view(ray.d)
        beside = self.views_beside(ray.d) if dr.hint(splats.g is not None, mode="scalar") else []
        while dr.hint(active, label="camera rays"):
            end = minimum(dr.fma(k + offset, self.step, near), far)
            p, length = ray(0.5 * (t + end)), end - t
            tau = self.sigma_t(p, active) * length
            absorbed = absorptance(tau)
            mean, albedo = self.mean_radiance(p, active, view), self.albedo(p, active)
            ahead -= passed * absorbed * albedo * mean
            following = passed * (1 - absorbed)
            if dr.hint(splats.sigma_t is not None, mode="scalar"):
                change = length * (following * albedo * mean - ahead)
                splats.sigma_t.add(p, of_channels(change, splats.sigma_t.channels), active)
            if dr.hint(splats.albedo is not None, mode="scalar"):
                change = passed * absorbed * mean
                splats.albedo.add(p, of_channels(change, splats.albedo.channels), active)
            if dr.hint(splats.emission is not None, mode="scalar"):
                thin = tau < 1e-4
                share = dr.select(thin, 1 - 0.5 * tau, absorbed / dr.select(thin, 1, tau))
                change = of_channels(passed * share * length, splats.emission.channels)
                splats.emission.add(p, change, active & self.medium.emission.covers(p))
            if dr.hint(splats.collisions is not None, mode="scalar"):
                values = self.collisions(passed * absorbed, p, active, view)
                splats.collisions.add(p, values, active)
            if dr.hint(splats.g is not None, mode="scalar"):
                change = passed * absorbed * albedo * self.by_mean_cosine(p, active, beside)
                splats.g.add(p, of_channels(change, 1), active)
            if dr.hint(splats.unscattered is not None, mode="scalar"):
                change = of_channels(-length * unscattered, splats.unscattered.channels)
                splats.unscattered.add(p, change, active)
            passed = following
            transmittance *= 1 - absorbed
            t = end
            k += 1
            active &= (t < far) & (dr.max(transmittance) > OPAQUE)
