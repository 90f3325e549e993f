"""A procedural chest CT for use without data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.phantom import anatomy
from mitsuba_irrcache.volumes.phantom.body import paint_body
from mitsuba_irrcache.volumes.phantom.canvas import Canvas
from mitsuba_irrcache.volumes.phantom.organs import paint_cavities, paint_mediastinum
from mitsuba_irrcache.volumes.phantom.shape import check_memory, checked_shape
from mitsuba_irrcache.volumes.phantom.skeleton import paint_skeleton

SMALLEST_SIDE = 8

# Coarse grids are block means of a finer one, as a scanner's voxels are: thin bone becomes darker,
# but is neither lost nor thickened.
COARSEST_SPACING = 3.0

# Peak memory while painting, in bytes per painted voxel.
BYTES_PER_VOXEL = 40


def thorax(shape: Sequence[int] = (350, 150, 512), memory_limit: int = 8 * 2**30) -> VolumeData:
    """Create a contrast-enhanced chest CT of a fictitious patient, in Hounsfield units.

    Whatever the shape, the volume is 380 x 240 x 330 mm (x, y, z) in LPS axes: +x is the patient's
    left, +y backwards, +z upwards. Equal shapes give equal volumes, and a position in the body has
    the same anatomy and texture at every resolution, up to partial-volume blur.

    Args:
        shape: voxel counts ``(z, y, x)``, each at least 8.
        memory_limit: maximum memory in bytes.

    Returns:
        Values int16 in HU, shape ``shape``; spacing and origin in mm.

    Raises:
        IrrcacheError: a shape of other than three integers, a side below 8, or a volume that needs
            more than ``memory_limit``.
    """
    shape = checked_shape(shape, SMALLEST_SIDE)
    size = np.subtract(anatomy.UPPER, anatomy.LOWER)
    spacing = size / shape[::-1]
    factors = np.ceil(spacing / COARSEST_SPACING - 1e-9).astype(int)[::-1]
    painted = tuple(int(n * k) for n, k in zip(shape, factors, strict=True))
    check_memory(shape, painted, BYTES_PER_VOXEL, memory_limit)
    canvas = Canvas(painted, anatomy.LOWER, anatomy.UPPER, anatomy.AIR)
    paint_body(canvas)
    paint_cavities(canvas)
    paint_mediastinum(canvas)
    paint_skeleton(canvas)
    values = np.rint(_block_means(canvas.values, factors)).astype(np.int16)
    origin = np.asarray(anatomy.LOWER) + spacing / 2
    return VolumeData(
        values=values,
        spacing=tuple(spacing),
        origin=tuple(origin),
        unit="HU",
        source="phantom:thorax",
    )


def _block_means(values: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return means over blocks of ``factors`` (z, y, x) voxels."""
    for axis, factor in enumerate(factors):
        if factor > 1:
            split = list(values.shape)
            split[axis : axis + 1] = [split[axis] // factor, factor]
            values = values.reshape(split).mean(axis=axis + 1, dtype=np.float32)
    return values
