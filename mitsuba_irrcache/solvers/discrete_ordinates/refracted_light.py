"""Irradiance from emitters that is refracted by glass around a medium, voxel by voxel.

Area emitters and bright regions of an environment are visible through glass in few directions,
which a set of ordinates would miss or overestimate in all voxels alike (ray effects). Their
irradiance is therefore estimated by paths from the voxels, which end at the first collision in the
medium.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import Divisor
from mitsuba_irrcache.core.sequences import hashed_seed, kronecker, random_stream, unit_floats
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import EmitterKind, illuminating, kind_of
from mitsuba_irrcache.solvers.discrete_ordinates.boundary_condition import SurfaceBoundary
from mitsuba_irrcache.transport.path import flags_of
from mitsuba_irrcache.transport.path_tracer import PathStart

#: Number of paths of an estimate for all voxels together; its minimum and maximum per voxel;
#: maximum number of paths of a launch.
PATHS, FEWEST, MOST, LANES = 1 << 23, 8, 512, 1 << 21
#: Weight of positions outside of the medium, which are moved to its boundary.
OUTSIDE = 1e-4
#: Offset of the random streams of these paths.
STREAM = 0x6A00


def is_needed(scene: mi.Scene) -> bool:
    """Return whether glass refracts radiance of anything but a constant environment.

    Suns and point-like emitters contribute nothing through smooth glass, through which no path can
    hit them.
    """
    rough = int(mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DiffuseTransmission)
    scatters = any(flags_of(shape) & rough for shape in scene.shapes())
    kinds = (kind_of(emitter) for emitter in illuminating(scene))
    return any(
        scatters or not (kind.has_one_direction or kind.is_point_like)
        for kind in kinds
        if kind is not EmitterKind.CONSTANT_ENVIRONMENT
    )


def refracted_irradiance(
    boundary: SurfaceBoundary, grid: Grid, voxels: mi.UInt32, seed: tuple[int, int]
) -> mi.Spectrum:
    """Estimate the mean over each of the ``voxels`` of the uncollided irradiance that is refracted
    or reflected on its way from emitters.
    """
    count = dr.width(voxels)
    samples = int(np.clip(PATHS // count, FEWEST, MOST))
    block, found = max(1, LANES // samples), []
    for begin in range(0, count, block):
        index = dr.arange(mi.UInt32, min(block, count - begin)) + dr.opaque(mi.UInt32, begin)
        own = dr.gather(mi.UInt32, voxels, index)
        found.append(_mean(boundary, grid, own, samples, seed))
    return mi.Spectrum(*(dr.concat([part[c] for part in found]) for c in range(len(found[0]))))


def _mean(
    boundary: SurfaceBoundary,
    grid: Grid,
    voxels: mi.UInt32,
    samples: int,
    seed: tuple[int, int],
) -> list[mi.Float]:
    """Return the mean of ``samples`` paths per voxel, one array per channel."""
    lane, k = Divisor(samples).split(dr.arange(mi.UInt32, dr.width(voxels) * samples))
    voxel = dr.gather(mi.UInt32, voxels, lane)
    words = mi.sample_tea_32(voxel, hashed_seed(seed)[0] + dr.opaque(mi.UInt32, STREAM))
    shift = unit_floats([*words, *mi.sample_tea_32(words[1], words[0])])
    rng = random_stream(mi.sample_tea_32(words[0] ^ k, words[1]))
    u = kronecker(k, 4, shift)
    within = mi.Point3f(u[2], u[3], rng.next_float32())
    p = grid.world.point(mi.Point3f(*grid.voxel_indices(voxel)) + within)
    # Only positions in the medium count, unless there are none.
    weight = dr.select(boundary.medium.contains(p), 1, OUTSIDE)
    p = boundary.medium.boundary.drawn_inside(p)
    direction = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
    pointer = dr.select(mi.Bool(True), boundary.pointer, dr.zeros(mi.MediumPtr, dr.width(lane)))
    start = PathStart(mi.Ray3f(p, direction), pointer, depth=1, pdf=0.0)
    sums, _ = boundary.paths.trace(start, rng, mi.Bool(True))
    values = [c * weight * (4 * dr.pi) for c in sums.scattered]
    dr.eval(values, weight)
    total = dr.block_sum(weight, samples)
    means = [dr.block_sum(value, samples) / total for value in values]
    dr.eval(means)
    return means
