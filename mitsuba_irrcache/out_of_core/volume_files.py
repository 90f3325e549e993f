"""Files of volumes that are read slice by slice: NumPy's ``.npy``, raw files and Zarr arrays."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, reason
from mitsuba_irrcache.io.zarr_chunks import check_chunks, is_zarr
from mitsuba_irrcache.machine.extras import require

#: Names of raw files, with sizes along x, y, z and type, as in the Open SciVis data sets.
RAW_NAME = re.compile(r"_(\d+)x(\d+)x(\d+)_(u?int(?:8|16|32)|float(?:16|32|64))\.raw$")

#: Largest share of the time that is spent on finding changes of a file while it is read.
SHARE_OF_CHECKS = 0.05


class VolumeFile:
    """A volume (z, y, x) in a file, of which some slices at a time are in memory.

    A file of the type ``.npy``, a Zarr folder with one array, or ``NAME_XxYxZ_TYPE.raw`` (little
    endian, x fastest) such as ``head_256x256x113_uint16.raw``.

    Raises:
        IrrcacheError: a file that is none of these, is truncated, or holds no real numbers; or one
            that another program has written to since it was opened, when it is read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise IrrcacheError(f'irrcache: the volume file "{self.path}" does not exist.')
        #: `state` when it was opened
        self.opened_state = self.state
        self._next_check = 0.0
        self._open = self._opener()
        array = self._open()
        if len(array.shape) != 3 or min(array.shape) < 2:
            raise IrrcacheError(
                f'irrcache: "{self.path}" has shape {tuple(array.shape)}; volumes larger than '
                "memory have three axes (z, y, x) of at least 2 voxels and one channel."
            )
        if np.dtype(array.dtype).kind not in "iuf":
            raise IrrcacheError(
                f'irrcache: "{self.path}" holds values of type {array.dtype}; convert them to real '
                "numbers, such as float32."
            )
        if self.path.is_dir():
            check_chunks(f'irrcache: "{self.path}"', self.path, array)
        self.shape = tuple(int(n) for n in array.shape)

    def read(self, first: int, last: int) -> np.ndarray:
        """Return the slices ``first`` to ``last - 1``, float32 (z, y, x)."""
        # Opened anew each time: pages of a mapped file count as memory of the process while it is
        # mapped.
        try:
            array = self._open()
            # A copy also where the type is the same: a view would be read after the check below.
            values = np.array(array[first:last], dtype=np.float32, order="C")
        except IrrcacheError:
            raise
        except Exception as error:  # the decoders of Zarr raise exceptions of any type
            raise IrrcacheError(
                f'irrcache: slices {first} to {last - 1} of "{self.path}" cannot be read '
                f"({reason(error)}); copy or write it again."
            ) from error
        # A folder of many files is looked through for a small share of the time.
        if perf_counter() >= self._next_check:
            self.require_unchanged()
        return values

    def require_unchanged(self) -> None:
        """Raise IrrcacheError if the file was written to since it was opened: what was read is then
        a mixture of two volumes.
        """
        started = perf_counter()
        try:
            is_unchanged = self.state == self.opened_state
        except FileNotFoundError:  # being replaced
            is_unchanged = False
        if not is_unchanged:
            raise IrrcacheError(
                f'irrcache: the volume file "{self.path}" was changed while it was in use; when it '
                "is complete, start again."
            )
        self._next_check = started + (perf_counter() - started) / SHARE_OF_CHECKS

    @property
    def state(self) -> list[tuple[str, int, int, int]]:
        """Return name, size, time and inode of the file, or of each file in the folder.

        They change when a file is written.
        """
        parts = sorted(self.path.rglob("*")) if self.path.is_dir() else [self.path]
        known = ((str(part), part.stat()) for part in parts)
        return [(name, s.st_size, s.st_mtime_ns, s.st_ino) for name, s in known]

    def _opener(self) -> Callable:
        if is_zarr(self.path):
            return self._zarr
        if self.path.suffix.lower() == ".npy":
            return self._npy
        match = RAW_NAME.search(self.path.name)
        if match is None:
            raise IrrcacheError(
                f'irrcache: "{self.path}" is neither a .npy file, nor the folder of a Zarr array, '
                "nor a raw file with a name like head_256x256x113_uint16.raw (voxels along x, y, z "
                "and type)."
            )
        sides, kind = [int(n) for n in match.groups()[:3]], np.dtype(match[4]).newbyteorder("<")
        expected = int(np.prod(sides, dtype=object)) * kind.itemsize
        if self.path.stat().st_size != expected:
            raise IrrcacheError(
                f'irrcache: "{self.path}" has {self.path.stat().st_size} bytes, but its name '
                f"promises {expected}; correct the name, or copy the file again."
            )
        return lambda: np.memmap(self.path, kind, mode="r", shape=tuple(sides[::-1]))

    def _npy(self) -> np.ndarray:
        try:
            return np.load(self.path, mmap_mode="r", allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise IrrcacheError(
                f'irrcache: "{self.path}" is no complete .npy file ({error}); save it again.'
            ) from None

    def _zarr(self):
        require("zarr", "science", f"reading {self.path}")
        # Imported here because only Zarr arrays need it.
        import zarr

        try:
            array = zarr.open(str(self.path), mode="r")
        except Exception as error:  # of any type, where the metadata are damaged
            raise IrrcacheError(
                f'irrcache: "{self.path}" cannot be opened as a Zarr array ({reason(error)}); '
                "copy or write it again."
            ) from error
        if not isinstance(array, zarr.Array):
            raise IrrcacheError(
                f'irrcache: "{self.path}" is a Zarr group; name the folder of one of its arrays: '
                f"{', '.join(sorted(array.array_keys())) or 'it has none'}."
            )
        return array
