"""Every format is read with its values in order and its placement, or refused with the reason."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine import extras
from mitsuba_irrcache.machine.extras import MissingPackageError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.formats import FORMATS
from mitsuba_irrcache.volumes.options import ReadOptions
from mitsuba_irrcache.volumes.readers import read_volume
from tests.support.volume_files import (
    DIRECTION,
    ORIGIN,
    SPACING,
    VTK_FILES,
    WRITTEN,
    marker,
    ramp,
)

FILES = {name: w for name, w in WRITTEN.items() if w.suffix and "zarr" not in w.suffix}


def options_of(name: str, is_ramp: bool = False) -> ReadOptions:
    given = dict(zip(WRITTEN[name].options[::2], WRITTEN[name].options[1::2], strict=True))
    spacing = given.get("--spacing")
    field = given.get("--field")
    return ReadOptions(
        field="ramp" if field and is_ramp else field,
        spacing=tuple(map(float, spacing.split(","))) if spacing else None,
    )


@pytest.mark.parametrize("name", WRITTEN)
def test_values_and_placement_are_read(tmp_path, name):
    written = WRITTEN[name]
    path = written.make(tmp_path, ramp())
    volume = read_volume(path, options=options_of(name, is_ramp=True))
    z, y, x = ramp().shape
    # NanoVDB's nodes have 8 voxels along each side, and Warp fills up the last ones.
    assert volume.size == ((x, y, z) if name != "nanovdb" else (8, 8, 8))
    np.testing.assert_array_equal(volume.values[:z, :y, :x], ramp())
    np.testing.assert_allclose(volume.index_to_world, written.index_to_world, rtol=1e-5, atol=1e-4)


def test_every_format_is_written_by_a_test():
    """A new format without an entry in `WRITTEN` fails here."""
    tested = {written.suffix for written in WRITTEN.values()} - {""}
    untested = [f.name for f in FORMATS if not any(t.endswith(f.suffixes) for t in tested)]
    assert untested == ["DICOM"]  # see test_readers.py


# Damaged files


@pytest.mark.parametrize("share", [0.02, 0.3, 0.67, 0.97])
@pytest.mark.parametrize("name", FILES)
def test_truncated_file_is_refused(tmp_path, name, share):
    noise = np.random.default_rng(1).uniform(size=(4, 5, 8)).astype(np.float32)
    path = FILES[name].make(tmp_path, noise)
    damaged = path if name != "analyze" else path.with_suffix(".img")
    content = damaged.read_bytes()
    damaged.write_bytes(content[: int(share * len(content))])
    with pytest.raises(IrrcacheError, match=r"volume\.") as error:
        read_volume(path, options=options_of(name))
    assert "NaN" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" * 60, b"GIF89a" * 3])
@pytest.mark.parametrize("suffix", sorted({w.suffix for w in FILES.values()}))
def test_file_of_another_format_is_refused(tmp_path, suffix, content):
    written = next(w for w in FILES.values() if w.suffix == suffix)
    path = written.make(tmp_path, marker())
    path.write_bytes(content)
    with pytest.raises(IrrcacheError, match=r"volume\.") as error:
        read_volume(path)
    assert "empty" in str(error.value) or content


# The files of VTK have no NaN, a .vol is not written with one, and the NIfTI library, which reads
# Analyze, too, replaces it by 0.
@pytest.mark.parametrize(
    "name", [n for n in WRITTEN if "vt" not in n and n not in ("mitsuba", "nifti", "analyze")]
)
def test_nan_is_located(tmp_path, name):
    values = ramp()
    values[2, 1, 3] = np.nan
    path = WRITTEN[name].make(tmp_path, values)
    with pytest.raises(IrrcacheError, match=r"has 1 values that are NaN.*\(3, \d, 2\)"):
        read_volume(path, options=options_of(name))
    replaced = read_volume(path, options=options_of(name), replace_nan=-5.0)
    assert replaced.values.min() == -5.0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones((5, 8), np.float32), "one slice"),
        (np.ones((1, 5, 8), np.float32), "one slice"),
        (np.ones((3, 5, 8), np.complex64), "type complex64"),
        (np.full((3, 5, 8), "a"), "type <U1"),
        (np.ones((2, 3, 4, 5, 6), np.float32), r"shape \(2, 3, 4, 5, 6\)"),
        (np.array([{}] * 8).reshape(2, 2, 2), "type object"),
    ],
)
@pytest.mark.parametrize("name", ["npy", "npz"])
def test_arrays_that_are_no_volumes_are_refused(tmp_path, name, values, message):
    path = tmp_path / f"a.{name}"
    if name == "npy":
        np.save(path, values, allow_pickle=True)
    else:
        np.savez(path, values, allow_pickle=True)
    expected = "no array with three axes" if name == "npz" and values.ndim == 2 else message
    with pytest.raises(IrrcacheError, match=expected):
        read_volume(path)


def test_array_promising_more_than_the_file_holds_is_refused(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, ramp())
    lie = path.read_bytes().replace(b"(4, 5, 8)", b"(40000, 50000, 80000)")
    path.write_bytes(lie)
    with pytest.raises(IrrcacheError, match=r"a\.npy is truncated.*promises 640000000000000 bytes"):
        read_volume(path)
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("volume.npy", lie)
    with pytest.raises(IrrcacheError, match=r"b\.npz\[volume\] is truncated"):
        read_volume(tmp_path / "b.npz")


@pytest.mark.parametrize(
    ("key", "value"), [("spacing", [1.0, 2.0]), ("origin", "here"), ("direction", np.eye(4))]
)
def test_unreadable_placement_of_an_archive_is_refused(tmp_path, key, value):
    np.savez(tmp_path / "a.npz", volume=ramp(), **{key: value})
    with pytest.raises(IrrcacheError, match=rf"a\.npz has {key}"):
        read_volume(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("dtype", "read"),
    [("bool", "uint8"), ("float16", "float32"), (">i2", "int16"), (">f8", "float64")],
)
def test_unusual_types_are_converted(tmp_path, dtype, read):
    values = (ramp() % 2).astype(dtype)
    np.save(tmp_path / "a.npy", values)
    volume = read_volume(tmp_path / "a.npy")
    assert volume.values.dtype == np.dtype(read)
    np.testing.assert_array_equal(volume.values, values)


# Selection


def test_channel_is_chosen_or_asked_for(tmp_path):
    values = np.stack([ramp(), 2 * ramp(), 3 * ramp()], axis=-1)
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(IrrcacheError, match=r"a\.npy has 3 channels.*--channel N, from 0 to 2"):
        read_volume(tmp_path / "a.npy")
    volume = read_volume(tmp_path / "a.npy", options=ReadOptions(channel=1))
    np.testing.assert_array_equal(volume.values, 2 * ramp())
    with pytest.raises(IrrcacheError, match="--channel is 3; give 0 to 2"):
        read_volume(tmp_path / "a.npy", options=ReadOptions(channel=3))


def test_channel_and_frame_of_an_image_are_chosen(tmp_path):
    import SimpleITK

    vectors = SimpleITK.GetImageFromArray(np.stack([ramp(), -ramp()], axis=-1), isVector=True)
    SimpleITK.WriteImage(vectors, str(tmp_path / "a.nrrd"))
    with pytest.raises(IrrcacheError, match=r"2 channels.*--channel"):
        read_volume(tmp_path / "a.nrrd")
    volume = read_volume(tmp_path / "a.nrrd", options=ReadOptions(channel=1))
    np.testing.assert_array_equal(volume.values, -ramp())
    frames = SimpleITK.GetImageFromArray(np.stack([ramp(), ramp() + 7]), isVector=False)
    SimpleITK.WriteImage(frames, str(tmp_path / "b.nii"))
    with pytest.raises(IrrcacheError, match=r"2 frames.*--frame"):
        read_volume(tmp_path / "b.nii")
    volume = read_volume(tmp_path / "b.nii", options=ReadOptions(frame=1))
    np.testing.assert_array_equal(volume.values, ramp() + 7)


def test_misspelt_field_is_corrected(tmp_path):
    np.savez(tmp_path / "a.npz", density=ramp(), temperature=ramp())
    with pytest.raises(IrrcacheError, match=r"2 volumes, 'density', 'temperature'.*--field"):
        read_volume(tmp_path / "a.npz")
    with pytest.raises(IrrcacheError, match=r"'Densty'.*did you mean \"density\""):
        read_volume(tmp_path / "a.npz", options=ReadOptions(field="Densty"))


# VTK


@pytest.mark.parametrize("name", ["ascii.vti", "appended_raw.vti", "binary.vtk", "ascii.vtk"])
def test_component_of_a_vtk_vector_is_chosen(name):
    volume = read_volume(VTK_FILES / name, options=ReadOptions(field="vectors", channel=2))
    np.testing.assert_array_equal(volume.values, 3 * ramp())


def test_vtk_cell_values_lie_at_cell_centres(tmp_path):
    header = "# vtk DataFile Version 3.0\n\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 9 6 5\n"
    placement = "ORIGIN -30 12 101.5\nSPACING 0.7 0.9 2.5\nCELL_DATA 160\nSCALARS a float\n"
    values = " ".join(map(str, ramp().ravel()))
    path = tmp_path / "a.vtk"
    path.write_text(f"{header}{placement}LOOKUP_TABLE default\n{values}\n")
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.values, ramp())
    np.testing.assert_allclose(volume.origin, ORIGIN + 0.5 * np.array(SPACING))


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("ascii.vtk", b"STRUCTURED_POINTS", b"UNSTRUCTURED_GRID", "UNSTRUCTURED_GRID; resample"),
        ("ascii.vtk", b"8 5 4", b"80000 5 4", "has 160 values"),
        ("binary.vtk", b"8 5 4", b"8 5 1", "one slice"),
        ("binary.vtk", b"POINT_DATA 160", b"POINT_DATA 16000000000000", "truncated"),
        ("ascii.vtk", b"POINT_DATA 160", b"POINT_DATA 999999", "truncated"),
        ("ascii.vtk", b"marker float", b"marker complex", "type 'complex'"),
        ("ascii.vti", b"Float32", b"String", "type 'String'"),
        ("ascii.vti", b"ImageData", b"PolyData", "not ImageData"),
        ("ascii.vti", b'Extent="0 7 ', b'Extent="0 700000000 ', "needs .* GiB"),
        ("binary_zlib.vti", b'Extent="0 7 ', b'Extent="0 8 ', "asks for"),
        ("binary_zlib.vti", b"vtkZLibDataCompressor", b"vtkLZ4DataCompressor", "LZ4.*ZLib"),
    ],
)
def test_damaged_vtk_is_refused(tmp_path, name, old, new, message):
    content = (VTK_FILES / name).read_bytes()
    assert old in content
    path = tmp_path / name
    path.write_bytes(content.replace(old, new))
    with pytest.raises(IrrcacheError, match=message) as error:
        read_volume(path, options=ReadOptions(field="marker"))
    assert name in str(error.value)


# Analyze


def test_analyze_without_its_voxels_is_refused(tmp_path):
    path = WRITTEN["analyze"].make(tmp_path, ramp())
    volume = read_volume(path.with_suffix(".img"))
    np.testing.assert_array_equal(volume.values, ramp())
    path.with_suffix(".img").unlink()
    with pytest.raises(IrrcacheError, match=r"volume\.hdr has its voxels in .*volume\.img"):
        read_volume(path)


# TIFF


def test_tiff_slices_in_a_list_and_a_missing_one(tmp_path):
    pytest.importorskip("tifffile", reason="tifffile is not installed")
    folder = WRITTEN["tiff slices"].make(tmp_path, ramp())
    np.testing.assert_array_equal(read_volume(str(folder / "s*.tif")).values, ramp())
    (folder / "s9.tif").rename(folder / "s19.tif")
    with pytest.raises(IrrcacheError, match=r"between s8.tif and s10.tif"):
        read_volume(folder)


def test_tiff_slices_of_other_shape_are_refused(tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed")
    folder = WRITTEN["tiff slices"].make(tmp_path, ramp())
    tifffile.imwrite(folder / "s9.tif", np.ones((6, 8), np.float32))
    with pytest.raises(IrrcacheError, match=r"s9.tif has shape \(6, 8\)"):
        read_volume(folder)


def test_codec_of_a_tiff_that_is_missing_is_named(tmp_path, monkeypatch):
    """LZW needs a package beside tifffile."""
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed")
    pytest.importorskip("imagecodecs", reason="imagecodecs is not installed, to write the file")
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, ramp(), photometric="minisblack", compression="lzw")
    np.testing.assert_array_equal(read_volume(path).values, ramp())

    def decode(self):
        raise ValueError("<COMPRESSION.LZW: 5> requires the 'imagecodecs' package")

    monkeypatch.setattr(tifffile.TiffPageSeries, "asarray", decode)
    with pytest.raises(IrrcacheError, match=r"a\.tif is compressed by LZW.*irrcache\[microscopy\]"):
        read_volume(path)


def test_tiff_of_one_page_is_one_slice(tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed")
    tifffile.imwrite(tmp_path / "a.tif", ramp()[0])
    with pytest.raises(IrrcacheError, match=r"a\.tif is one slice"):
        read_volume(tmp_path / "a.tif")


def test_tiff_channels_and_unit(tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed")
    values = np.stack([ramp(), ramp() + 1], axis=1)
    tifffile.imwrite(
        tmp_path / "a.tif",
        values,
        imagej=True,
        metadata={"axes": "ZCYX", "unit": "um", "spacing": 3.0},
    )
    with pytest.raises(IrrcacheError, match="2 channels"):
        read_volume(tmp_path / "a.tif")
    volume = read_volume(tmp_path / "a.tif", options=ReadOptions(channel=1))
    np.testing.assert_array_equal(volume.values, ramp() + 1)
    assert (volume.spacing[2], volume.length_unit) == (3.0, "um")


# NetCDF


def dataset(**changes):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    coordinates = {
        "time": ("time", [0.0, 60.0], {"units": "s"}),
        "z": ("z", [100.0, 140.0, 180.0, 220.0], {"units": "m"}),
        "y": ("y", np.arange(5) * 0.02, {"units": "km"}),
        "x": ("x", np.arange(8) * 0.02, {"units": "km"}),
    } | changes
    values = np.stack([ramp(), ramp() + 1000])
    found = xarray.Dataset({"q": (("time", "z", "y", "x"), values)}, coordinates)
    found["surface"] = ("y", "x"), ramp()[0]
    return found


def written(tmp_path: Path, data) -> Path:
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    return tmp_path / "a.nc"


def test_netcdf_frame_and_mixed_units(tmp_path):
    path = written(tmp_path, dataset())
    with pytest.raises(IrrcacheError, match=r"a\.nc\[q\] has 2 frames"):
        read_volume(path)
    volume = read_volume(path, options=ReadOptions(frame=1))
    np.testing.assert_array_equal(volume.values, ramp() + 1000)
    np.testing.assert_allclose(volume.spacing, (20, 20, 40))
    np.testing.assert_allclose(volume.origin, (0, 0, 100))
    assert volume.length_unit == "m"


@pytest.mark.parametrize("attributes", [{"positive": "down"}, {"standard_name": "depth"}])
def test_depths_point_downwards(tmp_path, attributes):
    first, data = ReadOptions(frame=0), dataset()
    plain = read_volume(written(tmp_path, data), options=first)
    data["z"].attrs |= attributes
    turned = read_volume(written(tmp_path, data), options=first)
    np.testing.assert_array_equal(turned.values, plain.values[::-1])
    assert turned.spacing == plain.spacing
    top = plain.origin[2] + plain.spacing[2] * (len(plain.values) - 1)
    assert turned.origin[2] == pytest.approx(-top)


def test_uneven_levels_are_interpolated_linearly(tmp_path):
    """A field that is linear in the height stays the same function of the height."""
    heights = np.array([0.0, 10.0, 30.0, 70.0])
    data = dataset(z=("z", heights, {"units": "m"})).isel(time=0)
    data["q"] = data["q"] * 0 + xarray_of(data["z"]) * 2.0 + 5.0
    volume = read_volume(written(tmp_path, data))
    z = volume.origin[2] + volume.spacing[2] * np.arange(len(volume.values))
    assert (z[0], z[-1], volume.spacing[2]) == (0.0, 70.0, 10.0)
    np.testing.assert_allclose(volume.values[:, 2, 3], 2 * z + 5, rtol=1e-6)
    assert "interpolated" in volume.source


def xarray_of(coordinate):
    return coordinate.astype("float32")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": ("x", np.arange(8.0), {"units": "degrees_east"})}, "'degrees_east'.*--spacing"),
        ({"z": ("z", [900.0, 800.0, 700.0, 600.0], {"units": "hPa"})}, "'hPa'.*--spacing"),
        ({"z": ("z", [0.0, 2.0, 1.0, 3.0])}, "do not increase"),
        ({"z": ("z", [0.0, 1.0, np.nan, 3.0])}, "do not increase"),
    ],
)
def test_coordinates_that_place_nothing_are_refused(tmp_path, changes, message):
    path = written(tmp_path, dataset(**changes))
    with pytest.raises(IrrcacheError, match=message):
        read_volume(path, options=ReadOptions(frame=0))
    volume = read_volume(path, options=ReadOptions(frame=0, spacing=(1, 2, 3)))
    assert volume.spacing == (1, 2, 3)


def test_packed_values_are_unpacked_and_missing_ones_located(tmp_path):
    data = dataset().isel(time=0)
    data["q"] = data["q"].where(data["q"] != 9)
    data["q"].encoding = {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -1}
    with pytest.raises(IrrcacheError, match=r"has 1 values that are NaN.*\(1, 1, 0\)"):
        read_volume(written(tmp_path, data))
    values = read_volume(tmp_path / "a.nc", replace_nan=9.0).values
    np.testing.assert_array_equal(values, ramp())


# Zarr and HDF5


def test_units_of_ome_zarr_may_differ_between_axes(tmp_path):
    path = WRITTEN["ome-zarr 0.4"].make(tmp_path, ramp())
    description = path / ".zattrs"
    content = json.loads(description.read_text())
    for axis in content["multiscales"][0]["axes"]:
        if axis["name"] == "z":
            axis["unit"] = "nanometer"
    description.write_text(json.dumps(content))
    volume = read_volume(path)
    expected = (*SPACING[:2], SPACING[2] * 1e-3)
    np.testing.assert_allclose(volume.spacing, expected)
    for axis in content["multiscales"][0]["axes"]:
        axis["unit"] = {"z": "foo"}.get(axis["name"], "micrometer")
    description.write_text(json.dumps(content))
    with pytest.raises(IrrcacheError, match=r"'foo' is no unit of length.*--spacing"):
        read_volume(path)


def test_each_series_of_a_tiff_file_has_its_own_voxel_size(tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="tifffile is not installed")
    sizes = {"big": (0.1, 0.1, 500.0), "small": (2.0, 2.0, 7000.0)}
    with tifffile.TiffWriter(tmp_path / "a.ome.tif", ome=True) as file:
        for number, (name, size) in enumerate(sizes.items()):
            placed = {f"PhysicalSize{a}": s for a, s in zip("XYZ", size, strict=True)}
            units = {"PhysicalSizeZUnit": "nm"}
            values = np.full((4 + number, 5, 6), number, dtype=np.uint8)
            file.write(values, metadata={"axes": "ZYX", "Name": name} | placed | units)
    for name, (x, y, z) in sizes.items():
        volume = read_volume(tmp_path / "a.ome.tif", options=ReadOptions(field=name))
        np.testing.assert_allclose(volume.spacing, (x, y, z * 1e-3))
        assert volume.length_unit == "µm"


def test_lower_resolution_of_ome_zarr_is_chosen(tmp_path):
    path = WRITTEN["ome-zarr 0.5"].make(tmp_path, ramp())
    volume = read_volume(path, options=ReadOptions(field="1"))
    np.testing.assert_array_equal(volume.values, ramp()[:, ::2, ::2])
    np.testing.assert_allclose(volume.spacing, (2 * SPACING[0], 2 * SPACING[1], SPACING[2]))
    assert volume.length_unit == "micrometer"


@pytest.mark.parametrize("name", ["zarr", "ome-zarr 0.4", "ome-zarr 0.5", "zarr of xarray"])
def test_damaged_zarr_is_refused(tmp_path, name):
    path = WRITTEN[name].make(tmp_path, ramp())
    for description in [*path.rglob("zarr.json"), *path.rglob(".z*")]:
        description.write_text(description.read_text()[:-20])
    with pytest.raises(IrrcacheError, match=r"cannot read .*volume.* as Zarr"):
        read_volume(path)


def test_empty_zarr_folder_is_refused(tmp_path):
    pytest.importorskip("zarr", reason="zarr is not installed")
    (tmp_path / "a.zarr").mkdir()
    with pytest.raises(IrrcacheError, match=r"a\.zarr is no Zarr folder"):
        read_volume(tmp_path / "a.zarr")


@pytest.mark.parametrize("package", ["h5py", "zarr"])
def test_volume_larger_than_the_memory_is_refused(tmp_path, package):
    """Neither format stores values that were never written, so that a small file may be huge."""
    library = pytest.importorskip(package, reason=f"{package} is not installed")
    shape, chunks = (100_000, 100_000, 100_000), (64, 64, 64)
    if package == "h5py":
        path = tmp_path / "a.h5"
        with library.File(path, "w") as file:
            file.create_dataset("a", shape=shape, dtype="f4", chunks=chunks)
    else:
        path = tmp_path / "a.zarr"
        library.create_array(str(path), shape=shape, dtype="f4", chunks=chunks)
    with pytest.raises(IrrcacheError, match=rf"reading .*{path.name}.* needs .* GiB.*crop"):
        read_volume(path)


def test_values_in_other_files_are_not_read(tmp_path):
    """An HDF5 file may name any file of this machine as the place of its values."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    (tmp_path / "other.raw").write_bytes(ramp().tobytes())
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset(
            "a", (4, 5, 8), "f4", external=[(str(tmp_path / "other.raw"), 0, h5py.h5f.UNLIMITED)]
        )
    with pytest.raises(IrrcacheError, match=r"a\.h5\[a\] stores its values in other files"):
        read_volume(tmp_path / "a.h5")


def test_element_size_of_imagej_is_read(tmp_path):
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t0/channel0"] = ramp()
        file["t0/channel0"].attrs["element_size_um"] = SPACING[::-1]
    volume = read_volume(tmp_path / "a.h5")
    np.testing.assert_allclose(volume.spacing, SPACING)
    assert volume.length_unit == "µm"


# OpenVDB and NanoVDB


def openvdb():
    from mitsuba_irrcache.volumes.openvdb_files import load_openvdb

    try:
        return load_openvdb(Path("a.vdb"))
    except MissingPackageError as error:
        pytest.skip(str(error))


def test_level_set_is_refused_by_name(tmp_path):
    library = openvdb()
    sphere = library.createLevelSetSphere(5.0, voxelSize=0.5)
    sphere.name = "surface"
    library.write(str(tmp_path / "a.vdb"), grids=[sphere])
    with pytest.raises(IrrcacheError, match=r"a\.vdb\[surface\] is a level set.*fog volume"):
        read_volume(tmp_path / "a.vdb")


def test_level_set_of_nanovdb_is_refused_by_name():
    warp = pytest.importorskip("warp", reason="warp is not installed")
    torus = Path(warp.__file__).parent / "tests" / "assets" / "torus.nvdb"
    if not torus.is_file():
        pytest.skip("this version of warp has no torus.nvdb")
    with pytest.raises(IrrcacheError, match=r"torus\.nvdb\[surface\] is a level set"):
        read_volume(torus)


def test_frustum_is_refused(tmp_path):
    library = openvdb()
    grid = library.FloatGrid()
    grid.copyFromArray(np.ascontiguousarray(ramp()))
    grid.transform = library.createFrustumTransform((0, 0, 0), (9, 9, 9), 0.5, 10.0)
    library.write(str(tmp_path / "a.vdb"), grids=[grid])
    with pytest.raises(IrrcacheError, match=r"Frustum.*resample"):
        read_volume(tmp_path / "a.vdb")


def test_sparse_grid_larger_than_the_memory_is_refused(tmp_path):
    library = openvdb()
    grid = library.FloatGrid()
    accessor = grid.getAccessor()
    accessor.setValueOn((0, 0, 0), 1.0)
    accessor.setValueOn((100_000, 100_000, 100_000), 1.0)
    library.write(str(tmp_path / "a.vdb"), grids=[grid])
    with pytest.raises(IrrcacheError, match=r"a\.vdb.* needs .* GiB"):
        read_volume(tmp_path / "a.vdb")


@pytest.mark.data
def test_openvdb_smoke_is_that_of_its_conversion():
    from tests.support.slices import data_folder

    library_is_there = openvdb()
    assert library_is_there
    folder = data_folder() / "openvdb_smoke"
    volume, converted = (read_volume(folder / f"smoke.{kind}") for kind in ("vdb", "vol"))
    np.testing.assert_allclose(volume.values.sum(dtype=float), converted.values.sum(dtype=float))


# Packages


@pytest.mark.parametrize(
    ("suffix", "extra"),
    [
        (".tif", "microscopy"),
        (".nc", "science"),
        (".h5", "science"),
        (".zarr", "science"),
        (".nvdb", "nanovdb"),
        (".nrrd", "volumes"),
    ],
)
def test_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, suffix, extra):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"x")
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        MissingPackageError, match=rf'a\{suffix} needs ".*mitsuba_irrcache\[{extra}'
    ):
        read_volume(path)


def test_missing_openvdb_is_explained(tmp_path, monkeypatch):
    path = tmp_path / "a.vdb"
    path.write_bytes(b" BDV\0\0\0\0" + bytes(60))
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"bpy.*nanovdb_convert"):
        read_volume(path)


def test_formats_of_a_file_copied_under_another_name(tmp_path):
    """The suffix decides; upper case is the same."""
    np.save(tmp_path / "a.npy", ramp())
    shutil.copy(tmp_path / "a.npy", tmp_path / "B.NPY")
    volume = read_volume(tmp_path / "B.NPY")
    assert isinstance(volume, VolumeData) and volume.size == (8, 5, 4)
    assert not np.allclose(DIRECTION, volume.direction)  # that of an array is the identity
