"""Derivatives along paths, computed from their end to their start.

The radiance from behind each segment is then known, as in path replay backpropagation (Vicini,
Speierer and Jakob 2021). Reverse mode adds derivatives to the parameters; forward mode adds up the
changes of the radiance along the paths.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.gradients.emitters import pull
from mitsuba_irrcache.gradients.paths import Segment, TracedPaths, Vertex
from mitsuba_irrcache.gradients.replay import CameraReplay, CameraSplats, RaySegments
from mitsuba_irrcache.gradients.tangent_fields import (
    AttachedParameters,
    MediumChanges,
    SceneChanges,
)


class PathDerivatives(TracedPaths):
    """Goes back along the paths that `trace` stored; how derivatives propagate, subclasses define.

    For each medium, methods take the sums for its derivatives, or the changes of its fields.
    """

    def _replay(
        self,
        march: CameraReplay,
        rays: RaySegments,
        ahead: mi.Spectrum,
        fields: CameraSplats | MediumChanges,
    ) -> None:
        """Propagate derivatives along ``rays`` in a medium, see `CameraReplay.replay`."""
        raise NotImplementedError

    def _carry(self, value: mi.Spectrum, weight: mi.Spectrum) -> None:
        """Propagate derivatives through the attached ``value`` of an emitter or BSDF, which
        contributes ``value`` times ``weight`` to the weighted radiance.
        """
        raise NotImplementedError

    def _go_back(
        self, media: Sequence[CameraSplats | MediumChanges], without_first: int | None
    ) -> None:
        """Propagate derivatives along all segments, and at all surfaces that paths hit.

        ``without_first`` is a medium that the first segments skip.
        """
        rest = mi.Spectrum(0)
        for number in range(len(self._segments) - 1, -1, -1):
            segment, vertex = self._segments[number], self._vertices[number + 1]
            self._at_vertex(vertex, rest, media)
            rest = rest + vertex.direct
            skipped = without_first if number == 0 else None
            self._along_segment(segment, rest, media, skipped)
            rest = rest + segment.gathered() + segment.emitted + segment.escaped
            dr.eval(rest)

    def _along_segment(
        self,
        segment: Segment,
        rest: mi.Spectrum,
        media: Sequence[CameraSplats | MediumChanges],
        skipped: int | None,
    ) -> None:
        """Propagate derivatives along a segment, given the weighted radiance ``rest`` that is
        reflected at its end.
        """
        behind = rest + segment.emitted + segment.escaped
        for number in range(len(self._media.marches)):
            if number == skipped:
                continue
            passed = segment.weight * segment.before[number]
            near, far, hit = segment.near[number], segment.far[number], segment.hit[number]
            ahead = segment.behind(number) + behind
            for marches, mask in segment.parts:
                march, own = marches[number], media[number]
                rays = RaySegments(segment.ray, near, far, passed, segment.offset, hit & mask)
                if march.irradiance is None:  # nothing is scattered, so that nothing collides
                    own = own.without_scattering()
                self._replay(march, rays, ahead, own)
        dr.eval()
        self._at_emitter(segment)

    def _at_emitter(self, segment: Segment) -> None:
        if self._emitters:
            with dr.resume_grad():
                value = segment.end.emitter(self._scene).eval(segment.end)
                self._carry(value, segment.emitter_weight)

    def _attenuated(
        self,
        ray: mi.Ray3f,
        spans: tuple[list[mi.Float], list[mi.Float], list[mi.Bool]],
        offset: mi.Float,
        radiance: mi.Spectrum,
        media: Sequence[CameraSplats | MediumChanges],
    ) -> None:
        """Propagate derivatives through the attenuation of weighted ``radiance`` from behind all
        media, along the ``spans`` of a ``ray`` in them. The first steps have the length ``offset``.
        """
        none = mi.Spectrum(dr.zeros(mi.Float, dr.width(offset)))
        for march, near, far, hit, own in zip(self._media.marches, *spans, media, strict=True):
            if own.sigma_t is not None:
                rays = RaySegments(ray, near, far, none, offset, hit)
                self._replay(march, rays, radiance + none, own.attenuation())
        dr.eval()

    def _at_vertex(
        self, vertex: Vertex, rest: mi.Spectrum, media: Sequence[CameraSplats | MediumChanges]
    ) -> None:
        """Propagate derivatives through the direct radiance of emitters, and through the BSDF.

        ``rest`` is the weighted radiance of all further segments.
        """
        contributes = vertex.active & (dr.max(dr.abs(vertex.direct)) > 0)
        spans = self._media.spans(vertex.shadow, vertex.length, contributes)
        offset = dr.ones(mi.Float, dr.width(vertex.length))
        self._attenuated(vertex.shadow, spans, offset, vertex.direct, media)
        if self._emitters:
            record = vertex.record
            sampled = vertex.active & (record.pdf > 0)
            with dr.resume_grad():
                value = self._scene.eval_emitter_direction(vertex.origin, record, sampled)
                self._carry(
                    value / dr.select(record.pdf > 0, record.pdf, 1),
                    dr.select(sampled, vertex.emitter_weight, 0),
                )
        if self._surfaces and vertex.surface is not None:
            self._at_surface(vertex, rest, contributes)

    def _at_surface(self, vertex: Vertex, rest: mi.Spectrum, contributes: mi.Bool) -> None:
        context, si = mi.BSDFContext(), vertex.surface

        def share(value: mi.Spectrum, factor: mi.Spectrum, active: mi.Bool) -> mi.Spectrum:
            return dr.select(active & (factor != 0), value / dr.select(factor != 0, factor, 1), 0)

        pairs = (
            (vertex.towards, share(vertex.direct, vertex.direct_scattering, contributes)),
            (vertex.next_direction, share(rest, vertex.scattering, vertex.active)),
        )
        for direction, weight in pairs:
            dr.eval(weight)
            with dr.resume_grad():
                self._carry(si.bsdf().eval(context, si, direction, vertex.active), weight)


class PathAdjoint(PathDerivatives):
    """Reverse mode: adds derivatives to sums, and to the gradients of emitters and BSDFs."""

    def add(self, splats: list[CameraSplats], without_first: int | None = None) -> None:
        """Add derivatives along the paths that `trace` stored to ``splats``.

        ``without_first`` is a medium that the first segments skip.
        """
        self._go_back(splats, without_first)
        if self._vertices[0] is not None:
            self._at_vertex(self._vertices[0], mi.Spectrum(0), splats)

    def _replay(
        self, march: CameraReplay, rays: RaySegments, ahead: mi.Spectrum, fields: CameraSplats
    ) -> None:
        march.replay(rays, ahead, mi.Spectrum(0), fields)

    def _carry(self, value: mi.Spectrum, weight: mi.Spectrum) -> None:
        pull(value, weight)


class PathTangent(PathDerivatives):
    """Forward mode: adds up the changes of the weighted radiance along each path."""

    _change: mi.Spectrum
    _attached: AttachedParameters

    def radiance(self, changes: SceneChanges) -> mi.Spectrum:
        """Return the changes of the weighted radiance of camera rays."""
        return self._sum(changes, lambda: self._go_back(changes.media, None))

    def alpha(self, changes: SceneChanges) -> mi.Float:
        """Return the changes of the alpha of camera rays.

        It is 1 minus the mean transmittance along rays that hit no surface.
        """
        first = self._segments[0]
        share = mi.Spectrum(1 / dr.size_v(mi.Spectrum))
        escaped = dr.select(first.end.is_valid(), 0, first.through * share)
        dr.eval(escaped)
        alpha = self._sum(changes, lambda: self._attenuated_along(first, escaped, changes.media))
        return -dr.sum(alpha)

    def incident(
        self, changes: SceneChanges, without_first: int | None = None
    ) -> list[tuple[mi.Vector3f, mi.Spectrum, mi.Spectrum]]:
        """Return the changes of what `contributions` returns."""
        start, first = self._vertices[0], self._segments[0]
        media, none = changes.media, mi.Spectrum(0)
        direct = self._sum(changes, lambda: self._at_vertex(start, none, media))
        total = self._sum(changes, lambda: self._go_back(media, without_first))
        emitted = self._sum(changes, lambda: self._emitted(first, media))
        return [(start.record.d, direct, none), (first.ray.d, emitted, total - emitted)]

    def _emitted(self, first: Segment, media: list[MediumChanges]) -> None:
        self._attenuated_along(first, first.emitted, media)
        self._at_emitter(first)

    def _attenuated_along(
        self, segment: Segment, radiance: mi.Spectrum, media: list[MediumChanges]
    ) -> None:
        spans = segment.near, segment.far, segment.hit
        self._attenuated(segment.ray, spans, segment.offset, radiance, media)

    def _sum(self, changes: SceneChanges, propagate: Callable[[], None]) -> mi.Spectrum:
        """Return the sum of the changes that ``propagate`` causes."""
        self._attached = changes.attached
        self._change = mi.Spectrum(dr.zeros(mi.Float, dr.width(self._segments[0].ray.d)))
        propagate()
        dr.eval(self._change)
        return self._change

    def _replay(
        self, march: CameraReplay, rays: RaySegments, ahead: mi.Spectrum, fields: MediumChanges
    ) -> None:
        readers = fields.readers(dr.width(rays.near))
        if not readers.is_empty:
            self._change = self._change + march.replay(rays, ahead, mi.Spectrum(0), readers).total()
            dr.eval(self._change)

    def _carry(self, value: mi.Spectrum, weight: mi.Spectrum) -> None:
        self._change = self._change + self._attached.change_of(value * weight)
