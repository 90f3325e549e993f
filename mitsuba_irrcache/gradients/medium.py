"""Derivatives of an objective by the fields of a medium, from those by the pixels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.gradients.emitters import EmitterAdjoint
from mitsuba_irrcache.gradients.film import CameraPass, FilmAdjoint
from mitsuba_irrcache.gradients.fluence import FluenceFields
from mitsuba_irrcache.gradients.forward_peak import with_forward_peak
from mitsuba_irrcache.gradients.parameters import (
    ALBEDO,
    EMISSION,
    MEAN_COSINE,
    SIGMA_T,
)
from mitsuba_irrcache.gradients.phase_function import PhasesBeside
from mitsuba_irrcache.gradients.points import add_ways
from mitsuba_irrcache.gradients.replay import CameraReplay, CameraSplats
from mitsuba_irrcache.gradients.resampling import VoxelQuadrature, volume_of
from mitsuba_irrcache.gradients.scattering import split
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, VoxelSums
from mitsuba_irrcache.gradients.transport import AdjointTransport, Derivatives
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.render.camera import ClosedFormCameraRays

#: Pairs of ordinates for the default directions of the cache, with others in proportion; those for
#: phase functions with a forward peak, whose moments are of higher order; those under environments
#: that vary, whose spots they have to find; and the fewest.
PAIRS, SHARP_PAIRS, MOST_PAIRS, FEWEST_PAIRS = 24, 64, 128, 8
UNEVEN = (EmitterKind.ENVIRONMENT_MAP,)
#: How much larger than estimated sums of magnitudes may be, in `FixedPointSums`.
MARGIN = 256.0
#: Bytes for camera samples and copies of tracks; numbers for each voxel, for each of its channels,
#: and for each further moment of these.
MEMORY, NUMBERS = 3 << 27, (40, 25, 12)
#: Optical depth of a voxel below which its collisions do not matter.
EMPTY = 1e-6


def original_of(medium: MediumGrid) -> MediumGrid:
    """The medium of the scene, which is not scaled by delta-M."""
    return medium.original or medium


def field_of(medium: MediumGrid, role: str) -> Field:
    """The field of ``medium`` that a role names."""
    if role == EMISSION:
        return medium.emission.field
    return medium.sigma_t if role == SIGMA_T else medium.albedo


class MediumAdjoint:
    """Derivatives by the medium of ``part`` in ``scene``; ``image`` are the camera rays and the
    integrator's property ``step``.

    ``wanted`` maps what is wanted, `SIGMA_T`, `ALBEDO`, `EMISSION` or `MEAN_COSINE`, to its
    channels; the derivatives by ``emitters`` are added to their parameters. The ordinates depend on
    ``seed``.
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
        #: channels of the sums at the data of each field of the medium
        self._sums = self._sums_for(wanted)
        self._fluence: FluenceFields | None = None
        #: phase functions beside that of the medium, see `PhasesBeside`
        self._phases: PhasesBeside | None = None
        colour = None
        if part.cache is not None:
            self.grid = part.cache.grid
            self._check_memory()
            self._transport = self._new_transport(seed)
            self._phases = self._transport.beside
            self._fluence = FluenceFields(scene, self._medium, part.cache, self._transport)
            self._quadrature = VoxelQuadrature(self._medium, self.grid)
            self._extinction = list(self._quadrature.extinction())
            dr.eval(self._extinction)
            if self._transport.channels == 1:
                factors = [dr.opaque(mi.Float, float(c)) for c in self._transport.colour]
                colour = mi.Spectrum(factors)
        _warn_of_aureole(part)
        beside = None
        if self._phases is not None:
            marches = [
                CameraReplay(self._medium, self._fluence.scattered_by(phase), colour, step)
                for phase in (self._phases.below, self._phases.above)
            ]
            beside = (*marches, self._phases.step)
        self._march = CameraReplay(self._medium, self._fluence, colour, step, beside)

    def _sums_for(self, wanted: dict[str, int]) -> dict[str, int]:
        """Channels of what is summed for the ``wanted`` derivatives: the extinction and albedo
        after delta-M scaling depend on the albedo before it, both.
        """
        if self._medium.original is None or wanted.keys() <= {EMISSION}:
            return dict(wanted)
        channels = max(self._medium.channels, *wanted.values())
        roles = (SIGMA_T, ALBEDO) if wanted.keys() & {ALBEDO, MEAN_COSINE} else (SIGMA_T,)
        return wanted | dict.fromkeys(roles, channels)

    def _new_transport(self, seed: int) -> AdjointTransport:
        settings, wanted = self._part.settings, self._wanted
        is_grey = self._medium.channels == max(wanted.values(), default=3) == 1
        return AdjointTransport(
            self._scene,
            self._medium,
            self.grid,
            (settings.seed, seed),
            self._pairs,
            settings.max_depth == 2,
            self._sums,
            is_grey and not self._emitters and EMISSION not in wanted,
        )

    @property
    def _pairs(self) -> int:
        """Pairs of ordinates, in proportion to the directions of the cache."""
        part, environment = self._part, self._scene.environment()
        uneven = environment is not None and kind_of(environment) in UNEVEN
        usual = part.solver.default_samples(
            self._medium, part.settings.max_depth, part.cache.active_count
        )
        share = (part.cache.samples or usual) / usual
        pairs = SHARP_PAIRS if self._medium.phase.forward else PAIRS
        return max(FEWEST_PAIRS, round((MOST_PAIRS if uneven else pairs) * share))

    def _check_memory(self) -> None:
        """Refuse an adjoint solve that cannot be held."""
        channels, moments = 1 if mi.is_monochromatic else 3, values_per_voxel(self._part.cache) - 1
        counts = 1, channels, channels * moments
        needed = MEMORY + 4 * self.grid.voxel_count * sum(
            n * c for n, c in zip(NUMBERS, counts, strict=True)
        )
        sides = " x ".join(map(str, self.grid.shape[::-1]))
        require_memory(needed, f"irrcache: a gradient with {sides} voxels", "lower resolution")

    # The camera

    def replayed(self, film: FilmAdjoint) -> tuple[dict[str, mi.Float], list[mi.Float] | None]:
        """Derivatives by what is wanted, at the data's voxels, of what the camera rays of ``film``
        depend on straight; and the adjoint fluence that they leave in the voxels.
        """
        splats = None
        for each in film.passes():
            span, behind, weights, hit, offset = self._rays(each, film.medium)
            march = each.ray, span, each.radiance
            ahead, passed = self._march.radiance(*march, offset, hit)
            straight = passed
            if self._is_scaled:
                projection = self._camera_rays.projection
                straight = projection.unscattered(passed, each.ray, *span, hit)
            ahead, unscattered = ahead + passed * behind[0], straight * behind[1]
            seen = (passed * weights[0] + straight * weights[1]) * each.radiance
            dr.eval(ahead, seen, unscattered)
            if self._scene.environment() is not None:
                self._emitters.add_background(each.ray, seen)
            if splats is None:
                splats = self._camera_splats(dr.abs(ahead) + dr.abs(unscattered), film)
            self._march.replay(*march, ahead, offset, hit, splats, unscattered)
            dr.eval()
        found = self._at_data({role: getattr(splats, role).values() for role in self._sums})
        if splats.unscattered is not None:
            found[SIGMA_T] = found[SIGMA_T] + splats.unscattered.values()
        if splats.collisions is None:
            return found, None
        return found, self._adjoint_fluence(splats.collisions)

    @property
    def _is_scaled(self) -> bool:
        """Whether a forward peak of the phase function counts as unscattered (see `delta_m`)."""
        return self._medium.original is not None and self._fluence is not None

    def _at_data(self, found: dict[str, mi.Float]) -> dict[str, mi.Float]:
        """Derivatives by what is wanted of the scene's medium, from those of the medium that is
        rendered.
        """
        if self._medium.original is None or self._sums.keys() <= {EMISSION}:
            return found
        change = self._phases.forward if self._phases is not None else 0.0
        return with_forward_peak(self._medium, found, self._sums[SIGMA_T], self._wanted, change)

    def _rays(self, each: CameraPass, medium: mi.Medium | None) -> tuple:
        """For camera rays the distances between which they are in the medium; the weighted radiance
        behind it that its transmittance attenuates, and that which the transmittance of the medium
        with its forward peak attenuates; the weights of an environment in these; whether rays hit
        the medium, and the first step. ``medium`` is around the sensor.
        """
        ray, camera_rays = each.ray, self._camera_rays
        visible, background, *weights = camera_rays.background(self._scene, ray, mi.Bool(True))
        behind = [each.radiance * background * weight for weight in weights]
        if not (visible or self._is_scaled):
            weights = [mi.Float(0), mi.Float(0)]
        if each.alpha is not None and not visible:
            behind[self._is_scaled] -= each.alpha / dr.size_v(mi.Spectrum)
        hit, near, far = camera_rays.span(ray, medium)
        offset = 1 - each.sampler.next_1d()
        span = mi.Float(near), mi.Float(far)
        dr.eval(ray, span, behind, weights, hit, offset, each.radiance)
        return span, behind, weights, hit, offset

    def _camera_splats(self, ahead: mi.Spectrum, film: FilmAdjoint) -> CameraSplats:
        """Empty sums for the derivatives that are wanted."""
        lengths = np.linalg.norm(self._medium.frame[:3, :3], axis=0)
        diagonal, rays = float(np.linalg.norm(lengths)), film.samples * MARGIN
        largest = film.largest * film.pixels * MARGIN
        peak = self._medium.phase.peak
        brightest = max(float(dr.max(dr.max(dr.abs(ahead)))[0]) * rays, 1e-30)
        irradiance = self._march.irradiance
        mean = irradiance.maximum * peak / (4 * np.pi) if irradiance is not None else 0.0
        collisions = unscattered = None
        if self._transport is not None:
            layers = self._transport.channels * self._transport.scattering.camera_count
            collisions = VoxelSums(self.grid, layers, largest * peak)
        if self._is_scaled and SIGMA_T in self._wanted:
            original, bound = self._medium.original.sigma_t, brightest * diagonal
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
        """Empty sums of the derivative by a field of the medium; None if it is not wanted."""
        if role not in self._sums:
            return None
        return splat_of(field_of(self._medium, role), self._sums[role], bound)

    # Transport

    def _adjoint_fluence(self, sums: VoxelSums) -> list[mi.Float]:
        """The adjoint fluence of camera rays for collisions in the voxels, by channel: its layers
        one after the other.
        """
        # docs/primer, eq. (8.4)
        least = dr.opaque(mi.Float, EMPTY / float(self.grid.voxel_size.min()))
        per_volume = dr.opaque(mi.Float, 1 / volume_of(self.grid))
        values, count = sums.values(), self._transport.scattering.camera_count
        found = [
            [
                dr.select(mean > least, total * per_volume / dr.maximum(mean, least), 0)
                for total in values[c * count : (c + 1) * count]
            ]
            for c, mean in zip(range(self._transport.channels), self._extinction, strict=False)
        ]
        dr.eval(found)
        return [concatenated(layers) for layers in found]

    def transported(self, fluence: list[mi.Float]) -> dict[str, mi.Float]:
        """Derivatives by what is wanted, at the data's voxels, of the radiance that reaches the
        voxels, given the adjoint ``fluence`` of camera rays.
        """
        transport = self._transport
        count = transport.scattering.camera_count
        camera = [split(values, count) for values in fluence[: transport.channels]]
        found = transport.derivatives(self._fluence.collided, camera, self._extinction)
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
        result = {role: splats[role].values() for role in self._sums if role in splats}
        if MEAN_COSINE in self._wanted:
            total = sum(np.array(values, dtype=np.float64).sum() for values in found.g)
            result[MEAN_COSINE] = mi.Float(total * volume_of(self.grid))
        if SIGMA_T in self._sums:
            for light in range(len(transport.point_lights)):
                result[SIGMA_T] = result[SIGMA_T] + self._along_ways(light, found)
        return self._at_data(result)

    def _along_ways(self, light: int, found: Derivatives) -> mi.Float:
        """The derivative by the extinction between a point-like light and the voxels."""
        grid, transport = self.grid, self._transport
        share = dr.opaque(mi.Float, -volume_of(grid))
        worth = transport.worth_of_point(light, found)
        removed = transport.from_points[light] * worth * share
        dr.eval(removed)
        diagonal = float(np.linalg.norm(grid.side_lengths))
        bound = float(dr.max(dr.max(dr.abs(removed)))[0]) * grid.voxel_count * diagonal * 3
        splat, emitter = self._splat(SIGMA_T, bound * MARGIN), transport.point_lights[light]
        add_ways(self._medium, emitter, transport.positions, removed, self._march.step, splat)
        return splat.values()


def splat_of(field: Field, channels: int, bound: float) -> GridSplat | ConstantSplat:
    """Empty sums of the derivative by a ``field``."""
    if field.grid is None:
        return ConstantSplat(channels, bound)
    return GridSplat(field.grid, channels, bound)


def values_per_voxel(cache: IrradianceCache) -> int:
    """Layers of the adjoint fluence that camera rays leave in the voxels of a ``cache``."""
    basis = cache.directional
    if basis is None:
        return 1
    return (basis.order + 1) ** 2 + len(basis.sources) + len(basis.others)


def _largest(channels: list[mi.Float]) -> float:
    """The largest magnitude; 0 without any channels."""
    return max((float(dr.max(dr.abs(values))[0]) for values in channels), default=0.0)


def _warn_of_aureole(part: CachedMedium) -> None:
    """Log a warning if derivatives neglect several scattering events into a forward peak."""
    cache = part.cache
    if part.medium.original is None or cache is None or cache.directional is None:
        return
    if cache.directional.sources or cache.direct_lights:
        mi.Log(
            mi.LogLevel.Warn,
            f'irrcache: medium "{part.medium.name}" scatters sharply: gradients count several '
            "scattering events into its forward peak as single ones. In pixels within about 10 "
            "degrees of a sun, point or lamp behind the medium they are wrong by up to a half.",
        )
