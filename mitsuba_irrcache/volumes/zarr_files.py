"""Zarr folders: OME-Zarr images of microscopes, data sets of xarray, and single arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import zarr

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.zarr_chunks import check_chunks
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.formats import ZARR_MARKS
from mitsuba_irrcache.volumes.lengths import factors_to_first
from mitsuba_irrcache.volumes.options import (
    ReadOptions,
    chosen_field,
    plain_axes,
    scalar_volume,
)


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one volume of a Zarr folder.

    Of the resolutions of an OME-Zarr image, the finest is read, or the one named by ``field``.

    Raises:
        IrrcacheError: no Zarr folder, or several volumes, channels or frames and none chosen.
    """
    if not any((path / mark).is_file() for mark in ZARR_MARKS):
        raise IrrcacheError(
            f"{path} is no Zarr folder: it has none of {', '.join(ZARR_MARKS)}; name the "
            "folder of an array or group"
        )
    node = zarr.open(str(path), mode="r")
    if isinstance(node, zarr.Array):
        source = str(path)
        axes = plain_axes(source, node.shape)
        note = absent_chunks(source, path, node)
        return VolumeData(scalar_volume(source, node, axes, options), source=source + note)
    image = _image_of(node)
    if image is not None:
        return _read_ome(path, *image, options)
    # Imported here because OME-Zarr does not need it.
    from mitsuba_irrcache.volumes import netcdf_files

    return netcdf_files.read(path, options)


def absent_chunks(source: str, folder: Path, array: zarr.Array) -> str:
    """Check the chunks of an array, and return a note on absent ones for the summary.

    Raises:
        IrrcacheError: a truncated chunk.
    """
    absent = check_chunks(source, folder, array)
    return f" ({absent} chunks are absent and count as {array.fill_value})" if absent else ""


def _image_of(group: zarr.Group) -> tuple[zarr.Group, dict[str, Any]] | None:
    """Return the group of an OME-Zarr image and its description; None if there is none.

    Converters such as bioformats2raw put the first image into the subgroup ``0``.
    """
    for candidate in (group, group.get("0")):
        if isinstance(candidate, zarr.Group):
            attributes = candidate.attrs.asdict()
            described = attributes.get("ome", attributes).get("multiscales")
            if described:
                return candidate, described[0]
    return None


def _read_ome(
    path: Path, group: zarr.Group, image: dict[str, Any], options: ReadOptions
) -> VolumeData:
    datasets = {dataset["path"]: dataset for dataset in image["datasets"]}
    level = next(iter(datasets), "")
    if options.field is not None:
        level = chosen_field(str(path), datasets, options.field, "resolution")
    array, source = group[level], f"{path}[{level}]"
    axes = [a if isinstance(a, dict) else {"name": a} for a in image["axes"]]
    names = "".join(axis["name"].lower() for axis in axes)
    if len(names) != len(axes) or set(names) - set("xyzct"):
        raise IrrcacheError(f"{source} has axes {[a['name'] for a in axes]}; give z, y, x, c, t")
    scale, shift = np.ones(len(axes)), np.zeros(len(axes))
    transformations = [
        *datasets[level].get("coordinateTransformations", ()),
        *image.get("coordinateTransformations", ()),
    ]
    for transformation in transformations:
        if transformation["type"] == "scale":
            factor = np.asarray(transformation["scale"], dtype=np.float64)
            scale, shift = scale * factor, shift * factor
        elif transformation["type"] == "translation":
            shift = shift + np.asarray(transformation["translation"], dtype=np.float64)
        elif transformation["type"] != "identity":
            raise IrrcacheError(
                f"{source} is placed by a {transformation['type']!r}; give scale and translation"
            )
    if not isinstance(array, zarr.Array):
        raise IrrcacheError(f"{source} is a group, not the array of a resolution; export it again")
    note = absent_chunks(source, path / group.path / level, array)
    values = scalar_volume(source, array, names, options)
    places = [names.index(axis) for axis in "xyz"]
    units = [axes[place].get("unit", "") for place in places]
    factors = factors_to_first(source, units)
    return VolumeData(
        values,
        tuple(scale[place] * factor for place, factor in zip(places, factors, strict=True)),
        tuple(shift[place] * factor for place, factor in zip(places, factors, strict=True)),
        length_unit=units[0],
        source=source + note,
    )
