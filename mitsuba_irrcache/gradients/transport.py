"""Adjoint transport: how the objective depends on the medium between emitters and the points at
which camera rays read the irradiance.

Transport is its own adjoint under reversal of directions. So the adjoint fluence Phi*, which the
objective's derivative by the irradiance leaves in the medium, solves the equation of all orders of
scattering with the adjoint fluence of the camera rays as its source, and the solver of the
irradiance solves it. Extinction is then worth, along each ordinate, what it removes and scatters of
the radiance L, times the adjoint radiance W that arrives against it.
"""

from __future__ import annotations

from collections.abc import Container, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.gradients.parameters import EMISSION, MEAN_COSINE, SIGMA_T
from mitsuba_irrcache.gradients.phase_function import PhasesBeside
from mitsuba_irrcache.gradients.scattering import (
    Layers,
    of_channels,
    scattering_of,
)
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.falloff import InverseSquareFactor, VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import (
    collision_albedo,
    extinction_grid,
    resampled,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks


class Derivatives:
    """Derivatives of the objective by the means over the voxels of a grid, per volume, for each
    channel of the radiance: by the extinction, for collisions of the voxel's albedo;
    ``collided``, by the scattering coefficient, Phi Phi* / (4 pi); and ``emitted``, by emission
    that is scattered. ``direct`` is, for each channel and part of the radiance, the scattered
    importance of what enters from emitters (see `scattering`); ``g``, by the mean cosine of the
    phase function.
    """

    def __init__(
        self,
        sigma_t: list,
        collided: list,
        direct: list[list[Layers]],
        emitted: list,
        g: Sequence = (),
    ) -> None:
        self.sigma_t, self.collided = sigma_t, collided
        self.direct, self.emitted, self.g = direct, emitted, g


class AdjointTransport:
    """The transport equation in all voxels of ``grid``, and its adjoint.

    ``pairs`` of opposite ordinates are used. With ``single``, radiance is scattered once only.
    ``wanted`` are the derivatives to be found: `SIGMA_T`, `EMISSION` and `MEAN_COSINE` may be among
    them. If the medium and what is wanted are ``grey``, and all emitters have one colour, a single
    channel stands for all: ``colour`` holds the factors of the radiance of each.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        grid: Grid,
        seed: tuple[int, int],
        pairs: int,
        single: bool,
        wanted: Container[str],
        grey: bool = False,
    ) -> None:
        self.grid, self._medium, self.single, self._wanted = grid, medium, single, wanted
        self.scattering = scattering_of(scene, medium)
        #: phase functions beside that of the medium, if derivatives by its mean cosine are wanted
        self.beside = PhasesBeside(medium.phase) if MEAN_COSINE in wanted else None
        colours = 1 if mi.is_monochromatic else 3
        rng = np.random.default_rng((*seed, 0x67726164))
        illumination = DistantIllumination(scene)
        if grey:
            (self.ordinates,), self.colour = illumination.factored_ordinates(1, pairs, colours, rng)
        else:
            (self.ordinates,) = illumination.ordinates(1, pairs, rng)
            self.colour = np.ones(colours)
        self.parts = self.scattering.parts(self.ordinates)
        #: sets of tracks of each sun, the last ordinates
        self.sun_tracks = illumination.sun_pairs(pairs) // max(illumination.sun_count, 1)
        self.channels = self.ordinates.incoming.shape[-1] if grey else colours
        solving_pairs = min(pairs, self.scattering.solving_pairs)
        (solving,) = illumination.ordinates(1, solving_pairs, rng)
        self._solving = solving.scattering().without_incoming()
        voxels = dr.arange(mi.UInt32, grid.voxel_count)
        self.positions = VoxelSamplePoints(scene, grid).of(voxels)
        self.point_lights = illumination.point_lights
        self._point_parts = self.scattering.point_parts(len(self.point_lights))
        #: irradiance from each point-like light at the voxel centres, and means over the voxels
        self.at_centres = illumination.point_irradiance(medium, self.positions)
        falloff = InverseSquareFactor.of(scene, grid) if self.at_centres else None
        mean = falloff.spread(voxels) if falloff is not None else mi.Float(1)
        self.from_points = [irradiance * mean for irradiance in self.at_centres]
        dr.eval(self.at_centres, self.from_points)
        #: levels of channels that are swept together, with the numbers of these channels
        self.levels = self._new_levels(medium, grid, voxels)

    def _new_levels(
        self, medium: MediumGrid, grid: Grid, voxels: mi.UInt32
    ) -> list[tuple[MultigridLevel, tuple[int, ...]]]:
        detail = extinction_grid(medium, grid)
        extinction = resampled(medium, medium.sigma_t, detail)
        mean = resampled(medium, medium.sigma_t, grid) if detail is not grid else extinction
        plain = resampled(medium, medium.albedo, grid)
        albedo = collision_albedo(medium, grid, voxels)
        # Where there is no matter yet, some that is added has the albedo of the data.
        none = [s <= 0 for s in mean]
        albedo = [
            dr.select(none[min(c, len(none) - 1)], _of(plain, c), _of(albedo, c))
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
            albedos, own_tracks = [albedo[c] for c in own], _of(tracks, own[0])
            level = self.scattering.new_level(_of(mean, own[0]), albedos, own_tracks)
            levels.append((level, own))
        return levels

    # The irradiance

    def irradiance(self, known: list[Layers]) -> tuple[list[Layers], list[Layers]]:
        """Fluence at all voxels, and that of collisions, in each channel; ``known`` is that of the
        cache, 0 where it has none.

        Behind the layers of the former are the irradiance of each narrow source, whose moments they
        exclude (see `cache/angular`).
        """
        centres, collided = [], []
        for level, own in self.levels:
            phi = None if self.single else self.scattering.joined([known[c] for c in own])
            table = level.tracks.table(*of_channels(self.ordinates, own))
            found, swept = (self.scattering.apart(v, len(own)) for v in level.sweep(phi, table))
            for c, layers, own_collided in zip(own, found, swept, strict=True):
                centres.append(self._with_narrow_sources(level, c, layers))
                collided.append(self._with_points(c, own_collided))
            dr.eval(centres, collided)
        return centres, collided

    def _with_narrow_sources(self, level: MultigridLevel, channel: int, layers: Layers) -> Layers:
        """Swept ``layers`` with the irradiance of point-like lights, without the higher moments of
        narrow sources, followed by the irradiance of each of these.
        """
        irradiance, *higher = layers
        irradiance = irradiance + sum((e[channel] for e in self.at_centres), mi.Float(0))
        narrow, points = [], iter(self.at_centres)
        for number, part in enumerate(self.parts[1:], 1):
            if number in self._point_parts:
                narrow.append(next(points)[channel])
                continue
            table = level.tracks.table(*part.of_channels([channel]))
            ((own, *moments),) = self.scattering.apart(level.sweep(None, table)[0], 1)
            higher = [a - b for a, b in zip(higher, moments, strict=True)]
            narrow.append(own)
        return [irradiance, *higher, *narrow]

    def _with_points(self, channel: int, layers: Layers) -> Layers:
        """``layers`` of collisions with those of point-like lights."""
        from_lights = [
            self.scattering.from_direction(irradiance[channel], self.towards_point(light))
            for light, irradiance in enumerate(self.from_points)
        ]
        if not from_lights:
            return layers
        return [a + sum(own) for a, *own in zip(layers, *from_lights, strict=True)]

    def towards_point(self, light: int) -> mi.Vector3f:
        """The direction from the voxels to the point-like light of this number."""
        at = dr.zeros(mi.Interaction3f, self.grid.voxel_count)
        at.p = self.positions
        return self.point_lights[light].sample_direction(at, mi.Point2f(0.5))[0].d

    def worth_of_point(self, light: int, found: Derivatives) -> mi.Spectrum:
        """The derivative by the irradiance of the point-like light of this number."""
        direction, part = self.towards_point(light), self._point_parts[light]
        return mi.Spectrum(
            *(self.scattering.into(direct[part], direction) for direct in found.direct)
        )

    # The adjoint

    def adjoint(self, camera: list[Layers]) -> tuple[list, list, list]:
        """The adjoint fluence of collisions in each channel: for each part of the radiance, with
        that of the ``camera`` rays; that which has travelled between voxels; and its mean over
        directions at the voxel centres, also without matter.
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
                    centres += self._irradiances(level.sweep(source, table)[0], own)
            else:
                _, first = level.sweep(source, level.tracks.table(*self._solving))
                phi = source + level.solve(first, self._solving)
                dr.eval(phi)
                irradiance, phi = level.sweep(phi, table)
                centres += self._irradiances(irradiance, own)
                found = scattering.apart(phi, len(own))
            travelled += found
            totals += [
                scattering.of_parts(camera[c], layers) for c, layers in zip(own, found, strict=True)
            ]
        dr.eval(totals, travelled, centres)
        return totals, travelled, centres

    def _irradiances(self, values: mi.Float, channels: Sequence[int]) -> list[mi.Float]:
        return [layers[0] for layers in self.scattering.apart(values, len(channels))]

    def _zeros(self, count: int) -> Layers:
        return [dr.zeros(mi.Float, self.grid.voxel_count) for _ in range(count)]

    def derivatives(
        self, phi: list[Layers], camera: list[Layers], extinction: list[mi.Float]
    ) -> Derivatives:
        """Derivatives by the medium, from the fluence ``phi`` of collisions and the adjoint fluence
        of the ``camera`` rays; ``extinction`` is its mean over the voxels. Those by the extinction
        are left out if they are not wanted.
        """
        # docs/primer, eq. (8.6)
        scattering = self.scattering
        totals, travelled, emitted = self.adjoint(camera)
        sigma_t, collided, direct, by_g = [], [], [], []
        for level, own in self.levels:
            for c in own:
                scale = self.albedo[c] * dr.inv_four_pi
                if SIGMA_T in self._wanted:
                    source = None if self.single else scattering.scattered(phi[c], scale)
                    adjoint = [scattering.scattered(layers, scale) for layers in totals[c]]
                    sigma_t.append(self._products(level, c, source, adjoint))
                collided.append(scattering.product(phi[c], travelled[c]))
                if self.beside is not None:
                    change = scattering.product(phi[c], travelled[c], self.beside.moments)
                    by_g.append(extinction[c] * self.albedo[c] * change)
                scale = extinction[c] * scale
                direct.append([scattering.scattered(layers, scale) for layers in totals[c]])
        dr.eval(sigma_t, collided, direct, by_g)
        return Derivatives(sigma_t, collided, direct, emitted, by_g)

    def _products(
        self, level: MultigridLevel, channel: int, source: Layers | None, adjoint: list[Layers]
    ) -> mi.Float:
        """The sum over all ordinates of (S - L) W: ``source`` is S, None for 0, and ``adjoint``
        that of W for each part of L.
        """
        none = self._zeros(self.scattering.count)
        source = none if source is None else source
        dr.eval(source, adjoint)
        total = dr.zeros(mi.Float, self.grid.voxel_count)
        for number, (part, own) in enumerate(zip(self.parts, adjoint, strict=True)):
            if len(part.rows):
                scattered = none if number else source
                total = self._add_products(
                    total, level, part.of_channels([channel]), scattered, own
                )
        return total

    def _add_products(
        self,
        total: mi.Float,
        level: MultigridLevel,
        ordinates: Ordinates,
        source: Layers,
        adjoint: Layers,
    ) -> mi.Float:
        """``total`` and the products of a part."""
        scattering, tracks = self.scattering, level.tracks
        directions, incoming, weights, offsets = ordinates
        forward = tracks.table(directions, incoming, weights, offsets)
        # Ordinates of emitters alone have no weight, but what enters along them meets W, too.
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


def _of(channels: list, number: int):
    """A channel; grey fields have the same in all."""
    return channels[min(number, len(channels) - 1)]


@symbolic
def _pair_products(
    grid: Grid, group: PairGroup, radiance: mi.Float, importance: mi.Float, adjoint: mi.Float
):
    """Sums over the ordinates of a group of the means over voxels of (S - L) W; ``adjoint`` is the
    source S* of the importance, laid out as both, ordinate by ordinate, or the same along all.

    Within a voxel both decay towards their sources S and S*, L forwards and W backwards: with
    L - S and W - S* in its middle, the mean is -(L - S) [S* sinh(tau/2) / (tau/2) + W - S*].
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
        _, light, _, depth = dr.gather(mi.Vector4f, radiance, place)
        _, weight, _, _ = dr.gather(mi.Vector4f, importance, opposite)
        if dr.hint(each, mode="scalar"):
            own = dr.gather(mi.Float, adjoint, opposite)
        half = 0.5 * depth / area
        series = 1 + half * half * (1 / 6)
        mean = dr.select(half < 0.1, series, dr.sinh(half) / half)
        total -= light * dr.fma(own, mean, weight)
        k += 1
    return total
