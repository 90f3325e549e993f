"""How much the radiance incident on a medium varies."""

from __future__ import annotations

from enum import Enum


class Detail(Enum):
    """How much the radiance incident on a medium varies with direction and position.

    The default voxel size of a cache and the default number of directions depend on it.
    """

    #: the same radiance from all directions, or none
    UNIFORM = "uniform"
    #: radiance of environments without bright regions
    SMOOTH = "smooth"
    #: radiance of all other emitters, whose shadows have sharp edges
    SHARP = "sharp"
