"""Chebyshev distance transform: how many cells a ray may cross before an occupied one."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled


def chebyshev(occupied: mi.Bool, shape: tuple[int, int, int], reach: int) -> mi.UInt32:
    """Return the Chebyshev distance of each grid cell to the nearest ``occupied`` one, at most
    ``reach``.

    ``shape`` is (z, y, x); distances are in cells.
    """
    nz, ny, nx = shape
    distance = dr.select(occupied, mi.UInt32(0), dr.opaque(mi.UInt32, reach))
    dr.eval(distance)
    places = unravelled(dr.arange(mi.UInt32, dr.width(distance)), [Divisor(nx), Divisor(ny)])
    for place, side, stride in zip(places, (nx, ny, nz), (1, nx, nx * ny), strict=True):
        limits = (dr.opaque(mi.Int32, n) for n in (side, stride))
        distance = _transform_axis(distance, mi.Int32(place), *limits)
    return distance


@symbolic
def _transform_axis(
    distance: mi.UInt32, place: mi.Int32, side: mi.Int32, stride: mi.Int32
) -> mi.UInt32:
    """Transform along one axis: minimise max(|k|, distance of the cell at offset k) over k."""
    index = dr.arange(mi.Int32, dr.width(distance))
    k, nearest = mi.Int32(1), mi.Int32(distance)
    while dr.hint(k < nearest, label="clearance"):
        for offset, inside in ((-k, place >= k), (k, place + k < side)):
            found = dr.gather(mi.UInt32, distance, mi.UInt32(index + offset * stride), inside)
            found = dr.maximum(k, mi.Int32(found))
            nearest = dr.select(inside, dr.minimum(nearest, found), nearest)
        k += 1
    result = mi.UInt32(nearest)
    dr.eval(result)
    return result
