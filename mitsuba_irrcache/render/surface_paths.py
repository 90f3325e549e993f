"""Paths between surfaces, with ray-marched media and cached irradiance at their last vertex.

A path ends at the first diffuse surface whose irradiance can be interpolated. Mirrors, glass and
glossy surfaces are sampled as in path tracing. Between surfaces the in-scattered radiance of the
media is integrated by ray marching of their caches, which is free of the noise of sampled
collisions.

If a medium has a forward peak that counts as unscattered (`media/delta_m`), the radiance of narrow
sources on surfaces is attenuated by the original extinction, so that shadows are sharp. Their
radiance that the peak scatters is gathered by the nodes along separate rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import Scattering
from mitsuba_irrcache.cache.surface import SpacingBounds, SurfaceNodes
from mitsuba_irrcache.core.jit import opaque_point, symbolic
from mitsuba_irrcache.lights.emitters import are_distant
from mitsuba_irrcache.render.film import ViewExtent
from mitsuba_irrcache.render.path_splitting import no_waiting, resumed, split
from mitsuba_irrcache.render.peak_sources import PeakSources
from mitsuba_irrcache.render.raymarch import Projection
from mitsuba_irrcache.render.sampled_emitters import EmitterSample, SampledEmitters
from mitsuba_irrcache.render.surface_vertices import (
    facing,
    lambertian,
    vertex_at,
)
from mitsuba_irrcache.transport.path import (
    MAX_SURVIVAL,
    MOST_CROSSINGS,
    Media,
    PartlyOriginalMedia,
    is_null,
    medium_after,
    position_on,
    power_heuristic,
    sample_bsdf,
    straight_through,
    unobstructed,
    visibility,
)

#: Maximum number of specular and glossy vertices of a ray up to the diffuse surface where a node is
#: placed.
MOST_BOUNCES = 6
#: Distance, in voxels of its cache, over which the radiance of a medium varies: nodes within the
#: medium need not be closer than a part of it.
MEDIUM_CELLS = 8.0
#: Factor of that distance for a medium with a truncated forward peak: radiance of narrow sources
#: that the peak scatters varies within a few degrees, so that shadows have edges of a fraction of
#: it.
PEAK_DISTANCE = 0.25
#: Height above the surface, over their distance, at which the visibility between a point and a node
#: is tested: chords of curved surfaces lie below these.
CHORD = 0.1
#: Largest spacing of nodes over the extent of the image at their distance, and its smallest value
#: in pixels: rays from the nodes then find objects that are visible in the image.
COARSEST_IN_VIEW, COARSEST_PIXELS = 1 / 32, 2.0
#: Smallest spacing of nodes in pixels where camera rays end; over the extent of the image where
#: rays from nodes end.
FINEST_PIXELS, FINEST_IN_VIEW = 0.5, 1 / 64
#: Largest and smallest spacing of nodes over the length of the rays from other nodes to them, where
#: that is more.
COARSEST_FROM_NODES, FINEST_FROM_NODES = 1 / 2, 1 / 16
#: Corners of the unit cube in homogeneous coordinates.
UNIT_CUBE = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)]).T


class SurfacePaths:
    """Paths in a scene with caches of its media (``projections``) and on its surfaces.

    Irradiance at the ``nodes`` excludes radiance that comes straight from the `SampledEmitters`,
    which are sampled wherever a path ends.
    """

    def __init__(
        self,
        media: Media,
        projections: Sequence[Projection],
        emitters: SampledEmitters,
        background_bound: mi.Float,
        rr_depth: mi.UInt32,
        nodes: SurfaceNodes | None = None,
        splits: bool = False,
    ) -> None:
        """Use these ``nodes``, or none yet; ``splits``: split camera paths at glass."""
        self.splits = splits
        self.media, self.projections, self.emitters = media, projections, emitters
        self.background_bound, self.rr_depth = background_bound, rr_depth
        if nodes is None:
            corners = [(p.medium.frame @ UNIT_CUBE)[:3] for p in projections]
            nodes = SurfaceNodes(np.min(corners, axis=(0, 2)), np.max(corners, axis=(0, 2)))
        self.nodes = nodes
        #: emitters that truncated forward peaks scatter, if any medium has one; the media before
        #: the truncation
        self.peak = PeakSources.of(projections)
        self._original_media = media.original()
        self.peak_distance = dr.opaque(mi.Float, PEAK_DISTANCE)
        self._view_extent = mi.Float(0), mi.Float(0)
        self._camera, self._camera_spread = mi.Point3f(0), mi.Float(0)
        self._finest_in_view = mi.Float(0)
        self._finest_from_nodes = mi.Float(0)
        #: irradiance of the nodes, one array for each channel
        self.irradiance = [mi.Float(0) for _ in range(dr.size_v(mi.Spectrum))]

    def bound_spacing(self, view: ViewExtent) -> None:
        """Bound the spacing of nodes by what an image shows."""
        self.nodes.set_origin_near(np.array(view.position))
        across = max(COARSEST_IN_VIEW, COARSEST_PIXELS / view.pixels)
        self._camera = opaque_point(view.position)
        # Rays of several sensors start at different positions: this is the least distance.
        self._camera_spread = dr.opaque(mi.Float, view.spread)
        self._view_extent = tuple(
            dr.opaque(mi.Float, across * x) for x in (view.at_sensor, view.per_distance)
        )
        self._finest_from_nodes = dr.opaque(mi.Float, FINEST_IN_VIEW / across)
        self._finest_in_view = dr.opaque(mi.Float, FINEST_PIXELS / across / view.pixels)

    def spacing_bounds(self, p: mi.Point3f, travelled: mi.Float, from_node: bool) -> SpacingBounds:
        """Return the bounds of the spacing of nodes at ``p``, where a path ends that has
        ``travelled`` this distance from a node or from the camera.
        """
        at_sensor, per_distance = self._view_extent
        if not from_node:
            coarsest = dr.fma(per_distance, travelled, at_sensor)
            return SpacingBounds(coarsest, coarsest * self._finest_in_view)
        distance = dr.maximum(dr.norm(p - self._camera) - self._camera_spread, 0)
        coarsest = dr.fma(per_distance, distance, at_sensor)
        finest = dr.maximum(coarsest * self._finest_from_nodes, FINEST_FROM_NODES * travelled)
        return SpacingBounds(dr.maximum(coarsest, COARSEST_FROM_NODES * travelled), finest)

    @symbolic
    def follow(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        pointer: mi.MediumPtr,
        rng: mi.PCG32,
        active: mi.Bool,
        on_emitter: EmitterSample | None = None,
        hide_emitters: bool = False,
        travelled: mi.Float | None = None,
    ):
        """Follow paths that begin with ``ray`` in the medium ``pointer``: at a node or, if samples
        ``on_emitter`` for the first vertex are given, at a camera ray's end before a surface, which
        has ``travelled`` this distance from the camera.

        Returns the radiance of emitters at the first surface, all other radiance, the transmittance
        of paths without any vertex (0 for others), and the node whose irradiance has to be added
        with the returned factor (only for rays from nodes; else it is included).
        """
        follower = _PathFollower(self, scene, on_emitter, hide_emitters)
        path, sums = follower.begin(ray, pointer, rng, active)
        if travelled is not None:
            path.travelled = mi.Float(travelled)
        while dr.hint(path.active, label="surface paths"):
            follower.advance(path, sums)
        return sums.emitted, sums.radiance, sums.passed, sums.end_number, sums.end_factor

    @symbolic
    def direct(self, scene, si, pointer, sample, rng, active, where, exact: bool):
        """Return the radiance of the sampled emitters that is reflected at ``si``.

        ``sample`` chooses positions on the emitters. ``where`` are two masks: where the path ends,
        so that a ray is sampled from the BSDF here for multiple importance sampling; and where
        emitters that forward peaks scatter are attenuated by the original extinction. The
        transmittance has no noise if it is to be ``exact``.
        """
        ends, is_original = where
        result, number, context = mi.Spectrum(0), mi.UInt32(0), mi.BSDFContext()
        vertex, active = vertex_at(si), mi.Bool(active) & (self.emitters.count > 0)
        while dr.hint(active, label="sampled emitters"):
            chosen_by = mi.Float(number) + rng.next_float32(active)
            record, value = self.emitters.sample(chosen_by, vertex, sample.of(number), active)
            f, density = si.bsdf().eval_pdf(context, si, si.to_local(record.d), active)
            value *= f
            reflects = active & (record.pdf > 0) & (dr.max(value) > 0)
            behind = medium_after(si, record.d, pointer)
            far = are_distant(record.emitter)
            media = self._media_towards(record, vertex.p, is_original & far, is_original & ~far)
            target = position_on(record, vertex)
            passed, rng = visibility(scene, media, vertex, target, behind, rng, reflects, exact)
            weight = power_heuristic(record.pdf, dr.select(record.delta, 0, density))
            result += dr.select(reflects, value * passed * weight, 0)
            number += 1
            active &= number < self.emitters.count
        if dr.hint(self.emitters.have_extent, mode="scalar"):
            met, rng = self.met_by_bsdf(scene, si, pointer, rng, ends, exact)
            result += met
        return result, rng

    def _media_towards(
        self, record: mi.DirectionSample3f, p: mi.Point3f, far: mi.Bool, near: mi.Bool
    ) -> Media | PartlyOriginalMedia:
        """Return the media by which sampled emitters are attenuated as seen from ``p``.

        In the lanes ``far`` (`AngularBasis.hits_source`) and ``near``, emitters that forward peaks
        scatter are attenuated by the original extinction: the rest of their radiance is part of the
        radiance that nodes gather, or that is scattered towards ``p``.
        """
        if self.peak is None:
            return self.media
        is_original = self.peak.include(record.emitter, p, record.d, far, near)
        return PartlyOriginalMedia(self.media, self._original_media, is_original)

    def met_by_bsdf(self, scene, si, pointer, rng, active, exact: bool):
        """Sample a ray from the BSDF at ``si``; return the reflected radiance of the sampled
        emitters that it hits, with multiple importance sampling.
        """
        choice = rng.next_float32(active)
        u = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
        sample, f = si.bsdf().sample(mi.BSDFContext(), si, choice, u, active)
        active = active & (sample.pdf > 0) & (dr.max(f) > 0)
        direction, vertex = si.to_world(sample.wo), vertex_at(si)
        pointer = medium_after(si, direction, pointer)
        ray, media = si.spawn_ray(direction), self.media
        if self.peak is not None:
            is_original = self.peak.hit_by(scene, vertex.p, ray, active, active)
            media = PartlyOriginalMedia(media, self._original_media, is_original)
        lines = ray, pointer, active
        met, rng = self._emitters_along(scene, media, lines, vertex, sample.pdf, rng, exact)
        return f * met, rng

    @symbolic
    def _emitters_along(self, scene, media, lines, vertex, density, rng, exact: bool):
        """Return the attenuated radiance of the sampled emitters on ``lines`` from ``vertex``.

        Surfaces that partly transmit are passed like null ones, as by `transport.path.visibility`:
        both ways to find an emitter, of which this one has the ``density`` [1/sr], then see the
        same emitters. ``lines`` are rays, their media, and which are active.
        """
        ray, pointer, active = mi.Ray3f(lines[0]), mi.MediumPtr(lines[1]), mi.Bool(lines[2])
        total, attenuation, crossings = mi.Spectrum(0), mi.Spectrum(1), mi.UInt32(0)
        while dr.hint(active, label="emitters met"):
            si = scene.ray_intersect(ray, active)
            if dr.hint(exact, mode="scalar"):
                factor = media.exact_transmittance(pointer, ray, si.t, active)
            else:
                factor, rng = media.transmittance(pointer, ray, si.t, rng, active)
            attenuation = dr.select(active, attenuation * factor, attenuation)
            emitter = si.emitter(scene, active)
            is_emitter = active & (emitter != None)  # noqa: E711
            value = emitter.eval(si, is_emitter)
            excess = self.emitters.excess(emitter, value)
            is_emitter &= (excess > 0) & (dr.max(value) > 0)
            record = mi.DirectionSample3f(scene, si, vertex)
            weight = power_heuristic(density, emitter.pdf_direction(vertex, record, is_emitter))
            total += dr.select(is_emitter, attenuation * value * excess * weight, 0)
            hit = active & si.is_valid()
            ray, pointer, attenuation = straight_through(si, ray, pointer, attenuation, hit)
            crossings += 1
            active &= hit & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)
        # A line that exceeds the maximum number of crossings does not contribute.
        return dr.select(crossings < MOST_CROSSINGS, total, 0), rng

    @symbolic
    def scattered_forward(self, scene, ray, pointer, rng, active):
        """Return the radiance of narrow sources that truncated forward peaks scatter into ``ray``
        before the first surface that is not null.
        """
        ray, pointer, active = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Bool(active)
        radiance, throughput, crossings = mi.Spectrum(0), mi.Spectrum(1), mi.UInt32(0)
        while dr.hint(active, label="scattered forward"):
            si = scene.ray_intersect(ray, active)
            offset = 1 - rng.next_float32(active)
            for projection in self.projections:
                hit, entry, leave = projection.medium.intersect(ray)
                entry, leave = dr.maximum(entry, 0), dr.minimum(leave, si.t)
                hit &= active & (pointer == projection.medium.pointer)
                ends = ray, entry, leave, mi.Spectrum(self.background_bound), offset, hit
                peaked = projection.truncates_peak
                part = Scattering.PEAK if peaked else Scattering.WITHOUT_PEAK
                scattered, transmittance, *_ = projection.march(*ends, scattering=part)
                if dr.hint(peaked, mode="scalar"):
                    radiance += dr.select(hit, throughput * scattered, 0)
                throughput = dr.select(hit, throughput * transmittance, throughput)
            crosses = active & si.is_valid() & is_null(si.bsdf().flags())
            factor = si.bsdf().eval_null_transmission(si, crosses)
            throughput = dr.select(crosses, throughput * factor, throughput)
            pointer = dr.select(crosses, medium_after(si, ray.d, pointer), pointer)
            ray = si.spawn_ray(ray.d)
            crossings += 1
            active &= crosses & (crossings < MOST_CROSSINGS)
        return radiance

    def visible(self, scene, si, numbers, weights, active):
        """Reduce the ``weights`` of nodes, where ``active``, to those that are visible from a
        point, and normalise them.
        """
        seen = []
        for number, weight in zip(numbers, weights, strict=True):
            tested = active & (weight > 0)
            p, geometric, *_ = self.nodes.positions(number, tested)
            height = CHORD * dr.norm(p - si.p)
            vertex = dr.zeros(mi.Interaction3f)
            vertex.p, vertex.n = si.p + height * geometric, si.n
            clear = unobstructed(scene, vertex.spawn_ray_to(p + height * geometric), tested)
            seen.append(dr.select(active & ~clear, 0, weight))
        total = seen[0] + seen[1] + seen[2] + seen[3]
        scale = dr.select(total > 0, dr.rcp(total), 0)
        return [
            dr.select(active, w * scale, weight) for w, weight in zip(seen, weights, strict=True)
        ]

    def irradiance_at(
        self, numbers: list[mi.UInt32], weights: list[mi.Float], active: mi.Bool
    ) -> mi.Spectrum:
        """Interpolate the irradiance between nodes."""
        channels = []
        for values in self.irradiance:
            total = mi.Float(0)
            for number, weight in zip(numbers, weights, strict=True):
                total += weight * dr.gather(mi.Float, values, number, active & (weight > 0))
            channels.append(total)
        return mi.Spectrum(*channels)

    @symbolic
    def walk(self, scene, ray, pointer, rng, active):
        """Follow rays through null, glossy and specular surfaces to the first diffuse one.

        Returns its position, its geometric and shading normal, the number of the medium before it,
        and the length of the path to it; whether there is one; and the distances of the first
        surface or medium, and of the first surface (infinite where there is none).
        """
        ray, pointer = mi.Ray3f(ray), mi.MediumPtr(pointer)
        position, geometric, shading = mi.Point3f(0), mi.Normal3f(0), mi.Normal3f(0)
        before = mi.MediumPtr(pointer)
        found, nearest, travelled = mi.Bool(False), mi.Float(dr.inf), mi.Float(0)
        nearest_surface = mi.Float(dr.inf)
        bounces, crossings, active = mi.UInt32(0), mi.UInt32(0), mi.Bool(active)
        while dr.hint(active, label="towards a diffuse surface"):
            for projection in self.projections:
                inside = active & (bounces == 0) & (pointer == projection.medium.pointer)
                distance = dr.maximum(travelled, projection.cell * MEDIUM_CELLS)
                peaked = projection.truncates_peak and self.peak.narrow.count > 0
                if dr.hint(peaked, mode="scalar"):
                    distance *= self.peak_distance
                nearest = dr.select(inside, dr.minimum(nearest, distance), nearest)
            si = scene.ray_intersect(ray, active)
            active &= si.is_valid()
            travelled += dr.select(active, si.t, 0)
            crosses = active & is_null(si.bsdf().flags())
            surface = active & ~crosses
            nearest_surface = dr.select(surface & (bounces == 0), travelled, nearest_surface)
            diffuse, _ = lambertian(si, surface)
            normals = facing(si, ray.d)
            position = dr.select(diffuse, si.p, position)
            geometric = dr.select(diffuse, normals[0], geometric)
            shading = dr.select(diffuse, normals[1], shading)
            before = dr.select(diffuse, pointer, before)
            found |= diffuse
            scatters = surface & ~diffuse
            choice = rng.next_float32(scatters)
            sample = mi.Point2f(rng.next_float32(scatters), rng.next_float32(scatters))
            direction, f, *_ = sample_bsdf(si, choice, sample, scatters)
            scatters &= dr.max(f) > 0
            direction = dr.select(scatters, direction, ray.d)
            pointer = dr.select(crosses | scatters, medium_after(si, direction, pointer), pointer)
            ray = dr.select(crosses | scatters, si.spawn_ray(direction), ray)
            bounces = dr.select(scatters, bounces + 1, bounces)
            crossings += 1
            active &= (crosses | scatters) & (bounces < MOST_BOUNCES)
            active &= crossings < MOST_CROSSINGS
        distances = dr.minimum(nearest, nearest_surface), nearest_surface
        place = position, (geometric, shading), self.media.number_of(before), travelled
        return place, found, distances


@dataclass
class _FollowedPath:
    """State of a path between surfaces."""

    ray: mi.Ray3f
    pointer: mi.MediumPtr
    throughput: mi.Spectrum
    eta: mi.Float
    #: density of the direction, 0 if emitters were not sampled at the last vertex
    pdf: mi.Float
    last: mi.Interaction3f
    #: whether there was no vertex yet
    first: mi.Bool
    #: part of the radiance of narrow sources that is not scattered into a truncated forward peak on
    #: the way from the last vertex
    share: mi.Spectrum
    #: whether there is no medium before the next surface
    clear: mi.Bool
    depth: mi.UInt32
    crossings: mi.UInt32
    #: length of the path so far
    travelled: mi.Float
    #: places for paths that were split off
    waiting: list
    rng: mi.PCG32
    active: mi.Bool


@dataclass
class _PathSums:
    """Results of `SurfacePaths.follow`."""

    emitted: mi.Spectrum
    radiance: mi.Spectrum
    #: transmittance of the media before hidden emitters and the background, without that of a
    #: forward peak; 0 for paths with a vertex
    passed: mi.Spectrum
    end_number: mi.UInt32
    end_factor: mi.Spectrum


class _PathFollower:
    """The loop over the surfaces of `SurfacePaths.follow`."""

    def __init__(
        self,
        paths: SurfacePaths,
        scene: mi.Scene,
        on_emitter: EmitterSample | None,
        hide_emitters: bool,
    ) -> None:
        self._paths, self._scene = paths, scene
        self._from_node = on_emitter is None
        self._splits = paths.splits and not self._from_node
        self._camera_sample = on_emitter or EmitterSample(mi.Point2f(0))
        self._hide_emitters = hide_emitters and not self._from_node

    def begin(
        self, ray: mi.Ray3f, pointer: mi.MediumPtr, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[_FollowedPath, _PathSums]:
        """Return the state before the first surface, and sums of 0."""
        ray, pointer, last = mi.Ray3f(ray), mi.MediumPtr(pointer), dr.zeros(mi.Interaction3f)
        last.p = ray.o
        path = _FollowedPath(
            ray=ray,
            pointer=pointer,
            throughput=mi.Spectrum(1),
            eta=mi.Float(1),
            pdf=mi.Float(0),
            last=last,
            first=mi.Bool(True),
            share=mi.Spectrum(1),
            clear=mi.Bool(not self._from_node),
            depth=mi.UInt32(0),
            crossings=mi.UInt32(0),
            travelled=mi.Float(0),
            waiting=no_waiting(ray, pointer) if self._splits else [],
            rng=rng,
            active=mi.Bool(active),
        )
        black, none = mi.Spectrum(0), mi.UInt32(0)
        return path, _PathSums(black, mi.Spectrum(0), mi.Spectrum(1), none, mi.Spectrum(0))

    def advance(self, path: _FollowedPath, sums: _PathSums) -> None:
        """Trace paths to their next surface, and sample the direction in which they continue."""
        self._apply_roulette(path)
        si = self._scene.ray_intersect(path.ray, path.active)
        self._march_media(path, sums, si)
        valid = path.active & si.is_valid()
        path.travelled += dr.select(valid, si.t, 0)
        hidden = self._add_hit_emitter(path, sums, si, valid)
        crosses = valid & (is_null(si.bsdf().flags()) | hidden)
        surface = valid & ~crosses
        ends = self._end_at_nodes(path, sums, si, surface)
        self._add_sampled_emitters(path, sums, si, surface, ends)
        self._scatter(path, sums, si, surface & ~ends, crosses)
        if self._splits:
            self._resume(path)

    def _apply_roulette(self, path: _FollowedPath) -> None:
        survival = dr.minimum(dr.max(path.throughput) * dr.square(path.eta), MAX_SURVIVAL)
        survival = dr.select(path.depth > self._paths.rr_depth, survival, 1)
        survives = path.rng.next_float32(path.active) < survival
        path.active &= survives & (dr.max(path.throughput) > 0)
        path.throughput = dr.select(path.active, path.throughput / survival, path.throughput)

    def _march_media(
        self, path: _FollowedPath, sums: _PathSums, si: mi.SurfaceInteraction3f
    ) -> None:
        """Ray march the media up to the next surface."""
        offset = 1 - path.rng.next_float32(path.active)
        for projection in self._paths.projections:
            hit, entry, leave = projection.medium.intersect(path.ray)
            entry, leave = dr.maximum(entry, 0), dr.minimum(leave, si.t)
            hit &= path.active & ~path.clear & (path.pointer == projection.medium.pointer)
            # Camera rays are marched before this, too, by the same code.
            march = projection.march if self._from_node else projection.called_march
            scattered, transmittance, _, emitted = march(
                path.ray,
                entry,
                leave,
                mi.Spectrum(self._paths.background_bound),
                offset,
                hit,
                scattering=Scattering.WITHOUT_PEAK if self._from_node else Scattering.ALL,
            )
            sums.radiance += dr.select(hit, path.throughput * (scattered + emitted), 0)
            path.throughput = dr.select(hit, path.throughput * transmittance, path.throughput)
            unscattered = transmittance
            if projection.truncates_peak:
                unscattered = projection.unscattered(transmittance, path.ray, entry, leave, hit)
                share = dr.minimum(unscattered / dr.maximum(transmittance, 1e-30), 1)
                path.share *= dr.select(hit & (entry < leave), share, 1)
            sums.passed *= dr.select(hit & path.first & (entry < leave), unscattered, 1)
        path.clear = mi.Bool(False)

    def _add_hit_emitter(
        self,
        path: _FollowedPath,
        sums: _PathSums,
        si: mi.SurfaceInteraction3f,
        valid: mi.Bool,
    ) -> mi.Bool:
        """Add emission, with multiple importance sampling where the last vertex sampled it.

        Returns the mask of lanes whose surface is a hidden emitter, which the path passes through.
        """
        paths, emitter = self._paths, si.emitter(self._scene, path.active)
        is_emitter = path.active & (emitter != None)  # noqa: E711
        hidden = mi.Bool(False)
        if self._hide_emitters:
            # As in volpath, hidden emitters are transparent if they are outside of all media.
            hidden = is_emitter & path.first & (path.pointer == None)  # noqa: E711
            is_emitter &= ~path.first
        value = emitter.eval(si, is_emitter)
        excess = paths.emitters.excess(emitter, value)
        value *= path.throughput
        if paths.peak is not None:
            ends = is_emitter & ~valid, is_emitter & valid
            unblurred = paths.peak.include(emitter, path.last.p, path.ray.d, *ends)
            unblurred &= path.first | (not self._from_node)
            value *= dr.select(unblurred, path.share, 1)
        record = mi.DirectionSample3f(self._scene, si, path.last)
        sampled = is_emitter & (path.pdf > 0) & (excess > 0)
        density = emitter.pdf_direction(path.last, record, sampled)
        weight = dr.select(sampled, power_heuristic(path.pdf, density), 1)
        if self._from_node:
            weight = dr.select(path.first, 0, weight)
        value = dr.select(is_emitter, value * (1 - excess + excess * weight), 0)
        sums.emitted += dr.select(path.first, value, 0)
        sums.radiance += dr.select(path.first, 0, value)
        return hidden

    def _end_at_nodes(
        self,
        path: _FollowedPath,
        sums: _PathSums,
        si: mi.SurfaceInteraction3f,
        surface: mi.Bool,
    ) -> mi.Bool:
        """End paths at diffuse surfaces with nodes; return the mask of paths that end."""
        # docs/primer, eq. (5.9)
        paths = self._paths
        diffuse, factor = lambertian(si, surface)
        normals = facing(si, path.ray.d)
        bounds = paths.spacing_bounds(si.p, path.travelled, self._from_node)
        numbers, weights, uncertain, _, _ = paths.nodes.find(si.p, normals, bounds, diffuse)
        weights = paths.visible(self._scene, si, numbers, weights, diffuse & uncertain)
        ends = diffuse & (weights[0] + weights[1] + weights[2] + weights[3] > 0)
        if self._from_node:
            number = chosen(numbers, weights, path.rng.next_float32(ends))
            sums.end_number = dr.select(ends, number, 0)
            sums.end_factor = dr.select(ends, path.throughput * factor, sums.end_factor)
        else:
            known = paths.irradiance_at(numbers, weights, ends)
            sums.radiance += dr.select(ends, path.throughput * factor * known, 0)
        sums.passed = dr.select(ends, 0, sums.passed)
        return ends

    def _add_sampled_emitters(
        self,
        path: _FollowedPath,
        sums: _PathSums,
        si: mi.SurfaceInteraction3f,
        surface: mi.Bool,
        ends: mi.Bool,
    ) -> None:
        """Sample the emitters."""
        rng, sample = path.rng, self._camera_sample
        smooth = surface & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        u = mi.Point2f(rng.next_float32(smooth), rng.next_float32(smooth))
        if not self._from_node:
            u = dr.select(path.first, sample.u, u)
        on_emitters = EmitterSample(u, dr.select(path.first, sample.sign, 1))
        where = ends, ends | (not self._from_node)
        direct, path.rng = self._paths.direct(
            self._scene, si, path.pointer, on_emitters, rng, smooth, where, not self._from_node
        )
        sums.radiance += dr.select(smooth, path.throughput * direct, 0)

    def _scatter(
        self,
        path: _FollowedPath,
        sums: _PathSums,
        si: mi.SurfaceInteraction3f,
        scatters: mi.Bool,
        crosses: mi.Bool,
    ) -> None:
        """Sample the BSDF where paths continue, and pass null surfaces."""
        rng, vertex = path.rng, vertex_at(si)
        choice = rng.next_float32(scatters)
        sample = mi.Point2f(rng.next_float32(scatters), rng.next_float32(scatters))
        if self._splits:
            sample = dr.select(path.first, self._camera_sample.u, sample)
            state = path.pointer, path.throughput, path.eta, vertex
            path.waiting, found = split(path.waiting, si, state, (choice, sample), scatters)
        else:
            found = sample_bsdf(si, choice, sample, scatters)
        direction, f, scale, is_vertex, density = found
        path.throughput = dr.select(scatters, path.throughput * f, path.throughput)
        path.eta = dr.select(scatters, path.eta * scale, path.eta)
        path.pdf = dr.select(is_vertex, density, path.pdf)
        path.last = dr.select(is_vertex, vertex, path.last)
        path.share = dr.select(is_vertex, 1, path.share)
        path.first &= ~is_vertex
        sums.passed = dr.select(is_vertex, 0, sums.passed)
        path.depth = dr.select(is_vertex, path.depth + 1, path.depth)
        direction = dr.select(scatters, direction, path.ray.d)
        goes_on = crosses | scatters
        medium = medium_after(si, direction, path.pointer)
        path.pointer = dr.select(goes_on, medium, path.pointer)
        path.ray = dr.select(goes_on, si.spawn_ray(direction), path.ray)
        path.crossings += 1
        path.active &= goes_on & (path.crossings < MOST_CROSSINGS)

    def _resume(self, path: _FollowedPath) -> None:
        """Continue with waiting reflected paths in lanes whose path has ended."""
        state = [path.ray, path.pointer, path.throughput, path.eta, path.last, path.pdf]
        path.waiting, state, new = resumed(path.waiting, state, path.active)
        path.ray, path.pointer, path.throughput, path.eta, path.last, path.pdf = state
        path.depth = dr.select(new, 1, path.depth)
        path.share = dr.select(new, 1, path.share)
        path.first &= ~new
        path.active |= new


def chosen(numbers: list[mi.UInt32], weights: list[mi.Float], u: mi.Float) -> mi.UInt32:
    """Choose one of the ``numbers`` with probabilities ``weights``."""
    result, largest = mi.UInt32(numbers[0]), mi.Float(weights[0])
    for number, weight in zip(numbers[1:], weights[1:], strict=True):
        result = dr.select(weight > largest, number, result)  # in case of rounding
        largest = dr.maximum(weight, largest)
    remaining, settled = mi.Float(u), mi.Bool(False)
    for number, weight in zip(numbers, weights, strict=True):
        here = ~settled & (remaining < weight)
        result = dr.select(here, number, result)
        settled |= here
        remaining -= weight
    return result
