"""Files with three or four values per voxel as colours: albedo, emission or extinction in RGB."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.options import MissingItemError
from mitsuba_irrcache.volumes.transfer import DensityMapping, TransferFunction

#: What the colours of a file may be, by the option ``--colour``.
USES = ("albedo", "emission", "extinction")
#: Luminance of linear RGB with the primaries of ITU-R BT.709.
_LUMINANCE = (0.2126, 0.7152, 0.0722)


@dataclass(frozen=True)
class ColourVolume:
    """The channels of a file.

    Attributes:
        density: alpha where there are four channels, otherwise the luminance of the three as they
            are stored.
        rgb: the three channels, with the placement of ``density``.
    """

    density: VolumeData
    rgb: tuple[VolumeData, VolumeData, VolumeData]


@dataclass(frozen=True)
class Colours:
    """Linear colours of a volume: ``values`` (z, y, x, 3), and their ``use``, one of `USES`.

    The values of extinctions are multiplied by the factor of a density.
    """

    use: str
    values: np.ndarray

    def apply(
        self, mapping: TransferFunction | DensityMapping, sigma_t: np.ndarray, albedo: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return extinction, albedo and emission, given those of the ``mapping`` of a density."""
        if self.use == "extinction":
            return mapping.apply(self.values)[0], albedo, None
        if self.use == "albedo":
            return sigma_t, self.values, None
        return sigma_t, albedo, self.values


def read_colours(source: str, use: str, read: Callable[[int], VolumeData]) -> ColourVolume:
    """Read the channels of a file.

    Args:
        source: the file, for messages.
        use: one of `USES`.
        read: reads the channel of a number.

    Raises:
        IrrcacheError: another number of channels than three, or four with alpha as the density.
    """
    channels: list[VolumeData] = []
    try:
        for number in range(5):
            channels.append(read(number))
    except MissingItemError as error:
        if not channels or error.count != len(channels):  # it is a frame that is missing
            raise
    allowed = (3,) if use == "extinction" else (3, 4)
    if len(channels) not in allowed:
        count = "more than 4" if len(channels) > 4 else len(channels)
        wanted = "red, green and blue" + (" and, if present, alpha" if 4 in allowed else "")
        raise IrrcacheError(
            f"{source} has {count} channel(s), but --colour {use} needs {wanted}; leave --colour "
            "out, and choose one with --channel N if there are several"
        )
    red, green, blue = channels[:3]
    if len(channels) == 4:
        return ColourVolume(channels[3], (red, green, blue))
    grey = np.zeros(red.values.shape, np.float32)
    for channel, weight in zip((red, green, blue), _LUMINANCE, strict=True):
        grey += np.asarray(channel.values, np.float32) * np.float32(weight)
    return ColourVolume(replace(red, values=grey), (red, green, blue))


def linear(channel: VolumeData, use: str) -> VolumeData:
    """Return a channel as linear float32.

    Unsigned integers are fractions of the largest value of their type; those of 8 bits are encoded
    as sRGB, as in images.

    Raises:
        IrrcacheError: negative values, or an albedo above 1.
    """
    values = np.asarray(channel.values)
    if values.dtype.kind == "u":
        values = values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
        if channel.values.dtype.itemsize == 1:
            bent = ((values + 0.055) / 1.055) ** 2.4
            values = np.where(values <= 0.04045, values / 12.92, bent)
    low, high = float(values.min()), float(values.max())
    if low < 0 or (use == "albedo" and high > 1):
        limit = "between 0 and 1" if use == "albedo" else "at least 0"
        raise IrrcacheError(
            f"{channel.source} has colours from {low:g} to {high:g}; as {use} they must be "
            f"{limit}. Divide them by their range and store them as real numbers, or as uint8 "
            "(sRGB) or uint16"
        )
    return replace(channel, values=np.asarray(values, np.float32))
