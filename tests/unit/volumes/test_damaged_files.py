"""Damaged files of every format are refused by an error that names the file, or read as they were.

Wrong values alone cannot be noticed: damages are those of interrupted copies and wrong names.
"""

from __future__ import annotations

import gc
import struct
from pathlib import Path

import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.images import write_pixels
from mitsuba_irrcache.volumes.options import ReadOptions
from mitsuba_irrcache.volumes.readers import read_volume
from tests.support.slices import write_dicom
from tests.support.volume_files import WRITTEN, Written, ramp

PAGE = b"<html>404 not found</html>"
CUTS = {"quarter": 0.25, "half": 0.5, "three quarters": 0.75}


def _simpleitk(path: Path, values: np.ndarray, compress: bool = False) -> None:
    import SimpleITK

    image = SimpleITK.GetImageFromArray(values)
    SimpleITK.WriteImage(image, str(path), useCompression=compress)


def _compressed(path: Path, values: np.ndarray) -> None:
    _simpleitk(path, values, True)


def _tiff(**options):
    def write(path: Path, values: np.ndarray) -> None:
        import tifffile

        with tifffile.TiffWriter(path) as tiff:
            for part in values:
                tiff.write(part, photometric="minisblack", contiguous=False, **options)

    return write


def _zarr(codec: str):
    def write(path: Path, values: np.ndarray) -> None:
        import zarr

        compressor = getattr(zarr.codecs, codec)()
        zarr.create_array(str(path), data=values, chunks=(2, 5, 8), compressors=compressor)

    return write


def _dicom(path: Path, values: np.ndarray) -> None:
    write_dicom(path, [0.0, 1.0, 2.0, 3.0])


def _png(path: Path, values: np.ndarray) -> None:
    path.mkdir()
    for number, part in enumerate(values.astype(np.uint8), 8):
        write_pixels(path / f"s{number}.png", part[..., None])


TIFF, ZARR = ("tifffile",), ("zarr",)
#: Files of formats above with other encodings.
OTHERS = {
    "nifti not compressed": Written(".nii", _simpleitk),
    "compressed nrrd": Written(".nrrd", _compressed),
    "compressed metaimage": Written(".mha", _compressed),
    "nrrd with a data file": Written(".nhdr", _simpleitk),
    "metaimage with a data file": Written(".mhd", _simpleitk),
    "tiff of pages": Written(".tif", _tiff(metadata=None), TIFF),
    "compressed tiff": Written(".tif", _tiff(compression="zlib"), TIFF),
    "zarr by blosc": Written(".zarr", _zarr("BloscCodec"), ZARR),
    "zarr by gzip": Written(".zarr", _zarr("GzipCodec"), ZARR),
    "dicom": Written("", _dicom),
    "png slices": Written("", _png),
}
#: Files of voxels without any header.
PLAIN = (".img", ".raw", ".zraw")


def damages(content: bytes) -> dict[str, bytes]:
    size = len(content)
    found = {"empty": b"", "first byte": content[:1], "first four bytes": content[:4]}
    found |= {name: content[: int(share * size)] for name, share in CUTS.items()}
    found |= {f"without the last {n}": content[: size - n] for n in (1, 2, 4, 8, 20) if n < size}
    return found | {"wrong magic": b"\0\1\2\3" + content[4:], "web page": PAGE}


def options(written: Written) -> ReadOptions:
    given = dict(zip(written.options[::2], written.options[1::2], strict=True))
    spacing = given.get("--spacing")
    return ReadOptions(
        field=given.get("--field"),
        spacing=tuple(map(float, spacing.split(","))) if spacing else None,
    )


@pytest.mark.parametrize("name", [*WRITTEN, *OTHERS])
def test_damaged_file(tmp_path, capfd, name):
    written = (WRITTEN | OTHERS)[name]
    path = written.make(tmp_path, ramp())
    expected = np.array(read_volume(path, options=options(written)).values)
    for file in [file for file in sorted(tmp_path.rglob("*")) if file.is_file()]:
        content = file.read_bytes()
        for damage, damaged in damages(content).items():
            if damage == "wrong magic" and file.suffix in PLAIN:
                continue
            file.write_bytes(damaged)
            try:
                values = read_volume(path, options=options(written)).values
            except IrrcacheError as error:
                said = str(error)
                assert path.name in said or file.name in said, (file, damage)
            else:
                np.testing.assert_array_equal(values, expected, f"{file} {damage}")
        file.write_bytes(content)
    gc.collect()
    assert "Traceback" not in capfd.readouterr().err


def test_absent_chunks_are_counted(tmp_path):
    """They are no damage: writers leave out chunks that hold the fill value alone."""
    path = OTHERS["zarr by gzip"].make(tmp_path, ramp())
    (path / "c" / "1" / "0" / "0").unlink()
    volume = read_volume(path)
    assert volume.values[2:].max() == 0
    assert volume.source.endswith("(1 chunks are absent and count as 0.0)")


def test_reports_beside_dicom_slices_are_ignored(tmp_path):
    write_dicom(tmp_path / "ct", [0.0, 1.0, 2.0])
    content = (tmp_path / "ct" / "a00.dcm").read_bytes()
    # The elements about the file alone, with the class of a report in place of that of a CT.
    (length,) = struct.unpack("<I", content[140:144])
    about = content[: 144 + length]
    assert about.count(b"1.2.840.10008.5.1.4.1.1.2\0") == 1
    report = about.replace(b"1.2.840.10008.5.1.4.1.1.2\0", b"1.2.840.10008.5.1.4.1.1.88")
    (tmp_path / "ct" / "report.dcm").write_bytes(report)
    (tmp_path / "ct" / "README").write_text("of a scanner")
    assert read_volume(tmp_path / "ct").size == (5, 6, 3)


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("nifti not compressed", "without the last 4", "is truncated: 988 bytes.*promises 992"),
        (
            "nifti not compressed",
            "web page",
            "is no NIfTI or Analyze image: it begins with b'<htm'",
        ),
        ("nrrd", "web page", "is no NRRD file: it begins with b'<htm'"),
        ("metaimage", "web page", "is no MetaImage"),
        ("netcdf4", "web page", "is no NetCDF file: it begins with b'<html>40'"),
        ("npy", "half", "is truncated: .* bytes, but its header promises"),
        ("mitsuba", "half", "is truncated: its header declares"),
        ("hdf5", "half", "truncated file"),
        ("openvdb", "half", "is truncated: .* bytes, but its grids end at byte"),
        ("nanovdb", "half", "is truncated"),
    ],
)
def test_message(tmp_path, name, damage, message):
    written = (WRITTEN | OTHERS)[name]
    path = written.make(tmp_path, ramp())
    path.write_bytes(damages(path.read_bytes())[damage])
    with pytest.raises(IrrcacheError, match=rf"{path.name}.*{message}"):
        read_volume(path, options=options(written))
