"""Memory layouts of the arrays of the sweep: x fastest, or slice by slice across an axis; channels
next to each other.
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
    """The axes from the fastest to the slowest, such that neighbours across ``axis`` are near each
    other in memory. For y and z the standard layout has this property.
    """
    return (1, 2, 0) if axis == 0 else STANDARD


def strides_of(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> tuple[int, int, int]:
    """Steps of the flat index along x, y, z."""
    steps, step = [0, 0, 0], 1
    for axis in layout:
        steps[axis] = step
        step *= int(sides[axis])
    return tuple(steps)


def coordinates_of(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> list[mi.UInt32]:
    """Integer coordinates along x, y, z of all values, in the order of their memory."""
    index = dr.arange(mi.UInt32, int(np.prod(sides)))
    places = unravelled(index, [Divisor(int(sides[axis])) for axis in layout[:2]])
    return [place for _, place in sorted(zip(layout, places, strict=True), key=lambda p: p[0])]


def flat_index(coordinates: Sequence[mi.UInt32], strides: tuple[int, ...]) -> mi.UInt32:
    """Flat indices of coordinates along x, y, z."""
    x, y, z = (p * dr.opaque(mi.UInt32, n) for p, n in zip(coordinates, strides, strict=True))
    return x + y + z


def interleaved_channels(channels: Sequence[mi.Float]) -> mi.Float:
    """Channels as one array, with the values of a voxel next to each other."""
    if len(channels) == 1:
        return channels[0]
    result = interleaved(list(channels))
    dr.eval(result)
    return result


def separate_channels(values: mi.Float, count: int) -> list[mi.Float]:
    """The ``count`` channels of an array with the values of a voxel next to each other."""
    if count == 1:
        return [values]
    first = dr.arange(mi.UInt32, dr.width(values) // count) * count
    channels = [dr.gather(mi.Float, values, first + c) for c in range(count)]
    dr.eval(channels)
    return channels


def voxel_and_channel(count: int, channels: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Voxel and channel of each value of an array with ``channels`` interleaved for ``count``
    voxels.
    """
    index = dr.arange(mi.UInt32, count * channels)
    if channels == 1:
        return index, mi.UInt32(0)
    voxel = index // channels
    return voxel, index - voxel * channels


def layer_and_index(width: int, count: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Layer and index in it of each value of an array of ``count`` layers, one after the other,
    each with ``width`` values (voxels or tracks).
    """
    return Divisor(width).split(dr.arange(mi.UInt32, width * count))
