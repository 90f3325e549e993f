"""Memory layouts of the arrays of the sweep: x fastest, or slice by slice across an axis, with the
channels of a voxel adjacent.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, unravelled
from mitsuba_irrcache.core.spectrum import interleaved

#: Axes of an array from the fastest to the slowest, unless it is laid out by slices.
STANDARD = (0, 1, 2)


def slicewise(axis: int) -> tuple[int, int, int]:
    """Return the axes from fastest to slowest such that neighbours within a slice across ``axis``
    are close in memory. For y and z the standard layout has this property.
    """
    return (1, 2, 0) if axis == 0 else STANDARD


def strides_of(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> tuple[int, int, int]:
    """Return the steps of the flat index along x, y, z."""
    steps, step = [0, 0, 0], 1
    for axis in layout:
        steps[axis] = step
        step *= int(sides[axis])
    return tuple(steps)


def coordinates_of(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> list[mi.UInt32]:
    """Return the integer coordinates along x, y, z of all values, in memory order."""
    index = dr.arange(mi.UInt32, int(np.prod(sides)))
    places = unravelled(index, [Divisor(int(sides[axis])) for axis in layout[:2]])
    return [place for _, place in sorted(zip(layout, places, strict=True), key=lambda p: p[0])]


def flat_index(coordinates: Sequence[mi.UInt32], strides: tuple[int, ...]) -> mi.UInt32:
    """Return the flat indices of integer coordinates along x, y, z."""
    x, y, z = (p * dr.opaque(mi.UInt32, n) for p, n in zip(coordinates, strides, strict=True))
    return x + y + z


def interleaved_channels(channels: Sequence[mi.Float]) -> mi.Float:
    """Return channels as one array, with the values of a voxel adjacent."""
    if len(channels) == 1:
        return channels[0]
    result = interleaved(list(channels))
    dr.eval(result)
    return result


def separate_channels(values: mi.Float, count: int) -> list[mi.Float]:
    """Return the ``count`` channels of an array with the values of a voxel adjacent."""
    if count == 1:
        return [values]
    first = dr.arange(mi.UInt32, dr.width(values) // count) * count
    channels = [dr.gather(mi.Float, values, first + c) for c in range(count)]
    dr.eval(channels)
    return channels


def voxel_and_channel(count: int, channels: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Return voxel and channel of each value of an array of ``count`` voxels with interleaved
    ``channels``.
    """
    index = dr.arange(mi.UInt32, count * channels)
    if channels == 1:
        return index, mi.UInt32(0)
    voxel = index // channels
    return voxel, index - voxel * channels


def block_and_index(width: int, count: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Return block, and index in the block, of each value of an array of ``count`` consecutive
    blocks of ``width`` values (voxels or tracks).
    """
    return Divisor(width).split(dr.arange(mi.UInt32, width * count))
