"""Point-like lights: where they are, and places that keep away from them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .grid import Grid

#: A lamp is not nearer to what the cache knows than this part of a voxel's shortest edge: less than
#: the half edge that lies between voxel centres and a lamp beside a box.
LEAST = 0.25


def point_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a scene that have a place and no size."""
    flag = mi.EmitterFlags.DeltaPosition
    return [e for e in scene.emitters() if mi.has_flag(e.flags(), flag)]


def position_of(emitter: mi.Emitter) -> np.ndarray:
    """Where a point-like emitter is (3), world space."""
    params = mi.traverse(emitter)
    position = params["position"] if "position" in params else params["to_world"].translation()
    return np.array(position, dtype=np.float64).ravel()


class Places:
    """Where the light in the voxels of ``grid`` is computed: at their centres, but for those that a
    lamp is in.

    A lamp beside a medium may be in the corner of a voxel's box that the medium does not fill. At
    its centre there is no end to the light, and lookups in the medium would read some of it.
    """

    def __init__(self, scene: mi.Scene, grid: Grid) -> None:
        self.grid = grid
        lamps = [position_of(e) for e in point_lights(scene)]
        self._lamps = [mi.Point3f([dr.opaque(mi.Float, float(v)) for v in p]) for p in lamps]
        self._least = dr.opaque(mi.Float, LEAST * float(grid.voxel_size.min()))

    def of(self, voxel: mi.UInt32) -> mi.Point3f:
        """World positions for the voxels of these flat indices."""
        p = self.grid.centers(voxel)
        for lamp in self._lamps:
            way = p - lamp
            distance = dr.norm(way)
            away = dr.select(distance > 0, way / distance, mi.Vector3f(0, 0, 1))
            p = dr.select(distance < self._least, lamp + self._least * away, p)
        return p
