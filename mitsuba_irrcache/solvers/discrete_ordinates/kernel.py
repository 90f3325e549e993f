"""Lines in a kernel: how they go on from slice to slice, and what they take and leave there."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import absorbed, clipped, decay, least
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.solvers.discrete_ordinates.empty_space import CELL

#: Positions within a voxel are integers below this: lines can be followed back without rounding.
ONE = 1 << 24
#: Parameters of a pair of directions.
INTEGERS, NUMBERS = 22, 12
#: Of these, the solid angle, and the last three: where light along the axis goes to, world space.
WEIGHT, DIRECTION = 1, 9


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
        return dr.select(voxel == self.entry, least(near, 0.5), 0.5)

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
        u = clipped(dr.fma(place, self.ratio, self.origin), 0.0, self.last)
        lower = mi.Int32(u)
        return lower * self.stride, u - mi.Float(lower)

    def above(self, place: mi.Int32) -> mi.Int32:
        """From ``place``, of the lower value, to the upper one; there is none at the grid's end."""
        return dr.select(place < mi.Int32(self.last) * self.stride, self.stride, 0)


@symbolic
def follow(
    corners: mi.UInt32,
    words: int,
    empty: mi.UInt32 | None,
    volume: mi.Float,
    source: mi.Float | None,
    table,
    which: mi.UInt32,
    lanes: mi.UInt32,
    copy: mi.UInt32,
    channels: int = 1,
    copy_back: mi.UInt32 | None = None,
):
    """Follows pairs of directions. ``corners``: so many ``words`` together, of `Extinction`.
    ``empty``: the slices that may be skipped, of `EmptySpace`. ``source``: what `Tracks.scatter`
    calls volume, None if voxels send no light; may be ``volume`` itself, where the light is added,
    from voxel ``copy`` on. Light of several ``channels`` goes the same way; a voxel has those of
    all of them next to each other.

    With ``copy_back`` both ways are told apart: the light of opposite directions is left from that
    voxel on, nothing is added to anything, ``source`` holds what voxels send in both ways at the
    same places, one value each, depths are not times solid angles, and irradiance is without that
    of what the voxel sends itself.
    """
    entering, elsewhere, apart = table.entering, source is not volume, copy_back is not None
    row = [dr.gather(mi.Int32, table.integers, which * INTEGERS + i) for i in range(INTEGERS)]
    nb, nc, na, sb, sc, sa, base, tb, tc, ta, shift, mb, fb, eb, gb, mc, fc, ec, gc = row[:19]
    cells = row[19:]
    length, weight, quantum, *detail = (
        dr.gather(mi.Float, table.numbers, which * NUMBERS + i) for i in range(DIRECTION)
    )
    light, light_back = (table.entering_along(which, way, channels) for way in range(2))
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
    since = least(there_b.start(ib, fb), there_c.start(ic, fc))
    kb, kc, gb, gc, off_back = (
        jb + eb,
        jc + ec,
        gb + width,
        gc + width,
        base + sa * (na - 1) + width,
    )
    kb, kc = dr.select(kb >= nb, kb - nb, kb), dr.select(kc >= nc, kc - nc, kc)
    since_back = least(back_b.start(kb, gb), back_c.start(kc, gc))
    slice_, slice_back = shift + width, shift + ta * (na - 1) + width
    L, L_back = ([mi.Float(0) for _ in range(channels)] for _ in range(2))
    s0, s0_back = mi.Float(0), mi.Float(0)
    scale, area = quantum * length, dr.rcp(length)
    count = mi.Float(1) if apart else weight  # what depths are times
    # Slices behind, of both ways; where they skip some, each is in a slice of its own.
    k, k_back, active_back = mi.Int32(0), mi.Int32(0), mi.Bool(active)
    ahead, ahead_back = mi.Int32(1), mi.Int32(1)
    needed, needed_back = mi.Bool(active), mi.Bool(active)
    if dr.hint(entering is not None, mode="scalar"):
        pair, arriving = entering.pair(which), entering.layers()
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
        if dr.hint(channels > 1, mode="scalar"):
            index, index_back = index * channels, index_back * channels
        place, place_back = index + copy, index_back + (copy_back if apart else copy)
        # Of the half before the middle of the slice, and of the half behind it.
        s, s_next = _levels(corners, words, slice_, there_b, there_c, ib, fb, ic, fc, needed)
        s_next_back, s_back = _levels(
            corners, words, slice_back, back_b, back_c, kb, gb, kc, gc, needed_back
        )
        if dr.hint(entering is not None, mode="scalar"):
            new, new_back = active & (since < 1), active_back & (since_back < 1)
            found = entering.at(pair, arriving, 0, k, ib, fb, ic, fc, new)
            found_back = entering.at(pair, arriving, 1, na - 1 - k_back, kb, gb, kc, gc, new_back)
            L, L_back = _chosen(new, found, L), _chosen(new_back, found_back, L_back)
        else:
            L = _chosen(since < 1, light, L)
            L_back = _chosen(since_back < 1, light_back, L_back)
        # In the middle slice both ways are in the same voxel: the first to write writes for both.
        middle = off == off_back
        if dr.hint(source is None, mode="scalar"):
            L = _times(L, _passed(since, s0, s, scale))
            L_back = _times(L_back, _passed(since_back, s0_back, s_back, scale))
            if dr.hint(apart, mode="scalar"):
                _write(volume, L, place, needed)
                _write(volume, L_back, place_back, needed_back)
            else:
                before = _read(mi.Float, volume, place, channels, needed)
                before_back = _read(mi.Float, volume, place_back, channels, needed_back)
                both = _sum(_sum(before, L), _chosen(middle, L_back, len(L) * [0]))
                _write(volume, both, place, needed)
                _write(volume, _sum(before_back, L_back), place_back, needed_back & ~middle)
        else:
            if dr.hint(apart, mode="scalar"):
                sent = _read(mi.Float, source, place, channels, needed)
                sent_back = _read(mi.Float, source, place_back, channels, needed_back)
            else:
                voxel = _read(mi.Vector4f, volume, place, channels, needed)
                voxel_back = _read(mi.Vector4f, volume, place_back, channels, needed_back)
                sent, sent_back = _sent(voxel), _sent(voxel_back)
                if dr.hint(elsewhere, mode="scalar"):
                    sent = _sources(source, index, channels, needed)
                    sent_back = _sources(source, index_back, channels, needed_back)
            sent, sent_back = _times(sent, weight), _times(sent_back, weight)
            L, tally = _crossed(L, sent, s * scale, s_next * scale, since, count, area)
            L_back, tally_back = _crossed(
                L_back, sent_back, s_back * scale, s_next_back * scale, since_back, count, area
            )
            if dr.hint(apart, mode="scalar"):
                _write(volume, _without(tally, sent), place, needed)
                _write(volume, _without(tally_back, sent_back), place_back, needed_back)
            else:
                tally = _sum(tally, _chosen(middle, tally_back, len(L) * [0]))
                _write(volume, _sum(voxel, tally), place, needed)
                _write(volume, _sum(voxel_back, tally_back), place_back, needed_back & ~middle)
        s0, s0_back = s_next, s_next_back
        ib, fb, since = there_b.advance(ib, fb, ahead)
        ic, fc, near = there_c.advance(ic, fc, ahead)
        since = least(near, since)
        kb, gb, since_back = back_b.advance(kb, gb, ahead_back)
        kc, gc, near_back = back_c.advance(kc, gc, ahead_back)
        since_back = least(near_back, since_back)
        off += sa * ahead
        off_back -= sa * ahead_back
        slice_ += ta * ahead
        slice_back -= ta * ahead_back
        k += ahead
        active &= k < na
        if dr.hint(empty is not None, mode="scalar"):
            k_back += ahead_back
            active_back &= k_back < na


@symbolic
def add_copies(volume: mi.Float, copies: mi.Float, voxels: int, count: int, kind: type) -> None:
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


def _levels(corners, words, slice_, across_b, across_c, ib, fb, ic, fc, active) -> tuple:
    """Extinction of a line in both halves of a slice, bilinear, in units of the quantum."""
    own = words < 4
    place_b, weight_b = across_b.lower(ib, fb, own)
    place_c, weight_c = across_c.lower(ic, fc, own)

    def bilinear(v00, v10, v01, v11):
        rows = [dr.fma(high - low, weight_b, low) for low, high in ((v00, v10), (v01, v11))]
        return dr.fma(rows[1] - rows[0], weight_c, rows[0])

    place = mi.UInt32(slice_ + place_b + place_c)
    if words == 1:
        above = place + mi.UInt32(across_c.above(place_c))
        rows = [dr.gather(mi.UInt32, corners, p, active) for p in (place, above)]
    else:
        rows = dr.gather(mi.Vector2u if words == 2 else mi.Array4u, corners, place, active)
    if own:
        value = bilinear(*(mi.Float(v) for w in rows for v in (w & 0xFFFF, w >> 16)))
        return value, value
    first, second = ([mi.Float(w & 0xFFFF) for w in rows], [mi.Float(w >> 16) for w in rows])
    return bilinear(*first), bilinear(*second)


def _passed(since, before, here, scale) -> mi.Float:
    """Transmittance from the slice before: half of it and half of this one, or what of this one
    lies behind the entry.
    """
    return decay(dr.select(since < 1, here * since, 0.5 * (before + here)) * scale)


def _crossed(L: list, source: list, first, second, since, count, area) -> tuple[list, list]:
    """Radiance behind a slice, and what its voxel tallies, for a source that is constant in it.
    ``first`` and ``second`` are the slice's optical depths, were it all like that half.

    A line stands for an ``area`` across it that is the less the longer it stays in a voxel.
    """
    to_middle = dr.select(since < 1, since, 0.5) * first
    tau = dr.fma(second, 0.5, to_middle)
    passed = decay(tau)
    # Thin voxels lose little, but what they scatter is known from just that.
    share = absorbed(tau, passed)
    half = dr.sqrt(passed) if first is second else decay(to_middle)
    left, tally = [], []
    for x, sent in zip(L, source, strict=True):
        lost, middle = (x - sent) * share, dr.fma(x - sent, half, sent)
        left.append(x - lost)
        tally.append(mi.Vector4f(0, middle, lost * area, count * tau * area))
    return left, tally


# Of all channels


def _places(place: mi.UInt32, channels: int) -> list[mi.UInt32]:
    return [place, *(place + c for c in range(1, channels))]


def _read(kind: type, volume: mi.Float, place: mi.UInt32, channels: int, active: mi.Bool) -> list:
    return [dr.gather(kind, volume, p, active) for p in _places(place, channels)]


def _write(volume: mi.Float, values: list, place: mi.UInt32, active: mi.Bool) -> None:
    for value, p in zip(values, _places(place, len(values)), strict=True):
        dr.scatter(volume, value, p, active)


def _chosen(first: mi.Bool, values: list, others: list) -> list:
    return [dr.select(first, a, b) for a, b in zip(values, others, strict=True)]


def _sum(first: list, second: list) -> list:
    return [a + b for a, b in zip(first, second, strict=True)]


def _times(values: list, factor: mi.Float) -> list:
    return [value * factor for value in values]


def _sources(source: mi.Float, place: mi.UInt32, channels: int, active: mi.Bool) -> list:
    return [dr.gather(mi.Float, source, p * 4, active) for p in _places(place, channels)]


def _without(tally: list[mi.Vector4f], sent: list[mi.Float]) -> list[mi.Vector4f]:
    return [t - mi.Vector4f(0, s, 0, 0) for t, s in zip(tally, sent, strict=True)]


def _sent(voxels: list[mi.Vector4f]) -> list[mi.Float]:
    return [voxel.x for voxel in voxels]
