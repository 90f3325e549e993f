"""Geometry of tracks relative to the voxels: computes the record of each pair of ordinates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsuba_irrcache.solvers.discrete_ordinates.extinction import ExtinctionLayout
from mitsuba_irrcache.solvers.discrete_ordinates.layout import STANDARD, slicewise, strides_of
from mitsuba_irrcache.solvers.discrete_ordinates.track_record import (
    FIXED_POINT_BITS,
    FIXED_POINT_ONE,
    TrackRecord,
    TransverseFields,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import TRANSVERSE


class TrackLayout:
    """The layout of tracks through a box of the voxels of a grid.

    ``box`` is the first voxel and the size (x, y, z) of the box in the grid of ``extinction``.
    ``empty_strides`` are the steps of the flat index of the cells of empty space;
    ``first_extinction`` is the index of the first extinction value of each axis, if the values for
    all axes are in one array.
    """

    def __init__(
        self,
        extinction: ExtinctionLayout,
        box: tuple[np.ndarray, np.ndarray],
        empty_strides: Sequence[int] = (0, 0, 0),
        first_extinction: Sequence[int] = (0, 0, 0),
    ) -> None:
        self.extinction = extinction
        self.lower, self.size = box
        self._empty_strides = np.array(empty_strides)
        self._first_extinction = np.array(first_extinction)

    def record(
        self, directions: np.ndarray, weights: np.ndarray, offsets: np.ndarray, by_slice: bool
    ) -> tuple[TrackRecord, np.ndarray, np.ndarray]:
        """Return the record of pairs of opposite ordinates (see `Tracks.table`), their dominant
        axes (n), and whether the first ordinate of each pair propagates along its axis (n).
        """
        # docs/primer, eq. (4.3)
        extinction = self.extinction
        # voxels / scene unit
        velocities = directions @ extinction.grid.coordinates.matrix[:3, :3].T
        axis = np.abs(velocities).argmax(axis=1)
        pairs = np.arange(len(directions))
        along = velocities[pairs, axis]
        strides, extinction_strides = self._strides(axis, by_slice)
        empty_strides = self._empty_strides
        voxels = np.array(strides_of(extinction.grid.resolution))
        per_voxel = extinction.is_read_by_voxel(has_source=not by_slice)
        if per_voxel:
            first_extinction = extinction_strides @ self.lower
        else:
            first_extinction = self.lower[axis] * extinction_strides[pairs, axis]
        last = extinction.values_grid.resolution - 1 - (self.lower if per_voxel else 0)

        def transverse(number: int) -> TransverseFields:
            k = TRANSVERSE[axis, number]
            slope = velocities[pairs, k] / along
            step = strides[pairs, k], extinction_strides[pairs, k], empty_strides[k], voxels[k]
            return self._transverse_fields(axis, k, slope, offsets[:, number], step, last[k])

        along_axis = directions * np.sign(along)[:, None]
        record = TrackRecord(
            transverse=(transverse(0), transverse(1)),
            slices=self.size[axis],
            last_slice=self.size[axis] - 1,
            stride=strides[pairs, axis],
            extinction_stride=extinction_strides[pairs, axis],
            empty_stride=empty_strides[axis],
            voxel_stride=voxels[axis],
            first_value=strides @ self.lower,
            first_extinction=first_extinction + self._first_extinction[axis],
            first_voxel=voxels @ self.lower,
            length=1 / np.abs(along),
            weight=weights,
            quantum=extinction.quantum,
            direction_x=along_axis[:, 0],
            direction_y=along_axis[:, 1],
            direction_z=along_axis[:, 2],
        )
        return record, axis, along > 0

    def _transverse_fields(
        self,
        axis: np.ndarray,
        k: np.ndarray,
        slope: np.ndarray,
        offset: np.ndarray,
        steps: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        last: np.ndarray,
    ) -> TransverseFields:
        """Return the fields of n pairs for the transverse axes ``k``.

        ``axis`` are the dominant axes, ``slope`` the voxels by which tracks move per slice,
        ``offset`` the random shifts, ``steps`` those of the four flat indices, and ``last`` the
        coordinates of the last extinction value.
        """
        size = self.size
        slope = np.rint(slope * FIXED_POINT_ONE).astype(np.int64)
        slope[slope == 0] = 1  # tracks never stay in a face
        start = np.minimum((offset * FIXED_POINT_ONE).astype(np.int64), FIXED_POINT_ONE - 1)
        end = start + (size[axis] - 1) * slope
        ratio = (self.extinction.values_grid.resolution / self.extinction.grid.resolution)[k]
        return TransverseFields(
            size=size[k],
            stride=steps[0],
            extinction_stride=steps[1],
            empty_stride=steps[2],
            voxel_stride=steps[3],
            slope=slope,
            first_shift=0,
            start=start,
            last_shift=(end >> FIXED_POINT_BITS) % size[k],
            last_position=end & (FIXED_POINT_ONE - 1),
            extinction_ratio=ratio,
            extinction_origin=self.lower[k] * ratio - 0.5,
            extinction_last=last,
        )

    def _strides(self, axis: np.ndarray, by_slice: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the strides (n, 3) of the swept volume and of the extinction for these dominant
        axes.
        """
        layouts = [slicewise(k) for k in range(3)]
        volume = [
            strides_of(self.extinction.grid.resolution, layout if by_slice else STANDARD)
            for layout in layouts
        ]
        extinction = [
            strides_of(self.extinction.sides(k), layout) for k, layout in enumerate(layouts)
        ]
        return np.array(volume)[axis], np.array(extinction)[axis]


def against_axis_last(incoming: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Sort irradiance (n, 2, channels) along each ordinate and its opposite such that the first
    value is along the dominant axis, and the second against it.
    """
    return np.where(forward[:, None, None], incoming, incoming[:, ::-1])
