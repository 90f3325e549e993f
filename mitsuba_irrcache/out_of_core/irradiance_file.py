"""The property ``irradiance_file``: irradiance in a ``.npy``, with a record of its inputs."""

from __future__ import annotations

import json
import os
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.files import atomic_write, check_folder_of
from mitsuba_irrcache.out_of_core.brick_file import EDGE, BrickFile
from mitsuba_irrcache.out_of_core.slabs import even_slabs


class IrradianceFile:
    """Irradiance that was written by `write`: float32 (z, y, x, channel).

    With ``is_grey`` all channels are equal, and the first one is read. The file stays open: where
    another one replaces it, the values remain those of this one.
    """

    def __init__(self, path: Path, is_grey: bool) -> None:
        self._path, self._file = path, open(path, "rb")
        self.close = weakref.finalize(self, self._file.close)
        np.lib.format.read_magic(self._file)
        self._shape, *_ = np.lib.format.read_array_header_1_0(self._file)
        self._offset = self._file.tell()
        *self.shape, channels = self._shape
        self.channels = 1 if is_grey else channels
        #: size and time of the file
        self.state = _state(self._file.fileno())

    def read(self, lower: Sequence[int], upper: Sequence[int]) -> np.ndarray:
        """Return the values (z, y, x[, channel]) of a box between two corners (z, y, x).

        Raises IrrcacheError if another program has written to the file since it was opened.
        """
        # Mapped anew each time, as pages of a mapped file count as memory of the process.
        mapped = np.memmap(self._file, "<f4", "r", self._offset, self._shape)
        box = mapped[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))]
        values = np.array(box[..., 0] if self.channels == 1 else box)
        if _state(self._file.fileno()) != self.state:
            raise IrrcacheError(
                f'irrcache: irradiance_file "{self._path}" was changed while it was in use; load '
                "the scene again, which computes the irradiance anew."
            )
        return values


def write(path: Path, irradiance: BrickFile, colour: np.ndarray, inputs: str) -> None:
    """Write the irradiance slab by slab, and then its record with the digest of its ``inputs``.

    The irradiance is the product of the values and of ``colour`` (channels).
    """
    _record(path).unlink(missing_ok=True)
    shape, (slices, ny, nx) = (*irradiance.shape, len(colour)), irradiance.shape
    with atomic_write(path) as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": tuple(shape)}
        np.lib.format.write_array_header_1_0(file, header)
        for first, last in even_slabs(slices, EDGE):
            values = irradiance.read((first, 0, 0), (last, ny, nx))
            values = values.reshape(last - first, ny, nx, -1) * colour.astype(np.float32)
            file.write(np.ascontiguousarray(values, "<f4").data)
        file.flush()
        # Noted before the file gets its name, under which another process may write its own.
        state = _state(file.fileno())
    is_grey = irradiance.channels == 1 and bool(np.ptp(colour) == 0)
    record = {"inputs": inputs, "is_grey": is_grey, "file": state}
    with atomic_write(_record(path)) as file:
        file.write(json.dumps(record).encode())


def check_replaceable(path: Path) -> None:
    """Raise IrrcacheError if ``path`` cannot be written, or is a file that `write` cannot have
    written, such as a volume: it has no record, which an interruption may also cause, and holds no
    irradiance (z, y, x, c).
    """
    check_folder_of(path, "irradiance_file")
    if not path.exists():
        return
    try:
        if {"inputs", "is_grey", "file"} <= set(json.loads(_record(path).read_text())):
            return
    except (OSError, ValueError, TypeError):  # no record, or a damaged one
        pass
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        if values.ndim == 4 and values.dtype == np.dtype("<f4"):
            return
    except (OSError, ValueError):
        pass
    raise IrrcacheError(
        f'irrcache: "{path}" exists and is no irradiance written by irrcache: it is not replaced. '
        "Name another file for the irradiance, or delete it."
    )


def recorded(path: Path, inputs: str) -> IrradianceFile | None:
    """Open the file if it was computed from these ``inputs`` and has not been changed since."""
    try:
        record = json.loads(_record(path).read_text())
        if record["inputs"] == inputs:
            file = IrradianceFile(path, record["is_grey"])
            if file.state == record["file"]:
                return file
            file.close()
    except (OSError, ValueError, KeyError, TypeError):  # no file, or a damaged one
        pass
    return None


def _record(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _state(file: int) -> list[int]:
    """Return the size and time of a file, given its descriptor."""
    state = os.fstat(file)
    return [state.st_size, state.st_mtime_ns]
