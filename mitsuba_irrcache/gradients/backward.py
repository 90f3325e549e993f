"""From derivatives of an objective by the pixels to those by the parameters of the medium."""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.emitters import EmitterAdjoint
from mitsuba_irrcache.gradients.film import LUMINANCE, CameraPass, FilmAdjoint
from mitsuba_irrcache.gradients.fluence import FluenceFields
from mitsuba_irrcache.gradients.forward_peak import with_forward_peak
from mitsuba_irrcache.gradients.parameters import (
    ALBEDO,
    EMISSION,
    MEAN_COSINE,
    SIGMA_T,
    channels_of,
    refuse_all,
    roles_of,
    shaped_like,
)
from mitsuba_irrcache.gradients.points import add_ways
from mitsuba_irrcache.gradients.replay import CameraReplay, CameraSplats
from mitsuba_irrcache.gradients.resampling import VoxelQuadrature, volume_of
from mitsuba_irrcache.gradients.scattering import split
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, VoxelSums
from mitsuba_irrcache.gradients.transport import AdjointTransport, Derivatives
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.lights.emitters import POINT_LIKE, EmitterKind, kind_of, position_of
from mitsuba_irrcache.lights.falloff import edges_away
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.render.camera import ClosedFormCameraRays
from mitsuba_irrcache.scene.compile import media_of
from mitsuba_irrcache.solvers.discrete_ordinates.layout import concatenated

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
    if part.half_space is not None:
        refuse_all(keys, f"{name} is opaque and homogeneous, and has no cache", "Set resolution")
    if part.solver.name != "sweep":
        refuse_all(keys, f'the solver is "{part.solver.name}"', 'Set solver to "sweep"')
    depth = part.settings.max_depth
    if depth > 2:
        refuse_all(keys, f"max_depth is {depth}", "Set max_depth to 1, 2 or -1")
    if medium.phase.forward and part.cache is not None:
        for light in part.description.emitters.of(*POINT_LIKE):
            # Irradiance and scattering into rays vary too much within the voxels around it.
            if edges_away(position_of(light)[:, None], part.cache.grid) < 1:
                refuse_all(
                    keys,
                    f'emitter "{light.id()}" is in {name}, which scatters sharply',
                    "Move it out of the medium, or make the phase function broader",
                )


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
            if role == MEAN_COSINE:
                wanted[role] = 1
                continue
            field = field_of(original_of(self._part.medium), role)
            own = field.channels if field.grid is not None else channels_of(self._params[key])
            wanted[role] = max(wanted.get(role, 1), own)
        march = self._camera_rays, self._step
        return MediumAdjoint(self._scene, self._part, march, wanted, self._emitters, self._seed)

    def _by_parameters(self, found: dict[str, mi.Float]) -> dict[str, object]:
        result = {}
        for key, role in self._of_medium.items():
            value = self._params[key]
            if role == MEAN_COSINE:
                result[key] = shaped_like(value, found[role])
                continue
            field = field_of(original_of(self._part.medium), role)
            result[key] = shaped_like(value, by_parameter(value, field, found[role]))
        return result


def original_of(medium: MediumGrid) -> MediumGrid:
    """The medium of the scene, which is not scaled by delta-M."""
    return medium.original or medium


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
        self._sums = dict(wanted)
        if self._medium.original is not None and wanted.keys() - {EMISSION}:
            # The extinction and albedo of the medium depend on the albedo of the scene's, both.
            most = max(self._medium.channels, *wanted.values())
            self._sums |= {SIGMA_T: most}
            if wanted.keys() & {ALBEDO, MEAN_COSINE}:
                self._sums[ALBEDO] = most
        self._fluence: FluenceFields | None = None
        colour = None
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
                self._sums,
                self._medium.channels == max(wanted.values(), default=3) == 1
                and not emitters
                and EMISSION not in wanted,
            )
            self._fluence = FluenceFields(scene, self._medium, part.cache, self._transport)
            self._quadrature = VoxelQuadrature(self._medium, self.grid)
            self._extinction = list(self._quadrature.extinction())
            dr.eval(self._extinction)
            if self._transport.channels == 1:
                factors = [dr.opaque(mi.Float, float(c)) for c in self._transport.colour]
                colour = mi.Spectrum(factors)
        beside, phases = None, self._transport.beside if self._transport is not None else None
        if phases is not None:
            marches = [
                CameraReplay(self._medium, self._fluence.scattered_by(phase), colour, step)
                for phase in (phases.below, phases.above)
            ]
            beside = (*marches, phases.step)
        self._march = CameraReplay(self._medium, self._fluence, colour, step, beside)

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
            span, behind, hit, offset = self._rays(each, film.medium)
            march = each.ray, span, each.radiance
            ahead, passed = self._march.radiance(*march, offset, hit)
            narrow, passed = self._attenuation(each.ray.d, passed)
            ahead, unscattered = ahead + passed * behind, mi.Spectrum(0)
            if narrow is not None:
                unscattered = dr.select(narrow, passed * behind, 0)
                ahead = ahead - unscattered
            dr.eval(ahead, passed, unscattered)
            if self._camera_rays.background(self._scene, each.ray, mi.Bool(True))[0]:
                self._emitters.add_background(each.ray, passed * each.radiance)
            if splats is None:
                splats = self._camera_splats(ahead + unscattered, film)
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

    def _attenuation(
        self, direction: mi.Vector3f, transmittance: mi.Spectrum
    ) -> tuple[mi.Bool | None, mi.Spectrum]:
        """Whether rays along ``direction`` meet a narrow source behind the medium (None: none is
        attenuated in another way), and what reaches them of the radiance behind it.
        """
        if not self._is_scaled:
            return None, transmittance
        basis = self._transport.scattering.basis
        narrow = basis.hits_source(mi.Point3f(0), direction, mi.Bool(True), mi.Bool(False))
        exponent = dr.opaque(mi.Float, self._medium.unscattered_exponent)
        return narrow, dr.select(narrow, dr.power(transmittance, exponent), transmittance)

    def _at_data(self, found: dict[str, mi.Float]) -> dict[str, mi.Float]:
        """Derivatives by what is wanted of the scene's medium, from those of the medium that is
        rendered.
        """
        if self._medium.original is None or self._sums.keys() <= {EMISSION}:
            return found
        phases = self._transport.beside
        change = phases.forward if phases is not None else 0.0
        return with_forward_peak(self._medium, found, self._sums[SIGMA_T], self._wanted, change)

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
