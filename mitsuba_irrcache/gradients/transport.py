"""Adjoint transport: derivatives through the irradiance that camera rays read.

Radiative transfer is its own adjoint under reversal of directions. So the adjoint fluence Phi*
obeys the same equation as the fluence, with the adjoint fluence of camera rays (the derivative of
the objective with respect to the irradiance) as its source, and the same solver solves it. The
derivative with respect to the extinction is the integral over directions of the radiance that it
adds by scattering and removes, S - L, times the adjoint radiance W of the opposite direction.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.gradients.lights import LightsOfOneDirection
from mitsuba_irrcache.gradients.parameters import EMISSION, MEAN_COSINE, SIGMA_T
from mitsuba_irrcache.gradients.phase_function import NeighbouringPhases
from mitsuba_irrcache.gradients.scattering import Components, scattering_of, with_channels
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import (
    collision_albedo,
    extinction_grid,
    resampled,
    track_extinction,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks


class Derivatives:
    """Derivatives of the objective with respect to means over the voxels, per volume.

    Each attribute is a list over the channels of the radiance.

    Attributes:
        sigma_t: with respect to the extinction, at the albedo of the voxel.
        collided: with respect to the scattering coefficient, Phi Phi* / (4 pi).
        direct: for each part of the radiance (see `scattering`), the components of the derivative
            with respect to the radiance that arrives from emitters.
        emitted: with respect to the emission, through scattering.
        g: with respect to the mean cosine of the phase function.
    """

    def __init__(
        self,
        sigma_t: list,
        collided: list,
        direct: list[list[Components]],
        emitted: list,
        g: Sequence = (),
    ) -> None:
        self.sigma_t, self.collided = sigma_t, collided
        self.direct, self.emitted, self.g = direct, emitted, g


@dataclass(frozen=True)
class TransportSettings:
    """How the transport equation and its adjoint are discretised.

    Attributes:
        seed: determines the ordinates.
        pairs: number of pairs of opposite ordinates.
        single: whether radiance is scattered once only.
        grey: whether the medium and the derivatives have a single channel. If all emitters are of
            one colour, too, a single channel is computed for all.
        has_dense_boundary: as in `extinction_grid`.
    """

    seed: tuple[int, int]
    pairs: int
    single: bool
    grey: bool = False
    has_dense_boundary: bool = False


class AdjointTransport:
    """The transport equation in all voxels of ``grid``, and its adjoint.

    ``wanted`` are the roles of the derivatives to be computed; those of `SIGMA_T`, `EMISSION` and
    `MEAN_COSINE` are computed only on request.

    Attributes:
        channels: number of channels that are computed.
        illumination: the distant emitters.
        colour: factor of the radiance of each channel, if one is computed for all; otherwise 1.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        grid: Grid,
        wanted: Container[str],
        settings: TransportSettings,
    ) -> None:
        self.grid, self._medium, self.single, self._wanted = grid, medium, settings.single, wanted
        self.scattering = scattering_of(scene, medium)
        #: for derivatives with respect to the mean cosine, if they are wanted
        self.neighbours = NeighbouringPhases(medium.phase) if MEAN_COSINE in wanted else None
        colours = 1 if mi.is_monochromatic else 3
        pairs, rng = settings.pairs, np.random.default_rng((*settings.seed, 0x67726164))
        self.illumination = illumination = DistantIllumination(scene)
        if settings.grey:
            (self.ordinates,), self.colour = illumination.factored_ordinates(1, pairs, colours, rng)
        else:
            (self.ordinates,) = illumination.ordinates(1, pairs, rng)
            self.colour = np.ones(colours)
        self.parts = self.scattering.parts(self.ordinates)
        self.channels = self.ordinates.incoming.shape[-1] if settings.grey else colours
        solving_pairs = min(pairs, self.scattering.solving_pairs)
        (solving,) = illumination.ordinates(1, solving_pairs, rng)
        self.solving = solving.scattering().without_incoming()
        #: emitters without extent
        self.lights = LightsOfOneDirection(scene, medium, grid, self.scattering, illumination)
        self.lights.add_suns(self.ordinates, self.parts, illumination.sun_pairs(pairs))
        #: the equation of channels that are swept together, and the indices of these channels
        self.levels = self._new_levels(medium, grid, settings.has_dense_boundary)

    def _new_levels(
        self, medium: MediumGrid, grid: Grid, has_dense_boundary: bool
    ) -> list[tuple[MultigridLevel, tuple[int, ...]]]:
        detail = extinction_grid(medium, grid, has_dense_boundary)
        extinction = track_extinction(medium, grid, detail)
        mean = resampled(medium, medium.sigma_t, grid) if detail is not grid else extinction
        plain = resampled(medium, medium.albedo, grid)
        albedo = collision_albedo(medium, grid, dr.arange(mi.UInt32, grid.voxel_count))
        # In empty voxels there are no collisions to average over; the albedo is that of the data.
        none = [s <= 0 for s in mean]
        albedo = [
            dr.select(none[min(c, len(none) - 1)], _channel(plain, c), _channel(albedo, c))
            for c in range(self.channels)
        ]
        dr.eval(albedo)
        self.albedo = albedo
        box = np.zeros(3, int), grid.resolution, detail
        tracks = [Tracks(grid, sigma_t, *box) for sigma_t in extinction]
        together = tuple(range(self.channels))
        joined = len(tracks) == 1 and self.scattering.joins_channels
        groups = [together] if joined else [(c,) for c in together]
        levels = []
        for own in groups:
            albedos, own_tracks = [albedo[c] for c in own], _channel(tracks, own[0])
            level = self.scattering.new_level(_channel(mean, own[0]), albedos, own_tracks)
            levels.append((level, own))
        return levels

    # The irradiance

    def irradiance(self, cached: list[Components]) -> tuple[list[Components], list[Components]]:
        """Return the fluence at the voxel centres, and that of collisions, for each channel.

        ``cached`` is the fluence of the cache, 0 at inactive voxels. The higher moments of the
        fluence at the centres exclude narrow sources (see `cache/angular`), whose irradiances
        follow.
        """
        centres, collided = [], []
        for level, own in self.levels:
            phi = None if self.single else self.scattering.joined([cached[c] for c in own])
            table = level.tracks.table(*with_channels(self.ordinates, own))
            found, swept = (self.scattering.separated(v, len(own)) for v in level.sweep(phi, table))
            for c, components, own_collided in zip(own, found, swept, strict=True):
                centres.append(self._with_narrow_sources(level, c, components))
                collided.append(self.lights.with_points(c, own_collided))
            dr.eval(centres, collided)
        return centres, collided

    def _with_narrow_sources(
        self, level: MultigridLevel, channel: int, components: Components
    ) -> Components:
        """Return ``components`` of a sweep as `irradiance` returns them.

        The irradiance of point-like lights is added, the higher moments of narrow sources are
        subtracted, and the irradiance of each of these is appended.
        """
        irradiance, *higher = components
        irradiance = irradiance + sum((e[channel] for e in self.lights.at_positions), mi.Float(0))
        narrow, points = [], iter(self.lights.at_positions)
        for number, part in enumerate(self.parts[1:], 1):
            if number in self.lights.parts[: self.lights.points]:
                narrow.append(next(points)[channel])
                continue
            table = level.tracks.table(*part.with_channels([channel]))
            ((own, *moments),) = self.scattering.separated(level.sweep(None, table)[0], 1)
            higher = [a - b for a, b in zip(higher, moments, strict=True)]
            narrow.append(own)
        return [irradiance, *higher, *narrow]

    # The adjoint

    def adjoint(self, camera: list[Components]) -> tuple[list, list, list]:
        """Solve the adjoint equation, given the adjoint fluence of ``camera`` rays by channel.

        Returns three lists over the channels: the adjoint fluence of collisions for each part of
        the radiance; the share of it that has travelled between voxels; and its mean over
        directions at the voxel centres, including empty voxels. The last list is empty if radiance
        is scattered once and the derivative with respect to the emission is not wanted.
        """
        # docs/primer, eq. (8.5)
        scattering = self.scattering
        totals, travelled, centres = [], [], []
        for level, own in self.levels:
            source = scattering.joined([camera[c] for c in own])
            table = level.tracks.table(*self.ordinates.scattering().without_incoming())
            if self.single:
                found = [self._zeros(scattering.count) for _ in own]
                if EMISSION in self._wanted:
                    centres += self._irradiances(level.sweep(source, table, True)[0], own)
            else:
                # Transposed, antidiffusion follows a sweep instead of preceding it.
                _, first = level.sweep(source, level.tracks.table(*self.solving), plain=True)
                phi = source + level.antidiffused(level.solve(first, self.solving))
                dr.eval(phi)
                irradiance, phi = level.sweep(phi, table, plain=True)
                centres += self._irradiances(irradiance, own)
                found = scattering.separated(level.antidiffused(phi), len(own))
            travelled += found
            totals += [
                scattering.of_parts(camera[c], components)
                for c, components in zip(own, found, strict=True)
            ]
        dr.eval(totals, travelled, centres)
        return totals, travelled, centres

    def _irradiances(self, values: mi.Float, channels: Sequence[int]) -> list[mi.Float]:
        return [components[0] for components in self.scattering.separated(values, len(channels))]

    def _zeros(self, count: int) -> Components:
        return [dr.zeros(mi.Float, self.grid.voxel_count) for _ in range(count)]

    def derivatives(
        self, phi: list[Components], camera: list[Components], extinction: list[mi.Float]
    ) -> Derivatives:
        """Return the derivatives with respect to the medium; those not wanted are empty lists.

        Args:
            phi: the fluence of collisions, by channel.
            camera: the adjoint fluence of camera rays, by channel.
            extinction: means over the voxels, by channel.
        """
        # docs/primer, eq. (8.6)
        scattering = self.scattering
        totals, travelled, emitted = self.adjoint(camera)
        sigma_t, collided, direct, by_g = [], [], [], []
        for level, own in self.levels:
            for c in own:
                scale = self.albedo[c] * dr.inv_four_pi
                if SIGMA_T in self._wanted:
                    source = None
                    if not self.single:
                        source = scattering.source(level, scattering.scattered(phi[c], scale))
                    adjoint = [scattering.scattered(components, scale) for components in totals[c]]
                    sigma_t.append(self._products(level, c, source, adjoint))
                collided.append(scattering.product(phi[c], travelled[c]))
                if self.neighbours is not None:
                    change = scattering.product(phi[c], travelled[c], self.neighbours.moments)
                    by_g.append(extinction[c] * self.albedo[c] * change)
                direct.append(self._by_direct(c, totals[c], extinction[c]))
        dr.eval(sigma_t, collided, direct, by_g)
        return Derivatives(sigma_t, collided, direct, emitted, by_g)

    def _by_direct(
        self, channel: int, adjoint: list[Components], extinction: mi.Float
    ) -> list[Components]:
        """Return `Derivatives.direct` of a channel for an ``adjoint`` fluence of each part."""
        scale = extinction * self.albedo[channel] * dr.inv_four_pi
        return [self.scattering.scattered(components, scale) for components in adjoint]

    def seen_directly(
        self, camera: list[Components], extinction: list[mi.Float]
    ) -> list[list[Components]]:
        """Return the share of `Derivatives.direct` that ``camera`` rays have themselves, without
        further scattering; arguments as those of `derivatives`.
        """
        none = self._zeros(self.scattering.count)
        return [
            self._by_direct(c, self.scattering.of_parts(components, none), extinction[c])
            for c, components in enumerate(camera)
        ]

    def _products(
        self,
        level: MultigridLevel,
        channel: int,
        source: Components | None,
        adjoint: list[Components],
    ) -> mi.Float:
        """Return the sum over all ordinates of (S - L) W, one value per voxel.

        ``source`` is S, None for 0; ``adjoint`` is the source of W for each part of L.
        """
        none = self._zeros(self.scattering.count)
        source = none if source is None else source
        dr.eval(source, adjoint)
        total = dr.zeros(mi.Float, self.grid.voxel_count)
        for number, (part, own) in enumerate(zip(self.parts, adjoint, strict=True)):
            # `add_paths_to_light` adds the derivatives with respect to suns.
            ordinates = part.before(self.lights.even, [channel])
            if len(ordinates.directions):
                scattered = none if number else source
                total = self._add_products(total, level, ordinates, scattered, own)
        return total

    def _add_products(
        self,
        total: mi.Float,
        level: MultigridLevel,
        ordinates: Ordinates,
        source: Components,
        adjoint: Components,
    ) -> mi.Float:
        """Add the products of one part of the radiance to ``total``, and return the sum."""
        scattering, tracks = self.scattering, level.tracks
        directions, incoming, weights, offsets = ordinates
        forward = tracks.table(directions, incoming, weights, offsets)
        # Ordinates of bright spots have no weight in sums, but contribute to the products.
        backward = tracks.table(directions, 0 * incoming, np.ones_like(weights), offsets)
        dr.eval(source, adjoint)
        swept = list(adjoint)

        def importance_of(group: PairGroup) -> mi.Float:
            found = scattering.along(level, adjoint, group)
            if scattering.count > 1:
                swept[:] = [found]
            return found

        both = zip(
            tracks.sweep_separately(forward, lambda group: scattering.along(level, source, group)),
            tracks.sweep_separately(backward, importance_of),
            strict=True,
        )
        for (_, group, radiance), (_, _, importance) in both:
            total = total + _pair_products(self.grid, group, radiance, importance, swept[0])
            dr.eval(total)
        return total


def _channel(channels: list, number: int):
    """Return the values of a channel; a grey field has the same values in all channels."""
    return channels[min(number, len(channels) - 1)]


@symbolic
def _pair_products(
    grid: Grid, group: PairGroup, radiance: mi.Float, importance: mi.Float, adjoint: mi.Float
):
    """Return the sums over the ordinates of a group of means over each voxel of (S - L) W.

    Within a voxel L and W decay exponentially towards their sources S and S*, in opposite
    directions. With L - S and W - S* at the middle of the voxel, the mean of the product is
    -(L - S) [S* sinh(tau/2) / (tau/2) + W - S*].

    Args:
        grid: the grid.
        group: the pairs of ordinates.
        radiance: result of `Tracks.sweep_separately`, which holds L - S.
        importance: the same with W - S*.
        adjoint: S*, one value per voxel for each direction, or the same for all directions.
    """
    # docs/primer, eq. (8.7)
    voxels = dr.opaque(mi.UInt32, grid.voxel_count)
    voxel = dr.arange(mi.UInt32, grid.voxel_count)
    each = dr.width(adjoint) > grid.voxel_count
    own, k, count = dr.gather(mi.Float, adjoint, voxel), mi.UInt32(0), group.count * 2
    total = dr.zeros(mi.Float, grid.voxel_count)
    while dr.hint(k < count, label="ordinates"):
        number = k // 2
        place, opposite = k * voxels + voxel, (k + 1 - 2 * (k - number * 2)) * voxels + voxel
        area = dr.max(dr.abs(grid.coordinates.vector(group.direction(number))))
        _, excess, _, depth = dr.gather(mi.Vector4f, radiance, place)
        _, weight, _, _ = dr.gather(mi.Vector4f, importance, opposite)
        if dr.hint(each, mode="scalar"):
            own = dr.gather(mi.Float, adjoint, opposite)
        half = 0.5 * depth / area
        series = 1 + half * half * (1 / 6)
        mean = dr.select(half < 0.1, series, dr.sinh(half) / half)
        total -= excess * dr.fma(own, mean, weight)
        k += 1
    return total
