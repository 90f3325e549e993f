"""Folders of Zarr arrays: which ones are, and whether all of their chunks are complete.

Blosc unpacks a chunk whose end is missing without an error, and a chunk whose file is absent or
empty counts as the fill value: writers leave out chunks that hold nothing else.
"""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING

from mitsuba_irrcache.errors import IrrcacheError

if TYPE_CHECKING:
    import zarr

#: Names of the file in the folder of a Zarr array, of version 3 and 2 of the format.
_MARKS = ("zarr.json", ".zarray")
_METADATA = ("zarr.json", ".zarray", ".zattrs", ".zgroup", ".zmetadata")
#: Blosc's header: versions, flags, item size, sizes unpacked, of a block, and packed.
_BLOSC = struct.Struct("<4B3I")


def is_zarr(folder: Path) -> bool:
    """Return whether a folder holds a Zarr array."""
    return any((folder / mark).is_file() for mark in _MARKS)


def check_chunks(source: str, folder: str | os.PathLike, array: zarr.Array) -> int:
    """Check the files of all chunks, and return the number of those that are absent.

    Args:
        source: the array, for messages.
        folder: the folder of the array.
        array: the opened array.

    Raises:
        IrrcacheError: the file of a chunk is empty, or ends before its compressed data do.
    """
    stored = array.shards or array.chunks
    total = math.prod(-(-n // m) for n, m in zip(array.shape, stored, strict=True))
    is_blosc = array.shards is None and any(
        "Blosc" in type(codec).__name__ for codec in array.compressors
    )
    found = 0
    for file in Path(folder).rglob("*"):
        if file.name in _METADATA or not file.is_file():
            continue
        found += 1
        size = file.stat().st_size
        needed = _blosc_bytes(file) if is_blosc else 1
        if size < max(needed, 1):
            raise IrrcacheError(
                f"{source} is truncated: the chunk {file} has {size} bytes of at least {needed}; "
                "copy or export it again"
            )
    return max(total - found, 0)


def _blosc_bytes(file: Path) -> int:
    """Return the number of bytes that the header of a chunk states."""
    with file.open("rb") as stream:
        header = stream.read(_BLOSC.size)
    return _BLOSC.unpack(header)[-1] if len(header) == _BLOSC.size else _BLOSC.size
