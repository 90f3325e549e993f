"""The volume formats: which files they are, which extra reads them, and by which function."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.extras import require
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import ReadOptions


@dataclass(frozen=True)
class Format:
    """A volume format.

    Attributes:
        name: as its users call it.
        suffixes: endings of file names, in lower case.
        reader: module of this folder; its function ``read(path, options)`` returns `VolumeData`.
        extra: the extra of this package that installs what the reader imports; "" for none.
        packages: modules that the reader imports.
        up: the world axis that points up in a picture, ``"z"`` or ``"y"``.
    """

    name: str
    suffixes: tuple[str, ...]
    reader: str
    extra: str = ""
    packages: tuple[str, ...] = ()
    up: str = "z"

    def read(self, path: Path, options: ReadOptions) -> VolumeData:
        """Read a file or folder of this format.

        Raises:
            IrrcacheError: a package is missing, or the file cannot be read.
        """
        return self.call(path, self.reader, "read", options)

    def call(self, path: Path, module: str, function: str, *arguments: Any) -> VolumeData:
        """Call a function of a module of this folder with ``path`` and further arguments.

        Errors of the library that decodes the file are raised as IrrcacheError, which names the
        file and the format.
        """
        for package in self.packages:
            require(package, self.extra, f"reading {path}")
        if not path.exists():
            raise IrrcacheError(f"volume file {path} does not exist")
        if path.is_file() and not path.stat().st_size:
            raise IrrcacheError(f"volume file {path} is empty; copy or export it again")
        called = getattr(import_module(f"mitsuba_irrcache.volumes.{module}"), function)
        try:
            return called(path, *arguments)
        except IrrcacheError:
            raise
        # Decoders raise exceptions of any type for damaged files.
        except Exception as error:
            reason = str(error).strip().splitlines() or [type(error).__name__]
            raise IrrcacheError(
                f"cannot read {path} as {self.name}: {reason[-1]} (is it truncated, or of another "
                "format?); copy or export it again"
            ) from error


TIFF = Format("TIFF", (".tif", ".tiff"), "tiff_files", "microscopy", ("tifffile",))
NETCDF = Format(
    "NetCDF",
    (".nc", ".nc4", ".cdf"),
    "netcdf_files",
    "science",
    ("xarray", "h5netcdf", "h5py", "scipy"),
)
ZARR = Format("Zarr", (".zarr",), "zarr_files", "science", ("zarr",))
#: Files that mark a folder as Zarr, of format 3 and 2.
ZARR_MARKS = ("zarr.json", ".zgroup", ".zarray", ".zattrs")

#: Endings of pictures, each of which is a slice.
PICTURES = (".png", ".jpg", ".jpeg", ".bmp")

#: All formats of files and, if their name has an ending, of folders.
FORMATS = (
    Format("Mitsuba volume", (".vol",), "mitsuba_files", up="y"),
    Format("NRRD", (".nrrd", ".nhdr"), "images", "volumes", ("SimpleITK",)),
    Format("NIfTI", (".nii", ".nii.gz"), "images", "volumes", ("SimpleITK",)),
    Format("Analyze", (".hdr", ".img"), "images", "volumes", ("SimpleITK",)),
    Format("MetaImage", (".mha", ".mhd"), "images", "volumes", ("SimpleITK",)),
    Format("DICOM", (".dcm",), "images", "volumes", ("SimpleITK",)),
    Format("legacy VTK", (".vtk",), "vtk_files"),
    Format("VTK image data", (".vti",), "vti_files"),
    Format("OpenVDB", (".vdb",), "openvdb_files", up="y"),
    Format("NanoVDB", (".nvdb",), "nanovdb_files", "nanovdb", ("warp",), up="y"),
    TIFF,
    ZARR,
    NETCDF,
    Format("HDF5", (".h5", ".hdf5"), "hdf5_files", "science", ("h5py",)),
    Format("NumPy", (".npy", ".npz"), "numpy_files"),
)


def format_of(path: Path) -> Format | None:
    """Return the format of a file or folder by its name, or None."""
    name = path.name.lower()
    fitting = [f for f in FORMATS if name.endswith(f.suffixes)]
    return fitting[0] if fitting else None


def suffixes() -> str:
    """Return the endings of all formats, for messages."""
    return ", ".join(suffix for known in FORMATS for suffix in known.suffixes)
