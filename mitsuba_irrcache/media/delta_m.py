"""Truncation of sharp forward peaks (delta-M, Wiscombe 1977) with TMS correction (Nakajima 1988).

A sharp phase function scatters a fraction f almost straight ahead, which is treated as unscattered.
The medium

    sigma_t' = sigma_t (1 - f albedo),   albedo' = albedo (1 - f) / (1 - f albedo)

with the phase function moments (g_l - f) / (1 - f) has the same radiance up to a blur of a few
degrees, and requires as few moments as a broad phase function. f is the first moment that is
truncated. Single scattering of narrow light sources uses the original phase function over 1 - f.

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
from mitsuba_irrcache.media.medium import MediumGrid


def without_forward_peak(medium: MediumGrid) -> MediumGrid:
    """``medium``, whose phase function has a forward peak, scaled by delta-M: light scattered into
    the peak counts as not scattered.
    """
    # docs/primer, eq. (4.12)
    phase = medium.phase.without_peak()
    share, sigma_t, albedo = phase.forward, medium.sigma_t, medium.albedo
    scaled = _combined(lambda s, a: s * (1 - share * a), sigma_t, albedo)
    remaining = _mean(scaled)
    return medium.replaced(
        sigma_t=scaled,
        albedo=_combined(lambda a: a * (1 - share) / (1 - share * a), albedo),
        phase=phase,
        unscattered_exponent=_mean(sigma_t) / remaining if remaining else 1.0,
        original=medium,
    )


def _mean(field: Field) -> float:
    if field.grid is None:
        return 0.5 * (field.minimum + field.maximum)
    return float(dr.mean(field.data)[0] * field.scale[0])


def _combined(function: Callable, *fields: Field) -> Field:
    """Apply ``function`` to the values of ``fields`` on the first grid that one of them has."""
    channels = max(field.channels for field in fields)
    grid = next((field.grid for field in fields if field.grid is not None), None)
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
