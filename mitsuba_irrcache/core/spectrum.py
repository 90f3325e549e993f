"""Colours and arrays of them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def interleaved(planes: mi.Spectrum | list[mi.Float], width: int = 0) -> mi.Float:
    """Planes of an image (or of a grid) as one array, the values of a pixel side by side; of
    ``width`` pixels, where it may be that no plane varies.
    """
    values, width = list(planes), width or max(map(dr.width, planes))
    flat = dr.zeros(mi.Float, width * len(values))
    index = dr.arange(mi.UInt32, width) * len(values)
    for i, value in enumerate(values):
        dr.scatter(flat, value, index + i)
    return flat


def luminance(spectrum: mi.Spectrum) -> mi.Float:
    """Luminance of a colour; the value itself in monochromatic variants."""
    return spectrum[0] if mi.is_monochromatic else mi.luminance(mi.Color3f(spectrum))
