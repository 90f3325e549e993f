"""What a camera ray sees: light scattered in media, from their caches, and what is behind them.

In a simple scene (see `compile`) its way is known in closed form. In all others the ray goes
straight on through null surfaces, from one medium into the next, and is marched through each with
that medium's cache. Where it meets a surface, or nothing any more, its straight way ends: what a
surface sends back is path traced, by one path per camera sample, which ends where it meets a medium
with a cache.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.direct_light import DirectLightAlongRays
from mitsuba_irrcache.cache.uncertainty import uncertainty_of
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import random_stream
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.memory import give_back
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium, CacheSettings
from mitsuba_irrcache.render.raymarch import Projection
from mitsuba_irrcache.scene.context import Surroundings
from mitsuba_irrcache.solvers.half_space import HalfSpace
from mitsuba_irrcache.transport.path import MOST_CROSSINGS, End, Start, is_null, medium_after, trace

#: Surfaces seen through less than this transmittance are traced by roulette.
FAINT = 0.1


def camera_rays_of(
    parts: list[CachedMedium],
    settings: CacheSettings,
    hide_emitters: bool = False,
    quadrature: str = "exponential",
    step: float = 1.0,
    layered: bool = False,
    with_error: bool = False,
) -> ClosedFormCameraRays | TracedCameraRays | None:
    """What sees the caches of ``parts`` as they are; None where there is no medium to be seen.

    ``layered`` and ``with_error`` are what `Projection` gathers beside the radiance.
    """
    if not parts:
        return None

    def project(medium: MediumGrid, cache: IrradianceCache | None) -> Projection:
        if cache is None or not (cache.active_count and cache.samples):
            return Projection(medium, None, quadrature, step, layered)
        field = cache.field()
        give_back(cache.grid.voxel_count)
        projection = Projection(
            medium,
            field,
            quadrature,
            step,
            layered,
            uncertainty=uncertainty_of(cache) if with_error else None,
            directional=cache.directional_field(field.channels),
            edges=cache.survey.edges if cache.survey is not None else None,
            falloff=cache.falloff,
            direct_lights=[DirectLightAlongRays(light) for light in cache.direct_lights],
        )
        del field  # it has been copied
        give_back(cache.grid.voxel_count)
        return projection

    projections = [project(part.medium, part.shown) for part in parts]
    medium = parts[0].medium
    if medium.is_isolated:
        closed_form = parts[0].half_space
        return ClosedFormCameraRays(projections[0], settings.max_depth, hide_emitters, closed_form)
    depths = settings.max_depth, settings.rr_depth
    return TracedCameraRays(medium.surroundings, projections, *depths, hide_emitters)


class RayResult:
    """What rays have found: ``scattered`` light of the media, ``background`` (emitters and
    surfaces, seen through the media, and light of these themselves), the ``transmittance`` of the
    way, ``alpha``, and the sums that `Projection.layers` makes layers of.
    """

    def __init__(
        self,
        scattered: mi.Spectrum,
        background: mi.Spectrum,
        transmittance: mi.Spectrum,
        alpha: mi.Float,
        gathered: list,
    ) -> None:
        self.scattered, self.background = scattered, background
        self.transmittance, self.alpha, self.gathered = transmittance, alpha, gathered


class ClosedFormCameraRays:
    """Camera rays through the one medium of a simple scene."""

    def __init__(
        self,
        projection: Projection,
        max_depth: int,
        hide_emitters: bool,
        half_space: HalfSpace | None = None,
    ) -> None:
        """``half_space`` computes the scattered radiance where there is no cache for it."""
        self.projection, self.medium = projection, projection.medium
        self._half_space = half_space
        self.hide_emitters, self.lit = hide_emitters, max_depth != 0

    def look(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        medium: mi.Medium | None,
        active: mi.Bool,
    ) -> RayResult:
        """Along ``ray``, which starts in ``medium``."""
        background = mi.Spectrum(0)
        environment = scene.environment()
        visible = environment is not None and not self.hide_emitters and self.lit
        if visible:
            escaped = dr.zeros(mi.SurfaceInteraction3f)
            escaped.wi = -ray.d
            escaped.wavelengths = ray.wavelengths
            background = environment.eval(escaped, active)
        hit, near, far = self.medium.intersect(ray)
        # As in volpath, a sensor is in the medium only if the scene says so, and the way in leads
        # through the boundary, wherever inside of it the medium's grid begins.
        _, entry, leave = self.medium.boundary.intersect(ray)
        entered = entry > -1e-5 * (leave - entry)
        hit &= (far > 0) if medium is not None else entered
        near = dr.maximum(near, 0)
        scattered, transmittance, gathered, emitted = self.projection.march(
            ray, near, far, background, 1 - sampler.next_1d(active), active & hit
        )
        if self._half_space is not None:
            if medium is not None:
                raise IrrcacheError(
                    f'irrcache: the sensor is inside of the opaque medium "{self.medium.name}", '
                    "whose radiance is known outside only; set resolution for a cache."
                )
            scattered = self._half_space.radiance(ray, near, far, sampler, active & hit)
        if self.lit:
            background = self._left_of(transmittance, ray.d) * background + emitted
        alpha = mi.Float(1)
        if not visible:  # dr.mean would write the number of samples into the kernel
            alpha = 1 - dr.sum(transmittance) / dr.size_v(mi.Spectrum)
        return RayResult(scattered, background, transmittance, alpha, gathered)

    def _left_of(self, transmittance: mi.Spectrum, direction: mi.Vector3f) -> mi.Spectrum:
        """What the medium leaves of the environment in a ``direction``."""
        if not self.projection.blurs:
            return transmittance
        lights = self.projection.directional.directional
        narrow = lights.shines(mi.Point3f(0), direction, mi.Bool(True), mi.Bool(False))
        return dr.select(narrow, self.projection.unscattered(transmittance), transmittance)


class TracedCameraRays:
    """Camera rays through several ``projections``, one for each medium that can be seen."""

    def __init__(
        self,
        surroundings: Surroundings,
        projections: list[Projection],
        max_depth: int,
        rr_depth: int,
        hide_emitters: bool,
    ) -> None:
        self.surroundings, self.projections = surroundings, projections
        #: the one that gathers most: a dark medium has no errors to tell
        self.projection = max(projections, key=lambda p: p.channel_count)
        self.hide_emitters = hide_emitters
        #: of narrow lights what is scattered into a forward peak, if there is one, is seen beside
        #: them
        self.narrow = next((p.directional.directional for p in projections if p.blurs), None)
        #: the caches hold what paths of any length find; for shorter ones they hold too much
        self.known = self._is_known if max_depth < 0 else None
        self.max_depth = dr.opaque(mi.UInt32, max_depth if max_depth >= 0 else 0xFFFFFFFF)
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)

    def look(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        medium: mi.Medium | None,
        active: mi.Bool,
    ) -> RayResult:
        """Along ``ray``, which starts in ``medium``."""
        pointer = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
        offset = 1 - sampler.next_1d(active)
        rng = _stream(sampler, active)
        scattered, background, passed, gathered, end, pointer, stopped, escaped, unscattered = (
            self._straight(scene, ray, pointer, offset, active)
        )
        # What is hardly seen is traced rarely.
        chance = dr.minimum(dr.max(passed) * (1 / FAINT), 1)
        traced = stopped & (rng.next_float32(stopped) < chance)
        weight = dr.select(traced, passed / chance, 0)
        start = Start(end, pointer, depth=0, pdf=0.0, clear=True)
        straight, reflected, met, last, _ = trace(
            scene,
            self.surroundings.media,
            start,
            self.max_depth,
            self.rr_depth,
            self.hide_emitters,
            rng,
            traced,
            self.known,
        )
        if self.known is not None:
            reflected += last.weight * self._irradiance(last) * dr.inv_four_pi
        shown = weight
        if self.narrow is not None:
            lamp = self.narrow.shines(ray.o, ray.d, far=mi.Bool(False), near=traced)
            shown = dr.select(lamp, unscattered / chance, weight)
        background += dr.select(traced, shown * straight + weight * reflected, 0)
        alpha = mi.Float(1)
        if self.hide_emitters or scene.environment() is None:
            clear = dr.select(traced & ~met, weight, 0)
            clear = dr.select(escaped, passed, clear)
            alpha = 1 - dr.sum(clear) / dr.size_v(mi.Spectrum)
        return RayResult(scattered, background, passed, alpha, gathered)

    @symbolic
    def _straight(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        pointer: mi.MediumPtr,
        offset: mi.Float,
        active: mi.Bool,
    ):
        """Up to the first surface that is not null: scattered light, emitters seen, transmittance
        and gathered sums; then the ray that ends there, its medium, and whether it stopped at a
        surface, or escaped; and the transmittance for narrow lights.
        """
        scattered, background, passed = mi.Spectrum(0), mi.Spectrum(0), mi.Spectrum(1)
        gathered = self.projection.nothing()
        unscattered = mi.Spectrum(1)
        # Distances are those from the camera all along, so that depths are too.
        segment, pointer, near = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Float(0)
        stopped, escaped, active = mi.Bool(False), mi.Bool(False), mi.Bool(active)
        bright = mi.Spectrum(self.surroundings.brightest)
        crossings = mi.UInt32(0)
        lit = self.max_depth > 0
        while dr.hint(active, label="straight on"):
            si = scene.ray_intersect(segment, active)
            valid = active & si.is_valid()
            far = dr.select(valid, dr.dot(si.p - ray.o, ray.d), dr.inf)
            for projection in self.projections:
                hit, entry, leave = projection.medium.intersect(ray)
                entry, leave = dr.maximum(entry, near), dr.minimum(leave, far)
                hit &= active & (pointer == projection.medium.pointer)
                found, through, sums, shine = projection.march(
                    ray, entry, leave, bright, offset, hit
                )
                scale = luminance(passed)
                scattered += passed * found
                background += dr.select(lit, passed * shine, 0)
                gathered = _added(gathered, sums, passed, scale)
                passed *= through
                if dr.hint(self.narrow is not None, mode="scalar"):
                    unscattered *= projection.unscattered(through)
            # Emitters, and what lies behind them if they are hidden.
            emitter = si.emitter(scene, active)
            shines = active & (emitter != None)  # noqa: E711
            null = is_null(si.bsdf().flags())
            crosses = valid & null
            if dr.hint(self.hide_emitters, mode="scalar"):
                crosses |= shines & valid & (pointer == None)  # noqa: E711
                shines = mi.Bool(False)
            shines &= crosses | ~valid
            light = emitter.eval(si, shines & lit)
            left = mi.Spectrum(passed)
            if dr.hint(self.narrow is not None, mode="scalar"):
                narrow = self.narrow.shines(ray.o, ray.d, shines & ~valid, shines & valid)
                left = dr.select(narrow, unscattered, left)
            background += dr.select(shines & lit, left * light, 0)
            stopped |= valid & ~crosses
            escaped |= active & ~valid
            pointer = dr.select(crosses & null, medium_after(si, ray.d, pointer), pointer)
            onwards = si.spawn_ray(ray.d)
            segment = dr.select(crosses, onwards, segment)
            near = dr.select(crosses, far, near)
            crossings += 1
            active &= crosses & (dr.max(passed) > 0) & (crossings < MOST_CROSSINGS)
        found = scattered, background, passed, gathered, segment, pointer, stopped, escaped
        return *found, unscattered

    def _is_known(self, pointer: mi.MediumPtr) -> mi.Bool:
        """Whether the light in a medium is cached."""
        known = mi.Bool(False)
        for projection in self.projections:
            known |= pointer == projection.medium.pointer
        return known

    def _irradiance(self, end: End) -> mi.Spectrum:
        """The cached irradiance where paths end, as much as they see of it."""
        result = mi.Spectrum(0)
        for projection in self.projections:
            here = (dr.max(end.weight) > 0) & (end.pointer == projection.medium.pointer)
            if projection.lit:
                phi = mi.Spectrum(projection.irradiance_at(end.p, end.direction, here))
                result = dr.select(here, phi, result)
        return result


def _added(gathered: list, sums: list, passed: mi.Spectrum, scale: mi.Float) -> list:
    """Sums of a medium that is seen through ``passed`` added to those before it."""
    if not sums:
        return gathered
    colour, *rest = gathered
    rest = [old + scale * new for old, new in zip(rest, sums[1:], strict=False)] + rest[
        len(sums) - 1 :
    ]
    return [colour + passed * sums[0], *rest]


def _stream(sampler: mi.Sampler, active: mi.Bool) -> mi.PCG32:
    """A random stream per lane, from two numbers of the sampler's."""
    a, b = (dr.reinterpret_array(mi.UInt32, sampler.next_1d(active)) for _ in range(2))
    return random_stream(mi.sample_tea_32(a, b, 8))
