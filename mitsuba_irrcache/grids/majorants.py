"""Macrocells: coarse cells with extinction bounds for tracking and empty-space skipping."""

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
    """Bounds of sigma_t [1/scene unit], over all channels, for blocks of voxels.

    The bounds hold under trilinear interpolation and clamping; the outermost cells extend to
    infinity.
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
        self.coordinates = (
            coordinates  #: world position -> macrocell coordinates, 0 to n along each axis
        )
        self.sides = tuple(dr.opaque(mi.Int32, n) for n in shape[::-1])

    @staticmethod
    def build(sigma_t: Field, boundary: Boundary | None, size: int = 0) -> Macrocells:
        """Build macrocells of ``size`` voxels along each edge; one cell for a constant field.

        With ``size`` 0 cells have at least 4 voxels along an edge, and there are at most 64 along
        an axis. The cell of a constant field covers the ``boundary``.
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
        """Prepare the traversal of the macrocells along ``ray``."""
        return Walk(self, ray)


class Walk:
    """A ray in macrocell coordinates.

    The caller stores the current cell as integers, so that rounding errors do not accumulate.
    """

    def __init__(self, cells: Macrocells, ray: mi.Ray3f) -> None:
        self.cells = cells
        self.origin = cells.coordinates.point(ray.o)
        self.direction = cells.coordinates.vector(ray.d)
        self.rcp = safe_rcp(self.direction)

    def cell(self, t: mi.Float) -> mi.Vector3i:
        """Return the cell that contains the point at distance ``t``."""
        u = dr.fma(self.direction, t, self.origin)
        limits = mi.Vector3i(*self.cells.sides) - 1
        # Clamp before the conversion: floats beyond 2^31 cannot be converted to integers.
        return mi.Vector3i(dr.clip(dr.floor(u), 0.0, mi.Vector3f(limits)))

    def index(self, cell: mi.Vector3i) -> mi.UInt32:
        nx, ny, _ = self.cells.sides
        return mi.UInt32((cell.z * ny + cell.y) * nx + cell.x)

    def majorant(self, cell: mi.Vector3i, active: mi.Bool) -> mi.Float:
        return dr.gather(mi.Float, self.cells.majorant, self.index(cell), active)

    def minorant(self, cell: mi.Vector3i, active: mi.Bool) -> mi.Float:
        return dr.gather(mi.Float, self.cells.minorant, self.index(cell), active)

    def exit(self, cell: mi.Vector3i, t: mi.Float) -> tuple[mi.Float, mi.Vector3i]:
        """Return the distance, at least ``t``, at which the ray leaves ``cell``, and the next cell.

        The distance is infinite if the ray leaves the grid through ``cell``, which extends to
        infinity.
        """
        forward = self.rcp > 0  # distinguishes 0 from -0, as the reciprocal does
        wall = mi.Vector3f(cell + dr.select(forward, 1, 0))
        limits = mi.Vector3i(*self.cells.sides) - 1
        last = dr.select(forward, cell >= limits, cell <= 0)
        distance = dr.select(last, dr.inf, (wall - self.origin) * self.rcp)
        nearest = dr.min(distance)
        step = dr.select(forward, mi.Vector3i(1), mi.Vector3i(-1))
        # Ties step along one axis only; the next call leaves through the other face at the same
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
    """Return minimum and maximum over each block and the voxels next to it, which trilinear
    stencils may read.
    """
    channels = sigma_t.channels
    least = largest = sigma_t.data
    # Reduce the channels first, then axis by axis: windows overlap, so this reads less than blocks
    # would.
    if channels > 1:
        index = dr.arange(mi.UInt32, sigma_t.grid.voxel_count) * channels
        values = [dr.gather(mi.Float, sigma_t.data, index + c) for c in range(channels)]
        least, largest = reduce(dr.minimum, values), reduce(dr.maximum, values)
        dr.eval(least, largest)
    sides = list(sigma_t.grid.shape[::-1])
    for axis in range(3):
        least, largest = _window_bounds(least, largest, sides, axis, size, shape[2 - axis])
        sides[axis] = shape[2 - axis]
    # Widen the bounds, since interpolation may round beyond its eight values.
    least, largest = least * sigma_t.scale * (1 - 1e-6), largest * sigma_t.scale * (1 + 1e-6)
    dr.eval(least, largest)
    return least, largest


def _window_bounds(
    least: mi.Float, largest: mi.Float, sides: list[int], axis: int, size: int, count: int
) -> tuple[mi.Float, mi.Float]:
    """Return the bounds of ``count`` windows of ``size`` + 2 values along one axis.

    ``least`` and ``largest`` are the same array for the first axis.
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
