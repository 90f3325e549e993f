"""Files are read completely, in the right order and position, or refused with the reason."""

from __future__ import annotations

import gzip
import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.mitsuba_vol import read_vol, write_vol
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.raw import RawLayout
from mitsuba_irrcache.volumes.readers import read_volume
from tests.support.slices import data_folder, write_dicom

SPACING, ORIGIN = (0.7, 0.9, 2.5), (-30.0, 12.0, 101.5)
ANGLE = 0.3
DIRECTION = np.array(
    [[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1.0]]
)


def ramp(dtype="int16") -> np.ndarray:
    return (np.arange(3 * 4 * 5).reshape(3, 4, 5) - 20).astype(dtype)


def write_image(path: Path, values: np.ndarray, compress: bool = False) -> Path:
    image = SimpleITK.GetImageFromArray(values)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(DIRECTION.ravel())
    SimpleITK.WriteImage(image, str(path), useCompression=compress)
    return path


# Placement


def test_unit_cube_and_voxel_centres_agree():
    volume = VolumeData(ramp(), SPACING, ORIGIN, DIRECTION)
    centre = volume.to_world @ (0.5 / 5, 0.5 / 4, 0.5 / 3, 1)
    np.testing.assert_allclose(centre[:3], ORIGIN)
    last = volume.to_world @ (1 - 0.5 / 5, 1 - 0.5 / 4, 1 - 0.5 / 3, 1)
    np.testing.assert_allclose(last, volume.index_to_world @ (4, 3, 2, 1))
    edges = np.linalg.norm(volume.to_world[:3, :3], axis=0)
    np.testing.assert_allclose(edges, volume.physical_size)


@pytest.mark.parametrize(
    "changes",
    [{"spacing": (1, 0, 1)}, {"spacing": (1, np.nan, 1)}, {"direction": np.ones((3, 3))}],
)
def test_impossible_placement_is_refused(changes):
    with pytest.raises(IrrcacheError, match=r"spacing|direction"):
        VolumeData(ramp(), **changes)


@pytest.mark.parametrize("name", ["a.nrrd", "a.nii", "a.nii.gz", "a.mha", "a.mhd"])
@pytest.mark.parametrize("compress", [False, True])
def test_image_values_and_placement_are_read(tmp_path, name, compress):
    volume = read_volume(write_image(tmp_path / name, ramp(), compress))
    np.testing.assert_array_equal(volume.values, ramp())
    np.testing.assert_allclose(volume.spacing, SPACING, rtol=1e-6)
    np.testing.assert_allclose(volume.origin, ORIGIN, rtol=1e-6)
    np.testing.assert_allclose(volume.direction, DIRECTION, atol=1e-6)


# DICOM


def test_dicom_is_sorted_by_position_and_rescaled(tmp_path):
    write_dicom(tmp_path / "ct", [4.0, -1.0, 1.5, 6.5])
    volume = read_volume(tmp_path / "ct")
    np.testing.assert_array_equal(volume.values[:, 0, 0], [-20, 30, 80, 130])
    stored = struct.unpack("<h", (tmp_path / "ct" / "a00.dcm").read_bytes()[-2:])
    assert stored == ((80 + 1000) // 2,)
    np.testing.assert_allclose(volume.spacing, (SPACING[0], SPACING[1], 2.5))
    np.testing.assert_allclose(volume.origin, (ORIGIN[0], ORIGIN[1], -1.0))
    assert volume.unit == "HU"


@pytest.mark.parametrize("how", ["data", "about the file"])
def test_dicom_elements_beyond_the_end_are_refused(tmp_path, how):
    """A DICOM slice of a kilobyte with one wrong byte, which would allocate gigabytes, is
    refused.
    """
    write_dicom(tmp_path / "ct", [0.0, 1.0, 2.0])
    file = tmp_path / "ct" / "a07.dcm"
    content = file.read_bytes()
    if how == "data":  # the number of rows: 2 bytes long
        lie = content.replace(
            struct.pack("<HHI", 0x28, 0x10, 2), struct.pack("<HHI", 0x28, 0x10, 2**31)
        )
        said = r"\(0028,0010\) promises 2147483648 bytes"
    else:
        lie = content.replace(b"\x02\0\x02\0UI", b"\x02\0\x02\0\1\2")
        said = "no element"
    assert lie != content
    file.write_bytes(lie)
    with pytest.raises(IrrcacheError, match=rf"a07\.dcm.*{said}"):
        read_volume(tmp_path / "ct")


@pytest.mark.parametrize("count", [0, -3, 11, 2147483648])
def test_meta_images_of_invalid_dimensions_are_refused(tmp_path, count):
    """MetaImages of impossible dimensions are refused; 2^31 crashed the process."""
    file = write_image(tmp_path / "a.mha", ramp())
    file.write_bytes(file.read_bytes().replace(b"NDims = 3", b"NDims = %d" % count))
    with pytest.raises(IrrcacheError, match=rf"a\.mha declares {count} dimensions"):
        read_volume(file)


def test_tilt_of_the_gantry_is_preserved(tmp_path):
    write_dicom(tmp_path / "ct", [0.0, 2.0, 4.0], shear=0.5)
    volume = read_volume(tmp_path / "ct")
    last = volume.index_to_world @ (0, 0, 2, 1)
    np.testing.assert_allclose(last[:3], (ORIGIN[0], ORIGIN[1] + 2.0, 4.0), atol=1e-9)


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([0, 1, 2, 4, 5], "1 slice.* missing between positions 2.00 and 4.00"),
        ([0, 1, 2, 2, 3, 4], "same position"),
        ([0, 1, 2, 3.3, 4.3], "uneven"),
        ([0], "at least 2"),
    ],
)
def test_incomplete_dicom_is_refused(tmp_path, positions, message):
    write_dicom(tmp_path / "ct", positions)
    with pytest.raises(IrrcacheError, match=message):
        read_volume(tmp_path / "ct")


def test_two_series_are_named_and_can_be_chosen(tmp_path):
    write_dicom(tmp_path / "ct", [0, 1, 2], uid="1.2.3.10", tag="a")
    write_dicom(tmp_path / "ct", [0, 2, 4, 6], uid="1.2.3.20", tag="b")
    with pytest.raises(IrrcacheError) as error:
        read_volume(tmp_path / "ct")
    for part in ("1.2.3.10 (3 slices)", "1.2.3.20 (4 slices)", "--series"):
        assert part in str(error.value)
    assert read_volume(tmp_path / "ct", series="1.2.3.20").size == (5, 6, 4)
    with pytest.raises(IrrcacheError, match=r"no series 9.9"):
        read_volume(tmp_path / "ct", series="9.9")


def test_folders_without_dicom_are_refused(tmp_path):
    with pytest.raises(IrrcacheError, match="is empty"):
        read_volume(tmp_path)
    (tmp_path / "notes.txt").write_text("no slice")
    with pytest.raises(IrrcacheError, match="no DICOM series"):
        read_volume(tmp_path)


# Raw files


@given(
    dtype=st.sampled_from(["uint8", "int16", "uint16", "int32", "float32", "float64"]),
    endian=st.sampled_from(["little", "big"]),
    offset=st.integers(0, 9),
)
@settings(max_examples=20, deadline=None)
def test_raw_file_round_trip(tmp_path_factory, dtype, endian, offset):
    path = tmp_path_factory.mktemp("raw") / "volume.bin"
    values = np.abs(ramp()).astype(dtype)
    order = {"little": "<", "big": ">"}[endian]
    path.write_bytes(b"h" * offset + values.astype(values.dtype.newbyteorder(order)).tobytes())
    volume = read_volume(path, raw=RawLayout((5, 4, 3), dtype, endian, SPACING, offset))
    np.testing.assert_array_equal(volume.values, values)
    assert volume.spacing == SPACING


def write_slices(folder: Path, numbers) -> None:
    for number in numbers:
        values = np.full((4, 5), number, dtype=">u2")
        (folder / f"head.{number}").write_bytes(values.tobytes())


def test_raw_slices_are_in_natural_order(tmp_path):
    write_slices(tmp_path, range(1, 13))
    volume = read_volume(tmp_path / "head.*", raw=RawLayout((5, 4, 12), "uint16", "big"))
    np.testing.assert_array_equal(volume.values[:, 0, 0], np.arange(1, 13))


def test_missing_raw_slice_is_named(tmp_path):
    write_slices(tmp_path, [1, 2, 3, 5, 6])
    with pytest.raises(IrrcacheError, match=r"between head.3 and head.5"):
        read_volume(tmp_path / "head.*", raw=RawLayout((5, 4, 5), "uint16", "big"))


def test_wrong_number_of_raw_slices(tmp_path):
    write_slices(tmp_path, range(4))
    with pytest.raises(IrrcacheError, match=r"4 slice files.*asks for 5"):
        read_volume(tmp_path / "head.*", raw=RawLayout((5, 4, 5), "uint16", "big"))


@pytest.mark.parametrize(("size", "state"), [(59, "truncated"), (61, "too long")])
def test_raw_size_must_match(tmp_path, size, state):
    path = tmp_path / "volume.bin"
    path.write_bytes(b"0" * size)
    with pytest.raises(IrrcacheError, match=state):
        read_volume(path, raw=RawLayout((5, 4, 3)))


@pytest.mark.parametrize(
    "fields", [{"shape": (0, 1, 1)}, {"dtype": "complex64"}, {"endian": "middle"}, {"offset": -1}]
)
def test_impossible_raw_layout(fields):
    with pytest.raises(IrrcacheError, match="raw"):
        RawLayout(**{"shape": (5, 4, 3), **fields})


# Mitsuba's format


@pytest.mark.parametrize("channels", [1, 3, 6])
def test_vol_round_trip(tmp_path, channels):
    values = np.random.default_rng(1).normal(size=(3, 4, 5, channels)).astype(np.float32)
    bbox = [[-1, -2, -3], [1, 2, 4]]
    written = write_vol(tmp_path / "a.vol", values, bbox)
    read, read_bbox = read_vol(tmp_path / "a.vol")
    np.testing.assert_array_equal(read, values)
    np.testing.assert_array_equal(read_bbox, bbox)
    assert (tmp_path / "a.vol").stat().st_size == written


def test_mitsuba_reads_and_writes_the_same_vol(tmp_path):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    values = np.random.default_rng(2).uniform(size=(3, 4, 5, 3)).astype(np.float32)
    write_vol(tmp_path / "ours.vol", values)
    theirs = mi.VolumeGrid(str(tmp_path / "ours.vol"))
    np.testing.assert_array_equal(np.array(theirs), values)
    theirs.write(str(tmp_path / "theirs.vol"))
    assert (tmp_path / "theirs.vol").read_bytes() == (tmp_path / "ours.vol").read_bytes()


def test_vol_is_placed_by_its_bounding_box(tmp_path):
    write_vol(tmp_path / "a.vol", ramp(), [[-1, -2, -3], [4, 6, 0]])
    volume = read_volume(tmp_path / "a.vol")
    assert volume.spacing == (1.0, 2.0, 1.0)
    np.testing.assert_allclose(volume.to_world @ (0, 0, 0, 1), (-1, -2, -3, 1))
    np.testing.assert_allclose(volume.to_world @ (1, 1, 1, 1), (4, 6, 0, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b[:-1], "truncated"),
        (lambda b: b[:20], "truncated"),
        (lambda b: b + b"0", "too long"),
        (lambda b: b"VOX" + b[3:], "not a Mitsuba volume"),
        (lambda b: b[:3] + b"\x04" + b[4:], "version 4"),
        (lambda b: b[:4] + struct.pack("<i", 2) + b[8:], "encoding 2"),
        (lambda b: b[:20] + struct.pack("<i", 2) + b[24:], "2 channels"),
        (lambda b: b[:8] + struct.pack("<i", -5) + b[12:], "size"),
        (lambda b: b[:8] + struct.pack("<iii", *[2**31 - 1] * 3) + b[20:], "truncated"),
    ],
)
def test_damaged_vol_is_refused(tmp_path, change, message):
    path = tmp_path / "a.vol"
    write_vol(path, ramp())
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(IrrcacheError, match=message):
        read_vol(path)


def test_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "a.vol"
    write_vol(path, ramp())
    before = path.read_bytes()
    bad = ramp("float32")
    bad[-1, 0, 0] = np.nan
    with pytest.raises(IrrcacheError, match="slice z=2"):
        write_vol(path, bad)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.vol"]


# Damaged files


@pytest.mark.parametrize("name", ["a.nrrd", "a.nii", "a.nii.gz", "a.mha"])
@pytest.mark.parametrize("compress", [False, True])
def test_truncated_image_is_refused(tmp_path, name, compress):
    noise = np.random.default_rng(3).integers(0, 4000, (8, 9, 10)).astype(np.int16)
    path = write_image(tmp_path / name, noise, compress)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(IrrcacheError, match=re.escape(name)):
        read_volume(path)


def test_missing_file_is_refused(tmp_path):
    for name in ("a.nrrd", "a.vol", "folder"):
        with pytest.raises(IrrcacheError, match="does not exist"):
            read_volume(tmp_path / name)


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_header_of_a_too_large_image_is_refused_before_allocation(tmp_path, name):
    path = write_image(tmp_path / "a.nii", ramp())
    content = bytearray(path.read_bytes())
    content[42:48] = struct.pack("<hhh", 30000, 30000, 30000)
    packed = gzip.compress(bytes(content)) if name.endswith("gz") else bytes(content)
    (tmp_path / name).write_bytes(packed)
    with pytest.raises(IrrcacheError, match="promises"):
        read_volume(tmp_path / name)


def test_compressed_nrrd_of_a_too_large_image_is_refused(tmp_path):
    path = write_image(tmp_path / "a.nrrd", ramp(), compress=True)
    path.write_bytes(path.read_bytes().replace(b"sizes: 5 4 3", b"sizes: 50000 40000 30000"))
    with pytest.raises(IrrcacheError, match="promises"):
        read_volume(path)


def test_nan_is_counted_and_located_or_replaced(tmp_path):
    values = ramp("float32")
    values[1, 2, 3] = np.nan
    values[2, 0, 0] = np.inf
    path = write_image(tmp_path / "a.nrrd", values)
    with pytest.raises(IrrcacheError, match=r"2 values.*\(3, 2, 1\).*--replace-nan"):
        read_volume(path)
    replaced = read_volume(path, replace_nan=-7.0).values
    assert replaced[1, 2, 3] == -7 and replaced[2, 0, 0] == -7 and replaced[0, 0, 0] == -20


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((4, 5), np.int16), "one slice"),
        (np.zeros((2, 3, 4, 5), np.int16), "frame"),
    ],
)
def test_images_that_are_no_volumes_are_refused(tmp_path, values, message):
    image = SimpleITK.GetImageFromArray(values, isVector=False)
    SimpleITK.WriteImage(image, str(tmp_path / "a.nrrd"))
    with pytest.raises(IrrcacheError, match=message):
        read_volume(tmp_path / "a.nrrd")


def test_unsupported_extension_is_named(tmp_path):
    (tmp_path / "a.gif").write_bytes(b"x")
    with pytest.raises(IrrcacheError, match=r"a\.gif.*--raw-shape"):
        read_volume(tmp_path / "a.gif")


# Third-party data


@pytest.mark.data
def test_oblique_head_is_placed_by_its_affine():
    """The NIfTI affine (RAS) with x and y negated (LPS) is ``index_to_world``."""
    path = data_folder() / "niivue_ct" / "CT_pitch.nii.gz"
    with gzip.open(path) as stream:
        header = stream.read(348)
    affine = np.array(struct.unpack("<12f", header[280:328])).reshape(3, 4)
    affine[:2] *= -1
    np.testing.assert_allclose(read_volume(path).index_to_world[:3], affine, atol=1e-3)


@pytest.mark.data
def test_unc_head_is_read_in_order():
    volume = read_volume(
        data_folder() / "unc_cthead" / "CThead.*",
        raw=RawLayout((256, 256, 113), "uint16", "big", (1, 1, 2)),
    )
    assert volume.values.max() == 3272
    np.testing.assert_allclose(volume.values.mean(), 379.5, atol=0.1)
    # Neighbouring slices are similar in the right order only.
    flat = volume.values.reshape(113, -1).astype(float)
    assert np.abs(np.diff(flat, axis=0)).mean() < 100
