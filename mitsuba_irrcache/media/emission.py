"""Light that media send out themselves: flames, plasma, glowing gas. Mitsuba's media have none.

The emission coefficient j is the radiance that is emitted along each unit of length [W m^-3 sr^-1,
or the scene's unit of radiance per unit of length], the same in all directions. It is the sigma_a
L_e of the paper's eq. 1, told as a whole: nothing multiplies it, so that matter without extinction
can shine too.
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

#: Voxels around a grid that still count as in it: rays end on the very faces of media.
SLACK = 1e-3


class Emission:
    """The emission coefficient at all places in media: that of ``field``, and 0 outside of its
    grid.
    """

    def __init__(self, field: Field) -> None:
        self.field, self.grid = field, field.grid
        self.channels, self.maximum = field.channels, field.maximum

    def at_world(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float | mi.Color3f:
        """Its value at the world position ``p``: a Float for one channel, else a Color3f."""
        if self.grid is None:
            return self.field.value
        u = self.grid.coordinates.point(p)
        sides = mi.Point3f([mi.Float(n) for n in self.grid.sides])
        inside = dr.all((u >= -SLACK) & (u <= sides + SLACK))
        return dr.select(inside, self.field.at(u, active & inside), 0)

    def interval(self, ray: mi.Ray3f, near: mi.Float, far: mi.Float) -> tuple[mi.Float, mi.Float]:
        """The part of a ray between ``near`` and ``far`` on which there can be light; none where it
        does not end behind its start.
        """
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
        """An unbiased estimate of int j dt from one random place, and the random generator; 0 where
        not ``active``.
        """
        if self.grid is None:
            return dr.select(active, mi.Spectrum(self.field.value) * (end - begin), 0), rng
        place = ray(dr.fma(rng.next_float32(active), end - begin, begin))
        light = mi.Spectrum(self.at_world(place, active)) * (end - begin)
        return dr.select(active, light, 0), rng

    def reaches(self, cells: Macrocells) -> mi.Bool:
        """For each of a medium's macrocells whether there may be light in it."""
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
    """Raises IrrcacheError where no part of the emission lies in a medium; ``frames`` are the
    ``to_world`` of unit cubes that enclose the media.
    """
    if not frames:
        raise IrrcacheError(
            "irrcache: there is emission, but no medium, and only media emit light. Put a medium "
            "around it; its sigma_t may be 0."
        )
    if emission.grid is not None and not any(_overlap(emission.grid, f) for f in frames):
        lower, upper = _box(emission.grid.to_world)
        raise IrrcacheError(
            f"irrcache: the emission fills {lower} to {upper}, where there is no medium, and only "
            "media emit light. Place it by its to_world in world space, or put a medium around it; "
            "its sigma_t may be 0."
        )


def _box(to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The world box around a unit cube that is placed by ``to_world``."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
    world = to_world[:3, :3] @ corners + to_world[:3, 3:]
    return world.min(axis=1), world.max(axis=1)


def _overlap(grid: Grid, frame: np.ndarray) -> bool:
    """Whether the world boxes of both meet."""
    (a, b), (c, d) = _box(grid.to_world), _box(frame)
    return bool((np.maximum(a, c) < np.minimum(b, d)).all())
