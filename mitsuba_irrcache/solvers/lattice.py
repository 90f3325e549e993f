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

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grid import Grid
from mitsuba_irrcache.solvers.empty import CELL, Emptiness

#: Positions within a voxel are integers below this: lines can be followed back without rounding.
ONE = 1 << 24
#: Extinction is kept in 16 bits, rounded at random, between 0 and the largest there is, at most
#: this optical depth of a voxel.
OPAQUE = 16.0
LEVELS = (1 << 16) - 1
#: What lines leave in a voxel is a mean over its cross section: smoothing of variance 1/12 along
#: both axes across, half of which is to be taken back (`sharpened`).
RECEIVED = 1 / 24
#: Up to so many voxels one launch takes all directions, each into a copy of the volume of its own,
#: which are added up in a fixed order: atomic sums would be other bits each time.
SMALL = 40**3
#: Voxels of all copies together, at most: 64 MB where light is scattered.
COPIES = 1 << 22

#: Axes of an array from the fastest to the slowest, unless they are laid out by slices.
STANDARD = (0, 1, 2)

_INTEGERS = 22
_NUMBERS = 11


class Lattice:
    """The lines through the voxels of ``grid`` between ``lower`` and ``upper`` (x, y, z; voxels
    outside of this box are empty and get no light).

    ``sigma_t`` holds the extinction [1/scene unit] at all voxels of ``detail``, a grid over the
    same box (None: the same grid). `carry` finds the light at the voxels ``wanted`` (flat indices;
    None: all). Where these hold all extinction, ``sparse`` lets it skip what is empty between them,
    if that gains time.
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
        self._own = self.detail.shape == grid.shape  # each voxel has its own extinction
        self.lower, self.sides = np.array(lower), np.array(upper) - np.array(lower)
        self._to_voxels = grid.coordinates.matrix[:3, :3]
        self._lines = max(int(np.prod(np.delete(self.sides, axis))) for axis in range(3))
        self._lanes = dr.arange(mi.UInt32, self._lines)
        dr.eval(self._lanes)
        self.together = grid.voxel_count <= SMALL
        opaque = OPAQUE * np.linalg.norm(self._to_voxels, axis=1).max()
        top = float(min(dr.max(sigma_t)[0], opaque))
        self._quantum = top / LEVELS
        levels = sigma_t * dr.opaque(mi.Float, LEVELS / top if top else 0)
        self._levels = _rounded(dr.minimum(levels, LEVELS))
        dr.eval(self._levels)
        self._halves: dict[int, mi.UInt32] = {}  # of slices along axes
        self._wanted = dr.arange(mi.UInt32, grid.voxel_count) if wanted is None else wanted
        self._empty: Emptiness | None = None
        if sparse and not self.together:
            self._empty = Emptiness.find(grid, self._wanted, lower, upper)
        if self.together:
            self._all_corners = [self._corners_across(axis) for axis in range(3)]
            dr.eval(self._all_corners)

    def table(
        self,
        directions: np.ndarray,
        light: np.ndarray,
        weights: np.ndarray,
        offsets: np.ndarray,
        by_slice: bool = False,
    ) -> Table:
        """What kernels need to know of pairs of opposite directions.

        Args:
            directions: (n, 3), where the light goes to, world space, unit length.
            light: (n, 2), irradiance that enters along a direction and along its opposite: radiance
                times solid angle.
            weights: (n), solid angles that each of a pair stands for, for light from the voxels.
            offsets: (n, 2), in [0, 1), random.
            by_slice: whether the volume that lines leave light in is laid out by their slices.
        """
        count = len(directions)
        integers = np.zeros((count, _INTEGERS), np.int64)
        numbers = np.zeros((count, _NUMBERS), np.float64)
        velocities = directions @ self._to_voxels.T
        axes = np.abs(velocities).argmax(axis=1)
        ratio = self.detail.resolution / self.grid.resolution
        for i, (velocity, axis) in enumerate(zip(velocities, axes, strict=True)):
            ways = light[i] if velocity[axis] > 0 else light[i][::-1]
            across = [k for k in range(3) if k != axis]
            order = (*across, axis)
            layout = _by_slice(axis)
            strides = _strides(self.grid.resolution, layout if by_slice else STANDARD)
            places = _strides(self._slices(axis), layout)
            row = [*(int(self.sides[k]) for k in order), *(strides[k] for k in order)]
            row += [int(np.dot(self.lower, strides)), *(places[k] for k in order)]
            row += [
                int(np.dot(self.lower, places) if self._own else self.lower[axis] * places[axis])
            ]
            for k, offset in zip(across, offsets[i], strict=True):
                slope = round(velocity[k] / velocity[axis] * ONE)
                slope = slope or 1  # lines never stay in a face
                start = min(int(offset * ONE), ONE - 1)
                end = start + (int(self.sides[axis]) - 1) * slope
                row += [slope, start, (end >> 24) % int(self.sides[k]), end & (ONE - 1)]
            row += [self._empty.strides[k] for k in order] if self._empty else [0, 0, 0]
            integers[i] = row
            numbers[i, :5] = [1 / abs(velocity[axis]), *ways, weights[i], self._quantum]
            numbers[i, 5:] = [
                x
                for k in across
                for x in (ratio[k], self.lower[k] * ratio[k] - 0.5, self.detail.resolution[k] - 1)
            ]
        rows = Rows(axes, velocities[np.arange(count), axes] > 0, integers)
        return Table(integers, numbers, rows)

    def carry(
        self,
        directions: np.ndarray,
        light: np.ndarray,
        offsets: np.ndarray,
        entering: Callable | None = None,
    ) -> mi.Float:
        """Irradiance at the centres of the wanted voxels: the light that enters along pairs of
        directions, told as in `table`; instead of that ``light``, line by line, if a function of
        the table is given that makes `Entering`.
        """
        table = self.table(directions, light, np.zeros(len(light)), offsets, by_slice=True)
        table.entering = entering(table) if entering is not None else None
        box = self.lower, self.lower + self.sides
        total = dr.opaque(mi.Float, 0, dr.width(self._wanted))
        for axis, pairs in table.by_axis:
            volume = dr.opaque(mi.Float, 0, self.grid.voxel_count)
            self._launch(volume, False, table, axis, pairs)
            total += sharpened(volume, self.grid, *box, axis, self._wanted)
            dr.eval(total)
        return total

    def scatter(self, volume: mi.Float, table: Table) -> None:
        """Follows the light that comes from the voxels themselves, and that enters from outside.

        ``volume`` holds four values for each voxel: the radiance per optical depth that it sends
        out, S, and three that are added to: its irradiance; what lines lose in it, the integral of
        L - S over optical depth and directions; and the integral of 1, W. So S plus the mean loss,
        loss / W, is the mean radiance *of collisions*: what is scattered from it is neither more
        nor less than what has collided.
        """
        for axis, pairs in table.by_axis:
            self._launch(volume, True, table, axis, pairs)

    def _launch(
        self, volume: mi.Float, scatters: bool, table: Table, axis: int, pairs: list[int]
    ) -> None:
        """Follows the ``pairs`` of ``table``, all of which have the dominant ``axis``."""
        if self.together:
            most = max(1, COPIES // self.grid.voxel_count)
            for start in range(0, len(pairs), most):
                self._launch_together(volume, scatters, table, axis, pairs[start : start + most])
            return
        corners = self._corners_across(axis)  # one set at a time is kept
        dr.eval(corners)
        empty = self._empty.slices if self._empty and not scatters else None
        source = volume if scatters else None
        for i in pairs:
            _sweep(
                corners, self._own, empty, volume, source, table, table.places[i],
                self._lanes, dr.opaque(mi.UInt32, 0),
            )  # fmt: skip
            dr.eval(volume)
            self.pause()

    def _launch_together(
        self, volume: mi.Float, scatters: bool, table: Table, axis: int, pairs: list[int]
    ) -> None:
        """The same in one launch; the ``pairs`` follow each other in the table's order."""
        voxels, count = self.grid.voxel_count, len(pairs)
        lines = dr.opaque(mi.UInt32, self._lines)
        lanes = dr.arange(mi.UInt32, self._lines * count)
        row = lanes // lines
        first = dr.opaque(mi.UInt32, table.order.index(pairs[0]))
        which = dr.gather(mi.UInt32, table.ordered, first + row)
        copies = dr.opaque(mi.Float, 0, dr.width(volume) * count)
        _sweep(
            self._all_corners[axis], self._own, None, copies, volume if scatters else None, table,
            which, lanes - row * lines, row * dr.opaque(mi.UInt32, voxels),
        )  # fmt: skip
        dr.eval(copies)
        _add(volume, copies, voxels, count, mi.Vector4f if scatters else mi.Float)
        dr.eval(volume)
        self.pause()

    def _slices(self, axis: int) -> np.ndarray:
        """Values of the extinction along x, y, z: a slice for each of the grid's along ``axis``."""
        sides = self.detail.resolution.copy()
        sides[axis] = self.grid.resolution[axis]
        return sides

    def _corners_across(self, axis: int) -> mi.UInt32:
        """For each value of the extinction in all slices along ``axis`` those of four, from it on
        along both other axes: flat, two words of two values each, or four words of the means over
        both halves of a slice, unless voxels have their own values.
        """
        sides = self._slices(axis)
        if self._own:
            values = self._levels
        elif axis in self._halves:
            values = self._halves[axis]
        else:
            count = int(sides[axis])
            values = self._halves[axis] = _halved(self._levels, self.detail, count, axis)
        at = _places(sides, _by_slice(axis))
        index, strides = _flat(at, _strides(sides)), _strides(sides)
        steps = []
        for k in range(3):
            if k != axis:
                last = dr.opaque(mi.UInt32, int(sides[k]) - 1)
                steps.append(dr.select(at[k] < last, dr.opaque(mi.UInt32, strides[k]), 0))
        places = [row + step for row in (index, index + steps[1]) for step in (0, steps[0])]
        words = [dr.gather(mi.UInt32, values, place) for place in places]
        if not self._own:
            return dr.ravel(mi.Array4u(words))
        return dr.ravel(mi.Vector2u(words[0] | words[1] << 16, words[2] | words[3] << 16))


def _by_slice(axis: int) -> tuple[int, int, int]:
    """The axes from the fastest to the slowest, such that neighbours across ``axis`` are near each
    other in memory. Slices along y and z are so as they are.
    """
    return (1, 2, 0) if axis == 0 else STANDARD


def _strides(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> tuple[int, int, int]:
    """Steps of the flat index along x, y, z."""
    steps, step = [0, 0, 0], 1
    for axis in layout:
        steps[axis] = step
        step *= int(sides[axis])
    return tuple(steps)


def _places(sides: np.ndarray, layout: tuple[int, ...] = STANDARD) -> list[mi.UInt32]:
    """Places along x, y, z of all values in the order of their memory."""
    index = dr.arange(mi.UInt32, int(np.prod(sides)))
    first, second = (dr.opaque(mi.UInt32, int(sides[axis])) for axis in layout[:2])
    row = index // first
    places = index - row * first, row % second, row // second
    return [place for _, place in sorted(zip(layout, places, strict=True), key=lambda p: p[0])]


def _flat(places: Sequence[mi.UInt32], strides: tuple[int, ...]) -> mi.UInt32:
    """Flat indices of places along x, y, z."""
    x, y, z = (p * dr.opaque(mi.UInt32, n) for p, n in zip(places, strides, strict=True))
    return x + y + z


def _rounded(values: mi.Float, shift: float = 0.0) -> mi.UInt32:
    """Integers, up or down by the golden ratio: right on average over any few neighbours."""
    place = dr.arange(mi.UInt32, dr.width(values))
    dither = mi.Float((place * 2654435769 + int(shift * 2**32)) >> 8) * 2**-24
    return mi.UInt32(dr.minimum(values + dither, LEVELS))


def _halved(levels: mi.UInt32, grid: Grid, count: int, axis: int) -> mi.UInt32:
    """``levels`` of the voxels of ``grid`` in ``count`` slices along ``axis`` instead: means over
    the first half of their thickness, and over the second one in the upper 16 bits.
    """
    sides, strides = grid.resolution.copy(), _strides(grid.resolution)
    before, sides[axis] = int(sides[axis]), count
    at = _places(sides)
    begin, at[axis] = mi.Float(at[axis]), mi.UInt32(0)
    rest, stride = _flat(at, strides), dr.opaque(mi.UInt32, strides[axis])
    ratio, last = dr.opaque(mi.Float, before / count), dr.opaque(mi.Float, before - 1)
    step = dr.select(last > 0, stride, 0)
    halves = []
    for half in range(2):
        total = 0.0
        # Two points: exact where kinks, the centres of voxels, lie between them or at the ends.
        for point in (0.125, 0.375):
            u = dr.clip((begin + (0.5 * half + point)) * ratio - 0.5, 0, last)
            lower = mi.UInt32(dr.minimum(u, dr.maximum(last - 1, 0)))
            place = rest + lower * stride
            low, high = (dr.gather(mi.UInt32, levels, i) for i in (place, place + step))
            total += dr.lerp(mi.Float(low), mi.Float(high), u - mi.Float(lower))
        halves.append(_rounded(0.5 * total, 0.5 * half))
    result = halves[0] | halves[1] << 16
    dr.eval(result)
    return result


def sharpened(
    values: mi.Float,
    grid: Grid,
    lower: np.ndarray,
    upper: np.ndarray,
    axis: int,
    index: mi.UInt32,
) -> mi.Float:
    """Values at the centres of the voxels ``index`` between ``lower`` and ``upper`` (x, y, z),
    given means over the cross sections of all voxels across ``axis``, ``values``, laid out by
    slices: second differences along both other axes take back what the mean has smoothed. Never
    negative.
    """
    places, strides = grid.places(index), _strides(grid.resolution, _by_slice(axis))
    place = _flat(places, strides)
    value, change = dr.gather(mi.Float, values, place), mi.Float(0)
    for k, (at, stride) in enumerate(zip(places, strides, strict=True)):
        if k == axis or upper[k] - lower[k] < 3:
            continue
        stride, first, last = (dr.opaque(mi.UInt32, n) for n in (stride, lower[k], upper[k] - 1))
        # At a border, the second difference of the voxel next to it.
        centre = place + dr.select(at == first, stride, 0) - dr.select(at == last, stride, 0)
        here, below, above = (
            dr.gather(mi.Float, values, i) for i in (centre, centre - stride, centre + stride)
        )
        # Where no line has left anything, nothing is known.
        change += dr.select((below > 0) & (above > 0), 2 * here - below - above, 0)
    return dr.maximum(dr.fma(change, dr.opaque(mi.Float, RECEIVED), value), 0)


class Table:
    """Parameters of pairs of directions as arrays: another direction compiles nothing."""

    def __init__(self, integers: np.ndarray, numbers: np.ndarray, rows: Rows) -> None:
        self.rows = rows
        #: the light that enters, where it is not the same along all lines of a pair
        self.entering: Entering | None = None
        self.integers = mi.Int32(integers.astype(np.int32).ravel())
        self.numbers = mi.Float(numbers.astype(np.float32).ravel())
        found = [(axis, np.flatnonzero(rows.axis == axis).tolist()) for axis in range(3)]
        #: the pairs of each dominant axis, which have their corners in common
        self.by_axis = [(axis, pairs) for axis, pairs in found if pairs]
        self.places = [dr.opaque(mi.UInt32, i) for i in range(len(integers))]
        self.order = [i for _, pairs in self.by_axis for i in pairs]
        # One more, since kernels that read an array of a single value are different ones.
        self.ordered = mi.UInt32([*self.order, 0, 1])


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


class Entering:
    """The light that enters a box along lines [irradiance: radiance times solid angle].

    The lines of a pair are told apart by where they pass the first slice, or would if they did not
    enter the box behind it. A scale times these two coordinates, moved, is a place among cells,
    each of which has two of the ``values``: along the axis, and against it.
    """

    def __init__(
        self, places: np.ndarray, cells: np.ndarray, values: mi.Float | None = None
    ) -> None:
        """``places``: for each pair scale, moves (2) and slopes (2) of the lines; ``cells``: the
        first value, and the cells along both axes.
        """
        self._places = mi.Float(places.ravel().tolist())
        self._cells = mi.UInt32(cells.ravel().tolist())
        self.values = values

    def pair(self, which: mi.UInt32) -> list:
        """What `at` has to know of pairs."""
        places = [dr.gather(mi.Float, self._places, which * 5 + i) for i in range(5)]
        return places + [dr.gather(mi.UInt32, self._cells, which * 3 + i) for i in range(3)]

    def at(self, pair: list, way: int, slice_, ib, fb, ic, fc, active) -> mi.Float:
        """The light of lines that are at these voxels, and positions in them, in a slice."""
        scale, move_b, move_c, slope_b, slope_c, first, nb, nc = pair
        k = mi.Float(slice_)
        b = dr.fma(-slope_b, k, dr.fma(mi.Float(fb), 1 / ONE, mi.Float(ib)))
        c = dr.fma(-slope_c, k, dr.fma(mi.Float(fc), 1 / ONE, mi.Float(ic)))
        b, c = (mi.Int32(dr.floor(dr.fma(x, scale, m))) for x, m in ((b, move_b), (c, move_c)))
        active = active & (b >= 0) & (c >= 0) & (b < mi.Int32(nb)) & (c < mi.Int32(nc))
        place = first + (mi.UInt32(c) * nb + mi.UInt32(b)) * 2 + way
        return dr.gather(mi.Float, self.values, place, active)


class _Across:
    """One way along the lines, and one of the axes across: its constants."""

    def __init__(self, sides: mi.Int32, slope: mi.Int32, detail: tuple) -> None:
        self.sides, self.slope = sides, slope
        self.stride, self.ratio, self.origin, self.last = detail
        forward = slope > 0
        self.entry = dr.select(forward, 0, sides - 1)
        # Distance to the side of entry, in slices: (zero + sign * position) * scale.
        self.zero = dr.select(forward, mi.Float(0), mi.Float(1))
        self.sign = dr.select(forward, mi.Float(1), mi.Float(-1)) * (1 / ONE)
        self.scale = ONE / mi.Float(dr.abs(slope))

    def since(self, position: mi.Int32) -> mi.Float:
        """Slices since the face of entry, in the voxel that adjoins it."""
        return dr.fma(mi.Float(position), self.sign, self.zero) * self.scale

    def start(self, voxel: mi.Int32, position: mi.Int32) -> mi.Float:
        """Slices since entry in the first slice: half of one, or less through a side."""
        near = self.since(position)
        return dr.select(voxel == self.entry, dr.minimum(near, 0.5), 0.5)

    def advance(self, voxel: mi.Int32, position: mi.Int32, slices: mi.Int32 | int = 1) -> tuple:
        """Voxel and position some ``slices`` on, and the slices since entry: 1 unless it is new."""
        moved = position + self.slope * slices
        position = moved & (ONE - 1)
        voxel = voxel + (moved >> 24)
        outside = mi.UInt32(voxel) >= mi.UInt32(self.sides)
        voxel = dr.select(outside, self.entry, voxel)
        return voxel, position, dr.select(outside, self.since(position), 1.0)

    def lower(self, voxel: mi.Int32, position: mi.Int32, own: bool) -> tuple:
        """Of the two values of the extinction around the line, where the lower one is, and the
        weight of the upper one. ``own``: each voxel has its own value.
        """
        if own:
            before = position < ONE // 2
            weight = dr.fma(mi.Float(position), 1 / ONE, dr.select(before, 0.5, -0.5))
            lower = dr.maximum(voxel - dr.select(before, 1, 0), 0)
            return lower * self.stride, dr.select(before & (voxel == 0), 0, weight)
        place = dr.fma(mi.Float(position), 1 / ONE, mi.Float(voxel))
        u = dr.clip(dr.fma(place, self.ratio, self.origin), 0, self.last)
        lower = mi.Int32(u)
        return lower * self.stride, u - mi.Float(lower)


@dr.syntax
def _sweep(
    corners: mi.UInt32,
    own: bool,
    empty: mi.UInt32 | None,
    volume: mi.Float,
    source: mi.Float | None,
    table: Table,
    which: mi.UInt32,
    lanes: mi.UInt32,
    copy: mi.UInt32,
):
    """Follows pairs of directions. ``empty``: the slices that may be skipped, of `Emptiness`.
    ``source``: what `Lattice.scatter` calls volume, None if voxels send no light; may be ``volume``
    itself, where the light is left, from voxel ``copy`` on.
    """
    entering, apart = table.entering, source is not volume
    row = [dr.gather(mi.Int32, table.integers, which * _INTEGERS + i) for i in range(_INTEGERS)]
    nb, nc, na, sb, sc, sa, base, tb, tc, ta, shift, mb, fb, eb, gb, mc, fc, ec, gc = row[:19]
    cells = row[19:]
    length, light, light_back, weight, quantum, *detail = (
        dr.gather(mi.Float, table.numbers, which * _NUMBERS + i) for i in range(_NUMBERS)
    )
    detail_b, detail_c = (tb, *detail[:3]), (tc, *detail[3:])
    lane = mi.Int32(lanes)
    jc = lane // dr.maximum(nb, 1)  # 0 where a vector of lanes is not filled
    jb = lane - jc * nb
    active = (jc < nc) & (na > 0)
    there_b, there_c = _Across(nb, mb, detail_b), _Across(nc, mc, detail_c)
    back_b, back_c = _Across(nb, -mb, detail_b), _Across(nc, -mc, detail_c)
    # The state of both ways: voxel and position along both axes across, offset of the slice, slices
    # since entry (1: not new), radiance, and depth and source in the slice before.
    width = 0 * lane
    ib, ic, fb, fc, off = mi.Int32(jb), mi.Int32(jc), fb + width, fc + width, base + width
    since = dr.minimum(there_b.start(ib, fb), there_c.start(ic, fc))
    kb, kc, gb, gc, off_back = (
        jb + eb,
        jc + ec,
        gb + width,
        gc + width,
        base + sa * (na - 1) + width,
    )
    kb, kc = dr.select(kb >= nb, kb - nb, kb), dr.select(kc >= nc, kc - nc, kc)
    since_back = dr.minimum(back_b.start(kb, gb), back_c.start(kc, gc))
    slice_, slice_back = shift + width, shift + ta * (na - 1) + width
    L, L_back, s0, s0_back = mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(0)
    scale, area = quantum * length, dr.rcp(length)
    # Slices behind, of both ways; where they skip some, each is in a slice of its own.
    k, k_back, active_back = mi.Int32(0), mi.Int32(0), mi.Bool(active)
    ahead, ahead_back = mi.Int32(1), mi.Int32(1)
    needed, needed_back = mi.Bool(active), mi.Bool(active)
    if dr.hint(entering is not None, mode="scalar"):
        pair = entering.pair(which)
    while dr.hint(active | active_back, label="slices"):
        if dr.hint(empty is not None, mode="scalar"):
            ahead = _slices(empty, cells, ib, ic, k, active)
            ahead_back = _slices(empty, cells, kb, kc, na - 1 - k_back, active_back)
            needed, needed_back = active & (ahead == 0), active_back & (ahead_back == 0)
            ahead, ahead_back = dr.maximum(ahead, 1), dr.maximum(ahead_back, 1)
        else:
            active_back = needed = needed_back = active
            k_back = k
        index = mi.UInt32(ib * sb + ic * sc + off)
        index_back = mi.UInt32(kb * sb + kc * sc + off_back)
        place, place_back = index + copy, index_back + copy
        # Of the half before the middle of the slice, and of the half behind it.
        s, s_next = _levels(corners, own, slice_, there_b, there_c, ib, fb, ic, fc, needed)
        s_next_back, s_back = _levels(
            corners, own, slice_back, back_b, back_c, kb, gb, kc, gc, needed_back
        )
        if dr.hint(entering is not None, mode="scalar"):
            new, new_back = active & (since < 1), active_back & (since_back < 1)
            found = entering.at(pair, 0, k, ib, fb, ic, fc, new)
            found_back = entering.at(pair, 1, na - 1 - k_back, kb, gb, kc, gc, new_back)
            L, L_back = dr.select(new, found, L), dr.select(new_back, found_back, L_back)
        else:
            L = dr.select(since < 1, light, L)
            L_back = dr.select(since_back < 1, light_back, L_back)
        # In the middle slice both ways are in the same voxel: the first to write writes for both.
        middle = off == off_back
        if dr.hint(source is None, mode="scalar"):
            L *= _passed(since, s0, s, scale)
            L_back *= _passed(since_back, s0_back, s_back, scale)
            before = dr.gather(mi.Float, volume, place, needed)
            before_back = dr.gather(mi.Float, volume, place_back, needed_back)
            dr.scatter(volume, before + L + dr.select(middle, L_back, 0), place, needed)
            dr.scatter(volume, before_back + L_back, place_back, needed_back & ~middle)
        else:
            voxel = dr.gather(mi.Vector4f, volume, place, active)
            voxel_back = dr.gather(mi.Vector4f, volume, place_back, active)
            sent, sent_back = voxel.x, voxel_back.x
            if dr.hint(apart, mode="scalar"):
                sent = dr.gather(mi.Float, source, index * 4, active)
                sent_back = dr.gather(mi.Float, source, index_back * 4, active)
            L, tally = _crossed(L, sent * weight, s * scale, s_next * scale, since, weight, area)
            L_back, tally_back = _crossed(
                L_back,
                sent_back * weight,
                s_back * scale,
                s_next_back * scale,
                since_back,
                weight,
                area,
            )
            tally += dr.select(middle, tally_back, 0)
            dr.scatter(volume, voxel + tally, place, active)
            dr.scatter(volume, voxel_back + tally_back, place_back, active & ~middle)
        s0, s0_back = s_next, s_next_back
        ib, fb, since = there_b.advance(ib, fb, ahead)
        ic, fc, near = there_c.advance(ic, fc, ahead)
        since = dr.minimum(near, since)
        kb, gb, since_back = back_b.advance(kb, gb, ahead_back)
        kc, gc, near_back = back_c.advance(kc, gc, ahead_back)
        since_back = dr.minimum(near_back, since_back)
        off += sa * ahead
        off_back -= sa * ahead_back
        slice_ += ta * ahead
        slice_back -= ta * ahead_back
        k += ahead
        active &= k < na
        if dr.hint(empty is not None, mode="scalar"):
            k_back += ahead_back
            active_back &= k_back < na


@dr.syntax
def _add(volume: mi.Float, copies: mi.Float, voxels: int, count: int, kind: type) -> None:
    """Adds to the ``voxels`` of ``volume``, values of this ``kind``, those of ``count`` copies, one
    after the other.
    """
    index = dr.arange(mi.UInt32, voxels)
    step, end = dr.opaque(mi.UInt32, voxels), dr.opaque(mi.UInt32, voxels * count)
    total, place = dr.gather(kind, volume, index), mi.UInt32(index)
    while dr.hint(place < end, label="copies"):
        total += dr.gather(kind, copies, place)
        place += step
    dr.scatter(volume, total, index)


def _slices(empty, strides, b, c, a, active) -> mi.Int32:
    """Slices that a line may skip from voxel (b, c) of slice ``a``, 0 where it is needed."""
    cell = sum(n * mi.Int32(mi.UInt32(i) // CELL) for n, i in zip(strides, (b, c, a), strict=True))
    return mi.Int32(dr.gather(mi.UInt32, empty, mi.UInt32(cell), active))


def _levels(corners, own, slice_, across_b, across_c, ib, fb, ic, fc, active) -> tuple:
    """Extinction of a line in both halves of a slice, bilinear, in units of the quantum."""
    place_b, weight_b = across_b.lower(ib, fb, own)
    place_c, weight_c = across_c.lower(ic, fc, own)

    def bilinear(v00, v10, v01, v11):
        rows = [dr.fma(high - low, weight_b, low) for low, high in ((v00, v10), (v01, v11))]
        return dr.fma(rows[1] - rows[0], weight_c, rows[0])

    place = mi.UInt32(slice_ + place_b + place_c)
    if own:
        words = dr.gather(mi.Vector2u, corners, place, active)
        value = bilinear(*(mi.Float(v) for w in words for v in (w & 0xFFFF, w >> 16)))
        return value, value
    words = dr.gather(mi.Array4u, corners, place, active)
    first, second = ([mi.Float(w & 0xFFFF) for w in words], [mi.Float(w >> 16) for w in words])
    return bilinear(*first), bilinear(*second)


def _passed(since, before, here, scale) -> mi.Float:
    """Transmittance from the slice before: half of it and half of this one, or what of this one
    lies behind the entry.
    """
    return dr.exp(-dr.select(since < 1, here * since, 0.5 * (before + here)) * scale)


def _crossed(L, source, first, second, since, weight, area) -> tuple:
    """Radiance behind a slice, and what its voxel tallies, for a source that is constant in it.
    ``first`` and ``second`` are the slice's optical depths, were it all like that half.

    A line stands for an ``area`` across it that is the less the longer it stays in a voxel.
    """
    to_middle = dr.select(since < 1, since, 0.5) * first
    tau = dr.fma(second, 0.5, to_middle)
    passed = dr.exp(-tau)
    # Thin voxels lose little, but what they scatter is known from just that.
    lost = (L - source) * dr.select(tau < 1e-3, tau * dr.fma(tau, -0.5, 1), 1 - passed)
    half = dr.sqrt(passed) if first is second else dr.exp(-to_middle)
    middle = dr.fma(L - source, half, source)
    return L - lost, mi.Vector4f(0, middle, lost * area, weight * tau * area)
