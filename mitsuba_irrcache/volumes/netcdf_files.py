"""NetCDF files, and data sets of xarray in Zarr folders: one variable with its coordinates."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import xarray

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.zarr_chunks import check_chunks
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.lengths import metres
from mitsuba_irrcache.volumes.options import ReadOptions, chosen_field, scalar_volume

_AXIS_OF_STANDARD_NAME = {
    "projection_x_coordinate": "x",
    "longitude": "x",
    "grid_longitude": "x",
    "projection_y_coordinate": "y",
    "latitude": "y",
    "grid_latitude": "y",
    "height": "z",
    "altitude": "z",
    "depth": "z",
    "air_pressure": "z",
    "height_above_mean_sea_level": "z",
    "height_above_reference_ellipsoid": "z",
    "time": "t",
}
_AXIS_OF_NAME = {
    "x": re.compile(
        r"x([tmhu]|_?\d*|dim|_?coord\w*)?|n?i|lon(gitude)?|west_east(_stag)?|e_w", re.I
    ),
    "y": re.compile(r"y([tmhv]|_?\d*|dim|_?coord\w*)?|n?j|lat(itude)?|south_north(_stag)?", re.I),
    "z": re.compile(
        r"z([tmhw]|_?\d*|dim|_?coord\w*)?|n?k|lev(el)?s?|height\w*|alt(itude)?|depth|plev|"
        r"bottom_top(_stag)?|nz",
        re.I,
    ),
    "t": re.compile(r"t|time\w*|frame|step|member|ensemble\w*", re.I),
    "c": re.compile(r"c|channel|band|component|wavelength|bin", re.I),
}
#: Relative deviation from even steps up to which coordinates count as even.
_EVEN = 1e-2
#: Largest ratio of the number of even levels to that of the uneven levels that they replace.
_MOST_LEVELS = 4


@dataclass(frozen=True)
class _Axis:
    """The coordinates of voxel centres along one axis, increasing, in world units."""

    positions: np.ndarray
    is_reversed: bool
    is_even: bool

    @property
    def spacing(self) -> float:
        """Return the spacing of the even grid that represents these positions."""
        steps = np.diff(self.positions)
        if self.is_even:
            return float(np.mean(steps))
        extent = self.positions[-1] - self.positions[0]
        count = min(np.ceil(extent / steps.min()), _MOST_LEVELS * len(steps))
        return float(extent / count)


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one variable with three spatial dimensions.

    Values are unpacked by ``scale_factor`` and ``add_offset``, and missing ones are NaN. Decreasing
    coordinates are reversed. Uneven levels are interpolated linearly to even ones.

    Raises:
        IrrcacheError: a damaged file, several variables, channels or frames and none chosen, or
            coordinates that are no lengths (degrees, pressures).
    """
    with open_dataset(path) as dataset:
        names = [str(name) for name in dataset.data_vars if len(spatial_axes(dataset[name])) == 3]
        name = chosen_field(str(path), names, options.field, "variable")
        return read_variable(path, dataset, name, options)


def open_dataset(path: Path) -> xarray.Dataset:
    """Open a NetCDF file or Zarr folder; values are read on use.

    Raises:
        IrrcacheError: the file is of neither format.
    """
    engine = "zarr"
    if path.is_file():
        with path.open("rb") as stream:
            magic = stream.read(8)
        if magic[:4] in (b"CDF\x01", b"CDF\x02"):
            engine = "scipy"
        elif magic == b"\x89HDF\r\n\x1a\n":
            engine = "h5netcdf"
            with h5py.File(path) as file:  # where it fails, h5netcdf leaves a traceback behind
                list(file["/"])
        elif magic[:3] == b"CDF":
            raise IrrcacheError(
                f"{path} is a NetCDF file of a kind that is not read ({magic[:4]!r}); convert it "
                "with nccopy -k netCDF-4"
            )
        else:
            raise IrrcacheError(
                f"{path} is no NetCDF file: it begins with {magic!r}; copy or export it again"
            )
    options = {"consolidated": None} if engine == "zarr" else {}
    return xarray.open_dataset(path, engine=engine, decode_times=False, **options)


def read_variable(
    path: Path,
    dataset: xarray.Dataset,
    name: str,
    options: ReadOptions,
    derive: Callable[[np.ndarray], np.ndarray] | None = None,
) -> VolumeData:
    """Read one variable with its placement; see `read`.

    ``derive`` computes other values from it, at the file's own levels: products and quotients of
    several variables are not those of interpolated ones.
    """
    source, values, unit, placed = _levels(path, dataset, name, options)
    if derive is not None:
        values = derive(values)
    for number, axis in enumerate("zyx"):
        if not placed[axis].is_even:
            source += f" (levels along {axis} interpolated to even ones)"
            values = _interpolated(values, number, placed[axis])
    return VolumeData(
        values,
        tuple(placed[axis].spacing for axis in "xyz"),
        tuple(float(placed[axis].positions[0]) for axis in "xyz"),
        unit=str(dataset[name].attrs.get("units", "")),
        length_unit=unit,
        source=source,
    )


def values_at_levels(
    path: Path, dataset: xarray.Dataset, name: str, options: ReadOptions
) -> np.ndarray:
    """Return the values (z, y, x) of one variable at the file's own levels, float64."""
    _, values, *_ = _levels(path, dataset, name, options)
    return values.astype(np.float64)


def _levels(
    path: Path, dataset: xarray.Dataset, name: str, options: ReadOptions
) -> tuple[str, np.ndarray, str, dict[str, _Axis]]:
    """Read one variable at the file's own levels, in increasing order of coordinates.

    Returns what messages call it, its values (z, y, x), and the unit of length and the coordinates
    along each axis.
    """
    variable, source = dataset[name], f"{path}[{name}]"
    axes = spatial_axes(variable)
    letters = "".join(_letter(dimension, axes) for dimension in variable.dims)
    if len(set(letters)) < len(letters) or "?" in letters:
        unknown = [str(d) for d in variable.dims if _letter(d, axes) == "?"] or variable.dims
        raise IrrcacheError(
            f"{source} has the dimensions {variable.dims}, of which {unknown} is neither space, "
            "time nor channel; select one index of it first"
        )
    if path.is_dir():
        _check_zarr(source, path, name)
    values = scalar_volume(source, variable.variable, letters, options)
    even_spacing = options.spacing is not None
    unit, placed = _placed(source, variable, axes, even_spacing)
    for number, axis in enumerate("zyx"):
        if placed[axis].is_reversed:
            values = np.flip(values, number)
    return source, values, unit, placed


def _check_zarr(source: str, folder: Path, name: str) -> None:
    """Refuse truncated chunks. To xarray absent ones are missing values, or fill values."""
    # Imported here because NetCDF files do not need it.
    import zarr

    array = zarr.open(str(folder / name), mode="r")
    check_chunks(source, folder / name, array)


def spatial_axes(variable: xarray.DataArray) -> dict[Hashable, str]:
    """Return the letter x, y or z of each spatial dimension.

    It follows from the attributes ``axis`` and ``standard_name`` of the coordinate, from the name,
    or, if these give no three axes, from the order of the last three dimensions: z, y, x.
    """
    found: dict[Hashable, str] = {}
    for dimension in variable.dims:
        letter = _axis_of(dimension, variable)
        if letter in ("x", "y", "z") and letter not in found.values():
            found[dimension] = letter
    if len(found) == 3 or variable.ndim < 3:
        return found
    return dict(zip(variable.dims[-3:], "zyx", strict=True))


def _letter(dimension: Hashable, spatial: dict[Hashable, str]) -> str:
    if dimension in spatial:
        return spatial[dimension]
    known = (axis for axis in "tc" if _AXIS_OF_NAME[axis].fullmatch(str(dimension)))
    return next(known, "?")


def _axis_of(dimension: Hashable, variable: xarray.DataArray) -> str:
    attributes = variable[dimension].attrs if dimension in variable.coords else {}
    letter = str(attributes.get("axis", "")).lower()
    if letter in ("x", "y", "z", "t"):
        return letter
    named = _AXIS_OF_STANDARD_NAME.get(attributes.get("standard_name", ""))
    if named:
        return named
    fitting = (a for a, names in _AXIS_OF_NAME.items() if names.fullmatch(str(dimension)))
    return next(fitting, "")


def _placed(
    source: str, variable: xarray.DataArray, axes: dict[Hashable, str], ignored: bool
) -> tuple[str, dict[str, _Axis]]:
    """Return the unit of length, and coordinates in it: the file's if it has one, or metres.

    Coordinates that increase downwards, such as depths, change their signs. If coordinates are
    ``ignored``, because the user states the spacing, they are indices.
    """
    units, placed = {}, {}
    for dimension, axis in axes.items():
        coordinate = variable.coords.get(dimension)
        units[axis] = "" if coordinate is None else str(coordinate.attrs.get("units", ""))
        if units[axis] and metres(units[axis]) is None and not ignored:
            raise IrrcacheError(
                f"{source} has the coordinate {dimension!r} in {units[axis]!r}, which is no "
                "length; give the distances of the voxels by --spacing X,Y,Z"
            )
    is_common = len(set(units.values())) == 1
    for dimension, axis in axes.items():
        coordinate = variable.coords.get(dimension)
        if coordinate is None or ignored or coordinate.ndim != 1:
            positions = np.arange(variable.sizes[dimension], dtype=np.float64)
        else:
            factor = 1.0 if is_common or not units[axis] else metres(units[axis])
            if _is_downwards(coordinate):
                factor = -factor
            positions = np.asarray(coordinate.values, dtype=np.float64) * factor
        placed[axis] = _axis(source, dimension, positions)
    unit = units["x"] if is_common else "m"
    return ("" if ignored else unit), placed


def _is_downwards(coordinate: xarray.DataArray) -> bool:
    """Return whether a coordinate increases downwards (CF conventions)."""
    positive = str(coordinate.attrs.get("positive", "")).lower()
    is_depth = coordinate.attrs.get("standard_name", "") == "depth"
    return positive == "down" or (is_depth and positive != "up")


def _axis(source: str, dimension: Hashable, positions: np.ndarray) -> _Axis:
    if len(positions) < 2:
        raise IrrcacheError(f"{source} has {len(positions)} value along {dimension!r}; give 2")
    is_reversed = bool(positions[-1] < positions[0])
    positions = positions[::-1] if is_reversed else positions
    steps = np.diff(positions)
    if not np.isfinite(positions).all() or steps.min() <= 0:
        raise IrrcacheError(
            f"{source} has coordinates along {dimension!r} that do not increase; sort them, or "
            "give --spacing X,Y,Z"
        )
    is_even = bool(np.abs(steps - steps.mean()).max() <= _EVEN * steps.mean())
    return _Axis(positions, is_reversed, is_even)


def _interpolated(values: np.ndarray, number: int, axis: _Axis) -> np.ndarray:
    """Interpolate linearly along an axis from uneven to even positions, float32."""
    count = round((axis.positions[-1] - axis.positions[0]) / axis.spacing) + 1
    even = axis.positions[0] + axis.spacing * np.arange(count)
    above = np.clip(np.searchsorted(axis.positions, even), 1, len(axis.positions) - 1)
    low, high = axis.positions[above - 1], axis.positions[above]
    shape = [1, 1, 1]
    shape[number] = count
    weight = np.clip((even - low) / (high - low), 0, 1).reshape(shape).astype(np.float32)
    return values.take(above - 1, number) * (1 - weight) + values.take(above, number) * weight
