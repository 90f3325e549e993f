"""From derivatives of an objective by the pixels to those by the parameters of the medium."""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.conservative import conserving
from mitsuba_irrcache.cache.direct_light import DirectLight, DirectLightAlongRays
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.emitters import EmitterAdjoint
from mitsuba_irrcache.gradients.film import LUMINANCE, CameraPass, FilmAdjoint
from mitsuba_irrcache.gradients.parameters import (
    ALBEDO,
    EMISSION,
    SIGMA_T,
    channels_of,
    refuse_all,
    roles_of,
    shaped_like,
)
from mitsuba_irrcache.gradients.points import add_ways
from mitsuba_irrcache.gradients.replay import CameraReplay, CameraSplats
from mitsuba_irrcache.gradients.resampling import VoxelQuadrature, volume_of
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, VoxelSums
from mitsuba_irrcache.gradients.transport import AdjointTransport, Derivatives
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.render.camera import ClosedFormCameraRays
from mitsuba_irrcache.scene.compile import media_of

#: Pairs of ordinates for the default directions of the cache, with others in proportion; those
#: under environments that vary, whose spots they have to find; and the fewest.
PAIRS, MOST_PAIRS, FEWEST_PAIRS = 24, 128, 8
UNEVEN = (EmitterKind.ENVIRONMENT_MAP,)
#: How much larger than estimated sums of magnitudes may be, in `FixedPointSums`.
MARGIN = 256.0
#: Bytes for camera samples and copies of tracks; numbers for each voxel, and for each of its
#: channels.
MEMORY, NUMBERS = 3 << 27, (40, 25)
#: Optical depth of a voxel below which its collisions do not matter.
EMPTY = 1e-6


def check(parts: list[CachedMedium], keys: list[str], layered: bool) -> None:
    """Raise IrrcacheError for scenes and settings in which no gradients are computed."""
    if not parts:
        refuse_all(
            keys,
            "no medium is visible, and Mitsuba's volpath renders the scene",
            "Give the shape of the medium a null BSDF",
        )
    if layered:
        refuse_all(keys, "the image is filtered or has aovs", "Set filter to none and no aovs")
    (part, *others), medium = parts, parts[0].medium
    if others or not medium.is_isolated:
        refuse_all(
            keys,
            "there are surfaces, area lights or several media, or the boundary is neither a "
            "box nor a sphere",
            "Reduce the scene to one medium under distant and point lights",
        )
    name = f'medium "{medium.name}"'
    if not medium.phase.is_isotropic:
        refuse_all(keys, f"the phase function of {name} is not isotropic", "Make it isotropic")
    if part.half_space is not None:
        refuse_all(keys, f"{name} is opaque and homogeneous, and has no cache", "Set resolution")
    if part.solver.name != "sweep":
        refuse_all(keys, f'the solver is "{part.solver.name}"', 'Set solver to "sweep"')
    depth = part.settings.max_depth
    if depth > 2:
        refuse_all(keys, f"max_depth is {depth}", "Set max_depth to 1, 2 or -1")


class ParameterAdjoint:
    """Derivatives by the parameters ``keys`` of ``scene`` of objectives of its images, in the types
    of these parameters: what camera rays depend on straight, view by view, and what the irradiance
    depends on, for all views at once.

    ``part`` is the scene's only medium, with its cache; ``image`` are its camera rays and the
    integrator's properties ``step`` and ``emission``; the ordinates depend on ``seed``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        params: mi.SceneParameters,
        keys: list[str],
        part: CachedMedium,
        image: tuple[ClosedFormCameraRays, float, object],
        seed: int,
    ) -> None:
        self._scene, self._params, self._part, self._seed = scene, params, part, seed
        self._camera_rays, self._step, emission = image
        (medium,) = media_of(scene)
        roles = roles_of(params, keys, medium, scene, emission)
        self._of_medium = {k: role for k, role in roles.items() if not isinstance(role, mi.Emitter)}
        _check_emission(part, self._of_medium)
        emitters = [role for role in roles.values() if isinstance(role, mi.Emitter)]
        self._emitters = EmitterAdjoint(scene, emitters)

    def view(self, film: FilmAdjoint) -> tuple[dict[str, object], list[mi.Float] | None]:
        """Derivatives of the objective whose derivatives by the pixels ``film`` has, at a given
        irradiance; and the adjoint fluence that its camera rays leave, None without a cache.
        """
        if film.largest == 0:
            return {}, None
        found, fluence = self._adjoint.replayed(film)
        return self._by_parameters(found), fluence

    def transport(self, fluence: list[mi.Float]) -> dict[str, object]:
        """Derivatives of the objective by way of the irradiance, given the sum of the adjoint
        ``fluence`` of all views.
        """
        return self._by_parameters(self._adjoint.transported(fluence))

    @cached_property
    def _adjoint(self) -> MediumAdjoint:
        wanted: dict[str, int] = {}
        for key, role in self._of_medium.items():
            field = field_of(self._part.medium, role)
            own = field.channels if field.grid is not None else channels_of(self._params[key])
            wanted[role] = max(wanted.get(role, 1), own)
        march = self._camera_rays, self._step
        return MediumAdjoint(self._scene, self._part, march, wanted, self._emitters, self._seed)

    def _by_parameters(self, found: dict[str, mi.Float]) -> dict[str, object]:
        result = {}
        for key, role in self._of_medium.items():
            value, field = self._params[key], field_of(self._part.medium, role)
            result[key] = shaped_like(value, by_parameter(value, field, found[role]))
        return result


def field_of(medium: MediumGrid, role: str) -> Field:
    """The field of ``medium`` that a role names."""
    if role == EMISSION:
        return medium.emission.field
    return medium.sigma_t if role == SIGMA_T else medium.albedo


def _check_emission(part: CachedMedium, of_medium: dict[str, str]) -> None:
    """Refuse derivatives by a medium that emits, and by emission that is 0 everywhere."""
    name = f'medium "{part.medium.name}"'
    others = [key for key, role in of_medium.items() if role != EMISSION]
    if part.medium.emission is not None and others:
        refuse_all(others, f"{name} is emissive", "Remove the emission")
    if part.medium.emission is None and len(others) < len(of_medium):
        refuse_all(
            [key for key in of_medium if key not in others],
            "the emission is 0 everywhere, and ignored",
            "Start with a small positive value",
        )


class MediumAdjoint:
    """Derivatives by the medium of ``part`` in ``scene``; ``image`` are the camera rays and the
    integrator's property ``step``.

    ``wanted`` maps what is wanted, `SIGMA_T`, `ALBEDO` or `EMISSION`, to its channels; the
    derivatives by ``emitters`` are added to their parameters. The ordinates depend on ``seed``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        part: CachedMedium,
        image: tuple[ClosedFormCameraRays, float],
        wanted: dict[str, int],
        emitters: EmitterAdjoint,
        seed: int,
    ) -> None:
        self._scene, self._part, self._wanted = scene, part, wanted
        self._camera_rays, step = image
        self._medium, self._emitters = part.medium, emitters
        self._transport: AdjointTransport | None = None
        self._collided: list[mi.Float] = []
        field, falloff, lights, colour = None, None, [], None
        if part.cache is not None:
            self.grid = part.cache.grid
            self._check_memory()
            self._transport = AdjointTransport(
                scene,
                self._medium,
                self.grid,
                (part.settings.seed, seed),
                self._pairs,
                part.settings.max_depth == 2,
                wanted,
                self._medium.channels == max(wanted.values(), default=3) == 1
                and not emitters
                and EMISSION not in wanted,
            )
            field, falloff, lights = self._irradiance()
            self._quadrature = VoxelQuadrature(self._medium, self.grid)
            self._extinction = list(self._quadrature.extinction())
            dr.eval(self._extinction)
            if self._transport.channels == 1:
                factors = [dr.opaque(mi.Float, float(c)) for c in self._transport.colour]
                colour = mi.Spectrum(factors)
        self._march = CameraReplay(self._medium, field, falloff, lights, colour, step)

    @property
    def _pairs(self) -> int:
        """Pairs of ordinates, in proportion to the directions of the cache."""
        part, environment = self._part, self._scene.environment()
        uneven = environment is not None and kind_of(environment) in UNEVEN
        usual = part.solver.default_samples(
            self._medium, part.settings.max_depth, part.cache.active_count
        )
        share = (part.cache.samples or usual) / usual
        return max(FEWEST_PAIRS, round((MOST_PAIRS if uneven else PAIRS) * share))

    def _check_memory(self) -> None:
        """Refuse an adjoint solve that cannot be held."""
        channels = 1 if mi.is_monochromatic else 3
        needed = MEMORY + 4 * self.grid.voxel_count * sum(
            n * c for n, c in zip(NUMBERS, (1, channels), strict=True)
        )
        sides = " x ".join(map(str, self.grid.shape[::-1]))
        require_memory(needed, f"irrcache: a gradient with {sides} voxels", "lower resolution")

    # The irradiance

    def _irradiance(self) -> tuple[RootField, InverseSquareFactor | None, list]:
        """The irradiance at all voxels, also where there is no matter, for lookups."""
        cache, grid = self._part.cache, self.grid
        count, voxels = grid.voxel_count, dr.arange(mi.UInt32, grid.voxel_count)
        channels, colour = self._transport.channels, self._transport.colour
        cached, all_channels = cache.irradiance.array, cache.channels
        # The brightest of all channels that differ by a factor.
        own = range(channels) if channels == all_channels else [int(colour.argmax())]
        place = voxels * all_channels
        known = [
            dr.gather(mi.Float, cached, place + c) * dr.opaque(mi.Float, 1 / float(colour[c]))
            for c in own
        ]
        swept, self._collided = self._transport.irradiance(known)
        has_value = dr.zeros(mi.Bool, count)
        if cache.active_count and cache.samples:
            dr.scatter(has_value, mi.Bool(True), cache.active)
        total = [dr.select(has_value, a, b) for a, b in zip(known, swept, strict=True)]
        brightest = _largest(total)
        lights = [
            DirectLight(self._scene, light.emitter, self._medium, grid, voxels)
            for light in cache.direct_lights
        ]
        for light in lights:
            total = [
                dr.maximum(t - light.irradiance[c] * dr.opaque(mi.Float, 1 / float(colour[c])), 0)
                for t, c in zip(total, own, strict=True)
            ]
        falloff = InverseSquareFactor.of(self._scene, grid, [light.emitter for light in lights])
        roots = [dr.sqrt(dr.maximum(t, 0)) for t in total]
        if falloff is not None:
            smooth = dr.rsqrt(falloff.of_voxels(voxels))
            roots = [r * smooth for r in roots]
        values = interleaved(roots, count)
        values = conserving(grid, values, dr.full(mi.Bool, True, count), channels)
        field = RootField(grid, values, channels)
        if falloff is not None:
            field.maximum *= falloff.maximum(voxels)
        field.maximum = max([field.maximum, brightest, *(light.maximum for light in lights)])
        return field, falloff, [DirectLightAlongRays(light) for light in lights]

    # The camera

    def replayed(self, film: FilmAdjoint) -> tuple[dict[str, mi.Float], list[mi.Float] | None]:
        """Derivatives by what is wanted, at the data's voxels, of what the camera rays of ``film``
        depend on straight; and the adjoint fluence that they leave in the voxels.
        """
        splats = None
        for each in film.passes():
            span, behind, hit, offset = self._rays(each, film.medium)
            march = each.ray, span, each.radiance
            ahead, passed = self._march.radiance(*march, behind, offset, hit)
            dr.eval(ahead, passed)
            if self._camera_rays.background(self._scene, each.ray, mi.Bool(True))[0]:
                self._emitters.add_background(each.ray, passed * each.radiance)
            if splats is None:
                splats = self._camera_splats(ahead, film)
            self._march.replay(*march, ahead, offset, hit, splats)
            dr.eval()
        found = {role: getattr(splats, role).values() for role in self._wanted}
        if splats.collisions is None:
            return found, None
        return found, self._fluence(splats.collisions)

    def _rays(self, each: CameraPass, medium: mi.Medium | None) -> tuple:
        """For camera rays the distances between which they are in the medium, the weighted radiance
        behind it, whether there is any such, and the first step. ``medium`` is around the sensor.
        """
        ray, camera_rays = each.ray, self._camera_rays
        visible, background = camera_rays.background(self._scene, ray, mi.Bool(True))
        behind = each.radiance * background if visible else mi.Spectrum(0)
        if each.alpha is not None and not visible:
            behind = behind - each.alpha / dr.size_v(mi.Spectrum)
        hit, near, far = camera_rays.span(ray, medium)
        offset = 1 - each.sampler.next_1d()
        span = mi.Float(near), mi.Float(far)
        dr.eval(ray, span, behind, hit, offset, each.radiance)
        return span, behind, hit, offset

    def _camera_splats(self, ahead: mi.Spectrum, film: FilmAdjoint) -> CameraSplats:
        """Empty sums for the derivatives that are wanted."""
        lengths = np.linalg.norm(self._medium.frame[:3, :3], axis=0)
        diagonal, rays = float(np.linalg.norm(lengths)), film.samples * MARGIN
        largest = film.largest * film.pixels * MARGIN
        brightest = max(float(dr.max(dr.max(dr.abs(ahead)))[0]) * rays, 1e-30)
        irradiance = self._march.irradiance
        mean = irradiance.maximum / (4 * np.pi) if irradiance is not None else 0.0
        needs = self._transport is not None
        return CameraSplats(
            self._splat(SIGMA_T, (brightest + largest * mean) * diagonal),
            self._splat(ALBEDO, largest * mean),
            VoxelSums(self.grid, self._transport.channels, largest) if needs else None,
            self._splat(EMISSION, largest * diagonal),
        )

    def _splat(self, role: str, bound: float) -> GridSplat | ConstantSplat | None:
        """Empty sums of the derivative by a field of the medium; None if it is not wanted."""
        if role not in self._wanted:
            return None
        field = field_of(self._medium, role)
        if field.grid is None:
            return ConstantSplat(self._wanted[role], bound)
        return GridSplat(field.grid, field.channels, bound)

    # Transport

    def _fluence(self, sums: VoxelSums) -> list[mi.Float]:
        """The adjoint fluence of camera rays for collisions in the voxels, by channel."""
        # docs/primer, eq. (8.4)
        least = dr.opaque(mi.Float, EMPTY / float(self.grid.voxel_size.min()))
        per_volume = dr.opaque(mi.Float, 1 / volume_of(self.grid))
        found = [
            dr.select(mean > least, total * per_volume / dr.maximum(mean, least), 0)
            for total, mean in zip(sums.values(), self._extinction, strict=False)
        ]
        dr.eval(found)
        return found

    def transported(self, fluence: list[mi.Float]) -> dict[str, mi.Float]:
        """Derivatives by what is wanted, at the data's voxels, of the radiance that reaches the
        voxels, given the adjoint ``fluence`` of camera rays.
        """
        transport = self._transport
        camera = fluence[: transport.channels]
        found = transport.derivatives(self._collided, camera, self._extinction)
        self._emitters.add_transport(transport, found)
        if not self._wanted:
            return {}
        volume = 3 * MARGIN * abs(np.linalg.det(self._medium.frame[:3, :3]))
        collided = _largest(found.collided)
        splats = {
            SIGMA_T: self._splat(SIGMA_T, volume * (_largest(found.sigma_t) + collided)),
            ALBEDO: self._splat(ALBEDO, volume * collided * self._medium.sigma_t.maximum),
            EMISSION: self._splat(EMISSION, volume * _largest(found.emitted)),
        }
        of_medium = splats[SIGMA_T], splats[ALBEDO], found, transport.albedo
        self._quadrature.add(*of_medium, splats[EMISSION])
        result = {role: splats[role].values() for role in self._wanted}
        if SIGMA_T in self._wanted:
            lights = zip(transport.point_lights, transport.from_points, strict=True)
            for emitter, irradiance in lights:
                result[SIGMA_T] = result[SIGMA_T] + self._along_ways(emitter, irradiance, found)
        return result

    def _along_ways(
        self, emitter: mi.Emitter, irradiance: mi.Spectrum, found: Derivatives
    ) -> mi.Float:
        """The derivative by the extinction between a point-like light and the voxels."""
        grid = self.grid
        share = dr.opaque(mi.Float, -volume_of(grid))
        removed = irradiance * mi.Spectrum(*found.direct) * share
        dr.eval(removed)
        diagonal = float(np.linalg.norm(grid.side_lengths))
        bound = float(dr.max(dr.max(dr.abs(removed)))[0]) * grid.voxel_count * diagonal * 3
        splat = self._splat(SIGMA_T, bound * MARGIN)
        add_ways(self._medium, emitter, self._transport.positions, removed, self._march.step, splat)
        return splat.values()


def _largest(channels: list[mi.Float]) -> float:
    """The largest magnitude; 0 without any channels."""
    return max((float(dr.max(dr.abs(values))[0]) for values in channels), default=0.0)


def by_parameter(value: object, field: Field, grad: mi.Float) -> mi.Float:
    """The derivative by a parameter's ``value`` from that by the ``field`` made of it: grids have a
    scale, and in monochromatic variants the luminance of coloured data.
    """
    if field.grid is None:
        return grad * dr.opaque(mi.Float, field.scale)
    grad = grad * field.scale
    if dr.is_tensor_v(value) and value.shape[3] != field.channels:
        grad = interleaved([grad * share for share in LUMINANCE])
    dr.eval(grad)
    return grad
