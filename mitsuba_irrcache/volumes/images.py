"""Image files with a header - NRRD, NIfTI, Analyze, MetaImage, DICOM - through SimpleITK."""

from __future__ import annotations

import gzip
import re
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import SimpleITK

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.detached import data_files
from mitsuba_irrcache.volumes.dicom_lengths import check_lengths
from mitsuba_irrcache.volumes.options import ReadOptions, picked

_READERS = {
    ".nrrd": "NrrdImageIO",
    ".nhdr": "NrrdImageIO",
    ".nii": "NiftiImageIO",
    ".nii.gz": "NiftiImageIO",
    ".mha": "MetaImageIO",
    ".mhd": "MetaImageIO",
    ".hdr": "NiftiImageIO",  # it reads the Analyze format, too, from which NIfTI stems
    ".img": "NiftiImageIO",
    ".dcm": "GDCMImageIO",
}
# Maximum compression ratio of deflate (zlib.net/zlib_tech.html).
_BEST_DEFLATE_RATIO = 1032
_COMPRESSED = re.compile(
    rb"^(?:encoding:\s*(?:gz|gzip|bz2|bzip2)|CompressedData\s*=\s*True)\s*$", re.I | re.M
)
_DIMENSIONS = re.compile(rb"^\s*NDims\s*[=:]\s*([-+]?\d+)", re.M)
_MOST_DIMENSIONS = 10
_NRRD = b"NRRD"
#: Bytes of the headers of NIfTI-1 and Analyze, and of NIfTI-2, with which these headers begin.
_NIFTI1, _NIFTI2 = 348, 540
_COMPONENT_BYTES = {
    SimpleITK.sitkUInt8: 1,
    SimpleITK.sitkInt8: 1,
    SimpleITK.sitkUInt16: 2,
    SimpleITK.sitkInt16: 2,
    SimpleITK.sitkUInt32: 4,
    SimpleITK.sitkInt32: 4,
    SimpleITK.sitkUInt64: 8,
    SimpleITK.sitkInt64: 8,
    SimpleITK.sitkFloat32: 4,
    SimpleITK.sitkFloat64: 8,
}


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one image file with its spacing, origin and direction (LPS, mm).

    Raises:
        IrrcacheError: a truncated file, a header that declares more than the file can hold (found
            before memory is allocated), one that names a data file in another folder, or an image
            that is no scalar volume.
    """
    if path.suffix == ".dcm":
        check_lengths(path)
    if path.suffix.lower() in (".mha", ".mhd"):
        _check_dimensions(path)
    if path.suffix.lower() in (".nrrd", ".nhdr"):
        _check_magic(path)
    first_voxel = _first_voxel(path) if _reader_of(path) == "NiftiImageIO" else 0
    reader = SimpleITK.ImageFileReader()
    # The reader is fixed: one selected by the contents could read unchecked data files.
    reader.SetImageIO(_reader_of(path))
    reader.SetFileName(str(path))
    try:
        data = _data_files(path, options)
        reader.ReadImageInformation()
        _check_volume(path, reader)
        channel = picked(str(path), "channel", reader.GetNumberOfComponents(), options.channel)
        frames = int(np.prod(reader.GetSize()[3:], dtype=object))
        frame = picked(str(path), "frame", frames, options.frame)
        _check_file_holds(path, data, first_voxel + _image_bytes(path, reader))
        image = reader.Execute()
    except RuntimeError as error:
        raise IrrcacheError(
            f"cannot read {path}: {_reason(error)} (is it truncated, or of another format?); copy "
            "or export it again"
        ) from error
    if image.GetDimension() == 4:
        image = image[..., frame]
    values = SimpleITK.GetArrayFromImage(image)
    return VolumeData(
        values=values if values.ndim == 3 else values[..., channel],
        spacing=image.GetSpacing(),
        origin=image.GetOrigin(),
        direction=np.array(image.GetDirection()).reshape(3, 3),
        length_unit="mm",
        source=str(path),
    )


def _data_files(path: Path, options: ReadOptions) -> list[Path]:
    """Return the files with the voxels, after checking those that a header names."""
    suffix = path.suffix.lower()
    if suffix in (".nrrd", ".nhdr", ".mha", ".mhd"):
        return data_files(path, options.data_folders)
    if suffix not in (".hdr", ".img"):
        return [path]
    image = path.with_suffix(".img" if suffix == ".hdr" else path.suffix)
    header = path.with_suffix(".hdr") if suffix == ".img" else path
    packed = path.with_suffix(".img.gz")
    for file, what in ((header, "header"), (packed if packed.exists() else image, "voxels")):
        if not file.is_file():
            raise IrrcacheError(f"{path} has its {what} in {file}, which does not exist; add it")
    return [packed if packed.exists() else image]


def _check_dimensions(path: Path) -> None:
    """Refuse a MetaImage with more dimensions than fit in MetaIO's unchecked buffer."""
    with path.open("rb") as stream:
        found = _DIMENSIONS.search(stream.read(64 * 1024))
    if found is None:
        raise IrrcacheError(
            f"{path} is no MetaImage: its header has no line such as NDims = 3; copy or export it "
            "again"
        )
    if not 1 <= float(found[1]) <= _MOST_DIMENSIONS:
        raise IrrcacheError(f"{path} declares {found[1].decode()} dimensions; a volume has 3")


def _check_magic(path: Path) -> None:
    with path.open("rb") as stream:
        magic = stream.read(len(_NRRD))
    if magic != _NRRD:
        raise IrrcacheError(
            f"{path} is no NRRD file: it begins with {magic!r}, not {_NRRD!r}; copy or export it "
            "again"
        )


def _first_voxel(path: Path) -> int:
    """Return the byte at which the voxels of a NIfTI or Analyze image begin in their file.

    Raises:
        IrrcacheError: the file does not begin with the header of such an image.
    """
    name = path.name.lower()
    header = path.with_suffix(".hdr") if name.endswith(".img") else path
    if not header.is_file():
        return 0  # reported with the names of both files
    try:
        with gzip.open(header) if name.endswith(".gz") else header.open("rb") as stream:
            content = stream.read(_NIFTI2)
    except (EOFError, zlib.error, OSError) as error:
        raise _damaged(header, error) from error
    for order in "<>":
        size = struct.unpack_from(order + "i", content)[0] if len(content) >= 4 else 0
        if size == _NIFTI1 <= len(content):
            offset = struct.unpack_from(order + "f", content, 108)[0]  # vox_offset
        elif size == _NIFTI2 <= len(content):
            offset = struct.unpack_from(order + "q", content, 168)[0]
        else:
            continue
        if not name.endswith((".nii", ".nii.gz")):
            return 0  # they are in a file of their own
        return int(offset) if size < offset < 1 << 40 else size
    raise IrrcacheError(
        f"{header} is no NIfTI or Analyze image: it begins with {content[:4]!r} and not with the "
        "length of a header, or ends within the header; copy or export it again"
    )


def _reason(error: Exception) -> str:
    """Return the last line that ITK says about an error, without its own address."""
    lines = [line.strip() for line in str(error).splitlines()]
    said = [line for line in lines if line and not line.startswith("Reason:")]
    return re.sub(r"^ITK ERROR:\s*(\w+\(0x\w+\):\s*)?", "", said[-1]) if said else "unknown error"


def _check_volume(path: Path, reader: SimpleITK.ImageFileReader) -> None:
    size = reader.GetSize()
    if len(size) < 3 or (len(size) == 3 and size[2] == 1):
        raise IrrcacheError(
            f"{path} is one slice of size {size}; give the folder of the series, or a 3-D file"
        )
    if len(size) > 4 and any(n != 1 for n in size[4:]):
        raise IrrcacheError(f"{path} has size {size}; extract one 3-D frame of it first")


def _image_bytes(path: Path, reader: SimpleITK.ImageFileReader) -> int:
    """Return the bytes of the stored voxels; NIfTI's own header is read for the type.

    SimpleITK reports the type after rescaling.
    """
    count = int(np.prod(reader.GetSize(), dtype=object)) * reader.GetNumberOfComponents()
    if reader.HasMetaDataKey("bitpix"):
        return count * int(reader.GetMetaData("bitpix")) // 8
    return count * _COMPONENT_BYTES.get(reader.GetPixelID(), 1)


def _reader_of(path: Path) -> str:
    """Return the name of SimpleITK's reader of a format."""
    name = path.name.lower()
    return next(reader for extension, reader in _READERS.items() if name.endswith(extension))


def _check_file_holds(path: Path, data: Sequence[Path], image_bytes: int) -> None:
    """Compare the size declared in the header with the file, and decompress a ``.gz`` once."""
    if path.suffix == ".dcm":
        # Pixel data may be compressed by any codec.
        _check_ratio(path, path.stat().st_size, image_bytes)
        return
    if path.suffix == ".gz":
        _check_ratio(path, path.stat().st_size, image_bytes)
        _check_gzip(path, image_bytes)
        return
    with path.open("rb") as stream:
        header = stream.read(64 * 1024)
    stored = sum(file.stat().st_size for file in data)
    if data[0].suffix == ".gz":
        _check_ratio(data[0], stored, image_bytes)
        _check_gzip(data[0], image_bytes)
        return
    if _COMPRESSED.search(header):
        _check_ratio(data[0], stored, image_bytes)
    elif stored < image_bytes:
        _raise_truncated(data[0], stored, image_bytes)


def _check_ratio(path: Path, stored: int, image_bytes: int) -> None:
    if image_bytes > stored * _BEST_DEFLATE_RATIO:
        raise IrrcacheError(
            f"{path} promises {image_bytes} bytes of voxels, but its {stored} compressed bytes "
            "cannot hold them; the header is wrong or the file truncated"
        )


def _check_gzip(path: Path, image_bytes: int) -> None:
    """Decompress to the end, because the NIfTI reader silently replaces missing data by zeros."""
    unpacked = 0
    try:
        with gzip.open(path) as stream:
            while block := stream.read(1 << 22):
                unpacked += len(block)
    except (EOFError, zlib.error, OSError) as error:
        raise _damaged(path, error) from error
    if unpacked < image_bytes:
        _raise_truncated(path, unpacked, image_bytes)


def _damaged(path: Path, error: Exception) -> IrrcacheError:
    return IrrcacheError(f"{path} is truncated or damaged ({error}); copy it again")


def _raise_truncated(path: Path, actual: int, image_bytes: int) -> None:
    raise IrrcacheError(
        f"{path} is truncated: {actual} bytes, but its header promises {image_bytes}; copy "
        "or export it again"
    )
