"""Correct interpolated values such that interpolation preserves the mean over the voxels.

Trilinear interpolation has a systematic error where values are curved or discontinuous. Between a
voxel with and one without irradiance, interpolated square roots yield a third instead of half of
it: a beam ten voxels wide loses 7 %. Inside dense media they yield too much, near the boundary too
little. For r interpolated linearly along each axis, the mean of r^2 equals that of r M r over the
voxels, with M = [1/6 2/3 1/6] along each axis. Replacing r by r sqrt(r / M r) therefore preserves
the mean of r^2 to first order, also next to every voxel. (For e^-kx the error is below 0.1, 2 and
20 % for k = 1, 2, 4 per voxel; without correction it is 4, 16 and 57 %.) On a CT head the
correction halves the error of the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.grids.grid import Grid


def conserving(grid: Grid, roots: mi.Float, known: mi.Bool, channels: int = 1) -> mi.Float:
    """Correct square ``roots`` such that interpolation preserves the values of ``known`` voxels.

    The correction acts along axes along which both neighbours are known. Noise that differs between
    neighbours counts as curvature and is amplified by a third.
    """
    smoothed = roots  # M r
    for second_difference in _second_differences(grid, known, channels):
        dr.eval(smoothed)
        smoothed = smoothed + second_difference(smoothed) / 6
    result = roots * dr.select(smoothed > 0, dr.sqrt(roots / smoothed), 1)
    dr.eval(result)
    return result


def unbiased(grid: Grid, values: mi.Float, known: mi.Bool, channels: int = 1) -> mi.Float:
    """Correct ``values`` such that interpolation has no mean error up to fourth order.

    Subtracts 1/12 of the second difference along each axis along which both neighbours are
    ``known``, limited to half of the value.
    """
    axes = _second_differences(grid, known, channels)
    curvature = sum(second_difference(values) for second_difference in axes)
    result = values - dr.clip(curvature * (1 / 12), -0.5 * values, 0.5 * values)
    dr.eval(result)
    return result


def _second_differences(grid: Grid, known: mi.Bool, channels: int) -> Iterator[Callable]:
    """Yield for each axis a function that computes second differences along it.

    They are 0 unless both neighbours are ``known``.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels if channels > 1 else index
    own_known, stride = dr.gather(mi.Bool, known, voxel), mi.UInt32(1)
    for place, side in zip(grid.places(voxel), grid.sides, strict=True):
        inside = own_known & (place > 0) & (place + 1 < mi.UInt32(side))
        for there in (voxel - stride, voxel + stride):
            inside &= dr.gather(mi.Bool, known, there, inside)
        step = stride * channels

        def second_difference(values: mi.Float, step=step, inside=inside) -> mi.Float:
            around = [dr.gather(mi.Float, values, i, inside) for i in (index - step, index + step)]
            return dr.select(inside, around[0] + around[1] - 2 * values, 0)

        yield second_difference
        stride = stride * mi.UInt32(side)
