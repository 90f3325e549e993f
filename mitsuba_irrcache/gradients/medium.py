"""Derivatives of an objective with respect to the fields of a medium."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.gradients.border_error import (
    POSITIONS,
    SHORTER,
    is_dense_at_illuminated_border,
)
from mitsuba_irrcache.gradients.emitters import EmitterAdjoint
from mitsuba_irrcache.gradients.film import CameraPass, FilmAdjoint
from mitsuba_irrcache.gradients.fluence import FluenceFields
from mitsuba_irrcache.gradients.forward_peak import with_forward_peak
from mitsuba_irrcache.gradients.parameters import (
    ALBEDO,
    EMISSION,
    MEAN_COSINE,
    SIGMA_T,
    Placement,
)
from mitsuba_irrcache.gradients.phase_function import NeighbouringPhases
from mitsuba_irrcache.gradients.placement import placement_derivative
from mitsuba_irrcache.gradients.points import add_paths_to_light
from mitsuba_irrcache.gradients.replay import CameraReplay, CameraSplats, RaySegments
from mitsuba_irrcache.gradients.resampling import VoxelQuadrature, volume_of
from mitsuba_irrcache.gradients.scattering import Components, split
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, VoxelSums
from mitsuba_irrcache.gradients.transport import AdjointTransport, Derivatives, TransportSettings
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.render.blurred_background import environment_along
from mitsuba_irrcache.render.camera import ClosedFormCameraRays

#: Numbers of pairs of ordinates where the cache has its default number of directions: usually; for
#: phase functions with a forward peak, which have moments of higher order; and under environments
#: that vary, whose bright spots the ordinates have to sample. With other numbers of directions
#: they are in proportion, but not below the last one.
PAIRS, SHARP_PAIRS, MOST_PAIRS, FEWEST_PAIRS = 24, 64, 128, 8
#: Kinds of environments that vary.
UNEVEN = (EmitterKind.ENVIRONMENT_MAP,)
#: Factor by which sums of magnitudes may exceed their estimates, in `FixedPointSums`.
MARGIN = 256.0
#: Memory for camera samples and copies of tracks [bytes]; and numbers that are stored for each
#: voxel, for each of its channels, and for each higher moment of each channel.
MEMORY, NUMBERS = 3 << 27, (40, 25, 12)
#: Optical depth of a voxel below which its collisions are neglected.
EMPTY = 1e-6


def original_of(medium: MediumGrid) -> MediumGrid:
    """Return the medium of the scene, before delta-M scaling."""
    return medium.original or medium


def field_of(medium: MediumGrid, role: str) -> Field:
    """Return the field of ``medium`` with a role: `SIGMA_T`, `ALBEDO` or `EMISSION`."""
    if role == EMISSION:
        return medium.emission.field
    return medium.sigma_t if role == SIGMA_T else medium.albedo


def sums_for(medium: MediumGrid, wanted: dict[str, int]) -> dict[str, int]:
    """Return the number of channels of the derivatives to sum, by role.

    With delta-M scaling, the ``wanted`` derivative with respect to the albedo follows from those
    with respect to both the scaled extinction and the scaled albedo.
    """
    if medium.original is None or wanted.keys() <= {EMISSION}:
        return dict(wanted)
    channels = max(medium.channels, *wanted.values())
    roles = (SIGMA_T, ALBEDO) if wanted.keys() & {ALBEDO, MEAN_COSINE} else (SIGMA_T,)
    return wanted | dict.fromkeys(roles, channels)


class MediumAdjoint:
    """Derivatives of an objective with respect to the medium of ``part`` in ``scene``.

    Args:
        scene: the scene.
        part: its only medium, with the cache.
        image: the camera rays, and the integrator's property ``step``.
        wanted: number of channels of each derivative to compute, by role: `SIGMA_T`, `ALBEDO`,
            `EMISSION` or `MEAN_COSINE`.
        emitters: receives the derivatives with respect to the radiance of emitters.
        seed: determines the ordinates.
        channels_apart: whether a single channel may not represent all.
    """

    def __init__(
        self,
        scene: mi.Scene,
        part: CachedMedium,
        image: tuple[ClosedFormCameraRays, float],
        wanted: dict[str, int],
        emitters: EmitterAdjoint,
        seed: int,
        channels_apart: bool = False,
    ) -> None:
        self._scene, self._part, self._wanted = scene, part, wanted
        self._camera_rays, step = image
        self.medium, self._emitters = part.medium, emitters
        #: number of positions in each voxel from which there are paths to lights
        self.positions, shorter = 1, 1
        if SIGMA_T in wanted and is_dense_at_illuminated_border(part):
            self.positions, shorter = POSITIONS, SHORTER
        #: emitters with respect to whose position or direction there are derivatives
        self.placements: list[Placement] = []
        self.transport: AdjointTransport | None = None
        #: number of channels of the sums for each role
        self._sums = sums_for(part.medium, wanted)
        self.fluence: FluenceFields | None = None
        #: for derivatives with respect to the mean cosine
        self.phases: NeighbouringPhases | None = None
        colour = None
        if part.cache is not None:
            self.grid = part.cache.grid
            self._check_memory()
            self.transport = self._new_transport(seed, channels_apart)
            self.phases = self.transport.neighbours
            self.fluence = FluenceFields(scene, self.medium, part.cache, self.transport)
            self.quadrature = VoxelQuadrature(self.medium, self.grid)
            self.extinction = list(self.quadrature.extinction())
            dr.eval(self.extinction)
            if self.transport.channels == 1:
                factors = [dr.opaque(mi.Float, float(c)) for c in self.transport.colour]
                colour = mi.Spectrum(factors)
        neighbours = None
        if self.phases is not None:
            phases = self.phases.below, self.phases.above
            marches = [
                CameraReplay(self.medium, fluence, colour, step, shorter=shorter)
                for fluence in map(self.fluence.scattered_by, phases)
            ]
            neighbours = (*marches, self.phases.step)
        self.march = CameraReplay(self.medium, self.fluence, colour, step, neighbours, shorter)

    def _new_transport(self, seed: int, channels_apart: bool) -> AdjointTransport:
        settings, wanted = self._part.settings, self._wanted
        is_grey = self.medium.channels == max(wanted.values(), default=3) == 1
        return AdjointTransport(
            self._scene,
            self.medium,
            self.grid,
            self._sums,
            TransportSettings(
                (settings.seed, seed),
                self._pairs,
                single=settings.max_depth == 2,
                grey=is_grey and not (channels_apart or self._emitters or EMISSION in wanted),
                has_dense_boundary=self._part.cache.interpolation.border is not None,
            ),
        )

    @property
    def _pairs(self) -> int:
        """Return the number of pairs of ordinates, in proportion to the directions of the cache."""
        part, environment = self._part, self._scene.environment()
        uneven = environment is not None and kind_of(environment) in UNEVEN
        usual = part.solver.default_samples(
            self.medium, part.settings.max_depth, part.cache.active_count
        )
        share = (part.cache.samples or usual) / usual
        pairs = SHARP_PAIRS if self.medium.phase.forward else PAIRS
        return max(FEWEST_PAIRS, round((MOST_PAIRS if uneven else pairs) * share))

    def _check_memory(self) -> None:
        """Raise IrrcacheError if the adjoint solve needs more memory than is free."""
        channels, moments = 1 if mi.is_monochromatic else 3, values_per_voxel(self._part.cache) - 1
        counts = 1, channels, channels * moments
        needed = MEMORY + 4 * self.grid.voxel_count * sum(
            n * c for n, c in zip(NUMBERS, counts, strict=True)
        )
        sides = " x ".join(map(str, self.grid.shape[::-1]))
        require_memory(needed, f"irrcache: a gradient with {sides} voxels", "lower resolution")

    # The camera

    def replayed(self, film: FilmAdjoint) -> tuple[dict[str, mi.Float], list[mi.Float] | None]:
        """Return the derivatives at a fixed fluence, and the adjoint fluence of the camera rays.

        ``film`` provides the camera rays. The derivatives are flat arrays at the voxels of the
        data, by role. The adjoint fluence is one array per channel, see `_adjoint_fluence`; None
        without a cache.
        """
        splats = None
        for each in film.passes():
            segments, behind, weights = self.rays(each, film.medium)
            ahead, transmittance, original = self.marched(segments)
            peaked, blurred = self.blurred(each, segments, weights[0], transmittance, original)
            behind = behind[0] + blurred, behind[1] - blurred
            ahead, unscattered = ahead + transmittance * behind[0], original * behind[1]
            visible = (transmittance * weights[0] + original * weights[1]) * each.radiance
            visible -= sum((weight for _, weight in peaked), mi.Spectrum(0))
            dr.eval(ahead, visible, unscattered, peaked)
            if self._scene.environment() is not None:
                self._emitters.add_background(each.ray.d, visible)
                for direction, weight in peaked:
                    self._emitters.add_background(direction, weight)
            if splats is None:
                splats = self._camera_splats(dr.abs(ahead) + dr.abs(unscattered), film)
            self.march.replay(segments, ahead, unscattered, splats)
            dr.eval()
            if splats.sigma_t is not None:
                self.march.replay_light_paths(segments, each.sampler.next_1d(), splats)
                dr.eval()
        found = self._at_data({role: getattr(splats, role).values() for role in self._sums})
        if splats.unscattered is not None:
            found[SIGMA_T] = found[SIGMA_T] + splats.unscattered.values()
        if splats.collisions is None:
            return found, None
        return found, self._adjoint_fluence(splats.collisions)

    def marched(self, segments: RaySegments) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum]:
        """Return the weighted radiance that the medium scatters into rays, and transmittances: that
        of the medium as it is rendered, and that before delta-M scaling.
        """
        ahead, transmittance = self.march.radiance(segments)
        original = transmittance
        if self.is_scaled:
            projection = self._camera_rays.projection
            original = projection.unscattered(
                transmittance, segments.ray, segments.near, segments.far, segments.active
            )
        return ahead, transmittance, original

    def blurred(
        self,
        each: CameraPass,
        segments: RaySegments,
        share: mi.Float,
        transmittance: mi.Spectrum,
        original: mi.Spectrum,
    ) -> tuple[list[tuple[mi.Vector3f, mi.Spectrum]], mi.Spectrum]:
        """Sample directions of radiance that a forward peak scatters, see
        `ClosedFormCameraRays.blur`. ``share`` is the weight of the transmittance of the scaled
        medium, see `rays`.

        Returns the directions, with weights that include those of the rays; and the weighted change
        of the radiance behind the medium, over the difference of both transmittances.
        """
        rays, ray, scene = self._camera_rays, segments.ray, self._scene
        change, found = mi.Spectrum(0), []
        if not (self.is_scaled and rays.blurs(scene)):
            return found, change
        u, before = each.sampler.next_2d(), environment_along(scene, ray, ray.d)
        transmittances, active = (transmittance, original), segments.active & (share != 0)
        for direction, weight in rays.blur(ray, *transmittances, u=u, active=active):
            weight = weight * each.radiance
            change += weight * (environment_along(scene, ray, direction) - before)
            found.append((direction, weight * (transmittance - original)))
        return found, change

    @property
    def shows_environment(self) -> bool:
        """Whether an environment is visible behind the medium."""
        rays = self._camera_rays
        seen = self._scene.environment() is not None and not rays.hide_emitters
        return seen and rays.shows_emitters

    @property
    def is_scaled(self) -> bool:
        """Return whether the medium is scaled by delta-M, and scatters."""
        return self.medium.original is not None and self.fluence is not None

    def _at_data(self, found: dict[str, mi.Float]) -> dict[str, mi.Float]:
        """Convert derivatives with respect to the rendered medium to those of the scene's medium.

        These differ by delta-M scaling.
        """
        if self.medium.original is None or self._sums.keys() <= {EMISSION}:
            return found
        change = self.phases.forward if self.phases is not None else 0.0
        return with_forward_peak(self.medium, found, self._sums[SIGMA_T], self._wanted, change)

    def rays(self, each: CameraPass, medium: mi.Medium | None) -> tuple:
        """Return what the march of camera rays starts from.

        ``medium`` is the one around the sensor. The results are

        - the rays within the medium;
        - two weighted radiances behind it: one that is attenuated by the transmittance of the
          medium as it is rendered, and one that is attenuated by that before delta-M scaling;
        - the weights of an environment in both of these.
        """
        ray, camera_rays = each.ray, self._camera_rays
        visible, background, *weights = camera_rays.background(
            self._scene, ray, medium, mi.Bool(True)
        )
        behind = [each.radiance * background * weight for weight in weights]
        if not (visible or self.is_scaled):
            weights = [mi.Float(0), mi.Float(0)]
        if each.alpha is not None and not visible:
            behind[self.is_scaled] -= each.alpha / dr.size_v(mi.Spectrum)
        hit, near, far = camera_rays.span(ray, medium)
        offset = 1 - each.sampler.next_1d()
        segments = RaySegments(ray, mi.Float(near), mi.Float(far), each.radiance, offset, hit)
        dr.eval(segments, behind, weights)
        return segments, behind, weights

    def _camera_splats(self, ahead: mi.Spectrum, film: FilmAdjoint) -> CameraSplats:
        """Return sums, 0 at first, for the derivatives that are wanted.

        ``ahead`` is the largest weighted radiance of the rays, which bounds the sums.
        """
        lengths = np.linalg.norm(self.medium.frame[:3, :3], axis=0)
        diagonal, rays = float(np.linalg.norm(lengths)), film.samples * MARGIN
        largest = film.largest * film.pixels * MARGIN
        peak = self.medium.phase.peak
        brightest = max(float(dr.max(dr.max(dr.abs(ahead)))[0]) * rays, 1e-30)
        irradiance = self.march.irradiance
        mean = irradiance.maximum * peak / (4 * np.pi) if irradiance is not None else 0.0
        collisions = unscattered = None
        if self.transport is not None:
            components = self.transport.channels * self.transport.scattering.camera_count
            collisions = VoxelSums(self.grid, components, largest * peak)
        if self.is_scaled and SIGMA_T in self._wanted:
            original, bound = self.medium.original.sigma_t, brightest * diagonal
            unscattered = splat_of(original, self._wanted[SIGMA_T], bound)
        return CameraSplats(
            self._splat(SIGMA_T, (brightest + largest * mean) * diagonal),
            self._splat(ALBEDO, largest * mean),
            collisions,
            self._splat(EMISSION, largest * diagonal),
            unscattered,
            ConstantSplat(1, largest * mean * MARGIN) if MEAN_COSINE in self._wanted else None,
        )

    def _splat(self, role: str, bound: float) -> GridSplat | ConstantSplat | None:
        """Return sums for derivatives with respect to a field; None if they are not wanted."""
        if role not in self._sums:
            return None
        return splat_of(field_of(self.medium, role), self._sums[role], bound)

    # Transport

    def _adjoint_fluence(self, sums: VoxelSums) -> list[mi.Float]:
        """Return the adjoint fluence of camera rays for collisions in the voxels.

        It is one array for each channel, whose components follow each other.
        """
        extinction = self.extinction[: self.transport.channels]
        count = self.transport.scattering.camera_count
        found = means_over_collisions(self.grid, sums, extinction, count)
        return [concatenated(components) for components in found]

    def transported(self, fluence: list[mi.Float]) -> dict[str, mi.Float]:
        """Return the derivatives through the fluence, given its adjoint of all camera rays.

        ``fluence`` is the sum of the arrays that `replayed` returns. The derivatives are flat
        arrays at the voxels of the data, by role.
        """
        transport = self.transport
        count = transport.scattering.camera_count
        camera = [split(values, count) for values in fluence[: transport.channels]]
        found = transport.derivatives(self.fluence.collided, camera, self.extinction)
        self._emitters.add_transport(transport, found)
        placed = {
            role: placement_derivative(role.emitter, self.medium, transport, found)
            for role in self.placements
        }
        if not self._wanted:
            return placed
        volume = 3 * MARGIN * abs(np.linalg.det(self.medium.frame[:3, :3]))
        collided = _largest(found.collided)
        splats = {
            SIGMA_T: self._splat(SIGMA_T, volume * (_largest(found.sigma_t) + collided)),
            ALBEDO: self._splat(ALBEDO, volume * collided * self.medium.sigma_t.maximum),
            EMISSION: self._splat(EMISSION, volume * _largest(found.emitted)),
        }
        of_medium = splats[SIGMA_T], splats[ALBEDO], found, transport.albedo
        self.quadrature.add(*of_medium, splats[EMISSION])
        result = {role: splats[role].values() for role in self._sums if role in splats}
        if MEAN_COSINE in self._wanted:
            total = sum(np.array(values, dtype=np.float64).sum() for values in found.g)
            result[MEAN_COSINE] = mi.Float(total * volume_of(self.grid))
        if SIGMA_T in self._sums:
            for light in range(len(transport.lights.emitters)):
                own = self._along_paths_to_light(light, found, camera)
                result[SIGMA_T] = result[SIGMA_T] + own
        return self._at_data(result) | placed

    def _along_paths_to_light(
        self, light: int, found: Derivatives, camera: list[Components]
    ) -> mi.Float:
        """Return derivatives through the extinction between an emitter and the voxels.

        ``camera`` is the adjoint fluence of camera rays. If the irradiance of the emitter is
        evaluated along these, `replayed` returns their own derivatives.
        """
        grid, lights = self.grid, self.transport.lights
        # A single channel that represents all holds the sum of their derivatives.
        several = dr.size_v(mi.Spectrum) // self.transport.channels
        share = dr.opaque(mi.Float, -volume_of(grid) / several)
        by_irradiance = lights.derivative(light, found.direct)
        if self.march.evaluates(lights.emitters[light]):
            own = self.transport.seen_directly(camera, self.extinction)
            by_irradiance -= lights.derivative(light, own)
        removed = lights.irradiance[light] * by_irradiance * share
        dr.eval(removed)
        # Elsewhere in the voxel the irradiance is at most that without the medium.
        brightest = lights.unattenuated(light, removed) if self.positions > 1 else removed
        largest = float(dr.max(dr.max(dr.abs(brightest)))[0])
        diagonal = float(np.linalg.norm(grid.side_lengths))
        bound = largest * grid.voxel_count * diagonal * 3
        splat, emitter = self._splat(SIGMA_T, bound * MARGIN), lights.emitters[light]
        for p, own in lights.positions_within(light, self.positions):
            change = removed * own
            dr.eval(change)
            add_paths_to_light(self.medium, emitter, p, change, self.march.path_step, splat)
        return splat.values()


def splat_of(field: Field, channels: int, bound: float) -> GridSplat | ConstantSplat:
    """Return sums, 0 at first, for derivatives with respect to the data of a ``field``.

    ``bound`` is an upper bound of the sum of their magnitudes.
    """
    if field.grid is None:
        return ConstantSplat(channels, bound)
    return GridSplat(field.grid, channels, bound)


def means_over_collisions(
    grid: Grid, sums: VoxelSums, extinction: list[mi.Float], count: int
) -> list[Components]:
    """Return the adjoint fluence of the collisions in ``sums``, by channel: ``count`` components.

    ``extinction`` has its means over the voxels of ``grid``, by channel.
    """
    # docs/primer, eq. (8.4)
    least = dr.opaque(mi.Float, EMPTY / float(grid.voxel_size.min()))
    per_volume, values = dr.opaque(mi.Float, 1 / volume_of(grid)), sums.values()
    found = [
        [
            dr.select(mean > least, total * per_volume / dr.maximum(mean, least), 0)
            for total in values[c * count : (c + 1) * count]
        ]
        for c, mean in enumerate(extinction)
    ]
    dr.eval(found)
    return found


def values_per_voxel(cache: IrradianceCache) -> int:
    """Return the number of components of the adjoint fluence of camera rays per voxel."""
    basis = cache.directional
    if basis is None:
        return 1
    return (basis.order + 1) ** 2 + len(basis.sources) + len(basis.others)


def _largest(channels: list[mi.Float]) -> float:
    """Return the largest magnitude in all channels; 0 if there are none."""
    return max((float(dr.max(dr.abs(values))[0]) for values in channels), default=0.0)
