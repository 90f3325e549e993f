"""HDF5 files (``.h5``, ``.hdf5``): one data set with the axes ``(z, y, x)`` or with channels last.

Attributes of the data set are its placement: ``spacing`` and ``origin`` (x, y, z), ``direction``
(3x3), ``unit``, or ``element_size_um`` (z, y, x; ImageJ, ilastik).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import (
    ReadOptions,
    chosen_field,
    plain_axes,
    readable_type,
    scalar_volume,
)


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one data set.

    Raises:
        IrrcacheError: a damaged file, several data sets and none chosen, or one whose values are
            in other files.
    """
    if not h5py.is_hdf5(path):
        raise IrrcacheError(f"{path} is no HDF5 file, or its header is damaged; export it again")
    with h5py.File(path, "r") as file:
        found: dict[str, h5py.Dataset] = {}

        def collect(name: str, item: object) -> None:
            if isinstance(item, h5py.Dataset) and item.ndim >= 3:
                found[name] = item

        file.visititems(collect)
        name = chosen_field(str(path), found, options.field, "data set")
        dataset, source = found[name], f"{path}[{name}]"
        if dataset.external or dataset.is_virtual:
            raise IrrcacheError(
                f"{source} stores its values in other files; copy them into this one"
            )
        readable_type(source, dataset.dtype)
        values = scalar_volume(source, dataset, plain_axes(source, dataset.shape), options)
        return VolumeData(values, **_placement(source, dataset.attrs), source=source)


def _placement(source: str, attributes: Any) -> dict[str, Any]:
    placement: dict[str, Any] = {}
    for key, shape in (("spacing", (3,)), ("origin", (3,)), ("direction", (3, 3))):
        if key in attributes:
            value = np.asarray(attributes[key])
            if value.shape != shape or value.dtype.kind not in "iuf":
                raise IrrcacheError(
                    f"{source} has {key} {value.tolist()!r}; give numbers {shape} (x, y, z)"
                )
            placement[key] = value if key == "direction" else tuple(value)
    sizes = np.ravel(attributes.get("element_size_um", ()))
    if "spacing" not in placement and sizes.size == 3:
        placement |= {"spacing": tuple(sizes[::-1].astype(float)), "length_unit": "µm"}
    if "unit" in attributes:
        unit = attributes["unit"]
        placement["unit"] = unit.decode() if isinstance(unit, bytes) else str(unit)
    return placement
