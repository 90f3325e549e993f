"""Radiance along camera rays: in-scattered radiance from the caches, and radiance behind the media.

For an isolated medium (see `compile`) the segment inside the medium has a closed form. In all other
scenes the ray continues straight through null surfaces and several media, each of which is ray
marched with its cache, until it hits a surface or leaves the scene. From there one path per camera
sample is followed to the first diffuse surface, whose irradiance is cached (`surface_irradiance`).
With a limited depth, or if some medium has no cache, the path is traced as in ``volpath`` instead;
if all orders are requested, it then ends at its first collision in a medium with a cache.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.area_light import moments_of
from mitsuba_irrcache.cache.direct_light import DirectLightAlongRays
from mitsuba_irrcache.cache.surface import SurfaceNodes
from mitsuba_irrcache.cache.uncertainty import uncertainty_of
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import random_stream
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.lights.environments import is_uneven
from mitsuba_irrcache.machine.memory import release_unused_memory
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium, CacheSettings
from mitsuba_irrcache.render.blurred_background import (
    SurroundingsChange,
    blurred_directions,
    environment_along,
    peak_depth,
    surroundings_change,
)
from mitsuba_irrcache.render.film import CameraSampler, scattered_rays, view_extent
from mitsuba_irrcache.render.peak_sources import PeakSources
from mitsuba_irrcache.render.raymarch import CachedFields, Projection
from mitsuba_irrcache.render.sampled_emitters import EmitterSample, SampledEmitters
from mitsuba_irrcache.render.surface_irradiance import SurfaceIrradiance
from mitsuba_irrcache.render.surface_paths import SurfacePaths
from mitsuba_irrcache.scene.description import SceneDescription
from mitsuba_irrcache.solvers.half_space import HalfSpace
from mitsuba_irrcache.transport.path import (
    MOST_CROSSINGS,
    is_null,
    medium_after,
)
from mitsuba_irrcache.transport.path_tracer import PathEnd, PathStart, PathTracer

#: Camera rays, at least about, by which nodes on surfaces are placed: in a small image, one for
#: each pixel would miss the narrow cells in corners.
PLACEMENT_RAYS = 1 << 16
#: Samples of an image from which on irradiance is cached on surfaces: a smaller one has less work.
FEWEST_SAMPLES = 1 << 15
#: Transmittance below which surfaces are traced with Russian roulette: where paths are long, and
#: where they end in cached irradiance, so that roulette would be most of the noise.
ROULETTE_BELOW, CACHED_ROULETTE_BELOW = 0.1, 0.01


def camera_rays_of(
    parts: list[CachedMedium],
    settings: CacheSettings,
    hide_emitters: bool = False,
    quadrature: str = "exponential",
    step: float = 1.0,
    layered: bool = False,
    with_error: bool = False,
) -> CameraRays | None:
    """Create the camera rays for the current caches of ``parts``; None if no medium is visible.

    ``layered`` and ``with_error`` select what `Projection` computes in addition to the radiance.
    """
    if not parts:
        return None

    def project(medium: MediumGrid, cache: IrradianceCache | None) -> Projection:
        if cache is None or not (cache.active_count and cache.samples):
            return Projection(medium, None, quadrature, step, layered)
        field = cache.field()
        release_unused_memory(cache.grid.voxel_count)
        cached = CachedFields(
            uncertainty=uncertainty_of(cache) if with_error else None,
            directional=cache.directional_field(field.channels),
            edges=cache.voxel_classes.cut_cells if cache.voxel_classes is not None else None,
            falloff=cache.falloff,
            direct_lights=_along_rays(cache),
        )
        border = cache.interpolation.border
        projection = Projection(
            medium,
            field,
            quadrature,
            step,
            layered,
            cached,
            border_depth=0.0 if border is None else border.depth,
        )
        del field  # already copied by the projection
        release_unused_memory(cache.grid.voxel_count)
        return projection

    projections = [project(part.medium, part.shown) for part in parts]
    medium = parts[0].medium
    if medium.is_isolated:
        closed_form = parts[0].half_space
        return ClosedFormCameraRays(projections[0], settings.max_depth, hide_emitters, closed_form)
    depths = settings.max_depth, settings.rr_depth
    refinement = max(part.refinement for part in parts)
    return TracedCameraRays(parts[0].description, projections, *depths, hide_emitters, refinement)


def _along_rays(cache: IrradianceCache) -> list[DirectLightAlongRays]:
    """Prepare the direct lights of a cache for lookups along rays."""
    lights, basis = cache.direct_lights, cache.directional
    moments = None
    if basis is not None and lights:
        basis = AngularBasis(basis.phase, [], order=lights[0].order)
        moments = moments_of(lights, basis, cache.grid, cache.active)
    return [DirectLightAlongRays(light, basis, moments) for light in lights]


class RayResult:
    """Result of tracing camera rays.

    ``scattered`` is the in-scattered radiance of the media, ``background`` the radiance of
    emitters, surfaces and volumetric emission, attenuated by the media. ``transmittance`` is that
    of the media, and ``gathered`` are the sums from which `Projection.layers` creates `Layers`.
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
    """Camera rays through an isolated medium."""

    def __init__(
        self,
        projection: Projection,
        max_depth: int,
        hide_emitters: bool,
        half_space: HalfSpace | None = None,
    ) -> None:
        """Store settings; ``half_space`` computes the radiance of a medium without cache."""
        self.projection, self.medium = projection, projection.medium
        self._half_space = half_space
        self.hide_emitters, self.shows_emitters = hide_emitters, max_depth != 0

    def shows(self, medium: mi.Medium) -> bool:
        """Return whether rays may start in ``medium``: there is only one."""
        return True

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        medium: mi.Medium | None,
        active: mi.Bool,
    ) -> RayResult:
        """Compute the radiance along ``ray``, which starts in ``medium``."""
        visible, radiance, through, straight = self.background(scene, ray, medium, active)
        hit, near, far = self.span(ray, medium)
        hit &= active
        scattered, transmittance, gathered, emitted = self.projection.march(
            ray, near, far, radiance, 1 - sampler.next_1d(active), hit
        )
        unscattered = self.projection.unscattered(transmittance, ray, near, far, hit)
        if self._half_space is not None:
            if medium is not None:
                raise IrrcacheError(
                    f'irrcache: the sensor is inside of the opaque medium "{self.medium.name}", '
                    "whose radiance is known only outside; set resolution to build a cache."
                )
            scattered = self._half_space.radiance(ray, near, far, sampler, hit)
        background = mi.Spectrum(0)
        if self.shows_emitters:
            background = (through * transmittance + straight * unscattered) * radiance + emitted
        if self.blurs(scene):
            u, ends_behind = sampler.next_2d(active), hit & (through != 0)
            found = self.blur(ray, transmittance, unscattered, u=u, active=ends_behind)
            peaked = transmittance - unscattered
            for direction, weight in found:
                other = environment_along(scene, ray, direction)
                background += weight * peaked * (other - radiance)
        alpha = mi.Float(1)
        if not visible:  # dr.mean would make the number of samples a constant of the kernel
            alpha = 1 - dr.sum(unscattered) / dr.size_v(mi.Spectrum)
        return RayResult(scattered, background, transmittance, alpha, gathered)

    def background(
        self, scene: mi.Scene, ray: mi.Ray3f, medium: mi.Medium | None, active: mi.Bool
    ) -> tuple[bool, mi.Spectrum, mi.Float, mi.Float]:
        """Return whether an environment is visible behind the medium, its radiance along ``ray``,
        which starts in ``medium``, and its weights for the transmittance of the medium and for that
        of the medium with the forward peak of its phase function (see `delta_m`).

        Narrow sources are attenuated by the latter, because their radiance that the peak scatters
        is part of the scattered radiance. Of a hidden environment, only radiance scattered by the
        peak remains.
        """
        environment, truncates = scene.environment(), self.projection.truncates_peak
        visible = environment is not None and not self.hide_emitters and self.shows_emitters
        peak_shows = truncates and environment is not None and self.shows_emitters
        through, straight = mi.Float(1), mi.Float(0)
        if not (visible or peak_shows):
            return False, mi.Spectrum(0), through, straight
        escaped = dr.zeros(mi.SurfaceInteraction3f)
        escaped.wi = -ray.d
        escaped.wavelengths = ray.wavelengths
        if truncates:
            lights = self.projection.directional.directional
            narrow = lights.hits_source(mi.Point3f(0), ray.d, mi.Bool(True), mi.Bool(False))
            through = dr.select(narrow, mi.Float(0), 1)
            straight = 1 - through if visible else -through
        if medium is not None:
            _, _, leave = self.medium.boundary.intersect(ray)
            ends = leave > ray.maxt  # at the far plane, behind which nothing is visible
            through, straight = dr.select(ends, 0, through), dr.select(ends, 0, straight)
        return visible, environment.eval(escaped, active), through, straight

    def blurs(self, scene: mi.Scene) -> bool:
        """Return whether radiance behind the medium that a forward peak scatters is blurred."""
        peaked = self.projection.truncates_peak and self.shows_emitters
        return peaked and is_uneven(scene.environment())

    def blur(
        self,
        ray: mi.Ray3f,
        transmittance: mi.Spectrum,
        unscattered: mi.Spectrum,
        u: mi.Point2f,
        active: mi.Bool,
    ) -> list[tuple[mi.Vector3f, mi.Float]]:
        """Return the `blurred_directions` of the environment for ``ray``, given both transmittances
        of the medium and two random numbers ``u``.
        """
        depth = peak_depth(transmittance, unscattered)
        found = blurred_directions(self.projection.directional.directional, ray.d, depth, u)
        return [(direction, dr.select(active, weight, 0)) for direction, weight in found]

    def span(self, ray: mi.Ray3f, medium: mi.Medium | None) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Return whether ``ray``, which starts in ``medium``, intersects the medium with a cache,
        and the distances of entry and exit.
        """
        hit, near, far = self.medium.intersect(ray)
        # As in volpath, a sensor is inside the medium only if the scene says so, and rays enter
        # through the boundary, even if the grid covers only a part of it.
        _, entry, leave = self.medium.boundary.intersect(ray)
        # The far plane ends rays only before their first intersection.
        if medium is not None:
            far = dr.select(leave > ray.maxt, dr.minimum(far, ray.maxt), far)
            hit &= (far > 0) & (near < far)
        else:
            hit &= (entry > -1e-5 * (leave - entry)) & (entry < ray.maxt)
        return hit, dr.maximum(near, 0), far


@dataclass
class _StraightRay:
    """A camera ray up to the first surface that is not null, and what it has gathered."""

    scattered: mi.Spectrum
    #: radiance of emitters and of volumetric emission
    background: mi.Spectrum
    transmittance: mi.Spectrum
    #: transmittance for narrow sources, by the extinction before delta-M scaling
    unscattered: mi.Spectrum
    #: the difference of both transmittances, and the distance of the middle of the medium where it
    #: arises
    peaked: mi.Spectrum
    middle: mi.Float
    #: sums for `Layers`
    gathered: list
    #: the ray behind the last surface, and the medium there
    segment: mi.Ray3f
    pointer: mi.MediumPtr
    #: distance of the last surface from the camera
    near: mi.Float
    #: whether the ray has hit a surface; whether it has left the scene
    stopped: mi.Bool
    escaped: mi.Bool
    crossings: mi.UInt32
    active: mi.Bool


@dataclass
class _PathBehind:
    """The beginning of a path behind media: a ``ray`` in the medium ``pointer``, which has
    ``travelled`` this distance from the camera; the factors of the radiance that it finds, and of
    that of emitters at the first surface.
    """

    ray: mi.Ray3f
    pointer: mi.MediumPtr
    travelled: mi.Float
    weight: mi.Spectrum
    direct_weight: mi.Spectrum
    active: mi.Bool


class TracedCameraRays:
    """Camera rays through several ``projections``, one for each visible medium."""

    def __init__(
        self,
        description: SceneDescription,
        projections: list[Projection],
        max_depth: int,
        rr_depth: int,
        hide_emitters: bool,
        refinement: int = 1,
    ) -> None:
        """``refinement`` multiplies the numbers of rays that gather irradiance on surfaces."""
        self.media, self.projections = description.media, projections
        self._refinement = refinement
        self.background_bound = description.background_bound
        #: the projection with most channels: media without a cache have no error estimates
        self.projection = max(projections, key=lambda p: p.channel_count)
        self.hide_emitters = hide_emitters
        #: emitters that truncated forward peaks scatter; None if no medium has one
        self.peak = PeakSources.of(projections)
        #: whether paths may end in media: not with a limited depth, because caches hold the sum of
        #: all orders
        self._ends_in_media = max_depth < 0
        self.max_depth = dr.opaque(mi.UInt32, max_depth if max_depth >= 0 else 0xFFFFFFFF)
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)
        #: emitters that are sampled for the irradiance on surfaces; None if it is not cached. An
        #: object that outlives the scene must not hold its emitters: Dr.Jit would call them without
        #: their shapes.
        self._emitters: SampledEmitters | None = None
        all_visible = len(projections) == len(description.media.grids)
        if max_depth < 0 and all_visible and description.has_surfaces:
            self._emitters = SampledEmitters(description.emitters)
        self._surfaces: SurfaceIrradiance | None = None
        self._refracts = description.refracts
        #: whether the current image uses irradiance on surfaces
        self.caches_surfaces = False

    def shows(self, medium: mi.Medium) -> bool:
        """Return whether rays may start in ``medium``: whether it is ray marched."""
        return any(dr.all(p.medium.pointer == mi.MediumPtr(medium)) for p in self.projections)

    def adopt(self, earlier: TracedCameraRays) -> None:
        """Reuse the surface nodes of camera rays for an ``earlier`` state of the same caches."""
        if earlier._surfaces is not None:
            paths = self._paths(earlier._surfaces.nodes)
            self._surfaces = earlier._surfaces.renewed(paths, self._refinement)

    def _paths(self, nodes: SurfaceNodes | None = None) -> SurfacePaths:
        rest = self.background_bound, self.rr_depth, nodes, self._refracts
        return SurfacePaths(self.media, self.projections, self._emitters, *rest)

    def prepare_view(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, seed: int = 0) -> None:
        """Cache the irradiance on the surfaces that ``sensor`` sees, if an image with ``spp``
        samples per pixel (0: the sampler's number) uses it.
        """
        width, height = (int(n) for n in sensor.film().crop_size())
        samples = width * height * (spp or sensor.sampler().sample_count())
        self.caches_surfaces = False
        # Shadows of media with a forward peak are sharp with cached irradiance only.
        is_worth_it = samples >= FEWEST_SAMPLES or self._refracts or self.peak is not None
        if self._emitters is None or not is_worth_it:
            return
        view = view_extent(sensor)
        if self._surfaces is None or not self._surfaces.has_space_for(view):
            self._surfaces = SurfaceIrradiance(self._paths(), seed, self._refinement)
        ray = scattered_rays(sensor, PLACEMENT_RAYS)
        medium = sensor.get_medium()
        pointer = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
        self._surfaces.prepare(scene, view, ray, pointer)
        self.caches_surfaces = True

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        medium: mi.Medium | None,
        active: mi.Bool,
    ) -> RayResult:
        """Compute the radiance along ``ray``, which starts in ``medium``."""
        pointer = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
        offset = 1 - sampler.next_1d(active)
        rng = _stream(sampler, active)
        marched = self._march_to_surface(scene, ray, pointer, offset, active)
        background, transmittance = marched.background, marched.transmittance
        end, pointer, unscattered = marched.segment, marched.pointer, marched.unscattered
        # Path trace surfaces of low transmittance with Russian roulette.
        least = CACHED_ROULETTE_BELOW if self.caches_surfaces else ROULETTE_BELOW
        chance = dr.minimum(dr.max(transmittance) * (1 / least), 1)
        traced = marched.stopped & (rng.next_float32(marched.stopped) < chance)
        weight = dr.select(traced, transmittance / chance, 0)
        is_stratified = isinstance(sampler, CameraSampler)
        if self.caches_surfaces and not is_stratified:
            on_emitter = EmitterSample(sampler.next_2d(traced))
        else:
            on_emitter = sampler.emitter_sample() if is_stratified else None
        path = _PathBehind(end, pointer, marched.near, weight, weight, traced)
        if self.peak is None:
            direct, reflected, straight = self._radiance_behind(scene, path, rng, on_emitter)
            found = dr.select(traced, weight * (direct + reflected), 0)
        else:
            change = self._surroundings_change(scene, ray, marched, rng, active)
            background += marched.peaked * change.environment
            surface = marched.peaked * change.surface / chance
            path.weight = weight + dr.select(traced, surface, 0)
            lamp = self.peak.hit_by(scene, ray.o, marched.segment, mi.Bool(False), traced)
            path.direct_weight = dr.select(lamp, unscattered / chance, path.weight)
            # The peak scatters radiance of another surface, too: follow a path towards it.
            towards = marched.peaked * change.weight
            chance_towards = dr.minimum(dr.max(dr.abs(towards)) * (1 / least), 1)
            end = mi.Ray3f(ray(marched.middle), change.direction, ray.time, ray.wavelengths)
            towards /= dr.maximum(chance_towards, 1e-30)
            is_followed = active & (rng.next_float32(active) < chance_towards)
            lamp = self.peak.hit_by(scene, end.o, end, mi.Bool(False), is_followed)
            deflected = _PathBehind(
                end,
                dr.zeros(mi.MediumPtr, dr.width(end)),
                mi.Float(marched.middle),
                towards,
                dr.select(lamp, 0, towards),
                is_followed,
            )
            found, straight = self._both_behind(scene, path, deflected, rng, on_emitter)
        background += found
        alpha = mi.Float(1)
        if self.hide_emitters or scene.environment() is None:
            passed = weight
            if self.peak is not None:
                passed, transmittance = dr.select(traced, unscattered / chance, 0), unscattered
            transparency = dr.select(traced, passed * straight, 0)
            transparency = dr.select(marched.escaped, transmittance, transparency)
            alpha = 1 - dr.sum(transparency) / dr.size_v(mi.Spectrum)
        return RayResult(marched.scattered, background, transmittance, alpha, marched.gathered)

    def _radiance_behind(
        self,
        scene: mi.Scene,
        path: _PathBehind,
        rng: mi.PCG32,
        on_emitter: EmitterSample | None,
    ) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum]:
        """Follow a path; return the radiance of emitters at the first surface, all other radiance,
        and the transmittance of paths without any vertex (0 for others).
        """
        if self.caches_surfaces:
            rest = rng, path.active, on_emitter, self.hide_emitters, path.travelled
            found = self._surfaces.paths.follow(scene, path.ray, path.pointer, *rest)
            return found[:3]
        sample = on_emitter.u if on_emitter is not None else None
        start = PathStart(path.ray, path.pointer, depth=0, pdf=0.0, clear=True, sample=sample)
        depths = self.max_depth, self.rr_depth
        is_cached = self._is_cached if self._ends_in_media else None
        paths = PathTracer(scene, self.media, *depths, self.hide_emitters, is_cached)
        sums, _ = paths.trace(start, rng, path.active)
        reflected = sums.scattered
        if self._ends_in_media:
            reflected += sums.end.weight * self._irradiance(sums.end) * dr.inv_four_pi
        return sums.direct, reflected, dr.select(sums.interacted, 0, mi.Spectrum(1))

    @symbolic
    def _both_behind(self, scene, path, deflected, rng, on_emitter):
        """Return the weighted radiance of two paths, and the third result of `_radiance_behind` for
        the first one.

        Both use the same random numbers, so that their difference has little noise.
        """
        total, straight, number = mi.Spectrum(0), mi.Spectrum(0), mi.UInt32(0)
        current = path
        active = path.active | deflected.active
        while dr.hint(active, label="paths behind media"):
            direct, reflected, passed = self._radiance_behind(scene, current, rng, on_emitter)
            radiance = current.direct_weight * direct + current.weight * reflected
            total += dr.select(current.active, radiance, 0)
            straight = dr.select(number == 0, passed, straight)
            number += 1
            current = dr.select(number == 1, deflected, current)
            active &= (number == 1) & deflected.active
        return total, straight

    def _surroundings_change(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        marched: _StraightRay,
        rng: mi.PCG32,
        active: mi.Bool,
    ) -> SurroundingsChange:
        """Estimate by how much the blur by forward peaks changes what is behind the media."""
        middle = mi.Ray3f(ray(marched.middle), ray.d, ray.time, ray.wavelengths)
        depth = peak_depth(marched.unscattered + marched.peaked, marched.unscattered)
        active = active & (dr.max(marched.peaked) > 0)
        lights = self.peak.basis
        return surroundings_change(scene, lights, middle, marched.escaped, depth, rng, active)

    @symbolic
    def _march_to_surface(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        pointer: mi.MediumPtr,
        offset: mi.Float,
        active: mi.Bool,
    ):
        """March along ``ray`` to the first surface that is not null; return the `_StraightRay`."""
        state = _StraightRay(
            scattered=mi.Spectrum(0),
            background=mi.Spectrum(0),
            transmittance=mi.Spectrum(1),
            unscattered=mi.Spectrum(1),
            peaked=mi.Spectrum(0),
            middle=mi.Float(0),
            gathered=self.projection.zero_sums(),
            segment=mi.Ray3f(ray),
            pointer=mi.MediumPtr(pointer),
            near=mi.Float(0),
            stopped=mi.Bool(False),
            escaped=mi.Bool(False),
            crossings=mi.UInt32(0),
            active=mi.Bool(active),
        )
        while dr.hint(state.active, label="march to surface"):
            si = scene.ray_intersect(state.segment, state.active)
            valid = state.active & si.is_valid()
            # Measure all distances from the camera, so that depths are correct.
            far = dr.select(valid, dr.dot(si.p - ray.o, ray.d), dr.inf)
            # The far plane ends rays only before their first intersection: in the sensor's medium.
            is_first = state.active & (state.crossings == 0)
            ends = is_first & ~valid & (state.pointer != None)  # noqa: E711
            far = dr.select(ends, ray.maxt, far)
            self._march_media(state, ray, far, offset)
            state.peaked = dr.select(ends, 0, state.peaked)
            null = valid & is_null(si.bsdf().flags())
            crosses = self._add_emitter(scene, state, ray, si, null, ends)
            state.stopped |= valid & ~crosses
            state.escaped |= state.active & ~valid
            state.pointer = dr.select(null, medium_after(si, ray.d, state.pointer), state.pointer)
            state.segment = dr.select(crosses, si.spawn_ray(ray.d), state.segment)
            state.near = dr.select(crosses, far, state.near)
            state.crossings += 1
            state.active &= crosses & (dr.max(state.transmittance) > 0)
            state.active &= state.crossings < MOST_CROSSINGS
        return state

    def _march_media(
        self, state: _StraightRay, ray: mi.Ray3f, far: mi.Float, offset: mi.Float
    ) -> None:
        """Ray march the media between the last surface and the distance ``far`` of the next one."""
        shows_emitters, max_background = self.max_depth > 0, mi.Spectrum(self.background_bound)
        for projection in self.projections:
            hit, entry, leave = projection.medium.intersect(ray)
            entry, leave = dr.maximum(entry, state.near), dr.minimum(leave, far)
            hit &= state.active & (state.pointer == projection.medium.pointer)
            # The paths behind surfaces march by the same code.
            march = projection.called_march if self.caches_surfaces else projection.march
            scattered, transmittance, sums, emitted = march(
                ray, entry, leave, max_background, offset, hit
            )
            scale = luminance(state.transmittance)
            state.scattered += state.transmittance * scattered
            state.background += dr.select(shows_emitters, state.transmittance * emitted, 0)
            state.gathered = _added(state.gathered, sums, state.transmittance, scale)
            state.transmittance *= transmittance
            if self.peak is not None:
                crosses = hit & (entry < leave)
                state.unscattered *= projection.unscattered(
                    transmittance, ray, entry, leave, crosses
                )
                state.peaked = state.transmittance - state.unscattered
                state.middle = dr.select(crosses, 0.5 * (entry + leave), state.middle)

    def _add_emitter(
        self,
        scene: mi.Scene,
        state: _StraightRay,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        null: mi.Bool,
        ends: mi.Bool,
    ) -> mi.Bool:
        """Add emission at the end of the segment, unless it ``ends`` at the far plane.

        Returns where the ray continues: behind ``null`` surfaces and hidden emitters.
        """
        valid, shows_emitters = state.active & si.is_valid(), self.max_depth > 0
        emitter = si.emitter(scene, state.active)
        hit_emitter = state.active & ~ends & (emitter != None)  # noqa: E711
        hidden = mi.Bool(False)
        if self.hide_emitters:
            hidden = hit_emitter & (~valid | (state.pointer == None))  # noqa: E711
            if self.peak is None:
                hit_emitter = mi.Bool(False)
        crosses = null | (hidden & valid)
        hit_emitter &= crosses | ~valid
        radiance = emitter.eval(si, hit_emitter & shows_emitters)
        attenuation = mi.Spectrum(state.transmittance)
        if self.peak is not None:
            ends = hit_emitter & ~valid, hit_emitter & valid
            unblurred = self.peak.include(emitter, ray.o, ray.d, *ends)
            attenuation = dr.select(unblurred, state.unscattered, attenuation)
            # Forward peaks scatter radiance of hidden emitters into the ray.
            attenuation -= dr.select(hidden, state.unscattered, 0)
            state.transmittance = dr.select(hidden, state.unscattered, state.transmittance)
        state.background += dr.select(hit_emitter & shows_emitters, attenuation * radiance, 0)
        return crosses

    def _is_cached(self, pointer: mi.MediumPtr) -> mi.Bool:
        """Return whether the radiance in a medium is cached."""
        known = mi.Bool(False)
        for projection in self.projections:
            known |= pointer == projection.medium.pointer
        return known

    def _irradiance(self, end: PathEnd) -> mi.Spectrum:
        """Look up the cached irradiance at the ends of paths."""
        result = mi.Spectrum(0)
        for projection in self.projections:
            here = (dr.max(end.weight) > 0) & (end.pointer == projection.medium.pointer)
            if projection.has_cache:
                phi = mi.Spectrum(projection.irradiance_at(end.p, end.direction, here))
                result = dr.select(here, phi, result)
        return result


CameraRays = ClosedFormCameraRays | TracedCameraRays


def _added(gathered: list, sums: list, transmittance: mi.Spectrum, scale: mi.Float) -> list:
    """Add the sums of a medium, attenuated by the ``transmittance`` in front of it."""
    if not sums:
        return gathered
    colour, *rest = gathered
    rest = [old + scale * new for old, new in zip(rest, sums[1:], strict=False)] + rest[
        len(sums) - 1 :
    ]
    return [colour + transmittance * sums[0], *rest]


def _stream(sampler: mi.Sampler, active: mi.Bool) -> mi.PCG32:
    """Create a random stream per lane, seeded by two numbers of the sampler."""
    a, b = (dr.reinterpret_array(mi.UInt32, sampler.next_1d(active)) for _ in range(2))
    return random_stream(mi.sample_tea_32(a, b, 8))
