"""The extinction in the form that tracks read.

Values are dithered to 16 bits, in the same way for all batches, and stored together with their
neighbours, so that bilinear interpolation needs a single memory access.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.sequences import golden_words, unit_floats
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.layout import (
    coordinates_of,
    flat_index,
    slicewise,
    strides_of,
)

#: Largest optical depth of a voxel that the quantised extinction represents; larger values are
#: clamped. Others are rounded up or down (`_dithered`) to one of LEVELS + 1 levels.
MAX_OPTICAL_DEPTH = 16.0
LEVELS = (1 << 16) - 1
#: Optical depth of a voxel above which sweeps with a source use separate extinctions for its two
#: halves along the track. With one value for both, multiple scattering in a CT head with an optical
#: depth of 1.2 per voxel was too bright by 0.5 %.
DENSE = 0.5


class ExtinctionLayout:
    """Layout of the extinction on ``values_grid`` for tracks through the voxels of ``grid``, a grid
    over the same box.

    Values are integers below 2^16, in units of ``quantum`` [1/scene unit]. ``is_dense`` states that
    the extinction of both halves of a voxel is needed (see `DENSE`).
    """

    def __init__(self, grid: Grid, values_grid: Grid, quantum: float, is_dense: bool) -> None:
        self.grid, self.values_grid = grid, values_grid
        self.quantum, self._is_dense = quantum, is_dense

    def is_read_by_voxel(self, has_source: bool) -> bool:
        """Return whether sweeps read one value for each voxel of the grid."""
        return self.values_grid.shape == self.grid.shape and not (has_source and self._is_dense)

    def sides(self, axis: int) -> np.ndarray:
        """Return the number of values along x, y, z, for tracks with the dominant ``axis``.

        Along this axis there is one value per slice of the grid.
        """
        sides = self.values_grid.resolution.copy()
        sides[axis] = self.grid.resolution[axis]
        return sides

    def words(self, has_source: bool, by_rows: bool) -> int:
        """Return the number of 32-bit words per value in `Extinction.corners`: one (``by_rows``) or
        two if sweeps read one value per voxel, four for both halves of slices.
        """
        return (1 if by_rows else 2) if self.is_read_by_voxel(has_source) else 4


class Extinction:
    """The extinction ``sigma_t`` [1/scene unit] at all voxels of ``values_grid``, for tracks
    through the voxels of ``grid``, which lies over the same box.
    """

    def __init__(self, grid: Grid, values_grid: Grid, sigma_t: mi.Float) -> None:
        top, is_dense = largest_extinction(grid, float(dr.max(sigma_t)[0]))
        self.layout = ExtinctionLayout(grid, values_grid, top / LEVELS, is_dense)
        self._levels = _packed(quantised(sigma_t, top))
        self._halves: dict[int, mi.UInt32] = {}  # of slices, by axis

    def corners(self, axis: int, words: int) -> mi.UInt32:
        """Return, for each value in all slices along ``axis``, the four values around a track: the
        value and its upper neighbours along both transverse axes.

        Two ``words`` hold two values each; four words hold the means over both halves of a slice. A
        single word holds the two values of one row, and kernels read the row above separately,
        which needs half the memory.
        """
        sides = self.layout.sides(axis)
        if words < 4:
            values = None
        elif axis in self._halves:
            values = self._halves[axis]
        else:
            count = int(sides[axis])
            values = self._halves[axis] = _slice_halves(
                self._levels, self.layout.values_grid, count, axis
            )
        at = coordinates_of(sides, slicewise(axis))
        index, strides = flat_index(at, strides_of(sides)), strides_of(sides)
        steps = []
        for k in range(3):
            if k != axis:
                last = dr.opaque(mi.UInt32, int(sides[k]) - 1)
                steps.append(dr.select(at[k] < last, dr.opaque(mi.UInt32, strides[k]), 0))
        indices = [row + step for row in (index, index + steps[1]) for step in (0, steps[0])]
        if values is not None:
            return dr.ravel(mi.Array4u([dr.gather(mi.UInt32, values, i) for i in indices]))
        pairs = zip(indices[0::2], indices[1::2], strict=True)
        rows = [_level(self._levels, a) | _level(self._levels, b) << 16 for a, b in pairs]
        return rows[0] if words == 1 else dr.ravel(mi.Vector2u(rows))


def largest_extinction(grid: Grid, largest: float) -> tuple[float, bool]:
    """Return the extinction of the highest level, given the ``largest`` extinction, and whether
    voxels are dense (see `DENSE`).
    """
    slices = np.linalg.norm(grid.coordinates.matrix[:3, :3], axis=1).max()
    top = float(min(largest, MAX_OPTICAL_DEPTH * slices))
    return top, top > DENSE * slices


def quantised(sigma_t: mi.Float, top: float, first: int = 0) -> mi.UInt32:
    """Return the extinction as dithered integers, `LEVELS` for the extinction ``top``.

    ``first`` is the index of the first value in the dither sequence.
    """
    levels = sigma_t * dr.opaque(mi.Float, LEVELS / top if top else 0)
    return _dithered(dr.minimum(levels, LEVELS), first=first)


def _packed(values: mi.UInt32) -> mi.UInt32:
    """Pack integers below 2^16 into words: the first half of ``values`` in the lower 16 bits, the
    second half in the upper ones.
    """
    dr.eval(values)
    half = (dr.width(values) + 1) // 2
    index = dr.arange(mi.UInt32, half)
    later = index + dr.opaque(mi.UInt32, half)
    upper = dr.gather(mi.UInt32, values, later, later < dr.width(values))
    words = dr.gather(mi.UInt32, values, index) | upper << 16
    dr.eval(words)
    return words


def _level(words: mi.UInt32, index: mi.UInt32) -> mi.UInt32:
    """Return value ``index`` of the result of `_packed`."""
    half = dr.opaque(mi.UInt32, dr.width(words))
    later = index >= half
    word = dr.gather(mi.UInt32, words, dr.select(later, index - half, index))
    return dr.select(later, word >> 16, word & 0xFFFF)


def _dithered(values: mi.Float, shift: float = 0.0, first: int = 0) -> mi.UInt32:
    """Round to integers, up or down by a golden-ratio sequence (not at random).

    The result is correct on average over a few neighbours; rounding to the nearest integer would
    lose optically thin regions next to dense ones. ``first`` is the index of the first value in the
    sequence, ``shift`` in [0, 1) an offset of the sequence.
    """
    index = dr.arange(mi.UInt32, dr.width(values))
    index = index + dr.opaque(mi.UInt32, first & 0xFFFFFFFF) if first else index
    (dither,) = unit_floats([golden_words(index, int(shift * 2**32))])
    return mi.UInt32(dr.minimum(values + dither, LEVELS))


def _slice_halves(levels: mi.UInt32, grid: Grid, count: int, axis: int) -> mi.UInt32:
    """Resample the packed ``levels`` of the voxels of ``grid`` to ``count`` slices along ``axis``.

    Returns words with the mean over the first half of each slice's thickness in the lower, and over
    the second half in the upper 16 bits.
    """
    sides, strides = grid.resolution.copy(), strides_of(grid.resolution)
    before, sides[axis] = int(sides[axis]), count
    at = coordinates_of(sides)
    begin, at[axis] = mi.Float(at[axis]), mi.UInt32(0)
    rest, stride = flat_index(at, strides), dr.opaque(mi.UInt32, strides[axis])
    ratio, last = dr.opaque(mi.Float, before / count), dr.opaque(mi.Float, before - 1)
    # Two points in each half: exact where kinks of the linear interpolation, the centres of voxels,
    # lie between the points or at the ends. Each value is read once for all points.
    points = (0.125, 0.375, 0.625, 0.875)
    where = [dr.clip((begin + point) * ratio - 0.5, 0, last) for point in points]
    first, values = dr.floor(where[0]), [0.0] * len(points)
    for k in range(math.ceil(0.75 * before / count) + 2):
        slice_ = first + k
        level = mi.Float(_level(levels, rest + mi.UInt32(dr.minimum(slice_, last)) * stride))
        for i, u in enumerate(where):
            values[i] += dr.maximum(1 - dr.abs(u - slice_), 0) * level
    halves = [_dithered(0.5 * (values[2 * i] + values[2 * i + 1]), 0.5 * i) for i in range(2)]
    result = halves[0] | halves[1] << 16
    dr.eval(result)
    return result
