"""Writes the files of this folder by the package ``vtk``, too large an install for the tests."""

from __future__ import annotations

import sys
from pathlib import Path

import vtk
from vtk.util.numpy_support import numpy_to_vtk

sys.path.insert(0, str(Path(__file__).parents[4]))
from tests.support.volume_files import DIRECTION, ORIGIN, SPACING, marker, ramp

FOLDER = Path(__file__).parent


def image(extent_begins_at_zero: bool = True) -> vtk.vtkImageData:
    values = marker()
    z, y, x = values.shape
    made = vtk.vtkImageData()
    shift = (0, 0, 0) if extent_begins_at_zero else (3, -2, 7)
    made.SetExtent(
        shift[0], shift[0] + x - 1, shift[1], shift[1] + y - 1, shift[2], shift[2] + z - 1
    )
    made.SetSpacing(SPACING)
    made.SetDirectionMatrix(DIRECTION.ravel().tolist())
    index = [s * n for s, n in zip(SPACING, shift, strict=True)]
    made.SetOrigin((ORIGIN - DIRECTION @ index).tolist())
    vectors = ramp()[..., None].repeat(3, axis=3) * [1, 2, 3]
    for name, array in (("marker", marker()), ("ramp", ramp()), ("vectors", vectors)):
        components = array.shape[3] if array.ndim == 4 else 1
        data = numpy_to_vtk(array.reshape(-1, components), deep=True)
        data.SetName(name)
        made.GetPointData().AddArray(data)
    made.GetPointData().SetActiveScalars("marker")
    return made


def main() -> None:
    for name, mode, compressor in (
        ("ascii", "Ascii", None),
        ("binary", "Binary", None),
        ("binary_zlib", "Binary", vtk.vtkZLibDataCompressor()),
        ("appended_lzma", "Appended", vtk.vtkLZMADataCompressor()),
        ("appended_base64", "Appended", None),
        ("appended_raw", "Appended", None),
    ):
        writer = vtk.vtkXMLImageDataWriter()
        writer.SetInputData(image(name != "appended_raw"))
        getattr(writer, f"SetDataModeTo{mode}")()
        writer.SetCompressor(compressor)
        writer.SetEncodeAppendedData(name == "appended_base64")
        writer.SetFileName(str(FOLDER / f"{name}.vti"))
        writer.Write()
    for name, mode in (("ascii", "ASCII"), ("binary", "Binary")):
        writer = vtk.vtkStructuredPointsWriter()
        writer.SetInputData(image())
        getattr(writer, f"SetFileTypeTo{mode}")()
        writer.SetFileName(str(FOLDER / f"{name}.vtk"))
        writer.Write()


if __name__ == "__main__":
    main()
