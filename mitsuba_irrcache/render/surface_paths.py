"""Paths between surfaces, with ray-marched media and cached irradiance at their last vertex.

A path ends at the first diffuse surface whose irradiance can be interpolated. Mirrors, glass and
glossy surfaces are sampled as in path tracing. Between surfaces the in-scattered radiance of the
media is integrated by ray marching of their caches, which is free of the noise of sampled
collisions.

Where a medium has a forward peak that counts as unscattered (`media/delta_m`), narrow sources reach
surfaces attenuated by the original extinction, so that their shadows are sharp. What the peak
scatters of their radiance is gathered by the nodes along rays of their own.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.surface import INDIRECT_LEVELS, LEVELS, SurfaceNodes
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import kronecker
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.lights.emitters import EmitterKind, EmittersByKind
from mitsuba_irrcache.lights.narrow_sources import Source
from mitsuba_irrcache.render.path_splitting import no_waiting, resumed, split
from mitsuba_irrcache.render.raymarch import Projection
from mitsuba_irrcache.transport.path import (
    MAX_SURVIVAL,
    MOST_CROSSINGS,
    Media,
    is_null,
    medium_after,
    power_heuristic,
    sample_bsdf,
    visibility,
)

#: Vertices without a diffuse surface up to which positions for nodes are searched.
MOST_BOUNCES = 6
#: Distance, in voxels of its cache, over which the radiance of a medium varies: nodes within the
#: medium need not be closer than a part of it.
MEDIUM_CELLS = 8.0
#: Height above the surface, over their distance, at which the visibility between a point and a node
#: is tested: chords of curved surfaces lie below these.
CHORD = 0.1
#: Luminance over its mean from which on a direction of an environment counts as a peak, which
#: casts shadows; samples of such an environment at each vertex.
PEAK, ENVIRONMENT_SAMPLES = 8.0, 8
#: Samples of emitters at each vertex, at most: if there are more emitters, each stands for several.
MOST_EMITTERS = 16
#: Largest relative difference of f in three directions for which a BSDF counts as Lambertian.
LAMBERTIAN = 1e-4
#: Corners of the unit cube in homogeneous coordinates.
UNIT_CUBE = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)]).T


class SampledEmitters:
    """Emitters that are sampled at the vertices of paths: all but smooth environments.

    Of an environment with a peak, such as a sun in a map of the sky, only the excess over
    ``threshold`` (a luminance) is sampled; the remainder is gathered along all directions. Each
    point-like or distant emitter is sampled once, an environment `ENVIRONMENT_SAMPLES` times.
    """

    def __init__(self, emitters: EmittersByKind) -> None:
        slots = [(emitter, 0.0, 1.0) for emitter, kind in emitters if not kind.is_environment]
        threshold = dr.inf
        for environment in emitters.of(EmitterKind.ENVIRONMENT_MAP):
            threshold = peak_threshold(environment)
            if threshold < dr.inf:
                share = 1 / ENVIRONMENT_SAMPLES
                slots += [(environment, k * share, share) for k in range(ENVIRONMENT_SAMPLES)]
        self.threshold = dr.opaque(mi.Float, threshold)
        environments = [emitter for emitter, kind in emitters if kind.is_environment]
        self._environment = mi.EmitterPtr(environments[0] if environments else None)
        dr.make_opaque(self._environment)
        #: whether rays can meet what is sampled
        self.have_extent = threshold < dr.inf or any(
            not (kind.is_environment or kind.has_one_direction or kind.is_point_like)
            for _, kind in emitters
        )
        #: samples at each vertex, and how many emitters one of them stands for
        self.count = dr.opaque(mi.UInt32, min(len(slots), MOST_EMITTERS))
        self.stride = dr.opaque(mi.Float, max(len(slots) / MOST_EMITTERS, 1))
        self._last = dr.opaque(mi.UInt32, max(len(slots) - 1, 0))
        self._emitters = dr.zeros(mi.EmitterPtr, max(len(slots), 1))
        for i, (emitter, *_) in enumerate(slots):
            dr.scatter(self._emitters, mi.EmitterPtr(emitter), mi.UInt32(i))
        self._first = mi.Float([first for _, first, _ in slots] or [0.0])
        self._share = mi.Float([share for *_, share in slots] or [1.0])
        dr.eval(self._emitters, self._first, self._share)

    def excess(self, emitter: mi.EmitterPtr, radiance: mi.Spectrum) -> mi.Float:
        """The part of a ``radiance`` of an emitter that is sampled."""
        peak = dr.maximum(1 - self.threshold / dr.maximum(luminance(radiance), 1e-30), 0)
        return dr.select(emitter == self._environment, peak, 1)

    def sample(
        self, number: mi.Float, vertex: mi.Interaction3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Sample a direction; return it with its radiance, without what is gathered, over its
        density.

        ``number`` is that of a sample, plus a random fraction, by which one emitter is chosen of
        those that it stands for.
        """
        number = dr.minimum(mi.UInt32(number * self.stride), self._last)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, number, active)
        share = dr.gather(mi.Float, self._share, number, active) * self.stride
        first = dr.gather(mi.Float, self._first, number, active)
        u = mi.Point2f(u.x, first + u.y * dr.gather(mi.Float, self._share, number, active))
        record, value = emitter.sample_direction(vertex, u, active)
        return record, value * share * self.excess(emitter, value * record.pdf)


class EmitterSample:
    """Position in [0, 1)^2 on the first sampled emitter at a vertex, shifted by a golden-ratio
    sequence for further ones: backwards for the second one of an antithetic pair (``sign`` -1).
    """

    def __init__(self, u: mi.Point2f, sign: mi.Float | float = 1.0) -> None:
        self.u, self.sign = u, mi.Float(sign)

    def of(self, number: mi.UInt32) -> mi.Point2f:
        """Return the position on the emitter with this number."""
        u = self.u + self.sign * mi.Point2f(kronecker(number, 2))
        return u - dr.floor(u)


def peak_threshold(environment: mi.Emitter) -> float:
    """The luminance beyond which an environment counts as a peak; infinite without peaks."""
    u = np.random.default_rng(1).random((2, 1 << 14), dtype=np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, u.shape[1])
    si.wi = -mi.warp.square_to_uniform_sphere(mi.Point2f(u))
    mean = float(dr.mean(luminance(environment.eval(si)))[0])
    record, _ = environment.sample_direction(si, mi.Point2f(u))
    si.wi = -record.d
    highest = float(dr.max(luminance(environment.eval(si)))[0])
    return PEAK * mean if highest > PEAK * mean else dr.inf


class SurfacePaths:
    """Paths in a scene with caches of its media (``projections``) and on its surfaces.

    Irradiance at the ``nodes`` excludes what comes straight from the `SampledEmitters`, which are
    sampled wherever a path ends.
    """

    def __init__(
        self,
        media: Media,
        projections: Sequence[Projection],
        emitters: SampledEmitters,
        brightest: mi.Float,
        rr_depth: mi.UInt32,
        nodes: SurfaceNodes | None = None,
        splits: bool = False,
    ) -> None:
        """Use these ``nodes``, or none yet; ``splits``: split camera paths at glass."""
        self.splits = splits
        self.media, self.projections, self.emitters = media, projections, emitters
        self.brightest, self.rr_depth = brightest, rr_depth
        if nodes is None:
            corners = [(p.medium.frame @ UNIT_CUBE)[:3] for p in projections]
            nodes = SurfaceNodes(np.min(corners, axis=(0, 2)), np.max(corners, axis=(0, 2)))
        self.nodes = nodes
        #: narrow sources, if any medium has a truncated forward peak, and the media before that
        self.narrow = next(
            (p.directional.directional for p in projections if p.truncates_peak), None
        )
        self._original_media = media
        if self.narrow is not None:
            self._original_media = Media([grid.original or grid for grid in media.grids])
        #: levels of nodes for points that the camera sees, and for others
        self.levels, self.indirect_levels = (
            dr.opaque(mi.UInt32, n) for n in (LEVELS, INDIRECT_LEVELS)
        )
        #: irradiance of the nodes, one array for each channel
        self.irradiance = [mi.Float(0) for _ in range(dr.size_v(mi.Spectrum))]

    @property
    def narrow_sources(self) -> tuple[Source, ...]:
        """Narrow sources whose radiance truncated forward peaks scatter, empty without a peak."""
        return () if self.narrow is None else (*self.narrow.sources, *self.narrow.others)

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
    ):
        """Follow paths that begin with ``ray`` in the medium ``pointer``: at a node or, if samples
        ``on_emitter`` for the first vertex are given, at a camera ray's end before a surface.

        Returns the radiance of emitters at the first surface, all other radiance, whether there was
        any interaction, and the node whose irradiance has to be added with the returned factor
        (only for rays from nodes; else it is included).
        """
        from_node = on_emitter is None
        splits = self.splits and not from_node
        camera_sample = on_emitter or EmitterSample(mi.Point2f(0))
        emitted, radiance = mi.Spectrum(0), mi.Spectrum(0)
        throughput, eta = mi.Spectrum(1), mi.Float(1)
        ray, pointer = mi.Ray3f(ray), mi.MediumPtr(pointer)
        pdf, last = mi.Float(0), dr.zeros(mi.Interaction3f)
        last.p = ray.o
        first, interacted = mi.Bool(True), mi.Bool(False)
        share, has_peaks = mi.Spectrum(1), self.narrow is not None
        clear = mi.Bool(not from_node)
        end_number, end_factor = mi.UInt32(0), mi.Spectrum(0)
        depth, crossings = mi.UInt32(0), mi.UInt32(0)
        waiting = no_waiting(ray, pointer) if splits else []
        active = mi.Bool(active)
        while dr.hint(active, label="surface paths"):
            survival = dr.minimum(dr.max(throughput) * dr.square(eta), MAX_SURVIVAL)
            survival = dr.select(depth > self.rr_depth, survival, 1)
            active &= (rng.next_float32(active) < survival) & (dr.max(throughput) > 0)
            throughput = dr.select(active, throughput / survival, throughput)

            # Ray march the media up to the next surface.
            si = scene.ray_intersect(ray, active)
            offset = 1 - rng.next_float32(active)
            for projection in self.projections:
                hit, entry, leave = projection.medium.intersect(ray)
                entry, leave = dr.maximum(entry, 0), dr.minimum(leave, si.t)
                hit &= active & ~clear & (pointer == projection.medium.pointer)
                scattered, transmittance, _, volume_emission = projection.march(
                    ray,
                    entry,
                    leave,
                    mi.Spectrum(self.brightest),
                    offset,
                    hit,
                    with_peak=not from_node,
                )
                radiance += dr.select(hit, throughput * (scattered + volume_emission), 0)
                throughput = dr.select(hit, throughput * transmittance, throughput)
                if dr.hint(projection.truncates_peak, mode="scalar"):
                    share *= projection.share_unscattered(transmittance, ray, entry, leave, hit)
            clear = mi.Bool(False)

            # Add emission, with multiple importance sampling where the last vertex sampled it.
            valid = active & si.is_valid()
            emitter = si.emitter(scene, active)
            is_emitter = active & (emitter != None)  # noqa: E711
            if dr.hint(hide_emitters and not from_node, mode="scalar"):
                is_emitter &= ~first
            value = emitter.eval(si, is_emitter)
            excess = self.emitters.excess(emitter, value)
            value *= throughput
            if dr.hint(has_peaks, mode="scalar"):
                narrow = self.narrow.hits_source(
                    last.p, ray.d, is_emitter & ~valid, is_emitter & valid
                )
                narrow &= first | (not from_node)
                value *= dr.select(narrow, share, 1)
            record = mi.DirectionSample3f(scene, si, last)
            sampled = is_emitter & (pdf > 0) & (excess > 0)
            density = emitter.pdf_direction(last, record, sampled)
            weight = dr.select(sampled, power_heuristic(pdf, density), 1)
            if dr.hint(from_node, mode="scalar"):
                weight = dr.select(first, 0, weight)
            value = dr.select(is_emitter, value * (1 - excess + excess * weight), 0)
            emitted += dr.select(first, value, 0)
            radiance += dr.select(first, 0, value)

            # End at a diffuse surface with nodes: docs/primer, eq. (5.9).
            bsdf = si.bsdf()
            crosses = valid & is_null(bsdf.flags())
            surface = valid & ~crosses
            diffuse, factor = lambertian(si, surface)
            normals = facing(si, ray.d)
            levels = self.indirect_levels if from_node else self.levels
            numbers, weights, uncertain, _, _ = self.nodes.find(si.p, normals, levels, diffuse)
            weights = self.visible(scene, si, numbers, weights, diffuse & uncertain)
            ends = diffuse & (weights[0] + weights[1] + weights[2] + weights[3] > 0)
            if dr.hint(from_node, mode="scalar"):
                end_number = dr.select(ends, chosen(numbers, weights, rng.next_float32(ends)), 0)
                end_factor = dr.select(ends, throughput * factor, end_factor)
            else:
                known = self.irradiance_at(numbers, weights, ends)
                radiance += dr.select(ends, throughput * factor * known, 0)
            interacted |= ends

            # Sample the emitters, and the BSDF where the path continues.
            scatters = surface & ~ends
            smooth = surface & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            u = mi.Point2f(rng.next_float32(smooth), rng.next_float32(smooth))
            if dr.hint(not from_node, mode="scalar"):
                u = dr.select(first, camera_sample.u, u)
            on_emitters = EmitterSample(u, dr.select(first, camera_sample.sign, 1))
            straight = ends | (not from_node)
            direct, rng = self.direct(
                scene, si, pointer, on_emitters, rng, smooth, (ends, straight), not from_node
            )
            radiance += dr.select(smooth, throughput * direct, 0)
            vertex = vertex_at(si)
            choice = rng.next_float32(scatters)
            sample = mi.Point2f(rng.next_float32(scatters), rng.next_float32(scatters))
            if dr.hint(splits, mode="scalar"):
                sample = dr.select(first, camera_sample.u, sample)
                state = pointer, throughput, eta, vertex
                waiting, found = split(waiting, si, state, (choice, sample), scatters)
            else:
                found = sample_bsdf(si, choice, sample, scatters)
            direction, f, scale, is_vertex, density = found
            throughput = dr.select(scatters, throughput * f, throughput)
            eta = dr.select(scatters, eta * scale, eta)
            pdf = dr.select(is_vertex, density, pdf)
            last = dr.select(is_vertex, vertex, last)
            share = dr.select(is_vertex, 1, share)
            first &= ~is_vertex
            interacted |= is_vertex
            depth = dr.select(is_vertex, depth + 1, depth)
            direction = dr.select(scatters, direction, ray.d)
            pointer = dr.select(crosses | scatters, medium_after(si, direction, pointer), pointer)
            ray = dr.select(crosses | scatters, si.spawn_ray(direction), ray)
            crossings += 1
            active &= (crosses | scatters) & (crossings < MOST_CROSSINGS)
            if dr.hint(splits, mode="scalar"):
                state = [ray, pointer, throughput, eta, last, pdf]
                waiting, state, new = resumed(waiting, state, active)
                ray, pointer, throughput, eta, last, pdf = state
                depth = dr.select(new, 1, depth)
                active |= new
        return emitted, radiance, interacted, end_number, end_factor

    @symbolic
    def direct(self, scene, si, pointer, sample, rng, active, where, exact: bool):
        """Return the radiance reflected at ``si`` that comes straight from the sampled emitters.

        ``where`` are two masks. With multiple importance sampling: where the path ends (the first
        one), a ray is sampled from the BSDF for it here. Narrow sources are attenuated by the
        original extinction where the second one holds, see `transmittance_to`. The transmittance
        has no noise if it is to be ``exact``.
        """
        ends, straight = where
        result, number, context = mi.Spectrum(0), mi.UInt32(0), mi.BSDFContext()
        vertex, active = vertex_at(si), mi.Bool(active) & (self.emitters.count > 0)
        while dr.hint(active, label="sampled emitters"):
            chosen_by = mi.Float(number) + rng.next_float32(active)
            record, value = self.emitters.sample(chosen_by, vertex, sample.of(number), active)
            f, density = si.bsdf().eval_pdf(context, si, si.to_local(record.d), active)
            value *= f
            reflects = active & (record.pdf > 0) & (dr.max(value) > 0)
            behind = medium_after(si, record.d, pointer)
            passed, rng = self.transmittance_to(
                scene, vertex, record, behind, rng, reflects, straight, exact
            )
            weight = power_heuristic(record.pdf, dr.select(record.delta, 0, density))
            result += dr.select(reflects, value * passed * weight, 0)
            number += 1
            active &= number < self.emitters.count
        if dr.hint(self.emitters.have_extent, mode="scalar"):
            met, rng = self.met_by_bsdf(scene, si, pointer, rng, ends, exact)
            result += met
        return result, rng

    def transmittance_to(self, scene, vertex, record, behind, rng, active, straight, exact: bool):
        """Return the transmittance from ``vertex`` to the position of an emitter in ``record``.

        Where ``straight``, radiance of narrow sources that is scattered into a truncated forward
        peak does not count as transmitted: it is part of what nodes gather, or of the radiance that
        is scattered towards the vertex.
        """
        narrow = mi.Bool(False)
        if dr.hint(self.narrow is not None, mode="scalar"):
            far = mi.has_flag(record.emitter.flags(), mi.EmitterFlags.Infinite)
            narrow = straight & self.narrow.hits_source(vertex.p, record.d, far, ~far)
        passed, rng = visibility(
            scene, self.media, vertex, record.p, behind, rng, active & ~narrow, exact
        )
        if dr.hint(self.narrow is not None, mode="scalar"):
            own, rng = visibility(
                scene, self._original_media, vertex, record.p, behind, rng, active & narrow, exact
            )
            passed = dr.select(narrow, own, passed)
        return passed, rng

    def met_by_bsdf(self, scene, si, pointer, rng, active, exact: bool):
        """Return the radiance reflected at ``si`` from a sampled emitter that a ray meets which is
        sampled from the BSDF, with multiple importance sampling.
        """
        choice = rng.next_float32(active)
        u = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
        sample, f = si.bsdf().sample(mi.BSDFContext(), si, choice, u, active)
        active = active & (sample.pdf > 0) & (dr.max(f) > 0)
        direction, vertex = si.to_world(sample.wo), vertex_at(si)
        pointer = medium_after(si, direction, pointer)
        narrow = mi.Bool(False)
        if self.narrow is not None:
            narrow = self.narrow.hits_source(vertex.p, direction, mi.Bool(True), mi.Bool(True))
        end, passed, rng = first_opaque(
            scene, self.media, si.spawn_ray(direction), pointer, rng, active & ~narrow, exact
        )
        if self.narrow is not None:
            own_end, own, rng = first_opaque(
                scene,
                self._original_media,
                si.spawn_ray(direction),
                pointer,
                rng,
                active & narrow,
                exact,
            )
            end, passed = dr.select(narrow, own_end, end), dr.select(narrow, own, passed)
        emitter = end.emitter(scene, active)
        is_emitter = active & (emitter != None)  # noqa: E711
        value = emitter.eval(end, is_emitter)
        excess = self.emitters.excess(emitter, value)
        is_emitter &= (excess > 0) & (dr.max(value) > 0)
        record = mi.DirectionSample3f(scene, end, vertex)
        density = emitter.pdf_direction(vertex, record, is_emitter)
        weight = power_heuristic(sample.pdf, density)
        return dr.select(is_emitter, f * value * excess * weight * passed, 0), rng

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
                ends = ray, entry, leave, mi.Spectrum(self.brightest), offset, hit
                smooth, transmittance, *_ = projection.march(*ends, with_peak=False)
                if dr.hint(projection.truncates_peak, mode="scalar"):
                    scattered, *_ = projection.march(*ends)
                    radiance += dr.select(hit, throughput * (scattered - smooth), 0)
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

        Returns its position, its geometric and shading normal, and the number of the medium before
        it; whether there is one; and the distances of the first surface or medium, and of the first
        surface (infinite where there is none).
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
                scale = projection.cell * MEDIUM_CELLS
                nearest = dr.select(
                    inside, dr.minimum(nearest, dr.maximum(travelled, scale)), nearest
                )
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
        place = position, (geometric, shading), self.media.number_of(before)
        return place, found, distances


@symbolic
def first_opaque(
    scene: mi.Scene,
    media: Media,
    ray: mi.Ray3f,
    pointer: mi.MediumPtr,
    rng: mi.PCG32,
    active: mi.Bool,
    exact: bool,
):
    """Find the first surface along ``ray`` that is not null, invalid where there is none.

    Returns it with the transmittance of null surfaces and media before it, without noise if
    ``exact``, and the random generator.
    """
    ray, pointer, active = mi.Ray3f(ray), mi.MediumPtr(pointer), mi.Bool(active)
    end, attenuation = dr.zeros(mi.SurfaceInteraction3f), mi.Spectrum(1)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="first opaque surface"):
        si = scene.ray_intersect(ray, active)
        if dr.hint(exact, mode="scalar"):
            factor = media.exact_transmittance(pointer, ray, si.t, active)
        else:
            factor, rng = media.transmittance(pointer, ray, si.t, rng, active)
        attenuation = dr.select(active, attenuation * factor, attenuation)
        null = active & si.is_valid() & is_null(si.bsdf().flags())
        end = dr.select(active & ~null, si, end)
        factor = si.bsdf().eval_null_transmission(si, null)
        attenuation = dr.select(null, attenuation * factor, attenuation)
        pointer = dr.select(null, medium_after(si, ray.d, pointer), pointer)
        ray = si.spawn_ray(ray.d)
        crossings += 1
        active &= null & (dr.max(attenuation) > 0) & (crossings < MOST_CROSSINGS)
    # A line that exceeds the maximum number of crossings does not contribute.
    return end, dr.select(crossings < MOST_CROSSINGS, attenuation, 0), rng


@symbolic
def unobstructed(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool):
    """Whether no surface but null ones lies on ``ray`` up to its end."""
    ray, clear, active = mi.Ray3f(ray), mi.Bool(active), mi.Bool(active)
    crossings = mi.UInt32(0)
    while dr.hint(active, label="visible nodes"):
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        null = is_null(si.bsdf().flags())
        clear &= ~(hit & ~null)
        remaining = ray.maxt - si.t
        ray = si.spawn_ray(ray.d)
        ray.maxt = remaining
        crossings += 1
        active &= hit & null & (crossings < MOST_CROSSINGS)
    return clear


def vertex_at(si: mi.SurfaceInteraction3f) -> mi.Interaction3f:
    """The interaction from which emitters are sampled."""
    vertex = dr.zeros(mi.Interaction3f)
    vertex.p, vertex.n = si.p, si.n
    vertex.time, vertex.wavelengths = si.time, si.wavelengths
    return vertex


def facing(si: mi.SurfaceInteraction3f, direction: mi.Vector3f) -> tuple[mi.Normal3f, mi.Normal3f]:
    """Geometric and shading normal on the side from which a ray arrives in ``direction``."""
    geometric, shading = si.n, si.sh_frame.n
    geometric = dr.select(dr.dot(geometric, direction) < 0, geometric, -geometric)
    shading = dr.select(dr.dot(shading, direction) < 0, shading, -shading)
    return mi.Normal3f(geometric), mi.Normal3f(shading)


def lambertian(si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Bool, mi.Spectrum]:
    """Whether the BSDF reflects alike in all directions, and its value f = reflectance / pi.

    By flags and, since the normals of bump maps differ from those of the surface, by its values.
    """
    bsdf, context = si.bsdf(), mi.BSDFContext()
    flags = bsdf.flags() & int(mi.BSDFFlags.All)
    active = active & (flags == int(mi.BSDFFlags.DiffuseReflection))
    side = dr.select(si.wi.z < 0, mi.Float(-1), 1)
    value = bsdf.eval(context, si, mi.Vector3f(0, 0, side), active)
    for x, y in ((0.6, 0.0), (-0.3, 0.51961524)):
        other = bsdf.eval(context, si, mi.Vector3f(x, y, 0.8 * side), active) / 0.8
        active = active & (dr.max(dr.abs(other - value)) <= LAMBERTIAN * dr.max(value))
    return active, value


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
