"""Where the voxels of a cache lie among surfaces and media, and what is done about those behind."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .grid import Grid


class Survey:
    """Where the voxels of ``grid`` are.

    ``place`` is 0 for a voxel whose centre is in no medium, else 1 for the first of the scene's,
    and so on. ``hidden`` are voxels inside of closed surfaces: what is known there must not be
    looked up from the other side. ``reach`` are those that a lookup in the cache's medium can read:
    some of it lies in them (``within``) or in a neighbour. ``edges`` are the surfaces between
    voxels.
    """

    def __init__(
        self,
        grid: Grid,
        place: mi.UInt32,
        within: mi.Bool,
        hidden: mi.Bool,
        edges: object | None = None,
    ) -> None:
        self.grid, self.place, self.hidden, self.edges = grid, place, hidden, edges
        total, _ = neighbourhood(grid, dr.select(within, mi.Float(1), 0), within)
        self.reach = within | (total > 0)
        dr.eval(self.reach)

    def filled(self, values: mi.Float, active: mi.UInt32, channels: int) -> mi.Float:
        """Values of all voxels, the hidden ones' replaced by means of those of their ``active``
        neighbours that are not, where there are any.
        """
        known = dr.zeros(mi.Bool, self.grid.voxel_count)
        dr.scatter(known, mi.Bool(True), active)
        known &= ~self.hidden
        dr.eval(known)
        total, weights = neighbourhood(self.grid, values, known, channels)
        voxel = dr.arange(mi.UInt32, self.grid.voxel_count * channels) // channels
        own = ~dr.gather(mi.Bool, self.hidden, voxel) | (weights == 0)
        return dr.select(own, values, total / dr.select(own, 1, weights))


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
        x, y, z = (p + o for p, o in zip(places, offset, strict=True))
        inside = (x >= 0) & (y >= 0) & (z >= 0)
        for at, side in zip((x, y, z), grid.sides, strict=True):
            inside &= at < side
        there = mi.UInt32((z * ny + y) * nx + x)
        inside &= dr.gather(mi.Bool, valid, there, inside)
        value = dr.gather(mi.Float, values, there * channels + channel, inside)
        total += dr.select(inside, value / squared, 0)
        weights += dr.select(inside, mi.Float(1 / squared), 0)
    return total, weights
