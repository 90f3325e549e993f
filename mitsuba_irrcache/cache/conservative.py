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

#: Relative variance of voxels from which on they conserve their light in full.
NOISY = 0.5


def conserving(
    grid: Grid, roots: mi.Float, known: mi.Bool, channels: int = 1, share: mi.Float | None = None
) -> mi.Float:
    """In place of the ``roots`` of all voxels of ``grid``, those that keep the light of ``known``
    voxels, along axes along which both neighbours are known; where there is a ``share`` in [0, 1],
    the factor that does so to this power.

    Noise that is not the same in neighbours counts as light that bends, and is enlarged by a third.
    """
    spread = _spread(grid, roots, known, channels)
    ratio = dr.select(spread > 0, roots / spread, 1)
    factor = dr.sqrt(ratio)
    if share is not None:
        place = dr.arange(mi.UInt32, dr.width(roots)) // channels
        factor = dr.power(ratio, 0.5 * dr.gather(mi.Float, share, place))
    result = roots * dr.select(ratio > 0, factor, 1)
    dr.eval(result)
    return result


def share_of_noise(grid: Grid, variance: mi.Float, known: mi.Bool) -> mi.Float:
    """How far noisy voxels are to conserve their light, from the mean relative ``variance`` of the
    voxels around each.

    Where it is small, the mean of interpolated roots is known from it (`root_correction`), and
    conserving would only enlarge the noise. Where few paths find light, some voxels are bright
    and most are dark: interpolated roots lose 16 % there with 16 samples per voxel.
    """
    counted = dr.select(known, mi.Float(1), 0)
    total, count = (_sums_around(grid, v) for v in (variance * counted, counted))
    share = dr.minimum(total / dr.maximum(count, 1) * (1 / NOISY), 1)
    dr.eval(share)
    return share


def _spread(grid: Grid, roots: mi.Float, known: mi.Bool, channels: int) -> mi.Float:
    """M r."""
    spread = roots
    for bend in _second_differences(grid, known, channels):
        dr.eval(spread)
        spread = spread + bend(spread) / 6
    return spread


def _sums_around(grid: Grid, values: mi.Float) -> mi.Float:
    """Sums over 3^3 voxels."""
    index, stride = dr.arange(mi.UInt32, grid.voxel_count), mi.UInt32(1)
    for place, side in zip(grid.places(index), grid.sides, strict=True):
        dr.eval(values)
        below, above = place > 0, place + 1 < mi.UInt32(side)
        total = values
        total += dr.select(below, dr.gather(mi.Float, values, index - stride, below), 0)
        total += dr.select(above, dr.gather(mi.Float, values, index + stride, above), 0)
        values, stride = total, stride * mi.UInt32(side)
    return values


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
