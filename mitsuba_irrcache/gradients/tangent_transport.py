"""Forward mode: the derivative of the fluence in the direction of given changes of the parameters.

It is the transpose of `transport`, stage by stage. Where the adjoint sums S - L times the
importance W over directions, a change of the extinction emits S - L times that change into each
direction, and the same solver scatters what is emitted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.gradients.scattering import Components, OrdinatePart, with_channels
from mitsuba_irrcache.gradients.transport import AdjointTransport
from mitsuba_irrcache.solvers.discrete_ordinates.moments import add_collided
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup, TrackTable


@dataclass
class VoxelTangents:
    """Changes of the means over the voxels, and of what emitters send; empty lists for none.

    Attributes:
        sigma_t: of the extinction, by channel.
        collided: of the scattering coefficient beyond what the extinction changes at the albedo of
            the voxel, by channel.
        emitted: of the emission coefficient, by channel.
        g: of the mean cosine of the phase function.
        lights: of the irradiance of each emitter of one direction in the voxels.
        unseen: likewise, for irradiance that camera rays do not read from the voxels.
        incoming: of the irradiance (n, 2, channels) that enters along the ordinates; None for none.
    """

    sigma_t: list[mi.Float] = field(default_factory=list)
    collided: list[mi.Float] = field(default_factory=list)
    emitted: list[mi.Float] = field(default_factory=list)
    g: float = 0.0
    lights: list[mi.Spectrum] = field(default_factory=list)
    unseen: list[mi.Spectrum] = field(default_factory=list)
    incoming: np.ndarray | None = None


def propagated(
    transport: AdjointTransport,
    first: list[list[Components]],
    unseen: list[list[Components]] | None = None,
) -> list[Components]:
    """Return what the importance of camera rays that collide in a voxel is multiplied by.

    ``first`` are, by channel, the components of the change of the fluence of collisions before
    further scattering between voxels, for each part of the radiance; ``unseen`` are those of
    changes that camera rays do not read from the voxels. The results are those of
    `FluenceTangent.for_camera`.
    """
    # docs/primer, eq. (8.18)
    found: list = [None] * transport.channels
    for level, own in transport.levels:
        scattered = [first[c] for c in own]
        if unseen is not None:
            scattered = [_sum_of_parts(first[c], unseen[c]) for c in own]
        travelled = _scattered_on(transport, level, scattered)
        for c, components in zip(own, travelled, strict=True):
            found[c] = _weighted(transport, c, first[c], components)
    dr.eval(found)
    return found


def _weighted(
    transport: AdjointTransport, channel: int, parts: list[Components], travelled: Components
) -> Components:
    scattering = transport.scattering
    smooth = [a + b for a, b in zip(parts[0], travelled, strict=True)]
    for source, own in zip(scattering.sources, parts[1:], strict=True):
        if not source.sharp:  # its higher moments are part of those that camera rays read
            smooth[1:] = [a + b for a, b in zip(smooth[1:], own[1:], strict=True)]
    factors = scattering.product_factors()
    values = [f * v for f, v in zip(factors, smooth, strict=True)]
    values += [own[0] * dr.inv_four_pi for own in parts[1:]]
    return [value * transport.albedo[channel] for value in values]


def _scattered_on(
    transport: AdjointTransport, level: MultigridLevel, parts: list[list[Components]]
) -> list[Components]:
    """Return what further scattering between voxels adds to the first change, by channel."""
    scattering = transport.scattering
    if transport.single:
        zero = dr.zeros(mi.Float, transport.grid.voxel_count)
        return [[zero] * scattering.count for _ in parts]
    totals = [[sum(each) for each in zip(*own, strict=True)] for own in parts]
    first = scattering.joined(totals)
    dr.eval(first)
    table = level.tracks.table(*transport.ordinates.scattering().without_incoming())
    once = level.sweep(first, table)[1]
    again = level.sweep(once, level.tracks.table(*transport.solving))[1]
    phi = once + level.solve(again, transport.solving)
    dr.eval(phi)
    return scattering.separated(phi, len(parts))


class FluenceTangent:
    """The derivative of the fluence of ``transport`` along ``tangents`` of its voxels.

    ``phi`` is the fluence of collisions and ``extinction`` the mean over the voxels, both by
    channel.
    """

    def __init__(
        self,
        transport: AdjointTransport,
        phi: list[Components],
        extinction: list[mi.Float],
        tangents: VoxelTangents,
    ) -> None:
        self._transport, self._phi, self._tangents = transport, phi, tangents
        self._extinction = extinction

    def for_camera(self) -> list[Components]:
        """Return what the importance of camera rays that collide in a voxel is multiplied by.

        These are, for each channel, the components of the change of the radiance that is scattered
        into the rays: the transpose of the adjoint fluence of camera rays, without the volume and
        the extinction of the voxels.
        """
        transport = self._transport
        found: list = [None] * transport.channels
        for level, own in transport.levels:
            for channel in own:
                found[channel] = self._first(level, channel)
        unseen = None
        if self._tangents.unseen:
            unseen = [
                self._of_lights(self._tangents.unseen, channel)
                for channel in range(transport.channels)
            ]
        return propagated(transport, found, unseen)

    def _of_lights(self, changes: list[mi.Spectrum], channel: int) -> list[Components]:
        """Return the components of ``changes`` of the irradiance of emitters of one direction, for
        each part of the radiance.
        """
        lights, scattering = self._transport.lights, self._transport.scattering
        parts = [self._zeros() for _ in self._transport.parts]
        for light, change in enumerate(changes):
            own = scattering.from_direction(change[channel], lights.towards(light))
            parts[lights.parts[light]] = _sum(parts[lights.parts[light]], own)
        dr.eval(parts)
        return parts

    def _first(self, level: MultigridLevel, channel: int) -> list[Components]:
        """Return the change before further scattering, for each part of the radiance.

        Its components are those of collisions.
        """
        # docs/primer, eq. (8.16)
        transport, tangents = self._transport, self._tangents
        parts = []
        for number, part in enumerate(transport.parts):
            found = self._zeros()
            if len(part.rows):
                if tangents.sigma_t:
                    found = _sum(found, self._of_extinction(level, number, part, channel))
                if not number:
                    found = _sum(found, self._of_sources(level, part, channel))
                if tangents.incoming is not None:
                    found = _sum(found, self._entering(level, part, channel))
            parts.append(found)
        parts = _sum_of_parts(parts, self._of_lights(tangents.lights, channel))
        dr.eval(parts)
        return parts

    def _zeros(self) -> Components:
        zero = dr.zeros(mi.Float, self._transport.grid.voxel_count)
        return [zero] * self._transport.scattering.count

    def _of_extinction(
        self, level: MultigridLevel, number: int, part: OrdinatePart, channel: int
    ) -> Components:
        """Return the collisions of what a change of the extinction adds along all ordinates."""
        transport, scattering = self._transport, self._transport.scattering
        directions, incoming, weights, offsets = part.before(transport.lights.even, [channel])
        source = self._zeros()
        if not len(directions):
            return source
        if not (number or transport.single):
            scale = transport.albedo[channel] * dr.inv_four_pi
            source = scattering.source(level, scattering.scattered(self._phi[channel], scale))
        dr.eval(source)
        tracks = level.tracks
        table = tracks.table(directions, incoming, weights, offsets)
        plain = tracks.table(directions, 0 * incoming, np.ones_like(weights), offsets)
        radiance = tracks.sweep_separately(table, lambda g: scattering.along(level, source, g))
        change, groups = self._tangents.sigma_t[channel], []

        def emission(_: PairGroup) -> mi.Float:
            _, group, swept = next(radiance)
            groups.append(group)
            # The radiance includes the solid angle.
            place = dr.arange(mi.UInt32, dr.width(swept) // 4)
            excess = dr.gather(mi.Float, swept, place * 4 + 1)
            voxels = dr.opaque(mi.UInt32, transport.grid.voxel_count)
            result = -excess * dr.gather(mi.Float, change, place % voxels)
            dr.eval(result)
            return result

        return self._collided(level, plain, emission, "decaying", lambda _: groups[-1])

    def _of_sources(self, level: MultigridLevel, part: OrdinatePart, channel: int) -> Components:
        """Return the collisions of changes of what is scattered and emitted in the voxels."""
        transport, scattering = self._transport, self._transport.scattering
        tangents, source, phi = self._tangents, None, self._phi[channel]
        if tangents.collided and not transport.single:
            scale = tangents.collided[channel] * dr.inv_four_pi
            source = scattering.scattered(phi, scale)
        if tangents.g and not transport.single:
            scale = self._extinction[channel] * transport.albedo[channel]
            own = scattering.scattered_by(phi, scale * tangents.g, transport.neighbours.moments)
            source = own if source is None else _sum(source, own)
        if source is not None:
            source = self._antidiffused(level, source)
        if tangents.emitted:
            own = scattering.isotropic(tangents.emitted[channel])
            source = own if source is None else _sum(source, own)
        if source is None:
            return self._zeros()
        dr.eval(source)
        directions, incoming, weights, offsets = part.with_channels([channel])
        table = level.tracks.table(directions, 0 * incoming, weights, offsets)

        def along(group: PairGroup) -> mi.Float:
            return scattering.along(level, source, group)

        return self._collided(level, table, along, "uniform", lambda group: group)

    def _antidiffused(self, level: MultigridLevel, emitted: Components) -> Components:
        """Apply `scattering.source` to radiance per length instead of per optical depth."""
        sigma_t = level.sigma_t
        sources = [dr.select(sigma_t > 0, values / sigma_t, 0) for values in emitted]
        found = self._transport.scattering.source(level, sources)
        return [
            dr.select(sigma_t > 0, sigma_t * source, values)
            for source, values in zip(found, emitted, strict=True)
        ]

    def _collided(
        self,
        level: MultigridLevel,
        table: TrackTable,
        source: Callable[[PairGroup], mi.Float],
        emission: str,
        weighted: Callable[[PairGroup], PairGroup],
    ) -> Components:
        """Sweep radiance that voxels emit, and return the components of its collisions.

        ``weighted`` returns the group of pairs with the ordinate weights that belongs to a group of
        the ``table``.
        """
        transport = self._transport
        voxels = transport.grid.voxel_count
        moments = transport.scattering.moments
        collided = [dr.opaque(mi.Float, 0, voxels) for _ in range(moments.count)]
        received = [dr.opaque(mi.Float, 0, voxels) for _ in range(moments.count)]
        lost, depth = (dr.opaque(mi.Float, 0, voxels) for _ in range(2))
        slots = dr.arange(mi.UInt32, voxels)
        for _, group, copies in level.tracks.sweep_separately(table, source, emission=emission):
            sums = received, collided, lost, depth
            received, collided, lost, depth = add_collided(
                moments, sums, copies, weighted(group), slots, voxels
            )
            dr.eval(received, collided, lost, depth)
        # Weighting by optical depth conserves energy; ordinates of narrow sources have no weight.
        mean = 4 * dr.pi * lost / dr.select(depth > 0, depth, 1)
        collided[0] = level.collided_irradiance(depth, mean, collided[0])
        dr.eval(collided)
        return collided

    def _entering(self, level: MultigridLevel, part: OrdinatePart, channel: int) -> Components:
        """Return the collisions of the change of the radiance that enters along a part."""
        scattering = self._transport.scattering
        incoming = self._tangents.incoming[part.rows] * part.mask[..., None]
        ordinates = part.ordinates._replace(incoming=incoming)
        table = level.tracks.table(*with_channels(ordinates, [channel]))
        single = scattering.new_level(
            level.sigma_t, [self._transport.albedo[channel]], level.tracks
        )
        (found,) = scattering.separated(single.sweep(None, table)[1], 1)
        return found


def _sum(first: Components, second: Components) -> Components:
    return [a + b for a, b in zip(first, second, strict=True)]


def _sum_of_parts(first: list[Components], second: list[Components]) -> list[Components]:
    return [_sum(a, b) for a, b in zip(first, second, strict=True)]
