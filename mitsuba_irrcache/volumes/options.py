"""What to read from a volume file, and one scalar volume out of an array with more axes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, suggestion
from mitsuba_irrcache.machine.memory import require_memory

#: Maximum number of names that an error message lists.
_MOST_NAMES = 20


@dataclass(frozen=True)
class ReadOptions:
    """Which scalar volume to read from a file that holds several, and from where.

    Attributes:
        field: name of an array, variable, grid or data set; None: the only one.
        channel: index of a value per voxel (colours, components, microscope channels), from 0.
        frame: index of a time step, from 0.
        spacing: voxel spacing along x, y, z that replaces that of the file.
        data_folders: folders, besides that of a header, for voxels in other files.
    """

    field: str | None = None
    channel: int | None = None
    frame: int | None = None
    spacing: tuple[float, float, float] | None = None
    data_folders: Sequence[str | PathLike] = ()


@dataclass(frozen=True)
class CloudVariables:
    """The variables of a cloud in a data set.

    Attributes:
        water: name of the liquid water content or mixing ratio; None: found by its name.
        radius: name of the effective radius; or a number in micrometres; None: found by its name.
        air_density: in kg/m^3, for mixing ratios in a data set that has none.
    """

    water: str | None = None
    radius: str | float | None = None
    air_density: float | None = None


def chosen_field(source: str, names: Iterable[str], wanted: str | None, what: str) -> str:
    """Return the field to read: the one ``wanted``, or the only one.

    Args:
        source: the file, for messages.
        names: the fields of the file that are volumes.
        wanted: the field that the user named, if any.
        what: what the format calls a field, in the singular.

    Raises:
        IrrcacheError: there is no field, several and none is wanted, or none of that name.
    """
    names = list(names)
    if wanted in names:
        return wanted
    if wanted is not None:
        raise IrrcacheError(
            f"{source} has no {what} {wanted!r} that is a volume{suggestion(wanted, names)}; "
            f"it has {_listed(names)}"
        )
    if len(names) == 1:
        return names[0]
    if not names:
        raise IrrcacheError(f"{source} has no {what} with three axes; give a file with a volume")
    raise IrrcacheError(
        f"{source} has {len(names)} volumes, {_listed(names)}; choose one with --field NAME"
    )


class MissingItemError(IrrcacheError):
    """A channel or frame that a file does not have; ``count`` is how many it has."""

    def __init__(self, message: str, count: int) -> None:
        super().__init__(message)
        self.count = count


class UnchosenItemError(IrrcacheError):
    """Several channels or frames, named by ``what``, are available and none is chosen."""

    def __init__(self, message: str, what: str) -> None:
        super().__init__(message)
        self.what = what


def picked(source: str, what: str, count: int, wanted: int | None) -> int:
    """Return the index to read of ``count`` items: the one ``wanted``, or 0 if there is one.

    ``what`` is ``"channel"`` or ``"frame"``, the name of the option.

    Raises:
        IrrcacheError: there are several and none is wanted, or the index is out of range.
    """
    if wanted is None and count == 1:
        return 0
    if wanted is None:
        uses = "albedo or emission" if count == 4 else "albedo, emission or extinction"
        colours = f"; or read them as colours: --colour {uses}"
        raise UnchosenItemError(
            f"{source} has {count} {what}s; choose one with --{what} N, from 0 to {count - 1}"
            f"{colours if what == 'channel' and count in (3, 4) else ''}",
            what,
        )
    if not 0 <= wanted < count:
        remedy = f"give 0 to {count - 1}" if count > 1 else f"leave --{what} out"
        raise MissingItemError(
            f"{source} has {count} {what}(s), but --{what} is {wanted}; {remedy}", count
        )
    return wanted


def scalar_volume(source: str, array: Any, axes: str, options: ReadOptions) -> np.ndarray:
    """Read one scalar volume of an array.

    Args:
        source: the file, for messages.
        array: a NumPy array, or one in a file that has ``shape``, ``dtype`` and indexing; only the
            chosen part is read.
        axes: a letter per axis: ``x``, ``y``, ``z``, ``c`` for channels, ``t`` for frames.
        options: the channel and frame to read.

    Returns:
        values ``(z, y, x)`` in the byte order of this machine.

    Raises:
        IrrcacheError: no volume, values that are no real numbers, a channel or frame that is not
            chosen, or more voxels than fit in memory.
    """
    dtype = readable_type(source, array.dtype)
    spatial = "".join(axis for axis in axes if axis in "xyz")
    sizes = dict(zip(axes, array.shape, strict=True))
    if sorted(spatial) != ["x", "y", "z"] or sizes["z"] == 1:
        raise IrrcacheError(
            f"{source} is one slice of shape {tuple(array.shape)}; give a volume with axes "
            "(z, y, x), or the files of all slices"
        )
    chosen = {
        "c": picked(source, "channel", sizes.get("c", 1), options.channel),
        "t": picked(source, "frame", sizes.get("t", 1), options.frame),
    }
    index = tuple(slice(None) if axis in spatial else chosen[axis] for axis in axes)
    voxels = int(np.prod([sizes[axis] for axis in spatial], dtype=object))
    require_memory(voxels * dtype.itemsize, f"reading {source}", "crop or resample it first")
    values = np.asarray(array[index])
    return values.transpose([spatial.index(axis) for axis in "zyx"]).astype(dtype, copy=False)


def plain_axes(source: str, shape: Sequence[int]) -> str:
    """Return the axes of an array without description: ``(z, y, x)`` or ``(z, y, x, channel)``.

    Leading axes of length 1 are no axes.

    Raises:
        IrrcacheError: another number of axes.
    """
    extra = 0
    while len(shape) - extra > 3 and shape[extra] == 1:
        extra += 1
    axes = {2: "yx", 3: "zyx", 4: "zyxc"}.get(len(shape) - extra)
    if axes is None or extra > 2:
        raise IrrcacheError(
            f"{source} has shape {tuple(shape)}; give an array (z, y, x) or (z, y, x, channel)"
        )
    return "tc"[:extra] + axes


def readable_type(source: str, dtype: Any) -> np.dtype:
    """Return the native type in which to hold values of ``dtype``, without loss.

    Raises:
        IrrcacheError: values that are no real numbers (complex, text, objects, records).
    """
    dtype = np.dtype(dtype)
    if dtype.kind not in "biuf":
        raise IrrcacheError(
            f"{source} has values of type {dtype}; convert them to real numbers, e.g. float32"
        )
    if dtype.kind == "b":
        return np.dtype(np.uint8)
    if dtype.kind == "f" and dtype.itemsize == 2:  # SciPy does not filter half precision
        return np.dtype(np.float32)
    if dtype.itemsize > 8:
        return np.dtype(np.float64)
    return dtype.newbyteorder("=")


def placement_of(matrix: np.ndarray) -> dict[str, Any]:
    """Return spacing, origin and direction of a 4x4 matrix from indices (x, y, z) to the world."""
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    direction = matrix[:3, :3] / np.where(spacing > 0, spacing, 1.0)
    return {
        "spacing": tuple(spacing),
        "origin": tuple(matrix[:3, 3]),
        "direction": direction,
    }


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(map(repr, names[:_MOST_NAMES])) or "none"
    return f"{shown}, ..." if len(names) > _MOST_NAMES else shown
