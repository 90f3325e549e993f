"""NumPy's files: ``.npy`` with one array, and ``.npz`` with arrays by name.

An array has the axes ``(z, y, x)`` or ``(z, y, x, channel)``. An ``.npz`` may hold, besides the
volume, ``spacing`` (x, y, z), ``origin`` (world position of the centre of the first voxel),
``direction`` (3x3, columns are the axes x, y, z) and the text ``unit``.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import (
    ReadOptions,
    chosen_field,
    plain_axes,
    readable_type,
    scalar_volume,
)

_PLACEMENT = ("spacing", "origin", "direction")
_MAGIC = b"\x93NUMPY"


class _Header(NamedTuple):
    """What the header of an array states."""

    shape: tuple[int, ...]
    dtype: np.dtype


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read a volume; without a ``spacing`` voxels have edges of length 1.

    Raises:
        IrrcacheError: a damaged file, or no array that is a scalar volume.
    """
    if path.suffix.lower() == ".npz":
        return _read_archive(path, options)
    with path.open("rb") as stream:
        header = _check_array(str(path), stream, path.stat().st_size)
    readable_type(str(path), header.dtype)
    array = np.load(path, mmap_mode="r", allow_pickle=False)
    return VolumeData(_volume(str(path), array, options), source=str(path))


def _read_archive(path: Path, options: ReadOptions) -> VolumeData:
    if not zipfile.is_zipfile(path):
        raise IrrcacheError(
            f"{path} is not an .npz archive, or truncated; write it with numpy.savez"
        )
    with zipfile.ZipFile(path) as archive:
        headers = {}
        for member in archive.infolist():
            if member.filename.endswith(".npy"):
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as stream:
                    headers[name] = _check_array(f"{path}[{name}]", stream, member.file_size)
    volumes = [n for n, h in headers.items() if n not in _PLACEMENT and len(h.shape) > 2]
    name = chosen_field(str(path), volumes, options.field, "array")
    readable_type(f"{path}[{name}]", headers[name].dtype)
    with np.load(path, allow_pickle=False) as arrays:
        placement = {key: arrays[key].tolist() for key in _PLACEMENT if key in arrays}
        unit = str(arrays["unit"]) if "unit" in arrays else ""
        values = _volume(f"{path}[{name}]", arrays[name], options)
    _check_placement(path, placement)
    return VolumeData(values, **placement, unit=unit, source=f"{path}[{name}]")


def _check_array(source: str, stream: BinaryIO, size: int) -> _Header:
    """Compare the header of an array with its ``size`` in bytes, and return it."""
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise IrrcacheError(f"{source} is no NumPy array; write it with numpy.save")
    major, minor = stream.read(2)
    readers = {(1, 0): np.lib.format.read_array_header_1_0}
    readers[2, 0] = readers[3, 0] = np.lib.format.read_array_header_2_0
    if (major, minor) not in readers:
        raise IrrcacheError(
            f"{source} has version {major}.{minor} of NumPy's format; save it again"
        )
    shape, _, dtype = readers[major, minor](stream)
    # An array of objects has no fixed size.
    expected = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if dtype.kind != "O" and size < stream.tell() + expected:
        raise IrrcacheError(
            f"{source} is truncated: {size} bytes, but its header promises {expected} bytes of "
            f"values {shape}; copy or save it again"
        )
    return _Header(shape, dtype)


def _volume(source: str, array: np.ndarray, options: ReadOptions) -> np.ndarray:
    axes = plain_axes(source, array.shape)
    return scalar_volume(source, array, axes, options)


def _check_placement(path: Path, placement: dict[str, object]) -> None:
    shapes = {"spacing": (3,), "origin": (3,), "direction": (3, 3)}
    for key, value in placement.items():
        array = np.asarray(value)
        if array.shape != shapes[key] or array.dtype.kind not in "iuf":
            raise IrrcacheError(
                f"{path} has {key} {value!r}; give numbers of shape {shapes[key]} (x, y, z)"
            )
