"""The record that a kernel reads for each pair of opposite ordinates.

Its named fields are packed into two arrays, and read from them, by this module alone. Before
packing each field is a NumPy array with a value per pair; after reading it is a Dr.Jit array with a
value per lane. Different sets of ordinates are different data for the same kernels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

#: Positions within a voxel are integers below FIXED_POINT_ONE (fixed point), so that a track can be
#: traced back to its entry without rounding errors.
FIXED_POINT_BITS = 24
FIXED_POINT_ONE = 1 << FIXED_POINT_BITS

Integer, Real = Any, Any


@dataclass
class TransverseFields:
    """Fields for one of the two axes transverse to the dominant axis of an ordinate."""

    #: voxels of the box of tracks
    size: Integer
    #: step of the flat index of the swept volume, of the extinction, of the cells of empty space,
    #: and of the grid's voxels
    stride: Integer
    extinction_stride: Integer
    empty_stride: Integer
    voxel_stride: Integer
    #: transverse motion of a track per slice [voxels / `FIXED_POINT_ONE`]
    slope: Integer
    #: voxels by which tracks have moved before the first slice, modulo ``size``, and the position
    #: of all tracks within their voxels there
    first_shift: Integer
    start: Integer
    #: voxels by which tracks have moved in the last slice, modulo ``size``, and their position
    #: there
    last_shift: Integer
    last_position: Integer
    #: extinction values per voxel, the coordinate of the first among them, and of the last
    extinction_ratio: Real
    extinction_origin: Real
    extinction_last: Real


@dataclass
class TrackRecord:
    """Fields for a pair: of both ``transverse`` axes, the dominant axis, and the whole pair."""

    transverse: tuple[TransverseFields, TransverseFields]
    #: number of slices that tracks cross, and the slice in which tracks against the axis begin (the
    #: last one of the box)
    slices: Integer
    last_slice: Integer
    stride: Integer
    extinction_stride: Integer
    empty_stride: Integer
    voxel_stride: Integer
    #: flat indices of the first voxel of the box in the swept volume, in the extinction, and in the
    #: grid
    first_value: Integer
    first_extinction: Integer
    first_voxel: Integer
    #: length of a track between two slices [scene units]
    length: Real
    #: ordinate weight: the solid angle of each ordinate of the pair [sr]
    weight: Real
    #: extinction of one unit of the quantised values [1 / scene unit]
    quantum: Real
    #: the ordinate along the dominant axis, world space
    direction_x: Real
    direction_y: Real
    direction_z: Real


def _paths(kind: str) -> list[tuple[int | None, str]]:
    """Return the fields of a kind in memory order, as (transverse axis or None, name)."""
    transverse = [f.name for f in fields(TransverseFields) if f.type == kind]
    own = [f.name for f in fields(TrackRecord) if f.type == kind]
    return [(axis, name) for axis in range(2) for name in transverse] + [(None, n) for n in own]


INTEGERS, REALS = _paths("Integer"), _paths("Real")


class PackedRecords:
    """The records of ``count`` pairs in the memory that kernels read."""

    def __init__(self, record: TrackRecord, count: int) -> None:
        def packed(paths: list) -> np.ndarray:
            parts = [record if axis is None else record.transverse[axis] for axis, _ in paths]
            columns = [getattr(part, name) for part, (_, name) in zip(parts, paths, strict=True)]
            return np.stack([np.broadcast_to(column, count) for column in columns], axis=1)

        self._integers = mi.Int32(packed(INTEGERS).astype(np.int32).ravel())
        self._reals = mi.Float(packed(REALS).astype(np.float32).ravel())

    def read(self, pair: mi.UInt32) -> TrackRecord:
        """Read the record of each ``pair``."""
        values = {path: self._read_integer(pair, i) for i, path in enumerate(INTEGERS)}
        values |= {path: self._read_real(pair, i) for i, path in enumerate(REALS)}

        def of(axis: int | None) -> dict:
            return {name: value for (a, name), value in values.items() if a == axis}

        return TrackRecord((TransverseFields(**of(0)), TransverseFields(**of(1))), **of(None))

    def weight(self, pair: mi.UInt32) -> mi.Float:
        """Read the ordinate weight alone."""
        return self._read_real(pair, REALS.index((None, "weight")))

    def direction(self, pair: mi.UInt32) -> mi.Vector3f:
        """Read the ordinate along the dominant axis alone."""
        first = REALS.index((None, "direction_x"))
        return mi.Vector3f(*(self._read_real(pair, first + k) for k in range(3)))

    def _read_integer(self, pair: mi.UInt32, number: int) -> mi.Int32:
        return dr.gather(mi.Int32, self._integers, pair * len(INTEGERS) + number)

    def _read_real(self, pair: mi.UInt32, number: int) -> mi.Float:
        return dr.gather(mi.Float, self._reals, pair * len(REALS) + number)
