"""OpenVDB grids (``.vdb``) through OpenVDB's own Python module.

PyPI has it only inside ``bpy``, Blender as a module, from whose folder it is loaded without the
rest of Blender.
"""

from __future__ import annotations

import glob
import importlib.util
import os
import struct
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.extras import MissingPackageError
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import (
    ReadOptions,
    chosen_field,
    placement_of,
    scalar_volume,
)

_TYPES = {
    "bool": "bool",
    "float": "float32",
    "double": "float64",
    "int32": "int32",
    "int64": "int64",
    "vec3s": "float32",
    "vec3d": "float64",
    "vec3i": "int32",
}
_MAGIC = b" BDV\0\0\0\0"
#: Version of files from which on the header has the layout that is checked; bytes of its parts.
_OLDEST_LAYOUT, _LIBRARY_VERSION, _UUID, _TWO_OFFSETS = 222, 8, 36, 16


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one grid, densely over the bounds of its active voxels.

    Raises:
        IrrcacheError: a damaged file, several grids and none chosen, a level set, a frustum, or
            points.
        MissingPackageError: OpenVDB's module is not installed.
    """
    with path.open("rb") as stream:
        magic = stream.read(8)
    if magic != _MAGIC:
        raise IrrcacheError(f"{path} is no OpenVDB file: it begins with {magic!r}, not {_MAGIC!r}")
    _check_ends(path)
    openvdb = load_openvdb(path)
    described = {grid.name: grid for grid in openvdb.readAllGridMetadata(str(path))}
    name = chosen_field(str(path), described, options.field, "grid")
    source = f"{path}[{name}]"
    _check_kind(source, described[name])
    grid = openvdb.read(str(path), name)
    low, high = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    if grid.empty() or min(high - low) < 0:
        raise IrrcacheError(f"{source} is empty: it has no active voxels; export it again")
    if not grid.transform.isLinear:
        raise IrrcacheError(
            f"{source} is placed by a {grid.transform.typeName}, whose voxels are no boxes; "
            "resample it to a linear transform"
        )
    kind = grid.valueTypeName
    vector = (3,) if kind.startswith("vec3") else ()
    shape = (*(int(n) for n in high - low + 1), *vector)
    bytes_needed = int(np.prod(shape, dtype=object)) * np.dtype(_TYPES[kind]).itemsize
    require_memory(bytes_needed, f"reading {source}", "crop or resample it first")
    values = np.empty(shape, _TYPES[kind])
    grid.copyToArray(values, ijk=tuple(int(n) for n in low))
    return VolumeData(
        scalar_volume(source, values, "xyzc"[: values.ndim], options),
        **placement_of(_index_to_world(grid.transform, low)),
        source=source,
    )


def _check_ends(path: Path) -> None:
    """Compare the file with the ends of its grids, since OpenVDB reads missing values as zeros.

    Files whose header is of another layout (before 2013) are left to the library.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:

        def number(form: str) -> int:
            data = stream.read(struct.calcsize(form))
            if len(data) < struct.calcsize(form):
                raise _truncated(path, size, size + 1)
            return struct.unpack(form, data)[0]

        def skip_text() -> None:
            length = number("<I")
            if stream.tell() + length > size:
                raise _truncated(path, size, stream.tell() + length)
            stream.seek(length, os.SEEK_CUR)

        stream.seek(len(_MAGIC))
        version = number("<I")
        if version < _OLDEST_LAYOUT:
            return
        stream.seek(_LIBRARY_VERSION, os.SEEK_CUR)
        has_offsets = stream.read(1) == b"\1"
        stream.seek(_UUID, os.SEEK_CUR)
        for _ in range(number("<I")):  # metadata: name, type and value
            for _ in range(3):
                skip_text()
        for _ in range(number("<I") if has_offsets else 0):
            for _ in range(3):  # name, type, and the grid whose tree is shared
                skip_text()
            stream.seek(_TWO_OFFSETS, os.SEEK_CUR)
            end = number("<q")
            if end > size:
                raise _truncated(path, size, end)
            stream.seek(end)


def _truncated(path: Path, size: int, needed: int) -> IrrcacheError:
    return IrrcacheError(
        f"{path} is truncated: {size} bytes, but its grids end at byte {needed} or later; copy or "
        "export it again"
    )


def load_openvdb(path: Path) -> ModuleType:
    """Return OpenVDB's module: one that is installed, or the one in the folder of ``bpy``.

    Raises:
        MissingPackageError: there is none; the message names the file ``path`` that needs it.
    """
    for name in ("openvdb", "pyopenvdb"):
        if importlib.util.find_spec(name) is not None:
            return importlib.import_module(name)
    # Import neither bpy, which takes seconds and changes the search path, nor its folder of
    # packages, whose OpenImageIO would replace the one in use.
    blender = importlib.util.find_spec("bpy")
    for folder in (blender and blender.submodule_search_locations) or ():
        pattern = os.path.join(folder, "*", "python", "lib", "python*", "site-packages")
        for file in glob.glob(os.path.join(pattern, "openvdb*.so")):
            spec = importlib.util.spec_from_file_location("openvdb", file)
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            sys.modules["openvdb"] = module
            return module
    raise MissingPackageError(
        f'reading {path} needs the module "openvdb", which is not installed. Remedy: '
        f'"{sys.executable} -m pip install --no-deps bpy" (Blender, 0.4 GB, for Python 3.11 or '
        "3.13), or install openvdb from conda-forge, or convert the file: nanovdb_convert (part of "
        "OpenVDB) writes .nvdb, which the extra [nanovdb] reads"
    )


def refuse_level_set(source: str) -> NoReturn:
    """Raise IrrcacheError: a level set is no density."""
    raise IrrcacheError(
        f"{source} is a level set: its values are distances to a surface, not densities. Convert "
        "it to a fog volume first, e.g. in Houdini by Convert VDB or in Blender by Mesh to Volume"
    )


def _check_kind(source: str, grid: Any) -> None:
    if grid.gridClass == "level set":
        refuse_level_set(source)
    if grid.valueTypeName not in _TYPES:
        raise IrrcacheError(
            f"{source} has values of type {grid.valueTypeName!r}; give a grid of one of "
            f"{', '.join(_TYPES)}"
        )


def _index_to_world(transform: Any, low: np.ndarray) -> np.ndarray:
    """Return the 4x4 matrix from indices counted from the voxel ``low``; voxels are centred."""
    corner = np.array(transform.indexToWorld(tuple(float(n) for n in low)))
    matrix = np.eye(4)
    for axis in range(3):
        beside = [float(n) for n in low]
        beside[axis] += 1.0
        matrix[:3, axis] = np.array(transform.indexToWorld(tuple(beside))) - corner
    matrix[:3, 3] = corner
    return matrix
