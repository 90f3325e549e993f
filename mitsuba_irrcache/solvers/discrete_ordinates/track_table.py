"""Tables of ordinates in the form that kernels read, and the boundary source of the tracks.

The boundary condition of the transport equation prescribes the radiance that enters the box of
tracks. It is either the same for all tracks of an ordinate (suns, environments), part of the
`TrackTable`, or given track by track by a `BoundarySource` (surfaces around the medium).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.solvers.discrete_ordinates.track_record import (
    FIXED_POINT_ONE,
    PackedRecords,
    TrackRecord,
)

#: The two transverse axes of each dominant axis.
TRANSVERSE = np.array([[1, 2], [0, 2], [0, 1]])


class TrackGeometry:
    """Geometry of the tracks of n pairs of opposite ordinates.

    ``axis`` (n) is the dominant axis of each pair, ``forward`` (n) whether its first ordinate
    propagates along that axis, ``transverse`` (n, 2) are the other axes, and ``sizes`` (n, 3) the
    numbers of voxels of the box along these two and along the dominant axis. ``slopes`` (n, 2) are
    the motions of tracks along the transverse axes per slice, and ``starts`` (n, 2) their positions
    within a voxel in the first slice [voxels].
    """

    def __init__(self, axis: np.ndarray, forward: np.ndarray, record: TrackRecord) -> None:
        self.axis, self.forward, self.transverse = axis, forward, TRANSVERSE[axis]
        b, c = record.transverse
        self.sizes = np.stack([b.size, c.size, record.slices], axis=1)
        self.slopes = np.stack([b.slope, c.slope], axis=1) / FIXED_POINT_ONE
        self.starts = np.stack([b.start, c.start], axis=1) / FIXED_POINT_ONE


class TrackTable:
    """Pairs of opposite ordinates in the form that kernels read; new ordinates compile no kernels.

    ``incoming`` (n, 2, channels) is the irradiance that enters along the dominant axis and against
    it; a single channel stands for all.
    """

    def __init__(
        self, record: TrackRecord, incoming: np.ndarray, axis: np.ndarray, forward: np.ndarray
    ) -> None:
        self.geometry = TrackGeometry(axis, forward, record)
        #: used instead of ``incoming`` if that differs between the tracks of an ordinate
        self.boundary_source: BoundarySource | None = None
        #: where tracks cross surfaces among the voxels, if there are any
        self.crossings: TrackCrossings | None = None
        self.records = PackedRecords(record, len(axis))
        self._incoming = mi.Float(incoming.astype(np.float32).ravel())
        self.channels = incoming.shape[2]
        found = [(k, np.flatnonzero(axis == k).tolist()) for k in range(3)]
        #: the pairs of each dominant axis, which read the same layout of the extinction
        self.by_axis = [(k, pairs) for k, pairs in found if pairs]
        self.pair_index = [dr.opaque(mi.UInt32, i) for i in range(len(axis))]
        self.order = [i for _, pairs in self.by_axis for i in pairs]
        # One more value: arrays of a single value compile other kernels.
        self.ordered = mi.UInt32([*self.order, 0, 1])

    def incoming(self, pair: mi.UInt32, way: int, channels: int) -> list[mi.Float]:
        """Read the irradiance that enters along the axis (``way`` 0) or against it (1), per
        channel.
        """
        first = (pair * 2 + way) * self.channels
        values = [dr.gather(mi.Float, self._incoming, first + c) for c in range(self.channels)]
        return values if self.channels == channels else values * channels


class PairGroup:
    """Some of the pairs of a ``table``, consecutive in its order."""

    def __init__(self, table: TrackTable, pairs: list[int]) -> None:
        self.table, self.rows = table, pairs
        self._first = dr.opaque(mi.UInt32, table.order.index(pairs[0]))
        self.count = dr.opaque(mi.UInt32, len(pairs))

    def __len__(self) -> int:
        return len(self.rows)

    def pair(self, number: mi.UInt32) -> mi.UInt32:
        """Return the index in the table of the pair with a ``number`` in the group."""
        return dr.gather(mi.UInt32, self.table.ordered, self._first + number)

    def weight(self, number: mi.UInt32) -> mi.Float:
        """Return the ordinate weight of the pair with a ``number`` in the group."""
        return self.table.records.weight(self.pair(number))

    def direction(self, number: mi.UInt32) -> mi.Vector3f:
        """Return the ordinate along the dominant axis (world space) of a ``number``."""
        return self.table.records.direction(self.pair(number))


#: Stands for a voxel where none is known, whose source is 0.
NO_VOXEL = 0xFFFFFFFF


class TrackCrossings:
    """Crossings of the tracks of a table with surfaces among the voxels, see `SurfaceCrossings`."""

    def __init__(
        self,
        number: mi.UInt32,
        first: np.ndarray,
        slots: mi.UInt32,
        records: mi.Float,
        sources: mi.UInt32,
    ) -> None:
        """``number`` holds, for each voxel of the grid, 1 + its index among the voxels near
        surfaces, 0 for others. ``first`` (n) is the index in ``slots`` of the first of these voxels
        for each pair. ``slots`` hold 1 + the index of a crossing in ``records`` and ``sources``, 0
        without a crossing.
        """
        self._number, self._slots = number, slots
        self._records, self._sources = records, sources
        # One more value: arrays of a single value compile other kernels.
        self._first = mi.UInt32([*first.tolist(), 0, 0])

    def first(self, pair: mi.UInt32) -> mi.UInt32:
        """Return the argument ``first`` of `slot` for each pair."""
        return dr.gather(mi.UInt32, self._first, pair)

    def slot(self, first: mi.UInt32, voxel: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """Return 1 + the index of the crossing in a voxel of the grid; 0 without one."""
        number = dr.gather(mi.UInt32, self._number, voxel, active)
        return dr.gather(mi.UInt32, self._slots, first + number - 1, active & (number > 0))

    def record(self, slot: mi.UInt32, active: mi.Bool) -> mi.Vector4f:
        """Return the record of the crossing with this `slot`, see `SurfaceCrossings`."""
        return dr.gather(mi.Vector4f, self._records, slot - 1, active)

    def source_voxels(self, slot: mi.UInt32, active: mi.Bool) -> mi.Vector2u:
        """Return the voxels of the grid whose source applies to the parts before and behind."""
        return dr.gather(mi.Vector2u, self._sources, slot - 1, active)


class BoundarySource:
    """Irradiance (radiance times solid angle) that enters the box, track by track.

    A track is identified by its two coordinates in the first slice, extrapolated if it enters the
    box later. These coordinates, scaled and shifted, determine a cell, which has two of the
    ``values``: along the dominant axis and against it. The values of the ``channels`` are stored
    one channel after the other.
    """

    def __init__(
        self,
        transforms: np.ndarray,
        cells: np.ndarray,
        values: mi.Float | None = None,
        channels: int = 1,
        first_crossing: int | None = None,
    ) -> None:
        """``transforms`` (n, 5) are scale, shifts (2) and slopes (2) of the tracks of each pair;
        ``cells`` (n, 3) the index of the first value, and the numbers of cells along both axes.
        ``first_crossing`` is the index of the values of crossing 0 with surfaces among the voxels
        (None: no such values); it may be negative, modulo 2^32, in a part of the table.
        """
        self._first_crossing = None
        if first_crossing is not None:
            self._first_crossing = dr.opaque(mi.UInt32, first_crossing & 0xFFFFFFFF)
        self._transforms = mi.Float(transforms.ravel().tolist())
        self._cells = mi.UInt32(cells.ravel().tolist())
        self.values, self.channels = values, channels

    def read_pair(self, pair: mi.UInt32) -> list:
        """Return the argument ``pair`` of `irradiance`."""
        transform = [dr.gather(mi.Float, self._transforms, pair * 5 + i) for i in range(5)]
        return transform + [dr.gather(mi.UInt32, self._cells, pair * 3 + i) for i in range(3)]

    def channel_offsets(self) -> list[mi.UInt32]:
        """Return the index of the first value of each channel but the first."""
        count = dr.width(self.values) // self.channels
        return [dr.opaque(mi.UInt32, c * count) for c in range(1, self.channels)]

    def irradiance(
        self, pair: list, offsets: list, way: int, slice_: mi.Int32, at: tuple, active: mi.Bool
    ) -> list[mi.Float]:
        """Return the irradiance that enters along tracks, per channel.

        The tracks are in the slice ``slice_``, ``at`` these voxels and positions within them (b, c,
        position_b, position_c).
        """
        scale, shift_b, shift_c, slope_b, slope_c, first, nb, nc = pair
        ib, ic, fb, fc = at
        k = mi.Float(slice_)
        b = dr.fma(-slope_b, k, dr.fma(mi.Float(fb), 1 / FIXED_POINT_ONE, mi.Float(ib)))
        c = dr.fma(-slope_c, k, dr.fma(mi.Float(fc), 1 / FIXED_POINT_ONE, mi.Float(ic)))
        b, c = (mi.Int32(dr.floor(dr.fma(x, scale, m))) for x, m in ((b, shift_b), (c, shift_c)))
        active = active & (b >= 0) & (c >= 0) & (b < mi.Int32(nb)) & (c < mi.Int32(nc))
        index = first + (mi.UInt32(c) * nb + mi.UInt32(b)) * 2 + way
        return self._read(index, offsets, active)

    def from_surface(
        self, slot: mi.UInt32, offsets: list, way: int, active: mi.Bool
    ) -> list[mi.Float]:
        """Return the irradiance along tracks that leave a surface among the voxels."""
        if self._first_crossing is None:
            return [mi.Float(0)] * self.channels
        return self._read(self._first_crossing + (slot - 1) * 2 + way, offsets, active)

    def _read(self, index: mi.UInt32, offsets: list, active: mi.Bool) -> list[mi.Float]:
        indices = [index, *(index + offset for offset in offsets)]
        return [dr.gather(mi.Float, self.values, i, active) for i in indices]
