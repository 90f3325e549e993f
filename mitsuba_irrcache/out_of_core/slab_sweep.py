"""Sweeps of volumes in files, slab by slab, with the radiance of all tracks passed on.

Across the dominant axis of an ordinate every track of a slice stays in the slab until its end, also
where it leaves through a side and enters again at the other. So one number per track and channel is
passed on from slab to slab. All ordinates of one dominant axis are swept together: along the axis
through the first slab while those against it pass through the last one, and so on, until both have
passed through all. Each slab is visited twice, and its sums are kept in a file between.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.out_of_core.brick_file import EDGE, BrickFile, RecordFile
from mitsuba_irrcache.out_of_core.slab_tracks import (
    SlabTracks,
    by_slices,
    from_slices,
    slice_place,
    swept_medium,
)
from mitsuba_irrcache.out_of_core.slabs import Slab, even_slabs, symmetric_slabs
from mitsuba_irrcache.out_of_core.survey import MappedField
from mitsuba_irrcache.solvers.discrete_ordinates.extinction import (
    LEVELS,
    largest_extinction,
    quantised,
)
from mitsuba_irrcache.solvers.discrete_ordinates.kernel import (
    CarriedRadiance,
    SweptVolume,
    sweep_tracks,
)
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import values_at_centres

#: Bytes of a voxel of both slabs while they are swept: extinction and its parts; and for each
#: channel the sums, or these and the source, and copies of them.
BYTES, BYTES_OF_CHANNEL, BYTES_OF_SOURCE = 16, 16, 56
#: Most values of all channels of both slabs: kernels count them in 32 bits, four for each.
MOST_VALUES = 1 << 30
#: Most slices of a slab: more would not be faster.
MOST_SLICES = 128
#: Share of the memory for what tracks carry.
SHARE_CARRIED = 0.4

Progress = Callable[[int, int], None]
#: returns the radiance that the voxels of a box emit or scatter, per optical depth: (z, y, x,
#: channel), given its lower and upper end (z, y, x)
Source = Callable[[list[int], list[int]], np.ndarray]


class SlabSweep:
    """Sweeps of the extinction ``sigma_t``, with working files in ``folder``, in about ``memory``
    bytes.
    """

    def __init__(self, sigma_t: MappedField, folder: Path, memory: int) -> None:
        self.grid, self._folder, self._memory = sigma_t.grid, folder, memory
        #: whether sweeps with a source would distinguish the halves of voxels in memory
        top, self.is_dense = largest_extinction(self.grid, sigma_t.largest)
        self._levels = BrickFile(folder / "extinction", self.grid.shape, np.uint16)
        slice_voxels = self.grid.voxel_count // self.grid.shape[0]
        for first, last in even_slabs(self.grid.shape[0], _thickness(memory, slice_voxels * 24)):
            levels = quantised(sigma_t.values(first, last), top, first * slice_voxels)
            values = np.array(levels).astype(np.uint16)
            self._levels.write((first, 0, 0), values.reshape(last - first, *self.grid.shape[1:]))
        self._tracks = SlabTracks(self.grid, top / LEVELS)

    def uncollided(
        self,
        directions: np.ndarray,
        incoming: np.ndarray,
        offsets: np.ndarray,
        progress: Progress = lambda done, total: None,
    ) -> BrickFile:
        """Uncollided irradiance at the centres of all voxels, as `Tracks.uncollided` computes it:
        a file of float32 with the channels of ``incoming`` (n, 2, channels).
        """
        ordinates = directions, np.zeros(len(directions)), offsets
        return self._irradiance("uncollided", ordinates, incoming, None, progress)

    def scattered(
        self,
        name: str,
        ordinates: tuple[np.ndarray, np.ndarray, np.ndarray],
        source: Source,
        channels: int,
        progress: Progress = lambda done, total: None,
    ) -> BrickFile:
        """Irradiance of what voxels emit or scatter, in a file called ``name``, along ordinates:
        directions (n, 3), weights (n) and offsets (n, 2), as `Tracks.table` takes them.
        """
        incoming = np.zeros((len(ordinates[0]), 2, channels))
        return self._irradiance(name, ordinates, incoming, source, progress)

    def _irradiance(
        self,
        name: str,
        all_ordinates: tuple[np.ndarray, np.ndarray, np.ndarray],
        incoming: np.ndarray,
        source: Source | None,
        progress: Progress,
    ) -> BrickFile:
        directions, weights, offsets = all_ordinates
        total = BrickFile(self._folder / name, self.grid.shape, np.float32, incoming.shape[2])
        axes = self._tracks.dominant_axes(all_ordinates)
        done = 0
        for axis in range(3):
            rows = np.flatnonzero(axes == axis)
            if not len(rows):
                continue
            ordinates = directions[rows], weights[rows], offsets[rows]
            sweep = _AxisSweep(self._tracks, self._levels, axis, ordinates, incoming[rows], source)
            groups = sweep.groups(self._memory)
            slabs = sweep.slabs(self._memory, max(len(group) for group in groups))
            records = RecordFile(self._folder / "sums")
            for group in groups:
                is_last = group is groups[-1]
                for step, _ in enumerate(slabs):
                    sweep.cross(slabs, step, group, records, total if is_last else None)
                    done += len(group) / (len(slabs) * len(directions))
                    progress(int(done * 1000), 1000)
                sweep.finish()
        return total

    def extinction(self, lower: list[int], upper: list[int]) -> np.ndarray:
        """The extinction in a box (z, y, x), in units of its quantum."""
        return self._levels.read(lower, upper)

    def stored(self, name: str, field: MappedField) -> BrickFile:
        """Copy a field to a working file, boxes of which are read."""
        file = BrickFile(self._folder / name, self.grid.shape, np.float32)
        for first, last in even_slabs(self.grid.shape[0], EDGE):
            file.write((first, 0, 0), field.file.read(first, last) * np.float32(field.factor))
        return file

    def close(self) -> None:
        """Closes the working file of the extinction."""
        self._levels.close()


class _AxisSweep:
    """Sweeps along all ordinates of one dominant ``axis``."""

    def __init__(
        self,
        tracks: SlabTracks,
        levels: BrickFile,
        axis: int,
        ordinates: tuple[np.ndarray, np.ndarray, np.ndarray],
        incoming: np.ndarray,
        source: Source | None,
    ) -> None:
        self._tracks, self._levels, self._axis = tracks, levels, axis
        self._ordinates, self._incoming, self._source = ordinates, incoming, source
        self._channels = incoming.shape[2]
        self._track_count = int(np.prod(np.delete(tracks.grid.resolution, axis)))
        self._track_index = dr.arange(mi.UInt32, self._track_count)
        dr.eval(self._track_index)
        #: what the tracks of each pair carry
        self._carried: dict[int, tuple[list[mi.Float], list[mi.Float]]] = {}

    def groups(self, memory: int) -> list[list[int]]:
        """The pairs, in as many groups as needed for what the tracks of one to fit into memory."""
        count = len(self._incoming)
        each = 2 * self._track_count * (self._channels + 1) * 4
        most = max(1, int(SHARE_CARRIED * memory / each))
        return [list(range(first, last)) for first, last in even_slabs(count, most)]

    def slabs(self, memory: int, pairs: int) -> list[Slab]:
        """Slabs of as many slices as fit beside what the tracks of so many ``pairs`` carry."""
        carried = (pairs + 1) * 2 * self._track_count * (self._channels + 1) * 4
        of_channel = BYTES_OF_CHANNEL if self._source is None else BYTES_OF_SOURCE
        each = 2 * self._track_count * (BYTES + of_channel * self._channels)
        most = MOST_VALUES // (2 * self._track_count * self._channels)
        thickness = max(1, min(_thickness(memory - carried, each), most))
        return symmetric_slabs(int(self._tracks.grid.resolution[self._axis]), thickness)

    def cross(
        self,
        slabs: list[Slab],
        step: int,
        group: list[int],
        records: RecordFile,
        total: BrickFile | None,
    ) -> None:
        """Cross one slab each way; what has been crossed both ways is added to the ``total``, if
        that is given.
        """
        numbers = [step, len(slabs) - 1 - step]
        numbers = numbers[:1] if numbers[0] == numbers[1] else numbers
        pair = slabs[numbers[0]], slabs[numbers[-1]]
        boxes = [self._box(slabs[number]) for number in numbers]
        medium = swept_medium([self._levels.read(*box) for box in boxes], self._axis)
        values = self._sums([records.read(number) for number in numbers], boxes)
        table = self._tracks.slab_table(self._ordinates, self._incoming, self._axis, pair)
        source = None if self._source is None else values
        volume = SweptVolume(values, source, dr.opaque(mi.UInt32, 0), self._channels)
        for i in group:
            carried = CarriedRadiance(self._carried.get(i))
            sweep_tracks(medium, volume, table, table.pair_index[i], self._track_index, carried)
            dr.eval(values, carried.after)
            self._carried[i] = carried.after
        del medium, carried
        is_second = step >= len(slabs) // 2
        self._keep(values, boxes, numbers, records, total if is_second else None)

    def finish(self) -> None:
        """Forget what the tracks of the last group carry."""
        self._carried.clear()

    def _box(self, slab: Slab) -> tuple[list[int], list[int]]:
        """Lower and upper end (z, y, x) of a slab."""
        lower, upper = [0, 0, 0], list(self._tracks.grid.shape)
        lower[2 - self._axis], upper[2 - self._axis] = slab
        return lower, upper

    def _sums(self, parts: list[np.ndarray | None], boxes: list) -> mi.Float:
        """The sums of one or two slabs as they were left, or 0, by slices; with the source, the
        four values of `Tracks.sweep`.
        """
        shapes = [by_slices(np.empty(_shape(box), bool), self._axis).shape for box in boxes]
        if self._source is None and all(part is None for part in parts):
            voxels = sum(int(np.prod(shape)) for shape in shapes)
            return dr.opaque(mi.Float, 0, voxels * self._channels)
        shapes = [(*shape, self._channels) for shape in shapes]
        parts = [
            np.zeros(shape, np.float32) if part is None else part.reshape(shape)
            for part, shape in zip(parts, shapes, strict=True)
        ]
        place = slice_place(self._axis)
        joined = parts[0] if len(parts) == 1 else np.concatenate(parts, place)
        if self._source is not None:
            sums, joined = joined, np.zeros((*joined.shape, 4), np.float32)
            sources = [by_slices(self._source(*box), self._axis) for box in boxes]
            joined[..., 0] = np.concatenate(sources, place)
            joined[..., 1] = sums
        return mi.Float(joined.ravel())

    def _keep(
        self,
        values: mi.Float,
        boxes: list,
        numbers: list[int],
        records: RecordFile,
        total: BrickFile | None,
    ) -> None:
        """Store the sums of the slabs, or add what they mean to the ``total``."""
        place, first = slice_place(self._axis), 0
        shape = list(by_slices(np.empty(_shape(boxes[0]), bool), self._axis).shape)
        thickness = shape[place]
        shape[place] *= len(boxes)
        if self._source is not None:
            values = dr.gather(
                mi.Float, values, 4 * dr.arange(mi.UInt32, dr.width(values) // 4) + 1
            )
        sums = np.array(values).reshape(*shape, self._channels)
        for box, number in zip(boxes, numbers, strict=True):
            within: list = [slice(None)] * sums.ndim
            within[place] = slice(first, first + thickness)
            own = sums[tuple(within)]
            first += thickness
            if total is None:
                records.write(number, np.ascontiguousarray(own))
            else:
                if self._source is None:
                    found = self._at_centres(mi.Float(own.ravel()), _shape(box))
                else:
                    found = from_slices(own, self._axis)
                before = total.read(*box)
                total.write(box[0], before + found.reshape(before.shape))

    def _at_centres(self, means: mi.Float, shape: tuple[int, int, int]) -> np.ndarray:
        """The values of a slab at the centres of its voxels (z, y, x, channel)."""
        grid, channels = Grid(shape, np.eye(4)), self._channels
        index = dr.arange(mi.UInt32, grid.voxel_count)
        box = np.zeros(3, int), grid.resolution
        found = []
        for c in range(channels):
            value = values_at_centres(means, grid, *box, self._axis, index, c, channels)
            found.append(np.array(value))
        return found[0] if channels == 1 else np.stack(found, axis=1)


def _shape(box: tuple) -> tuple[int, int, int]:
    return tuple(b - a for a, b in zip(*box, strict=True))


def _thickness(memory: int, slice_bytes: int) -> int:
    """How many slices of so many bytes each fit, one at least."""
    return int(np.clip(memory // slice_bytes, 1, MOST_SLICES))
