"""Mitsuba's grid volume format (``.vol``, version 3): float32, little endian, x fastest.

Layout: ``"VOL"``, version (uint8), encoding (int32, 1 for float32), size x, y, z, channels (int32),
bounding box min and max (6 float32), then values as ``(z, y, x, channel)``.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.files import atomic_write

_HEADER = struct.Struct("<3sB5i6f")
_VERSION = 3
_FLOAT32 = 1
_CHANNELS = (1, 3, 6)
_UNIT_CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def read_vol(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """Read a ``.vol`` file.

    Returns:
        values float32 ``(z, y, x, channel)``, and the bounding box ``[[min], [max]]`` of shape
        ``(2, 3)`` (which Mitsuba ignores unless ``use_grid_bbox`` is set).

    Raises:
        IrrcacheError: the file is missing, of another format, truncated or too long; the header is
            compared with the file size before memory is allocated.
    """
    path = Path(path)
    if not path.is_file():
        raise IrrcacheError(f"volume file {path} does not exist")
    size, channels, bbox = _read_header(path)
    values = np.fromfile(path, dtype="<f4", offset=_HEADER.size)
    return values.reshape(*size[::-1], channels), bbox


def write_vol(
    path: str | os.PathLike,
    array: np.ndarray,
    bbox: tuple | np.ndarray = _UNIT_CUBE,
) -> int:
    """Write ``array`` of shape ``(z, y, x)`` or ``(z, y, x, channel)`` atomically.

    Args:
        path: the output file.
        array: any real dtype, converted to float32 slice by slice.
        bbox: ``((x, y, z) min, (x, y, z) max)`` stored in the header.

    Returns:
        the number of bytes written.

    Raises:
        IrrcacheError: the format does not support the shape, or a value is not finite.
    """
    if array.ndim == 3:
        array = array[..., None]
    if array.ndim != 4 or array.size == 0 or array.shape[3] not in _CHANNELS:
        raise IrrcacheError(
            f"cannot write shape {array.shape} to {path}: give (z, y, x) or (z, y, x, channel) "
            "with 1, 3 or 6 channels"
        )
    z, y, x, channels = array.shape
    corners = np.asarray(bbox, dtype=np.float32).reshape(6)
    header = _HEADER.pack(b"VOL", _VERSION, _FLOAT32, x, y, z, channels, *corners)
    with atomic_write(path) as stream:
        stream.write(header)
        for index in tqdm(range(z), f"writing {Path(path).name}", delay=1, disable=None):
            part = np.ascontiguousarray(array[index], dtype="<f4")
            if not np.isfinite(part).all():
                raise IrrcacheError(
                    f"cannot write {path}: slice z={index} has values that are NaN or infinite; "
                    "replace them first"
                )
            part.tofile(stream)
    return _HEADER.size + 4 * array.size


def _read_header(path: Path) -> tuple[tuple[int, int, int], int, np.ndarray]:
    """Read and validate the header: size (x, y, z), number of channels and bounding box."""
    file_bytes = path.stat().st_size
    if file_bytes < _HEADER.size:
        raise IrrcacheError(
            f"{path} is truncated: {file_bytes} bytes, a .vol header alone has {_HEADER.size}"
        )
    with path.open("rb") as stream:
        fields = _HEADER.unpack(stream.read(_HEADER.size))
    magic, version, encoding, *size, channels = fields[:7]
    if magic != b"VOL":
        raise IrrcacheError(f"{path} is not a Mitsuba volume: it begins with {magic!r}, not b'VOL'")
    if version != _VERSION or encoding != _FLOAT32:
        raise IrrcacheError(
            f"{path} has version {version} and encoding {encoding}; convert it to version "
            f"{_VERSION}, encoding {_FLOAT32} (float32)"
        )
    if channels not in _CHANNELS:
        raise IrrcacheError(f"{path} has {channels} channels; Mitsuba reads 1, 3 or 6")
    if min(size) < 1:
        raise IrrcacheError(f"{path} has size {size} (x, y, z); every side must be at least 1")
    expected = _HEADER.size + 4 * size[0] * size[1] * size[2] * channels
    if file_bytes != expected:
        state = "truncated" if file_bytes < expected else "too long"
        raise IrrcacheError(
            f"{path} is {state}: its header declares {size} voxels (x, y, z) and {channels} "
            f"channels, {expected} bytes, but it has {file_bytes}; copy or export it again"
        )
    return tuple(size), channels, np.array(fields[7:], dtype=np.float64).reshape(2, 3)
