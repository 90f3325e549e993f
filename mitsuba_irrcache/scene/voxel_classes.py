"""Where the voxels of a cache lie among surfaces and media."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.grids.grid import Grid


class VoxelClasses:
    """Where the voxels of ``grid`` are.

    ``place`` is 0 for a voxel whose centre is in no medium, else 1 for the first of the scene's,
    and so on. ``reach`` are those that a lookup in the cache's medium can read: some of it lies in
    them (``within``) or in a neighbour. ``enclosed`` are those that see nothing but the backs of
    surfaces. ``edges`` are the surfaces between voxels, None where there are none.
    """

    def __init__(
        self,
        grid: Grid,
        place: mi.UInt32,
        within: mi.Bool,
        enclosed: mi.Bool,
        edges: object | None = None,
    ) -> None:
        self.grid, self.place, self.enclosed, self.edges = grid, place, enclosed, edges
        total, _ = neighbourhood(grid, dr.select(within, mi.Float(1), 0), within)
        self.reach = within | (total > 0)
        dr.eval(self.reach)

    def filled(self, values: mi.Float, channels: int) -> mi.Float:
        """Values of all voxels, the means of their neighbours' for those inside of opaque things:
        of a curved surface, `edges` leave a little to be read there.
        """
        voxel = dr.arange(mi.UInt32, self.grid.voxel_count)
        lit = mi.Bool(False)
        for c in range(channels):
            lit |= dr.gather(mi.Float, values, voxel * channels + c) > 0
        known = lit | ~self.enclosed
        dr.eval(known)
        total, weights = neighbourhood(self.grid, values, known, channels)
        own = dr.gather(mi.Bool, known, dr.arange(mi.UInt32, dr.width(values)) // channels)
        own |= weights == 0
        result = dr.select(own, values, total / dr.select(own, 1, weights))
        dr.eval(result)
        return result


def neighbourhood(
    grid: Grid, values: mi.Float, valid: mi.Bool, channels: int = 1
) -> tuple[mi.Float, mi.Float]:
    """Sums of ``values`` over the valid ones of the 26 neighbours of each voxel, nearer ones
    weighing more, and the sums of weights.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels
    channel = index - voxel * channels
    places = [mi.Int32(p) for p in grid.places(voxel)]
    nx, ny, _ = grid.sides
    total, weights = mi.Float(0), mi.Float(0)
    for step in np.ndindex(3, 3, 3):
        offset = [s - 1 for s in step]
        squared = sum(o * o for o in offset)
        if not squared:
            continue
        at = [p + o for p, o in zip(places, offset, strict=True)]
        inside = mi.Bool(True)
        for a, side in zip(at, grid.sides, strict=True):
            inside &= (a >= 0) & (a < side)
        there = mi.UInt32((at[2] * ny + at[1]) * nx + at[0])
        inside &= dr.gather(mi.Bool, valid, there, inside)
        value = dr.gather(mi.Float, values, there * channels + channel, inside)
        total += dr.select(inside, value / squared, 0)
        weights += dr.select(inside, mi.Float(1 / squared), 0)
    return total, weights
