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

#: Mean relative variance of voxels above which the correction is applied in full. Around lamps in
#: anisotropic media, with a variance of 0.12, images were 0.4 to 1 % darker with 0.5 than with 0.2,
#: and are the same with smaller values.
NOISY = 0.2


def conserving(
    grid: Grid,
    roots: mi.Float,
    known: mi.Bool,
    channels: int = 1,
    share: mi.Float | None = None,
    separated: tuple[mi.Bool, mi.Bool, mi.Bool] | None = None,
) -> mi.Float:
    """Correct square ``roots`` such that interpolation preserves the values of ``known`` voxels.

    ``share`` in [0, 1], per voxel and channel, is the power to which the correction factor is
    raised; None: 1.

    The correction acts along axes along which both neighbours are known, and not ``separated`` by
    surfaces (`VoxelClasses`), where interpolation does not mix their values. Noise that differs
    between neighbours counts as curvature and is amplified by a third.
    """
    # docs/primer, eq. (2.2)
    smoothed = roots  # M r
    for second_difference in _second_differences(grid, known, channels, separated):
        dr.eval(smoothed)
        smoothed = smoothed + second_difference(smoothed) / 6
    ratio = dr.select(smoothed > 0, roots / smoothed, 1)
    factor = dr.sqrt(ratio)
    if share is not None:
        factor = dr.power(ratio, 0.5 * share)
    result = roots * dr.select(ratio > 0, factor, 1)
    dr.eval(result)
    return result


def share_of_noise(grid: Grid, variance: mi.Float, known: mi.Bool) -> mi.Float:
    """Compute the ``share`` of `conserving` per voxel, from the mean relative ``variance`` of the
    3^3 voxels around it.

    Where the variance is small, the bias of interpolated roots follows from it
    (`root_correction`), and conserving would only amplify the noise. Where few paths reach an
    emitter, some voxels are bright and most are dark: interpolated roots lose 16 % of the
    irradiance there with 16 samples per voxel.
    """
    counted = dr.select(known, mi.Float(1), 0)
    total, count = (_sums_around(grid, v) for v in (variance * counted, counted))
    share = dr.minimum(total / dr.maximum(count, 1) * (1 / NOISY), 1)
    dr.eval(share)
    return share


def _sums_around(grid: Grid, values: mi.Float) -> mi.Float:
    """Return the sum of ``values`` over the 3^3 voxels around each voxel."""
    index, stride = dr.arange(mi.UInt32, grid.voxel_count), mi.UInt32(1)
    for place, side in zip(grid.voxel_indices(index), grid.sides, strict=True):
        dr.eval(values)
        below, above = place > 0, place + 1 < mi.UInt32(side)
        total = values
        total += dr.select(below, dr.gather(mi.Float, values, index - stride, below), 0)
        total += dr.select(above, dr.gather(mi.Float, values, index + stride, above), 0)
        values, stride = total, stride * mi.UInt32(side)
    return values


def unbiased(grid: Grid, values: mi.Float, known: mi.Bool, channels: int = 1) -> mi.Float:
    """Correct ``values`` such that the mean error of trilinear interpolation is of fourth order.

    Subtracts 1/12 of the second difference along each axis along which both neighbours are
    ``known``, limited to half of the value.
    """
    axes = _second_differences(grid, known, channels)
    curvature = sum(second_difference(values) for second_difference in axes)
    result = values - dr.clip(curvature * (1 / 12), -0.5 * values, 0.5 * values)
    dr.eval(result)
    return result


def _second_differences(
    grid: Grid, known: mi.Bool, channels: int, separated: tuple | None = None
) -> Iterator[Callable]:
    """Yield for each axis a function that computes second differences along it.

    They are 0 unless both neighbours are ``known``, and not ``separated``.
    """
    index = dr.arange(mi.UInt32, grid.voxel_count * channels)
    voxel = index // channels if channels > 1 else index
    own_known, stride = dr.gather(mi.Bool, known, voxel), mi.UInt32(1)
    for axis, (place, side) in enumerate(zip(grid.voxel_indices(voxel), grid.sides, strict=True)):
        inside = own_known & (place > 0) & (place + 1 < mi.UInt32(side))
        for there in (voxel - stride, voxel + stride):
            inside &= dr.gather(mi.Bool, known, there, inside)
        if separated is not None:
            for there in (voxel - stride, voxel):
                inside &= ~dr.gather(mi.Bool, separated[axis], there, inside)
        step = stride * channels

        def second_difference(values: mi.Float, step=step, inside=inside) -> mi.Float:
            around = [dr.gather(mi.Float, values, i, inside) for i in (index - step, index + step)]
            return dr.select(inside, around[0] + around[1] - 2 * values, 0)

        yield second_difference
        stride = stride * mi.UInt32(side)
