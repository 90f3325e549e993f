"""Lookups between voxels that lie on different sides of surfaces.

Interpolation in a cell, the box between eight voxel centres, would mix the irradiance of both sides
of a surface that cuts it. `CellSides` divides each cut cell by planes into regions; a lookup
weights only those corners that are visible from its own region.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import ExtendedField, Extension, RootField
from mitsuba_irrcache.scene.cell_sides import (
    CORNERS,
    PER_WORD,
    WORDS,
    CellSides,
    planes_of,
    region_of,
)

#: Smallest weight of a corner, so that those used have weights if a lookup is at another one.
LEAST_WEIGHT = 1e-6


class CutCells:
    """The cells of a cache over ``grid`` that surfaces intersect, with the planes that divide them.

    Surfaces that bound ``medium``, if given, are ignored.
    """

    def __init__(self, scene: mi.Scene, grid: Grid, medium: mi.MediumPtr | None = None) -> None:
        self.grid = Extension(grid).grid  #: the grid that lookups interpolate on
        self.cells = tuple(n - 1 for n in self.grid.sides)
        sides = CellSides(scene, self.grid, medium)
        #: number of cut cells; without any, no lookups are corrected
        self.count = dr.width(sides.found)
        if not self.count:
            return
        self._number = dr.zeros(mi.UInt32, int((self.grid.resolution - 1).prod()))
        dr.scatter(self._number, dr.arange(mi.UInt32, self.count) + 1, sides.found)
        self._planes, self._curvatures = sides.planes, sides.curvatures
        self._corners = sides.corners
        dr.eval(self._number, self._planes, self._curvatures, self._corners)

    @symbolic
    def corrected(
        self, field: RootField | ExtendedField, p: mi.Point3f, phi: mi.Float | mi.Color3f, active
    ):
        """Correct ``phi``, the value of ``field`` at the world position ``p``, in cut cells.

        There it becomes the mean of the voxels that are visible from the region around ``p``.
        """
        s = self._clamped(p)
        cell = self._cell(s)
        lower = mi.Vector3i(cell)
        index = mi.UInt32((lower.z * self.cells[1] + lower.y) * self.cells[0] + lower.x)
        number = dr.gather(mi.UInt32, self._number, index, active)
        if active & (number > 0):
            record = number - 1
            planes = planes_of(self._planes, self._curvatures, record)
            region = region_of(planes, s, cell + 0.5)
            word = dr.gather(mi.UInt32, self._corners, record * WORDS + region // PER_WORD)
            corners = word >> (8 * (region % PER_WORD))
            phi = self._mean(field, corners, s, lower, phi)
        return phi

    def _clamped(self, p: mi.Point3f) -> mi.Point3f:
        """Convert a world position to voxels, 0 at the centre of the first one, clamped."""
        u = self.grid.coordinates.point(p) - 0.5
        last = mi.Point3f([mi.Float(n) for n in self.cells])
        return dr.minimum(dr.maximum(u, 0), last)

    def _cell(self, s: mi.Point3f) -> mi.Vector3f:
        """Return the cell that contains ``s``; the last one at the upper border."""
        return dr.minimum(dr.floor(s), mi.Vector3f([mi.Float(n - 1) for n in self.cells]))

    def _mean(
        self,
        field: RootField | ExtendedField,
        corners: mi.UInt32,
        s: mi.Point3f,
        lower: mi.Vector3i,
        phi: mi.Float | mi.Color3f,
    ) -> mi.Float | mi.Color3f:
        """Return the mean, with trilinear weights at ``s``, of the voxels at those corners of a
        cell whose bit in ``corners`` is set; 0 if there is none.

        The type of the result is that of ``phi``.
        """
        fraction = s - mi.Point3f(lower)
        nx, ny, _ = self.grid.sides
        total, weights = dr.zeros(type(phi)), mi.Float(0)
        for i, corner in enumerate(CORNERS):
            place = [n + c for n, c in zip(lower, corner, strict=True)]
            parts = [f if c else 1 - f for f, c in zip(fraction, corner, strict=True)]
            weight = dr.maximum(parts[0] * parts[1] * parts[2], LEAST_WEIGHT)
            weight = dr.select((corners >> i) & 1 > 0, weight, 0)
            value = _roots(field, mi.UInt32((place[2] * ny + place[1]) * nx + place[0]))
            total += weight * value
            weights += weight
        return field.decoded(total / dr.maximum(weights, LEAST_WEIGHT))


def _roots(field: RootField | ExtendedField, voxel: mi.UInt32) -> mi.Float | mi.Color3f:
    """Return the stored values, square roots for a `RootField`, of voxels."""
    n = field.channels
    values = [dr.gather(mi.Float, field.data, voxel * n + c) for c in range(n)]
    return values[0] if n == 1 else mi.Color3f(values)
