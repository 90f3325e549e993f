"""Small valid files of all formats, and their readers.

Each reader is a plain function, since it is sent to another process.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK

from experiments.robustness.faults import commands, properties
from experiments.robustness.faults.fuzz import lying_cache, mutated, mutated_gzip
from mitsuba_irrcache.io.mitsuba_vol import write_vol
from mitsuba_irrcache.volumes.readers import read_volume
from mitsuba_irrcache.volumes.transfer import load_preset, load_transfer_function


@dataclass(frozen=True)
class Format:
    """Functions that write, damage and read a file of a format."""

    name: str
    make: Callable[[Path], None]
    read: Callable[[Path], object]
    mutate: Callable = mutated


def read_cache(path: Path) -> None:
    """Load a cache, and access all its contents."""
    import mitsuba as mi

    if mi.variant() != "llvm_ad_rgb":
        mi.set_variant("llvm_ad_rgb")
    from mitsuba_irrcache.cache.volume import IrradianceCache

    IrradianceCache.description_of(path)
    cache = IrradianceCache.load(path)
    if cache.grid.voxel_count <= 1 << 20:  # otherwise the scene's own grid differs
        field = cache.field()
        assert np.isfinite(np.array(field.data)).all()


def _write_cache(path: Path) -> None:
    import drjit as dr
    import mitsuba as mi

    from mitsuba_irrcache.cache.volume import IrradianceCache
    from mitsuba_irrcache.grids.grid import Grid

    cache = IrradianceCache(Grid((3, 4, 5), np.eye(4)), dr.arange(mi.UInt32, 60), 3, -1, {"a": "b"})
    double = dr.float64_array_t(mi.Float)
    sums = tuple(double(np.linspace(1, 2, 60).tolist()) for _ in range(6))
    cache.add(3, 16, [(sums, sums[:3])])
    cache.save(path)


def _write_image(path: Path) -> None:
    values = (np.arange(3 * 4 * 5).reshape(3, 4, 5) - 20).astype("int16")
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(values), str(path))


def _values() -> np.ndarray:
    return np.linspace(0, 1, 60, dtype=np.float32).reshape(3, 4, 5)


def _write_npy(path: Path) -> None:
    np.save(path, _values())


def _write_npz(path: Path) -> None:
    np.savez(path, volume=_values(), spacing=(1.0, 2.0, 3.0))


def _write_vtk(path: Path) -> None:
    header = "# vtk DataFile Version 3.0\n\nBINARY\nDATASET STRUCTURED_POINTS\nDIMENSIONS 5 4 3\n"
    placement = (
        "SPACING 1 2 3\nORIGIN 0 0 0\nPOINT_DATA 60\nSCALARS a float\nLOOKUP_TABLE default\n"
    )
    path.write_bytes(f"{header}{placement}".encode() + _values().astype(">f4").tobytes())


def _write_vti(path: Path) -> None:
    grid = 'WholeExtent="0 4 0 3 0 2" Origin="0 0 0" Spacing="1 2 3"'
    values = _values().tobytes()
    path.write_bytes(
        f"""<VTKFile type="ImageData" byte_order="LittleEndian" header_type="UInt32">
<ImageData {grid}><Piece Extent="0 4 0 3 0 2"><PointData><DataArray type="Float32" Name="a"
format="appended" offset="0"/></PointData></Piece></ImageData>
<AppendedData encoding="raw">_""".encode()
        + np.uint32(len(values)).tobytes()
        + values
        + b"</AppendedData></VTKFile>"
    )


def _write_tiff(path: Path) -> None:
    import tifffile

    tifffile.imwrite(path, _values(), imagej=True, metadata={"axes": "ZYX", "spacing": 2.0})


def _write_hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("a", data=_values(), chunks=True, compression="gzip")


def _write_netcdf(path: Path) -> None:
    import xarray

    variables = {"a": (("z", "y", "x"), _values())}
    coordinates = {axis: np.arange(n) for axis, n in zip("zyx", (3, 4, 5), strict=True)}
    engine = "scipy" if path.suffix == ".cdf" else "h5netcdf"
    xarray.Dataset(variables, coordinates).to_netcdf(path, engine=engine)


def _write_vol(path: Path) -> None:
    write_vol(path, np.linspace(0, 1, 60).reshape(3, 4, 5))


def _write_dicom(path: Path) -> None:
    """Write a slice; the other ones are unchanged."""
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for index in range(3):
        image = SimpleITK.GetImageFromArray(np.full((6, 5), 20 * index, dtype=np.int16))
        tags = {
            "0008|0060": "CT",
            "0008|0016": "1.2.840.10008.5.1.4.1.1.2",
            "0008|0018": f"1.2.826.0.1.9.{index + 1}",
            "0020|000e": "1.2.826.0.1.9",
            "0020|0032": f"0\\0\\{index}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
        }
        for key, value in tags.items():
            image.SetMetaData(key, value)
        writer.SetFileName(str(path.parent / f"{index}.dcm") if index else str(path))
        writer.Execute(image)


def read_series(path: Path) -> object:
    """Read the folder that contains a slice."""
    return read_volume(path.parent)


def _write_transfer_function(path: Path) -> None:
    load_preset("ct-bone").save(path)


FORMATS = (
    Format("light.cache", _write_cache, read_cache, lying_cache),
    Format("a.nrrd", _write_image, read_volume),
    Format("a.nii", _write_image, read_volume),
    Format("a.nii.gz", _write_image, read_volume, mutated_gzip),
    Format("a.mha", _write_image, read_volume),
    Format("a.vol", _write_vol, read_volume),
    Format("a.npy", _write_npy, read_volume),
    Format("a.npz", _write_npz, read_volume),
    Format("a.vtk", _write_vtk, read_volume),
    Format("a.vti", _write_vti, read_volume),
    Format("a.tif", _write_tiff, read_volume),
    Format("a.h5", _write_hdf5, read_volume),
    Format("a.nc", _write_netcdf, read_volume),
    Format("a.cdf", _write_netcdf, read_volume),
    Format("slice.dcm", _write_dicom, read_series),
    Format("transfer.json", _write_transfer_function, load_transfer_function),
    Format(
        "properties.json",
        properties.write_valid,
        properties.render_case,
        properties.mutated_properties,
    ),
    Format("command.json", commands.write_valid, commands.run_case, commands.mutated_command),
)
