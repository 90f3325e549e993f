"""Roots of light such that what is interpolated between them has the light of the voxels.

Interpolation errs to the same side wherever light bends or ends. Between a voxel that is lit and
one that is not, interpolated roots leave a third of the light where half of it is right: a beam of
ten voxels across loses 7 % of it. In dense matter they read too much, too little where it begins.
With r interpolated linearly along each axis, the mean of r^2 over all places is that of r M r over
the voxels, M = [1/6 2/3 1/6] along each axis. To first order r sqrt(r / M r) in place of r has the
mean of r^2, the light of the voxels: as exact as sums over voxels are, also next to any voxel. (For
light e^-kx it is within 0.1, 2 and 20 % for k = 1, 2, 4 per voxel; without, 4, 16 and 57 % too
much.) On a CT head it halves the error of the image.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .grid import Grid


def unbiased(grid: Grid, values: mi.Float, known: mi.Bool, channels: int = 1) -> mi.Float:
    """In place of the ``values`` at the centres of all voxels of ``grid``, those between which
    interpolation has no error on average, to the fourth order: a twelfth of the second difference
    less along each axis along which both neighbours are ``known``. At most half of a value is taken
    away or added.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels if channels > 1 else index
    own_known = dr.gather(mi.Bool, known, voxel)
    bends, stride = mi.Float(0), mi.UInt32(1)
    for place, side in zip(grid.places(voxel), grid.sides, strict=True):
        inside = own_known & (place > 0) & (place + 1 < mi.UInt32(side))
        for there in (voxel - stride, voxel + stride):
            inside &= dr.gather(mi.Bool, known, there, inside)
        step = stride * channels
        around = [dr.gather(mi.Float, values, i, inside) for i in (index - step, index + step)]
        bends += dr.select(inside, around[0] + around[1] - 2 * values, 0)
        stride = stride * mi.UInt32(side)
    result = values - dr.clip(bends * (1 / 12), -0.5 * values, 0.5 * values)
    dr.eval(result)
    return result


def conserving(grid: Grid, roots: mi.Float, known: mi.Bool, channels: int = 1) -> mi.Float:
    """In place of the ``roots`` of all voxels of ``grid``, those that keep the light of ``known``
    voxels, along axes along which both neighbours are known.

    Noise that is not the same in neighbours counts as light that bends, and is enlarged by a third.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels if channels > 1 else index
    own_known = dr.gather(mi.Bool, known, voxel)
    spread, stride = roots, mi.UInt32(1)  # M r
    for place, side in zip(grid.places(voxel), grid.sides, strict=True):
        dr.eval(spread)
        inside = own_known & (place > 0) & (place + 1 < mi.UInt32(side))
        for there in (voxel - stride, voxel + stride):
            inside &= dr.gather(mi.Bool, known, there, inside)
        step = stride * channels
        around = [dr.gather(mi.Float, spread, i, inside) for i in (index - step, index + step)]
        bend = around[0] + around[1] - 2 * spread
        spread = spread + dr.select(inside, bend / 6, 0)
        stride = stride * mi.UInt32(side)
    result = roots * dr.select(spread > 0, dr.sqrt(roots / spread), 1)
    dr.eval(result)
    return result
