"""One small volume written in every format by the format's own library, with its placement.

The grid is anisotropic, shifted and rotated as far as the format permits.
"""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from mitsuba_irrcache.io.mitsuba_vol import write_vol

SPACING = (0.7, 0.9, 2.5)
ORIGIN = np.array([-30.0, 12.0, 101.5])
ANGLE = 0.3
DIRECTION = np.array(
    [[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1.0]]
)
#: Index (x, y, z) of the only voxel of `marker` that is not zero.
MARKED = (6, 1, 2)
VTK_FILES = Path(__file__).parents[1] / "unit" / "volumes" / "files"


def marker() -> np.ndarray:
    """Return a volume (z, y, x) that is zero but for one voxel beside the middle."""
    values = np.zeros((4, 5, 8), np.float32)
    x, y, z = MARKED
    values[z, y, x] = 2.0
    return values


def ramp() -> np.ndarray:
    """Return a volume (z, y, x) of which no two values are equal."""
    return np.arange(4 * 5 * 8, dtype=np.float32).reshape(4, 5, 8)


@dataclass(frozen=True)
class Written:
    """How a format stores `marker` or `ramp`.

    Attributes:
        suffix: of the file's name.
        write: writes values to a path.
        packages: imported by writer or reader; the test is skipped without them.
        spacing, origin, direction: the placement that the file states.
        options: of ``irrcache import``.
    """

    suffix: str
    write: Callable[[Path, np.ndarray], None]
    packages: tuple[str, ...] = ()
    spacing: tuple[float, float, float] = SPACING
    origin: np.ndarray = field(default_factory=lambda: ORIGIN)
    direction: np.ndarray = field(default_factory=lambda: DIRECTION)
    options: tuple[str, ...] = ()

    @property
    def index_to_world(self) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, :3] = self.direction * np.asarray(self.spacing)
        matrix[:3, 3] = self.origin
        return matrix

    def make(self, folder: Path, values: np.ndarray) -> Path:
        """Write a file; skip the test if a package is missing."""
        # Packages are not imported: bpy would take seconds and change the search path.
        for package in self.packages:
            if importlib.util.find_spec(package) is None:
                pytest.skip(f"{package} is not installed")
        path = folder / f"volume{self.suffix}"
        self.write(path, values)
        return path


def _simpleitk(path: Path, values: np.ndarray, direction: np.ndarray = DIRECTION) -> None:
    import SimpleITK

    image = SimpleITK.GetImageFromArray(values)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN.tolist())
    image.SetDirection(direction.ravel().tolist())
    SimpleITK.WriteImage(image, str(path))


def _analyze(path: Path, values: np.ndarray) -> None:
    _simpleitk(path, values, np.eye(3))


def _npy(path: Path, values: np.ndarray) -> None:
    np.save(path, values)


def _npz(path: Path, values: np.ndarray) -> None:
    np.savez_compressed(path, a=values, spacing=SPACING, origin=ORIGIN, direction=DIRECTION)


def _vol(path: Path, values: np.ndarray) -> None:
    low = ORIGIN - 0.5 * np.array(SPACING)
    write_vol(path, values, (low, low + np.array(SPACING) * values.shape[::-1]))


def _vtk(name: str) -> Callable[[Path, np.ndarray], None]:
    def write(path: Path, values: np.ndarray) -> None:
        shutil.copy(VTK_FILES / name, path)

    return write


def _imagej(path: Path, values: np.ndarray) -> None:
    import tifffile

    tifffile.imwrite(
        path,
        values,
        imagej=True,
        resolution=(1 / SPACING[0], 1 / SPACING[1]),
        metadata={"axes": "ZYX", "spacing": SPACING[2], "unit": "um"},
    )


def _ome(path: Path, values: np.ndarray) -> None:
    import tifffile

    sizes = {f"PhysicalSize{axis}": size for axis, size in zip("XYZ", SPACING, strict=True)}
    tifffile.imwrite(path, values, ome=True, metadata={"axes": "ZYX", **sizes})


def _slices(path: Path, values: np.ndarray) -> None:
    import tifffile

    path.mkdir()
    for number, part in enumerate(values, 8):  # file names in which 10 would come before 8
        tifffile.imwrite(path / f"s{number}.tif", part)


def _dataset(values: np.ndarray):
    import xarray

    coordinates = {
        axis: (
            axis,
            ORIGIN["xyz".index(axis)] + SPACING["xyz".index(axis)] * np.arange(count),
            {"units": "m"},
        )
        for axis, count in zip("zyx", values.shape, strict=True)
    }
    # The order of the dimensions is not that of the axes, and one is reversed.
    dimensions = ("z", "y", "x")
    array = xarray.DataArray(
        values, coordinates, dimensions, name="extinction", attrs={"units": "m-1"}
    )
    return array.transpose("y", "z", "x").isel(y=slice(None, None, -1)).to_dataset()


def _netcdf4(path: Path, values: np.ndarray) -> None:
    _dataset(values).to_netcdf(path, engine="h5netcdf")


def _netcdf3(path: Path, values: np.ndarray) -> None:
    _dataset(values).to_netcdf(path, engine="scipy")


def _zarr_of_xarray(path: Path, values: np.ndarray) -> None:
    _dataset(values).to_zarr(path)


def _zarr(path: Path, values: np.ndarray) -> None:
    import zarr

    zarr.save_array(str(path), values)


def _ome_zarr(version: str) -> Callable[[Path, np.ndarray], None]:
    def write(path: Path, values: np.ndarray) -> None:
        import zarr

        group = zarr.open_group(str(path), mode="w", zarr_format=3 if version == "0.5" else 2)
        for level, data in (("0", values), ("1", values[:, ::2, ::2])):
            group.create_array(level, data=data[None])
        axes = [{"name": "c", "type": "channel"}]
        axes += [{"name": a, "type": "space", "unit": "micrometer"} for a in "zyx"]
        datasets = [
            {
                "path": level,
                "coordinateTransformations": [
                    {
                        "type": "scale",
                        "scale": [1, SPACING[2], SPACING[1] * factor, SPACING[0] * factor],
                    },
                    {"type": "translation", "translation": [0, *ORIGIN[::-1].tolist()]},
                ],
            }
            for level, factor in (("0", 1), ("1", 2))
        ]
        image = {"axes": axes, "datasets": datasets}
        if version == "0.5":
            group.attrs["ome"] = {"version": "0.5", "multiscales": [image]}
        else:
            group.attrs["multiscales"] = [{"version": version, **image}]

    return write


def _hdf5(path: Path, values: np.ndarray) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("a/b", data=values, chunks=True, compression="gzip")
        dataset.attrs.update({"spacing": SPACING, "origin": ORIGIN, "direction": DIRECTION})
        file["weights"] = np.ones(7)


def _openvdb(path: Path, values: np.ndarray) -> None:
    from mitsuba_irrcache.volumes.openvdb_files import load_openvdb

    openvdb = load_openvdb(path)
    grid = openvdb.FloatGrid()
    grid.copyFromArray(np.ascontiguousarray(values.T), ijk=(-2, 3, 5), tolerance=-1.0)
    for x, y, z in np.argwhere(np.isnan(values.T)).tolist():  # left out by copyFromArray
        grid.getAccessor().setValueOn((x - 2, y + 3, z + 5), np.nan)
    matrix = np.eye(4)
    matrix[:3, :3] = DIRECTION * np.array(SPACING)
    matrix[:3, 3] = ORIGIN - matrix[:3, :3] @ (-2, 3, 5)
    grid.transform = openvdb.createLinearTransform(matrix.T.tolist())
    grid.name = "density"
    openvdb.write(str(path), grids=[grid])


def _nanovdb(path: Path, values: np.ndarray) -> None:
    import warp

    volume = warp.Volume.load_from_numpy(
        np.ascontiguousarray(values.T), tuple(ORIGIN), 0.8, 0.0, device="cpu"
    )
    volume.save_to_nvdb(str(path), codec="none")


STRAIGHT = {"direction": np.eye(3)}
UNSHIFTED = {"direction": np.eye(3), "origin": np.zeros(3)}
PLAIN = {"spacing": (1.0, 1.0, 1.0), **UNSHIFTED}
ARRAY = ("--field", "marker")

#: How each format stores the volume, by a name for the test.
WRITTEN = {
    "nrrd": Written(".nrrd", _simpleitk),
    "nifti": Written(".nii.gz", _simpleitk),
    "metaimage": Written(".mha", _simpleitk),
    "analyze": Written(".hdr", _analyze, **STRAIGHT),
    "mitsuba": Written(".vol", _vol, **STRAIGHT),
    "npy": Written(".npy", _npy, **PLAIN),
    "npy with a spacing": Written(
        ".npy", _npy, **UNSHIFTED, options=("--spacing", ",".join(map(str, SPACING)))
    ),
    "npz": Written(".npz", _npz),
    "vtk text": Written(".vtk", _vtk("ascii.vtk"), **STRAIGHT, options=ARRAY),
    "vtk binary": Written(".vtk", _vtk("binary.vtk"), **STRAIGHT, options=ARRAY),
    "vti text": Written(".vti", _vtk("ascii.vti"), options=ARRAY),
    "vti binary": Written(".vti", _vtk("binary.vti"), options=ARRAY),
    "vti zlib": Written(".vti", _vtk("binary_zlib.vti"), options=ARRAY),
    "vti lzma": Written(".vti", _vtk("appended_lzma.vti"), options=ARRAY),
    "vti base64": Written(".vti", _vtk("appended_base64.vti"), options=ARRAY),
    "vti raw": Written(".vti", _vtk("appended_raw.vti"), options=ARRAY),
    "imagej": Written(".tif", _imagej, ("tifffile",), **UNSHIFTED),
    "ome-tiff": Written(".ome.tif", _ome, ("tifffile",), **UNSHIFTED),
    "tiff slices": Written("", _slices, ("tifffile",), **PLAIN),
    "netcdf4": Written(".nc", _netcdf4, ("xarray", "h5netcdf"), **STRAIGHT),
    "netcdf3": Written(".nc", _netcdf3, ("xarray",), **STRAIGHT),
    "zarr of xarray": Written(".zarr", _zarr_of_xarray, ("xarray", "zarr"), **STRAIGHT),
    "zarr": Written(".zarr", _zarr, ("zarr",), **PLAIN),
    "ome-zarr 0.4": Written(".ome.zarr", _ome_zarr("0.4"), ("zarr",), **STRAIGHT),
    "ome-zarr 0.5": Written("", _ome_zarr("0.5"), ("zarr",), **STRAIGHT),
    "hdf5": Written(".h5", _hdf5, ("h5py",)),
    "openvdb": Written(".vdb", _openvdb, ("bpy",)),
    "nanovdb": Written(".nvdb", _nanovdb, ("warp",), spacing=(0.8, 0.8, 0.8), **STRAIGHT),
}
