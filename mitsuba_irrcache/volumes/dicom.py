"""Reader of a folder with one CT or MR series as DICOM files, one per slice, through SimpleITK."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import SimpleITK
from tqdm import tqdm

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.dicom_lengths import check_lengths

# Errors are raised with the name of the folder; ITK's own warnings would precede them.
SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)

_POSITION = "0020|0032"
_ORIENTATION = "0020|0037"
_MODALITY = "0008|0060"
# Scanners round positions to about 0.01 mm; a larger share of the slice distance is no rounding.
_UNEVEN = 0.05


def read_dicom_series(folder: str | os.PathLike, series: str | None = None) -> VolumeData:
    """Read the series in ``folder``, sorted by position, rescaled (Hounsfield units for CT).

    Placement is LPS (x to the patient's left, y to the back, z to the head), in mm. The third
    direction is that from the first slice to the last, so the tilt of a gantry is preserved.

    Args:
        folder: the files of one series, or of several if ``series`` selects one.
        series: SeriesInstanceUID.

    Raises:
        IrrcacheError: no DICOM files, a truncated one, several series and none selected, a single
            slice, or slices missing, duplicated or unevenly spaced.
    """
    folder = Path(folder)
    files = sorted(file for file in folder.iterdir() if file.is_file())
    classes = {file: check_lengths(file) for file in files}
    uid = _choose_series(folder, series)
    _check_left_out(folder, classes)
    slices = _series_files(folder, uid)
    if len(slices) < 2:
        raise IrrcacheError(
            f"series {uid} in {folder} has {len(slices)} slice; a volume needs at least 2"
        )
    positions, orientation, modality = _slice_placement(slices)
    row, column = orientation.reshape(2, 3)
    order = np.argsort(positions @ np.cross(row, column), kind="stable")
    positions = positions[order]
    _check_gaps(folder, positions, np.cross(row, column))
    stack = positions[-1] - positions[0]
    image = _read_slices([slices[i] for i in order], folder)
    return VolumeData(
        values=SimpleITK.GetArrayFromImage(image),
        spacing=(*image.GetSpacing()[:2], np.linalg.norm(stack) / (len(slices) - 1)),
        origin=tuple(positions[0]),
        direction=np.stack([row, column, stack / np.linalg.norm(stack)], axis=1),
        unit="HU" if modality == "CT" else "",
        length_unit="mm",
        source=f"{folder} ({len(slices)} DICOM slices)",
    )


def _choose_series(folder: Path, series: str | None) -> str:
    """Return the UID of the only series, or of the requested one."""
    found = SimpleITK.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    if not found:
        raise IrrcacheError(
            f"folder {folder} has no DICOM series; give the folder that holds the slices itself"
        )
    if series in found:
        return series
    if series is None and len(found) == 1:
        return found[0]
    listing = "; ".join(f"{f} ({len(_series_files(folder, f))} slices)" for f in found)
    wanted = "several series" if series is None else f"no series {series}"
    raise IrrcacheError(f"folder {folder} has {wanted}: choose one with --series UID: {listing}")


def _check_left_out(folder: Path, classes: dict[Path, str | None]) -> None:
    """Raise IrrcacheError for damaged slices.

    GDCM leaves them out, which `_check_gaps` does not notice at the ends of a series. A file that
    belongs to no series is a damaged slice if its name is like that of a slice, unless it is a
    DICOM file of another class, such as a report.
    """
    uids = SimpleITK.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    used = {Path(file).name for uid in uids for file in _series_files(folder, uid)}
    patterns = {_pattern(name) for name in used}
    wanted = {classes[folder / name] for name in used} | {None, ""}
    for file, kind in classes.items():
        is_slice = file.suffix.lower() == ".dcm" or _pattern(file.name) in patterns
        if is_slice and kind in wanted and file.name not in used:
            raise IrrcacheError(
                f"{file} cannot be read as a slice, unlike others in its folder: it is truncated, "
                "damaged or of another format; copy it again, or remove it from the folder"
            )


def _pattern(name: str) -> str:
    """Return the name of a file with all numbers replaced by 0."""
    return re.sub(r"\d+", "0", name)


def _series_files(folder: Path, uid: str) -> tuple[str, ...]:
    return SimpleITK.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), uid)


def _slice_placement(files: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray, str]:
    """Return positions ``(slice, 3)``, the common orientation (6,), and the modality."""
    reader = SimpleITK.ImageFileReader()
    positions, orientations, modality = [], [], ""
    for file in tqdm(files, "reading DICOM headers", delay=1, disable=None):
        reader.SetFileName(file)
        reader.ReadImageInformation()
        if not (reader.HasMetaDataKey(_POSITION) and reader.HasMetaDataKey(_ORIENTATION)):
            raise IrrcacheError(f"{file} has no ImagePositionPatient; it is no slice of a volume")
        positions.append(_numbers(reader.GetMetaData(_POSITION)))
        orientations.append(_numbers(reader.GetMetaData(_ORIENTATION)))
        modality = reader.GetMetaData(_MODALITY).strip() if reader.HasMetaDataKey(_MODALITY) else ""
    turned = np.abs(np.array(orientations) - orientations[0]).max(axis=1) > 1e-3
    if turned.any():
        raise IrrcacheError(
            f"{files[int(turned.argmax())]} lies in another plane than {files[0]}; "
            "keep scout views and reformats out of the folder"
        )
    return np.array(positions), np.array(orientations[0]), modality


def _numbers(text: str) -> list[float]:
    try:
        return [float(number) for number in text.split("\\")]
    except ValueError as error:
        raise IrrcacheError(f"a DICOM slice is placed at {text!r}, which is no position") from error


def _check_gaps(folder: Path, positions: np.ndarray, normal: np.ndarray) -> None:
    """Refuse duplicate, missing or unevenly spaced slices, which one z spacing cannot represent."""
    depth = positions @ normal
    steps = np.diff(depth)
    usual = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - usual)))
    step = float(steps[worst])
    where = f"between positions {depth[worst]:.2f} and {depth[worst + 1]:.2f} mm in {folder}"
    if usual <= 0 or step < 0.01 * usual:
        raise IrrcacheError(
            f"two slices at the same position {where}; keep one of them, or choose --series UID"
        )
    if abs(step - usual) <= _UNEVEN * usual:
        return
    missing = round(step / usual) - 1
    if missing > 0:
        raise IrrcacheError(
            f"about {missing} slice(s) missing {where}: the step is {step:.2f} mm, usually "
            f"{usual:.2f} mm; complete the series"
        )
    raise IrrcacheError(
        f"uneven slices {where}: the step is {step:.2f} mm, usually {usual:.2f} mm; "
        "resample the series to even slices first"
    )


def _read_slices(files: list[str], folder: Path) -> SimpleITK.Image:
    reader = SimpleITK.ImageSeriesReader()
    reader.SetFileNames(files)
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise IrrcacheError(f"cannot read the DICOM series in {folder}: {error}") from error
    if image.GetNumberOfComponentsPerPixel() != 1:
        raise IrrcacheError(f"the DICOM series in {folder} is in colour; give one of grey values")
    return image
