"""Slices as pictures, one file each: PNG, JPEG and BMP, grey or in colour, through OpenImageIO."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813 (the name its documentation uses)

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.machine.memory import require_memory
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import ReadOptions, scalar_volume
from mitsuba_irrcache.volumes.raw import check_numbering, natural_order


def read_slices(paths: Sequence[Path], options: ReadOptions) -> VolumeData:
    """Stack pictures in the order of the numbers in their names; voxels have edges of length 1.

    The first row of a picture is the first one along y. Values are those of the file, without
    conversion: 0 to 255 for 8 bits.

    Raises:
        IrrcacheError: a missing number, pictures of different size or type, or a damaged file.
    """
    ordered = natural_order(paths)
    check_numbering(ordered)
    if len(ordered) < 2:
        raise IrrcacheError(f"{ordered[0]} is one slice; give a folder or list of all slices")
    first = _read(ordered[0])
    require_memory(2 * len(ordered) * first.nbytes, f"reading {len(ordered)} slices", "crop them")
    stack = np.empty((len(ordered), *first.shape), first.dtype)
    for number, path in enumerate(ordered):
        pixels = _read(path)
        if pixels.shape != first.shape or pixels.dtype != first.dtype:
            raise IrrcacheError(
                f"{path} has shape {pixels.shape} (y, x, channel) and type {pixels.dtype}, but "
                f"{ordered[0]} has {first.shape} and {first.dtype}; give slices of one series"
            )
        stack[number] = pixels
    source = f"{ordered[0]} ... {ordered[-1].name}"
    return VolumeData(scalar_volume(source, stack, "zyxc", options), source=source)


def _read(path: Path) -> np.ndarray:
    """Return the pixels of a file ``(y, x, channel)`` in its own type."""
    if not path.is_file():
        raise IrrcacheError(f"slice {path} does not exist")
    settings = oiio.ImageSpec()
    settings["oiio:UnassociatedAlpha"] = 1  # colours are not multiplied by alpha
    file = oiio.ImageInput.open(str(path), settings)
    reason = oiio.geterror() if file is None else ""
    if file is not None:
        pixels = file.read_image(0, 0, 0, file.spec().nchannels, file.spec().format)
        reason = file.geterror()
        file.close()
    if reason or pixels is None:
        raise IrrcacheError(
            f"cannot read {path} as a picture: {reason or 'no pixels'} (is it truncated, or of "
            "another format?); copy or export it again"
        )
    return np.asarray(pixels)
