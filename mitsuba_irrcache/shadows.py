"""Light that ends between two voxels: at the edge of a shadow, or of a beam.

Interpolated roots fall faster than the light does there. Between a voxel that is lit and one that
is not they leave a third of the light, where half of it is right: a beam of ten voxels across
loses 7 % of its light. Where no matter in between explains the difference, voxels on the bright
side are raised by what is lost.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .edges import Edges
from .grid import Grid
from .lamps import point_lights
from .layers import luminance
from .medium import MediumGrid

#: Roots that differ by less than this times the optical depth between two voxels, relative to the
#: larger one, do so since light falls off in matter: interpolation is right there.
EXPLAINED = 2.0
#: Squared differences below so many times their variance are noise.
NOISE = 4.0


class Shadows:
    """What keeps the light at the edges of shadows, in a cache over ``grid`` in ``medium``; next to
    ``edges``, across which nothing is interpolated, there is nothing to keep.
    """

    def __init__(self, medium: MediumGrid, grid: Grid, edges: Edges | None = None) -> None:
        self.medium, self.grid, self._edges = medium, grid, edges

    @classmethod
    def of(
        cls, scene: mi.Scene, medium: MediumGrid, grid: Grid, edges: Edges | None = None
    ) -> Shadows | None:
        """None where nothing casts shadows and no light is a beam."""
        beams = any("Point" not in light.class_name() for light in point_lights(scene))
        return None if medium.alone and not beams else cls(medium, grid, edges)

    def corrected(
        self, roots: mi.Float, noise: mi.Float, active: mi.UInt32, channels: int
    ) -> mi.Float:
        """The ``roots`` of the voxels' light such that these, interpolated and squared, have its
        mean; ``noise`` is its relative variance, ``active`` are the voxels that have light.

        The squares of a trilinear interpolant of r have the mean of r M r, with M = [1/6 2/3 1/6]
        along each axis; those of r sqrt(r / M r), to first order, that of r^2.
        """
        grid, count = self.grid, self.grid.voxel_count
        sigma_t = self.medium.sigma_t.at_world(grid.centers(dr.arange(mi.UInt32, count)))
        depth = EXPLAINED * luminance(mi.Spectrum(sigma_t))
        known = dr.zeros(mi.Bool, count)
        away = mi.Bool(True) if self._edges is None else ~self._edges.touch(active)
        dr.scatter(known, away, active)
        dr.eval(depth, known)
        index = dr.arange(mi.UInt32, count * channels)
        voxel = index // channels
        channel = index - voxel * channels
        places = grid.places(voxel)
        own, own_depth, own_known = roots, *(dr.gather(type(v), v, voxel) for v in (depth, known))
        deviation = dr.square(own) * noise * 0.25
        swept, stride = own, mi.UInt32(1)
        for place, side, edge in zip(places, grid.sides, grid.voxel_size, strict=True):
            half_edge = dr.opaque(mi.Float, 0.5 * float(edge))
            dr.eval(swept, deviation)
            added = mi.Float(0)
            for ahead in (False, True):
                inside = own_known & (place + 1 < mi.UInt32(side) if ahead else place > 0)
                there = dr.select(inside, voxel + stride if ahead else voxel - stride, voxel)
                inside &= dr.gather(mi.Bool, known, there)
                matter = (own_depth + dr.gather(mi.Float, depth, there)) * half_edge
                there = there * channels + channel
                other = dr.gather(mi.Float, roots, there)
                spread = deviation + dr.gather(mi.Float, deviation, there)
                squared = dr.square(own - other)
                explained = dr.square(matter * dr.maximum(own, other))
                found = dr.maximum(squared - NOISE * spread, 0)
                share = dr.select(found > 0, found / (squared + explained), 0)
                apart = dr.gather(mi.Float, swept, there) - swept
                added += dr.select(inside, apart * share / 6, 0)
            swept = swept + added
            stride = stride * mi.UInt32(side)
        result = own * dr.select(swept > 0, dr.sqrt(own / dr.select(swept > 0, swept, 1)), 1)
        dr.eval(result)
        return result
