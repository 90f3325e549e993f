"""Bounding boxes of scenes whose meshes Mitsuba has merged.

On loading, Mitsuba merges meshes and rectangles that have the same BSDF and media. The bounding
box of the result lacks the rectangles (seen in Mitsuba 3.9), and so does that of the scene, at
whose diameter suns and environments end their shadow rays.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

#: Extent of a scene beyond its bounding box, over the size of the box, below which it is rounding.
ROUNDING = 1e-3


def correct_mesh_bounds(scene: mi.Scene) -> None:
    """Compute the bounding boxes of all meshes anew."""
    for shape in scene.shapes():
        if shape.is_mesh():
            shape.recompute_bbox()


def bounds_of_shapes(scene: mi.Scene) -> np.ndarray:
    """Return the ends (2, 3) of the bounding box of all shapes, after `correct_mesh_bounds`;
    infinite without shapes.
    """
    boxes = [scene.bbox(), *(shape.bbox() for shape in scene.shapes())]
    lower = np.min([np.array(box.min, dtype=np.float64) for box in boxes], axis=0)
    upper = np.max([np.array(box.max, dtype=np.float64) for box in boxes], axis=0)
    return np.array([lower, upper])


def lost_extent(scene: mi.Scene) -> float:
    """Return the largest distance by which shapes extend beyond the bounding box of the scene,
    after `correct_mesh_bounds`; 0 if it is correct.
    """
    lower, upper = bounds_of_shapes(scene)
    size, box = np.abs([lower, upper]).max(), scene.bbox()
    if not np.isfinite(size):
        return 0.0
    beyond = max((np.array(box.min) - lower).max(), (upper - np.array(box.max)).max())
    return float(beyond) if beyond > ROUNDING * size else 0.0
