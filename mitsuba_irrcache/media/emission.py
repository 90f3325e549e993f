"""Volumetric emission (flames, plasma, glowing gas), which Mitsuba's media do not support.

The emission coefficient j is the isotropic radiance emitted per unit length [W m^-3 sr^-1, or the
scene's unit of radiance per unit of length]. It equals the product sigma_a L_e in eq. 1 of the
paper, but is specified directly, so that media without extinction can be emissive.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.boundary import safe_rcp
from mitsuba_irrcache.grids.fields import Field
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.majorants import Macrocells
from mitsuba_irrcache.grids.occupancy import active_voxels, marked

#: Tolerance around a grid [voxels] within which positions count as inside: rays end exactly on the
#: faces of media.
SLACK = 1e-3


class Emission:
    """Emission coefficient j: the value of ``field`` inside of its grid, 0 outside."""

    def __init__(self, field: Field) -> None:
        self.field, self.grid = field, field.grid
        self.channels, self.maximum = field.channels, field.maximum

    def at_world(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Evaluate j at world positions; returns a Float for one channel, else a Color3f."""
        if self.grid is None:
            return self.field.value
        inside = self.covers(p)
        return dr.select(inside, self.field.at_world(p, active & inside), 0)

    def covers(self, p: mi.Point3f) -> mi.Bool:
        """Return whether world positions are in the emissive grid; always true for constant
        emission.
        """
        if self.grid is None:
            return mi.Bool(True)
        u = self.grid.coordinates.point(p)
        sides = mi.Point3f([mi.Float(n) for n in self.grid.sides])
        return dr.all((u >= -SLACK) & (u <= sides + SLACK))

    def interval(self, ray: mi.Ray3f, near: mi.Float, far: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Clip a ray between ``near`` and ``far`` to the emissive grid; empty if end <= start."""
        if self.grid is None:
            return near, far
        origin = self.grid.coordinates.point(ray.o)
        rcp = safe_rcp(self.grid.coordinates.vector(ray.d))
        sides = mi.Point3f([mi.Float(n) for n in self.grid.sides])
        a, b = -origin * rcp, (sides - origin) * rcp
        enters, leaves = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
        return dr.maximum(near, enters), dr.minimum(far, leaves)

    def between(
        self, ray: mi.Ray3f, begin: mi.Float, end: mi.Float, rng: mi.PCG32, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.PCG32]:
        """Estimate int j dt from ``begin`` to ``end``, unbiased, from one random position.

        Returns the estimate, 0 where not ``active``, and the advanced random number generator.
        """
        if self.grid is None:
            return dr.select(active, mi.Spectrum(self.field.value) * (end - begin), 0), rng
        place = ray(dr.fma(rng.next_float32(active), end - begin, begin))
        light = mi.Spectrum(self.at_world(place, active)) * (end - begin)
        return dr.select(active, light, 0), rng

    def reaches(self, cells: Macrocells) -> mi.Bool:
        """Return for each macrocell of a medium whether it may contain emission."""
        if self.grid is None or cells.count == 1:
            return dr.full(mi.Bool, True, cells.count)
        own = SimpleNamespace(
            macrocells=Macrocells.build(self.field, None), sigma_t=self.field, boundary=None
        )
        nz, ny, nx = cells.shape
        place = np.linalg.inv(cells.coordinates.matrix) @ np.diag([nx, ny, nz, 1.0])
        grid = Grid(cells.shape, place)
        return marked(grid, active_voxels(own, grid))


def check_emission_is_within(emission: Emission, frames: Sequence[np.ndarray]) -> None:
    """Raise IrrcacheError if no part of the emission lies in a medium.

    ``frames`` are the ``to_world`` matrices (4, 4) of unit cubes that enclose the media.
    """
    if not frames:
        raise IrrcacheError(
            "irrcache: emission is set, but the scene has no medium, and only media have "
            "volumetric emission. Put a medium around it; its sigma_t may be 0."
        )
    if emission.grid is not None and not any(_overlap(emission.grid, f) for f in frames):
        lower, upper = _box(emission.grid.to_world)
        raise IrrcacheError(
            f"irrcache: the emission fills {lower} to {upper}, where there is no medium, and only "
            "media have volumetric emission. Place it by its to_world in world space, or put a "
            "medium around it; its sigma_t may be 0."
        )


def _box(to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the world bounding box of the unit cube under ``to_world``."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
    world = to_world[:3, :3] @ corners + to_world[:3, 3:]
    return world.min(axis=1), world.max(axis=1)


def _overlap(grid: Grid, frame: np.ndarray) -> bool:
    """Return whether the world bounding boxes overlap."""
    (a, b), (c, d) = _box(grid.to_world), _box(frame)
    return bool((np.maximum(a, c) < np.minimum(b, d)).all())
