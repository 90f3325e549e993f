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

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.grids.grid import Grid


def conserving(grid: Grid, roots: mi.Float, known: mi.Bool, channels: int = 1) -> mi.Float:
    """In place of the ``roots`` of all voxels of ``grid``, those that keep the light of ``known``
    voxels, along axes along which both neighbours are known.

    Noise that is not the same in neighbours counts as light that bends, and is enlarged by a third.
    """
    # docs/primer, eq. (2.2)
    spread = roots  # M r
    for bend in _second_differences(grid, known, channels):
        dr.eval(spread)
        spread = spread + bend(spread) / 6
    result = roots * dr.select(spread > 0, dr.sqrt(roots / spread), 1)
    dr.eval(result)
    return result


def unbiased(grid: Grid, values: mi.Float, known: mi.Bool, channels: int = 1) -> mi.Float:
    """In place of the ``values`` at the centres of all voxels of ``grid``, those between which
    interpolation has no error on average, to the fourth order: a twelfth of the second difference
    less along each axis along which both neighbours are ``known``. At most half of a value is taken
    away or added.
    """
    bends = sum(bend(values) for bend in _second_differences(grid, known, channels))
    result = values - dr.clip(bends * (1 / 12), -0.5 * values, 0.5 * values)
    dr.eval(result)
    return result


def _second_differences(grid: Grid, known: mi.Bool, channels: int) -> Iterator[Callable]:
    """For each axis a function that takes second differences of values along it, 0 where not both
    neighbours are ``known``.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels if channels > 1 else index
    own_known, stride = dr.gather(mi.Bool, known, voxel), mi.UInt32(1)
    for place, side in zip(grid.places(voxel), grid.sides, strict=True):
        inside = own_known & (place > 0) & (place + 1 < mi.UInt32(side))
        for there in (voxel - stride, voxel + stride):
            inside &= dr.gather(mi.Bool, known, there, inside)
        step = stride * channels

        def bend(values: mi.Float, step=step, inside=inside) -> mi.Float:
            around = [dr.gather(mi.Float, values, i, inside) for i in (index - step, index + step)]
            return dr.select(inside, around[0] + around[1] - 2 * values, 0)

        yield bend
        stride = stride * mi.UInt32(side)
