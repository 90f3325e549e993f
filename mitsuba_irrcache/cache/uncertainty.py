"""The error of the cache as a field, to be projected to the screen like the light itself.

*Noise*: voxels are estimated independently of each other, so the variance of a pixel is the sum of
those of its voxels, each times the square of the voxel's share in the pixel. These shares are never
known one by one; but of random errors, +- one standard error per voxel, the squared projection is
that variance on average (Hutchinson's estimator of a trace). `PROBES` such errors are projected.

Where voxels share their samples (`IrradianceCache.correlated`), their errors do not average out.
All probes err to the same side then, and the projection is the largest deviation that the errors of
the voxels admit.

*Bias*: the field at half the resolution differs from the field by more than the field differs from
the truth, by a known ratio where the light is smooth (Richardson).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import Extension, extrapolated

#: Random errors that are projected; their signs are kept in the last bits of a float.
PROBES = 4
#: Of the random numbers for the signs: after the usual 4, neighbours' are correlated by up to 0.5.
ROUNDS = 8
#: What is left of the difference to half the resolution. Of roots r on voxels of edge h, trilinear
#: interpolation errs by 1/12 h^2 Laplacian(r) on average over all places. Averages over 2^3 voxels
#: err by 1/8, and interpolating these between voxels of edge 2h to the centres of the fine ones,
#: where the difference is taken, by 3/8 (1/3 on average over all places).
COARSE_TO_FINE = (1 / 12) / (1 / 8 + 3 / 8)
#: What is left of this, about, where interpolation keeps the light of voxels (`conservative`): of
#: smooth light nothing, of a CT head and a cloud 0.5 to 0.7 of the error of the image.
KEPT = 0.6


class UncertaintyField:
    """Relative errors of the irradiance: `PROBES` random ones and the bias; ``count`` in all.

    ``data`` holds two values per voxel, both times the root of Phi, since lookups interpolate
    roots: the relative standard error, and the relative bias.
    """

    # docs/primer, eq. (6.1)

    count = PROBES + 1

    def __init__(self, grid: Grid, data: mi.Float) -> None:
        self.grid, self.data = grid, data

    def at_world(self, p: mi.Point3f, phi: mi.Float | mi.Color3f, active: mi.Bool) -> list:
        """Relative errors at ``p``, where the irradiance is ``phi``."""
        root = dr.sqrt(phi if isinstance(phi, mi.Float) else dr.sum(phi) / 3)
        sums = [mi.Float(0)] * self.count  # one array: added to below, never in place
        for voxel, weight in self.grid.corners(self.grid.coordinates.point(p)):
            deviation, bias = dr.gather(mi.Vector2f, self.data, voxel, active)
            bits = dr.reinterpret_array(mi.UInt32, deviation)
            for k in range(PROBES):
                sign = (bits << (31 - k)) & 0x80000000
                sums[k] = sums[k] + weight * dr.reinterpret_array(mi.Float, bits ^ sign)
            sums[PROBES] = sums[PROBES] + weight * bias
        inverse = dr.select(root > 0, dr.rcp(root), 0)
        return [s * inverse for s in sums]


def uncertainty_of(cache: IrradianceCache) -> UncertaintyField:
    """The errors of ``cache``, which has at least two batches of samples (one tells no noise)."""
    # docs/primer, eq. (6.2)
    phi, error = cache.mean_and_error()
    for light in cache.direct_lights:  # looked up apart, without an error
        channels = list(light.irradiance)[: cache.channels]
        phi = dr.maximum(phi - sum(channels) / len(channels), 0)
    if cache.falloff is not None:
        smooth = 1 / cache.falloff.of_voxels(cache.active)
        phi, error = phi * smooth, error * smooth
    root = dr.sqrt(phi)
    # Of twice the size in Phi, relatively; without a quotient, which explodes in shadows.
    left = COARSE_TO_FINE * (KEPT if cache.correlated else 1)
    bias = 2 * left * (_at_half_resolution(cache, root) - root)
    extension = Extension(cache.grid)
    roots, deviations, biases = (
        _everywhere(cache, values) for values in (root, dr.select(phi > 0, error / root, 0), bias)
    )
    voxel = dr.arange(mi.UInt32, extension.grid.voxel_count)
    inside = extension.inside(voxel)
    beyond = sum(dr.select(i != inside, mi.Float(1), 0) for i in extension.inwards(voxel))
    inner = dr.gather(mi.Float, roots, inside)
    growth = extrapolated(extension, roots) / dr.select(inner > 0, inner, 1)
    # a^2 / b of two values that err alike errs as the root of 2^2 + 1 of them, mostly as a does.
    deviation = dr.gather(mi.Float, deviations, inside) * growth * 5 ** (0.5 * beyond)
    random, _ = mi.sample_tea_32(inside, mi.UInt32(0x5EED), ROUNDS)
    if cache.correlated:
        random = random & 0  # all errors to the same side
    bits = dr.reinterpret_array(mi.UInt32, deviation) & ~mi.UInt32(2**PROBES - 1)
    signed = dr.reinterpret_array(mi.Float, bits | (random >> (32 - PROBES)))
    bias = dr.gather(mi.Float, biases, inside) * growth
    return UncertaintyField(extension.grid, interleaved([signed, bias]))


def _everywhere(cache: IrradianceCache, values: mi.Float) -> mi.Float:
    """Values of the active voxels on all of the grid, 0 elsewhere."""
    result = dr.zeros(mi.Float, cache.grid.voxel_count)
    dr.scatter(result, values, cache.active)
    return result


def _at_half_resolution(cache: IrradianceCache, root: mi.Float) -> mi.Float:
    """The root of the irradiance at the active voxels, from its averages over 2^3 of them."""
    halves = Grid(tuple(-(-n // 2) for n in cache.grid.shape), np.eye(4))
    corner = halves.places(dr.arange(mi.UInt32, halves.voxel_count))
    nx, ny, nz = (mi.UInt32(n) for n in cache.grid.sides)
    values, ones = _everywhere(cache, root), _everywhere(cache, mi.Float(1))
    total, members = mi.Float(0), mi.Float(0)
    # Gathered, in this order: atomic sums would be other bits each time.
    for steps in np.ndindex(2, 2, 2):
        x, y, z = (2 * c + s for c, s in zip(corner, steps, strict=True))
        inside, voxel = (x < nx) & (y < ny) & (z < nz), cache.grid.index(x, y, z)
        total += dr.gather(mi.Float, values, voxel, inside)
        members += dr.gather(mi.Float, ones, voxel, inside)
    known = dr.select(members > 0, mi.Float(1), 0)
    # Cells without a voxel have no value: they count with weight 0.
    roots, weights = (GridField(halves, v, 1) for v in (total / dr.maximum(members, 1), known))
    u = mi.Point3f(*cache.grid.places(cache.active)) * 0.5 + 0.25
    return roots.at(u) / weights.at(u)
