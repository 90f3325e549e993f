"""The entry point for all volume files: ``read_volume``."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.mitsuba_vol import read_vol
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.raw import RawLayout, read_raw, read_raw_slices

PathLike = str | os.PathLike


def read_volume(
    path: PathLike | Sequence[PathLike],
    *,
    raw: RawLayout | None = None,
    series: str | None = None,
    replace_nan: float | None = None,
    data_folders: Sequence[PathLike] = (),
) -> VolumeData:
    """Read a scalar volume with its placement.

    Args:
        path: NRRD, NIfTI, MetaImage or Mitsuba ``.vol`` file; a folder with a DICOM series; with
            ``raw``, a raw file, or a list or glob pattern of raw slice files.
        raw: the layout of raw files.
        series: SeriesInstanceUID, for DICOM folders with several.
        replace_nan: value that replaces NaN and infinite values.
        data_folders: folders, besides that of a header (NRRD, MetaImage), for voxels that it keeps
            in other files.

    Raises:
        IrrcacheError: anything that cannot be read as a finite scalar volume.
    """
    volume = _read(path, raw, series, data_folders)
    return replace(volume, values=_finite(volume, replace_nan))


def _read(
    path: PathLike | Sequence[PathLike],
    raw: RawLayout | None,
    series: str | None,
    data_folders: Sequence[PathLike],
) -> VolumeData:
    paths = _expand(path)
    if raw is not None:
        return read_raw(paths[0], raw) if len(paths) == 1 else read_raw_slices(paths, raw)
    if len(paths) > 1:
        raise IrrcacheError(
            f"{len(paths)} files from {paths[0]} on: several files are read as raw slices only; "
            "give their --raw-shape X,Y,Z and --raw-type"
        )
    single = paths[0]
    if single.is_dir():
        return _read_folder(single, series)
    if not single.exists():
        raise IrrcacheError(f"volume file {single} does not exist")
    name = single.name.lower()
    if name.endswith(".vol"):
        return _read_mitsuba(single)
    # Imported here because only these formats need SimpleITK.
    from mitsuba_irrcache.volumes import images

    if name.endswith(images.EXTENSIONS):
        return images.read_image(single, data_folders)
    raise IrrcacheError(
        f"{single} has an extension that is not supported; give .vol, "
        f"{', '.join(images.EXTENSIONS)}, a DICOM folder, or --raw-shape X,Y,Z for a raw file"
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


def _read_folder(folder: Path, series: str | None) -> VolumeData:
    if not any(folder.iterdir()):
        raise IrrcacheError(f"folder {folder} is empty; give a folder with a DICOM series")
    # Imported here because only these formats need SimpleITK.
    from mitsuba_irrcache.volumes.dicom import read_dicom_series

    return read_dicom_series(folder, series)


def _read_mitsuba(path: Path) -> VolumeData:
    """Read a one-channel ``.vol``, placed by the bounding box in its header."""
    values, (low, high) = read_vol(path)
    if values.shape[3] != 1:
        raise IrrcacheError(
            f"{path} has {values.shape[3]} channels; only volumes of one value are imported, "
            "use it in a scene as it is"
        )
    spacing = (high - low) / values.shape[2::-1]
    return VolumeData(values[..., 0], tuple(spacing), tuple(low + 0.5 * spacing), source=str(path))


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
