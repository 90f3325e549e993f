"""How much the light that reaches a medium varies."""

from __future__ import annotations

from enum import Enum


class Detail(Enum):
    """How much the radiance that reaches a medium from outside varies with direction and position.

    It decides how large the voxels of a cache may be, and how many directions are needed.
    """

    #: the same from all directions, or none
    UNIFORM = "uniform"
    #: from environments without bright regions
    SMOOTH = "smooth"
    #: all other emitters, which cast shadows with edges
    SHARP = "sharp"
