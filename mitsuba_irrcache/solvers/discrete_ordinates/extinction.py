"""The extinction as tracks read it: dithered to 16 bits, in the same way for all batches, with the
neighbours of each value beside it, so that one memory access suffices for bilinear interpolation.
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

#: Largest optical depth of a voxel that the quantised extinction distinguishes; values beyond are
#: clamped. Between 0 and the largest value they are rounded up or down (`_dithered`).
MAX_OPTICAL_DEPTH = 16.0
LEVELS = (1 << 16) - 1
#: Optical depth of a voxel from which on sweeps with a source distinguish the extinction of its two
#: halves. With one value for both, multiple scattering in a CT head of 1.2 per voxel was too bright
#: by 0.5 %.
DENSE = 0.5


class ExtinctionLayout:
    """Where tracks through the voxels of ``grid`` find the extinction, whose values are those of
    the voxels of ``values_grid``, which lies over the same box.

    Values are integers below 2^16, in units of ``quantum`` [1/scene unit]. ``is_dense``: collisions
    depend on how the extinction changes within a voxel.
    """

    def __init__(self, grid: Grid, values_grid: Grid, quantum: float, is_dense: bool) -> None:
        self.grid, self.values_grid = grid, values_grid
        self.quantum, self._is_dense = quantum, is_dense

    def is_read_by_voxel(self, has_source: bool) -> bool:
        """Whether sweeps read one value for each voxel of the grid."""
        return self.values_grid.shape == self.grid.shape and not (has_source and self._is_dense)

    def sides(self, axis: int) -> np.ndarray:
        """Values along x, y, z: one slice for each of the grid's along ``axis``."""
        sides = self.values_grid.resolution.copy()
        sides[axis] = self.grid.resolution[axis]
        return sides

    def words(self, has_source: bool, by_rows: bool) -> int:
        """How many words `Extinction.corners` holds for each value: one (by rows) or two where
        sweeps read one value for each voxel, four for both halves of slices.
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
        """For each value in all slices along ``axis`` the four values around a track: itself and
        its upper neighbours along both transverse axes.

        Two ``words`` hold two values each; four words hold the means over both halves of a slice; a
        single word holds the row of two, and the row above is read separately, which takes half as
        much memory in all.
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
    """The largest extinction that is distinguished where the ``largest`` one is this, and whether
    voxels are so dense that their halves differ.
    """
    slices = np.linalg.norm(grid.coordinates.matrix[:3, :3], axis=1).max()
    top = float(min(largest, MAX_OPTICAL_DEPTH * slices))
    return top, top > DENSE * slices


def quantised(sigma_t: mi.Float, top: float, first: int = 0) -> mi.UInt32:
    """The extinction of the voxels from number ``first`` on, in units of the quantum, of which
    ``top`` are `LEVELS`.
    """
    levels = sigma_t * dr.opaque(mi.Float, LEVELS / top if top else 0)
    return _dithered(dr.minimum(levels, LEVELS), first=first)


def _packed(values: mi.UInt32) -> mi.UInt32:
    """Two integers below 2^16 in each word: the first half of ``values``, and the second one."""
    dr.eval(values)
    half = (dr.width(values) + 1) // 2
    index = dr.arange(mi.UInt32, half)
    later = index + dr.opaque(mi.UInt32, half)
    upper = dr.gather(mi.UInt32, values, later, later < dr.width(values))
    words = dr.gather(mi.UInt32, values, index) | upper << 16
    dr.eval(words)
    return words


def _level(words: mi.UInt32, index: mi.UInt32) -> mi.UInt32:
    """Value ``index`` of those that `_packed` has packed."""
    half = dr.opaque(mi.UInt32, dr.width(words))
    later = index >= half
    word = dr.gather(mi.UInt32, words, dr.select(later, index - half, index))
    return dr.select(later, word >> 16, word & 0xFFFF)


def _dithered(values: mi.Float, shift: float = 0.0, first: int = 0) -> mi.UInt32:
    """Integers, rounded up or down by a golden-ratio sequence (not at random): correct on average
    over any few neighbours, where rounding to the nearest would lose thin matter beside dense.

    ``first`` is the number of the first value in the sequence.
    """
    index = dr.arange(mi.UInt32, dr.width(values))
    index = index + dr.opaque(mi.UInt32, first & 0xFFFFFFFF) if first else index
    (dither,) = unit_floats([golden_words(index, int(shift * 2**32))])
    return mi.UInt32(dr.minimum(values + dither, LEVELS))


def _slice_halves(levels: mi.UInt32, grid: Grid, count: int, axis: int) -> mi.UInt32:
    """``levels`` of the voxels of ``grid``, resampled to ``count`` slices along ``axis``: the mean
    over the first half of each slice's thickness, and over the second one in the upper 16 bits.
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
