"""All orders of scattering, from sweeps on a hierarchy of grids.

The irradiance of scattered light solves phi = A phi + b. A takes irradiance to the light that it
scatters, phi -> albedo phi / (4 pi), carried by one sweep over a fixed set of directions; b is the
light that was scattered once. Iterating this (source iteration) adds an order per sweep: in dense,
white matter thousands. What is slow to converge is smooth, and smooth light is found on coarser
grids by the same means: errors are corrected there, grid by grid (multigrid).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.grid import Grid, stencil
from mitsuba_irrcache.solvers.discrete_ordinates.anderson import TINY, AndersonAcceleration, mixed
from mitsuba_irrcache.solvers.discrete_ordinates.layout import voxel_and_channel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Voxels along the longest side of the coarsest grid, at most.
COARSEST = 20
#: Corrections on the finest grid, at most; there is one on the others.
CORRECTIONS = 12
#: Optical depth of a voxel from which on what lines lose in it tells of its collisions.
HARDLY = 1e-2
#: Relative error of the finest solution that is left; and changes with which that of few voxels is
#: done, and one that only corrects finer ones, whose error is looked at in any case.
TOLERANCE = 2e-3
FEW_TOLERANCE, COARSE_TOLERANCE = 2e-4, 3e-2


class MultigridLevel:
    """A grid of the hierarchy: extinction, albedo, the lines, and the next coarser level.

    ``sigma_t`` and ``albedo``, as all light, have a value for each voxel that the ``lattice``
    wants, outside of which there is no matter; where light of several channels is to be scattered,
    which goes the same ways, albedo and light have those of a voxel next to each other. Coarser
    levels have half the voxels along those axes along which voxels are shortest, or along all if
    ``evenly``: errors between voxels far apart are found by sweeps, and those between near ones
    only on coarser grids.
    """

    def __init__(
        self, sigma_t: mi.Float, albedo: mi.Float, lattice: Tracks, evenly: bool = False
    ) -> None:
        self.sigma_t, self.albedo, self.lattice = sigma_t, albedo, lattice
        self.grid, self.evenly = lattice.grid, evenly
        self.channels = dr.width(albedo) // lattice.active_count
        # to the next level: x, y, z
        self._ratio = np.array([2, 2, 2]) if evenly else _ratio(self.grid)
        self._coarser: MultigridLevel | None = None
        self._tolerance = FEW_TOLERANCE
        self._children: list[tuple[mi.UInt32, mi.Float]] = []

    @property
    def coarsest(self) -> bool:
        return max(self.grid.shape) <= COARSEST

    @property
    def coarser(self) -> MultigridLevel:
        """The level of fewer voxels, made when it is first asked for."""
        if self._coarser is None:
            grid, lines = _reduced(self.grid, self._ratio), self.lattice
            wanted = None if lines.all_active else self._around(grid)
            children = []
            for voxel, inside in _children(self.grid, grid, self._ratio):
                place = lines.active_index(voxel)
                inside &= place < dr.opaque(mi.UInt32, lines.active_count)
                extinction = dr.gather(mi.Float, self.sigma_t, place, inside)
                children.append((dr.select(inside, place, 0), extinction))
            total = sum(s for _, s in children)
            sigma_t = total / len(children)
            # The weights of the means that follow are shares of the extinction.
            shares = [(i, dr.select(total > 0, s / total, 0)) for i, s in children]
            dr.eval(sigma_t, shares)
            box = np.zeros(3, int), grid.resolution
            lattice = Tracks(grid, sigma_t, *box, None, wanted, lines.sparse, lines.pause)
            wanted = lattice.active
            sigma_t = dr.gather(mi.Float, sigma_t, wanted)
            self._children = [
                (dr.gather(mi.UInt32, i, wanted), dr.gather(mi.Float, w, wanted)) for i, w in shares
            ]
            dr.eval(sigma_t, self._children)
            self._coarser = self._coarse(sigma_t, self._restricted(self.albedo, lattice), lattice)
            self._coarser._tolerance = COARSE_TOLERANCE
        return self._coarser

    def _coarse(self, *arguments: object) -> MultigridLevel:
        return MultigridLevel(*arguments, self.evenly)

    def _around(self, coarse: Grid) -> mi.UInt32:
        """The voxels of a ``coarse`` grid that wanted ones lie between."""
        marks = dr.opaque(mi.Bool, False, coarse.voxel_count)
        axes = [ends for ends, _ in self._stencil(coarse, self.lattice.active)]
        for at in product(*axes):
            dr.scatter(marks, mi.Bool(True), coarse.index(*at))
        return dr.compress(marks)

    def _stencil(self, coarse: Grid, voxel: mi.UInt32) -> list[tuple]:
        """Along x, y, z the two voxels of a ``coarse`` grid around each ``voxel``, and the weight
        of the upper.
        """
        axes, places = [], self.grid.places(voxel)
        for at, n, sides in zip(places, self._ratio, coarse.sides, strict=True):
            lower, weight, more = stencil((mi.Float(at) + 0.5) * dr.opaque(mi.Float, 1 / n), sides)
            axes.append(((lower, lower + dr.select(more, 1, 0)), weight))
        return axes

    def restrict(self, values: mi.Float) -> mi.Float:
        """Means over the voxels of the coarser level, weighted by extinction."""
        return self._restricted(values, self.coarser.lattice)

    def _restricted(self, values: mi.Float, coarse: Tracks) -> mi.Float:
        place, channel = voxel_and_channel(coarse.active_count, self.channels)
        result = mi.Float(0)
        for i, w in self._children:
            child = dr.gather(mi.UInt32, i, place) * self.channels + channel
            result += dr.gather(mi.Float, values, child) * dr.gather(mi.Float, w, place)
        dr.eval(result)
        return result

    def prolong(self, values: mi.Float) -> mi.Float:
        """Values of the coarser level at the voxels of this one, trilinear."""
        place, channel = voxel_and_channel(self.lattice.active_count, self.channels)
        return self._interpolated(values, place, self.channels, channel)

    def _interpolated(
        self, values: mi.Float, place: mi.UInt32, step: int, begin: mi.UInt32
    ) -> mi.Float:
        """Values of the coarser level, each ``step`` of them from ``begin`` on, at places of this
        one, trilinear.
        """
        coarse = self.coarser.lattice
        voxel = dr.gather(mi.UInt32, self.lattice.active, place)
        (xs, wx), (ys, wy), (zs, wz) = self._stencil(coarse.grid, voxel)

        def along_x(y, z):
            at = (coarse.active_index(coarse.grid.index(x, y, z)) for x in xs)
            return dr.lerp(*(dr.gather(mi.Float, values, p * step + begin) for p in at), wx)

        return dr.lerp(*(dr.lerp(*(along_x(y, z) for y in ys), wy) for z in zs), wz)

    def scatter(self, phi: mi.Float | None, table: TrackTable) -> tuple[mi.Float, mi.Float]:
        """A phi plus the light that enters along ``table``: irradiance, and the mean of it where it
        collides, which is what is scattered again.

        ``phi``, such a mean, may be None for 0.
        """
        lattice = self.lattice
        place, channel = voxel_and_channel(lattice.active_count, self.channels)
        slot = dr.gather(mi.UInt32, lattice.active, place) * self.channels + channel
        volume = dr.opaque(mi.Float, 0, self.grid.voxel_count * self.channels * 4)
        if phi is not None:
            sent = phi * self.albedo * dr.inv_four_pi
            dr.scatter(volume, mi.Vector4f(sent, 0, 0, 0), slot)
            dr.eval(volume)
            if table.boundary_source is not None:
                table.boundary_source.receive(phi)
        lattice.sweep(volume, table)
        source, phi, lost, depth = dr.gather(mi.Vector4f, volume, slot)
        # Radiance of collisions times 4 pi, which is what 1 is, integrated over directions.
        collided = 4 * dr.pi * (source + lost / dr.select(depth > 0, depth, 1))
        collided = self.known_from(depth, collided, phi)
        dr.eval(phi, collided)
        return phi, collided

    def known_from(self, depth: mi.Float, collided: mi.Float, received: mi.Float) -> mi.Float:
        """The light of collisions: what lines tell by what they lose, ``collided``, or all that is
        ``received`` where they hardly find matter, their ``depth`` integrated over directions.
        There the lines of suns find other matter, and would be as bright as that is more; and thin
        matter sees the light that there is.
        """
        size = float(self.grid.voxel_size.min()) / (4 * np.pi * HARDLY)
        found = dr.square(depth * dr.opaque(mi.Float, size))
        return dr.select(found < 1, dr.lerp(received, collided, found), collided)

    def seen(self, phi: mi.Float, place: mi.UInt32, heading: mi.Vector3f | None) -> mi.Float:
        """4 pi times the radiance that rays along ``heading`` see scattered from ``phi`` at a
        ``place`` of it, per albedo.
        """
        return dr.gather(mi.Float, phi, place)

    def passed_on(self, phi: mi.Float, rows: Sequence[np.ndarray], sets: int) -> mi.Float:
        """About A phi, irradiance, along ``rows`` of so many ``sets`` of directions: found on the
        coarser level, if there is one.
        """
        directions, light, weights, offsets = rows
        coarse = self if self.coarsest else self.coarser
        table = coarse.lattice.table(directions, light, weights / sets, offsets)
        if self.coarsest:
            return self.scatter(phi, table)[0]
        return self.prolong(coarse.scatter(self.restrict(phi), table)[0])

    def tables(
        self, rows: Sequence[np.ndarray], returning: Callable | None = None
    ) -> list[TrackTable]:
        """Those of this level and of all coarser ones for ``rows`` as in `Tracks.table`, along
        which no light enters from outside. ``returning``, if given, makes of a level and such a
        table of it the light that enters because phi is what it is.
        """
        tables, level = [], self
        while True:
            tables.append(level.lattice.table(*rows))
            if returning is not None:
                tables[-1].boundary_source = returning(level, tables[-1])
            if level.coarsest:
                return tables
            level = level.coarser

    def solve(
        self,
        b: mi.Float,
        rows: Sequence[np.ndarray],
        returning: Callable | None = None,
        tolerance: float = 1.0,
    ) -> mi.Float:
        """Solves phi = A phi + b for ``rows`` and ``returning`` as of `tables`, ``tolerance`` times
        as exactly as is promised.
        """
        tables = self.tables(rows, returning)
        phi = self._guess(b, tables)
        change, light = np.inf, self._sums(dr.abs(b)).max() > 0
        mixing = AndersonAcceleration(self._sums)
        for _ in range(CORRECTIONS if not self.coarsest and light else 0):
            corrected = self.correct(phi, b, tables)
            scale = self._sums(dr.abs(corrected))
            last, change = change, self._sums(dr.abs(corrected - phi))
            # Errors fall by about the same factor each time. It is not trusted to stay as small as
            # it may be at first: what converges last shows last.
            factor = np.clip(change / np.maximum(last, TINY), 0.5, 0.95)
            left = (change * factor / (1 - factor) / np.maximum(scale, TINY)).max()
            mi.Log(mi.LogLevel.Debug, f"irrcache: light of further orders known to {left:.1e}")
            phi = mixing.next(phi, corrected)
            if left <= TOLERANCE * tolerance:
                break
        else:
            if not self.coarsest and light:
                mi.Log(
                    mi.LogLevel.Warn,
                    f"irrcache: light of high orders of scattering is known to {left:.1e} only",
                )
        return phi

    def _sums(self, values: mi.Float) -> np.ndarray:
        """Of ``values``, weighted with how much of the light in a voxel is scattered there, for
        each channel.
        """
        channels, voxels = self.channels, dr.opaque(mi.UInt32, self.lattice.active_count)
        place = dr.arange(mi.UInt32, dr.width(values) // channels)
        voxel = place % voxels
        weight, sums = dr.gather(mi.Float, self.sigma_t, voxel), []
        for c in range(channels):
            value = dr.gather(mi.Float, values, place * channels + c)
            albedo = dr.gather(mi.Float, self.albedo, voxel * channels + c)
            sums.append(dr.sum(value * albedo * weight))
        dr.eval(sums)
        return np.array([float(total[0]) for total in sums])

    def correct(self, phi: mi.Float, b: mi.Float, tables: list[TrackTable]) -> mi.Float:
        """A sweep, and the correction of its error."""
        return self.corrected(phi, self.scatter(phi, tables[0])[1] + b, tables[1:])

    def corrected(self, phi: mi.Float, swept: mi.Float, coarse: list[TrackTable]) -> mi.Float:
        """What a sweep has made of ``phi``, the errors that are left of which are found on the
        coarser level, with tables of it and those below; there is none under the coarsest.
        """
        if self.coarsest:
            return swept
        _, again = self.coarser.scatter(self.restrict(swept - phi), coarse[0])
        result = swept + self.prolong(self.coarser._approximate(again, coarse))
        dr.eval(result)
        return result

    def _approximate(self, b: mi.Float, tables: list[TrackTable]) -> mi.Float:
        """About the solution, by a single correction on each level."""
        return self._iterate(b, tables[0]) if self.coarsest else self.correct(b, b, tables)

    def _guess(self, b: mi.Float, tables: list[TrackTable]) -> mi.Float:
        """The solution as the coarser level sees it; on the coarsest, the solution."""
        if self.coarsest:
            return self._iterate(b, tables[0])
        coarser = self.coarser  # made before anything is restricted to it
        return self.prolong(coarser._approximate(self.restrict(b), tables[1:]))

    def _iterate(self, b: mi.Float, table: TrackTable) -> mi.Float:
        """Source iteration with Anderson's acceleration on few voxels."""
        known = np.array(b, dtype=np.float64).reshape(-1, self.channels).T
        phi, history = known.copy(), []
        scale = np.abs(known).mean(axis=1)
        for _ in range(200):
            # As lists: NumPy's memory would be borrowed, and kernels differ with its alignment.
            scattered = np.array(self.scatter(mi.Float(phi.T.ravel().tolist()), table)[1])
            image = scattered.reshape(-1, self.channels).T + known
            history.append((phi, image))
            history = history[-6:]
            residual = image - phi
            if not np.isfinite(residual).all():
                raise IrrcacheError(
                    "irrcache: the light in the medium is not finite in single precision; lower "
                    "the radiance of the emitters (light of the first order: "
                    f"{scale.max():.1e} on average)."
                )
            if (np.abs(residual).mean(axis=1) <= self._tolerance * scale).all():
                break
            phi = np.array([mixed(history, c) for c in range(self.channels)])
        return mi.Float(image.T.ravel().tolist())


def _ratio(grid: Grid) -> np.ndarray:
    """Voxels along x, y, z of which one of the next level is made: two where they are less than
    twice as long as the shortest, of those axes that have several.
    """
    several = grid.resolution > 1
    shortest = grid.voxel_size[several].min() if several.any() else 0.0
    return np.where(several & (grid.voxel_size < 2 * shortest), 2, 1)


def _reduced(grid: Grid, ratio: np.ndarray) -> Grid:
    """The grid of voxels so many times as large; it may reach beyond the end of ``grid``."""
    sides = -(-grid.resolution // ratio)
    scale = ratio * sides / grid.resolution
    return Grid(tuple(int(n) for n in sides[::-1]), grid.to_world @ np.diag([*scale, 1.0]))


def _children(fine: Grid, coarse: Grid, ratio: np.ndarray) -> list[tuple[mi.UInt32, mi.Bool]]:
    """For each place of fine voxels in a coarse one the voxel there, and whether there is one."""
    at = coarse.places(dr.arange(mi.UInt32, coarse.voxel_count))
    nx, ny, nz = (int(n) for n in fine.resolution)
    result = []
    for steps in np.ndindex(*(int(n) for n in ratio[::-1])):
        x, y, z = (int(n) * a + d for n, a, d in zip(ratio, at, steps[::-1], strict=True))
        inside = (x < nx) & (y < ny) & (z < nz)
        result.append((dr.select(inside, fine.index(x, y, z), 0), inside))
    return result
