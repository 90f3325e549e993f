"""The body surface: skin, subcutaneous fat and the muscles over the rib cage."""

from __future__ import annotations

import numpy as np

from mitsuba_irrcache.volumes.phantom import anatomy
from mitsuba_irrcache.volumes.phantom.canvas import Canvas, Region
from mitsuba_irrcache.volumes.phantom.distance import Ellipsoid

SKIN_THICKNESS = 2.0

# Width in voxels of the transition from body to air. This step of 1000 HU crosses all values that a
# transfer function assigns to lungs. Within one voxel it would be undersampled: the optical depth
# of the skin would depend on the position of the surface between voxel centres, which would be
# visible as rings like wood grain. Its standard deviation of 0.7 voxels resembles a scanner's blur.
SKIN_SOFTNESS = 2.5

# Subcutaneous fat: z, thickness in mm.
FAT_THICKNESS = ((0, 15), (100, 11), (200, 8), (280, 7), (330, 5))

# The layer of fat between the rib cage and the muscles over it: height above the centre lines of
# the ribs, and thickness in mm.
FASCIA_HEIGHT, FASCIA_THICKNESS = 9.0, 2.4

# The furrow over the spine: half width and depth in mm.
FURROW_WIDTH, FURROW_DEPTH = 14.0, 5.0


def paint_body(canvas: Canvas) -> None:
    """Paint skin, subcutaneous fat, muscle, and the fat between the muscles and in the armpits."""
    region = canvas.region(anatomy.WHOLE)
    distance = skin_distance(region)
    # The region extends beyond the surface: where the body blends into air, skin must be
    # underneath.
    canvas.paint(region, distance - np.float32(SKIN_SOFTNESS * canvas.edge), anatomy.SKIN)
    distance += np.float32(SKIN_THICKNESS)
    canvas.paint(region, distance, anatomy.FAT)
    heights, thickness = np.transpose(FAT_THICKNESS)
    distance += np.interp(region.z, heights, thickness).astype(np.float32)
    canvas.paint(region, distance, anatomy.MUSCLE)
    _paint_fascia(canvas)
    armpits = [Ellipsoid((s * 128, 2, 228), (12, 30, 34)) for s in (anatomy.RIGHT, anatomy.LEFT)]
    canvas.paint_solids(armpits, anatomy.FAT)
    canvas.paint(region, -skin_distance(region), anatomy.AIR, SKIN_SOFTNESS)


def _paint_fascia(canvas: Canvas) -> None:
    region = canvas.region(anatomy.CAGE.bounds(), FASCIA_HEIGHT + FASCIA_THICKNESS + canvas.edge)
    height = anatomy.CAGE.distance(region.x, region.y, region.z)
    sheet = np.abs(height - np.float32(FASCIA_HEIGHT)) - np.float32(FASCIA_THICKNESS / 2)
    canvas.paint(region, sheet, anatomy.FAT)


def skin_distance(region: Region) -> np.ndarray:
    """Return the signed distance (z, y, x) in mm to the skin, with the furrow of the spine."""
    distance = anatomy.TORSO.distance(region.x, region.y, region.z)
    distance += FURROW_DEPTH * np.exp(-((region.x / FURROW_WIDTH) ** 2)) * (region.y > 0)
    return distance
