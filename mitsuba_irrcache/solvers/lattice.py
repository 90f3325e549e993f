"""Sweeps along parallel lines that all voxels of a grid share.

For one direction, lines lie on the lattice of the voxels of a slice across the direction's dominant
axis, moved by a random fraction of a voxel, and advance slice by slice. From one slice to the next
all lines move by the same number of whole voxels: in every slice each voxel has exactly one line.
So a voxel and direction cost one step, whatever the size of the grid, and no two lines ever write
to the same voxel. A line that leaves through a side goes on as a new one that enters through the
opposite side; it begins at the very point of entry, between two slices.

Along a line the extinction is interpolated between the four voxels around it in every slice, and
linear from slice to slice; a source is that of the line's voxel in every slice.

Each launch takes a direction and its opposite along the same lines: two independent chains of
arithmetic, and the odd part of what is integrated over directions cancels.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grid import Grid

#: Positions within a voxel are integers below this: lines can be followed back without rounding.
ONE = 1 << 24
#: Extinction is kept in 16 bits, rounded at random, between 0 and the largest there is, at most
#: this optical depth of a voxel.
OPAQUE = 16.0
LEVELS = (1 << 16) - 1
#: What `carry` gives a voxel is a mean over its cross section: smoothing of variance 1/12 along two
#: of three axes, half of which is to be taken back (`sharpened`).
RECEIVED = 1 / 36
#: Below so many voxels one launch takes all directions and adds atomically.
SMALL = 40**3

_INTEGERS = 16
_NUMBERS = 5


class Lattice:
    """The lines through the voxels of ``grid`` between ``lower`` and ``upper`` (x, y, z; voxels
    outside of this box are empty and get no light).

    ``sigma_t`` holds the extinction [1/scene unit] of all voxels of the grid.
    """

    def __init__(self, grid: Grid, sigma_t: mi.Float, lower: np.ndarray, upper: np.ndarray) -> None:
        self.grid = grid
        self.sides = np.array(upper) - np.array(lower)
        nx, ny, _ = (int(n) for n in grid.resolution)
        self._strides = (1, nx, nx * ny)
        self._base = int(np.dot(lower, self._strides))
        self._to_voxels = grid.coordinates.matrix[:3, :3]
        self._lines = max(int(np.prod(np.delete(self.sides, axis))) for axis in range(3))
        self._lanes = dr.arange(mi.UInt32, self._lines)
        dr.eval(self._lanes)
        self.together = grid.voxel_count <= SMALL
        opaque = OPAQUE * np.linalg.norm(self._to_voxels, axis=1).max()
        top = float(min(dr.max(sigma_t)[0], opaque))
        self._quantum = top / LEVELS
        levels = sigma_t * dr.opaque(mi.Float, LEVELS / top if top else 0)
        place = dr.arange(mi.UInt32, grid.voxel_count)
        dither = mi.Float(mi.sample_tea_32(place, mi.UInt32(0x5EED), 8)[0] >> 8) * 2**-24
        self._levels = mi.UInt32(dr.minimum(dr.floor(levels + dither), LEVELS))
        dr.eval(self._levels)
        if self.together:
            self._all_corners = dr.concat([self._corners_across(axis) for axis in range(3)])
            dr.eval(self._all_corners)

    def table(
        self, directions: np.ndarray, light: np.ndarray, weights: np.ndarray, offsets: np.ndarray
    ) -> Table:
        """What kernels need to know of pairs of opposite directions.

        Args:
            directions: (n, 3), where the light goes to, world space, unit length.
            light: (n, 2), irradiance that enters along a direction and along its opposite: radiance
                times solid angle.
            weights: (n), solid angles that each of a pair stands for, for light from the voxels.
            offsets: (n, 2), in [0, 1), random.
        """
        count = len(directions)
        integers = np.zeros((count, _INTEGERS), np.int64)
        numbers = np.zeros((count, _NUMBERS), np.float64)
        velocities = directions @ self._to_voxels.T
        axes = np.abs(velocities).argmax(axis=1)
        for i, (velocity, axis) in enumerate(zip(velocities, axes, strict=True)):
            ways = light[i] if velocity[axis] > 0 else light[i][::-1]
            across = [k for k in range(3) if k != axis]
            order = (*across, axis)
            row = [*(int(self.sides[k]) for k in order), *(self._strides[k] for k in order)]
            row += [self._base, int(axis) * self.grid.voxel_count if self.together else 0]
            for k, offset in zip(across, offsets[i], strict=True):
                slope = round(velocity[k] / velocity[axis] * ONE)
                slope = slope or 1  # lines never stay in a face
                start = min(int(offset * ONE), ONE - 1)
                end = start + (int(self.sides[axis]) - 1) * slope
                row += [slope, start, (end >> 24) % int(self.sides[k]), end & (ONE - 1)]
            integers[i] = row
            length = 1 / abs(velocity[axis])
            numbers[i] = [length, *ways, weights[i], self._quantum]
        return Table(integers, numbers, axes)

    def carry(self, volume: mi.Float, table: Table) -> None:
        """Adds to ``volume``, one value for each voxel of the grid, the light that enters along all
        pairs of ``table``: irradiance.
        """
        self._launch(volume, None, table)

    def scatter(self, volume: mi.Float, table: Table) -> None:
        """Follows the light that comes from the voxels themselves, and that enters from outside.

        ``volume`` holds four values for each voxel: the radiance per optical depth that it sends
        out, S, and three that are added to: its irradiance; what lines lose in it, the integral of
        L - S over optical depth and directions; and the integral of 1, W. So S plus the mean loss,
        loss / W, is the mean radiance *of collisions*: what is scattered from it is neither more
        nor less than what has collided.
        """
        if not self.together:
            self._launch(volume, volume, table)
            return
        index = dr.arange(mi.UInt32, self.grid.voxel_count) * 4
        source = dr.gather(mi.Float, volume, index)
        dr.eval(source)
        self._launch(volume, source, table)

    def _launch(self, volume: mi.Float, source: mi.Float | None, table: Table) -> None:
        if self.together:
            count = len(table.places)
            lanes = dr.arange(mi.UInt32, self._lines * count)
            lines = dr.opaque(mi.UInt32, self._lines)
            which = lanes // lines
            _sweep(self._all_corners, volume, source, table, which, lanes - which * lines, True)
            dr.eval(volume)
            return
        # By dominant axis, since each has its own corners: they are made when they are needed.
        corners, last = None, -1
        for axis, i in sorted(zip(table.axes, range(len(table.places)), strict=True)):
            if axis != last:
                corners, last = None, axis  # one set at a time is kept
                corners = self._corners_across(axis)
                dr.eval(corners)
            _sweep(corners, volume, source, table, table.places[i], self._lanes, False)
            dr.eval(volume)

    def _corners_across(self, axis: int) -> mi.UInt32:
        """For each voxel the extinction of the four voxels from it on along both other axes, 16
        bits each; flat, two words per voxel.
        """
        index = dr.arange(mi.UInt32, self.grid.voxel_count)
        at = self.grid.places(index)
        steps = []
        for k in range(3):
            if k != axis:
                last = dr.opaque(mi.UInt32, int(self.grid.resolution[k]) - 1)
                steps.append(dr.select(at[k] < last, dr.opaque(mi.UInt32, self._strides[k]), 0))
        words = []
        for start in (index, index + steps[1]):
            low, high = (dr.gather(mi.UInt32, self._levels, i) for i in (start, start + steps[0]))
            words.append(low | high << 16)
        return dr.ravel(mi.Vector2u(words))


def sharpened(values: mi.Float, grid: Grid, strength: float) -> mi.Float:
    """``values`` of all voxels less ``strength`` times their second differences along all axes:
    what smoothing by a kernel of twice that variance, in voxels, has taken away. Never negative.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count)
    nx, ny, nz = (mi.UInt32(n) for n in grid.sides)
    change = mi.Float(0)
    for i, n, stride in zip(
        grid.places(index), (nx, ny, nz), (mi.UInt32(1), nx, nx * ny), strict=True
    ):
        # At a border, the second difference of the voxel next to it.
        centre = index + dr.select(i == 0, stride, 0) - dr.select(i + 1 == n, stride, 0)
        for other in (centre - stride, centre + stride):
            here, there = (dr.gather(mi.Float, values, k, n > 2) for k in (centre, other))
            change += here - there
    return dr.maximum(dr.fma(change, dr.opaque(mi.Float, strength), values), 0)


class Table:
    """Parameters of pairs of directions as arrays: another direction compiles nothing."""

    def __init__(self, integers: np.ndarray, numbers: np.ndarray, axes: np.ndarray) -> None:
        self.integers = mi.Int32(integers.astype(np.int32).ravel())
        self.numbers = mi.Float(numbers.astype(np.float32).ravel())
        self.axes = [int(axis) for axis in axes]
        self.places = [dr.opaque(mi.UInt32, i) for i in range(len(integers))]


class _Across:
    """One way along the lines, and one of the axes across: its constants."""

    def __init__(self, sides: mi.Int32, stride: mi.Int32, slope: mi.Int32) -> None:
        self.sides, self.stride, self.slope = sides, stride, slope
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

    def advance(self, voxel: mi.Int32, position: mi.Int32) -> tuple:
        """Voxel and position in the next slice, and the slices since entry: 1 unless it is new."""
        moved = position + self.slope
        position = moved & (ONE - 1)
        voxel = voxel + (moved >> 24)
        outside = mi.UInt32(voxel) >= mi.UInt32(self.sides)
        voxel = dr.select(outside, self.entry, voxel)
        return voxel, position, dr.select(outside, self.since(position), 1.0)

    def lower(self, voxel: mi.Int32, position: mi.Int32) -> tuple:
        """Of the two voxels around the line, how far back the lower one is, and the weight of the
        upper one.
        """
        before, first = position < ONE // 2, voxel == 0
        weight = dr.fma(mi.Float(position), 1 / ONE, dr.select(before, 0.5, -0.5))
        back = dr.select(before & ~first, self.stride, 0)
        return back, dr.select(before & first, 0, weight)


@dr.syntax
def _sweep(
    corners: mi.UInt32,
    volume: mi.Float,
    source: mi.Float | None,
    table: Table,
    which: mi.UInt32,
    lanes: mi.UInt32,
    together: bool,
):
    """Follows a pair of directions. ``together``: lanes of all pairs at once, with a ``source`` of
    its own.
    """
    row = [dr.gather(mi.Int32, table.integers, which * _INTEGERS + i) for i in range(_INTEGERS)]
    nb, nc, na, sb, sc, sa, base, shift, mb, fb, eb, gb, mc, fc, ec, gc = row
    length, light, light_back, weight, quantum = (
        dr.gather(mi.Float, table.numbers, which * _NUMBERS + i) for i in range(_NUMBERS)
    )
    lane = mi.Int32(lanes)
    jc = lane // dr.maximum(nb, 1)  # 0 where a vector of lanes is not filled
    jb = lane - jc * nb
    active = (jc < nc) & (na > 0)
    there_b, there_c = _Across(nb, sb, mb), _Across(nc, sc, mc)
    back_b, back_c = _Across(nb, sb, -mb), _Across(nc, sc, -mc)
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
    L, L_back, s0, s0_back = mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(0)
    scale, area = quantum * length, dr.rcp(length)
    k = mi.Int32(0)
    while dr.hint(active, label="slices"):
        index = mi.UInt32(ib * sb + ic * sc + off)
        index_back = mi.UInt32(kb * sb + kc * sc + off_back)
        s = _level(corners, index + mi.UInt32(shift), there_b, there_c, ib, fb, ic, fc, active)
        s_back = _level(
            corners, index_back + mi.UInt32(shift), back_b, back_c, kb, gb, kc, gc, active
        )
        L = dr.select(since < 1, light, L)
        L_back = dr.select(since_back < 1, light_back, L_back)
        # In the middle slice both ways are in the same voxel: the first to write writes for both.
        middle = off == off_back
        if dr.hint(source is None, mode="scalar"):
            L *= _passed(since, s0, s, scale)
            L_back *= _passed(since_back, s0_back, s_back, scale)
            if dr.hint(together, mode="scalar"):
                dr.scatter_reduce(dr.ReduceOp.Add, volume, L, index, active)
                dr.scatter_reduce(dr.ReduceOp.Add, volume, L_back, index_back, active)
            else:
                before = dr.gather(mi.Float, volume, index, active)
                before_back = dr.gather(mi.Float, volume, index_back, active)
                dr.scatter(volume, before + L + dr.select(middle, L_back, 0), index, active)
                dr.scatter(volume, before_back + L_back, index_back, active & ~middle)
        else:
            if dr.hint(together, mode="scalar"):
                voxel, voxel_back = mi.Vector4f(0), mi.Vector4f(0)
                voxel.x = dr.gather(mi.Float, source, index, active)
                voxel_back.x = dr.gather(mi.Float, source, index_back, active)
            else:
                voxel = dr.gather(mi.Vector4f, volume, index, active)
                voxel_back = dr.gather(mi.Vector4f, volume, index_back, active)
            L, tally = _crossed(L, voxel.x * weight, s * scale, since, weight, area)
            L_back, tally_back = _crossed(
                L_back, voxel_back.x * weight, s_back * scale, since_back, weight, area
            )
            if dr.hint(together, mode="scalar"):
                for i in range(1, 4):
                    dr.scatter_reduce(dr.ReduceOp.Add, volume, tally[i], index * 4 + i, active)
                    dr.scatter_reduce(
                        dr.ReduceOp.Add, volume, tally_back[i], index_back * 4 + i, active
                    )
            else:
                tally += dr.select(middle, tally_back, 0)
                dr.scatter(volume, voxel + tally, index, active)
                dr.scatter(volume, voxel_back + tally_back, index_back, active & ~middle)
        s0, s0_back = s, s_back
        ib, fb, since = there_b.advance(ib, fb)
        ic, fc, near = there_c.advance(ic, fc)
        since = dr.minimum(near, since)
        kb, gb, since_back = back_b.advance(kb, gb)
        kc, gc, near_back = back_c.advance(kc, gc)
        since_back = dr.minimum(near_back, since_back)
        off += sa
        off_back -= sa
        k += 1
        active &= k < na


def _level(corners, index, across_b, across_c, ib, fb, ic, fc, active) -> mi.Float:
    """Extinction of a line in a slice, bilinear, in units of the quantum."""
    below_b, weight_b = across_b.lower(ib, fb)
    below_c, weight_c = across_c.lower(ic, fc)
    words = dr.gather(mi.Vector2u, corners, index - mi.UInt32(below_b + below_c), active)
    low, high = mi.Vector2f(words & 0xFFFF), mi.Vector2f(words >> 16)
    rows = dr.fma(high - low, weight_b, low)
    return dr.fma(rows.y - rows.x, weight_c, rows.x)


def _passed(since, before, here, scale) -> mi.Float:
    """Transmittance from the slice before: half of both slices' extinction, or what of this one's
    lies behind the entry.
    """
    return dr.exp(-dr.select(since < 1, here * since, 0.5 * (before + here)) * scale)


def _crossed(L, source, depth, since, weight, area) -> tuple:
    """Radiance behind a slice, and what its voxel tallies, for a source that is constant in it.

    A line stands for an ``area`` across it that is the less the longer it stays in a voxel.
    """
    tau = dr.select(since < 1, since + 0.5, 1) * depth
    passed = dr.exp(-tau)
    # Thin voxels lose little, but what they scatter is known from just that.
    lost = (L - source) * dr.select(tau < 1e-3, tau * dr.fma(tau, -0.5, 1), 1 - passed)
    middle = dr.fma(L - source, dr.sqrt(passed), source)
    return L - lost, mi.Vector4f(0, middle, lost * area, weight * tau * area)
