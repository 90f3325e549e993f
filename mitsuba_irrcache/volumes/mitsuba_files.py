"""Mitsuba's ``.vol`` files, placed by the bounding box in their header."""

from __future__ import annotations

from pathlib import Path

from mitsuba_irrcache.io.mitsuba_vol import read_vol
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import ReadOptions, scalar_volume


def read(path: Path, options: ReadOptions) -> VolumeData:
    """Read one channel of a ``.vol`` file.

    Raises:
        IrrcacheError: a damaged file, or several channels and none chosen.
    """
    values, (low, high) = read_vol(path)
    spacing = (high - low) / values.shape[2::-1]
    return VolumeData(
        scalar_volume(str(path), values, "zyxc", options),
        tuple(spacing),
        tuple(low + 0.5 * spacing),
        source=str(path),
    )
