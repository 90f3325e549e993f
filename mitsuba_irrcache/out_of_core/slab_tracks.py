"""Tracks through two slabs of a volume at a time, one for each direction of a pair of ordinates."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.out_of_core.slabs import Slab
from mitsuba_irrcache.solvers.discrete_ordinates.extinction import ExtinctionLayout
from mitsuba_irrcache.solvers.discrete_ordinates.kernel import SweptMedium
from mitsuba_irrcache.solvers.discrete_ordinates.layout import (
    coordinates_of,
    flat_index,
    slicewise,
    strides_of,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_layout import TrackLayout, against_axis_last
from mitsuba_irrcache.solvers.discrete_ordinates.track_record import (
    FIXED_POINT_BITS,
    FIXED_POINT_ONE,
    TrackRecord,
    TransverseFields,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import TRANSVERSE, TrackTable


class SlabTracks:
    """Tracks through all voxels of ``grid``, whose extinction is read slab by slab.

    It has one value per voxel, in units of ``quantum`` [1/scene unit].
    """

    def __init__(self, grid: Grid, quantum: float) -> None:
        self.grid, self.quantum = grid, quantum
        extinction = ExtinctionLayout(grid, grid, quantum, is_dense=False)
        self._layout = TrackLayout(extinction, (np.zeros(3, int), grid.resolution))

    def dominant_axes(self, ordinates: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
        """Return the dominant axis of each ordinate; ``ordinates`` are as in `slab_table`."""
        _, axes, _ = self._layout.record(*ordinates, by_slice=True)
        return axes

    def slab_table(
        self,
        ordinates: tuple[np.ndarray, np.ndarray, np.ndarray],
        incoming: np.ndarray,
        axis: int,
        slabs: tuple[Slab, Slab],
    ) -> TrackTable:
        """Return the table of ordinates, all with the dominant ``axis``, for a pair of slabs.

        Args:
            ordinates: directions (n, 3), weights (n) and offsets (n, 2), as in `Tracks.table`.
            incoming: (n, 2, channels), as there.
            axis: dominant axis of the ordinates.
            slabs: the slab that tracks along the axis cross, and the one that those against it
                cross. The volume consists of both, or of one if they are the same.
        """
        record, _, forward = self._layout.record(*ordinates, by_slice=True)
        (first, end), (_, last_end) = slabs
        slices = (end - first) * (1 if slabs[0] == slabs[1] else 2)
        sides = self.grid.resolution.copy()
        sides[axis] = slices
        strides = strides_of(sides, slicewise(axis))
        transverse = [
            _moved(fields, strides[k], first, last_end - 1)
            for fields, k in zip(record.transverse, TRANSVERSE[axis], strict=True)
        ]
        record = replace(
            record,
            transverse=tuple(transverse),
            slices=end - first,
            last_slice=slices - 1,
            stride=strides[axis],
            extinction_stride=strides[axis],
        )
        return _table(record, against_axis_last(incoming, forward), axis, forward)


def _table(record: TrackRecord, incoming: np.ndarray, axis: int, forward: np.ndarray) -> TrackTable:
    count = len(forward)
    record = replace(record, slices=np.full(count, record.slices))
    return TrackTable(record, incoming, np.full(count, axis), forward)


def _moved(fields: TransverseFields, stride: int, first: int, last: int) -> TransverseFields:
    """Return the fields of tracks that begin in other slices.

    Those along the axis begin in slice ``first``, those against it in slice ``last``.
    """
    ahead, behind = (fields.start + n * fields.slope for n in (first, last))
    return replace(
        fields,
        stride=stride,
        extinction_stride=stride,
        first_shift=(ahead >> FIXED_POINT_BITS) % fields.size,
        start=ahead & (FIXED_POINT_ONE - 1),
        last_shift=(behind >> FIXED_POINT_BITS) % fields.size,
        last_position=behind & (FIXED_POINT_ONE - 1),
    )


def by_slices(box: np.ndarray, axis: int) -> np.ndarray:
    """Transpose a box (z, y, x, ...) to the layout of a swept volume, the slowest axis first."""
    return box.transpose(*_order(axis), *range(3, box.ndim))


def from_slices(values: np.ndarray, axis: int) -> np.ndarray:
    """Transpose a result of `by_slices` back to (z, y, x, ...)."""
    return values.transpose(*np.argsort(_order(axis)), *range(3, values.ndim))


def _order(axis: int) -> list[int]:
    return [2 - k for k in slicewise(axis)[::-1]]


def slice_place(axis: int) -> int:
    """Return the position of ``axis`` among the axes of `by_slices`."""
    return 2 - slicewise(axis).index(axis)


def swept_medium(parts: list[np.ndarray], axis: int) -> SweptMedium:
    """Return the extinction of one or two slabs in the form that tracks along ``axis`` read.

    For each voxel this is its quantised value and that of its neighbour (see `Extinction.corners`,
    by rows).

    ``parts`` are boxes (z, y, x) of quantised values, uint16.
    """
    box = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2 - axis)
    sides = np.array(box.shape[::-1])
    values = box.ravel()
    words = mi.UInt32((np.append(values, np.uint16(0)) if values.size % 2 else values).view("u4"))
    at = coordinates_of(sides, slicewise(axis))
    k, strides = TRANSVERSE[axis, 0], strides_of(sides)
    index, last = flat_index(at, strides), dr.opaque(mi.UInt32, int(sides[k]) - 1)
    upper = index + dr.select(at[k] < last, dr.opaque(mi.UInt32, strides[k]), 0)

    def level(i: mi.UInt32) -> mi.UInt32:
        return (dr.gather(mi.UInt32, words, i >> 1) >> ((i & 1) << 4)) & 0xFFFF

    rows = level(index) | level(upper) << 16
    dr.eval(rows)
    return SweptMedium(rows, words=1)
