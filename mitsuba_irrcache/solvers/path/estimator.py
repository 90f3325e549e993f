"""The estimator of the solver ``path`` for general scenes: surfaces, area emitters, several media.

A voxel centre is the first vertex of a path, where scattering is isotropic. Its irradiance,
int_S2 L dw, is estimated with multiple importance sampling: by emitter sampling, and by a path that
starts in a uniform direction and continues through the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.transport.path import power_heuristic, sample_emitter
from mitsuba_irrcache.transport.path_tracer import PathStart, PathTracer


def contributions(
    tracer: PathTracer,
    position: mi.Point3f,
    pointer: mi.MediumPtr,
    spread: list[mi.Float],
    rng: mi.PCG32,
    excluded: Sequence[mi.EmitterPtr] = (),
) -> list[tuple[mi.Vector3f, mi.Spectrum, mi.Spectrum]]:
    """Take one sample per lane of the incident radiance at ``position``, in the medium ``pointer``.

    Returns tuples of the direction towards the origin of the radiance, and its uncollided and
    scattered irradiance. Their sum is an unbiased estimate of the irradiance; moments of the
    radiance follow from the directions.

    ``spread`` are four uniform numbers for the directions. Radiance directly from the emitters
    ``excluded`` is not included.
    """
    scene, media = tracer.scene, tracer.media
    vertex, always = dr.zeros(mi.Interaction3f), mi.Bool(True)
    vertex.p = position
    sample = mi.Point2f(spread[0], spread[1])
    record, light, rng = sample_emitter(scene, media, vertex, pointer, sample, rng, always)
    density = dr.select(record.delta, 0, dr.inv_four_pi)
    light *= power_heuristic(record.pdf, density)
    for emitter in excluded:
        light = dr.select(record.emitter == emitter, 0, light)
    direction = mi.warp.square_to_uniform_sphere(mi.Point2f(spread[2], spread[3]))
    start = PathStart(mi.Ray3f(position, direction), pointer, 1, dr.inv_four_pi, excluded=excluded)
    sums, _ = tracer.trace(start, rng, always)
    sphere = 4 * dr.pi
    return [
        (record.d, light, mi.Spectrum(0)),
        (direction, sphere * sums.direct, sphere * sums.scattered),
    ]


def estimate(
    directional: AngularBasis | None, tracer: PathTracer, position: mi.Point3f, *others: object
) -> list[mi.Spectrum]:
    """Take one sample of the irradiance, uncollided and scattered.

    If there is an angular basis ``directional``, the moments of the radiance follow. The other
    arguments are those of `contributions`.
    """
    found = contributions(tracer, position, *others)
    irradiances = [sum(f[1] for f in found), sum(f[2] for f in found)]
    return irradiances + (directional.moments(position, found) if directional is not None else [])
