"""The bones of the thorax: vertebrae, ribs with their cartilages, sternum and shoulder girdle."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mitsuba_irrcache.volumes.phantom import anatomy
from mitsuba_irrcache.volumes.phantom.canvas import Canvas
from mitsuba_irrcache.volumes.phantom.distance import (
    Drum,
    Ellipsoid,
    Segment,
    Solid,
    chain,
    smooth_curve,
)


@dataclass(frozen=True)
class Vertebra:
    """Heights in mm: centre ``z`` and height of the body, drop of the spinous process."""

    name: str
    z: float
    height: float
    radii: tuple[float, float]
    transverse: float
    droop: float

    @property
    def centre(self) -> np.ndarray:
        return np.array([0.0, float(anatomy.spine_y(self.z)), self.z])

    @property
    def arch_y(self) -> float:
        """Return the y of the middle of the vertebral canal."""
        return self.centre[1] + self.radii[1] + 8.0


VERTEBRAE = (
    Vertebra("C7", 319, 13, (13.5, 9.0), 30, 6),
    Vertebra("T1", 301, 15, (15.0, 10.0), 30, 10),
    Vertebra("T2", 282, 16, (14.5, 11.0), 31, 14),
    Vertebra("T3", 262, 16, (14.0, 12.0), 32, 18),
    Vertebra("T4", 242, 17, (14.0, 13.0), 32, 21),
    Vertebra("T5", 222, 17, (14.0, 14.0), 32, 23),
    Vertebra("T6", 201, 18, (14.5, 14.5), 32, 24),
    Vertebra("T7", 179, 18, (15.0, 15.0), 32, 23),
    Vertebra("T8", 157, 19, (15.5, 15.5), 31, 21),
    Vertebra("T9", 134, 19, (16.5, 15.5), 30, 17),
    Vertebra("T10", 110, 20, (17.5, 16.0), 28, 12),
    Vertebra("T11", 85, 21, (18.5, 16.0), 25, 8),
    Vertebra("T12", 59, 22, (20.0, 16.5), 23, 5),
    Vertebra("L1", 30, 24, (22.0, 17.0), 36, 3),
    Vertebra("L2", -1, 25, (23.0, 17.0), 40, 3),
)

THORACIC = {int(v.name[1:]): v for v in VERTEBRAE if v.name.startswith("T")}


@dataclass(frozen=True)
class Rib:
    """The course of a rib: its descent in mm, and the angle on the cage at which its bone ends.

    The angle is 0 at the back and 180 degrees in front. ``joint`` is the end of its cartilage on
    the left side (x, y, z in mm): at the sternum, or on the cartilage above; floating ribs have
    none. ``half_height`` and ``radius`` give the section of the flat bone.
    """

    number: int
    drop: float
    end_angle: float
    joint: tuple[float, float, float] | None = None
    half_height: float = 3.0
    radius: float = 3.2


RIBS = (
    Rib(1, 24, 138, (20, -66, 264), 3.4, 3.4),
    Rib(2, 44, 150, (17, -82, 237), 3.0, 3.3),
    Rib(3, 56, 153, (15, -87, 214)),
    Rib(4, 67, 153, (16, -90, 193)),
    Rib(5, 76, 151, (17, -92, 173)),
    Rib(6, 82, 147, (17, -93, 155)),
    Rib(7, 84, 141, (14, -94, 140)),
    Rib(8, 78, 131, (50, -92, 113)),
    Rib(9, 71, 124, (75, -84, 85)),
    Rib(10, 62, 116, (95, -71, 62), 2.9, 3.1),
    Rib(11, 54, 88, None, 2.7, 2.9),
    Rib(12, 28, 50, None, 2.3, 2.7),
)

# The sternum from the notch to the xiphoid: points (y, z), half width and radius in mm.
MANUBRIUM = ((-68, 270, 24, 5), (-76, 253, 18, 5), (-83, 238, 13, 5))
STERNUM_BODY = ((-84, 233, 11, 4.5), (-90, 200, 12, 4.5), (-93, 165, 15, 4.5), (-93, 140, 10, 4.5))
XIPHOID = ((-92, 135, 4, 2.5), (-88, 112, 3, 2.0))


def paint_skeleton(canvas: Canvas) -> None:
    """Paint cartilage first, then bone: a shell of cortical bone about a spongy core."""
    canvas.paint_solids(_discs(), anatomy.DISC)
    canvas.paint_solids(_costal_cartilages(), anatomy.CARTILAGE)
    canvas.paint_shell(_spine(), anatomy.CORTICAL_BONE, anatomy.SPONGY_BONE, 1.2)
    flat_bones = [*_ribs(), *_sternum(), *_shoulder_girdle()]
    canvas.paint_shell(flat_bones, anatomy.CORTICAL_BONE, anatomy.RIB_MARROW, 1.5)
    canvas.paint_solids(_canal(7.5), anatomy.FLUID)
    canvas.paint_solids(_canal(4.5), anatomy.CORD)


def _spine() -> list[Solid]:
    return [solid for vertebra in VERTEBRAE for solid in _vertebra(vertebra)]


def _vertebra(vertebra: Vertebra) -> list[Solid]:
    """Return body, pedicles, laminae, and the transverse, articular and spinous processes."""
    axis = anatomy.spine_axis(vertebra.z)
    body = Drum(vertebra.centre, vertebra.radii, vertebra.height / 2, axis, waist=0.12)
    back, z = vertebra.arch_y, vertebra.z
    roof = back + 10.0
    tip = (0.0, roof + 24.0 - 0.25 * vertebra.droop, z - vertebra.droop)
    solids = [body, *chain([(0, roof, z - 2), tip], [3.0, 3.4], 5.0)]
    for side in (anatomy.RIGHT, anatomy.LEFT):
        pedicle = [(side * 9.5, back - 9, z + 3), (side * 10.5, back + 3, z + 2)]
        lamina = [pedicle[-1], (0, roof, z - 3)]
        transverse = [pedicle[-1], (side * vertebra.transverse, back + 9, z + 4)]
        facet = [(side * 11, back + 5, z + 12), (side * 10, back + 6, z - 12)]
        solids += chain(pedicle, 3.6, 2.0) + chain(lamina, 2.6, 5.5)
        solids += chain(transverse, [4.0, 3.6], 1.5) + chain(facet, 3.4)
    return solids


def _discs() -> list[Solid]:
    discs = []
    for above, below in pairwise(VERTEBRAE):
        z = (above.z - above.height / 2 + below.z + below.height / 2) / 2
        gap = above.z - below.z - (above.height + below.height) / 2
        centre = np.array([0.0, float(anatomy.spine_y(z)), z])
        discs.append(Drum(centre, below.radii, gap / 2 + 1, anatomy.spine_axis(z)))
    return discs


def _canal(radius: float) -> list[Segment]:
    return chain([(0, v.arch_y, v.z) for v in VERTEBRAE], radius)


def rib_course(rib: Rib, side: int, count: int = 28) -> np.ndarray:
    """Return the centre line (count, 3) in mm of a rib's bone, from its head to its cartilage."""
    vertebra = THORACIC[rib.number]
    head = (0.85 * vertebra.radii[0] + 2, vertebra.centre[1] + 8, vertebra.z + 7)
    neck = (vertebra.transverse - 4, vertebra.arch_y + 3, vertebra.z + 6)
    angles = np.radians(np.linspace(36, rib.end_angle, 7))
    # Ribs descend steeply at the back and the side, and are nearly level in front.
    share = np.sin(angles / np.radians(rib.end_angle) * np.pi / 2) ** 1.6
    fall = rib.drop * np.where(angles < np.radians(rib.end_angle), share, 1)
    on_cage = anatomy.CAGE.on_surface(angles, vertebra.z + 6 - fall)
    course = smooth_curve([head, neck, *on_cage], count)
    return course * (side, 1, 1)


def _ribs() -> list[Segment]:
    bones = []
    for rib in RIBS:
        for side in (anatomy.RIGHT, anatomy.LEFT):
            radii = np.linspace(rib.radius, 0.92 * rib.radius, 28)
            bones += chain(rib_course(rib, side), radii, rib.half_height)
    return bones


def _costal_cartilages() -> list[Segment]:
    bars = []
    for rib in RIBS:
        if rib.joint is None:
            continue
        course = rib_course(rib, anatomy.LEFT)
        end, heading = course[-1], course[-1] - course[-3]
        joint = np.array(rib.joint, dtype=np.float64)
        onward = end + 0.25 * np.linalg.norm(joint - end) * heading / np.linalg.norm(heading)
        curve = smooth_curve([end, onward, joint], 10)
        for side in (anatomy.RIGHT, anatomy.LEFT):
            bars += chain(curve * (side, 1, 1), 3.4, 2.6)
    return bars


def _sternum() -> list[Segment]:
    bars = []
    for part in (MANUBRIUM, STERNUM_BODY, XIPHOID):
        rows = smooth_curve(part, 10)
        for (y, z, half_width, radius), (next_y, next_z, _, _) in pairwise(rows):
            bars += chain([(0, y, z), (0, next_y, next_z)], radius, half_width, (1, 0, 0))
    return bars


def _shoulder_girdle() -> list[Solid]:
    solids: list[Solid] = []
    for side in (anatomy.RIGHT, anatomy.LEFT):
        solids += _clavicle(side) + _scapula(side)
    return solids


def _clavicle(side: int) -> list[Segment]:
    """Return an S-shaped bar from the manubrium to the acromion."""
    points = [(22, -68, 274), (50, -62, 281), (85, -36, 287), (115, -14, 288), (136, 4, 287)]
    curve = smooth_curve(points, 14) * (side, 1, 1)
    return chain(curve, [7.5, 6.5, *[5.5] * 10, 6.0, 6.5])


def _scapula(side: int) -> list[Solid]:
    """Return blade between its borders, spine with acromion, coracoid, and socket."""
    mirror = (side, 1, 1)
    medial = smooth_curve([(68, 88, 268), (66, 98, 240), (72, 102, 205), (90, 100, 168)], 14)
    lateral = smooth_curve([(122, 42, 268), (122, 48, 250), (113, 76, 212), (92, 99, 168)], 14)
    medial, lateral = medial * mirror, lateral * mirror
    blade = []
    for start, end in zip(medial, lateral, strict=True):
        blade += chain([start, end], 1.9, 4.2)
    crest = [(68, 101, 238), (100, 88, 256), (128, 62, 276), (142, 34, 288), (138, 14, 289)]
    coracoid = [(120, 34, 266), (116, 16, 278), (122, 0, 270)]
    crest, coracoid = smooth_curve(crest, 12) * mirror, smooth_curve(coracoid, 8) * mirror
    borders = chain(medial, 2.6) + chain(lateral, 4.2)
    socket = Ellipsoid((side * 126, 38, 260), (6, 11, 16))
    return [*blade, *borders, *chain(crest, 3.6, 3.0), *chain(coracoid, 5.0), socket]
