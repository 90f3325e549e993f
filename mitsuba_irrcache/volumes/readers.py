"""The entry point for all volume files: ``read_volume``."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.extras import require
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.formats import (
    NETCDF,
    PICTURES,
    TIFF,
    ZARR,
    ZARR_MARKS,
    format_of,
    suffixes,
)
from mitsuba_irrcache.volumes.options import CloudVariables, ReadOptions
from mitsuba_irrcache.volumes.raw import RawLayout, read_raw, read_raw_slices

PathLike = str | os.PathLike


def read_volume(
    path: PathLike | Sequence[PathLike],
    *,
    raw: RawLayout | None = None,
    series: str | None = None,
    replace_nan: float | None = None,
    options: ReadOptions | None = None,
    cloud: CloudVariables | None = None,
) -> VolumeData:
    """Read a scalar volume with its placement.

    Args:
        path: a file of one of `formats.FORMATS`; a folder with a DICOM series; with ``raw``, a raw
            file, or a list or glob pattern of raw slice files.
        raw: the layout of raw files.
        series: SeriesInstanceUID, for DICOM folders with several.
        replace_nan: value that replaces NaN and infinite values.
        options: which of several volumes to read, and from where.
        cloud: read the extinction of a cloud of liquid water, from these variables.

    Raises:
        IrrcacheError: anything that cannot be read as a finite scalar volume.
    """
    options = options or ReadOptions()
    if cloud is not None:
        volume = _read_cloud(path, options, cloud)
    else:
        volume = _read(path, raw, series, options)
    if options.spacing is not None:
        volume = replace(volume, spacing=options.spacing)
    return replace(volume, values=_finite(volume, replace_nan))


def _read(
    path: PathLike | Sequence[PathLike],
    raw: RawLayout | None,
    series: str | None,
    options: ReadOptions,
) -> VolumeData:
    paths = _expand(path)
    if raw is not None:
        return read_raw(paths[0], raw) if len(paths) == 1 else read_raw_slices(paths, raw)
    if len(paths) > 1:
        read = _reader_of_slices(paths)
        if read is not None:
            return read(paths, options)
        raise IrrcacheError(
            f"{len(paths)} files from {paths[0]} on: several files are read as slices only, all of "
            f"them TIFF, pictures ({', '.join(PICTURES)}), or raw with --raw-shape X,Y,Z and "
            "--raw-type"
        )
    single = paths[0]
    if not single.exists():
        raise IrrcacheError(f"volume file {single} does not exist")
    known = format_of(single)
    if known is not None:
        return known.read(single, options)
    if single.is_dir():
        return _read_folder(single, series, options)
    if single.name.lower().endswith(PICTURES):
        raise IrrcacheError(f"{single} is one slice; give a folder or list of all slices")
    raise IrrcacheError(
        f"{single} has an extension that is not supported; give {suffixes()}, a DICOM folder, a "
        f"folder or list of slices ({', '.join(PICTURES)}), or --raw-shape X,Y,Z for a raw file"
    )


def _expand(path: PathLike | Sequence[PathLike]) -> list[Path]:
    """Return the files that a path, a glob pattern or a list of paths stands for."""
    if not isinstance(path, (str, os.PathLike)):
        if not path:
            raise IrrcacheError("an empty list of files; name at least one")
        return [Path(p) for p in path]
    if not Path(path).exists() and glob.has_magic(str(path)):
        found = glob.glob(str(path))
        if not found:
            raise IrrcacheError(f"no file matches {path}")
        return [Path(p) for p in found]
    return [Path(path)]


def _read_folder(folder: Path, series: str | None, options: ReadOptions) -> VolumeData:
    names = {path.name for path in folder.iterdir()}
    if not names:
        raise IrrcacheError(f"folder {folder} is empty; give a folder with a DICOM series")
    if names & set(ZARR_MARKS):
        return ZARR.read(folder, options)
    shown = [folder / name for name in sorted(names) if not name.startswith(".")]
    read = _reader_of_slices(shown)
    if read is not None:
        return read(shown, options)
    require("SimpleITK", "volumes", f"reading {folder}")
    # Imported here because only these formats need SimpleITK.
    from mitsuba_irrcache.volumes.dicom import read_dicom_series

    return read_dicom_series(folder, series)


def _reader_of_slices(paths: list[Path]) -> Callable | None:
    """Return the function that stacks these files, or None if they are no slices."""
    names = [path.name.lower() for path in paths]
    if names and all(name.endswith(TIFF.suffixes) for name in names):
        return _read_tiff_slices
    if names and all(name.endswith(PICTURES) for name in names):
        return _read_pictures
    return None


def _read_pictures(paths: list[Path], options: ReadOptions) -> VolumeData:
    # Imported here because only pictures need OpenImageIO.
    from mitsuba_irrcache.volumes.picture_slices import read_slices

    return read_slices(paths, options)


def _read_cloud(
    path: PathLike | Sequence[PathLike], options: ReadOptions, cloud: CloudVariables
) -> VolumeData:
    paths = _expand(path)
    known = format_of(paths[0])
    if len(paths) > 1 or known not in (NETCDF, ZARR):
        raise IrrcacheError(
            f"{paths[0]}: --cloud reads one NetCDF file or Zarr folder with the liquid water "
            "content and the effective radius; for other files give --density"
        )
    return NETCDF.call(paths[0], "clouds", "read_cloud", options, cloud)


def _read_tiff_slices(paths: list[Path], options: ReadOptions) -> VolumeData:
    require("tifffile", TIFF.extra, f"reading {paths[0]}")
    # Imported here because only this format needs tifffile.
    from mitsuba_irrcache.volumes.tiff_files import read_slices

    return read_slices(paths, options)


def _finite(volume: VolumeData, replacement: float | None) -> np.ndarray:
    """Return finite values; others are replaced, or refused with their number and first index."""
    values = volume.values
    if values.dtype.kind != "f":
        return values
    bad_per_slice = [int(np.count_nonzero(~np.isfinite(part))) for part in values]
    count = sum(bad_per_slice)
    if count == 0:
        return values
    if replacement is not None:
        bad = ~np.isfinite(values)
        return np.where(bad, values.dtype.type(replacement), values)
    z = int(np.flatnonzero(bad_per_slice)[0])
    y, x = (int(i) for i in np.argwhere(~np.isfinite(values[z]))[0])
    raise IrrcacheError(
        f"{volume.source} has {count} values that are NaN or infinite, the first at voxel "
        f"(x, y, z) = ({x}, {y}, {z}); give --replace-nan VALUE to replace them"
    )
