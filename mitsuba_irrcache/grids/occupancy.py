"""Determine the voxels of a grid that lookups in a medium can read."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.grids.grid import Affine, Grid
from mitsuba_irrcache.grids.majorants import Macrocells

#: If fewer than this share of the voxels is active, they are determined more precisely, with
#: macrocells of this many voxels of the medium along an edge.
SPARSE_SHARE, SPARSE_CELL_SIZE = 0.3, 2


def marked(grid: Grid, voxels: mi.UInt32) -> mi.Bool:
    """Convert a list of voxels into a mask over all voxels of ``grid``."""
    marks = dr.zeros(mi.Bool, grid.voxel_count)
    if dr.width(voxels):
        dr.scatter(marks, mi.Bool(True), voxels)
    return marks


def dilated(grid: Grid, marks: mi.Bool) -> mi.Bool:
    """Extend a mask of the voxels of ``grid`` by all their neighbours, diagonal ones included."""
    voxel = dr.arange(mi.UInt32, grid.voxel_count)
    for axis in range(3):
        dr.eval(marks)
        found, place = mi.Bool(marks), list(grid.voxel_indices(voxel))
        at, last = place[axis], mi.UInt32(grid.sides[axis]) - 1
        for exists, beside in ((at > 0, at - 1), (at < last, at + 1)):
            place[axis] = beside
            found |= dr.gather(mi.Bool, marks, grid.index(*place), exists)
        marks = found
    return marks


def active_voxels(medium, grid: Grid) -> mi.UInt32:
    """Return the ascending flat indices of the voxels of ``grid`` that lookups at positions with
    sigma_t > 0 can read.

    Every macrocell that is not empty marks the voxels whose trilinear support may overlap it. If
    these are few, the computation is repeated with smaller macrocells.
    """
    cells = medium.macrocells
    occupied = dr.compress(cells.majorant > 0)
    if dr.width(occupied) == 0:
        return mi.UInt32()
    if cells.count == 1:
        return dr.arange(mi.UInt32, grid.voxel_count)
    marked = _mark(cells, occupied, grid)
    if dr.width(marked) < SPARSE_SHARE * grid.voxel_count:
        cells = Macrocells.build(medium.sigma_t, medium.boundary, SPARSE_CELL_SIZE)
        marked = _mark(cells, dr.compress(cells.majorant > 0), grid)
    return marked


def occupied_box(grid: Grid, active: mi.UInt32) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest box, (lower, upper) in (x, y, z), around the ``active`` voxels."""
    ends = [(dr.min(p), dr.max(p)) for p in grid.voxel_indices(active)]
    dr.eval(ends)
    return np.array([int(e[0][0]) for e in ends]), np.array([int(e[1][0]) + 1 for e in ends])


def _supports(cells, occupied: mi.UInt32, grid: Grid) -> tuple[list[mi.Int32], list[mi.Int32]]:
    """Return first and last voxel along x, y, z whose trilinear support overlaps each macrocell."""
    nz, ny, nx = cells.shape
    index = unravelled(occupied, [Divisor(nx), Divisor(ny)])
    to_voxels = grid.coordinates.matrix @ np.linalg.inv(cells.coordinates.matrix)
    # Border cells extend beyond their grid, whose values are clamped: extend them to the cache's
    # bounds.
    corners = np.array(list(np.ndindex(2, 2, 2))) * grid.resolution
    to_cells = np.linalg.inv(to_voxels)
    reach = corners @ to_cells[:3, :3].T + to_cells[:3, 3]
    start, end = np.minimum(0.0, reach.min(axis=0)), np.maximum((nx, ny, nz), reach.max(axis=0))
    middle, half = [], []
    for i, n, least, most in zip(index, (nx, ny, nz), start, end, strict=True):
        low = dr.select(i == 0, dr.opaque(mi.Float, float(least)), mi.Float(i))
        high = dr.select(i == n - 1, dr.opaque(mi.Float, float(most)), mi.Float(i) + 1)
        middle.append(0.5 * (low + high))
        half.append(0.5 * (high - low))
    center = Affine(to_voxels).point(mi.Point3f(middle))
    first, last = [], []
    for side, c, row in zip(grid.sides, center, np.abs(to_voxels[:3, :3]), strict=True):
        extent = sum(dr.opaque(mi.Float, float(m)) * h for m, h in zip(row, half, strict=True))
        limit = mi.Float(side - 1)
        # Lookups at u in (i - 1/2, i + 3/2) read voxel i; border voxels are read beyond the grid,
        # too.
        first.append(mi.Int32(dr.clip(dr.floor(c - extent - 0.5 - 1e-3), 0, limit)))
        last.append(mi.Int32(dr.clip(dr.floor(c + extent + 0.5 + 1e-3), 0, limit)))
    return first, last


@symbolic
def _mark(cells: Macrocells, occupied: mi.UInt32, grid: Grid) -> mi.UInt32:
    """Return the voxels that a lookup in the ``occupied`` cells can read."""
    (x0, y0, z0), (x1, y1, z1) = _supports(cells, occupied, grid)
    marks = dr.zeros(mi.UInt32, grid.voxel_count)
    x, y, z = mi.Int32(x0), mi.Int32(y0), mi.Int32(z0)
    active = mi.Bool(True)
    while dr.hint(active, label="active voxels"):
        dr.scatter(marks, mi.UInt32(1), grid.index(x, y, z), active)
        x += 1
        wrap_x = x > x1
        x = dr.select(wrap_x, x0, x)
        y = dr.select(wrap_x, y + 1, y)
        wrap_y = y > y1
        y = dr.select(wrap_y, y0, y)
        z = dr.select(wrap_y, z + 1, z)
        active &= z <= z1
    return dr.compress(marks > 0)
