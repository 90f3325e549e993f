"""Colours and arrays of colours."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def interleaved(planes: mi.Spectrum | list[mi.Float], width: int = 0) -> mi.Float:
    """Interleave the channels of an image or grid into one array.

    ``width`` is the number of pixels; it is needed only if all channels may be constant.
    """
    values, width = list(planes), width or max(map(dr.width, planes))
    flat = dr.zeros(mi.Float, width * len(values))
    scatter_channels(flat, values, dr.arange(mi.UInt32, width))
    return flat


def scatter_channels(flat: mi.Float, channels: list[mi.Float], items: mi.UInt32) -> None:
    """Write the channels of ``items`` into the interleaved array ``flat``.

    Each channel has a launch of its own; all of them, and arrays with other numbers of channels,
    share one kernel.
    """
    first = items * dr.opaque(mi.UInt32, len(channels))
    for i, value in enumerate(channels):
        dr.scatter(flat, value, first + dr.opaque(mi.UInt32, i))


def channel_mean(values: mi.Float | mi.Color3f) -> mi.Float:
    """Return the mean over the channels, of which a value may have one.

    Unlike those of ``dr.mean``, the kernels do not depend on the number of lanes.
    """
    if isinstance(values, mi.Float):
        return values
    return dr.sum(values) * (1 / len(values))


def luminance(spectrum: mi.Spectrum) -> mi.Float:
    """Return the luminance of a colour, or the value itself in monochromatic variants."""
    return spectrum[0] if mi.is_monochromatic else mi.luminance(mi.Color3f(spectrum))
