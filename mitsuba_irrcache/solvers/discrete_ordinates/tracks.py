"""Sweeps along parallel lines that all voxels of a grid share.

For one direction, lines lie on the lattice of the voxels of a slice across the direction's dominant
axis, moved by a random fraction of a voxel, and advance slice by slice. From one slice to the next
all lines move by the same number of whole voxels: in every slice each voxel has exactly one line.
So a voxel and direction cost one step, whatever the size of the grid, and no two lines ever write
to the same voxel. A line that leaves through a side goes on as a new one that enters through the
opposite side; it begins at the very point of entry, between two slices.

Along a line the extinction is interpolated between the four values around it in every slice, and
linear from slice to slice; a source is that of the line's voxel in every slice. On a grid that is
coarser or finer than the medium's, the values across the lines are still those of the medium, and
each half of a slice has its own mean. Were they interpolated to the grid, and between its voxels
again, matter would be wider than it is, and shade more: on a CT head at twice its resolution, 1 %
of the light in the air and 5 % in the skin.

Each launch takes a direction and its opposite along the same lines: two independent chains of
arithmetic, and the odd part of what is integrated over directions cancels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.empty_space import EmptySpace
from mitsuba_irrcache.solvers.discrete_ordinates.extinction import Extinction
from mitsuba_irrcache.solvers.discrete_ordinates.kernel import (
    DIRECTION,
    INTEGERS,
    NUMBERS,
    ONE,
    add_copies,
    follow,
)
from mitsuba_irrcache.solvers.discrete_ordinates.layout import (
    STANDARD,
    flat,
    joined,
    layers_of,
    slicewise,
    strides_of,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import Group, Rows, TrackTable

#: What lines leave in a voxel is a mean over its cross section: smoothing of variance 1/12 along
#: both axes across, half of which is to be taken back (`sharpened`).
RECEIVED = 1 / 24
#: Up to so many voxels one launch takes all directions, each into a copy of the volume of its own,
#: which are added up in a fixed order: atomic sums would be other bits each time.
SMALL = 40**3
#: Voxels of all copies together, at most: 64 MB where light is scattered.
COPIES = 1 << 22


class Tracks:
    """The lines through the voxels of ``grid`` between ``lower`` and ``upper`` (x, y, z; voxels
    outside of this box are empty and get no light).

    ``sigma_t`` holds the extinction [1/scene unit] at all voxels of ``detail``, a grid over the
    same box (None: the same grid). Light is found at the voxels ``wanted`` (flat indices; None:
    all). Where these hold all extinction, ``sparse`` lets it skip what is empty between them, if
    that gains time.
    """

    def __init__(
        self,
        grid: Grid,
        sigma_t: mi.Float,
        lower: np.ndarray,
        upper: np.ndarray,
        detail: Grid | None = None,
        wanted: mi.UInt32 | None = None,
        sparse: bool = False,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        self.grid, self.detail = grid, detail or grid
        #: called after every launch; see `CacheBuilder.pause`
        self.pause = pause
        self.lower, self.sides = np.array(lower), np.array(upper) - np.array(lower)
        self._to_voxels = grid.coordinates.matrix[:3, :3]
        self._lines = max(int(np.prod(np.delete(self.sides, axis))) for axis in range(3))
        self._lanes = dr.arange(mi.UInt32, self._lines)
        dr.eval(self._lanes)
        self.together = grid.voxel_count <= SMALL
        self._extinction = Extinction(grid, self.detail, sigma_t)
        self.wanted = dr.arange(mi.UInt32, grid.voxel_count) if wanted is None else wanted
        self.count = dr.width(self.wanted)
        #: whether all voxels are wanted
        self.whole = self.count == grid.voxel_count
        self._places: mi.UInt32 | None = None
        self.sparse, self._empty = sparse, None
        if sparse and not self.together:
            self._empty = EmptySpace.find(grid, self.wanted, lower, upper)
        #: where the corners of each axis begin among all that are kept
        self._first_corner = [0, 0, 0]
        if self.together:
            sizes = [np.prod(self._extinction.sides(axis)) for axis in range(3)]
            self._first_corner = np.cumsum([0, *sizes[:2]]).tolist()
            self._all_corners: dict[int, mi.UInt32] = {}  # of all axes

    def _own(self, scatters: bool) -> bool:
        """Whether lines read the extinction that voxels have of their own, one value of each."""
        return self._extinction.own and not (scatters and self._extinction.dense)

    def places(self, voxels: mi.UInt32) -> mi.UInt32:
        """Where these voxels are among the wanted ones; of others, the number of these."""
        if self.whole:
            return voxels
        if self._places is None:
            self._places = dr.opaque(mi.UInt32, self.count, self.grid.voxel_count)
            dr.scatter(self._places, dr.arange(mi.UInt32, self.count), self.wanted)
            dr.eval(self._places)
        return dr.gather(mi.UInt32, self._places, voxels)

    def table(
        self,
        directions: np.ndarray,
        light: np.ndarray,
        weights: np.ndarray,
        offsets: np.ndarray,
        by_slice: bool = False,
    ) -> TrackTable:
        """What kernels need to know of pairs of opposite directions.

        Args:
            directions: (n, 3), where the light goes to, world space, unit length.
            light: (n, 2) or (n, 2, channels), irradiance that enters along a direction and along
                its opposite: radiance times solid angle.
            weights: (n), solid angles that each of a pair stands for, for light from the voxels.
            offsets: (n, 2), in [0, 1), random.
            by_slice: whether the volume that lines leave light in is laid out by their slices.
        """
        count = len(directions)
        integers = np.zeros((count, INTEGERS), np.int64)
        numbers = np.zeros((count, NUMBERS), np.float64)
        light = light if light.ndim == 3 else light[..., None]
        velocities = directions @ self._to_voxels.T
        axes = np.abs(velocities).argmax(axis=1)
        ratio = self.detail.resolution / self.grid.resolution
        own = self._own(not by_slice)
        last = self.detail.resolution - 1 - (self.lower if own else 0)
        for i, (velocity, axis) in enumerate(zip(velocities, axes, strict=True)):
            across = [k for k in range(3) if k != axis]
            order = (*across, axis)
            layout = slicewise(axis)
            strides = strides_of(self.grid.resolution, layout if by_slice else STANDARD)
            places = strides_of(self._extinction.sides(axis), layout)
            row = [*(int(self.sides[k]) for k in order), *(strides[k] for k in order)]
            row += [int(np.dot(self.lower, strides)), *(places[k] for k in order)]
            corner = np.dot(self.lower, places) if own else self.lower[axis] * places[axis]
            row += [int(corner) + self._first_corner[axis]]
            for k, offset in zip(across, offsets[i], strict=True):
                slope = round(velocity[k] / velocity[axis] * ONE)
                slope = slope or 1  # lines never stay in a face
                start = min(int(offset * ONE), ONE - 1)
                end = start + (int(self.sides[axis]) - 1) * slope
                row += [slope, start, (end >> 24) % int(self.sides[k]), end & (ONE - 1)]
            row += [self._empty.strides[k] for k in order] if self._empty else [0, 0, 0]
            integers[i] = row
            numbers[i, :3] = [1 / abs(velocity[axis]), weights[i], self._extinction.quantum]
            numbers[i, DIRECTION:] = directions[i] * np.sign(velocity[axis])
            numbers[i, 3:DIRECTION] = [
                x for k in across for x in (ratio[k], self.lower[k] * ratio[k] - 0.5, last[k])
            ]
        forward = velocities[np.arange(count), axes] > 0
        along = np.where(forward[:, None, None], light, light[:, ::-1])
        return TrackTable(integers, numbers, along, Rows(axes, forward, integers))

    def carry(
        self,
        directions: np.ndarray,
        light: np.ndarray,
        offsets: np.ndarray,
        entering: Callable | None = None,
    ) -> mi.Float:
        """Irradiance at the centres of the wanted voxels: the light that enters along pairs of
        directions, told as in `track_table`; instead of that ``light``, line by line, if a
        function of the table is given that makes `BoundarySource`. Of several channels one follows
        the other.
        """
        table = self.table(directions, light, np.zeros(len(light)), offsets, by_slice=True)
        table.entering = entering(table) if entering is not None else None
        box = self.lower, self.lower + self.sides
        channels = table.channels if table.entering is None else table.entering.channels
        wanted = self.count
        total = dr.opaque(mi.Float, 0, wanted * channels)
        for axis, pairs in table.by_axis:
            volume = dr.opaque(mi.Float, 0, self.grid.voxel_count * channels)
            self._launch(volume, False, table, axis, pairs)
            for c in range(channels):
                light = sharpened(volume, self.grid, *box, axis, self.wanted, c, channels)
                place = dr.arange(mi.UInt32, wanted)
                place = place + dr.opaque(mi.UInt32, wanted * c) if c else place
                # In place: a sum would be a second array.
                dr.scatter_add(total, light, place)
            dr.eval(total)
            del volume, light  # before the next axis has its own
        return total

    def scatter(self, volume: mi.Float, table: TrackTable) -> None:
        """Follows the light that comes from the voxels themselves, and that enters from outside.

        ``volume`` holds four values for each voxel: the radiance per optical depth that it sends
        out, S, and three that are added to: its irradiance; what lines lose in it, the integral of
        L - S over optical depth and directions; and the integral of 1, W. So S plus the mean loss,
        loss / W, is the mean radiance *of collisions*: what is scattered from it is neither more
        nor less than what has collided. Of several channels, a voxel has those four
        values of each in turn.
        """
        if self.together:
            self._launch_together(volume, True, table, table.order)
            return
        for axis, pairs in table.by_axis:
            self._launch(volume, True, table, axis, pairs)

    def apart(
        self, table: TrackTable, sent: Callable[[Group], mi.Float] | None = None
    ) -> Iterator[tuple[int, Group, mi.Float]]:
        """Follows the pairs of ``table``, some at a time, and tells their axis and what their lines
        leave: volumes one after the other, two for each pair, of light along the axis and against
        it.

        Where ``sent`` tells what voxels send out, likewise, of four values for each voxel, those of
        `scatter`; else of the light that enters, laid out by slices.
        """
        voxels = self.grid.voxel_count
        most = max(1, COPIES // (2 * voxels))
        for axis, pairs in table.by_axis:
            corners, words = self._corners(axis, sent is not None)
            for start in range(0, len(pairs), most):
                group = Group(table, pairs[start : start + most])
                row, lanes = layers_of(self._lines, len(group))
                copies = dr.opaque(mi.Float, 0, 2 * len(group) * voxels * (4 if sent else 1))
                begin = row * dr.opaque(mi.UInt32, 2 * voxels)
                empty = self._empty.slices if self._empty else None
                follow(
                    corners, words, empty, copies, sent(group) if sent else None,
                    table, group.pair(row), lanes, begin,
                    copy_back=begin + dr.opaque(mi.UInt32, voxels),
                )  # fmt: skip
                dr.eval(copies)
                self.pause()
                yield axis, group, copies

    def _corners(self, axis: int, scatters: bool) -> tuple[mi.UInt32, int]:
        """Values of the extinction for lines along ``axis``, and the words that are together. By
        rows, lines that meet little else find the one above in a cache; wide volumes that light is
        scattered in would have replaced it.
        """
        by_rows = not scatters and not self.together
        words = self._extinction.words(self._own(scatters), by_rows)
        if self.together:
            if words not in self._all_corners:
                parts = [self._extinction.corners(k, words) for k in range(3)]
                self._all_corners[words] = joined(parts)
            return self._all_corners[words], words
        corners = self._extinction.corners(axis, words)
        dr.eval(corners)
        return corners, words

    def _launch(
        self, volume: mi.Float, scatters: bool, table: TrackTable, axis: int, pairs: list[int]
    ) -> None:
        """Follows the ``pairs`` of ``table``, all of which have the dominant ``axis``."""
        if self.together:
            self._launch_together(volume, scatters, table, pairs)
            return
        corners, words = self._corners(axis, scatters)  # one set at a time is kept
        empty = self._empty.slices if self._empty else None
        source = volume if scatters else None
        channels = self._channels(volume, scatters)
        for i in pairs:
            follow(
                corners, words, empty, volume, source, table, table.places[i],
                self._lanes, dr.opaque(mi.UInt32, 0), channels,
            )  # fmt: skip
            dr.eval(volume)
            self.pause()

    def _launch_together(
        self, volume: mi.Float, scatters: bool, table: TrackTable, pairs: list[int]
    ) -> None:
        """The same in one launch, or few; the ``pairs``, of any axes, follow each other in the
        table's order.
        """
        kind, size = (mi.Vector4f, 4) if scatters else (mi.Float, 1)
        voxels = dr.width(volume) // size  # of all channels
        most, (corners, words) = max(1, COPIES // voxels), self._corners(0, scatters)
        for start in range(0, len(pairs), most):
            group = Group(table, pairs[start : start + most])
            row, lanes = layers_of(self._lines, len(group))
            copies = dr.opaque(mi.Float, 0, dr.width(volume) * len(group))
            follow(
                corners, words, None, copies, volume if scatters else None,
                table, group.pair(row), lanes, row * dr.opaque(mi.UInt32, voxels),
                self._channels(volume, scatters),
            )  # fmt: skip
            dr.eval(copies)
            add_copies(volume, copies, voxels, len(group), kind)
            dr.eval(volume)
            self.pause()

    def _channels(self, volume: mi.Float, scatters: bool) -> int:
        """How many a volume has."""
        return dr.width(volume) // (self.grid.voxel_count * (4 if scatters else 1))


def sharpened(
    values: mi.Float,
    grid: Grid,
    lower: np.ndarray,
    upper: np.ndarray,
    axis: int,
    index: mi.UInt32,
    channel: int = 0,
    channels: int = 1,
    begin: mi.UInt32 | int = 0,
) -> mi.Float:
    """Values at the centres of the voxels ``index`` between ``lower`` and ``upper`` (x, y, z),
    given means over the cross sections of all voxels across ``axis``, ``values`` from ``begin`` on,
    laid out by slices: second differences along both other axes take back what the mean has
    smoothed. Never negative. A voxel may have values of several ``channels``, of which one is
    taken.
    """
    places, strides = grid.places(index), strides_of(grid.resolution, slicewise(axis))
    place = flat(places, strides) + begin

    def read(i: mi.UInt32, active: mi.Bool | bool = True) -> mi.Float:
        i = i if channels == 1 else i * channels + channel
        return dr.gather(mi.Float, values, i, active)

    value, change = read(place), mi.Float(0)
    for k, (at, stride) in enumerate(zip(places, strides, strict=True)):
        if k == axis or upper[k] - lower[k] < 3:
            continue
        stride, first, last = (dr.opaque(mi.UInt32, n) for n in (stride, lower[k], upper[k] - 1))
        # A voxel beside the box may lie on the border of the grid, with no neighbour beyond it.
        inside = (at >= first) & (at <= last)
        # At a border, the second difference of the voxel next to it.
        centre = place + dr.select(at == first, stride, 0) - dr.select(at == last, stride, 0)
        here, below, above = (read(i, inside) for i in (centre, centre - stride, centre + stride))
        # Where no line has left anything, nothing is known.
        change += dr.select((below > 0) & (above > 0), 2 * here - below - above, 0)
    return dr.maximum(dr.fma(change, dr.opaque(mi.Float, RECEIVED), value), 0)
