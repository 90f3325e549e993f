"""Paths through media with known fluence and between surfaces, of which all segments are stored.

A path starts at the camera, or in a voxel. It continues from surface to surface; on each segment
the media add the radiance that they scatter, which their fluence determines, and attenuate what is
behind. `path_derivatives` has the derivatives along the paths.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.gradients.replay import CameraReplay, RaySegments
from mitsuba_irrcache.transport.path import (
    MOST_CROSSINGS,
    Media,
    distance_to,
    is_solid,
    position_on,
    power_heuristic,
    visibility,
    with_valid_direction,
)

#: Number of surfaces of a path, at most, and after which Russian roulette ends paths; smallest
#: probability to continue.
MOST_SURFACES, ROULETTE_AFTER, LEAST_CHANCE = 64, 4, 0.05
#: Density of isotropic directions.
UNIFORM = 1 / (4 * dr.pi)


@dataclass
class Start:
    """Starts of paths.

    Attributes:
        ray: their first rays.
        adjoint: derivative of the objective with respect to the radiance along the rays.
        alpha: derivative with respect to what the rays see if they leave the scene: -1 times that
            with respect to alpha; None without.
        adjoint_of_irradiance: derivative with respect to the irradiance of emitters at the origin
            of the rays, which is scattered there, as a function of the direction to the emitter;
            None for rays of a camera.
        rng: random number generator.
        adjoint_of_emitters: derivative with respect to the radiance of emitters that the rays hit;
            None if it is ``adjoint``.
        medium: the medium that the sensor names; rays of a camera do not pass any other medium in
            which they start, as in the image.
    """

    ray: mi.Ray3f
    adjoint: mi.Spectrum
    alpha: mi.Float | None
    adjoint_of_irradiance: Callable[[mi.Vector3f], mi.Spectrum] | None
    rng: mi.PCG32
    adjoint_of_emitters: mi.Spectrum | None = None
    medium: mi.Medium | None = None


@dataclass
class Segment:
    """A segment of paths: what it contributes, and what going back along it needs.

    Attributes:
        ray: the rays; ``distance`` to their ends.
        offset: length of the first step in each medium, in steps.
        weight: throughput at the start, times the derivative of the objective.
        near, far, hit: for each medium, where the rays are in it.
        scattered, before: for each medium, the radiance that it scatters into the rays, and the
            transmittance of what is in front of it.
        through: transmittance of all media.
        parts: marches of the media, each with the paths for which it is used.
        end: the surface at the end.
        emitted: weighted radiance of emitters that the ray hits; ``emitter_weight`` its weight.
    """

    ray: mi.Ray3f
    distance: mi.Float
    offset: mi.Float
    weight: mi.Spectrum
    near: list[mi.Float]
    far: list[mi.Float]
    hit: list[mi.Bool]
    scattered: list[mi.Spectrum]
    before: list[mi.Spectrum]
    through: mi.Spectrum
    parts: list[tuple[list[CameraReplay], mi.Bool]]
    end: mi.SurfaceInteraction3f
    emitted: mi.Spectrum
    emitter_weight: mi.Spectrum
    #: contribution to alpha
    escaped: mi.Spectrum

    def gathered(self) -> mi.Spectrum:
        """Return the weighted radiance that the media scatter into the ray."""
        products = (b * s for b, s in zip(self.before, self.scattered, strict=True))
        return self.weight * sum(products, mi.Spectrum(0))

    def behind(self, number: int) -> mi.Spectrum:
        """Return the weighted radiance that a medium and all behind it scatter into the ray."""
        total = mi.Spectrum(0)
        for near, before, scattered in zip(self.near, self.before, self.scattered, strict=True):
            later = near >= self.near[number]
            total += dr.select(later, before * scattered, 0)
        return self.weight * total


@dataclass
class Vertex:
    """A surface at the end of a segment, or the start in a voxel (without ``incoming``).

    Attributes:
        shadow: ray to the sampled point of an emitter; ``length`` is its length.
        direct: weighted radiance of the emitter that the vertex scatters along the path.
        record, emitter_weight: the sampled direction, and the weight of the radiance of the
            emitter.
        surface: the surface; None for a voxel.
        next_direction, scattering: the direction of the next segment, and the BSDF there.
        active: paths that have this vertex.
    """

    shadow: mi.Ray3f
    length: mi.Float
    direct: mi.Spectrum
    record: mi.DirectionSample3f
    emitter_weight: mi.Spectrum
    origin: mi.Interaction3f
    surface: mi.SurfaceInteraction3f | None
    towards: mi.Vector3f
    direct_scattering: mi.Spectrum
    active: mi.Bool
    next_direction: mi.Vector3f | None = None
    scattering: mi.Spectrum | None = None


class MarchedMedia:
    """Media with known fluence that lie apart, or side by side."""

    def __init__(self, marches: Sequence[CameraReplay]) -> None:
        self.marches = list(marches)

    def indirect(self) -> MarchedMedia:
        """Return the media for rays from voxels and diffuse surfaces, into which forward peaks
        scatter no radiance of narrow sources, because that counts as unscattered (`media/delta_m`).
        """
        return MarchedMedia([march.indirect() for march in self.marches])

    def without_visible(self) -> MarchedMedia:
        """Return the media for rays that do not see emitters, see `source_weights`."""
        return MarchedMedia([march.without_visible() for march in self.marches])

    def without_scattering(self) -> MarchedMedia:
        """Return the media as they attenuate radiance, without what they scatter."""
        return MarchedMedia([march.without_scattering() for march in self.marches])

    def spans(self, ray: mi.Ray3f, distance: mi.Float, active: mi.Bool) -> tuple[list, list, list]:
        """Return where rays of a length are in each medium, and whether they are."""
        nears, fars, hits = [], [], []
        for march in self.marches:
            hit, near, far = march.medium.intersect(ray)
            near, far = dr.maximum(near, 0), dr.minimum(far, distance)
            hit &= active & (near < far)
            nears.append(dr.select(hit, near, dr.inf))
            fars.append(dr.select(hit, far, dr.inf))
            hits.append(hit)
        return nears, fars, hits

    def unnamed(self, ray: mi.Ray3f, medium: mi.Medium | None) -> list[mi.Bool]:
        """Return, for each medium but the given one, whether rays start in it."""
        named = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
        found = []
        for march in self.marches:
            # The grid may cover only a part of the medium.
            hit, entry, leave = march.medium.boundary.intersect(ray)
            within = hit & (entry < -1e-5 * (leave - entry)) & (leave > 0)
            found.append(within & (march.medium.pointer != named))
        return found

    @property
    def are_isotropic(self) -> bool:
        """Whether all of them scatter isotropically."""
        return all(march.medium.phase.is_isotropic for march in self.marches)

    @staticmethod
    def march(
        ray: mi.Ray3f,
        spans: tuple[list, list, list],
        offset: mi.Float,
        parts: list[tuple[list[CameraReplay], mi.Bool]],
    ) -> tuple[list[mi.Spectrum], list[mi.Spectrum], mi.Spectrum]:
        """Return ``scattered``, ``before`` and ``through`` of `Segment`."""
        one = mi.Spectrum(dr.ones(mi.Float, dr.width(offset)))
        scattered, transmittances = [], []
        for number, (near, far, hit) in enumerate(zip(*spans, strict=True)):
            total, passed = 0 * one, mi.Spectrum(one)
            for marches, mask in parts:
                rays = RaySegments(ray, near, far, one, offset, hit & mask)
                found, transmittance = marches[number].radiance(rays)
                total, passed = total + found, passed * transmittance
                dr.eval(total, passed)
            scattered.append(total)
            transmittances.append(passed)
        nears = spans[0]
        before, through = [], mi.Spectrum(one)
        for number, near in enumerate(nears):
            passed = mi.Spectrum(one)
            for other, (start, factor) in enumerate(zip(nears, transmittances, strict=True)):
                if other != number:
                    passed *= dr.select(start < near, factor, 1)
            before.append(passed)
            through *= transmittances[number]
        dr.eval(before, through)
        return scattered, before, through

    def transmittance(self, ray: mi.Ray3f, distance: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """Return the transmittance of all media up to a distance along rays."""
        result = mi.Spectrum(1)
        for march, near, far, hit in zip(
            self.marches, *self.spans(ray, distance, active), strict=True
        ):
            result *= march.transmittance(ray, near, far, hit)
        return result


class TracedPaths:
    """Traces paths in ``scene`` between surfaces and through ``media``.

    ``emitters`` and ``surfaces`` state whether derivatives with respect to the radiance of emitters
    and to BSDFs are added to the gradients of their parameters; ``hide_emitters`` is the
    integrator's property; ``events`` is the number of scattering events along a path at most, None
    without a limit. What passes null interfaces and thin panes straight is no event.
    """

    def __init__(
        self,
        scene: mi.Scene,
        media: MarchedMedia,
        emitters: bool = False,
        surfaces: bool = False,
        hide_emitters: bool = False,
        events: int | None = None,
    ) -> None:
        self._scene, self._media, self._hides = scene, media, hide_emitters
        self._emitters, self._surfaces, self._events = emitters, surfaces, events
        self._attenuating = None if events is None else media.without_scattering()
        #: the media for rays from voxels and diffuse surfaces
        self._indirect = media.indirect()
        #: the media for rays of the camera that no surface has deflected
        self._straight = media.without_visible() if hide_emitters else media
        self._segments: list[Segment] = []
        self._vertices: list[Vertex | None] = []

    # Forwards

    def trace(self, start: Start) -> mi.Spectrum:
        """Trace paths, store them, and return the weighted radiance along them."""
        self._segments, self._vertices = [], []
        ray, weight, rng = start.ray, mi.Spectrum(start.adjoint), start.rng
        active, origin, total = mi.Bool(True), dr.zeros(mi.Interaction3f), mi.Spectrum(0)
        density, vertex = mi.Float(0), None
        is_from_camera = start.adjoint_of_irradiance is None
        # whether the camera sees what the path hits, straight or through null interfaces
        is_seen = mi.Bool(is_from_camera)
        # whether it does so also by reflection and refraction; number of scattering events
        is_followed, count = mi.Bool(is_from_camera), mi.UInt32(0)
        if not is_from_camera:
            origin = dr.zeros(mi.Interaction3f, dr.width(ray.d))
            origin.p, density = ray.o, mi.Float(UNIFORM)
            vertex, rng = self._start_in_voxel(origin, start.adjoint_of_irradiance, rng)
            total += vertex.direct
        self._vertices.append(vertex)
        for number in range(MOST_SURFACES):
            offset = 1 - rng.next_float32()
            arrival = origin, density, is_seen, is_followed, count
            alpha = start.alpha if number == 0 else None
            of_emitters = start.adjoint_of_emitters if number == 0 else None
            weights = weight, weight if of_emitters is None else of_emitters
            parts = self._parts(number, is_from_camera, (is_seen, is_followed), count)
            skipped, ends = [], mi.Bool(False)
            if number == 0 and is_from_camera:
                skipped = self._media.unnamed(ray, start.medium)
                if start.medium is not None:
                    ends = ~self._scene.ray_test(ray)
            of_segment = offset, active, alpha, parts, skipped, ends
            segment = self._segment(ray, weights, arrival[:3], *of_segment)
            self._segments.append(segment)
            total += segment.gathered() + segment.emitted + segment.escaped
            active = active & segment.end.is_valid()
            vertex, ray, weight, arrival, active, rng = self._scatter(
                segment, number, arrival, active, rng
            )
            origin, density, is_seen, is_followed, count = arrival
            self._vertices.append(vertex)
            total += vertex.direct
            dr.eval(total, ray, weight, arrival, active, rng)
            if not dr.any(active):
                break
        return total

    def _parts(
        self,
        number: int,
        is_from_camera: bool,
        visible: tuple[mi.Bool, mi.Bool],
        count: mi.UInt32,
    ) -> list[tuple[list[CameraReplay], mi.Bool]]:
        """Return the marches of a segment, each with the paths for which it is used.

        ``visible`` states which paths the camera sees straight, and which also by reflection and
        refraction.

        Forward peaks scatter radiance of narrow sources into paths that the camera follows by
        reflection and refraction. Media scatter into paths of less than the largest number of
        events.
        """
        if self._events == 0:
            return [(self._attenuating.marches, mi.Bool(True))]
        scatters = mi.Bool(True) if self._events is None else count < self._events
        if self._media.are_isotropic or not is_from_camera:
            parts = [(self._indirect.marches, scatters)]
        elif number == 0:
            parts = [(self._straight.marches, scatters)]
        else:
            is_seen, is_followed = visible
            parts = [
                (self._media.marches, scatters & is_followed),
                (self._indirect.marches, scatters & ~is_followed),
            ]
            if self._hides:
                parts[0] = self._media.marches, scatters & is_followed & ~is_seen
                parts.insert(0, (self._straight.marches, scatters & is_seen))
        if self._events is not None and number > 0:
            parts.append((self._attenuating.marches, ~scatters))
        return parts

    def _start_in_voxel(
        self,
        origin: mi.Interaction3f,
        adjoint: Callable[[mi.Vector3f], mi.Spectrum],
        rng: mi.PCG32,
    ) -> tuple[Vertex, mi.PCG32]:
        sample = mi.Point2f(rng.next_float32(), rng.next_float32())
        record, emitter, shadow, visible = self._emitter(origin, sample, mi.Bool(True))
        other = dr.select(record.delta, 0, UNIFORM)
        share = power_heuristic_or_one(record, other)
        scale = adjoint(record.d) * (visible * share)
        vertex = Vertex(
            shadow, distance_to(record), scale * emitter, record, scale, origin, None, record.d,
            mi.Spectrum(1), mi.Bool(True),
        )  # fmt: skip
        dr.eval(vertex.direct, vertex.emitter_weight, vertex.shadow, rng)
        return vertex, rng

    def _emitter(
        self, origin: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum, mi.Ray3f, mi.Spectrum]:
        """Sample an emitter: the record, radiance over density, shadow ray and transmittance."""
        record, emitter = self._scene.sample_emitter_direction(origin, sample, False, active)
        record = with_valid_direction(record)
        active = active & (record.pdf > 0)
        emitter = dr.select(active, emitter, 0)
        if not self._emitters:  # the derivative with respect to a radiance of 0 is not 0
            active = active & (dr.max(dr.abs(emitter)) > 0)
        shadow = mi.Ray3f(origin.spawn_ray_to(record.p))
        shadow.d = record.d
        shadow.maxt = dr.largest(mi.Float)
        none, rng = dr.zeros(mi.MediumPtr), mi.PCG32()
        target = position_on(record, origin)
        passed, _ = visibility(
            self._scene, Media([]), origin, target, none, rng, active, exact=True
        )
        visible = active & (dr.max(passed) > 0)
        through = self._media.transmittance(shadow, distance_to(record), visible)
        return record, emitter, shadow, dr.select(visible, passed * through, 0)

    def _segment(
        self,
        ray: mi.Ray3f,
        weights: tuple[mi.Spectrum, mi.Spectrum],
        arrival: tuple,
        offset: mi.Float,
        active: mi.Bool,
        alpha: mi.Float | None,
        parts: list[tuple[list[CameraReplay], mi.Bool]],
        skipped: list[mi.Bool],
        ends: mi.Bool,
    ) -> Segment:
        """Follow rays to the next surface.

        ``weights`` are those of scattered radiance and of the radiance of emitters; ``skipped``
        states for each medium, if there are any, which rays do not pass it; ``ends`` which rays end
        at the far plane, behind which nothing is visible to a sensor in a medium.
        """
        (weight, of_emitters), (origin, density, is_seen) = weights, arrival
        hides = is_seen if self._hides else mi.Bool(False)
        end, distance = next_solid(self._scene, ray, active, hides)
        distance = dr.select(ends, ray.maxt, distance)
        nears, fars, hits = self._media.spans(ray, distance, active)
        for number, mask in enumerate(skipped):
            hits[number] &= ~mask
            nears[number] = dr.select(mask, dr.inf, nears[number])
            fars[number] = dr.select(mask, dr.inf, fars[number])
        spans = nears, fars, hits
        dr.eval(end, distance, spans)
        scattered, before, through = self._media.march(ray, spans, offset, parts)
        emits = active & ~ends
        emitter = end.emitter(self._scene, emits)
        record = mi.DirectionSample3f(self._scene, end, origin)
        other = self._scene.pdf_emitter_direction(origin, record, active & ~is_seen)
        share = dr.select(density > 0, power_heuristic(density, other), 1)
        share = dr.select(hides, 0, share)
        emitter_weight = dr.select(emits, of_emitters * through * share, 0)
        emitted = emitter_weight * emitter.eval(end, emits)
        escaped = mi.Spectrum(0)
        if alpha is not None:
            away = active & ~end.is_valid()
            escaped = dr.select(away, through * (alpha / dr.size_v(mi.Spectrum)), 0)
        dr.eval(emitted, emitter_weight, escaped)
        return Segment(
            ray, distance, offset, weight, *spans, scattered, before, through, parts, end, emitted,
            emitter_weight, escaped,
        )  # fmt: skip

    def _scatter(
        self, segment: Segment, number: int, arrival: tuple, active: mi.Bool, rng: mi.PCG32
    ) -> tuple[Vertex, mi.Ray3f, mi.Spectrum, tuple, mi.Bool, mi.PCG32]:
        """Scatter paths at the end of a segment.

        ``arrival`` is the position where the path last chose a direction, its density, whether the
        camera sees what it hits straight, or by reflection and refraction, and the number of
        scattering events. Returns the vertex, and ray, weight and ``arrival`` of the next segment.
        """
        si, bsdf = segment.end, segment.end.bsdf()
        arriving = segment.weight * segment.through
        context = mi.BSDFContext()
        sample = mi.Point2f(rng.next_float32(), rng.next_float32())
        *_, is_followed, count = arrival
        may_scatter = active if self._events is None else active & (count < self._events)
        record, emitter, shadow, visible = self._emitter(si, sample, may_scatter)
        towards = si.to_local(record.d)
        value, other = bsdf.eval_pdf(context, si, towards, active)
        share = power_heuristic_or_one(record, dr.select(record.delta, 0, other))
        scale = dr.select(may_scatter, arriving * visible * share, 0)
        choice, sample = (
            rng.next_float32(),
            mi.Point2f(rng.next_float32(), rng.next_float32()),
        )
        found, factor = bsdf.sample(context, si, choice, sample, active)
        weight = arriving * factor
        # Emitters were sampled through null interfaces from where the path chose its direction.
        is_straight = mi.has_flag(found.sampled_type, mi.BSDFFlags.Null)
        density = dr.select(mi.has_flag(found.sampled_type, mi.BSDFFlags.Delta), 0, found.pdf)
        density = dr.select(is_straight, arrival[1], density)
        origin = dr.select(is_straight, arrival[0], mi.Interaction3f(si))
        is_seen = is_straight & arrival[2]
        is_followed &= ~mi.has_flag(found.sampled_type, mi.BSDFFlags.Diffuse)
        may_go_on = active & (is_straight | may_scatter)
        count = dr.select(is_straight, count, count + 1)
        # A path that ends here has no derivative with respect to what the BSDF scatters.
        scattering = dr.select(may_go_on, factor * found.pdf, 0)
        active = may_go_on & (dr.max(dr.abs(weight)) > 0)
        chance = mi.Float(1)
        if number >= ROULETTE_AFTER:
            # Relative to the start of the path, whose weight is a derivative.
            first = dr.max(dr.abs(self._segments[0].weight))
            ratio = dr.max(dr.abs(weight)) / dr.select(first > 0, first, 1)
            chance = dr.clip(ratio, LEAST_CHANCE, 0.95)
        goes_on = rng.next_float32() < chance
        vertex = Vertex(
            shadow, distance_to(record), scale * emitter * value, record, scale * value,
            mi.Interaction3f(si), si, towards, value, active, found.wo, scattering,
        )  # fmt: skip
        active = active & goes_on
        weight = dr.select(active, weight / chance, 0)
        ray = mi.Ray3f(si.spawn_ray(si.to_world(found.wo)))
        dr.eval(vertex.direct, vertex.emitter_weight, vertex.shadow, vertex.scattering)
        return vertex, ray, weight, (origin, density, is_seen, is_followed, count), active, rng

    def contributions(self) -> list[tuple[mi.Vector3f, mi.Spectrum, mi.Spectrum]]:
        """Return the weighted radiance that is incident at starts in voxels: directions, and what
        comes from there straight from emitters and scattered.
        """
        (vertex, *vertices), (first, *segments) = self._vertices, self._segments
        rest = first.gathered() + first.escaped
        rest += sum((s.gathered() + s.emitted for s in segments), mi.Spectrum(0))
        rest += sum((v.direct for v in vertices), mi.Spectrum(0))
        none = mi.Spectrum(0)
        return [(vertex.record.d, vertex.direct, none), (first.ray.d, first.emitted, rest)]

    def largest(self) -> float:
        """Return an upper bound of the weighted radiance that any part of a path has ahead."""
        total = mi.Spectrum(0)
        for segment in self._segments:
            total += dr.abs(segment.gathered()) + dr.abs(segment.emitted) + dr.abs(segment.weight)
        for vertex in self._vertices:
            total += 0 if vertex is None else dr.abs(vertex.direct)
        return float(dr.max(dr.max(total))[0])


def power_heuristic_or_one(record: mi.DirectionSample3f, other: mi.Float) -> mi.Float:
    """Return the weight of a sample of an emitter; 1 for emitters that nothing else can hit."""
    return dr.select(record.delta, 1, power_heuristic(record.pdf, other))


@symbolic
def next_solid(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, hides_emitters: mi.Bool):
    """Return the first surface along rays that is more than the boundary of a medium, and the
    distance to it (infinite if there is none). Rays pass emitters where these are hidden.
    """
    si, ahead, active = dr.zeros(mi.SurfaceInteraction3f), mi.Ray3f(ray), mi.Bool(active)
    found, crossings = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d)), mi.UInt32(0)
    found.wi = -ray.d
    found.t = dr.inf
    while dr.hint(active, label="next surface"):
        si = scene.ray_intersect(ahead, active)
        solid = active & si.is_valid() & is_solid(si)
        solid &= ~(hides_emitters & (si.shape.emitter() != None))  # noqa: E711
        found = dr.select(solid, si, found)
        ahead = si.spawn_ray(ahead.d)
        crossings += 1
        active &= si.is_valid() & ~solid & (crossings < MOST_CROSSINGS)
    distance = dr.select(found.is_valid(), dr.dot(found.p - ray.o, ray.d), dr.inf)
    return found, distance
