"""The path loop: vertices in media and on surfaces, until paths end.

It is used by the solver ``path`` (irradiance at voxel centres), by ``sweep`` (radiance that enters
a medium from surfaces or through glass), and by camera rays (radiance of surfaces without cached
irradiance).

Depth has the meaning it has in ``volpath``: every collision in a medium and every surface that is
not null is a vertex of the path; null surfaces are free. An emitter contributes if fewer than
``max_depth`` vertices precede it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.media.phase import interaction
from mitsuba_irrcache.transport.path import (
    MAX_SURVIVAL,
    MOST_CROSSINGS,
    Media,
    medium_after,
    position_on,
    power_heuristic,
    sample_bsdf,
    visibility,
    with_valid_direction,
)


class PathStart:
    """Initial state of paths: a ray, its medium, and how it was sampled.

    ``depth`` is the number of preceding vertices. ``pdf`` is the density of the ray's direction if
    emitters were also sampled at the previous vertex; 0 if not, so that emitters hit by the ray
    count fully. ``clear`` states that there is no medium before the first surface. The radiance of
    the emitters ``excluded`` is not added if the ray hits them before any other vertex. ``sample``
    in [0, 1)^2 chooses an emitter and a point on it at the first vertex, so that both are
    stratified over the paths of a pixel; None: they are independent.
    """

    def __init__(
        self,
        ray: mi.Ray3f,
        pointer: mi.MediumPtr,
        depth: int,
        pdf: float,
        clear: bool = False,
        excluded: Sequence[mi.EmitterPtr] = (),
        sample: mi.Point2f | None = None,
    ) -> None:
        self.ray, self.pointer = ray, pointer
        self.depth, self.pdf, self.clear = depth, pdf, clear
        self.excluded, self.sample = tuple(excluded), sample


@dataclass
class PathEnd:
    """Final state of paths that end with a collision in a medium whose radiance is cached.

    ``p``, ``direction`` and ``pointer`` are the position, the direction of propagation and the
    medium of the collision. ``weight`` is the path throughput including the albedo; it is 0 for
    paths that end elsewhere.
    """

    p: mi.Point3f
    direction: mi.Vector3f
    pointer: mi.MediumPtr
    weight: mi.Spectrum


@dataclass
class PathSums:
    """Results of paths: the radiance received directly from emitters and emissive media, the
    scattered radiance, whether any interaction occurred, and where paths ended.
    """

    direct: mi.Spectrum
    scattered: mi.Spectrum
    interacted: mi.Bool
    end: PathEnd

    def add(self, radiance: mi.Spectrum, is_direct: mi.Bool) -> None:
        """Add ``radiance`` to the direct or, if the path has a vertex already, scattered part."""
        self.direct += dr.select(is_direct, radiance, 0)
        self.scattered += dr.select(is_direct, 0, radiance)


@dataclass
class _PathState:
    """Loop state of `PathTracer.trace`."""

    ray: mi.Ray3f
    pointer: mi.MediumPtr
    depth: mi.UInt32
    crossings: mi.UInt32
    throughput: mi.Spectrum
    eta: mi.Float
    #: density [1/sr] of the current direction; 0 if emitters were not sampled at the last vertex
    pdf: mi.Float
    #: previous vertex
    last: mi.Interaction3f
    #: whether there is no medium before the next surface
    clear: mi.Bool
    rng: mi.PCG32
    active: mi.Bool


@dataclass
class _Segment:
    """What ends a segment of a path: a collision at distance ``t``, or the surface at ``si``."""

    si: mi.SurfaceInteraction3f
    t: mi.Float
    collided: mi.Bool
    surface: mi.Bool

    def vertex(self, ray: mi.Ray3f) -> mi.Interaction3f:
        """Return the vertex at the end of the segment along ``ray``."""
        vertex = dr.zeros(mi.Interaction3f)
        vertex.p = dr.select(self.collided, ray(self.t), self.si.p)
        vertex.n = dr.select(self.collided, 0, self.si.n)
        vertex.time, vertex.wavelengths = ray.time, ray.wavelengths
        return vertex


class PathTracer:
    """Traces paths through a scene and its media.

    ``is_cached`` is an optional predicate on media: paths end with their first collision in a
    medium for which it holds, and the caller looks up the radiance there in a cache.
    """

    def __init__(
        self,
        scene: mi.Scene,
        media: Media,
        max_depth: mi.UInt32,
        rr_depth: mi.UInt32,
        hide_emitters: bool = False,
        is_cached: Callable[[mi.MediumPtr], mi.Bool] | None = None,
    ) -> None:
        self.scene, self.media = scene, media
        self._max_depth, self._rr_depth = max_depth, rr_depth
        self._hide_emitters, self._is_cached = hide_emitters, is_cached

    @symbolic
    def trace(self, start: PathStart, rng: mi.PCG32, active: mi.Bool):
        """Trace one path per lane; return `PathSums`, and the random number generator."""
        path, sums = self._begin(start, rng, active)
        while dr.hint(path.active, label="paths"):
            self._apply_roulette(path)
            is_direct = path.depth == start.depth
            segment = self._next_segment(path, sums, is_direct)
            skipped = self._add_hit_emitter(path, sums, segment, is_direct, start.excluded)
            segment.surface &= segment.si.is_valid()
            scatters = segment.surface & ~skipped
            vertex = segment.vertex(path.ray)
            first = None if start.sample is None else (is_direct, start.sample)
            self._add_sampled_emitter(path, sums, segment, vertex, scatters, first)
            is_vertex = self._scatter(path, segment, vertex, scatters, skipped)
            sums.interacted |= is_vertex
        return sums, path.rng

    def _begin(
        self, start: PathStart, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[_PathState, PathSums]:
        ray, pointer = mi.Ray3f(start.ray), mi.MediumPtr(start.pointer)
        depth, last = mi.UInt32(start.depth), dr.zeros(mi.Interaction3f)
        last.p = ray.o
        path = _PathState(
            ray=ray,
            pointer=pointer,
            depth=depth,
            crossings=mi.UInt32(0),
            throughput=mi.Spectrum(1),
            eta=mi.Float(1),
            pdf=mi.Float(start.pdf),
            last=last,
            clear=mi.Bool(start.clear),
            rng=rng,
            active=mi.Bool(active) & (depth < self._max_depth),
        )
        end = PathEnd(mi.Point3f(ray.o), mi.Vector3f(ray.d), mi.MediumPtr(pointer), mi.Spectrum(0))
        return path, PathSums(mi.Spectrum(0), mi.Spectrum(0), mi.Bool(False), end)

    def _apply_roulette(self, path: _PathState) -> None:
        """Apply Russian roulette as volpath does; it bounds the variation of the throughput."""
        survival = dr.minimum(dr.max(path.throughput) * dr.square(path.eta), MAX_SURVIVAL)
        survival = dr.select(path.depth > self._rr_depth, survival, 1)
        survives = path.rng.next_float32(path.active) < survival
        path.active &= survives & (dr.max(path.throughput) > 0)
        path.throughput = dr.select(path.active, path.throughput / survival, path.throughput)

    def _next_segment(self, path: _PathState, sums: PathSums, is_direct: mi.Bool) -> _Segment:
        """Sample a free flight, add emission along it, and end paths in cached media."""
        si = self.scene.ray_intersect(path.ray, path.active)
        collided, t, path.throughput, path.rng, emitted = self.media.sample_distance(
            path.pointer, path.ray, si.t, path.throughput, path.rng, path.active & ~path.clear
        )
        sums.add(emitted, is_direct)
        path.clear = mi.Bool(False)
        surface = path.active & ~collided
        sums.interacted |= collided
        if self._is_cached is not None:
            is_end, end = collided & self._is_cached(path.pointer), sums.end
            end.p = dr.select(is_end, path.ray(t), end.p)
            end.direction = dr.select(is_end, path.ray.d, end.direction)
            end.pointer = dr.select(is_end, path.pointer, end.pointer)
            end.weight = dr.select(is_end, path.throughput, end.weight)
            collided &= ~is_end
        return _Segment(si, t, collided, surface)

    def _add_hit_emitter(
        self,
        path: _PathState,
        sums: PathSums,
        segment: _Segment,
        is_direct: mi.Bool,
        excluded: Sequence[mi.EmitterPtr],
    ) -> mi.Bool:
        """Add emission of emitters hit by the ray, with multiple importance sampling.

        Returns the mask of lanes whose surface is a hidden emitter, which the path passes through.
        """
        si = segment.si
        emitter = si.emitter(self.scene, segment.surface)
        hit_emitter = segment.surface & (emitter != None)  # noqa: E711
        skipped = mi.Bool(False)
        if self._hide_emitters:
            hidden = hit_emitter & (path.depth == 0)
            hit_emitter &= ~hidden
            # As in volpath, hidden emitters are transparent if they are outside of all media.
            skipped = hidden & si.is_valid() & (path.pointer == None)  # noqa: E711
        record = mi.DirectionSample3f(self.scene, si, path.last)
        sampled = hit_emitter & (path.pdf > 0)
        density = self.scene.pdf_emitter_direction(path.last, record, sampled)
        mis_weight = dr.select(sampled, power_heuristic(path.pdf, density), 1)
        radiance = path.throughput * emitter.eval(si, hit_emitter) * mis_weight
        emitted = dr.select(hit_emitter, radiance, 0)
        for each in excluded:
            emitted = dr.select(is_direct & (emitter == each), 0, emitted)
        sums.add(emitted, is_direct)
        return skipped

    def _add_sampled_emitter(
        self,
        path: _PathState,
        sums: PathSums,
        segment: _Segment,
        vertex: mi.Interaction3f,
        scatters: mi.Bool,
        first: tuple[mi.Bool, mi.Point2f] | None,
    ) -> None:
        """Sample an emitter from a vertex, and add its radiance with multiple importance
        sampling. ``first`` has the mask of first vertices and `PathStart.sample`.
        """
        si, collided, rng = segment.si, segment.collided, path.rng
        bsdf = si.bsdf()
        smooth = scatters & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        active = (collided | smooth) & (path.depth + 1 < self._max_depth)
        sample = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
        if first is not None:
            sample = dr.select(*first, sample)
        record, emitted = self.scene.sample_emitter_direction(vertex, sample, False, active)
        record = with_valid_direction(record)
        active &= (record.pdf > 0) & (dr.max(emitted) > 0)
        value, density = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(record.d), active & smooth)
        value = dr.select(collided, mi.Spectrum(dr.inv_four_pi), value)
        density = dr.select(collided, dr.inv_four_pi, density)
        if not self.media.isotropic:
            collision = interaction(path.ray(segment.t), path.ray.d)
            phase = path.pointer.phase_function()
            value, density = _phase_value(
                phase, collision, record.d, active & collided, value, density
            )
        active &= dr.max(value) > 0
        medium = dr.select(segment.surface, medium_after(si, record.d, path.pointer), path.pointer)
        target = position_on(record, vertex)
        attenuation, path.rng = visibility(
            self.scene, self.media, vertex, target, medium, rng, active
        )
        mis_weight = power_heuristic(record.pdf, dr.select(record.delta, 0, density))
        sums.scattered += dr.select(
            active, path.throughput * value * emitted * attenuation * mis_weight, 0
        )

    def _scatter(
        self,
        path: _PathState,
        segment: _Segment,
        vertex: mi.Interaction3f,
        scatters: mi.Bool,
        skipped: mi.Bool,
    ) -> mi.Bool:
        """Sample the BSDF or the phase function and continue the path.

        Returns the mask of lanes whose path has a vertex here (not those that pass a null surface).
        """
        si, collided, rng = segment.si, segment.collided, path.rng
        choice = rng.next_float32(path.active)
        sample = mi.Point2f(rng.next_float32(path.active), rng.next_float32(path.active))
        towards, value, scale, is_vertex, density = sample_bsdf(si, choice, sample, scatters)
        path.throughput = dr.select(scatters, path.throughput * value, path.throughput)
        path.eta = dr.select(scatters, path.eta * scale, path.eta)
        path.pdf = dr.select(is_vertex, density, path.pdf)
        path.pdf = dr.select(collided, dr.inv_four_pi, path.pdf)
        direction = mi.warp.square_to_uniform_sphere(sample)
        if not self.media.isotropic:
            collision = interaction(path.ray(segment.t), path.ray.d)
            direction, value, density = path.pointer.phase_function().sample(
                mi.PhaseFunctionContext(), collision, choice, sample, collided
            )
            path.throughput = dr.select(collided, path.throughput * value, path.throughput)
            path.pdf = dr.select(collided, density, path.pdf)
        next_direction = dr.select(skipped, path.ray.d, towards)
        next_ray = si.spawn_ray(next_direction)
        medium = medium_after(si, next_direction, path.pointer)
        path.pointer = dr.select(scatters, medium, path.pointer)
        path.ray.o = dr.select(collided, vertex.p, next_ray.o)
        path.ray.d = dr.select(collided, direction, next_ray.d)
        is_vertex |= collided
        path.last = dr.select(is_vertex, vertex, path.last)
        path.depth = dr.select(is_vertex, path.depth + 1, path.depth)
        path.crossings += 1
        path.active &= (collided | segment.surface) & (path.depth < self._max_depth)
        path.active &= path.crossings < MOST_CROSSINGS
        return is_vertex


def _phase_value(
    phase: mi.PhaseFunctionPtr,
    collision: mi.MediumInteraction3f,
    towards: mi.Vector3f,
    active: mi.Bool,
    value: mi.Spectrum,
    density: mi.Float,
) -> tuple[mi.Spectrum, mi.Float]:
    """Evaluate the phase function and its density ``towards`` a direction where ``active``.

    Elsewhere ``value`` and ``density`` are returned unchanged.
    """
    own, pdf = phase.eval_pdf(mi.PhaseFunctionContext(), collision, towards, active)
    return dr.select(active, own, value), dr.select(active, pdf, density)
