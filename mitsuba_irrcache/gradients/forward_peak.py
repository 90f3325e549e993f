"""The transpose of delta-M scaling (`media/delta_m`).

It converts derivatives with respect to the scaled medium, whose phase function has no forward peak,
to derivatives with respect to the medium of the scene.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.parameters import ALBEDO, MEAN_COSINE, SIGMA_T
from mitsuba_irrcache.gradients.splatting import GridSplat
from mitsuba_irrcache.grids.fields import ConstantField, Field, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid


def with_forward_peak(
    medium: MediumGrid,
    found: dict[str, mi.Float],
    channels: int,
    wanted: dict[str, int],
    change: float = 0.0,
) -> dict[str, mi.Float]:
    """Return derivatives with respect to ``medium.original``, by role, as flat arrays.

    Args:
        medium: the scaled medium.
        found: derivatives with respect to the extinction and albedo of ``medium``, by role, at the
            voxels of their data; and, at fixed extinction and albedo, the mean cosine.
        channels: number of channels of ``found``.
        wanted: number of channels of each derivative to return, by role: `SIGMA_T`, `ALBEDO`,
            `MEAN_COSINE`; other roles are returned as they are.
        change: derivative of the share of the forward peak with respect to the mean cosine.
    """
    # docs/primer, eq. (8.14)
    share, field = dr.opaque(mi.Float, medium.phase.forward), medium.sigma_t
    p = _positions(field.grid)
    by_sigma_t = _channels(found[SIGMA_T], channels)
    sigma_t, albedo = (
        list(mi.Spectrum(f.at_world(p))) for f in (medium.original.sigma_t, medium.original.albedo)
    )
    result = {role: values for role, values in found.items() if role in wanted}
    if SIGMA_T in wanted:
        values = [(1 - share * a) * d for a, d in zip(albedo, by_sigma_t, strict=False)]
        result[SIGMA_T] = _at_data(medium.original.sigma_t, p, values, wanted[SIGMA_T])
    by_share = 0.0
    if MEAN_COSINE in wanted:
        triples = zip(albedo, sigma_t, by_sigma_t, strict=False)
        by_share -= sum(_total(a * s * d) for a, s, d in triples)
    if ALBEDO in wanted:
        values = [-share * s * d for s, d in zip(sigma_t, by_sigma_t, strict=False)]
        result[ALBEDO] = _at_data(medium.original.albedo, p, values, wanted[ALBEDO])
    if ALBEDO not in found:
        return result
    p = _positions(medium.albedo.grid)
    albedo = list(mi.Spectrum(medium.original.albedo.at_world(p)))
    by_albedo = [
        (a, d / dr.square(1 - share * a))
        for a, d in zip(albedo, _channels(found[ALBEDO], channels), strict=False)
    ]
    if ALBEDO in wanted:
        values = [d * (1 - share) for _, d in by_albedo]
        result[ALBEDO] += _at_data(medium.original.albedo, p, values, wanted[ALBEDO])
    if MEAN_COSINE in wanted:
        by_share += sum(_total(a * (a - 1) * d) for a, d in by_albedo)
        result[MEAN_COSINE] = found[MEAN_COSINE] + dr.opaque(mi.Float, change * by_share)
    dr.eval(result)
    return result


def changes_without_peak(
    medium: MediumGrid, sigma_t: Field | None, albedo: Field | None, share: float
) -> tuple[Field, Field]:
    """Return the changes of the extinction and albedo of ``medium``, which is scaled.

    Args:
        medium: the scaled medium.
        sigma_t: change of the extinction of ``medium.original``; None for 0.
        albedo: change of its albedo.
        share: change of the share of the forward peak.
    """
    # docs/primer, eq. (8.14), transposed
    original = medium.original
    peak, share = (dr.opaque(mi.Float, value) for value in (medium.phase.forward, share))

    def at(p: mi.Point3f) -> tuple:
        fields = original.sigma_t, original.albedo, sigma_t, albedo
        return tuple(mi.Spectrum(0 if f is None else f.at_world(p)) for f in fields)

    s, a, ds, da = at(_positions(medium.sigma_t.grid))
    extinction = _field(medium.sigma_t, (1 - peak * a) * ds - s * (peak * da + a * share))
    s, a, ds, da = at(_positions(medium.albedo.grid))
    change = (da * (1 - peak) + share * a * (a - 1)) / dr.square(1 - peak * a)
    return extinction, _field(medium.albedo, change)


def _field(like: Field, values: mi.Spectrum) -> Field:
    """Return a field of ``values`` on the grid of another one."""
    channels = dr.size_v(mi.Spectrum)
    if like.grid is None:
        return ConstantField(np.array(values, dtype=np.float64).reshape(channels, -1)[:, 0])
    return GridField(like.grid, interleaved(values, like.grid.voxel_count), channels)


def _positions(grid: Grid | None) -> mi.Point3f:
    """Return the voxel centres of a grid, or an arbitrary position if there is none."""
    if grid is None:
        return mi.Point3f(0)
    return grid.centers(dr.arange(mi.UInt32, grid.voxel_count))


def _channels(values: mi.Float, count: int) -> list[mi.Float]:
    """Return the ``count`` channels of an array with interleaved channels."""
    index = dr.arange(mi.UInt32, dr.width(values) // count) * count
    return [dr.gather(mi.Float, values, index + c) for c in range(count)]


def _total(values: mi.Float) -> float:
    return float(np.array(values, dtype=np.float64).sum())


def _at_data(field: Field, p: mi.Point3f, values: list[mi.Float], channels: int) -> mi.Float:
    """Return derivatives with respect to the data of ``field``, with this number of channels.

    ``values`` are the derivatives with respect to its lookups at positions ``p``.
    """
    values = [sum(values)] if channels == 1 else values
    if field.grid is None:
        return mi.Float([np.array(v, dtype=np.float64).sum() for v in values])
    dr.eval(values)
    largest = max(float(dr.max(dr.abs(v))[0]) for v in values)
    splat = GridSplat(field.grid, channels, largest * dr.width(p))
    splat.add(p, values, mi.Bool(True))
    return splat.values()
