"""Error estimates of the cache as fields, which are ray marched to the image like the irradiance.

*Noise*: the voxels' errors are independent, so the variance of a pixel is the sum of the voxels'
variances times the squares of their weights in the pixel. The weights are never computed
explicitly; instead `PROBES` random fields with values of +- one standard error are ray marched. The
expected square of the resulting pixel values is the variance (Hutchinson's trace estimator).

If voxels share their samples (`IrradianceCache.correlated`), errors do not average out. All probes
then have the same sign, and their projection is the largest deviation that the voxels' errors
admit.

*Bias*: for a smooth field, the difference from the field at half the resolution is a known multiple
of the discretisation error (Richardson extrapolation).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.border import FittedBorder
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import marked
from mitsuba_irrcache.grids.root_field import Extension, extrapolated

#: Number of random error fields. With few, a pixel's error bar is itself uncertain: 4 have 63, 88
#: and 96 % of the errors within 1, 2 and 3 bars (Student's t), 16 have 67, 94 and 99 %. Their signs
#: are stored in the last bits of two floats, SIGNS in each.
PROBES, SIGNS = 16, 8
#: Rounds of the random number generator for the signs: after the usual 4 rounds, neighbours are
#: correlated by up to 0.5.
ROUNDS = 8
#: Ratio of the error to the difference from half the resolution. The mean error of trilinear
#: interpolation of square roots r on voxels of edge h is 1/12 h^2 Laplacian(r). Averaging over 2^3
#: voxels adds 1/8 h^2 Laplacian(r), and interpolating the averages between voxels of edge 2h to the
#: centres of the fine voxels, where the difference is evaluated, adds 3/8 (1/3 averaged over all
#: positions).
COARSE_TO_FINE = (1 / 12) / (1 / 8 + 3 / 8)
#: Approximate factor on this ratio with conservative interpolation (`conservative`): smooth fields
#: then have no error; on a CT head and a cloud 0.5 to 0.7 times the image error remained.
CONSERVATIVE_FACTOR = 0.6


class UncertaintyField:
    """Relative errors of the irradiance: `PROBES` random fields and the bias, ``count`` in total.

    ``data`` stores two values per voxel, the relative standard error and the relative bias, both
    multiplied by sqrt(Phi), because lookups interpolate square roots.
    """

    # docs/primer, eq. (6.1)

    count = PROBES + 1

    def __init__(self, grid: Grid, data: mi.Float) -> None:
        self.grid, self.data = grid, data

    def at_world(self, p: mi.Point3f, phi: mi.Float | mi.Color3f, active: mi.Bool) -> list:
        """Return the ``count`` relative errors at ``p``, where the irradiance is ``phi``."""
        root = dr.sqrt(phi if isinstance(phi, mi.Float) else dr.sum(phi) / 3)
        sums = [mi.Float(0)] * self.count  # the same array; not modified in place below
        for voxel, weight in self.grid.corners(self.grid.coordinates.point(p)):
            deviation, bias = dr.gather(mi.Vector2f, self.data, voxel, active)
            bits = dr.reinterpret_array(mi.UInt32, deviation)
            signs = bits, dr.reinterpret_array(mi.UInt32, bias)
            for k in range(PROBES):
                sign = (signs[k // SIGNS] << (31 - k % SIGNS)) & 0x80000000
                sums[k] = sums[k] + weight * dr.reinterpret_array(mi.Float, bits ^ sign)
            sums[PROBES] = sums[PROBES] + weight * bias
        inverse = dr.select(root > 0, dr.rcp(root), 0)
        return [s * inverse for s in sums]


def uncertainty_of(cache: IrradianceCache) -> UncertaintyField:
    """Estimate the errors of ``cache``, which must have at least two batches of samples."""
    # docs/primer, eq. (6.2)
    phi, error = cache.mean_and_error()
    for light in cache.direct_lights:  # these are looked up separately and have no error estimate
        channels = list(light.irradiance)[: cache.channels]
        phi = dr.maximum(phi - sum(channels) / len(channels), 0)
    if cache.falloff is not None:
        smooth = 1 / cache.falloff.of_voxels(cache.active)
        phi, error = phi * smooth, error * smooth
    root = dr.sqrt(phi)
    # The relative error of Phi is twice that of its root; a quotient would diverge in shadows.
    ratio = COARSE_TO_FINE * (CONSERVATIVE_FACTOR if cache.correlated else 1)
    bias = 2 * ratio * (_at_half_resolution(cache, root) - root)
    extension = Extension(cache.grid)
    roots, deviations, biases = (
        _everywhere(cache, values) for values in (root, dr.select(phi > 0, error / root, 0), bias)
    )
    voxel = dr.arange(mi.UInt32, extension.grid.voxel_count)
    inside = extension.inside(voxel)
    beyond = sum(dr.select(i != inside, mi.Float(1), 0) for i in extension.inwards(voxel))
    inner = dr.gather(mi.Float, roots, inside)
    border, classes = cache.border, cache.voxel_classes
    separated = None if classes is None else classes.separated
    if border is not None:
        border = FittedBorder(border, roots, marked(cache.grid, cache.active), 1, separated)
    beyond_border = extrapolated(extension, roots, border=border, separated=separated)
    growth = beyond_border / dr.select(inner > 0, inner, 1)
    # Extrapolated roots are a^2 / b (`extrapolated`); their relative error is sqrt(2^2 + 1) times
    # that of equally noisy a and b.
    deviation = dr.gather(mi.Float, deviations, inside) * growth * 5 ** (0.5 * beyond)
    random, _ = mi.sample_tea_32(inside, mi.UInt32(0x5EED), ROUNDS)
    if cache.correlated:
        random = random & 0  # the same sign for all errors
    bias = dr.gather(mi.Float, biases, inside) * growth
    signed = [_with_signs(deviation, random), _with_signs(bias, random << SIGNS)]
    return UncertaintyField(extension.grid, interleaved(signed))


def _with_signs(values: mi.Float, random: mi.UInt32) -> mi.Float:
    """Replace the last bits of ``values`` by the first ones of ``random``."""
    bits = dr.reinterpret_array(mi.UInt32, values) & ~mi.UInt32(2**SIGNS - 1)
    return dr.reinterpret_array(mi.Float, bits | (random >> (32 - SIGNS)))


def _everywhere(cache: IrradianceCache, values: mi.Float) -> mi.Float:
    """Return an array over all voxels with these values at the active voxels, 0 elsewhere."""
    result = dr.zeros(mi.Float, cache.grid.voxel_count)
    dr.scatter(result, values, cache.active)
    return result


def _at_half_resolution(cache: IrradianceCache, root: mi.Float) -> mi.Float:
    """Average ``root`` over 2^3 voxels, and interpolate the averages back to the active voxels."""
    halves = Grid(tuple(-(-n // 2) for n in cache.grid.shape), np.eye(4))
    corner = halves.voxel_indices(dr.arange(mi.UInt32, halves.voxel_count))
    nx, ny, nz = (mi.UInt32(n) for n in cache.grid.sides)
    values, ones = _everywhere(cache, root), _everywhere(cache, mi.Float(1))
    total, members = mi.Float(0), mi.Float(0)
    # Gather in a fixed order: atomic sums would not be reproducible.
    for steps in np.ndindex(2, 2, 2):
        x, y, z = (2 * c + s for c, s in zip(corner, steps, strict=True))
        inside, voxel = (x < nx) & (y < ny) & (z < nz), cache.grid.index(x, y, z)
        total += dr.gather(mi.Float, values, voxel, inside)
        members += dr.gather(mi.Float, ones, voxel, inside)
    known = dr.select(members > 0, mi.Float(1), 0)
    # Cells without an active voxel have weight 0.
    roots, weights = (GridField(halves, v, 1) for v in (total / dr.maximum(members, 1), known))
    u = mi.Point3f(*cache.grid.voxel_indices(cache.active)) * 0.5 + 0.25
    return roots.at(u) / weights.at(u)
