"""Constant and trilinearly interpolated fields."""

from __future__ import annotations

from functools import reduce
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.grid import Grid, stencil


class ConstantField:
    """A spatially constant value: a Float (grey) or a Color3f."""

    grid = None

    def __init__(self, values: np.ndarray, scale: float = 1.0) -> None:
        self.channels, self.scale = len(values), scale
        opaque = [dr.opaque(mi.Float, float(v) * scale) for v in values]
        self.value = opaque[0] if self.channels == 1 else mi.Color3f(opaque)
        self.minimum = float(np.min(values)) * scale
        self.maximum = float(np.max(values)) * scale

    def at_world(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        return type(self.value)(self.value)  # a copy, because symbolic loops write to their state


class GridField:
    """Values at the voxel centres of a grid, interpolated trilinearly and clamped at the border.

    ``data`` is flat with ``channels`` (1 or 3) interleaved values per voxel and is not copied;
    ``scale`` multiplies every lookup, so that a scaled medium needs no copy of its data.
    """

    def __init__(self, grid: Grid, data: mi.Float, channels: int, scale: float = 1.0) -> None:
        if dr.width(data) != grid.voxel_count * channels:
            raise IrrcacheError(
                f"GridField: {dr.width(data)} values do not fill {grid.shape} x {channels} channels"
            )
        self.grid, self.data, self.channels = grid, data, channels
        self.scale = dr.opaque(mi.Float, scale)
        self.maximum = float(dr.max(data)[0]) * scale

    def at(self, u: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Interpolate at the voxel coordinates ``u``: a Float for one channel, else a Color3f."""
        values = [v * self.scale for v in self._interpolate(u, active)]
        return values[0] if self.channels == 1 else mi.Color3f(values)

    def at_world(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Interpolate at the world position ``p``."""
        return self.at(self.grid.coordinates.point(p), active)

    def _interpolate(self, u: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        nx, ny, _ = self.grid.sides
        corners, weights, steps = zip(
            *(stencil(c, n) for c, n in zip(u, self.grid.sides, strict=True)), strict=True
        )
        # Compute one flat index per lookup; the other corners are a stride away, or 0 at the
        # border.
        base = ((corners[2] * ny + corners[1]) * nx + corners[0]) * self.channels
        dx = dr.select(steps[0], self.channels, 0)
        dy = dr.select(steps[1], nx * self.channels, 0)
        dz = dr.select(steps[2], nx * ny * self.channels, 0)
        wx, wy, wz = weights
        result = []
        for channel in range(self.channels):
            faces = []
            for z in (base, base + dz):
                edges = []
                for y in (z, z + dy):
                    low, high = (
                        dr.gather(mi.Float, self.data, mi.UInt32(i + channel), active)
                        for i in (y, y + dx)
                    )
                    edges.append(dr.lerp(low, high, wx))
                faces.append(dr.lerp(*edges, wy))
            result.append(dr.lerp(*faces, wz))
        return result


Field = ConstantField | GridField

#: Difference of neighbouring voxels, over the maximum, from which on their interpolation matters.
DIFFERENT = 1e-3


def positions_between_voxels(field: Field, count: int) -> mi.Point3f | None:
    """Return ``count`` random world positions between neighbouring voxels of different values; None
    if there are none.

    Voxels at opposite faces of a grid count as neighbours, so that a ``wrap_mode`` can be found out
    at these positions.
    """
    if field.grid is None:
        return None
    grid, least = field.grid, dr.opaque(mi.Float, DIFFERENT * field.maximum)
    sides = [mi.UInt32(n) for n in grid.sides]
    index, strides = dr.arange(mi.UInt32, grid.voxel_count), (1, sides[0], sides[0] * sides[1])
    differs = mi.Bool(False)
    for i, n, stride in zip(grid.voxel_indices(index), sides, strides, strict=True):
        neighbour = dr.select(i + 1 < n, index + stride, index + stride - stride * n)
        for channel in range(field.channels):
            own, other = (
                dr.gather(mi.Float, field.data, k * field.channels + channel)
                for k in (index, neighbour)
            )
            differs |= dr.abs(own - other) * field.scale > least
    chosen = dr.compress(differs)
    if not dr.width(chosen):
        return None
    rng, last = mi.PCG32(count), dr.opaque(mi.UInt32, dr.width(chosen) - 1)
    place = mi.UInt32(rng.next_float32() * (mi.Float(last) + 1))
    index = dr.gather(mi.UInt32, chosen, dr.minimum(place, last))
    u = mi.Point3f(*grid.voxel_indices(index)) + 0.5
    u += mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    size = mi.Point3f(*(mi.Float(n) for n in grid.sides))
    u = dr.select(u > size, u - size, u)
    dr.eval(u)
    return grid.world.point(u)


#: Largest error of interpolation by the texture units of GPUs, whose weights have 8 bits, relative
#: to the range of the voxels between which they interpolate; 0.0068 was measured.
TEXTURE_UNIT_ERROR = 0.01


def error_of_texture_units(field: Field, p: mi.Point3f) -> mi.Float | mi.Color3f:
    """Bound the error at world positions ``p`` of a GPU's texture units, by which Mitsuba
    interpolates grid volumes in ``cuda_*`` variants; 0 in others.
    """
    if field.grid is None or dr.backend_v(mi.Float) != dr.JitBackend.CUDA:
        return mi.Float(0)
    return TEXTURE_UNIT_ERROR * range_around(field, field.grid.coordinates.point(p))


def range_around(field: GridField, u: mi.Point3f) -> mi.Float | mi.Color3f:
    """Return the range of the voxels that interpolation at the voxel coordinates ``u`` uses."""
    corner = dr.floor(u - 0.5) + 0.5
    values = [field.at(corner + mi.Vector3f(offset)) for offset in product((0.0, 1.0), repeat=3)]
    return reduce(dr.maximum, values) - reduce(dr.minimum, values)
