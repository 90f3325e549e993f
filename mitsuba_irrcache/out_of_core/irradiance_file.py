"""The property ``irradiance_file``: irradiance in a ``.npy``, with a record of its inputs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.out_of_core.brick_file import EDGE, BrickFile
from mitsuba_irrcache.out_of_core.slabs import even_slabs


class IrradianceFile:
    """Irradiance that was written by `write`: float32 (z, y, x, channel).

    With ``is_grey`` all channels are equal, and the first one is read.
    """

    def __init__(self, path: Path, is_grey: bool) -> None:
        self._path = path
        *self.shape, channels = np.load(path, mmap_mode="r", allow_pickle=False).shape
        self.channels = 1 if is_grey else channels

    def read(self, lower: Sequence[int], upper: Sequence[int]) -> np.ndarray:
        """Return the values (z, y, x[, channel]) of a box between two corners (z, y, x)."""
        # Opened anew each time, as pages of a mapped file count as memory of the process.
        mapped = np.load(self._path, mmap_mode="r", allow_pickle=False)
        box = mapped[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))]
        return np.array(box[..., 0] if self.channels == 1 else box)

    def close(self) -> None:
        """Do nothing, since the file belongs to the user."""


def write(path: Path, irradiance: BrickFile, colour: np.ndarray, inputs: str) -> None:
    """Write the irradiance slab by slab, and then its record with the digest of its ``inputs``.

    The irradiance is the product of the values and of ``colour`` (channels).
    """
    _record(path).unlink(missing_ok=True)
    partial = path.with_name(f".{path.name}.tmp")
    shape, (slices, ny, nx) = (*irradiance.shape, len(colour)), irradiance.shape
    try:
        for first, last in even_slabs(slices, EDGE):
            mode = "r+" if first else "w+"
            mapped = np.lib.format.open_memmap(partial, mode, np.float32, shape)
            values = irradiance.read((first, 0, 0), (last, ny, nx))
            values = values.reshape(last - first, ny, nx, -1)
            mapped[first:last] = values * colour.astype(np.float32)
            del mapped
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise IrrcacheError(
            f'irrcache: irradiance_file "{path}" cannot be written: {error.strerror}.'
        ) from None
    is_grey = irradiance.channels == 1 and bool(np.ptp(colour) == 0)
    record = {"inputs": inputs, "is_grey": is_grey, "file": _state(path)}
    with atomic_write(_record(path)) as file:
        file.write(json.dumps(record).encode())


def recorded(path: Path, inputs: str) -> IrradianceFile | None:
    """Open the file if it was computed from these ``inputs`` and has not been changed since."""
    try:
        record = json.loads(_record(path).read_text())
        if record["inputs"] == inputs and record["file"] == _state(path):
            return IrradianceFile(path, record["is_grey"])
    except (OSError, ValueError, KeyError):  # no file, or a damaged one
        pass
    return None


def _record(path: Path) -> Path:
    return path.with_name(f"{path.name}.json")


def _state(path: Path) -> list[int]:
    """Return the size and time of a file."""
    state = path.stat()
    return [state.st_size, state.st_mtime_ns]
