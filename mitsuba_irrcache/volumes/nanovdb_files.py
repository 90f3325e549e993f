"""NanoVDB grids (``.nvdb``) through NVIDIA Warp, on the processor."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.openvdb_files import refuse_level_set
from mitsuba_irrcache.volumes.options import (
    ReadOptions,
    chosen_field,
    placement_of,
    scalar_volume,
)

_MAGIC = (b"NanoVDB0", b"NanoVDB2")
# io::FileHeader: magic, version, number of grids, codec. io::FileMetaData: size in memory, size in
# the file, ..., number of active voxels, type of values, class of the grid, ..., bounds of the
# indices (inclusive), ..., length of the name.
_HEADER = struct.Struct("<8sIHH")
_RECORD = struct.Struct("<QQ8xQ2I48x6i24xI36x")
_LEVEL_SET = 1
_TYPES = {1: wp.float32, 2: wp.float64, 4: wp.int32, 6: wp.vec3f}


@dataclass(frozen=True)
class _Grid:
    """The entry of a grid in the table of contents of a file."""

    index: int
    name: str
    kind: int
    grid_class: int
    bounds: np.ndarray | None


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one grid, densely over the bounds of its active voxels.

    Raises:
        IrrcacheError: a damaged file, several grids and none chosen, a level set, or values that
            are neither float, double, int32 nor three floats.
    """
    content = path.read_bytes()
    grids = _contents(path, content)
    by_name = {grid.name: grid for grid in grids}
    grid = by_name[chosen_field(str(path), by_name, options.field, "grid")]
    source = f"{path}[{grid.name}]" if grid.name else str(path)
    if grid.grid_class == _LEVEL_SET:
        refuse_level_set(source)
    if grid.kind not in _TYPES:
        raise IrrcacheError(
            f"{source} has values of NanoVDB type {grid.kind}; convert it to float without "
            "quantisation"
        )
    dtype = _TYPES[grid.kind]
    wp.config.log_level = wp.LOG_ERROR
    volume = wp.Volume.load_from_nvdb(content, device="cpu")
    for _ in range(grid.index):
        volume = volume.load_next_grid()
    low, high = _bounds(source, grid, volume)
    size = tuple(int(n) for n in high - low + 1)
    needed = int(np.prod(size, dtype=object)) * 2 * wp.types.type_size_in_bytes(dtype)
    require_memory(needed, f"reading {source}", "crop or resample it first")
    info = volume.get_grid_info()
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(info.transform_matrix).reshape(3, 3)
    matrix[:3, 3] = np.array(info.translation) + matrix[:3, :3] @ low
    values = wp.empty(shape=size, dtype=dtype, device="cpu")
    first = wp.vec3i(*(int(n) for n in low))
    wp.launch(_lookup(dtype), values.shape, inputs=[volume.id, first, values], device="cpu")
    dense = values.numpy()
    axes = "xyz" if dense.ndim == 3 else "xyzc"
    return VolumeData(
        scalar_volume(source, dense, axes, options), **placement_of(matrix), source=source
    )


def _bounds(source: str, grid: _Grid, volume: wp.Volume) -> np.ndarray:
    """Return the least and the largest index of the active voxels, shape ``(2, 3)``."""
    bounds = grid.bounds
    if bounds is None:
        active = volume.get_voxels().numpy()
        bounds = np.array([active.min(axis=0), active.max(axis=0)]) if len(active) else None
    if bounds is None or (bounds[1] < bounds[0]).any():
        raise IrrcacheError(f"{source} is empty: it has no active voxels; export it again")
    return bounds.astype(np.int64)


def _contents(path: Path, content: bytes) -> list[_Grid]:
    """Return the table of contents, after comparing it with the length of the file.

    Warp does not check what it reads; a truncated file would end the process.
    """
    if len(content) < _HEADER.size or content[:8] not in _MAGIC:
        raise IrrcacheError(
            f"{path} is no NanoVDB file: it begins with {content[:8]!r}, not {_MAGIC[0]!r}; write "
            "it with NanoVDB 32 or newer"
        )
    *_, count, codec = _HEADER.unpack_from(content)
    grids, position, stored = [], _HEADER.size, 0
    for index in range(count):
        if position + _RECORD.size > len(content):
            raise _truncated(path, len(content), position + _RECORD.size)
        in_memory, in_file, voxels, kind, grid_class, *bounds, length = _RECORD.unpack_from(
            content, position
        )
        position += _RECORD.size
        name = content[position : position + length].rstrip(b"\0").decode("latin-1")
        position += length
        stored += in_file
        if codec == 0 and in_memory > in_file:
            raise _truncated(path, in_file, in_memory)
        # Warp itself writes neither bounds nor a number of voxels.
        known = np.array(bounds).reshape(2, 3) if voxels else None
        grids.append(_Grid(index, name, kind, grid_class, known))
    if position + stored > len(content):
        raise _truncated(path, len(content), position + stored)
    return grids


def _truncated(path: Path, actual: int, expected: int) -> IrrcacheError:
    return IrrcacheError(
        f"{path} is truncated: {actual} bytes, but its header promises {expected}; copy or export "
        "it again"
    )


def _lookup(dtype: type) -> wp.Kernel:
    """Return a kernel that reads the voxels from ``first`` on into an array."""

    @wp.kernel(module="unique")
    def lookup(volume: wp.uint64, first: wp.vec3i, values: wp.array3d(dtype=dtype)):
        i, j, k = wp.tid()
        values[i, j, k] = wp.volume_lookup(
            volume, first[0] + i, first[1] + j, first[2] + k, dtype=dtype
        )

    return lookup
