"""Multiple scattering: source iteration on a hierarchy of grids (multigrid).

The mean irradiance of collisions phi (the mean over the collisions in a voxel) solves phi = A phi +
b. The operator A is one transport sweep over a fixed set of ordinates with the source alpha * phi /
(4 pi), where alpha is the albedo; b is the uncollided irradiance, averaged over collisions (order
0). Source iteration (phi <- A phi + b) adds one order of scattering per sweep; dense media with an
albedo near 1 need thousands. The slowly converging errors are smooth, and are corrected on coarser
grids with the same operator: a cycle is a sweep, followed by a correction from the next coarser
grid, where one more sweep computes the right-hand side (multigrid; for acceleration of
discrete-ordinates methods in general see Adams and Larsen, *Fast iterative methods for
discrete-ordinates particle transport calculations*, Progress in Nuclear Energy 40, 2002). Anderson
acceleration (`anderson`) combines the cycles.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import from_numpy
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.grid import Grid, stencil
from mitsuba_irrcache.solvers.discrete_ordinates.anderson import (
    TINY,
    AndersonAcceleration,
    accelerated,
)
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.antidiffusion import Antidiffusion
from mitsuba_irrcache.solvers.discrete_ordinates.layout import voxel_and_channel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Maximum number of voxels along the longest side of the coarsest grid.
COARSEST = 20
#: Maximum number of multigrid cycles on the finest grid; one cycle is run on the others.
MAX_CYCLES = 12
#: Optical depth of a voxel above which collisions are computed from the loss of radiance in it.
THIN = 1e-2
#: Relative error of the solution on the finest grid.
TOLERANCE = 1e-3
#: Where surfaces divide the voxels, rooms may be darker than the rest: errors are relative to the
#: irradiance of each voxel plus this share of the mean. With 1e-2, a room in a medium 2e4 times as
#: bright was 0.7 % too dark with 64 voxels along a side.
LOWEST_IRRADIANCE = 1e-4
#: Relative changes at which the iteration on the coarsest grid ends, if that is the only grid, and
#: if it only corrects finer ones.
COARSEST_TOLERANCE, CORRECTION_TOLERANCE = 2e-4, 3e-2
#: Maximum number of iterations on the coarsest grid, and of iterates that Anderson acceleration
#: combines.
MAX_ITERATIONS, HISTORY = 200, 6


class MultigridLevel:
    """A grid of the hierarchy: extinction, albedo, tracks, and the next coarser level.

    ``sigma_t`` and ``albedo``, like all fields of irradiance, have a value for each active voxel of
    the ``tracks``; the extinction of other voxels is 0. If several channels are swept together,
    albedo and irradiance have adjacent channels. Coarser levels have half as many voxels along the
    axes along which voxels are shortest, or along all axes (``all_axes``): a sweep reduces errors
    that differ between voxels that are near, optically. With edges of 4 : 1 and optical depths of 2
    and 0.5, an error that alternates along the short edges keeps 19 % of its amplitude in a sweep,
    one that alternates along the long edges 57 %: the coarser grid has to represent the latter, and
    need not represent the former.
    """

    def __init__(
        self, sigma_t: mi.Float, albedo: mi.Float, tracks: Tracks, all_axes: bool = False
    ) -> None:
        self.sigma_t, self.albedo, self.tracks = sigma_t, albedo, tracks
        self.grid, self.all_axes = tracks.grid, all_axes
        self.channels = dr.width(albedo) // tracks.active_count
        # voxels of this level in one of the next, along x, y, z
        self._ratio = np.array([2, 2, 2]) if all_axes else _coarsening(self.grid)
        self._coarser: MultigridLevel | None = None
        self._tolerance = COARSEST_TOLERANCE
        self._children: list[tuple[mi.UInt32, mi.Float]] = []
        self._antidiffusion: Antidiffusion | None = None
        #: whether numerical diffusion is compensated; not among surfaces, which separate voxels
        self._is_antidiffusive = tracks.surfaces is None
        #: values of voxels that surfaces cut
        self._is_cut: mi.Bool | None = None
        if tracks.surfaces is not None:
            place, _ = voxel_and_channel(tracks.active_count, self.channels)
            self._is_cut = tracks.surfaces.is_cut_at(dr.gather(mi.UInt32, tracks.active, place))
            dr.eval(self._is_cut)

    @property
    def coarsest(self) -> bool:
        """Whether there is no coarser level."""
        return max(self.grid.shape) <= COARSEST

    @property
    def coarser(self) -> MultigridLevel:
        """The next coarser level, created at the first access."""
        if self._coarser is None:
            grid, fine = _coarse_grid(self.grid, self._ratio), self.tracks
            active = None if fine.all_active else self._interpolated_from(grid)
            children = []
            for voxel, inside in _children_of(self.grid, grid, self._ratio):
                place = fine.active_index(voxel)
                inside &= place < dr.opaque(mi.UInt32, fine.active_count)
                extinction = dr.gather(mi.Float, self.sigma_t, place, inside)
                children.append((dr.select(inside, place, 0), extinction))
            total = sum(s for _, s in children)
            sigma_t = total / len(children)
            # The weights of all other means are shares of the extinction.
            shares = [(i, dr.select(total > 0, s / total, 0)) for i, s in children]
            dr.eval(sigma_t, shares)
            box = np.zeros(3, int), grid.resolution
            tracks = Tracks(grid, sigma_t, *box, None, active, fine.sparse, fine.pause)
            active = tracks.active
            sigma_t = dr.gather(mi.Float, sigma_t, active)
            self._children = [
                (dr.gather(mi.UInt32, i, active), dr.gather(mi.Float, w, active)) for i, w in shares
            ]
            dr.eval(sigma_t, self._children)
            self._coarser = self._new_level(sigma_t, self._restricted(self.albedo, tracks), tracks)
            self._coarser._tolerance = CORRECTION_TOLERANCE
            self._coarser._is_antidiffusive = self._is_antidiffusive
        return self._coarser

    def _new_level(self, sigma_t: mi.Float, albedo: mi.Float, tracks: Tracks) -> MultigridLevel:
        return MultigridLevel(sigma_t, albedo, tracks, self.all_axes)

    @property
    def _measured(self) -> int:
        """Number of unknowns of a voxel, the first ones, from which the error is estimated."""
        return 1

    # Transfer between levels

    def _interpolated_from(self, coarse: Grid) -> mi.UInt32:
        """Return the voxels of a ``coarse`` grid from which active voxels are interpolated."""
        marks = dr.opaque(mi.Bool, False, coarse.voxel_count)
        axes = [ends for ends, _ in self._stencil(coarse, self.tracks.active)]
        for at in product(*axes):
            dr.scatter(marks, mi.Bool(True), coarse.index(*at))
        return dr.compress(marks)

    def _stencil(self, coarse: Grid, voxel: mi.UInt32) -> list[tuple]:
        """Return, for x, y, z, the coordinates of the two voxels of a ``coarse`` grid around each
        ``voxel``, and the interpolation weight of the upper one.
        """
        axes, places = [], self.grid.voxel_indices(voxel)
        for at, n, sides in zip(places, self._ratio, coarse.sides, strict=True):
            lower, weight, more = stencil((mi.Float(at) + 0.5) * dr.opaque(mi.Float, 1 / n), sides)
            axes.append(((lower, lower + dr.select(more, 1, 0)), weight))
        return axes

    def restrict(self, values: mi.Float) -> mi.Float:
        """Return means over the voxels of the coarser level, weighted by extinction."""
        return self._restricted(values, self.coarser.tracks)

    def _restricted(self, values: mi.Float, coarse: Tracks) -> mi.Float:
        place, channel = voxel_and_channel(coarse.active_count, self.channels)
        result = mi.Float(0)
        for i, w in self._children:
            child = dr.gather(mi.UInt32, i, place) * self.channels + channel
            result += dr.gather(mi.Float, values, child) * dr.gather(mi.Float, w, place)
        dr.eval(result)
        return result

    def prolong(self, values: mi.Float) -> mi.Float:
        """Interpolate values of the coarser level trilinearly at the voxels of this one."""
        place, channel = voxel_and_channel(self.tracks.active_count, self.channels)
        return self._interpolated(values, place, self.channels, channel)

    def _interpolated(
        self, values: mi.Float, place: mi.UInt32, step: int, begin: mi.UInt32
    ) -> mi.Float:
        """Interpolate values of the coarser level, at index ``voxel * step + begin``, trilinearly
        at the active voxels of this level.
        """
        coarse = self.coarser.tracks
        voxel = dr.gather(mi.UInt32, self.tracks.active, place)
        (xs, wx), (ys, wy), (zs, wz) = self._stencil(coarse.grid, voxel)

        def along_x(y, z):
            at = (coarse.active_index(coarse.grid.index(x, y, z)) for x in xs)
            return dr.lerp(*(dr.gather(mi.Float, values, p * step + begin) for p in at), wx)

        return dr.lerp(*(dr.lerp(*(along_x(y, z) for y in ys), wy) for z in zs), wz)

    # The operator A

    def sweep(
        self, phi: mi.Float | None, table: TrackTable, plain: bool = False
    ) -> tuple[mi.Float, mi.Float]:
        """Compute A phi plus the irradiance due to radiance that enters along the ``table``.

        ``phi`` is a mean irradiance of collisions; None: 0. If ``plain``, numerical diffusion is
        not compensated. Returns the irradiance at voxel centres, and the mean irradiance of
        collisions, which determines the next order.
        """
        # docs/primer, eq. (4.8)
        tracks = self.tracks
        place, channel = voxel_and_channel(tracks.active_count, self.channels)
        slot = dr.gather(mi.UInt32, tracks.active, place) * self.channels + channel
        volume = dr.opaque(mi.Float, 0, self.grid.voxel_count * self.channels * 4)
        if phi is not None:
            source = phi * self.albedo * dr.inv_four_pi
            flat, source = source, source if plain else self.antidiffused(source)
            change = source - flat
            dr.scatter(volume, mi.Vector4f(source, 0, 0, 0), slot)
            dr.eval(volume)
            if table.boundary_source is not None:
                table.boundary_source.update(phi)
        tracks.sweep(volume, table)
        source, irradiance, lost, depth = dr.gather(mi.Vector4f, volume, slot)
        # S + V / W, the mean radiance of collisions, times 4 pi.
        collided = 4 * dr.pi * (source + lost / dr.select(depth > 0, depth, 1))
        if self._is_cut is not None and tracks.surfaces.medium is not None:
            # Centres of cut voxels may be outside of the medium, where irradiance is not computed.
            irradiance = dr.select(self._is_cut & (depth > 0), collided, irradiance)
        if phi is not None:
            irradiance -= 4 * dr.pi * Antidiffusion.at_centre(change, self._voxel_depth(depth))
        collided = self.collided_irradiance(depth, collided, irradiance)
        if self._is_cut is not None:
            # Middles of tracks may lie behind the surface: use the mean over parts of tracks.
            irradiance = dr.select(self._is_cut, collided, irradiance)
        dr.eval(irradiance, collided)
        return irradiance, collided

    def antidiffused(self, values: mi.Float) -> mi.Float:
        """Apply `Antidiffusion` to a field like phi, unless there are surfaces among the voxels."""
        place, channel = voxel_and_channel(self.tracks.active_count, self.channels)
        return self._antidiffused(values, place, self.channels, channel)

    def antidiffused_layer(self, values: mi.Float) -> mi.Float:
        """Apply `antidiffused` to a single channel of a moment, one value for each voxel."""
        return self._antidiffused(values, dr.arange(mi.UInt32, self.tracks.active_count), 1, 0)

    def _antidiffused(
        self, values: mi.Float, place: mi.UInt32, step: int, begin: mi.UInt32 | int
    ) -> mi.Float:
        if not self._is_antidiffusive:
            return values
        if self._antidiffusion is None:
            active = self.tracks.active, self.tracks.active_index
            self._antidiffusion = Antidiffusion(self.grid, self.sigma_t, *active)
        return self._antidiffusion.applied(values, place, step, begin)

    def collisions(self, phi: mi.Float | None, table: TrackTable) -> mi.Float:
        """Return the second result of `sweep`."""
        return self.sweep(phi, table)[1]

    def collided_irradiance(
        self, depth: mi.Float, collided: mi.Float, irradiance: mi.Float
    ) -> mi.Float:
        """Return the mean irradiance of collisions, blended from two estimates.

        ``collided`` is computed from the loss of radiance along tracks; in voxels that are nearly
        empty it is replaced by the ``irradiance`` at the centre. ``depth`` is the sum W of eq.
        (4.7): optical depth per unit of length, integrated over directions. In nearly empty voxels
        the tracks of suns and of the quadrature pass through different extinction, so that loss
        over depth is unreliable, while the irradiance is nearly constant.
        """
        found = dr.square(self._voxel_depth(depth) * dr.opaque(mi.Float, 1 / THIN))
        return dr.select(found < 1, dr.lerp(irradiance, collided, found), collided)

    def _voxel_depth(self, depth: mi.Float) -> mi.Float:
        """Return the optical depth of the shortest edge of voxels, given the sum W of eq. (4.7)."""
        return depth * dr.opaque(mi.Float, float(self.grid.voxel_size.min()) / (4 * np.pi))

    def scattered_radiance(
        self, phi: mi.Float, index: mi.UInt32, direction: mi.Vector3f | None
    ) -> mi.Float:
        """Return 4 pi times the radiance scattered into ``direction`` in the active voxel
        ``index``, divided by the albedo; for isotropic scattering that is ``phi``.
        """
        return dr.gather(mi.Float, phi, index)

    def propagated_change(self, phi: mi.Float, ordinates: Ordinates, sets: int) -> mi.Float:
        """Approximate the irradiance A phi along the ``ordinates`` of several ``sets``, on the
        coarser level if there is one.
        """
        directions, incoming, weights, offsets = ordinates
        coarse = self if self.coarsest else self.coarser
        table = coarse.tracks.table(directions, incoming, weights / sets, offsets)
        if self.coarsest:
            return self.sweep(phi, table)[0]
        return self.prolong(coarse.sweep(self.restrict(phi), table)[0])

    def tables(
        self, ordinates: Ordinates, boundary_source: Callable | None = None
    ) -> list[TrackTable]:
        """Return the track tables of this level and all coarser ones for ``ordinates``.

        ``boundary_source(level, table)`` returns the boundary source of a table; None: no radiance
        enters.
        """
        tables, level = [], self
        while True:
            tables.append(level.tracks.table(*ordinates))
            if boundary_source is not None:
                tables[-1].boundary_source = boundary_source(level, tables[-1])
            if level.coarsest:
                return tables
            level = level.coarser

    # Solution of phi = A phi + b

    def solve(
        self,
        b: mi.Float,
        ordinates: Ordinates,
        boundary_source: Callable | None = None,
        tolerance: float = 1.0,
    ) -> mi.Float:
        """Solve phi = A phi + b by accelerated multigrid cycles, for ``ordinates`` and
        ``boundary_source`` as in `tables`, to ``tolerance`` times the relative error `TOLERANCE`.
        """
        # docs/primer, eq. (4.9)
        tables = self.tables(ordinates, boundary_source)
        phi = self._initial_guess(b, tables)
        change, nonzero = np.inf, self._scattered_sums(dr.abs, b).max() > 0
        acceleration = AndersonAcceleration(self._scattered_sums)
        for _ in range(MAX_CYCLES if not self.coarsest and nonzero else 0):
            image = self.cycle(phi, b, tables)
            weights = None if self.tracks.surfaces is None else self._weights(image)
            scale = self._scattered_sums(dr.abs, image, weights=weights)
            last = change
            change = self._scattered_sums(lambda a, b: dr.abs(a - b), image, phi, weights=weights)
            # Errors decay by about the same factor in each cycle. It is bounded from below, because
            # the first factors may be small: slowly converging errors dominate only later.
            factor = np.clip(change / np.maximum(last, TINY), 0.5, 0.95)
            error = (change * factor / (1 - factor) / np.maximum(scale, TINY)).max()
            mi.Log(mi.LogLevel.Debug, f"irrcache: multiple scattering, relative error {error:.1e}")
            phi = acceleration.next(phi, image)
            if error <= TOLERANCE * tolerance:
                break
        else:
            if not self.coarsest and nonzero:
                mi.Log(
                    mi.LogLevel.Warn,
                    f"irrcache: multiple scattering has not converged after {MAX_CYCLES} "
                    f"multigrid cycles, its relative error is {error:.1e}",
                )
        return phi

    def _weights(self, phi: mi.Float) -> mi.Float:
        """Return the weights of all voxels and channels in the error: one over the irradiance plus
        `LOWEST_IRRADIANCE` times its mean.
        """
        count, channels = self.tracks.active_count, self.channels
        place = dr.arange(mi.UInt32, count * channels)
        irradiance = dr.abs(dr.gather(mi.Float, phi, place))
        channel, weights = place % dr.opaque(mi.UInt32, channels), mi.Float(0)
        for c in range(channels):
            own = dr.select(channel == c, irradiance, 0)
            lowest = dr.sum(own) * (LOWEST_IRRADIANCE / count)
            weight = 1 / dr.maximum(irradiance + lowest, np.finfo(np.float32).tiny)
            weights = dr.select(channel == c, weight, weights)
        dr.eval(weights)
        return weights

    def _scattered_sums(
        self, integrand: Callable, *fields: mi.Float, weights: mi.Float | None = None
    ) -> np.ndarray:
        """Return sums of ``integrand(*fields)`` per channel, weighted by the scattering coefficient
        and by the ``weights`` of voxels and channels (None: 1).
        """
        channels, voxels = self.channels, dr.opaque(mi.UInt32, self.tracks.active_count)
        place = dr.arange(mi.UInt32, self._measured * self.tracks.active_count)
        voxel = place % voxels
        weight, sums = dr.gather(mi.Float, self.sigma_t, voxel), []
        for c in range(channels):
            value = integrand(*(dr.gather(mi.Float, x, place * channels + c) for x in fields))
            share = weight * dr.gather(mi.Float, self.albedo, voxel * channels + c)
            if weights is not None:
                share *= dr.gather(mi.Float, weights, voxel * channels + c)
            sums.append(dr.sum(value * share))
        dr.eval(sums)
        return np.array([float(total[0]) for total in sums])

    def cycle(self, phi: mi.Float, b: mi.Float, tables: list[TrackTable]) -> mi.Float:
        """Run a multigrid cycle: a step of source iteration, and the coarse-grid correction."""
        return self.coarse_corrected(phi, self.collisions(phi, tables[0]) + b, tables[1:])

    def corrected_along(self, ordinates: Ordinates, phi: mi.Float, swept: mi.Float) -> mi.Float:
        """Apply `coarse_corrected` to ``swept``, the result of a sweep along ``ordinates``."""
        coarse = [] if self.coarsest else self.coarser.tables(ordinates)
        return self.coarse_corrected(phi, swept, coarse)

    def coarse_corrected(
        self, phi: mi.Float, swept: mi.Float, coarse: list[TrackTable]
    ) -> mi.Float:
        """Add the coarse-grid correction to ``swept``, the result of a sweep of ``phi``.

        ``coarse`` are the track tables of the coarser levels.
        """
        # docs/primer, eq. (4.10)
        if self.coarsest:
            return swept
        residual = self.coarser.collisions(self.restrict(swept - phi), coarse[0])
        result = swept + self.prolong(self.coarser._approximate_solution(residual, coarse))
        dr.eval(result)
        return result

    def _approximate_solution(self, b: mi.Float, tables: list[TrackTable]) -> mi.Float:
        """Approximate the solution by a single cycle on each level."""
        return self._source_iteration(b, tables[0]) if self.coarsest else self.cycle(b, b, tables)

    def _initial_guess(self, b: mi.Float, tables: list[TrackTable]) -> mi.Float:
        """Return the interpolated solution of the coarser level; on the coarsest, the solution."""
        if self.coarsest:
            return self._source_iteration(b, tables[0])
        coarser = self.coarser  # made before anything is restricted to it
        return self.prolong(coarser._approximate_solution(self.restrict(b), tables[1:]))

    def _source_iteration(self, b: mi.Float, table: TrackTable) -> mi.Float:
        """Solve by source iteration with Anderson acceleration, for few voxels."""
        first = np.array(b, dtype=np.float64).reshape(-1, self.channels).T
        phi, images, residuals = first, [], []
        scale = np.abs(first).mean(axis=1, keepdims=True)
        for _ in range(MAX_ITERATIONS):
            scattered = np.array(self.collisions(from_numpy(phi.T), table))
            image = scattered.reshape(-1, self.channels).T + first
            residual = image - phi
            if not np.isfinite(residual).all():
                raise IrrcacheError(
                    "irrcache: the irradiance in the medium is not finite in single precision; "
                    "lower the radiance of the emitters (irradiance before scattering: "
                    f"{scale.max():.1e} on average)."
                )
            largest = scale
            if self.tracks.surfaces is not None:
                values = np.abs(image)
                largest = values + LOWEST_IRRADIANCE * values.mean(axis=1, keepdims=True)
            change = np.abs(residual) / np.maximum(largest, TINY)
            if (change.mean(axis=1) <= self._tolerance).all():
                break
            images, residuals = [*images, image][-HISTORY:], [*residuals, residual][-HISTORY:]
            phi = accelerated(np.array(images), np.array(residuals))
        return from_numpy(image.T)


def _coarsening(grid: Grid) -> np.ndarray:
    """Return the number of voxels along x, y, z that one voxel of the next level replaces.

    It is 2 along axes with several voxels whose edge is less than twice the shortest one, else 1.
    """
    several = grid.resolution > 1
    shortest = grid.voxel_size[several].min() if several.any() else 0.0
    return np.where(several & (grid.voxel_size < 2 * shortest), 2, 1)


def _coarse_grid(grid: Grid, ratio: np.ndarray) -> Grid:
    """Return the grid with voxels enlarged by ``ratio``; it may extend beyond ``grid``."""
    sides = -(-grid.resolution // ratio)
    scale = ratio * sides / grid.resolution
    return Grid(tuple(int(n) for n in sides[::-1]), grid.to_world @ np.diag([*scale, 1.0]))


def _children_of(fine: Grid, coarse: Grid, ratio: np.ndarray) -> list[tuple[mi.UInt32, mi.Bool]]:
    """Return, for each position of a fine voxel within a coarse one, the fine voxels of all coarse
    voxels, and whether they exist.
    """
    at = coarse.voxel_indices(dr.arange(mi.UInt32, coarse.voxel_count))
    nx, ny, nz = (int(n) for n in fine.resolution)
    result = []
    for steps in np.ndindex(*(int(n) for n in ratio[::-1])):
        x, y, z = (int(n) * a + d for n, a, d in zip(ratio, at, steps[::-1], strict=True))
        inside = (x < nx) & (y < ny) & (z < nz)
        result.append((dr.select(inside, fine.index(x, y, z), 0), inside))
    return result
