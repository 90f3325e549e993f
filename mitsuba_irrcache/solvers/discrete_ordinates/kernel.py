"""The sweep kernel: the transport equation solved along tracks, slice by slice.

Along a track of length s the equation of radiative transfer is ordinary (method of characteristics,
Askew 1972): dL/ds = sigma_t (S - L). With a source S that is constant in a voxel of optical depth
tau, L' = L e^-tau + S (1 - e^-tau), the step characteristic scheme (Lewis and Miller,
*Computational Methods of Neutron Transport*, 1984).

All radiance in this module is multiplied by the solid angle of its ordinate (ordinate weight), so
that sums over ordinates are irradiance (fluence rate).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import absorbed, clipped, decay, maximum, minimum
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.solvers.discrete_ordinates.empty_space import CELL
from mitsuba_irrcache.solvers.discrete_ordinates.track_record import (
    FIXED_POINT_BITS,
    FIXED_POINT_ONE,
    TrackRecord,
    TransverseFields,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import NO_VOXEL, TrackTable


@dataclass(frozen=True)
class SweptMedium:
    """The arrays of the medium that tracks read.

    ``corners`` is the result of `Extinction.corners` with this number of ``words``; ``empty`` is
    `EmptySpace.slices`, None if no slices are skipped.
    """

    corners: mi.UInt32
    words: int
    empty: mi.UInt32 | None = None


@dataclass(frozen=True)
class SweptVolume:
    """The array to which a sweep writes, and the source that it reads.

    Without ``source`` (no voxel emits or scatters), ``values`` has one value per voxel and channel,
    to which the irradiance is added. With a source, it has the four values of `Tracks.sweep`;
    ``source`` is the same array, or another one if ``values`` holds copies, in which case the copy
    of a lane starts at index ``begin`` (voxels times channels). Channels of a voxel are adjacent.

    With ``begin_backward`` the two ways of a pair are stored separately: the ordinate against the
    axis writes its values from that index on, and values are replaced instead of added to;
    ``source`` has one value per voxel and way in the same layout; W is not multiplied by solid
    angles, and the irradiance excludes the source of the voxel itself. With ``collisions`` there
    are two values instead of four: the radiance of collisions without the source of the voxel, and
    the optical depth.

    With ``emission``, ``source`` is radiance per length instead, which voxels without extinction
    have, too: "uniform" in a voxel, or "decaying" along each track like radiance that is attenuated
    by the voxel, with this value in its middle. Irradiance then includes the voxel's own.
    """

    values: mi.Float
    source: mi.Float | None
    begin: mi.UInt32
    channels: int = 1
    begin_backward: mi.UInt32 | None = None
    collisions: bool = False
    emission: str | None = None


class CarriedRadiance:
    """State of the tracks of one pair between two parts of a volume that is swept in parts.

    For either way it holds the radiance in each channel and the extinction of the last slice, one
    array each. ``before`` is ``after`` of the previous part, None in the first part. The positions
    of the tracks follow from the table, whose fields are those of the current part.
    """

    def __init__(self, before: tuple[list[mi.Float], list[mi.Float]] | None) -> None:
        self.before, self.after = before, None


@symbolic
def sweep_tracks(
    medium: SweptMedium,
    volume: SweptVolume,
    table: TrackTable,
    pair: mi.UInt32,
    track: mi.UInt32,
    carried: CarriedRadiance | None = None,
):
    """Sweep pairs of opposite ordinates; each lane sweeps one ``track`` of a ``pair`` of the table.

    Both ways are swept at once: two independent chains of arithmetic hide each other's latency.
    With ``carried``, the volume is a part of a larger one, and tracks continue from part to part.
    """
    sweep = _PairSweep(medium, volume, table, pair)
    # An array that the loop reads and writes has to be one of its variables.
    values, (forward, backward) = volume.values, sweep.begin(mi.Int32(track), carried)
    while dr.hint(forward.active | backward.active, label="slices"):
        forward, backward = sweep.cross_slice(values, forward, backward)
    if dr.hint(carried is not None, mode="scalar"):
        carried.after = tuple([*way.radiance, way.previous] for way in (forward, backward))


@symbolic
def add_copies(volume: mi.Float, copies: mi.Float, voxels: int, count: int, kind: type) -> None:
    """Add ``count`` consecutive ``copies`` to ``volume``, which has ``voxels`` values of this
    ``kind``.
    """
    index = dr.arange(mi.UInt32, voxels)
    step, end = dr.opaque(mi.UInt32, voxels), dr.opaque(mi.UInt32, voxels * count)
    total, place = dr.gather(kind, volume, index), mi.UInt32(index)
    while dr.hint(place < end, label="copies"):
        total += dr.gather(kind, copies, place)
        place += step
    dr.scatter(volume, total, index)


# One way of a pair


@dataclass
class _TrackState:
    """Loop state of the sweep over slices, for one way: positions and radiance of the tracks."""

    #: voxels along the transverse axes, and positions within them (fixed point)
    b: mi.Int32
    c: mi.Int32
    position_b: mi.Int32
    position_c: mi.Int32
    #: flat indices at which the slice begins: of the volume, of the extinction
    offset: mi.Int32
    extinction_offset: mi.Int32
    #: slices from the point of entry into the box to the middle of this slice (0 to 1) if the track
    #: has entered after the middle of the previous slice; 1 otherwise
    since_entry: mi.Float
    #: radiance in each channel, times the solid angle
    radiance: list[mi.Float]
    #: quantised extinction in the second half of the previous slice
    previous: mi.Float
    #: slices crossed, and whether there are more
    crossed: mi.Int32
    active: mi.Bool
    #: slices since the track left a surface behind the middle of the previous slice, 1 otherwise;
    #: None where no surfaces are among the voxels, or where a sweep has a source
    since_surface: mi.Float | None = None

    @property
    def at(self) -> tuple:
        """Voxels and positions, as `BoundarySource.irradiance` takes them."""
        return self.b, self.c, self.position_b, self.position_c


class _TransverseMotion:
    """Motion of the tracks of one way along one of the transverse axes."""

    def __init__(self, fields: TransverseFields, slope: mi.Int32) -> None:
        self.size, self.slope = fields.size, slope
        self.extinction_stride = fields.extinction_stride
        self.ratio, self.origin = fields.extinction_ratio, fields.extinction_origin
        self.last = fields.extinction_last
        forward = slope > 0
        #: voxel at the side through which tracks enter
        self.entry = dr.select(forward, 0, self.size - 1)
        # Distance to the side of entry, in slices: (zero + sign * position) * scale.
        self.zero = dr.select(forward, mi.Float(0), mi.Float(1))
        self.sign = dr.select(forward, mi.Float(1), mi.Float(-1)) * (1 / FIXED_POINT_ONE)
        self.scale = FIXED_POINT_ONE / mi.Float(dr.abs(slope))

    def since_entry(self, position: mi.Int32) -> mi.Float:
        """Return the slices since the side of entry, for tracks in the voxel next to it."""
        return dr.fma(mi.Float(position), self.sign, self.zero) * self.scale

    def start(self, voxel: mi.Int32, position: mi.Int32) -> mi.Float:
        """Return the slices since entry in the first slice: 0.5, or less if a track entered
        through a side.
        """
        nearest = self.since_entry(position)
        return dr.select(voxel == self.entry, minimum(nearest, 0.5), 0.5)

    def advance(self, voxel: mi.Int32, position: mi.Int32, slices: mi.Int32 | int) -> tuple:
        """Return voxel and position after some ``slices``, and the slices since entry, which are 1
        unless the track has just entered through a side.
        """
        moved = position + self.slope * slices
        position = moved & (FIXED_POINT_ONE - 1)
        voxel = voxel + (moved >> FIXED_POINT_BITS)
        outside = mi.UInt32(voxel) >= mi.UInt32(self.size)
        voxel = dr.select(outside, self.entry, voxel)
        return voxel, position, dr.select(outside, self.since_entry(position), 1.0)

    def since_last_slice(self, voxel: mi.Int32, position: mi.Int32) -> mi.Float:
        """Return the slices since entry that `advance` returned for tracks at this position.

        Tracks that have just entered are those whose distance from the side is less than the
        motion in one slice; for others the result is 1.
        """
        new = dr.select(
            self.slope > 0, position < self.slope, position >= self.slope + FIXED_POINT_ONE
        )
        return dr.select((voxel == self.entry) & new, self.since_entry(position), 1.0)

    def lower(self, voxel: mi.Int32, position: mi.Int32, per_voxel: bool) -> tuple:
        """Return the index of the lower of the two extinction values around the track, and the
        interpolation weight of the upper one.

        ``per_voxel`` states that each voxel has exactly one value.
        """
        if per_voxel:
            before = position < FIXED_POINT_ONE // 2
            weight = dr.fma(mi.Float(position), 1 / FIXED_POINT_ONE, dr.select(before, 0.5, -0.5))
            lower = dr.maximum(voxel - dr.select(before, 1, 0), 0)
            return lower * self.extinction_stride, dr.select(before & (voxel == 0), 0, weight)
        x = dr.fma(mi.Float(position), 1 / FIXED_POINT_ONE, mi.Float(voxel))
        u = clipped(dr.fma(x, self.ratio, self.origin), 0.0, self.last)
        lower = mi.Int32(u)
        return lower * self.extinction_stride, u - mi.Float(lower)

    def to_upper(self, index: mi.Int32) -> mi.Int32:
        """Return the step from the ``index`` of the lower value to the upper one; 0 at the grid's
        end.
        """
        last = mi.Int32(self.last) * self.extinction_stride
        return dr.select(index < last, self.extinction_stride, 0)


class _Way:
    """One of the two opposite ordinates of a pair: ``number`` 0 propagates along the dominant axis,
    1 against it.
    """

    def __init__(self, record: TrackRecord, number: int) -> None:
        self.number, self.record = number, record
        b, c = record.transverse
        self.b = _TransverseMotion(b, -b.slope if number else b.slope)
        self.c = _TransverseMotion(c, -c.slope if number else c.slope)

    def begin(
        self, track: mi.Int32, channels: int, restarts: bool, carried: CarriedRadiance | None
    ) -> _TrackState:
        """Return the state before the first slice that this way crosses.

        ``restarts`` states that tracks may restart at surfaces, so that ``since_surface`` is
        needed; ``carried`` is as in `sweep_tracks`.
        """
        record, (fields_b, fields_c) = self.record, self.record.transverse
        # The divisor is 0 where a vector of lanes is not filled.
        c = track // dr.maximum(fields_b.size, 1)
        b = track - c * fields_b.size
        active = (c < fields_c.size) & (record.slices > 0)
        zero = 0 * track  # makes uniform values as wide as the lanes
        position_b, position_c = fields_b.start + zero, fields_c.start + zero
        offset, extinction_offset = record.first_value + zero, record.first_extinction + zero
        shift_b, shift_c = fields_b.first_shift, fields_c.first_shift
        if self.number:
            last = record.last_slice
            shift_b, shift_c = fields_b.last_shift, fields_c.last_shift
            position_b, position_c = fields_b.last_position + zero, fields_c.last_position + zero
            offset = record.first_value + record.stride * last + zero
            extinction_offset = record.first_extinction + record.extinction_stride * last + zero
        b, c = b + shift_b, c + shift_c
        b = dr.select(b >= fields_b.size, b - fields_b.size, b)
        c = dr.select(c >= fields_c.size, c - fields_c.size, c)
        if carried is None or carried.before is None:
            since = minimum(self.b.start(b, position_b), self.c.start(c, position_c))
            *radiance, previous = [mi.Float(0) for _ in range(channels + 1)]
        else:
            since = minimum(
                self.c.since_last_slice(c, position_c), self.b.since_last_slice(b, position_b)
            )
            *radiance, previous = carried.before[self.number]
        return _TrackState(
            b=b,
            c=c,
            position_b=position_b,
            position_c=position_c,
            offset=offset,
            extinction_offset=extinction_offset,
            since_entry=since,
            radiance=radiance,
            previous=previous,
            crossed=mi.Int32(0),
            active=active,
            since_surface=mi.Float(1) if restarts else None,
        )

    def advance(
        self,
        state: _TrackState,
        slices: mi.Int32 | int,
        radiance: list,
        previous: mi.Float,
        since_surface: mi.Float | None,
    ) -> _TrackState:
        """Return the state after some ``slices``, with the radiance, last extinction and distance
        from a surface behind the current slice.
        """
        record = self.record
        b, position_b, since_b = self.b.advance(state.b, state.position_b, slices)
        c, position_c, since_c = self.c.advance(state.c, state.position_c, slices)
        step = record.stride * slices
        extinction_step = record.extinction_stride * slices
        crossed = state.crossed + slices
        return _TrackState(
            b=b,
            c=c,
            position_b=position_b,
            position_c=position_c,
            offset=state.offset - step if self.number else state.offset + step,
            extinction_offset=state.extinction_offset - extinction_step
            if self.number
            else state.extinction_offset + extinction_step,
            since_entry=minimum(since_c, since_b),
            radiance=radiance,
            previous=previous,
            crossed=crossed,
            active=state.active & (crossed < record.slices),
            since_surface=since_surface,
        )

    def slice_of(self, state: _TrackState) -> mi.Int32:
        """Return the index of the slice along the axis."""
        return self.record.slices - 1 - state.crossed if self.number else state.crossed

    def voxel(self, state: _TrackState) -> mi.UInt32:
        """Return the flat index of the voxel in the swept volume."""
        b, c = self.record.transverse
        return mi.UInt32(state.b * b.stride + state.c * c.stride + state.offset)

    def grid_voxel(self, state: _TrackState) -> mi.UInt32:
        """Return the flat index of the voxel in the grid, independent of the volume's layout."""
        (b, c), record = self.record.transverse, self.record
        place = state.b * b.voxel_stride + state.c * c.voxel_stride + record.first_voxel
        return mi.UInt32(place + self.slice_of(state) * record.voxel_stride)

    def empty_slices(self, empty: mi.UInt32, state: _TrackState) -> mi.Int32:
        """Return the number of slices that may be skipped from here on; 0 if this one is needed."""
        b, c = self.record.transverse
        strides = b.empty_stride, c.empty_stride, self.record.empty_stride
        at = state.b, state.c, self.slice_of(state)
        cell = sum(n * mi.Int32(mi.UInt32(i) // CELL) for n, i in zip(strides, at, strict=True))
        return mi.Int32(dr.gather(mi.UInt32, empty, mi.UInt32(cell), state.active))

    def extinction(self, medium: SweptMedium, state: _TrackState, active: mi.Bool) -> tuple:
        """Return the quantised extinction in the half of the slice that this way crosses first, and
        in the other half, interpolated bilinearly across the track.
        """
        lower, upper = self._extinction(medium, state, active)
        return (upper, lower) if self.number else (lower, upper)

    def _extinction(self, medium: SweptMedium, state: _TrackState, active: mi.Bool) -> tuple:
        words, per_voxel = medium.words, medium.words < 4
        index_b, weight_b = self.b.lower(state.b, state.position_b, per_voxel)
        index_c, weight_c = self.c.lower(state.c, state.position_c, per_voxel)

        def bilinear(v00, v10, v01, v11):
            rows = [dr.fma(high - low, weight_b, low) for low, high in ((v00, v10), (v01, v11))]
            return dr.fma(rows[1] - rows[0], weight_c, rows[0])

        index = mi.UInt32(state.extinction_offset + index_b + index_c)
        if words == 1:
            above = index + mi.UInt32(self.c.to_upper(index_c))
            found = [dr.gather(mi.UInt32, medium.corners, i, active) for i in (index, above)]
        else:
            kind = mi.Vector2u if words == 2 else mi.Array4u
            found = dr.gather(kind, medium.corners, index, active)
        if per_voxel:
            value = bilinear(*(mi.Float(v) for w in found for v in (w & 0xFFFF, w >> 16)))
            return value, value
        first, second = ([mi.Float(w & 0xFFFF) for w in found], [mi.Float(w >> 16) for w in found])
        return bilinear(*first), bilinear(*second)


# Both ways of a pair


class _Visit:
    """The current voxels of the tracks of one way.

    ``voxel`` are their indices in the whole volume, ``copy`` those in the copy that is written,
    ``active`` masks the voxels that are needed. Channels of a voxel are adjacent.
    """

    def __init__(self, voxel: mi.UInt32, copy: mi.UInt32, active: mi.Bool) -> None:
        self.voxel, self.copy, self.active = voxel, copy, active

    def read(self, kind: type, volume: mi.Float, channels: int) -> list:
        """Return the values of the copy, one per channel."""
        return [
            dr.gather(kind, volume, self._at(self.copy, c), self.active) for c in range(channels)
        ]

    def read_sources(self, volume: mi.Float, channels: int) -> list:
        """Return the first of the four values, the source, of the whole volume, per channel."""
        return [
            dr.gather(mi.Float, volume, self._at(self.voxel, c) * 4, self.active)
            for c in range(channels)
        ]

    def write(self, volume: mi.Float, values: list) -> None:
        """Replace the values of the copy."""
        for c, value in enumerate(values):
            dr.scatter(volume, value, self._at(self.copy, c), self.active)

    @staticmethod
    def _at(index: mi.UInt32, channel: int) -> mi.UInt32:
        return index + channel if channel else index


class _PairSweep:
    """Both ways of pairs of opposite ordinates through a medium and a volume."""

    def __init__(
        self, medium: SweptMedium, volume: SweptVolume, table: TrackTable, pair: mi.UInt32
    ) -> None:
        self.medium, self.volume = medium, volume
        record = table.records.read(pair)
        self.ways = _Way(record, 0), _Way(record, 1)
        self.separate = volume.begin_backward is not None
        self.begins = (
            volume.begin,
            volume.begin if volume.begin_backward is None else volume.begin_backward,
        )
        self.incoming = [table.incoming(pair, way, volume.channels) for way in range(2)]
        self.boundary_source = table.boundary_source
        if self.boundary_source is not None:
            self._cells = self.boundary_source.read_pair(pair)
            self._offsets = self.boundary_source.channel_offsets()
        self.crossings = table.crossings
        if self.crossings is not None:
            self._first_crossing = self.crossings.first(pair)
        self._source_elsewhere = volume.source is not volume.values
        self.weight, self.scale = record.weight, record.quantum * record.length
        # Cross section of the tube that a track represents, over the volume of a voxel: the tubes
        # of an ordinate fill the volume.
        self.length, self.area = record.length, dr.rcp(record.length)
        #: what optical depths are multiplied by
        self.solid_angle = mi.Float(1) if self.separate else record.weight

    def begin(
        self, track: mi.Int32, carried: CarriedRadiance | None
    ) -> tuple[_TrackState, _TrackState]:
        restarts = self.crossings is not None and self.volume.source is None
        channels = self.volume.channels
        forward, backward = (way.begin(track, channels, restarts, carried) for way in self.ways)
        return forward, backward

    def cross_slice(
        self, values: mi.Float, forward: _TrackState, backward: _TrackState
    ) -> tuple[_TrackState, _TrackState]:
        """Cross a slice, or skip empty ones, both ways; read and write the ``values`` of its
        voxels. Returns the new states.
        """
        states = forward, backward
        slices, needed = self._needed(states)
        voxels = [way.voxel(state) for way, state in zip(self.ways, states, strict=True)]
        if self.volume.channels > 1:
            voxels = [voxel * self.volume.channels for voxel in voxels]
        extinction = [
            way.extinction(self.medium, state, active)
            for way, state, active in zip(self.ways, states, needed, strict=True)
        ]
        radiance = [self._entered(way, state) for way, state in zip(self.ways, states, strict=True)]
        visits = [
            _Visit(voxel, voxel + begin, active)
            for voxel, begin, active in zip(voxels, self.begins, needed, strict=True)
        ]
        # In the middle slice both ways are in the same voxel, as positions are integers: the first
        # to write writes for both.
        middle = forward.offset == backward.offset
        since = [None, None]
        if self.volume.source is None:
            radiance, since = self._attenuate(values, states, radiance, extinction, visits, middle)
        else:
            radiance = self._collide(values, states, radiance, extinction, visits, middle)
        forward, backward = (
            way.advance(state, n, light, second, left)
            for way, state, n, light, (_, second), left in zip(
                self.ways, states, slices, radiance, extinction, since, strict=True
            )
        )
        if self.medium.empty is None:
            backward = replace(backward, crossed=forward.crossed, active=forward.active)
        return forward, backward

    def _needed(self, states: tuple) -> tuple[list, list]:
        """Return for both ways the slices to advance by, and whether this slice is needed."""
        if self.medium.empty is None:
            return [1, 1], [state.active for state in states]
        empty = [
            way.empty_slices(self.medium.empty, state)
            for way, state in zip(self.ways, states, strict=True)
        ]
        needed = [state.active & (n == 0) for state, n in zip(states, empty, strict=True)]
        return [dr.maximum(n, 1) for n in empty], needed

    def _entered(self, way: _Way, state: _TrackState) -> list[mi.Float]:
        """Return the radiance before the slice; at the boundary for tracks that just entered."""
        entered = state.since_entry < 1
        if self.boundary_source is None:
            return _select(entered, self.incoming[way.number], state.radiance)
        entered = state.active & entered
        found = self.boundary_source.irradiance(
            self._cells, self._offsets, way.number, way.slice_of(state), state.at, entered
        )
        return _select(entered, found, state.radiance)

    def _attenuate(
        self,
        values: mi.Float,
        states: tuple,
        radiance: list,
        extinction: list,
        visits: list[_Visit],
        middle: mi.Bool,
    ) -> tuple[list[list[mi.Float]], list]:
        """Attenuate the radiance up to the middle of the slice, and add it to the voxels.

        Returns, for both ways, the radiance carried on, and the slices since the track left a
        surface (None without surfaces).
        """
        radiance = [
            _scale(light, _transmittance(state, first, self.scale))
            for state, light, (first, _) in zip(states, radiance, extinction, strict=True)
        ]
        added, since = radiance, [None, None]
        if self.crossings is not None:
            found = [
                _attenuate_at_surface(self, way, light, first, self._slot(way, state, visit.active))
                for way, state, light, (first, _), visit in zip(
                    self.ways, states, radiance, extinction, visits, strict=True
                )
            ]
            added, radiance, since = ([way[i] for way in found] for i in range(3))
        if self.separate:
            for light, visit in zip(added, visits, strict=True):
                visit.write(values, light)
        else:
            before = [visit.read(mi.Float, values, self.volume.channels) for visit in visits]
            self._add_both(values, before, added, visits, middle)
        return radiance, since

    def _collide(
        self,
        values: mi.Float,
        states: tuple,
        radiance: list,
        extinction: list,
        visits: list[_Visit],
        middle: mi.Bool,
    ) -> list[list[mi.Float]]:
        """Propagate the radiance through the slice, whose voxels emit or scatter, and tally
        irradiance and collisions; return the radiance behind it for both ways.
        """
        source, channels = self.volume.source, self.volume.channels
        if self.separate:
            sources = [visit.read(mi.Float, source, channels) for visit in visits]
        else:
            before = [visit.read(mi.Vector4f, values, channels) for visit in visits]
            if self._source_elsewhere:
                sources = [visit.read_sources(source, channels) for visit in visits]
            else:
                sources = [[value.x for value in voxel] for voxel in before]
        sources = [_scale(sent, self.weight) for sent in sources]
        cross = self._cross_voxel if self.volume.emission is None else self._cross_emitting_voxel
        crossed = [
            cross(state, light, sent, halves)
            for state, light, sent, halves in zip(
                states, radiance, sources, extinction, strict=True
            )
        ]
        if self.crossings is not None:
            whole = source if self._source_elsewhere else values
            crossed = [
                _collide_at_surface(
                    self, way, state, light, halves, *result,
                    self._slot(way, state, visit.active), whole,
                )
                for way, state, light, halves, result, visit in zip(
                    self.ways, states, radiance, extinction, crossed, visits, strict=True
                )
            ]  # fmt: skip
        radiance, tallies = ([way[i] for way in crossed] for i in range(2))
        if self.separate:
            for visit, tally, sent in zip(visits, tallies, sources, strict=True):
                own = tally
                if self.volume.emission is None:
                    own = [t - mi.Vector4f(0, s, 0, 0) for t, s in zip(tally, sent, strict=True)]
                visit.write(values, collisions(own) if self.volume.collisions else own)
        else:
            self._add_both(values, before, tallies, visits, middle)
        return radiance

    def _add_both(
        self, values: mi.Float, before: list, added: list, visits: list[_Visit], middle: mi.Bool
    ) -> None:
        """Write the values ``before`` plus what both ways have ``added``.

        Where ``middle``, both ways are in the same voxel, and the first one writes the sum.
        """
        forward, backward = visits
        both = _add(added[0], _select(middle, added[1], self.volume.channels * [0]))
        forward.write(values, _add(before[0], both))
        backward.active = backward.active & ~middle
        backward.write(values, _add(before[1], added[1]))

    def _cross_voxel(
        self, state: _TrackState, radiance: list, source: list, extinction: tuple
    ) -> tuple[list, list]:
        """Propagate radiance through a voxel with a constant source.

        Returns per channel the radiance behind it, and the tally (0, irradiance in its middle, V,
        W). V is the loss of radiance and W the optical depth times solid angle, both over the
        track's length in a slice.
        """
        # docs/primer, eqs. (4.6), (4.7)
        # The longer a track is in a voxel, the narrower is its tube.
        area, count = self.area, self.solid_angle
        first, second = (half * self.scale for half in extinction)
        to_middle = dr.select(state.since_entry < 1, state.since_entry, 0.5) * first
        tau = dr.fma(second, 0.5, to_middle)
        transmittance = decay(tau)
        # Little is lost in thin voxels, but their scattering is computed from just that loss.
        share = absorbed(tau, transmittance)
        to_centre = decay(to_middle)
        behind, tally = [], []
        for x, sent in zip(radiance, source, strict=True):
            lost, middle = (x - sent) * share, dr.fma(x - sent, to_centre, sent)
            behind.append(x - lost)
            tally.append(mi.Vector4f(0, middle, lost * area, count * tau * area))
        return behind, tally

    def _cross_emitting_voxel(
        self, state: _TrackState, radiance: list, emission: list, extinction: tuple
    ) -> tuple[list, list]:
        """Propagate radiance through a voxel that emits radiance per length.

        Returns what `_cross_voxel` returns.
        """
        # docs/primer, eq. (8.17)
        first, second = (half * self.scale for half in extinction)
        ahead = dr.select(state.since_entry < 1, state.since_entry, 0.5)
        to_middle = ahead * first
        tau = dr.fma(second, 0.5, to_middle)
        transmittance = decay(tau)
        share = absorbed(tau, transmittance)
        # Shares of the emission that leave the voxel, collide in it, and pass its middle.
        half, thin = 0.5 * tau, tau < 0.02
        if self.volume.emission == "decaying":
            series = dr.fma(half * half, 1 / 6, 1)
            leaving, passing = decay(half), mi.Float(1)
            total = dr.select(half < 0.1, series, dr.sinh(half) / half)
            colliding = dr.select(thin, half * dr.fma(tau, -1 / 6, 1), total - leaving)
        else:
            leaving = dr.select(tau > 0, share / tau, 1)
            lost = absorbed(to_middle, decay(to_middle))
            passing = dr.select(to_middle > 0, lost / to_middle, 1)
            colliding = dr.select(thin, half * dr.fma(tau, -1 / 3, 1), 1 - leaving)
        depth, to_centre = self.solid_angle * tau * self.area, decay(to_middle)
        behind, tally = [], []
        for x, sent in zip(radiance, emission, strict=True):
            emitted = sent * self.length
            middle = dr.fma(x, to_centre, emitted * ahead * passing)
            emitted = emitted * (ahead + 0.5)
            behind.append(dr.fma(x, transmittance, emitted * leaving))
            collided = dr.fma(x, share, emitted * colliding)
            tally.append(mi.Vector4f(0, middle, collided * self.area, depth))
        return behind, tally

    # Surfaces among the voxels

    def _slot(self, way: _Way, state: _TrackState, active: mi.Bool) -> mi.UInt32:
        """Return 1 + the index of the crossing with a surface in this slice; 0 without one."""
        return self.crossings.slot(self._first_crossing, way.grid_voxel(state), active)

    def _crossing(self, way: _Way, slot: mi.UInt32, active: mi.Bool) -> tuple:
        """Return the crossing with surfaces as seen along this way.

        That is: the first and last position, in slices from the middle; whether the parts before
        and behind them belong to the voxel; the radiance behind the last surface, per channel; and
        the voxels whose source applies to the two parts.
        """
        first, last, before, behind = self.crossings.record(slot, active)
        voxels = tuple(self.crossings.source_voxels(slot, active))
        if way.number:
            first, last, before, behind = -last, -first, behind, before
            voxels = voxels[1], voxels[0]
            # Without a crossing there is only the part before.
            alone = first > last
            before = dr.select(alone, behind, before)
            voxels = dr.select(alone, voxels[1], voxels[0]), voxels[1]
        left = [mi.Float(0)] * self.volume.channels
        if self.boundary_source is not None:
            left = self.boundary_source.from_surface(slot, self._offsets, way.number, active)
        return first, last, before, behind, left, voxels

    def _attenuated_parts(
        self, way: _Way, radiance: list, extinction: mi.Float, slot: mi.UInt32
    ) -> tuple[list, list, mi.Float]:
        """Return the results of `_attenuate_at_surface` where a surface crosses the voxel."""
        first, last, before, behind, left, _ = self._crossing(way, slot, slot > 0)
        crosses = first <= last
        reaches, leaves = ~crosses | (first > 0), crosses & (last <= 0)
        to_middle = decay(maximum(-last, 0.0) * extinction * self.scale)
        behind = dr.select(leaves, behind, 0)
        received, carried = [], []
        for x, y in zip(radiance, left, strict=True):
            carried.append(dr.select(crosses, dr.select(leaves, y * to_middle, y), x))
            received.append(dr.select(reaches, x * before, carried[-1] * behind))
        since = dr.select(crosses & ~leaves, clipped(1 - last, 0.0, 1.0), 1)
        return received, carried, since

    def _cross_parts(
        self,
        way: _Way,
        state: _TrackState,
        radiance: list,
        extinction: tuple,
        slot: mi.UInt32,
        source: mi.Float,
    ) -> tuple[list, list]:
        """Return the results of `_collide_at_surface` where a surface crosses the voxel."""
        # docs/primer, eq. (4.16)
        first, last, before, behind, left, voxels = self._crossing(way, slot, slot > 0)
        crosses = first <= last
        lower, upper = (half * self.scale for half in extinction)
        begin = -dr.select(state.since_entry < 1, state.since_entry, 0.5)
        end, restart = (clipped(x, begin, 0.5) for x in (first, last))
        ahead = _depth(begin, end, lower, upper)
        beyond = dr.select(crosses, _depth(restart, mi.Float(0.5), lower, upper), 0)
        shares = [absorbed(tau, decay(tau)) for tau in (ahead, beyond)]
        to_centre, from_surface = decay(-begin * lower), decay(maximum(-last, 0.0) * lower)
        # Parts on the far side of a surface are those of another voxel: they count for none, whose
        # mean does not need them.
        depth = self.solid_angle * (before * ahead + behind * beyond) * self.area
        channels = range(self.volume.channels)
        sources = [
            [
                self._source(source, voxel * len(channels) + c, (slot > 0) & (voxel != NO_VOXEL))
                for c in channels
            ]
            for voxel in voxels
        ]
        carried, tallies = [], []
        for x, y, s, t in zip(radiance, left, *sources, strict=True):
            lost = (x - s) * shares[0], (y - t) * shares[1]
            centre = dr.select(
                ~crosses | (first > 0),
                before * dr.fma(x - s, to_centre, s),
                dr.select(last < 0, behind * dr.fma(y - t, from_surface, t), 0),
            )
            # Without a crossing, y is what the part scatters more than its source.
            carried.append(dr.select(crosses, y - lost[1], x - lost[0] + y))
            total = (before * lost[0] + behind * lost[1]) * self.area
            tallies.append(mi.Vector4f(0, centre, total, depth))
        return carried, tallies

    def _source(self, volume: mi.Float, index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """Return the source at an ``index`` of voxels and channels, times the solid angle."""
        return dr.gather(mi.Float, volume, index * 4, active) * self.weight


@symbolic
def _attenuate_at_surface(
    sweep: _PairSweep, way: _Way, radiance: list, extinction: mi.Float, slot: mi.UInt32
):
    """Correct the radiance at the middle of a slice for surfaces in the voxel.

    ``radiance`` is attenuated to the middle of the slice, ``extinction`` is that of its first half,
    ``slot`` is 0 where there is no surface. Returns the radiance that the voxel receives, the
    radiance that the track carries on, and the slices since the track left a surface.
    """
    received, carried, since = list(radiance), list(radiance), mi.Float(1)
    if slot > 0:
        received, carried, since = sweep._attenuated_parts(way, radiance, extinction, slot)
    return received, carried, since


@symbolic
def _collide_at_surface(
    sweep: _PairSweep,
    way: _Way,
    state: _TrackState,
    radiance: list,
    extinction: tuple,
    carried: list,
    tallies: list,
    slot: mi.UInt32,
    source: mi.Float,
):
    """Correct the results of `_PairSweep._cross_voxel` for surfaces in the voxel.

    Returns ``carried`` and ``tallies`` unchanged where ``slot`` is 0, and otherwise those of the
    parts of the track that belong to the voxel. ``source`` is the volume with the source of all
    voxels.
    """
    if slot > 0:
        carried, tallies = sweep._cross_parts(way, state, radiance, extinction, slot, source)
    return carried, tallies


def _depth(a: mi.Float, b: mi.Float, lower: mi.Float, upper: mi.Float) -> mi.Float:
    """Return the optical depth between positions ``a`` and ``b`` [slices from the middle], with
    different extinctions in the ``lower`` and ``upper`` half.
    """
    below, above = dr.minimum(b, 0) - dr.minimum(a, 0), dr.maximum(b, 0) - dr.maximum(a, 0)
    return dr.fma(lower, below, upper * above)


def _transmittance(state: _TrackState, here: mi.Float, scale: mi.Float) -> mi.Float:
    """Return the transmittance from the middle of the previous slice, or from the point of entry,
    to the middle of this slice.

    ``here`` is the extinction in the half of this slice that is crossed first.
    """
    # docs/primer, eq. (4.4)
    since = state.since_entry
    if state.since_surface is not None:
        since = dr.minimum(since, state.since_surface)
    return decay(dr.select(since < 1, here * since, 0.5 * (state.previous + here)) * scale)


# All channels of a voxel


def collisions(tallies: list) -> list:
    """Return (radiance lost per optical depth, optical depth) for each tally of four values.

    If the optical depth is 0, the first value is its limit, the radiance in the middle.
    """
    return [mi.Vector2f(dr.select(t.w > 0, t.z / t.w, t.y), t.w) for t in tallies]


def _select(condition: mi.Bool, values: list, others: list) -> list:
    return [dr.select(condition, a, b) for a, b in zip(values, others, strict=True)]


def _add(first: list, second: list) -> list:
    return [a + b for a, b in zip(first, second, strict=True)]


def _scale(values: list, factor: mi.Float) -> list:
    return [value * factor for value in values]
