"""Measures of the phantom in mm and HU, shared by its organ systems.

Axes are LPS about the body: +x to the patient's left, +y backwards, +z upwards; x = 0 is the median
plane, z = 0 lies in the second lumbar vertebra and z = 330 in the neck.
"""

from __future__ import annotations

import numpy as np

from mitsuba_irrcache.volumes.phantom.canvas import Tissue
from mitsuba_irrcache.volumes.phantom.distance import Trunk
from mitsuba_irrcache.volumes.phantom.splines import monotone

LOWER = (-190.0, -120.0, 0.0)
UPPER = (190.0, 120.0, 330.0)
WHOLE = (np.array(LOWER), np.array(UPPER))

LEFT, RIGHT = 1, -1

AIR = Tissue(-1000)
SKIN = Tissue(20, 5)
FAT = Tissue(-100, 16)
MUSCLE = Tissue(50, 16)
LUNG = Tissue(-860, 40)
VESSEL = Tissue(120, 10)
AIRWAY_WALL = Tissue(30)
BLOOD = Tissue(210, 14)
VENOUS_BLOOD = Tissue(150, 12)
MYOCARDIUM = Tissue(90, 12)
LIVER = Tissue(105, 14)
SPLEEN = Tissue(120, 10)
KIDNEY = Tissue(160, 14)
FLUID = Tissue(15, 8)
CARTILAGE = Tissue(125, 16)
DISC = Tissue(85, 12)
CORD = Tissue(40, 5)
SPONGY_BONE = Tissue(320, 90)
RIB_MARROW = Tissue(360, 90)
CORTICAL_BONE = Tissue(1050, 60)

# Rows for Trunk: z, half width, y of the widest place, y of the front, y of the back.
TORSO = Trunk(
    np.array(
        [
            (0, 152, 5, -98, 90),
            (60, 158, 5, -106, 98),
            (120, 163, 5, -112, 108),
            (180, 167, 8, -114, 112),
            (230, 171, 10, -106, 110),
            (262, 173, 12, -94, 104),
            (280, 165, 14, -80, 96),
            (296, 136, 14, -64, 89),
            (312, 92, 14, -54, 80),
            (330, 66, 12, -50, 70),
        ]
    )
)

# The surface that contains the centre lines of the ribs.
CAGE = Trunk(
    np.array(
        [
            (0, 118, 10, -70, 70),
            (45, 127, 8, -80, 77),
            (90, 132, 4, -88, 84),
            (128, 131, 2, -92, 88),
            (152, 127, 2, -92, 90),
            (177, 121, 2, -90, 91),
            (203, 113, 3, -87, 89),
            (229, 101, 5, -81, 84),
            (256, 84, 8, -70, 76),
            (275, 66, 12, -52, 67),
            (288, 54, 16, -36, 60),
            (306, 44, 20, -10, 52),
        ]
    ),
    exponent=2.3,
)

# Depth of the pleura below the centre lines of the ribs.
PLEURA_DEPTH = 7.0

# The centre of the vertebral bodies: z, y (thoracic kyphosis, lumbar and cervical lordosis).
SPINE = np.array(
    [(-20, 27), (0, 28), (31, 33), (60, 40), (110, 49), (178, 54), (240, 46), (281, 33), (330, 12)]
)


def spine_y(z: np.ndarray | float) -> np.ndarray:
    """Return the y of the centre of the vertebral column at height ``z``, mm."""
    return monotone(SPINE[:, 0], SPINE[:, 1])(np.clip(z, SPINE[0, 0], SPINE[-1, 0]))


def spine_axis(z: float) -> np.ndarray:
    """Return the unit vector along the vertebral column, upwards, at height ``z``."""
    direction = np.array([0.0, float(spine_y(z + 5) - spine_y(z - 5)), 10.0])
    return direction / np.linalg.norm(direction)
