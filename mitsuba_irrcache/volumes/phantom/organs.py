"""Lungs, heart, great vessels and the organs below the diaphragm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mitsuba_irrcache.volumes.phantom import anatomy
from mitsuba_irrcache.volumes.phantom.canvas import Canvas, Tissue
from mitsuba_irrcache.volumes.phantom.distance import (
    Ellipsoid,
    Segment,
    Solid,
    Trunk,
    chain,
    smooth_curve,
)
from mitsuba_irrcache.volumes.phantom.vessels import vessel_tree

PLEURA = Trunk(
    np.array(
        [
            *(row for row in anatomy.CAGE.inset(anatomy.PLEURA_DEPTH).profile if row[0] < 280),
            (288, 49, 18, -28, 52),
            (298, 42, 20, -12, 45),
            (305, 33, 21, 4, 37),
            (310, 18, 21, 14, 28),
        ]
    ),
    exponent=2.3,
)

# The diaphragm's domes: right, left, and the central tendon that carries the heart.
DOMES = (
    Ellipsoid((-66, -4, 28), (70, 92, 84)),
    Ellipsoid((68, -2, 24), (66, 88, 76)),
    Ellipsoid((6, -22, 36), (78, 70, 62)),
)
DIAPHRAGM_THICKNESS = 4.0

HEART_AXIS = (0.80, -0.42, -0.43)
HEART = (
    Ellipsoid((22, -40, 134), (66, 46, 44), HEART_AXIS),
    Ellipsoid((-14, -32, 146), (36, 40, 42)),
)
LEFT_VENTRICLE = Ellipsoid((44, -42, 122), (44, 29, 29), HEART_AXIS)
LEFT_VENTRICLE_POOL = Ellipsoid((42, -41, 123), (34, 19, 19), HEART_AXIS)
RIGHT_VENTRICLE_POOL = Ellipsoid((18, -66, 126), (38, 13, 26), (0.86, -0.2, -0.47))
RIGHT_ATRIUM_POOL = Ellipsoid((-32, -34, 142), (17, 23, 29))
LEFT_ATRIUM_POOL = Ellipsoid((6, -4, 158), (31, 17, 20))

AORTA = (
    ((16, -38, 152), 14),
    ((-6, -46, 175), 16),
    ((-18, -42, 203), 15.5),
    ((-12, -26, 228), 14.5),
    ((4, 0, 238), 13.5),
    ((19, 24, 226), 13),
    ((25, 34, 200), 12.5),
    ((24, 34, 160), 12),
    ((18, 24, 110), 11.5),
    ((10, 12, 60), 10.5),
    ((6, 4, 20), 10),
    ((4, 2, -10), 9.5),
)
ARCH_BRANCHES = (
    (((-10, -24, 236), 6.5), ((-18, -26, 262), 6), ((-30, -22, 292), 5), ((-34, -4, 330), 3.6)),
    (((2, -6, 246), 4.5), ((10, -10, 272), 4), ((22, -10, 300), 3.6), ((28, -6, 335), 3.4)),
    (((12, 12, 242), 5), ((24, 8, 270), 5), ((44, 2, 292), 4.6), ((80, -2, 292), 4)),
    (((-28, -22, 290), 4.5), ((-50, -6, 296), 4.4), ((-80, -4, 292), 4)),
)
PULMONARY_ARTERIES = (
    (((24, -62, 150), 14), ((26, -50, 176), 14), ((20, -24, 196), 13)),
    (((20, -24, 196), 11), ((-6, -12, 194), 10.5), ((-40, -4, 188), 9), ((-58, 2, 178), 6.5)),
    (((20, -24, 196), 11), ((36, 0, 202), 10), ((54, 14, 194), 8), ((62, 18, 180), 6.5)),
)
PULMONARY_VEINS = (
    (((-14, 0, 164), 6), ((-46, -8, 168), 5.5)),
    (((-14, 4, 152), 6), ((-46, 18, 148), 5.5)),
    (((26, 0, 166), 6), ((54, -6, 172), 5.5)),
    (((26, 4, 154), 6), ((56, 18, 150), 5.5)),
)
VENAE_CAVAE = (
    (((-32, -30, 158), 10), ((-34, -32, 200), 9.5), ((-30, -34, 240), 9), ((-30, -36, 264), 8)),
    (((-30, -36, 262), 7.5), ((-36, -34, 285), 6.5), ((-46, -26, 330), 6)),
    (((-30, -40, 252), 7), ((4, -46, 262), 7), ((34, -40, 280), 6.5), ((44, -24, 330), 6)),
    (((-26, -18, 130), 12), ((-26, -4, 104), 11), ((-24, 4, 50), 11), ((-20, 8, -10), 11)),
)
TRACHEA = (((0, -14, 340), 8.5), ((0, -4, 290), 8.5), ((1, 6, 240), 8.5), ((2, 12, 216), 9))
BRONCHI = (
    (((2, 12, 216), 7.5), ((-24, 14, 200), 6.5), ((-44, 14, 188), 5.0), ((-58, 14, 160), 3.2)),
    (((2, 12, 216), 7.0), ((28, 16, 196), 6.0), ((50, 20, 184), 4.8), ((62, 24, 158), 3.2)),
    (((-40, 14, 191), 4.0), ((-60, 0, 210), 2.6)),
    (((46, 19, 187), 4.0), ((64, 4, 206), 2.6)),
)
HILA = {anatomy.RIGHT: (-54.0, 4.0, 180.0), anatomy.LEFT: (58.0, 15.0, 182.0)}

LIVER = (
    Ellipsoid((-72, -2, 40), (72, 88, 76)),
    Ellipsoid((-4, -42, 66), (54, 38, 28), (1, -0.1, 0.15)),
)
STOMACH = (Ellipsoid((62, -30, 58), (40, 46, 42)), Ellipsoid((40, -52, 20), (44, 30, 34)))
STOMACH_BUBBLE = (Ellipsoid((64, -46, 72), (30, 24, 22)),)
SPLEEN = (Ellipsoid((98, 34, 52), (24, 42, 46)),)
KIDNEYS = (Ellipsoid((-54, 44, 6), (22, 24, 44)), Ellipsoid((54, 44, 6), (22, 24, 44)))
# In painting order.
ABDOMINAL_ORGANS = (
    (STOMACH, anatomy.FLUID),
    (STOMACH_BUBBLE, anatomy.AIR),
    (LIVER, anatomy.LIVER),
    (SPLEEN, anatomy.SPLEEN),
    (KIDNEYS, anatomy.KIDNEY),
)


def paint_cavities(canvas: Canvas) -> None:
    """Paint the lungs, the mediastinum between them, and the organs of the upper abdomen."""
    region = canvas.region(PLEURA.bounds(), canvas.edge)
    walls = PLEURA.distance(region.x, region.y, region.z)
    domes = dome_distance(region.x, region.y, region.z)
    canvas.paint(region, lung_distance(walls, domes, region.y, region.z), anatomy.LUNG)
    for side in (anatomy.RIGHT, anatomy.LEFT):
        canvas.paint_solids(vessel_tree(HILA[side], _lung_points(side)), anatomy.VESSEL)
    # The abdomen overwrites the fat on the diaphragm, and the heart overwrites both.
    canvas.paint_solids(_mediastinal_fat(), anatomy.FAT)
    abdomen = np.maximum(walls, domes, out=domes)
    abdomen += np.float32(DIAPHRAGM_THICKNESS)
    canvas.paint(region, abdomen, anatomy.FAT)
    for solids, tissue in ABDOMINAL_ORGANS:
        _, distance = canvas.union(solids, region)
        canvas.paint(region, np.maximum(distance, abdomen, out=distance), tissue)


def dome_distance(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the signed distance in mm to the space below the diaphragm's domes."""
    z = np.maximum(z, max(dome.centre[2] for dome in DOMES))
    return np.minimum.reduce([dome.distance(x, y, z, edge=0.0) for dome in DOMES])


def lung_distance(walls: np.ndarray, domes: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the signed distance in mm to both lungs, including the mediastinum's part.

    ``walls`` and ``domes`` are the distances to the pleural walls and to the space under the domes.
    """
    # The costodiaphragmatic recess reaches lower at the back than at the front.
    floor = np.float32(0.97) * (np.float32(62) - np.float32(0.25) * y - z)
    ceiling = z - np.float32(308)
    return np.maximum(np.maximum(walls, -domes), np.maximum(floor, ceiling))


def _lung_points(side: int, count: int = 700) -> np.ndarray:
    """Return random points (count, 3) in mm inside one lung, outside of the mediastinum."""
    generator = np.random.Generator(np.random.PCG64(7 + side))
    low, high = np.array([26.0, -90.0, 45.0]), np.array([126.0, 85.0, 308.0])
    points = (low + generator.random((40 * count, 3)) * (high - low)) * (side, 1, 1)
    x, y, z = points.astype(np.float32).T
    walls, domes = PLEURA.distance(x, y, z), dome_distance(x, y, z)
    clear = lung_distance(walls, domes, y, z) < -5
    for solid in HEART:
        clear &= solid.distance(x, y, z, 1.0) > 5
    return points[clear][:count]


def paint_mediastinum(canvas: Canvas) -> None:
    """Paint the muscle beside the spine, the heart, the great vessels and the airways."""
    canvas.paint_solids(_paravertebral_muscle(), anatomy.MUSCLE)
    paint_heart(canvas)
    _paint_tubes(canvas, VENAE_CAVAE, anatomy.VENOUS_BLOOD)
    _paint_tubes(canvas, (*PULMONARY_ARTERIES, *PULMONARY_VEINS), anatomy.BLOOD)
    _paint_tubes(canvas, (AORTA, *ARCH_BRANCHES), anatomy.BLOOD)
    oesophagus = [(3, anatomy.spine_y(z) - 21, z) for z in np.linspace(90, 340, 12)]
    canvas.paint_solids(chain(oesophagus, 6.5), anatomy.MUSCLE)
    airways = (TRACHEA, *BRONCHI)
    _paint_tubes(canvas, airways, anatomy.AIRWAY_WALL, thickening=1.8)
    _paint_tubes(canvas, airways, anatomy.AIR)


def _mediastinal_fat() -> list[Solid]:
    """Return fat in the median plane, thin behind the sternum, and a pad under the heart."""
    front = chain([(0, -62, 268), (2, -72, 200), (4, -72, 110), (4, -68, 74)], 6.0, 20.0, (0, 1, 0))
    middle = chain(
        [(0, -8, 298), (0, -12, 280), (0, -16, 250), (2, -16, 200), (4, -10, 150), (4, -4, 80)],
        [24, 25, 27, 26, 22, 18],
        24.0,
        (0, 1, 0),
    )
    under_heart = Ellipsoid((22, -38, 98), (58, 40, 22))
    return [*front, *middle, under_heart]


def _paravertebral_muscle() -> list[Segment]:
    heights = np.linspace(-20, 345, 16)
    return chain([(0, anatomy.spine_y(z) + 18, z) for z in heights], 21.0, 12.0, (0, 1, 0))


def paint_heart(canvas: Canvas) -> None:
    """Paint pericardial fat, muscle and the four blood pools; the apex points left and forwards."""
    canvas.paint_solids(HEART, anatomy.FAT)
    region, distance = canvas.union(HEART)
    canvas.paint(region, distance + np.float32(3), anatomy.MYOCARDIUM)
    canvas.paint_solids([RIGHT_ATRIUM_POOL, RIGHT_VENTRICLE_POOL], anatomy.VENOUS_BLOOD)
    canvas.paint_solids([LEFT_VENTRICLE], anatomy.MYOCARDIUM)
    canvas.paint_solids([LEFT_VENTRICLE_POOL, LEFT_ATRIUM_POOL], anatomy.BLOOD)


def _paint_tubes(
    canvas: Canvas, tubes: Sequence[Sequence], tissue: Tissue, thickening: float = 0.0
) -> None:
    """Paint smoothed tubes given as rows of (point, radius)."""
    segments = []
    for tube in tubes:
        points = [point for point, _ in tube]
        radii = [radius + thickening for _, radius in tube]
        rows = np.column_stack([points, radii])
        curve = smooth_curve(rows, 6 * len(rows))
        segments += chain(curve[:, :3], curve[:, 3])
    canvas.paint_solids(segments, tissue)
