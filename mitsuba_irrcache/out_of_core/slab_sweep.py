"""Sweeps of volumes in files, slab by slab.

Slabs lie across the dominant axis of an ordinate, so that each of its tracks crosses a whole slab,
also if it leaves through a side and enters again at the opposite one. So one number per track and
channel, its radiance, is passed on from slab to slab. All ordinates of one dominant axis are swept
together: those along the axis cross the first slab while those against it cross the last one, and
so on. Each slab is visited twice; its sums are stored in a file in the meantime.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.out_of_core.brick_file import BrickFile, RecordFile
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
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import SweptBox, values_at_centres

#: Memory per voxel of both slabs during a sweep [bytes]: of the extinction; and for each channel of
#: the sums, or of the sums and the source, with copies.
BYTES, BYTES_OF_CHANNEL, BYTES_OF_SOURCE = 16, 16, 56
#: Largest number of values of all channels of both slabs, since kernels use 32-bit indices of four
#: numbers per value.
MOST_VALUES = 1 << 30
#: Largest number of slices of a slab; thicker slabs are not faster.
MOST_SLICES = 128
#: Share of the memory for the radiance of the tracks.
SHARE_CARRIED = 0.4
#: Name of the working file of the quantised extinction.
EXTINCTION_FILE = "extinction"

Progress = Callable[[int, int], None]
#: directions (n, 3), weights (n) and offsets (n, 2) of pairs of ordinates, as `Tracks.table` takes
#: them
PairsOfOrdinates = tuple[np.ndarray, np.ndarray, np.ndarray]


class SlabSweep:
    """Sweeps of the extinction ``sigma_t``, within about ``memory`` bytes.

    Working files are in ``folder``.
    """

    def __init__(self, sigma_t: MappedField, folder: Path, memory: int) -> None:
        self.grid, self._folder, self._memory = sigma_t.grid, folder, memory
        #: whether sweeps with a source would distinguish the halves of voxels in memory
        top, self.is_dense = largest_extinction(self.grid, sigma_t.largest)
        self._levels = self.file(EXTINCTION_FILE, np.uint16)
        write_levels(self._levels, sigma_t, top, memory)
        self._unit = top / LEVELS
        self._tracks = SlabTracks(self.grid, self._unit)

    def file(self, name: str, dtype: np.dtype = np.float32, channels: int = 1) -> BrickFile:
        """Create a working file for values of all voxels."""
        return BrickFile.without_name(self._folder / name, self.grid.shape, dtype, channels)

    def uncollided(
        self,
        directions: np.ndarray,
        incoming: np.ndarray,
        offsets: np.ndarray,
        progress: Progress = lambda done, total: None,
    ) -> BrickFile:
        """Compute the uncollided irradiance at the centres of all voxels, as `Tracks.uncollided`.

        Returns a file of float32 with the channels of ``incoming`` (n, 2, channels).
        """
        ordinates = directions, np.zeros(len(directions)), offsets
        return self._irradiance("uncollided", ordinates, incoming, None, progress)

    def scattered(
        self,
        name: str,
        ordinates: PairsOfOrdinates,
        source: BrickFile,
        progress: Progress = lambda done, total: None,
    ) -> BrickFile:
        """Compute the irradiance of the radiance that voxels emit or scatter.

        ``source`` is this radiance per optical depth. Returns a file called ``name``.
        """
        incoming = np.zeros((len(ordinates[0]), 2, source.channels))
        return self._irradiance(name, ordinates, incoming, source, progress)

    def _irradiance(
        self,
        name: str,
        ordinates: PairsOfOrdinates,
        incoming: np.ndarray,
        source: BrickFile | None,
        progress: Progress,
    ) -> BrickFile:
        total = self.file(name, channels=incoming.shape[2])
        done = 0
        for sweep in AxisSweep.of_all(self._tracks, self._levels, ordinates, incoming, source):
            groups = sweep.groups(self._memory)
            slabs = sweep.slabs(self._memory, max(len(group) for group in groups))
            records = RecordFile(self._folder / "sums")
            for group in groups:
                carried: Carried = {}
                for step, _ in enumerate(slabs):
                    numbers = sweep.numbers(slabs, step)
                    parts = [records.read(number) for number in numbers]
                    sums = sweep.cross(slabs, step, group, carried, parts)
                    is_complete = group is groups[-1] and sweep.is_second_visit(slabs, step)
                    for number, own in zip(numbers, sums, strict=True):
                        if is_complete:
                            box = sweep.box(slabs[number])
                            before = total.read(*box)
                            found = sweep.irradiance(own, box).reshape(before.shape)
                            total.write(box[0], before + found)
                        else:
                            records.write(number, np.ascontiguousarray(own))
                    done += len(group) / (len(slabs) * len(incoming))
                    progress(int(done * 1000), 1000)
        return total

    def extinction(self, lower: list[int], upper: list[int]) -> np.ndarray:
        """Return the extinction in a box (z, y, x), float32, as it has been quantised."""
        return self._levels.read(lower, upper) * np.float32(self._unit)

    def close(self) -> None:
        """Close the working file of the extinction."""
        self._levels.close()


def write_levels(file: BrickFile, sigma_t: MappedField, top: float, memory: int) -> None:
    """Write the quantised extinction, up to ``top``, of all voxels."""
    slices, *sides = sigma_t.grid.shape
    slice_voxels = int(np.prod(sides))
    for first, last in even_slabs(slices, _thickness(memory, slice_voxels * 24)):
        levels = quantised(sigma_t.values(first, last), top, first * slice_voxels)
        values = np.array(levels).astype(np.uint16)
        file.write((first, 0, 0), values.reshape(last - first, *sides))
    sigma_t.file.require_unchanged()  # before anything is computed from it


#: What the tracks of each pair carry, by its number: for either way the radiance in each channel
#: and the extinction passed last.
Carried = dict[int, tuple[list, list]]


class AxisSweep:
    """Sweeps along all ordinates of one dominant ``axis`` through the quantised extinction
    ``levels``.
    """

    def __init__(
        self,
        tracks: SlabTracks,
        levels: BrickFile,
        axis: int,
        ordinates: PairsOfOrdinates,
        incoming: np.ndarray,
        source: BrickFile | None,
    ) -> None:
        self._tracks, self._levels, self.axis = tracks, levels, axis
        self._ordinates, self._incoming, self._source = ordinates, incoming, source
        self._channels = incoming.shape[2]
        self._track_count = int(np.prod(np.delete(tracks.grid.resolution, axis)))
        self._track_index = dr.arange(mi.UInt32, self._track_count)
        dr.eval(self._track_index)

    @classmethod
    def of_all(
        cls,
        tracks: SlabTracks,
        levels: BrickFile,
        ordinates: PairsOfOrdinates,
        incoming: np.ndarray,
        source: BrickFile | None,
    ) -> list[AxisSweep]:
        """Return the sweeps along these ordinates, one for each dominant axis that has some."""
        axes = tracks.dominant_axes(ordinates)
        rows = {axis: np.flatnonzero(axes == axis) for axis in range(3)}
        return [
            cls(tracks, levels, axis, tuple(a[own] for a in ordinates), incoming[own], source)
            for axis, own in rows.items()
            if len(own)
        ]

    @property
    def pair_count(self) -> int:
        """Number of pairs of ordinates."""
        return len(self._incoming)

    def groups(self, memory: int) -> list[list[int]]:
        """Divide the pairs into groups; the radiance of the tracks of one group fits in memory."""
        each = 2 * self._track_count * (self._channels + 1) * 4
        most = max(1, int(SHARE_CARRIED * memory / each))
        return [list(range(first, last)) for first, last in even_slabs(self.pair_count, most)]

    def slabs(self, memory: int, pairs: int, fewest: int = 1) -> list[Slab]:
        """Slabs of as many slices as fit beside what the tracks of so many ``pairs`` carry, about
        ``fewest`` at least.
        """
        carried = (pairs + 1) * 2 * self._track_count * (self._channels + 1) * 4
        of_channel = BYTES_OF_CHANNEL if self._source is None else BYTES_OF_SOURCE
        each = 2 * self._track_count * (BYTES + of_channel * self._channels)
        most = MOST_VALUES // (2 * self._track_count * self._channels)
        slices = int(self._tracks.grid.resolution[self.axis])
        most = min(most, -(-slices // fewest))
        return symmetric_slabs(slices, max(1, min(_thickness(memory - carried, each), most)))

    @staticmethod
    def numbers(slabs: list[Slab], step: int) -> list[int]:
        """Return the slabs that are crossed in a ``step``: along the axis, and, if it is another
        one, against it.
        """
        last = len(slabs) - 1 - step
        return [step] if step == last else [step, last]

    @staticmethod
    def is_second_visit(slabs: list[Slab], step: int) -> bool:
        """Return whether the slabs of a ``step`` have been crossed both ways after it."""
        return step >= len(slabs) // 2

    def cross(
        self,
        slabs: list[Slab],
        step: int,
        pairs: list[int],
        carried: Carried,
        parts: list[np.ndarray | None],
    ) -> list[np.ndarray]:
        """Cross one slab each way with these ``pairs``; return the sums of each slab, to which is
        added what was ``carried`` there.

        ``parts`` are the sums before, None for 0. What the tracks carry is replaced.
        """
        numbers = self.numbers(slabs, step)
        pair = slabs[numbers[0]], slabs[numbers[-1]]
        boxes = [self.box(slabs[number]) for number in numbers]
        medium = swept_medium([self._levels.read(*box) for box in boxes], self.axis)
        values = self._values(parts, boxes)
        table = self._tracks.slab_table(self._ordinates, self._incoming, self.axis, pair)
        source = None if self._source is None else values
        volume = SweptVolume(values, source, dr.opaque(mi.UInt32, 0), self._channels)
        for i in pairs:
            state = CarriedRadiance(carried.get(i))
            sweep_tracks(medium, volume, table, table.pair_index[i], self._track_index, state)
            dr.eval(values, state.after)
            carried[i] = state.after
        del medium, state
        return self._sums(values, boxes)

    def box(self, slab: Slab) -> tuple[list[int], list[int]]:
        """Return the lower and upper end (z, y, x) of a slab."""
        lower, upper = [0, 0, 0], list(self._tracks.grid.shape)
        lower[2 - self.axis], upper[2 - self.axis] = slab
        return lower, upper

    def _values(self, parts: list[np.ndarray | None], boxes: list) -> mi.Float:
        """Return the stored sums of one or two slabs, or 0, by slices.

        With a source, each voxel has the four values of `Tracks.sweep`.
        """
        shapes = [self._shape_of_sums(box) for box in boxes]
        if self._source is None and all(part is None for part in parts):
            return dr.opaque(mi.Float, 0, sum(int(np.prod(shape)) for shape in shapes))
        parts = [
            np.zeros(shape, np.float32) if part is None else part.reshape(shape)
            for part, shape in zip(parts, shapes, strict=True)
        ]
        place = slice_place(self.axis)
        joined = parts[0] if len(parts) == 1 else np.concatenate(parts, place)
        if self._source is not None:
            sums, joined = joined, np.zeros((*joined.shape, 4), np.float32)
            sources = [by_slices(self._source.read(*box), self.axis) for box in boxes]
            joined[..., 0] = np.concatenate(sources, place).reshape(sums.shape)
            joined[..., 1] = sums
        return mi.Float(joined.ravel())

    def _sums(self, values: mi.Float, boxes: list) -> list[np.ndarray]:
        """Return the sums of each slab, by slices."""
        place, first = slice_place(self.axis), 0
        shape = list(self._shape_of_sums(boxes[0]))
        thickness = shape[place]
        shape[place] *= len(boxes)
        if self._source is not None:
            values = dr.gather(
                mi.Float, values, 4 * dr.arange(mi.UInt32, dr.width(values) // 4) + 1
            )
        sums, found = np.array(values).reshape(shape), []
        for _ in boxes:
            within: list = [slice(None)] * sums.ndim
            within[place] = slice(first, first + thickness)
            found.append(sums[tuple(within)])
            first += thickness
        return found

    def shape_of_sums(self, slab: Slab) -> tuple[int, ...]:
        """Return the shape of the sums of a slab, which are by slices."""
        return self._shape_of_sums(self.box(slab))

    def _shape_of_sums(self, box: tuple) -> tuple[int, ...]:
        return (*by_slices(np.empty(_shape(box), bool), self.axis).shape, self._channels)

    def irradiance(self, sums: np.ndarray, box: tuple) -> np.ndarray:
        """Convert the sums of a slab to the irradiance (z, y, x, channel) in its ``box``."""
        if self._source is None:
            found = self._at_centres(mi.Float(sums.ravel()), _shape(box))
        else:
            found = from_slices(sums, self.axis)
        return found.reshape(*_shape(box), self._channels)

    def _at_centres(self, means: mi.Float, shape: tuple[int, int, int]) -> np.ndarray:
        """Return the values of a slab at the centres of its voxels (z, y, x, channel)."""
        grid, channels = Grid(shape, np.eye(4)), self._channels
        index = dr.arange(mi.UInt32, grid.voxel_count)
        box = SweptBox(grid, np.zeros(3, int), grid.resolution, self.axis)
        found = []
        for c in range(channels):
            value = values_at_centres(means, box, index, c, channels)
            found.append(np.array(value))
        return found[0] if channels == 1 else np.stack(found, axis=1)


def _shape(box: tuple) -> tuple[int, int, int]:
    return tuple(b - a for a, b in zip(*box, strict=True))


def _thickness(memory: int, slice_bytes: int) -> int:
    """Return how many slices of ``slice_bytes`` bytes each fit in ``memory``, at least one."""
    return int(np.clip(memory // slice_bytes, 1, MOST_SLICES))
