"""Where the values of a volume lie in memory: along x, y, z, or slice by slice across an axis."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, unravelled
from mitsuba_irrcache.core.spectrum import interleaved

#: Axes of an array from the fastest to the slowest, unless they are laid out by slices.
STANDARD = (0, 1, 2)


def slicewise(axis: int) -> tuple[int, int, int]:
    """The axes from the fastest to the slowest, such that neighbours across ``axis`` are near each
    other in memory. Slices along y and z are so as they are.
    """
    return (1, 2, 0) if axis == 0 else STANDARD


def strides_of(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> tuple[int, int, int]:
    """Steps of the flat index along x, y, z."""
    steps, step = [0, 0, 0], 1
    for axis in layout:
        steps[axis] = step
        step *= int(sides[axis])
    return tuple(steps)


def places_of(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> list[mi.UInt32]:
    """Places along x, y, z of all values in the order of their memory."""
    index = dr.arange(mi.UInt32, int(np.prod(sides)))
    places = unravelled(index, [Divisor(int(sides[axis])) for axis in layout[:2]])
    return [place for _, place in sorted(zip(layout, places, strict=True), key=lambda p: p[0])]


def flat(places: Sequence[mi.UInt32], strides: tuple[int, ...]) -> mi.UInt32:
    """Flat indices of places along x, y, z."""
    x, y, z = (p * dr.opaque(mi.UInt32, n) for p, n in zip(places, strides, strict=True))
    return x + y + z


def joined(parts: Sequence[mi.Float | mi.UInt32]) -> mi.Float | mi.UInt32:
    """Arrays one after the other, by kernels that do not differ with their widths, as those of
    ``dr.concat`` do.
    """
    if len(parts) == 1:
        return parts[0]
    result = dr.empty(type(parts[0]), sum(dr.width(part) for part in parts))
    start = 0
    for part in parts:
        dr.scatter(result, part, dr.arange(mi.UInt32, dr.width(part)) + dr.opaque(mi.UInt32, start))
        start += dr.width(part)
    dr.eval(result)
    return result


def side_by_side(channels: Sequence[mi.Float]) -> mi.Float:
    """Channels as one array that has the values of a voxel next to each other."""
    if len(channels) == 1:
        return channels[0]
    result = interleaved(list(channels))
    dr.eval(result)
    return result


def voxels_of(count: int, channels: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Of all values of an array that has those of all ``channels`` of a voxel next to each other:
    voxel and channel.
    """
    index = dr.arange(mi.UInt32, count * channels)
    if channels == 1:
        return index, mi.UInt32(0)
    voxel = index // channels
    return voxel, index - voxel * channels


def layers_of(voxels: int, count: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Of all values of an array that has ``count`` ones for each voxel (or line), one layer after
    the other: layer and voxel.
    """
    return Divisor(voxels).split(dr.arange(mi.UInt32, voxels * count))
