"""Transposes of interpolation: values at positions are added to the voxels that a lookup reads.

Many values are added to each voxel, in an order that differs between runs. They are added in 64-bit
fixed point, where the result does not depend on the order: equal seeds give equal bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.fast_math import clipped
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.grid import Grid

#: Number of bits of the largest sum of magnitudes.
BITS = 60
#: Number of sums among which the derivatives with respect to a constant are distributed, because
#: atomic additions to a single address would be serialised.
SLOTS = 1 << 12


class FixedPointSums:
    """An array of ``size`` sums whose bits do not depend on the order of additions.

    ``bound`` is an upper bound of the sum of the magnitudes of all contributions.
    """

    def __init__(self, size: int, bound: float) -> None:
        exponent = BITS - math.ceil(math.log2(bound)) if 0 < bound < math.inf else 0
        self._exponent = int(np.clip(exponent, -100, 120))
        self._scale = dr.opaque(mi.Float, 2.0**self._exponent)
        self._limit = dr.opaque(mi.Float, 2.0**BITS)
        self.sums = dr.zeros(mi.Int64, size)
        self._invalid = dr.zeros(mi.UInt32, 1)
        dr.make_opaque(self.sums, self._invalid)

    def check(self, values: Sequence[mi.Float], active: mi.Bool) -> None:
        """Note values that are not finite, which fixed point cannot represent."""
        finite = mi.Bool(True)
        for value in values:
            finite &= dr.isfinite(value)
        one, first = mi.UInt32(1), mi.UInt32(0)
        dr.scatter_reduce(dr.ReduceOp.Or, self._invalid, one, first, active & ~finite)

    def add(self, index: mi.UInt32, value: mi.Float, active: mi.Bool) -> None:
        """Add a ``value`` to the sum at ``index``."""
        scaled = clipped(value * self._scale, -self._limit, self._limit)
        # On processors, Dr.Jit's default first adds up equal indices within a vector: for the
        # voxels around camera rays that takes longer than one atomic addition for each lane.
        on_processor = dr.backend_v(self.sums) == dr.JitBackend.LLVM
        mode = dr.ReduceMode.Direct if on_processor else dr.ReduceMode.Auto
        dr.scatter_reduce(dr.ReduceOp.Add, self.sums, mi.Int64(scaled), index, active, mode)

    def values(self) -> mi.Float:
        """Return the sums; raise IrrcacheError if a value that `check` saw was not finite."""
        if self._invalid[0]:
            raise IrrcacheError(
                "irrcache: a contribution to the gradient is not finite. This is an error of "
                "irrcache: please report it with the scene. No gradient was written."
            )
        double = dr.float64_array_t(mi.Float)
        result = mi.Float(double(self.sums) * dr.opaque(double, 2.0**-self._exponent))
        dr.eval(result)
        return result


class GridSplat:
    """The transpose of trilinear interpolation on ``grid`` of ``channels`` interleaved values."""

    def __init__(self, grid: Grid, channels: int, bound: float) -> None:
        self.grid, self.channels = grid, channels
        self._sums = FixedPointSums(grid.voxel_count * channels, bound)

    def add(self, p: mi.Point3f, values: Sequence[mi.Float], active: mi.Bool) -> None:
        """Add one value for each channel at world positions."""
        self._sums.check(values, active)
        for index, weight in self.grid.corners(self.grid.coordinates.point(p)):
            for c, value in enumerate(values):
                place = index * self.channels + c
                self._sums.add(place, value * weight, active & (weight > 0))

    def values(self) -> mi.Float:
        return self._sums.values()


class VoxelSums:
    """Integrals over each voxel of ``grid`` of ``channels`` values at positions."""

    def __init__(self, grid: Grid, channels: int, bound: float) -> None:
        self.grid, self.channels = grid, channels
        self._sums = FixedPointSums(grid.voxel_count * channels, bound)

    def add(self, p: mi.Point3f, values: Sequence[mi.Float], active: mi.Bool) -> None:
        """Add one value for each channel to the voxels around world positions."""
        self._sums.check(values, active)
        place = [
            dr.clip(mi.Int32(dr.floor(clipped(x, -1.0, mi.Float(n)))), 0, n - 1)
            for x, n in zip(self.grid.coordinates.point(p), self.grid.sides, strict=True)
        ]
        index = self.grid.index(*place) * self.channels
        for c, value in enumerate(values):
            self._sums.add(index + c, value, active)

    def values(self) -> list[mi.Float]:
        """Return the integrals over the voxels, one array for each channel."""
        sums = self._sums.values()
        place = dr.arange(mi.UInt32, self.grid.voxel_count) * self.channels
        found = [dr.gather(mi.Float, sums, place + c) for c in range(self.channels)]
        dr.eval(found)
        return found


class ConstantSplat:
    """The transpose of the lookup of a constant field of ``channels`` values."""

    def __init__(self, channels: int, bound: float) -> None:
        self.channels = channels
        self._sums = FixedPointSums(SLOTS * channels, bound)

    def add(self, p: mi.Point3f, values: Sequence[mi.Float], active: mi.Bool) -> None:
        """Add one value for each channel, wherever ``p`` is."""
        self._sums.check(values, active)
        bits = sum(dr.reinterpret_array(mi.UInt32, x) * 2654435761 for x in p)
        slot = bits >> (32 - SLOTS.bit_length() + 1)
        for c, value in enumerate(values):
            self._sums.add(slot * self.channels + c, value, active)

    def values(self) -> mi.Float:
        sums = np.array(self._sums.values(), dtype=np.float64).reshape(SLOTS, self.channels)
        return mi.Float(sums.sum(axis=0).tolist())


def summed_to_channels(values: mi.Spectrum, channels: int) -> list[mi.Float]:
    """Convert derivatives by channel of the radiance to derivatives by channel of a field.

    A grey field affects all channels, so that its derivative is their sum.
    """
    return [dr.sum(values)] if channels == 1 else list(values)
