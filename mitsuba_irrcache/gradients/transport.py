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
from mitsuba_irrcache.gradients.parameters import EMISSION, SIGMA_T
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.falloff import InverseSquareFactor, VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from mitsuba_irrcache.solvers.discrete_ordinates.layout import interleaved_channels
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import (
    collision_albedo,
    extinction_grid,
    resampled,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Pairs of ordinates along which the adjoint equation is solved; those of the last sweep and of the
#: products are as many as the cache was built with.
SOLVING_PAIRS = 16
#: Sweeps by which the irradiance of collisions follows from that of voxel centres.
SWEEPS = 1


class Derivatives:
    """Derivatives of the objective by the means over the voxels of a grid, per volume, for each
    channel of the radiance: by the extinction, for collisions of the voxel's albedo;
    ``collided``, by the scattering coefficient, Phi Phi* / (4 pi); ``direct``, by the
    irradiance of point-like lights at the voxels; and ``emitted``, by emission that is scattered.
    """

    def __init__(self, sigma_t: list, collided: list, direct: list, emitted: list) -> None:
        self.sigma_t, self.collided = sigma_t, collided
        self.direct, self.emitted = direct, emitted


class AdjointTransport:
    """The transport equation in all voxels of ``grid``, and its adjoint.

    ``pairs`` of opposite ordinates are used. With ``single``, radiance is scattered once only.
    ``wanted`` are the derivatives to be found, `SIGMA_T` and `EMISSION` if they are among them. If
    the medium and what is wanted are ``grey``, and all emitters have one colour, a single channel
    stands for all: ``colour`` holds the factors of the radiance of each.
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
        colours = 1 if mi.is_monochromatic else 3
        rng = np.random.default_rng((*seed, 0x67726164))
        illumination = DistantIllumination(scene)
        if grey:
            (self.ordinates,), self.colour = illumination.factored_ordinates(1, pairs, colours, rng)
        else:
            (self.ordinates,) = illumination.ordinates(1, pairs, rng)
            self.colour = np.ones(colours)
        #: sets of tracks of each sun, the last ordinates
        self.sun_tracks = illumination.sun_ordinates(pairs) // max(illumination.sun_count, 1)
        self.channels = self.ordinates.incoming.shape[-1] if grey else colours
        (solving,) = illumination.ordinates(1, min(pairs, SOLVING_PAIRS), rng)
        self._solving = solving.scattering().without_incoming()
        voxels = dr.arange(mi.UInt32, grid.voxel_count)
        self.positions = VoxelSamplePoints(scene, grid).of(voxels)
        self.point_lights = illumination.point_lights
        at_centres = illumination.point_irradiance(medium, self.positions)
        falloff = InverseSquareFactor.of(scene, grid) if at_centres else None
        mean = falloff.spread(voxels) if falloff is not None else mi.Float(1)
        #: irradiance from all point-like lights at the voxel centres, and means over the voxels of
        #: that from each
        self._at_centres = sum(at_centres, mi.Spectrum(0))
        self.from_points = [irradiance * mean for irradiance in at_centres]
        dr.eval(self._at_centres, self.from_points)
        self._levels = self._new_levels(medium, grid, voxels)

    def _new_levels(self, medium: MediumGrid, grid: Grid, voxels: mi.UInt32) -> list[tuple]:
        """The levels of channels that are swept together, with the numbers of these channels."""
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
        groups = [together] if len(tracks) == 1 else [(c,) for c in together]
        return [
            (
                MultigridLevel(
                    _of(mean, own[0]), interleaved_channels([albedo[c] for c in own]), own_tracks
                ),
                own,
            )
            for own, own_tracks in zip(groups, tracks, strict=True)
        ]

    @property
    def tracks(self) -> list[tuple[Tracks, tuple[int, ...]]]:
        """Tracks, and the channels whose extinction they have."""
        return [(level.tracks, own) for level, own in self._levels]

    # The irradiance

    def irradiance(self, known: list[mi.Float]) -> tuple[list[mi.Float], list[mi.Float]]:
        """Irradiance at all voxels, and that of collisions, in each channel; ``known`` is that of
        the cache, 0 where it has none.
        """
        centres, collided = [], []
        for level, own in self._levels:
            table = level.tracks.table(*self._incoming(own))
            none = dr.zeros(mi.Float, self._count)
            centre = interleaved_channels([self._at_centres[c] + none for c in own])
            points = interleaved_channels(
                [sum((e[c] for e in self.from_points), none) for c in own]
            )
            phi = None if self.single else interleaved_channels([known[c] for c in own])
            for _ in range(1 if self.single else SWEEPS):
                irradiance, swept = level.sweep(phi, table)
                irradiance, phi = irradiance + centre, swept + points
                dr.eval(irradiance, phi)
            centres += self._apart(irradiance, own)
            collided += self._apart(phi, own)
        return centres, collided

    @property
    def _count(self) -> int:
        return self.grid.voxel_count

    def _incoming(self, channels: Sequence[int]) -> Ordinates:
        """The ordinates, with what enters along them in these channels."""
        incoming = self.ordinates.incoming
        if incoming.shape[-1] > 1:
            incoming = incoming[..., list(channels)]
        return self.ordinates._replace(incoming=incoming)

    def _apart(self, values: mi.Float, channels: Sequence[int]) -> list[mi.Float]:
        """Interleaved ``values`` of some channels, each as an array."""
        count = len(channels)
        if count == 1:
            return [values]
        place = dr.arange(mi.UInt32, self._count) * count
        found = [dr.gather(mi.Float, values, place + i) for i in range(count)]
        dr.eval(found)
        return found

    # The adjoint

    def adjoint(self, camera: list[mi.Float]) -> tuple[list, list, list]:
        """The adjoint fluence of collisions: in all, with that of the ``camera`` rays, and the part
        that has travelled between voxels; and the latter at the voxel centres, also without matter.
        """
        # docs/primer, eq. (8.5)
        totals, travelled, centres = [], [], []
        for level, own in self._levels:
            source = interleaved_channels([camera[c] for c in own])
            table = level.tracks.table(*self.ordinates.scattering().without_incoming())
            if self.single:
                totals += self._apart(source, own)
                travelled += [dr.zeros(mi.Float, self._count) for _ in own]
                if EMISSION in self._wanted:
                    centres += self._apart(level.sweep(source, table)[0], own)
                continue
            _, first = level.sweep(source, level.tracks.table(*self._solving))
            phi = source + level.solve(first, self._solving)
            dr.eval(phi)
            irradiance, phi = level.sweep(phi, table)
            centres += self._apart(irradiance, own)
            travelled += self._apart(phi, own)
            totals += self._apart(phi + source, own)
        dr.eval(totals, travelled, centres)
        return totals, travelled, centres

    def derivatives(
        self, phi: list[mi.Float], camera: list[mi.Float], extinction: list[mi.Float]
    ) -> Derivatives:
        """Derivatives by the medium, from the irradiance ``phi`` of collisions and the adjoint
        fluence of the ``camera`` rays; ``extinction`` is its mean over the voxels. Those by the
        extinction are left out if they are not wanted.
        """
        # docs/primer, eq. (8.6)
        total, travelled, emitted = self.adjoint(camera)
        sigma_t, collided, direct = [], [], []
        for level, own in self._levels:
            for c in own:
                scale = self.albedo[c] * dr.inv_four_pi
                source = mi.Float(0) if self.single else scale * phi[c]
                if SIGMA_T in self._wanted:
                    sigma_t.append(self._products(level.tracks, c, source, scale * total[c]))
                collided.append(phi[c] * travelled[c] * dr.inv_four_pi)
                direct.append(extinction[c] * scale * total[c])
        dr.eval(sigma_t, collided, direct)
        return Derivatives(sigma_t, collided, direct, emitted)

    def _products(
        self, tracks: Tracks, channel: int, source: mi.Float, adjoint: mi.Float
    ) -> mi.Float:
        """The sum over all ordinates of (S - L) W: ``source`` is S, and ``adjoint`` that of W."""
        directions, incoming, weights, offsets = self._incoming([channel])
        forward = tracks.table(directions, incoming, weights, offsets)
        # Ordinates of emitters alone have no weight, but what enters along them meets W, too.
        backward = tracks.table(directions, 0 * incoming, np.ones_like(weights), offsets)
        voxels, total = self._count, dr.zeros(mi.Float, self._count)
        source = source + dr.zeros(mi.Float, voxels)
        dr.eval(source, adjoint)
        both = zip(
            tracks.sweep_separately(forward, lambda group: repeated(source, group, voxels)),
            tracks.sweep_separately(backward, lambda group: repeated(adjoint, group, voxels)),
            strict=True,
        )
        for (_, group, radiance), (_, _, importance) in both:
            total = total + _pair_products(self.grid, group, radiance, importance, adjoint)
            dr.eval(total)
        return total


def _of(channels: list, number: int) -> mi.Float:
    """A channel; grey fields have the same in all."""
    return channels[min(number, len(channels) - 1)]


def repeated(values: mi.Float, group: PairGroup, voxels: int) -> mi.Float:
    """Values of the voxels for both ways of all pairs of a group."""
    count = dr.opaque(mi.UInt32, voxels)
    result = dr.gather(mi.Float, values, dr.arange(mi.UInt32, 2 * len(group) * voxels) % count)
    dr.eval(result)
    return result


@symbolic
def _pair_products(
    grid: Grid, group: PairGroup, radiance: mi.Float, importance: mi.Float, adjoint: mi.Float
):
    """Sums over the ordinates of a group of the means over voxels of (S - L) W.

    Within a voxel both decay towards their sources S and S*, L forwards and W backwards: with
    L - S and W - S* in its middle, the mean is -(L - S) [S* sinh(tau/2) / (tau/2) + W - S*].
    """
    # docs/primer, eq. (8.7)
    voxels = dr.opaque(mi.UInt32, grid.voxel_count)
    voxel = dr.arange(mi.UInt32, grid.voxel_count)
    own, k, count = dr.gather(mi.Float, adjoint, voxel), mi.UInt32(0), group.count * 2
    total = dr.zeros(mi.Float, grid.voxel_count)
    while dr.hint(k < count, label="ordinates"):
        number = k // 2
        place, opposite = k * voxels + voxel, (k + 1 - 2 * (k - number * 2)) * voxels + voxel
        area = dr.max(dr.abs(grid.coordinates.vector(group.direction(number))))
        _, light, _, depth = dr.gather(mi.Vector4f, radiance, place)
        _, weight, _, _ = dr.gather(mi.Vector4f, importance, opposite)
        half = 0.5 * depth / area
        series = 1 + half * half * (1 / 6)
        mean = dr.select(half < 0.1, series, dr.sinh(half) / half)
        total -= light * dr.fma(own, mean, weight)
        k += 1
    return total
