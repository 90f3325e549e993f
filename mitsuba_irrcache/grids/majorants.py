"""Coarse cells over the extinction grid: local majorants, empty-space skipping, and a walk through
them.
"""

from __future__ import annotations

from functools import reduce

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor
from mitsuba_irrcache.grids.boundary import Boundary, safe_rcp
from mitsuba_irrcache.grids.fields import ConstantField, Field, GridField
from mitsuba_irrcache.grids.grid import Affine


class Macrocells:
    """Bounds of sigma_t [1/scene unit], over all channels, over blocks of voxels.

    Conservative under trilinear interpolation and clamping: the outermost cells reach to infinity.
    """

    def __init__(
        self,
        majorant: mi.Float,
        minorant: mi.Float,
        shape: tuple[int, int, int],
        coordinates: Affine,
    ) -> None:
        self.majorant = majorant
        self.minorant = minorant
        self.shape = shape
        self.coordinates = coordinates  #: world -> macrocell coordinates, 0 to n along each axis
        self.sides = tuple(dr.opaque(mi.Int32, n) for n in shape[::-1])

    @staticmethod
    def build(sigma_t: Field, boundary: Boundary | None, size: int = 0) -> Macrocells:
        """Blocks of ``size`` voxels along each edge (0: at least 4, at most 64 blocks); of a
        constant, one cell over the ``boundary``.
        """
        if isinstance(sigma_t, ConstantField):
            majorant = dr.opaque(mi.Float, sigma_t.maximum)
            minorant = dr.opaque(mi.Float, sigma_t.minimum)
            return Macrocells(majorant, minorant, (1, 1, 1), Affine(np.linalg.inv(boundary.frame)))
        grid = sigma_t.grid
        size = size or max(4, -(-max(grid.shape) // 64))
        shape = tuple(-(-n // size) for n in grid.shape)
        minorant, majorant = _block_bounds(sigma_t, size, shape)
        shrink = np.diag([1 / size] * 3 + [1.0])
        return Macrocells(majorant, minorant, shape, Affine(shrink @ grid.coordinates.matrix))

    @property
    def count(self) -> int:
        return int(np.prod(self.shape))

    def walk(self, ray: mi.Ray3f) -> Walk:
        """The constants of a walk along ``ray``."""
        return Walk(self, ray)


class Walk:
    """A ray in macrocell coordinates. The cell is kept as integers by the caller; nothing
    accumulates.
    """

    def __init__(self, cells: Macrocells, ray: mi.Ray3f) -> None:
        self.cells = cells
        self.origin = cells.coordinates.point(ray.o)
        self.direction = cells.coordinates.vector(ray.d)
        self.rcp = safe_rcp(self.direction)

    def cell(self, t: mi.Float) -> mi.Vector3i:
        """The cell that contains the point at distance ``t``."""
        u = dr.fma(self.direction, t, self.origin)
        limits = mi.Vector3i(*self.cells.sides) - 1
        # Clipped as floats first: a float beyond 2^31 has no integer.
        return mi.Vector3i(dr.clip(dr.floor(u), 0.0, mi.Vector3f(limits)))

    def index(self, cell: mi.Vector3i) -> mi.UInt32:
        nx, ny, _ = self.cells.sides
        return mi.UInt32((cell.z * ny + cell.y) * nx + cell.x)

    def majorant(self, cell: mi.Vector3i, active: mi.Bool) -> mi.Float:
        return dr.gather(mi.Float, self.cells.majorant, self.index(cell), active)

    def minorant(self, cell: mi.Vector3i, active: mi.Bool) -> mi.Float:
        return dr.gather(mi.Float, self.cells.minorant, self.index(cell), active)

    def exit(self, cell: mi.Vector3i, t: mi.Float) -> tuple[mi.Float, mi.Vector3i]:
        """Distance, at least ``t``, at which the ray leaves ``cell``, and the cell behind.

        The distance is infinite for a border cell, which reaches that far.
        """
        forward = self.rcp > 0  # also tells 0 from -0, as the reciprocal does
        wall = mi.Vector3f(cell + dr.select(forward, 1, 0))
        limits = mi.Vector3i(*self.cells.sides) - 1
        last = dr.select(forward, cell >= limits, cell <= 0)
        distance = dr.select(last, dr.inf, (wall - self.origin) * self.rcp)
        nearest = dr.min(distance)
        step = dr.select(forward, mi.Vector3i(1), mi.Vector3i(-1))
        # Ties step along one axis only; the next call leaves through the other at the same
        # distance.
        on_x = distance.x == nearest
        on_y = ~on_x & (distance.y == nearest)
        on_z = ~on_x & ~on_y
        axis = mi.Vector3i(*(dr.select(on, 1, 0) for on in (on_x, on_y, on_z)))
        following = cell + dr.select(nearest < dr.inf, axis * step, 0)
        return dr.maximum(nearest, t), following


def _block_bounds(
    sigma_t: GridField, size: int, shape: tuple[int, int, int]
) -> tuple[mi.Float, mi.Float]:
    """Least and largest value in each block grown by the one voxel that trilinear stencils reach
    beyond it.
    """
    channels = sigma_t.channels
    least = largest = sigma_t.data
    # Channels first, then axis by axis: windows overlap, so this reads less than blocks would.
    if channels > 1:
        index = dr.arange(mi.UInt32, sigma_t.grid.voxel_count) * channels
        values = [dr.gather(mi.Float, sigma_t.data, index + c) for c in range(channels)]
        least, largest = reduce(dr.minimum, values), reduce(dr.maximum, values)
        dr.eval(least, largest)
    sides = list(sigma_t.grid.shape[::-1])
    for axis in range(3):
        least, largest = _reduced(least, largest, sides, axis, size, shape[2 - axis])
        sides[axis] = shape[2 - axis]
    # A little slack, since interpolation may round beyond its eight values.
    least, largest = least * sigma_t.scale * (1 - 1e-6), largest * sigma_t.scale * (1 + 1e-6)
    dr.eval(least, largest)
    return least, largest


def _reduced(
    least: mi.Float, largest: mi.Float, sides: list[int], axis: int, size: int, count: int
) -> tuple[mi.Float, mi.Float]:
    """Bounds of ``count`` windows along one axis, each of ``size`` values and one more at both
    ends; at first both are bounds of the same array.
    """
    stride, side = int(np.prod(sides[:axis])), sides[axis]
    index = dr.arange(mi.UInt32, int(np.prod(sides)) // side * count)
    row, within = Divisor(stride).split(index)
    behind, window = Divisor(count).split(row)
    before, sides_here = (dr.opaque(mi.UInt32, n) for n in (stride, side))
    start = within + behind * (before * sides_here)
    first = mi.Int32(window * size) - 1
    places = [
        start + mi.UInt32(dr.clip(first + k, 0, mi.Int32(sides_here) - 1)) * before
        for k in range(size + 2)
    ]
    low = [dr.gather(mi.Float, least, place) for place in places]
    high = low if least is largest else [dr.gather(mi.Float, largest, place) for place in places]
    bounds = reduce(dr.minimum, low), reduce(dr.maximum, high)
    dr.eval(bounds)
    return bounds
