"""What kernels know of pairs of opposite directions, and of the light that enters along them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.solvers.discrete_ordinates.kernel import DIRECTION, NUMBERS, ONE, WEIGHT


class TrackTable:
    """Parameters of pairs of directions as arrays: another direction compiles nothing.

    ``light`` (n, 2, channels) is what enters along the axis and against it; if it has one channel,
    in all alike.
    """

    def __init__(
        self, integers: np.ndarray, numbers: np.ndarray, light: np.ndarray, rows: Rows
    ) -> None:
        self.rows = rows
        #: the light that enters, where it is not the same along all lines of a pair
        self.entering: BoundarySource | None = None
        self.integers = mi.Int32(integers.astype(np.int32).ravel())
        self.numbers = mi.Float(numbers.astype(np.float32).ravel())
        self.light, self.channels = mi.Float(light.astype(np.float32).ravel()), light.shape[2]
        found = [(axis, np.flatnonzero(rows.axis == axis).tolist()) for axis in range(3)]
        #: the pairs of each dominant axis, which have their corners in common
        self.by_axis = [(axis, pairs) for axis, pairs in found if pairs]
        self.places = [dr.opaque(mi.UInt32, i) for i in range(len(integers))]
        self.order = [i for _, pairs in self.by_axis for i in pairs]
        # One more, since kernels that read an array of a single value are different ones.
        self.ordered = mi.UInt32([*self.order, 0, 1])

    def entering_along(self, which: mi.UInt32, way: int, channels: int) -> list[mi.Float]:
        """The light of each of ``channels`` that enters along the axis (0) or against it (1)."""
        first = (which * 2 + way) * self.channels
        light = [dr.gather(mi.Float, self.light, first + c) for c in range(self.channels)]
        return light if self.channels == channels else light * channels


class Group:
    """Pairs of a ``table`` that follow each other there."""

    def __init__(self, table: TrackTable, pairs: list[int]) -> None:
        self.table, self._pairs = table, pairs
        self._first = dr.opaque(mi.UInt32, table.order.index(pairs[0]))
        self.count = dr.opaque(mi.UInt32, len(pairs))

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: mi.UInt32) -> mi.UInt32:
        """Of a number in the group the number in the table."""
        return dr.gather(mi.UInt32, self.table.ordered, self._first + number)

    def weight(self, number: mi.UInt32) -> mi.Float:
        """Its solid angle for light from the voxels."""
        return dr.gather(mi.Float, self.table.numbers, self.pair(number) * NUMBERS + WEIGHT)

    def direction(self, number: mi.UInt32) -> mi.Vector3f:
        """Where its light along the axis goes to, world space."""
        place = self.pair(number) * NUMBERS + DIRECTION
        return mi.Vector3f(*(dr.gather(mi.Float, self.table.numbers, place + i) for i in range(3)))


class Rows:
    """The lines of pairs of directions: for each (n) the dominant ``axis`` and whether the first of
    the pair goes ``forward`` along it, the other axes (n, 2), the voxels of the box along these two
    and the axis (n, 3); what lines move by across the axis from slice to slice, ``slopes``, and
    where between whole numbers they pass the first slice, ``starts`` (n, 2) [voxels].
    """

    def __init__(self, axis: np.ndarray, forward: np.ndarray, integers: np.ndarray) -> None:
        self.axis, self.forward, self.sides = axis, forward, integers[:, :3]
        self.across = np.array([[k for k in range(3) if k != a] for a in axis], int).reshape(-1, 2)
        self.slopes, self.starts = integers[:, [11, 15]] / ONE, integers[:, [12, 16]] / ONE


class BoundarySource:
    """The light that enters a box along lines [irradiance: radiance times solid angle].

    The lines of a pair are told apart by where they pass the first slice, or would if they did not
    enter the box behind it. A scale times these two coordinates, moved, is a place among cells,
    each of which has two of the ``values``: along the axis, and against it. The values of all
    ``channels`` follow each other.
    """

    def __init__(
        self,
        places: np.ndarray,
        cells: np.ndarray,
        values: mi.Float | None = None,
        channels: int = 1,
    ) -> None:
        """``places``: for each pair scale, moves (2) and slopes (2) of the lines; ``cells``: the
        first value, and the cells along both axes.
        """
        self._places = mi.Float(places.ravel().tolist())
        self._cells = mi.UInt32(cells.ravel().tolist())
        self.values, self.channels = values, channels

    def pair(self, which: mi.UInt32) -> list:
        """What `at` has to know of pairs."""
        places = [dr.gather(mi.Float, self._places, which * 5 + i) for i in range(5)]
        return places + [dr.gather(mi.UInt32, self._cells, which * 3 + i) for i in range(3)]

    def layers(self) -> list[mi.UInt32]:
        """Where the values of the channels begin, but for the first."""
        count = dr.width(self.values) // self.channels
        return [dr.opaque(mi.UInt32, c * count) for c in range(1, self.channels)]

    def at(
        self, pair: list, layers: list, way: int, slice_, ib, fb, ic, fc, active
    ) -> list[mi.Float]:
        """The light of lines that are at these voxels, and positions in them, in a slice."""
        scale, move_b, move_c, slope_b, slope_c, first, nb, nc = pair
        k = mi.Float(slice_)
        b = dr.fma(-slope_b, k, dr.fma(mi.Float(fb), 1 / ONE, mi.Float(ib)))
        c = dr.fma(-slope_c, k, dr.fma(mi.Float(fc), 1 / ONE, mi.Float(ic)))
        b, c = (mi.Int32(dr.floor(dr.fma(x, scale, m))) for x, m in ((b, move_b), (c, move_c)))
        active = active & (b >= 0) & (c >= 0) & (b < mi.Int32(nb)) & (c < mi.Int32(nc))
        place = first + (mi.UInt32(c) * nb + mi.UInt32(b)) * 2 + way
        places = [place, *(place + layer for layer in layers)]
        return [dr.gather(mi.Float, self.values, p, active) for p in places]
