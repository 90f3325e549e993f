"""Compensation of the numerical diffusion of sources that are constant within voxels.

What collides in a voxel is scattered from all of the voxel. So each scattering displaces radiance
at random, and the medium conducts more of it than the exact one: in the diffusion limit by a
quarter of the squared optical depth of a voxel, 9 % at a depth of 0.6. The dark side of a dense
cloud would be too bright by as much. Per collision and axis, tracks have the mean square
displacement

    V = 2 / (3 tau^2) + 2 c

in voxels of the optical depth tau, instead of 2 / (3 tau^2). The excess is that of a diffusion with
the coefficient c, about 1 / 10 in thin and 1 / (4 tau) in thick voxels. It is compensated by fluxes
between neighbouring voxels, proportional to the difference of their sources (antidiffusive fluxes:
Boris and Book, *Flux-corrected transport I*, Journal of Computational Physics 11, 1973). They
preserve energy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.grids.grid import Grid

#: Coefficients of 1 / c = CONSTANT + SLOPE tau, which is within 2 % of the exact value for optical
#: depths tau up to 6 of a cubic voxel. `coefficient` limits c above a depth of about 2
#: (LARGEST_PART), and halves it at a depth of OPAQUE.
CONSTANT, SLOPE = 10.25, 3.4
#: Part of the mean square displacement per collision that may be compensated. Along few ordinates
#: and tracks, the displacement of single voxels is less than the mean, and more would make the
#: solution unstable in dense voxels (an optical depth above 2). In opaque voxels c is
#: divided by 1 + (tau / OPAQUE)^4: multigrid would converge slowly, and images show the boundary of
#: such media only.
LARGEST_PART, OPAQUE = 0.4, 6.0
#: Mean over all directions of the length of a track from its entry into a cubic voxel to the middle
#: of the slice, in units of the edge.
HALF_WAY = 0.6
#: Optical depth of a voxel below which numerical diffusion, less than 3e-4, is neglected.
NEGLIGIBLE_DEPTH = 0.03


class Antidiffusion:
    """Compensates the numerical diffusion in a grid of active voxels.

    Args:
        grid: the grid.
        sigma_t: extinction, one value for each active voxel.
        active: flat indices of the active voxels.
        active_index: function from flat indices to indices among the active voxels, which returns
            their number for others.
    """

    def __init__(
        self,
        grid: Grid,
        sigma_t: mi.Float,
        active: mi.UInt32,
        active_index: Callable[[mi.UInt32], mi.UInt32],
    ) -> None:
        self._grid, self._sigma_t = grid, sigma_t
        self._active, self._active_index = active, active_index
        deepest = dr.max(sigma_t)
        #: whether there is diffusion worth compensating
        self.is_needed = float(deepest[0]) * grid.voxel_size.max() > NEGLIGIBLE_DEPTH

    def applied(
        self, source: mi.Float, place: mi.UInt32, step: int = 1, begin: mi.UInt32 | int = 0
    ) -> mi.Float:
        """Return ``source``, radiance per optical depth, changed by antidiffusive fluxes.

        Each value belongs to the active voxel ``place``, and is at the index ``place * step +
        begin``.
        """
        # docs/primer, eq. (4.13)
        if not self.is_needed:
            return source
        lanes = place, step, begin
        dr.eval(source)
        # Smooth the source to which fluxes are in proportion. Otherwise differences that alternate
        # from voxel to voxel would be amplified by up to a factor of 2.
        smooth = source + dr.opaque(mi.Float, 1 / 12) * self._divergence(source, lanes, False)
        dr.eval(smooth)
        result = source - self._divergence(smooth, lanes, True)
        dr.eval(result)
        return result

    @staticmethod
    def at_centre(change: mi.Float, depth: mi.Float) -> mi.Float:
        """Return what a ``change`` of the source by `applied` must not add to the radiance at the
        centre of a voxel of this optical ``depth``, where the source is the original one.
        """
        return change * (1 - dr.exp(depth * dr.opaque(mi.Float, -HALF_WAY)))

    def _divergence(self, source: mi.Float, lanes: Sequence, scaled: bool) -> mi.Float:
        """Return the sum over the neighbours of a voxel of their differences from it, weighted by
        the smaller one of both extinctions over its own, and by c if ``scaled``.
        """
        place, step, begin = lanes
        count = dr.opaque(mi.UInt32, dr.width(self._active))
        own = dr.gather(mi.Float, self._sigma_t, place)
        voxel = dr.gather(mi.UInt32, self._active, place)
        at, total, stride = self._grid.voxel_indices(voxel), mi.Float(0), mi.UInt32(1)
        sides = zip(at, self._grid.sides, self._grid.voxel_size, strict=True)
        for coordinate, side, edge in sides:
            length = dr.opaque(mi.Float, float(edge))
            inside = coordinate > 0, coordinate + 1 < mi.UInt32(side)
            for exists, neighbour in zip(inside, (voxel - stride, voxel + stride), strict=True):
                index = self._active_index(dr.select(exists, neighbour, voxel))
                exists &= index < count
                weight = dr.minimum(own, dr.gather(mi.Float, self._sigma_t, index, exists))
                there = dr.gather(mi.Float, source, index * step + begin, exists)
                if scaled:
                    weight *= coefficient(weight * length)
                total += dr.select(exists, weight * (there - source), 0)
            stride *= mi.UInt32(side)
        return dr.select(own > 0, total / own, 0)


def coefficient(depth: mi.Float) -> mi.Float:
    """Return the coefficient of antidiffusion c between voxels of this optical ``depth``."""
    # docs/primer, eq. (4.12)
    constant, slope = (dr.opaque(mi.Float, v) for v in (CONSTANT, SLOPE))
    excess = dr.rcp(dr.fma(slope, depth, constant))
    exact = dr.rcp(dr.maximum(3 * dr.square(depth), 1e-6))  # half of 2 / (3 tau^2)
    limit = dr.opaque(mi.Float, LARGEST_PART) * (excess + exact)
    opaque = dr.square(dr.square(depth * dr.opaque(mi.Float, 1 / OPAQUE)))
    return dr.minimum(excess, limit) / (1 + opaque)
