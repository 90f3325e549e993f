"""Truncation of sharp forward peaks (delta-M, Wiscombe 1977) with TMS correction (Nakajima 1988).

A sharp phase function scatters a fraction f almost straight ahead, which is treated as unscattered.
The medium

    sigma_t' = sigma_t (1 - f albedo),   albedo' = albedo (1 - f) / (1 - f albedo)

with the phase function moments (g_l - f) / (1 - f) has the same radiance up to a blur of a few
degrees, and requires as few moments as a broad phase function. f is the first truncated moment.
Single scattering of narrow sources uses the original phase function divided by 1 - f.

Transmittance therefore treats scattering into the peak as unscattered, with two exceptions: narrow
sources seen directly through the medium are attenuated by the original extinction; and paths from
surfaces, which receive radiance from all directions, exclude the peak from scattering.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.grids.fields import ConstantField, Field, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid, Unscaled

#: Numbers of parts into which a voxel of the albedo is divided along each axis to evaluate the
#: scaled medium, in the order in which they are tried; and the number of voxels above which no
#: finer division is tried.
PARTS, MOST_VOXELS = (1, 3, 5, 9), 1 << 22
#: Mean relative error of the interpolated extinction and scattering below which a division
#: suffices, and above which a warning is logged; number of random positions that estimate it.
SMALL_ERROR, LARGE_ERROR, CHECKS = 0.002, 0.01, 4096


def without_forward_peak(medium: MediumGrid) -> MediumGrid:
    """Return ``medium``, whose phase function has a forward peak, scaled by delta-M.

    Radiance scattered into the peak counts as unscattered.
    """
    # docs/primer, eq. (4.14)
    phase = medium.phase.without_peak()
    scaled, albedo = _scaled(medium, phase.forward)
    exponent = None
    if medium.albedo.grid is None:
        exponent = 1 / (1 - phase.forward * np.array(medium.albedo.value, np.float64).ravel())
    return medium.replaced(
        sigma_t=scaled,
        albedo=albedo,
        phase=phase,
        unscaled=Unscaled(medium, exponent),
    )


def _scaled(medium: MediumGrid, share: float) -> tuple[Field, Field]:
    """Return the scaled extinction and albedo, for a peak with this ``share`` f of the phase
    function.

    They are not linear in the fields of ``medium``: where its albedo varies, they are evaluated on
    finer voxels, until their interpolation preserves scattering and absorption.
    """
    sigma_t, albedo = medium.sigma_t, medium.albedo
    share = dr.opaque(mi.Float, share)  # kernels do not depend on its value
    for parts in PARTS:
        grids = [f.grid and _divided(f.grid, albedo.grid, parts) for f in (sigma_t, albedo)]
        if parts > 1 and max(g.voxel_count for g in grids if g is not None) > MOST_VOXELS:
            break
        remaining = _combined(
            lambda s, a: s * (1 - share * a), grids[0] or grids[1], sigma_t, albedo
        )
        scattering = _combined(lambda a: a * (1 - share) / (1 - share * a), grids[1], albedo)
        error = _error_of_interpolation(medium, share, remaining, scattering)
        if error < SMALL_ERROR:
            return remaining, scattering
    if error > LARGE_ERROR:
        mi.Log(
            mi.LogLevel.Warn,
            f'irrcache: the albedo of medium "{medium.name}" differs so much between neighbouring '
            f"voxels that scattering between them is wrong by about {100 * error:.1f} % once the "
            "forward peak of its phase function is truncated. Interpolate the data to finer "
            "voxels, or use a phase function without a sharp peak.",
        )
    return remaining, scattering


def _divided(grid: Grid, albedo: Grid | None, parts: int) -> Grid:
    """Return ``grid`` with voxels divided such that their edges are at most 1 / ``parts`` of the
    edges of the voxels of ``albedo``.

    Each voxel is divided into an odd number of parts along each axis: its centre remains a voxel
    centre, so that fields that are linear between the voxels stay the same.
    """
    if albedo is None or parts == 1:
        return grid
    ratio = grid.voxel_size / albedo.voxel_size
    if grid is not albedo:
        ratio = np.maximum(grid.voxel_size / albedo.voxel_size.min(), 1)
    odd = 2 * np.ceil((parts * ratio - 1 - 1e-6) / 2).astype(int) + 1
    odd = np.where(grid.resolution == 1, 1, odd) if grid is albedo else odd
    return Grid(tuple(int(n) for n in (grid.resolution * odd)[::-1]), grid.to_world)


def _error_of_interpolation(
    medium: MediumGrid, share: mi.Float, remaining: Field, scattering: Field
) -> float:
    """Estimate the relative error of the scaled extinction and scattering coefficient, the larger
    of the two, by their mean deviation at random positions in the medium.
    """
    if medium.albedo.grid is None:
        return 0.0
    rng = mi.PCG32(CHECKS)
    u = mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    p = Grid((1, 1, 1), medium.frame).world.point(u)
    sigma_t, albedo = (
        mi.Spectrum(medium.sigma_t.at_world(p)),
        mi.Spectrum(medium.albedo.at_world(p)),
    )
    new, found = mi.Spectrum(remaining.at_world(p)), mi.Spectrum(scattering.at_world(p))
    errors = []
    for value, exact in (
        (new, sigma_t * (1 - share * albedo)),
        (new * found, sigma_t * albedo * (1 - share)),
    ):
        apart, total = np.abs(np.array(value) - np.array(exact)).sum(), np.array(exact).sum()
        errors.append(float(apart / total) if total > 0 else 0.0)
    return max(errors)


def _combined(function: Callable, grid: Grid | None, *fields: Field) -> Field:
    """Apply ``function`` to the values of ``fields`` at the voxels of ``grid``; None: all fields
    are constant. Returns the field of the results.
    """
    channels = max(field.channels for field in fields)
    index = dr.arange(mi.UInt32, 1 if grid is None else grid.voxel_count)
    known = [_channels(field, grid, index, channels) for field in fields]
    values = [function(*of_channel) for of_channel in zip(*known, strict=True)]
    dr.eval(values)
    if grid is None:
        return ConstantField(np.array([v[0] for v in values], dtype=np.float64))
    data = interleaved(values, grid.voxel_count)
    dr.eval(data)
    return GridField(grid, data, channels)


def _channels(field: Field, grid: Grid | None, index: mi.UInt32, count: int) -> list[mi.Float]:
    """Evaluate ``count`` channels of a field at the voxel centres of ``grid``."""
    place = mi.Point3f(0)
    if grid is not None:
        place = grid.world.point(mi.Point3f(*grid.voxel_indices(index)) + 0.5)
    value = field.at_world(place)
    channels = [value] if field.channels == 1 else list(value)
    return [mi.Float(channels[min(c, field.channels - 1)]) for c in range(count)]
