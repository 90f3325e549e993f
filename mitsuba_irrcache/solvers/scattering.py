"""All orders of scattering, from sweeps on a hierarchy of grids.

The irradiance of scattered light solves phi = A phi + b. A takes irradiance to the light that it
scatters, phi -> albedo phi / (4 pi), carried by one sweep over a fixed set of directions; b is the
light that was scattered once. Iterating this (source iteration) adds an order per sweep: in dense,
white matter thousands. What is slow to converge is smooth, and smooth light is found on coarser
grids by the same means: errors are corrected there, grid by grid (multigrid).
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grid import Grid, stencil
from mitsuba_irrcache.solvers.lattice import Lattice
from mitsuba_irrcache.solvers.table import Table

#: Voxels along the longest side of the coarsest grid, at most.
COARSEST = 20
#: Corrections on the finest grid, at most; there is one on the others.
CORRECTIONS = 12
#: Relative error of the finest solution that is left, and change of the coarsest one; if ``evenly``
#: of one that only corrects finer ones, whose error is looked at in any case.
TOLERANCE = 1e-3
COARSE_TOLERANCE, EVEN_TOLERANCE = 2e-4, 1e-2
#: Below all light.
TINY = 1e-300


class Level:
    """A grid of the hierarchy: extinction, albedo, the lines, and the next coarser level.

    ``sigma_t`` and ``albedo`` hold a value for each voxel; where light of several channels is to be
    scattered, which goes the same ways, the albedo has the values of one after those of the other.
    Coarser levels have half the voxels along those axes along which voxels are shortest, or along
    all if ``evenly``: errors between voxels far apart are found by sweeps, and those between near
    ones only on coarser grids.
    """

    def __init__(
        self,
        grid: Grid,
        sigma_t: mi.Float,
        albedo: mi.Float,
        lattice: Lattice,
        evenly: bool = False,
    ) -> None:
        self.grid, self.sigma_t, self.albedo, self.lattice = grid, sigma_t, albedo, lattice
        self.evenly = evenly
        self.channels = dr.width(albedo) // grid.voxel_count
        self._ratio = np.array([2, 2, 2]) if evenly else _ratio(grid)  # to the next level: x, y, z
        self._coarser: Level | None = None
        self._tolerance = COARSE_TOLERANCE
        self._children: list[tuple[mi.UInt32, mi.Float]] = []

    @property
    def coarsest(self) -> bool:
        return max(self.grid.shape) <= COARSEST

    @property
    def coarser(self) -> Level:
        """The level of fewer voxels, made when it is first asked for."""
        if self._coarser is None:
            grid = _reduced(self.grid, self._ratio)
            children = [
                (i, dr.gather(mi.Float, self.sigma_t, i) * w)
                for i, w in _children(self.grid, grid, self._ratio)
            ]
            total = sum(s for _, s in children)
            sigma_t = total / len(children)
            # The weights of the means that follow are shares of the extinction.
            shares = [(i, dr.select(total > 0, s / total, 0)) for i, s in children]
            self._children = self._of_all_channels(shares, grid.voxel_count)
            dr.eval(sigma_t, self._children)
            box = np.zeros(3, int), grid.resolution
            lattice = Lattice(grid, sigma_t, *box, pause=self.lattice.pause)
            albedo = self.restrict(self.albedo)
            self._coarser = self._coarse(grid, sigma_t, albedo, lattice)
            if self.evenly:
                self._coarser._tolerance = EVEN_TOLERANCE
        return self._coarser

    def _coarse(self, grid: Grid, sigma_t: mi.Float, albedo: mi.Float, lattice: Lattice) -> Level:
        return Level(grid, sigma_t, albedo, lattice, self.evenly)

    def restrict(self, values: mi.Float) -> mi.Float:
        """Means over the voxels of the coarser level, weighted by extinction."""
        result = sum(dr.gather(mi.Float, values, i) * w for i, w in self._children)
        dr.eval(result)
        return result

    def _of_all_channels(self, children: list, voxels: int) -> list:
        """The same children for each of the channels."""
        if self.channels == 1:
            return children
        layer, voxel = _layers(voxels, self.channels)
        before = layer * dr.opaque(mi.UInt32, self.grid.voxel_count)
        dr.eval(children)
        return [
            (dr.gather(mi.UInt32, i, voxel) + before, dr.gather(mi.Float, w, voxel))
            for i, w in children
        ]

    def prolong(self, values: mi.Float) -> mi.Float:
        """Values of the coarser level at the voxels of this one, trilinear."""
        layer, voxel = _layers(self.grid.voxel_count, self.channels)
        before = layer * dr.opaque(mi.UInt32, self.coarser.grid.voxel_count)
        return self._interpolated(values, voxel, before)

    def _interpolated(self, values: mi.Float, voxel: mi.UInt32, before: mi.UInt32) -> mi.Float:
        """Values of the coarser level, from ``before`` on, at voxels of this one, trilinear."""
        axes, coarse = [], self.coarser.grid
        for at, n, sides in zip(self.grid.places(voxel), self._ratio, coarse.sides, strict=True):
            lower, weight, more = stencil((mi.Float(at) + 0.5) * dr.opaque(mi.Float, 1 / n), sides)
            axes.append(((lower, lower + dr.select(more, 1, 0)), weight))
        (xs, wx), (ys, wy), (zs, wz) = axes

        def along_x(y, z):
            ends = (dr.gather(mi.Float, values, coarse.index(x, y, z) + before) for x in xs)
            return dr.lerp(*ends, wx)

        return dr.lerp(*(dr.lerp(*(along_x(y, z) for y in ys), wy) for z in zs), wz)

    def scatter(self, phi: mi.Float | None, table: Table) -> tuple[mi.Float, mi.Float]:
        """A phi plus the light that enters along ``table``: irradiance, and the mean of it where it
        collides, which is what is scattered again.

        ``phi``, such a mean, may be None for 0.
        """
        count = self.grid.voxel_count * self.channels
        nothing = dr.zeros(mi.Float, count)
        sent = nothing if phi is None else phi * self.albedo * dr.inv_four_pi
        if self.channels > 1:
            # The channels of a voxel next to each other, and back below.
            index = dr.arange(mi.UInt32, count)
            voxel = index // self.channels
            layer = index - voxel * self.channels
            dr.eval(sent)
            place = layer * dr.opaque(mi.UInt32, self.grid.voxel_count) + voxel
            sent = dr.gather(mi.Float, sent, place)
        volume = dr.ravel(mi.Vector4f(sent, nothing, nothing, nothing))
        dr.eval(volume)
        if table.entering is not None and phi is not None:
            table.entering.receive(phi)
        self.lattice.scatter(volume, table)
        index = dr.arange(mi.UInt32, count)
        if self.channels > 1:
            layer, voxel = _layers(self.grid.voxel_count, self.channels)
            index = voxel * self.channels + layer
        source, phi, lost, depth = dr.gather(mi.Vector4f, volume, index)
        # Radiance of collisions times 4 pi, which is what 1 is, integrated over directions.
        collided = 4 * dr.pi * (source + lost / dr.select(depth > 0, depth, 1))
        collided = dr.select(depth > 0, collided, phi)
        dr.eval(phi, collided)
        return phi, collided

    def solve(
        self,
        b: mi.Float,
        directions: np.ndarray,
        weights: np.ndarray,
        offsets: np.ndarray,
        returning: Callable | None = None,
    ) -> mi.Float:
        """Solves phi = A phi + b for directions as in `Lattice.table`. ``returning``, if given,
        makes of a lattice and such a table of it the light that enters because phi is what it is.
        """
        dark = np.zeros((len(directions), 2))  # no light enters from outside
        tables, level = [], self
        while True:
            tables.append(level.lattice.table(directions, dark, weights, offsets))
            if returning is not None:
                tables[-1].entering = returning(level.lattice, tables[-1])
            if level.coarsest:
                break
            level = level.coarser
        phi = self._guess(b, tables)
        change, scale = np.inf, self._sums(b)
        light = scale.max() > 0
        for _ in range(CORRECTIONS if not self.coarsest and light else 0):
            before, phi = phi, self.correct(phi, b, tables)
            scale = self._sums(phi)
            last, change = change, self._sums(phi - before)
            # Errors fall by about the same factor each time. It is not trusted to stay as small as
            # it may be at first: what converges last shows last.
            factor = np.clip(change / np.maximum(last, TINY), 0.5, 0.95)
            left = (change * factor / (1 - factor) / np.maximum(scale, TINY)).max()
            mi.Log(mi.LogLevel.Debug, f"irrcache: light of further orders known to {left:.1e}")
            if left <= TOLERANCE:
                break
        else:
            if not self.coarsest and light:
                mi.Log(
                    mi.LogLevel.Warn,
                    f"irrcache: light of high orders of scattering is known to {left:.1e} only",
                )
        return phi

    def _sums(self, values: mi.Float) -> np.ndarray:
        """Of the absolute values of each channel."""
        voxels = self.grid.voxel_count
        place = dr.arange(mi.UInt32, voxels)
        parts = [values]
        if self.channels > 1:
            starts = (dr.opaque(mi.UInt32, c * voxels) for c in range(self.channels))
            parts = [dr.gather(mi.Float, values, place + start) for start in starts]
        return np.array([float(dr.sum(dr.abs(part))[0]) for part in parts])

    def correct(self, phi: mi.Float, b: mi.Float, tables: list[Table]) -> mi.Float:
        """A sweep, and the correction of its error on the coarser level; ``tables`` are those of
        this level and of all coarser ones.
        """
        table, *coarse = tables
        swept = self.scatter(phi, table)[1] + b
        _, again = self.coarser.scatter(self.restrict(swept - phi), coarse[0])
        result = swept + self.prolong(self.coarser._approximate(again, coarse))
        dr.eval(result)
        return result

    def _approximate(self, b: mi.Float, tables: list[Table]) -> mi.Float:
        """About the solution, by a single correction on each level."""
        phi = self._guess(b, tables)
        return phi if self.coarsest else self.correct(phi, b, tables)

    def _guess(self, b: mi.Float, tables: list[Table]) -> mi.Float:
        """The solution as the coarser level sees it; on the coarsest, the solution."""
        if self.coarsest:
            return self._iterate(b, tables[0])
        coarser = self.coarser  # made before anything is restricted to it
        return self.prolong(coarser._approximate(self.restrict(b), tables[1:]))

    def _iterate(self, b: mi.Float, table: Table) -> mi.Float:
        """Source iteration with Anderson's acceleration on few voxels."""
        known = np.array(b, dtype=np.float64).reshape(self.channels, -1)
        phi, history = known.copy(), []
        scale = np.abs(known).mean(axis=1)
        for _ in range(200):
            # As lists: NumPy's memory would be borrowed, and kernels differ with its alignment.
            scattered = np.array(self.scatter(mi.Float(phi.ravel().tolist()), table)[1])
            image = scattered.reshape(known.shape) + known
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
            phi = np.array([_mixed(history, c) for c in range(self.channels)])
        return mi.Float(image.ravel().tolist())


def _mixed(history: list, channel: int) -> np.ndarray:
    """The combination of images that leaves the least residual (Anderson's mixing)."""
    points, images = (np.array([x[channel] for x in xs]) for xs in zip(*history, strict=True))
    residuals = images - points
    if len(history) == 1:
        return images[0]
    differences = (residuals[:-1] - residuals[-1]).T
    share, *_ = np.linalg.lstsq(differences, -residuals[-1], rcond=1e-8)
    return images[-1] + share @ (images[:-1] - images[-1])


def _layers(voxels: int, channels: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Channel and voxel of all values of several channels."""
    index = dr.arange(mi.UInt32, voxels * channels)
    layer = index // dr.opaque(mi.UInt32, voxels)
    return layer, index - layer * dr.opaque(mi.UInt32, voxels)


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


def _children(fine: Grid, coarse: Grid, ratio: np.ndarray) -> list[tuple[mi.UInt32, mi.Float]]:
    """For each place of fine voxels in a coarse one the voxel there, and 1, or 0 where there is
    none.
    """
    at = coarse.places(dr.arange(mi.UInt32, coarse.voxel_count))
    nx, ny, nz = (int(n) for n in fine.resolution)
    result = []
    for steps in np.ndindex(*(int(n) for n in ratio[::-1])):
        x, y, z = (int(n) * a + d for n, a, d in zip(ratio, at, steps[::-1], strict=True))
        inside = (x < nx) & (y < ny) & (z < nz)
        place = dr.select(inside, fine.index(x, y, z), 0)
        result.append((place, dr.select(inside, mi.Float(1), 0)))
    return result
