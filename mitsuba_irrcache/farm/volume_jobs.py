"""Sweeps of a volume in files by several workers: the jobs of one sweep, and what each does.

All ordinates of one dominant axis cross the slabs across it one after the other (see
`out_of_core.slab_sweep`). A job is one step of a batch of ordinates: it reads the faces, what the
tracks of the batch carry out of the previous step, and the sums of the slabs, to which all batches
before have been added. It writes both anew under other names. So every file is written by one job
and never changes, a job may be repeated by any worker at any time, and each voxel is added to in
the order of one machine.

A job returns the digests of what it has written to these files, which are checked before a later
run continues with them (`require_unchanged`).
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from uuid import uuid4
from zipfile import BadZipFile

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, reason
from mitsuba_irrcache.farm.jobs import UnfitWorkerError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.io.files import atomic_write, file_digest
from mitsuba_irrcache.out_of_core.brick_file import EDGE, BrickFile
from mitsuba_irrcache.out_of_core.slab_sweep import (
    EXTINCTION_FILE,
    AxisSweep,
    Carried,
    PairsOfOrdinates,
)
from mitsuba_irrcache.out_of_core.slab_tracks import SlabTracks
from mitsuba_irrcache.out_of_core.slabs import Slab, even_slabs

#: Pairs of ordinates of a job, at most, and slabs of an axis, about at least: with more of both
#: more workers have something to do, and reading and writing takes a larger share.
PAIRS, FEWEST_SLABS = 8, 8
#: End of the names of files of a `SweepPlan`.
PLAN = ".plan.npz"
#: End of the names of files of the irradiance in a slab.
FOUND = ".found.npy"


@dataclass(frozen=True)
class SweepPlan:
    """All that a sweep of a volume depends on, as workers read it from a file.

    Attributes:
        name: of the sweep, which begins the names of its files.
        shape: voxels (z, y, x).
        to_world: of the voxels.
        quantum: of the extinction in the file `EXTINCTION_FILE` [1/scene unit].
        memory: bytes of a worker.
        ordinates: of all dominant axes.
        incoming: (n, 2, channels).
        source: name of the file of the source, "" without one.
    """

    name: str
    shape: tuple[int, int, int]
    to_world: np.ndarray
    quantum: float
    memory: int
    ordinates: PairsOfOrdinates
    incoming: np.ndarray
    source: str

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.incoming.shape[2]

    def save(self, folder: Path) -> None:
        """Write the plan."""
        names = ("directions", "weights", "offsets")
        arrays = dict(zip(names, self.ordinates, strict=True)) | {
            "shape": np.array(self.shape),
            "to_world": self.to_world,
            "quantum": np.float64(self.quantum),
            "memory": np.int64(self.memory),
            "incoming": self.incoming,
            "source": np.frombuffer(self.source.encode(), np.uint8),
        }
        with atomic_write(folder / f"{self.name}{PLAN}") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, folder: Path, name: str) -> SweepPlan:
        """Read a plan that `save` has written."""
        path = folder / f"{name}{PLAN}"
        try:
            with np.load(path, allow_pickle=False) as file:
                ordinates = tuple(file[key] for key in ("directions", "weights", "offsets"))
                return cls(
                    name,
                    tuple(map(int, file["shape"])),
                    file["to_world"],
                    float(file["quantum"]),
                    int(file["memory"]),
                    ordinates,
                    file["incoming"],
                    file["source"].tobytes().decode(),
                )
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise _unusable(path, reason(error)) from None

    def sweeps(self, folder: Path) -> list[AxisSweep]:
        """Return the sweeps of all dominant axes, with the files that they read."""
        grid = Grid(self.shape, self.to_world)
        levels = BrickFile.existing(folder / EXTINCTION_FILE, self.shape, np.uint16)
        source = None
        if self.source:
            source = BrickFile.existing(folder / self.source, self.shape, np.float32, self.channels)
        tracks = SlabTracks(grid, self.quantum)
        return AxisSweep.of_all(tracks, levels, self.ordinates, self.incoming, source)

    def slabs(self, sweep: AxisSweep) -> list[Slab]:
        """Return the slabs of one dominant axis."""
        return sweep.slabs(self.memory, PAIRS, FEWEST_SLABS)


@dataclass(frozen=True)
class SlabStep:
    """One step of a batch of ordinates of one dominant axis; ``batches`` and ``slabs`` are their
    numbers, ``axis`` is that of the list of sweeps.
    """

    sweep: str
    axis: int
    step: int
    batch: int
    slabs: int
    batches: int

    @property
    def name(self) -> str:
        """Name of the job."""
        return f"{self.sweep}-{self.axis}-{self.step}-{self.batch}"

    @property
    def faces(self) -> str:
        """The file of what the tracks carry after the step."""
        return f"{self.name}.faces.npy"

    @property
    def faces_before(self) -> str | None:
        """The file of what they carry before it."""
        return replace(self, step=self.step - 1).faces if self.step else None

    @property
    def numbers(self) -> list[int]:
        """The slabs that are crossed."""
        return AxisSweep.numbers([(0, 0)] * self.slabs, self.step)

    @property
    def _is_second_visit(self) -> bool:
        return AxisSweep.is_second_visit([(0, 0)] * self.slabs, self.step)

    @property
    def completes(self) -> bool:
        """Whether all ordinates have crossed the slabs both ways after it."""
        return self._is_second_visit and self.batch == self.batches - 1

    def sums(self, number: int) -> str:
        """Return the file of the sums of a slab after the step; `found` if it `completes` them."""
        return f"{self.sweep}-{self.axis}-slab-{number}-{self._visits}.sums.npy"

    def sums_before(self, number: int) -> str | None:
        """Return the file of the sums before the step; None where they are 0."""
        if not self._visits:
            return None
        return f"{self.sweep}-{self.axis}-slab-{number}-{self._visits - 1}.sums.npy"

    def found(self, number: int) -> str:
        """Return the file of the irradiance in a slab."""
        return f"{self.sweep}-{self.axis}-slab-{number}{FOUND}"

    @property
    def _visits(self) -> int:
        """How many batches have crossed the slabs before."""
        is_again = self._is_second_visit and len(self.numbers) == 2
        return self.batch + (self.batches if is_again else 0)

    @property
    def after(self) -> tuple[str, ...]:
        """The jobs that write what this one reads."""
        needed = []
        if self.step:
            needed.append(replace(self, step=self.step - 1))
        if self.batch:
            needed.append(replace(self, batch=self.batch - 1))
        elif self._visits:
            first = self.slabs - 1 - self.step
            needed.append(replace(self, step=first, batch=self.batches - 1))
        return tuple(each.name for each in needed)

    @property
    def reads(self) -> list[str]:
        """The files that no other job reads."""
        names = [self.faces_before, *map(self.sums_before, self.numbers)]
        return [name for name in names if name is not None]


def steps_of(sweep: str, slabs_and_batches: list[tuple[int, int]]) -> Iterator[SlabStep]:
    """Yield all steps of a sweep, given the numbers of slabs and batches of each axis."""
    for axis, (slabs, batches) in enumerate(slabs_and_batches):
        for step in range(slabs):
            for batch in range(batches):
                yield SlabStep(sweep, axis, step, batch, slabs, batches)


def by_length_of_way(steps: list[SlabStep]) -> list[SlabStep]:
    """Sort steps, the one that most others wait for in a row first."""
    left: dict[str, int] = {}
    for step in reversed(steps):  # each is before those that wait for it
        own = left.setdefault(step.name, 0)
        for name in step.after:
            left[name] = max(left.get(name, 0), own + 1)
    return sorted(steps, key=lambda step: -left[step.name])


def cross_slabs(arguments: dict, _: Path) -> dict[str, str]:
    """Run one step: cross one or two slabs along a batch of ordinates; return the digests of the
    files that it has written.
    """
    folder, step = _shared(arguments["folder"]), SlabStep(**arguments["step"])
    plan = SweepPlan.load(folder, step.sweep)
    sweep = plan.sweeps(folder)[step.axis]
    slabs = plan.slabs(sweep)
    pairs = list(range(*list(even_slabs(sweep.pair_count, PAIRS))[step.batch]))
    tracks = int(np.prod(plan.shape)) // plan.shape[2 - sweep.axis]
    faces = (len(pairs), 2, plan.channels + 1, tracks)
    carried: Carried = {}
    if step.faces_before is not None:
        before = np.array(_mapped(folder / step.faces_before, faces))
        carried = {
            i: tuple([mi.Float(values) for values in way] for way in own)
            for i, own in zip(pairs, before, strict=True)
        }
    parts = []
    for number in step.numbers:
        name = step.sums_before(number)
        shape = sweep.shape_of_sums(slabs[number])
        # Copied: Dr.Jit would write to the memory of the array itself.
        parts.append(None if name is None else np.array(_mapped(folder / name, shape)))
    sums = sweep.cross(slabs, step.step, pairs, carried, parts)
    digests = {}
    for number, own in zip(step.numbers, sums, strict=True):
        if step.completes:
            found = sweep.irradiance(own, sweep.box(slabs[number]))
            digests[step.found(number)] = _write(folder / step.found(number), found)
        else:
            digests[step.sums(number)] = _write(folder / step.sums(number), own)
    if step.step < len(slabs) - 1:
        after = [[[np.array(v) for v in way] for way in carried[i]] for i in pairs]
        digests[step.faces] = _write(folder / step.faces, np.array(after, np.float32))
    return digests


def add_axes(arguments: dict, _: Path) -> dict[str, str]:
    """Add the irradiance of all dominant axes in some slices; return the digest of these slices in
    the file of the sweep.
    """
    folder, (first, last) = _shared(arguments["folder"]), arguments["slices"]
    plan = SweepPlan.load(folder, arguments["sweep"])
    total = np.zeros((last - first, *plan.shape[1:], plan.channels), np.float32)
    for axis, sweep in enumerate(plan.sweeps(folder)):
        slabs = plan.slabs(sweep)
        for number, slab in enumerate(slabs):
            (lower, _, _), (upper, _, _) = box = sweep.box(slab)
            begin, end = max(first, lower), min(last, upper)
            if begin >= end:
                continue
            name = SlabStep(plan.name, axis, 0, 0, len(slabs), 1).found(number)
            shape = [b - a for a, b in zip(*box, strict=True)]
            found = _mapped(folder / name, (*shape, plan.channels))
            own = tuple(slice(a, b) for a, b in zip(box[0][1:], box[1][1:], strict=True))
            total[(slice(begin - first, end - first), *own)] += found[begin - lower : end - lower]
    file = BrickFile.existing(folder / plan.name, plan.shape, np.float32, plan.channels)
    file.write((first, 0, 0), total)
    digest = file.digest(first, last)
    file.close()
    return {plan.name: digest}


def require_unchanged(path: Path, digest: str, found: str | None = None) -> None:
    """Raise IrrcacheError unless a working file has the ``digest`` of what a finished job wrote.

    ``found`` is that of the part which the job has written, None for the whole file.
    """
    try:
        found = found or file_digest(path).hex()
    except OSError as error:
        raise _unusable(path, reason(error)) from None
    if found != digest:
        raise _unusable(path, "it is damaged: its content is not what was written to it")


def slices_of(shape: tuple[int, int, int]) -> list[Slab]:
    """Return the slices of each job of `add_axes`: whole bricks, which no other job writes."""
    return list(even_slabs(shape[0], EDGE))


def _shared(folder: str) -> Path:
    if not Path(folder).is_dir():
        raise UnfitWorkerError(f'it has no folder "{folder}"; use one that all machines share')
    return Path(folder)


def _mapped(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Open an array that `_write` has written."""
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise _unusable(path, reason(error)) from None
    if values.shape != tuple(shape) or values.dtype != np.float32:
        raise _unusable(path, f"it has shape {values.shape} of {values.dtype}")
    return values


def _unusable(path: Path, why: str) -> IrrcacheError:
    return IrrcacheError(
        f'the working file "{path}" cannot be used ({why}). Another command may be using the same '
        f'folder; if none is, remove the folder "{path.parent}" and start again.'
    )


def _write(path: Path, values: np.ndarray) -> str:
    """Write an array, whole or not at all; return the SHA-256 of the file."""
    values, header = np.ascontiguousarray(values), io.BytesIO()
    description = np.lib.format.header_data_from_array_1_0(values)
    np.lib.format.write_array_header_1_0(header, description)
    partial = path.with_name(f"{path.name}.{uuid4().hex}.tmp")
    try:
        with open(partial, "wb") as file:
            file.write(header.getbuffer())
            file.write(values.data)  # NumPy's own does not say why it fails
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise IrrcacheError(f'cannot write "{path}": {error.strerror or error}') from None
    sha = hashlib.sha256(header.getbuffer())
    sha.update(values.data)
    return sha.hexdigest()
