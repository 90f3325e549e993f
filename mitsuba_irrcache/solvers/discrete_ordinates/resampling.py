"""Resampling of the medium to the voxels of the cache and of the tracks: means that conserve
optical depth, and the albedo of collisions.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor, symbolic, unravelled
from mitsuba_irrcache.grids.fields import Field, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid

#: Maximum number of points along each axis of a voxel over which the medium is averaged.
FINEST = 4
#: Quadrature points for collisions, and their weights, along each axis of a voxel or, if it is
#: larger than a voxel of the data, of parts of it: Gauss-Radau points of both halves, exact for
#: products of fields that are linear in each half. Data values are in the middle if the grids are
#: the same.
RADAU = (1 / 6, 3 / 8), (1 / 2, 1 / 4), (5 / 6, 3 / 8)
#: Approximate number of extinction values along each axis of a voxel.
DETAIL = 2
#: Maximum number of voxels of a grid whose extinction is refined at dense boundaries that cut them:
#: sweeps then read 128 bytes more per voxel.
MOST_REFINED = 1 << 21


def extinction_grid(medium: MediumGrid, grid: Grid, has_dense_boundary: bool = False) -> Grid:
    """Return the grid on which tracks read the extinction.

    If ``grid`` and the medium's grid cover the same box, it is the medium's grid or, if ``grid`` is
    much coarser, a grid of blocks of its voxels, about `DETAIL` per voxel along each axis.
    Otherwise it is ``grid``, or a grid of half its edges if voxels are cut by a dense boundary,
    which interpolation of the extinction blurs.
    """
    data = medium.sigma_t.grid
    if not medium.fills(grid):
        return halved(grid) if has_dense_boundary else grid
    if data is None or not medium.fills(data):
        return grid
    block = np.maximum(np.rint(data.resolution / (DETAIL * grid.resolution)), 1).astype(int)
    block = np.where(data.resolution % block == 0, block, 1)
    sides = data.resolution // block
    if (sides == grid.resolution).all():
        return grid
    return data if (block == 1).all() else Grid(tuple(int(n) for n in sides[::-1]), grid.to_world)


def halved(grid: Grid) -> Grid:
    """Return the grid of half the edges, or ``grid`` if it has too many voxels."""
    if grid.voxel_count > MOST_REFINED:
        return grid
    return Grid(tuple(DETAIL * n for n in grid.shape), grid.to_world)


def resampled(
    medium: MediumGrid, field: Field, grid: Grid, points_if_cut: int = FINEST
) -> list[mi.Float]:
    """Return the channels of ``field`` at the voxels of ``grid``.

    Values are means over voxels if these are larger than the field's, or if the boundary of the
    medium may cut them, then over at least ``points_if_cut`` points along each axis; outside of the
    boundary the field counts as 0.
    """
    cut = not medium.fills(grid)
    if field.grid is not None and not cut:
        block, rest = np.divmod(field.grid.resolution, grid.resolution)
        if not rest.any() and np.prod(block) <= FINEST**3 and medium.fills(field.grid):
            return _blocks(field, grid, block)
    ratio = 1.0 if field.grid is None else (grid.voxel_size / field.grid.voxel_size).max()
    points = int(np.clip(np.ceil(ratio - 1e-3), points_if_cut if cut else 1, FINEST))
    index = dr.arange(mi.UInt32, grid.voxel_count)
    values = _mean(field, grid, index, points, medium.contains if cut else None)
    dr.eval(values)
    return values


def mean_extinction(medium: MediumGrid, grid: Grid) -> list[mi.Float]:
    """Return the channels of the extinction at the voxels of ``grid``, means over voxels that
    count as filled by the ``medium`` within the box of its data, whatever its boundary.
    """
    data = medium.sigma_t.grid
    ratio = 1.0 if data is None else (grid.voxel_size / data.voxel_size).max()
    fewest = 1 if medium.bbox is None else FINEST
    points = int(np.clip(np.ceil(ratio - 1e-3), fewest, FINEST))
    index = dr.arange(mi.UInt32, grid.voxel_count)
    values = _mean(medium.sigma_t, grid, index, points, medium.clips)
    dr.eval(values)
    return values


def track_extinction(medium: MediumGrid, grid: Grid, detail: Grid) -> list[mi.Float]:
    """Return the channels of the extinction on the grid ``detail``, see `extinction_grid`."""
    points = FINEST // DETAIL if detail.voxel_count > grid.voxel_count else FINEST
    return resampled(medium, medium.sigma_t, detail, points)


def collision_albedo(medium: MediumGrid, grid: Grid, voxels: mi.UInt32) -> list[mi.Float]:
    """Return the channels of the albedo at these ``voxels`` of ``grid``, averaged with the
    extinction as weight: the mean over collisions in uniform radiance.

    The weight matters where albedo and extinction change together, at the edges of objects.
    """
    contains = None if medium.fills(grid) else medium.contains
    return _albedo_of_collisions(medium, grid, voxels, contains)


def mean_albedo(medium: MediumGrid, grid: Grid, voxels: mi.UInt32) -> list[mi.Float]:
    """Return `collision_albedo` of voxels that count as filled by the ``medium`` within the box of
    its data, whatever its boundary.
    """
    return _albedo_of_collisions(medium, grid, voxels, medium.clips)


def _albedo_of_collisions(
    medium: MediumGrid, grid: Grid, voxels: mi.UInt32, contains: Callable | None
) -> list[mi.Float]:
    """Return the albedo of collisions where a medium ``contains`` positions (None: everywhere)."""
    albedo, extinction = medium.albedo, medium.sigma_t
    if albedo.grid is None:
        none, values = dr.zeros(mi.Float, dr.width(voxels)), mi.Spectrum(albedo.value)
        return [value + none for value in list(values)[: albedo.channels]]
    fields = [f.grid for f in (albedo, extinction) if f.grid is not None]
    ratio = max((grid.voxel_size / data.voxel_size).max() for data in fields)
    parts = int(np.clip(np.ceil(ratio - 1e-3), 1, FINEST // 2))
    values = _extinction_weighted_albedo(medium, grid, voxels, parts, contains)
    dr.eval(values)
    return values


def _blocks(field: GridField, grid: Grid, block: np.ndarray) -> list[mi.Float]:
    """Return means over blocks of ``block`` voxels (x, y, z), which are the voxels of ``grid``."""
    sums: list = [0.0] * field.channels
    at = grid.voxel_indices(dr.arange(mi.UInt32, grid.voxel_count))
    for dz, dy, dx in np.ndindex(*block[::-1]):
        voxel = (a * int(n) + d for a, n, d in zip(at, block, (dx, dy, dz), strict=True))
        place = field.grid.index(*voxel) * field.channels
        for c in range(field.channels):
            sums[c] = sums[c] + dr.gather(mi.Float, field.data, place + c)
    values = [total * (field.scale / int(np.prod(block))) for total in sums]
    dr.eval(values)
    return values


@symbolic
def _mean(field, grid, index, points: int, contains):
    """Return means of ``field`` over points^3 positions in the voxels ``index``, per channel;
    positions count where a medium ``contains`` them (None: all do).
    """
    corner, sides = mi.Point3f(*grid.voxel_indices(index)), [Divisor(points)] * 2
    points, count = dr.opaque(mi.Float, points), dr.opaque(mi.UInt32, points**3)
    sums = [dr.zeros(mi.Float, dr.width(index)) for _ in range(field.channels)]
    k = mi.UInt32(0)
    while dr.hint(k < count, label="points in a voxel"):
        place = mi.Point3f(*unravelled(k, sides)) + 0.5
        p = grid.world.point(corner + place / points)
        value = field.at_world(p)
        if dr.hint(contains is not None, mode="scalar"):
            value = dr.select(contains(p), value, 0)
        for c in range(field.channels):
            part = value if dr.hint(field.channels == 1, mode="scalar") else value[c]
            sums[c] = sums[c] + part
        k += 1
    return [s / mi.Float(count) for s in sums]


@symbolic
def _extinction_weighted_albedo(medium, grid, index, parts: int, contains):
    """Return means of the albedo over the voxels ``index``, weighted by extinction, with the
    quadrature `RADAU` in ``parts`` parts along each axis.
    """
    channels = max(medium.albedo.channels, medium.sigma_t.channels)
    corner, sides = mi.Point3f(*grid.voxel_indices(index)), [Divisor(3 * parts)] * 2
    parts, count = dr.opaque(mi.Float, parts), dr.opaque(mi.UInt32, (3 * parts) ** 3)
    scattered = [dr.zeros(mi.Float, dr.width(index)) for _ in range(channels)]
    collided = [dr.zeros(mi.Float, dr.width(index)) for _ in range(channels)]
    k = mi.UInt32(0)
    while dr.hint(k < count, label="collisions in a voxel"):
        within, weight = [], mi.Float(1)
        for i in unravelled(k, sides):
            part = i // 3
            middle = i - part * 3 == 1
            aside = dr.select(i - part * 3 == 0, RADAU[0][0], RADAU[2][0])
            within.append(mi.Float(part) + dr.select(middle, RADAU[1][0], aside))
            weight *= dr.select(middle, RADAU[1][1], RADAU[0][1])
        p = grid.world.point(corner + mi.Point3f(within) / parts)
        sigma_t = mi.Spectrum(medium.sigma_t.at_world(p)) * weight
        albedo = mi.Spectrum(medium.albedo.at_world(p))
        if dr.hint(contains is not None, mode="scalar"):
            sigma_t = dr.select(contains(p), sigma_t, 0)
        for c in range(channels):
            collided[c] = collided[c] + sigma_t[c]
            scattered[c] = scattered[c] + sigma_t[c] * albedo[c]
        k += 1
    return [dr.select(collided[c] > 0, scattered[c] / collided[c], 0) for c in range(channels)]
