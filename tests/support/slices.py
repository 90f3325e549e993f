"""Slices of a DICOM series, and the folder of the reference volumes."""

from __future__ import annotations

import locale
import os
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

#: Placement of the slices: distance of pixels, and position of the first one.
SLICE_SPACING = (0.7, 0.9)
X_ORIGIN, Y_ORIGIN = -30.0, 12.0


def data_folder() -> Path:
    """Return the folder of the reference volumes; skip the test if there is none."""
    default = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
    folder = Path(os.environ.get("IRRCACHE_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no data folder {folder}; set IRRCACHE_DATA to run this test")
    return folder


def write_dicom(folder: Path, positions, uid="1.2.826.0.1.9", tag="a", shear=0.0) -> None:
    """Write DICOM slices of the value 20 times their position, stored as (value + 1000) / 2.

    File names do not follow the positions.
    """
    folder.mkdir(exist_ok=True)
    before = locale.setlocale(locale.LC_ALL)  # the writer sets it to C, in which text is ASCII
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for index, position in enumerate(positions):
        image = SimpleITK.GetImageFromArray(np.full((6, 5), 20 * position, dtype=np.int16))
        image.SetSpacing(SLICE_SPACING)
        tags = {
            "0008|0060": "CT",
            "0008|0016": "1.2.840.10008.5.1.4.1.1.2",
            "0008|0018": f"{uid}.{index + 1}",
            "0020|000e": uid,
            "0020|0013": str(index),
            "0020|0032": f"{X_ORIGIN}\\{Y_ORIGIN + shear * position}\\{position}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0028|1052": "-1000",
            "0028|1053": "2",
        }
        for key, value in tags.items():
            image.SetMetaData(key, value)
        writer.SetFileName(str(folder / f"{tag}{(7 * index) % 97:02d}.dcm"))
        writer.Execute(image)
    locale.setlocale(locale.LC_ALL, before)
