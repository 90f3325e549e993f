"""Raw files without a header: one file, or one file per slice."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData

_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")
_BYTE_ORDER = {"little": "<", "big": ">"}


@dataclass(frozen=True)
class RawLayout:
    """The layout of a raw file, which has no header.

    Attributes:
        shape: voxel counts along x, y, z (x fastest); of the whole volume, also for slice files.
        dtype: one of uint8, int8, uint16, int16, uint32, int32, float32, float64.
        endian: ``"little"`` or ``"big"``.
        spacing: voxel size along x, y, z.
        offset: bytes to skip at the start of every file.

    Raises:
        IrrcacheError: a field that describes no file.
    """

    shape: tuple[int, int, int]
    dtype: str = "uint8"
    endian: str = "little"
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    offset: int = 0

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise IrrcacheError(f"raw shape {self.shape}: give three counts X,Y,Z of at least 1")
        if self.dtype not in _TYPES:
            raise IrrcacheError(f"raw type {self.dtype!r}: give one of {', '.join(_TYPES)}")
        if self.endian not in _BYTE_ORDER:
            raise IrrcacheError(f"raw endianness {self.endian!r}: give little or big")
        if self.offset < 0:
            raise IrrcacheError(f"raw offset {self.offset}: give a number of bytes, 0 or more")

    @property
    def numpy_dtype(self) -> np.dtype:
        """Return the NumPy type including its byte order."""
        return np.dtype(self.dtype).newbyteorder(_BYTE_ORDER[self.endian])


def read_raw(path: str | os.PathLike, layout: RawLayout) -> VolumeData:
    """Map one raw file into memory; values are read on first use.

    Raises:
        IrrcacheError: the file is missing, or its size is not that of ``layout``.
    """
    path = Path(path)
    shape = layout.shape[::-1]
    _check_bytes(path, layout, shape)
    values = np.memmap(path, layout.numpy_dtype, mode="r", offset=layout.offset, shape=shape)
    return VolumeData(values, layout.spacing, source=str(path))


def read_raw_slices(paths: Sequence[str | os.PathLike], layout: RawLayout) -> VolumeData:
    """Stack raw slice files in natural order (``head.2`` before ``head.10``).

    Returns:
        values in the machine's byte order.

    Raises:
        IrrcacheError: the number of files is not the shape's z, a number is missing from the
            sequence of names, or a file's size is wrong.
    """
    ordered = natural_order(paths)
    x, y, z = layout.shape
    check_numbering(ordered)
    if len(ordered) != z:
        raise IrrcacheError(
            f"{len(ordered)} slice files from {ordered[0]} on, but raw shape {layout.shape} "
            f"(x, y, z) asks for {z}; correct the shape or the list"
        )
    values = np.empty((z, y, x), dtype=layout.dtype)
    for index, path in enumerate(ordered):
        _check_bytes(path, layout, (y, x))
        flat = np.fromfile(path, layout.numpy_dtype, offset=layout.offset)
        values[index] = flat.reshape(y, x)
    return VolumeData(values, layout.spacing, source=f"{ordered[0]} ... {ordered[-1].name}")


def _check_bytes(path: Path, layout: RawLayout, shape: tuple[int, ...]) -> None:
    """Compare a file's size with the layout before mapping or reading it."""
    if path.is_dir():
        raise IrrcacheError(f"raw file {path} is a folder; name its files, for example {path}/*")
    if not path.is_file():
        raise IrrcacheError(f"raw file {path} does not exist")
    count = int(np.prod(shape, dtype=object))
    expected = layout.offset + count * layout.numpy_dtype.itemsize
    actual = path.stat().st_size
    if actual != expected:
        state = "truncated" if actual < expected else "too long"
        raise IrrcacheError(
            f"raw file {path} is {state}: {actual} bytes, but {layout.offset} + {count} x "
            f"{layout.dtype} make {expected}; correct the shape, type or offset"
        )


def natural_order(paths: Sequence[str | os.PathLike]) -> list[Path]:
    """Sort files by the numbers in their names: ``head.2`` before ``head.10``."""
    return sorted((Path(path) for path in paths), key=lambda path: _natural_key(path.name))


def _natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that compares digits as numbers, without leading zeros, too."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts]


def check_numbering(ordered: Sequence[Path]) -> None:
    """Refuse numbered names with a gap: after a missing slice, all others would be shifted.

    Names whose only difference is one number count as numbered; other lists are used as given.
    """
    keys = [_natural_key(path.name) for path in ordered]
    if len(keys) < 3 or len({len(key) for key in keys}) != 1:
        return
    varying = [i for i in range(len(keys[0])) if len({key[i] for key in keys}) > 1]
    if len(varying) != 1 or keys[0][varying[0]][0] == 0:
        return
    numbers = np.array([key[varying[0]][1] for key in keys])
    steps = np.diff(numbers)
    holes = np.flatnonzero(steps > steps.min())
    if holes.size:
        before, after = ordered[holes[0]].name, ordered[holes[0] + 1].name
        raise IrrcacheError(
            f"a slice is missing between {before} and {after} in {ordered[0].parent}; "
            "complete the series, or import an unbroken part of it"
        )
