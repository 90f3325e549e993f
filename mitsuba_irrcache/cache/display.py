"""Describe caches as text, and as HTML for notebooks: slices of the irradiance and its error."""

from __future__ import annotations

import base64
import html
from typing import Any

import mitsuba as mi
import numpy as np

#: `IrradianceCache`, whose module imports this one.
Cache = Any
#: Percentile of the irradiance that is shown as white: voxels next to emitters are much brighter.
_WHITE = 99.0
#: Longest side of a slice on the page, in pixels.
_PIXELS = 180
#: The slices: the axis along which they are cut, as (array axis, its name, the slice's axes).
_CUTS = ((0, "z", "x right, y up"), (1, "y", "x right, z up"), (2, "x", "y right, z up"))


def as_text(cache: Cache) -> str:
    """Describe a cache in the style of Mitsuba's objects, one property per line."""
    lines = ",\n".join(f"  {name} = {value}" for name, value in _described(cache).items())
    return f"IrradianceCache[\n{lines}\n]"


def as_html(cache: Cache) -> str:
    """Describe a cache by a table, and by slices through its middle as images."""
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>"
        for name, value in _described(cache).items()
    )
    table = f"<b>IrradianceCache</b><table>{rows}</table>"
    if not cache.samples or not cache.active_count:
        return table
    irradiance = np.array(cache.irradiance, dtype=np.float64)
    lit = irradiance[irradiance > 0]
    white = float(np.percentile(lit, _WHITE)) if lit.size else 1.0
    pictures = [_row(cache, "irradiance", irradiance / white, f"white: {white:.4g}")]
    if not np.isnan(cache.relative_error):
        error = np.array(cache.standard_error, dtype=np.float64).mean(axis=3, keepdims=True)
        mean = irradiance.mean(axis=3, keepdims=True)
        relative = np.divide(error, mean, out=np.zeros_like(error), where=mean > 0)
        largest = max(float(np.percentile(relative, _WHITE)), 1e-12)
        pictures.append(
            _row(cache, "relative standard error", relative / largest, f"white: {largest:.2%}")
        )
    return table + "".join(pictures)


def _described(cache: Cache) -> dict[str, str]:
    """Return the properties of a cache as text, by name."""
    x, y, z = cache.grid.resolution
    edges = " x ".join(f"{edge:.4g}" for edge in cache.grid.voxel_size)
    described = {
        "voxels": f"{x} x {y} x {z}, of {edges}",
        "active": f"{cache.active_count} ({cache.active_count / cache.grid.voxel_count:.1%})",
        "samples": f"{cache.samples} per voxel, in {len(cache.streams)} stream(s)",
        "channels": str(cache.channels),
        "max_depth": str(cache.max_depth),
    }
    if cache.moments:
        described["angular moments"] = str(cache.moments)
    if cache.samples and cache.active_count:
        values = np.array(cache.mean_and_error()[0])
        described["irradiance"] = f"mean {values.mean():.4g}, maximum {values.max():.4g}"
        error = cache.relative_error
        unknown = "unknown with a single batch"
        described["relative error"] = unknown if np.isnan(error) else f"{error:.2%}"
    return described


def _row(cache: Cache, title: str, values: np.ndarray, scale: str) -> str:
    """Return HTML with three slices through the middle of ``values`` (z, y, x, channel).

    A value of 1 is white; ``scale`` is the text that states what white means.
    """
    longest = float(max(cache.grid.side_lengths))
    sides = dict(zip("xyz", (float(side) for side in cache.grid.side_lengths), strict=True))
    images = []
    for axis, name, about in _CUTS:
        middle = values.shape[axis] // 2
        # Rows of an image run downwards, coordinates upwards.
        part = np.take(values, middle, axis)[::-1]
        right, _, up = about.replace(" right", "").replace(" up", "").partition(", ")
        width, height = (max(8, round(_PIXELS * sides[a] / longest)) for a in (right, up))
        images.append(
            f'<figure style="display:inline-block;margin:4px"><img src="{_png(part)}" '
            f'width="{width}" height="{height}" style="image-rendering:pixelated" '
            f'alt="{title}, slice {name} = {middle}"/>'
            f"<figcaption>{name} = {middle} ({about})</figcaption></figure>"
        )
    return f"<div>{html.escape(title)} ({html.escape(scale)})<br/>{''.join(images)}</div>"


def _png(values: np.ndarray) -> str:
    """Return an image (row, column, channel) of linear values as a data URL."""
    if values.shape[2] != 3:
        values = values.mean(axis=2, keepdims=True).repeat(3, axis=2)
    linear = mi.Bitmap(np.ascontiguousarray(np.clip(values, 0, 1), dtype=np.float32))
    bitmap = linear.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    stream = mi.MemoryStream()
    bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    return f"data:image/png;base64,{base64.b64encode(stream.raw_buffer()).decode()}"
