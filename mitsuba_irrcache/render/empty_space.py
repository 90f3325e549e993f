"""Distances to the nearest non-empty macrocell, by which rays skip empty space."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import clipped, maximum, minimum
from mitsuba_irrcache.grids.boundary import safe_rcp
from mitsuba_irrcache.grids.distance_transform import chebyshev
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.media.emission import Emission

#: Maximum distance in macrocells that rays skip at once.
MOST_CELLS = 8


class Clearance:
    """Chebyshev distance of each macrocell to the nearest one with extinction or emission.

    Distances are in macrocells, 0 for occupied cells and at most `MOST_CELLS`.
    """

    def __init__(self, cells: Macrocells, emission: Emission | None = None) -> None:
        self.cells = cells
        occupied = cells.majorant > 0
        if emission is not None:
            occupied |= emission.reaches(cells)
        self.distance = chebyshev(occupied, cells.shape, MOST_CELLS)

    def along(self, ray: mi.Ray3f) -> ClearanceAlongRay:
        """Prepare lookups along a ray."""
        return ClearanceAlongRay(self, ray)


class ClearanceAlongRay:
    """Lookups along a ray.

    Each axis is mirrored if necessary, such that the ray's direction is positive along all axes.
    """

    def __init__(self, clearance: Clearance, ray: mi.Ray3f) -> None:
        self.distance, cells = clearance.distance, clearance.cells
        origin, direction = cells.coordinates.point(ray.o), cells.coordinates.vector(ray.d)
        rcp = safe_rcp(direction)
        forward = rcp > 0  # distinguishes 0 from -0, as the reciprocal does
        self.sides = mi.Vector3f(*cells.sides)
        self.origin = dr.select(forward, origin, self.sides - origin)
        self.direction, self.rcp = dr.abs(direction), dr.abs(rcp)
        # Flat indices are stored as floats: there are at most 2^24 cells.
        nx, ny, _ = self.sides
        strides = mi.Vector3f(1, nx, nx * ny)
        self.first = dr.sum(dr.select(forward, 0, (self.sides - 1) * strides))
        self.strides = dr.select(forward, strides, -strides)

    def exit(self, t: mi.Float, active: mi.Bool) -> tuple[mi.Bool, mi.Float]:
        """Return whether the position at ``t`` is empty, and the distance up to which it remains
        empty.

        The distance is at least ``t``.
        """
        u = dr.fma(self.direction, t, self.origin)
        # Clamp before the conversion: floats beyond 2^31 cannot be converted to integers.
        cell = [clipped(dr.floor(c), 0.0, n - 1) for c, n in zip(u, self.sides, strict=True)]
        index = self.first
        for c, stride in zip(cell, self.strides, strict=True):
            index = dr.fma(c, stride, index)
        clearance = mi.Float(dr.gather(mi.UInt32, self.distance, mi.UInt32(index), active))
        nearest = mi.Float(dr.inf)
        for c, n, origin, rcp in zip(cell, self.sides, self.origin, self.rcp, strict=True):
            wall = c + clearance
            # Border cells extend to infinity.
            nearest = minimum(dr.select(wall < n, (wall - origin) * rcp, dr.inf), nearest)
        return clearance > 0, maximum(nearest, t)
