"""Working files of volumes, stored in bricks, of which boxes are read and written."""

from __future__ import annotations

import hashlib
import os
import weakref
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError

#: Voxels along an edge of a brick.
EDGE = 32


class BrickFile:
    """Values (z, y, x, channel) of one type in a file, created with zeros if it is missing.

    Slabs across any axis are read and written in whole bricks, each of which is contiguous; slabs
    across x of an array with x fastest would touch every page of the file.
    """

    def __init__(
        self, path: Path, shape: tuple[int, int, int], dtype: np.dtype, channels: int = 1
    ) -> None:
        self.path, self.shape = path, shape
        self.channels, self.dtype = channels, np.dtype(dtype)
        self._counts = [-(-n // EDGE) for n in shape]
        self._bytes = EDGE**3 * channels * self.dtype.itemsize
        if not hasattr(os, "pread"):
            raise IrrcacheError(
                "irrcache: sigma_t_file needs Linux or macOS: working files of this system cannot "
                "be read at a position; use a volume that fits into memory."
            )
        self._file = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        self.close = weakref.finalize(self, os.close, self._file)
        size = self._size
        if os.fstat(self._file).st_size == size:
            return
        try:
            os.ftruncate(self._file, size)
            if hasattr(os, "posix_fallocate"):
                # Reserve the space at once, so that a full disk is noticed now and not after hours.
                os.posix_fallocate(self._file, 0, size)
        except OSError as error:
            self.close()
            raise IrrcacheError(
                f'irrcache: cannot create a working file of {size / 2**30:.1f} GiB at "{path}": '
                f"{error.strerror}; use another disk (work_folder, or -o of irrcache farm)."
            ) from None

    @classmethod
    def existing(
        cls, path: Path, shape: tuple[int, int, int], dtype: np.dtype, channels: int = 1
    ) -> BrickFile:
        """Open an existing file; raise IrrcacheError if it is missing or has another size."""
        if not path.is_file():
            raise IrrcacheError(
                f'the working file "{path}" is missing; another command may be using its folder.'
            )
        bytes_there = path.stat().st_size
        file = cls(path, shape, dtype, channels)
        if bytes_there != file._size:
            raise IrrcacheError(
                f'the working file "{path}" has {bytes_there} bytes of {file._size}.'
            )
        return file

    @property
    def _size(self) -> int:
        return int(np.prod(self._counts, dtype=object)) * self._bytes

    @classmethod
    def without_name(
        cls, path: Path, shape: tuple[int, int, int], dtype: np.dtype, channels: int = 1
    ) -> BrickFile:
        """Create a file that is deleted when it is closed, or with the returned object."""
        try:
            return cls(path, shape, dtype, channels)
        finally:
            path.unlink(missing_ok=True)

    def read(self, lower: Sequence[int], upper: Sequence[int]) -> np.ndarray:
        """Return the values (z, y, x[, channel]) of a box between two corners (z, y, x)."""
        shape = [b - a for a, b in zip(lower, upper, strict=True)]
        box = np.empty((*shape, self.channels), self.dtype)
        for number, inside, outside in self._bricks(lower, upper):
            box[outside] = self._brick(number)[inside]
        return box[..., 0] if self.channels == 1 else box

    def write(self, lower: Sequence[int], values: np.ndarray) -> None:
        """Replace the values of a box that begins at the voxel ``lower`` (z, y, x)."""
        values = values.reshape(*values.shape[:3], self.channels)
        upper = [a + n for a, n in zip(lower, values.shape, strict=False)]
        for number, inside, outside in self._bricks(lower, upper):
            if all(part == slice(0, EDGE) for part in inside):
                brick = np.ascontiguousarray(values[outside], self.dtype)
            else:
                brick = self._brick(number).copy()
                brick[inside] = values[outside]
            os.pwrite(self._file, brick.data.cast("B"), number * self._bytes)

    def digest(self, first: int, last: int) -> str:
        """Return the SHA-256 of all bricks with voxels in the slices from ``first`` to before
        ``last``.
        """
        _, ny, nx = self._counts
        sha = hashlib.sha256()
        for number in range(first // EDGE * ny * nx, -(-last // EDGE) * ny * nx):
            sha.update(os.pread(self._file, self._bytes, number * self._bytes))
        return sha.hexdigest()

    def _brick(self, number: int) -> np.ndarray:
        data = os.pread(self._file, self._bytes, number * self._bytes)
        return np.frombuffer(data, self.dtype).reshape(EDGE, EDGE, EDGE, self.channels)

    def _bricks(self, lower: Sequence[int], upper: Sequence[int]) -> Iterator[tuple]:
        """Yield each brick that overlaps a box.

        The results are the index of the brick, and the slices of the overlap within the brick and
        within the box.
        """
        _, ny, nx = self._counts
        ranges = [range(a // EDGE, -(-b // EDGE)) for a, b in zip(lower, upper, strict=True)]
        for at in product(*ranges):
            inside, outside = [], []
            for i, a, b in zip(at, lower, upper, strict=True):
                first, last = max(i * EDGE, a), min((i + 1) * EDGE, b)
                inside.append(slice(first - i * EDGE, last - i * EDGE))
                outside.append(slice(first - a, last - a))
            yield (at[0] * ny + at[1]) * nx + at[2], tuple(inside), tuple(outside)


class RecordFile:
    """Arrays that are stored and read as a whole, by index."""

    def __init__(self, path: Path) -> None:
        self._path, self._sizes = path, {}

    def write(self, number: int, values: np.ndarray) -> None:
        """Store an array."""
        self._sizes[number] = values.shape
        values.tofile(self._name(number))

    def read(self, number: int) -> np.ndarray | None:
        """Return an array and delete it from the disk; None if it was not stored."""
        if number not in self._sizes:
            return None
        name, shape = self._name(number), self._sizes.pop(number)
        values = np.fromfile(name, np.float32).reshape(shape)
        name.unlink()
        return values

    def _name(self, number: int) -> Path:
        return self._path.with_name(f"{self._path.name}-{number}")
