"""The extinction as lines read it: in 16 bits, with the neighbours of each value beside it."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.sequences import golden_words, unit_floats
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.layout import (
    flat,
    places_of,
    slicewise,
    strides_of,
)

#: Extinction is kept in 16 bits, rounded at random, between 0 and the largest there is, at most
#: this optical depth of a voxel.
OPAQUE = 16.0
LEVELS = (1 << 16) - 1
#: Optical depth of a voxel from which on the extinction of its halves is told apart where light
#: collides. With one value for both, all orders of scattering in a CT head of 1.2 per voxel were
#: too bright by 0.5 %.
DENSE = 0.5


class Extinction:
    """``sigma_t`` [1/scene unit] at all voxels of ``detail``, for lines through the voxels of
    ``grid``, over the same box.

    Values are ``quantum`` times integers below 2^16.
    """

    def __init__(self, grid: Grid, detail: Grid, sigma_t: mi.Float) -> None:
        self.grid, self.detail = grid, detail
        #: whether each voxel has a value of its own
        self.own = detail.shape == grid.shape
        slices = np.linalg.norm(grid.coordinates.matrix[:3, :3], axis=1).max()
        top = float(min(dr.max(sigma_t)[0], OPAQUE * slices))
        #: whether it matters to collisions how the extinction changes within a voxel
        self.dense = top > DENSE * slices
        self.quantum = top / LEVELS
        levels = sigma_t * dr.opaque(mi.Float, LEVELS / top if top else 0)
        self._levels = _packed(_rounded(dr.minimum(levels, LEVELS)))
        self._halves: dict[int, mi.UInt32] = {}  # of slices along axes

    def sides(self, axis: int) -> np.ndarray:
        """Values along x, y, z: a slice for each of the grid's along ``axis``."""
        sides = self.detail.resolution.copy()
        sides[axis] = self.grid.resolution[axis]
        return sides

    def words(self, own: bool, by_rows: bool) -> int:
        """How many `corners` keeps together, of values that voxels have of their ``own``, or of
        both halves of slices.
        """
        return (1 if by_rows else 2) if own else 4

    def corners(self, axis: int, words: int) -> mi.UInt32:
        """For each value of the extinction in all slices along ``axis`` those of four, from it on
        along both other axes: flat, two ``words`` of two values each that voxels have of their
        own, or four words of the means over both halves of a slice. A single word is only that
        row of two: the other is read where it is a line's own, half as much memory in all.
        """
        sides = self.sides(axis)
        if words < 4:
            values = None
        elif axis in self._halves:
            values = self._halves[axis]
        else:
            count = int(sides[axis])
            values = self._halves[axis] = _halved(self._levels, self.detail, count, axis)
        at = places_of(sides, slicewise(axis))
        index, strides = flat(at, strides_of(sides)), strides_of(sides)
        steps = []
        for k in range(3):
            if k != axis:
                last = dr.opaque(mi.UInt32, int(sides[k]) - 1)
                steps.append(dr.select(at[k] < last, dr.opaque(mi.UInt32, strides[k]), 0))
        places = [row + step for row in (index, index + steps[1]) for step in (0, steps[0])]
        if values is not None:
            return dr.ravel(mi.Array4u([dr.gather(mi.UInt32, values, p) for p in places]))
        pairs = zip(places[0::2], places[1::2], strict=True)
        rows = [_level(self._levels, a) | _level(self._levels, b) << 16 for a, b in pairs]
        return rows[0] if words == 1 else dr.ravel(mi.Vector2u(rows))


def _packed(values: mi.UInt32) -> mi.UInt32:
    """Two integers below 2^16 in each word: the first half of them, and the second one."""
    dr.eval(values)
    half = (dr.width(values) + 1) // 2
    index = dr.arange(mi.UInt32, half)
    later = index + dr.opaque(mi.UInt32, half)
    upper = dr.gather(mi.UInt32, values, later, later < dr.width(values))
    words = dr.gather(mi.UInt32, values, index) | upper << 16
    dr.eval(words)
    return words


def _level(words: mi.UInt32, index: mi.UInt32) -> mi.UInt32:
    """One of the integers."""
    half = dr.opaque(mi.UInt32, dr.width(words))
    later = index >= half
    word = dr.gather(mi.UInt32, words, dr.select(later, index - half, index))
    return dr.select(later, word >> 16, word & 0xFFFF)


def _rounded(values: mi.Float, shift: float = 0.0) -> mi.UInt32:
    """Integers, up or down by the golden ratio: right on average over any few neighbours."""
    place = dr.arange(mi.UInt32, dr.width(values))
    (dither,) = unit_floats([golden_words(place, int(shift * 2**32))])
    return mi.UInt32(dr.minimum(values + dither, LEVELS))


def _halved(levels: mi.UInt32, grid: Grid, count: int, axis: int) -> mi.UInt32:
    """``levels`` of the voxels of ``grid`` in ``count`` slices along ``axis`` instead: means over
    the first half of their thickness, and over the second one in the upper 16 bits.
    """
    sides, strides = grid.resolution.copy(), strides_of(grid.resolution)
    before, sides[axis] = int(sides[axis]), count
    at = places_of(sides)
    begin, at[axis] = mi.Float(at[axis]), mi.UInt32(0)
    rest, stride = flat(at, strides), dr.opaque(mi.UInt32, strides[axis])
    ratio, last = dr.opaque(mi.Float, before / count), dr.opaque(mi.Float, before - 1)
    # Two points of each half: exact where kinks, the centres of voxels, lie between them or at the
    # ends. All that they are interpolated of is read once.
    points = (0.125, 0.375, 0.625, 0.875)
    where = [dr.clip((begin + point) * ratio - 0.5, 0, last) for point in points]
    first, values = dr.floor(where[0]), [0.0] * len(points)
    for k in range(math.ceil(0.75 * before / count) + 2):
        slice_ = first + k
        level = mi.Float(_level(levels, rest + mi.UInt32(dr.minimum(slice_, last)) * stride))
        for i, u in enumerate(where):
            values[i] += dr.maximum(1 - dr.abs(u - slice_), 0) * level
    halves = [_rounded(0.5 * (values[2 * i] + values[2 * i + 1]), 0.5 * i) for i in range(2)]
    result = halves[0] | halves[1] << 16
    dr.eval(result)
    return result
