"""Empty space that tracks skip in one step, from a distance transform."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, unravelled
from mitsuba_irrcache.grids.distance_transform import chebyshev
from mitsuba_irrcache.grids.grid import Grid

#: Voxels along an edge of a cell, and the largest distance that is distinguished, in cells.
CELL, MAX_DISTANCE = 2, 12
#: Share of occupied cells above which all voxels are visited.
WORTHWHILE = 0.5


class EmptySpace:
    """Number of slices that tracks may advance in a box of voxels without passing a needed voxel.

    ``slices`` holds for each cell of `CELL`^3 voxels, x fastest, the number of slices that a track
    may advance from any voxel in it; 0 if the cell contains a needed voxel. Tracks move by at most
    one voxel along each transverse axis per slice, so this is a Chebyshev distance. Cells at the
    sides of the box count as needed, because tracks enter there. ``shape`` (z, y, x) is that of the
    cells.
    """

    def __init__(self, slices: mi.UInt32, shape: tuple[int, int, int]) -> None:
        self.slices = slices
        _, ny, nx = shape
        self.strides = 1, nx, nx * ny

    @staticmethod
    def find(
        grid: Grid, needed: mi.UInt32, lower: np.ndarray, upper: np.ndarray
    ) -> EmptySpace | None:
        """Create it for the box between ``lower`` and ``upper`` (x, y, z) of ``grid``.

        ``needed`` are flat indices of voxels. Returns None if too few cells are empty to save time.
        """
        sides = np.array(upper) - np.array(lower)
        shape = tuple(int(n) for n in -(-sides // CELL))[::-1]
        count = int(np.prod(shape))
        occupied = _occupied_cells(grid, needed, lower, shape)
        if dr.sum(occupied)[0] > WORTHWHILE * count:
            return None
        distance = _distances(occupied, sides, shape)
        there = dr.gather(mi.UInt32, occupied, dr.arange(mi.UInt32, count))
        # Only cells that are needed are 0; a track in any other one may advance by 1 at least.
        slices = dr.select(
            there > 0, 0, dr.select(distance > 0, (distance - 1) * CELL + 1, mi.UInt32(1))
        )
        dr.eval(slices)
        return EmptySpace(slices, shape)


def _occupied_cells(
    grid: Grid, needed: mi.UInt32, lower: np.ndarray, shape: tuple[int, ...]
) -> mi.UInt32:
    """Return 1 for each cell that contains a needed voxel, 0 for others."""
    _, ny, nx = (dr.opaque(mi.UInt32, n) for n in shape)
    occupied = dr.opaque(mi.UInt32, 0, int(np.prod(shape)))
    first = [dr.opaque(mi.UInt32, int(n)) for n in lower]
    x, y, z = ((a - n) // CELL for a, n in zip(grid.voxel_indices(needed), first, strict=True))
    dr.scatter(occupied, mi.UInt32(1), (z * ny + y) * nx + x)
    return occupied


def _distances(occupied: mi.UInt32, sides: np.ndarray, shape: tuple[int, ...]) -> mi.UInt32:
    """Return the Chebyshev distance of each cell to the nearest occupied one, or to the outside of
    the box.
    """
    _, ny, nx = (dr.opaque(mi.UInt32, n) for n in shape)
    # With a layer around that is outside, as is part of the last cell of an odd side.
    outer = [n + 2 for n in shape]
    _, oy, ox = (dr.opaque(mi.UInt32, n) for n in outer)
    index = dr.arange(mi.UInt32, int(np.prod(outer)))
    at = unravelled(index, [Divisor(n) for n in outer[:0:-1]])
    whole = [dr.opaque(mi.UInt32, int(n) // CELL) for n in sides]
    inside = mi.Bool(True)
    for a, n in zip(at, whole, strict=True):
        inside &= (a >= 1) & (a <= n)
    x, y, z = (a - 1 for a in at)
    there = dr.gather(mi.UInt32, occupied, (z * ny + y) * nx + x, inside)
    distance = chebyshev(~inside | (there > 0), tuple(outer), MAX_DISTANCE)
    index = dr.arange(mi.UInt32, int(np.prod(shape)))
    x, y, z = unravelled(index, [Divisor(n) for n in shape[:0:-1]])
    return dr.gather(mi.UInt32, distance, ((z + 1) * oy + y + 1) * ox + x + 1)
