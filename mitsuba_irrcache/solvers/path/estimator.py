"""The estimator of the solver ``path`` for general scenes: surfaces, lights on them, several media.

A voxel centre is an isotropic scattering vertex of a path from the camera, its first one. What it
receives, int_S2 L dw, is estimated twice: straight from emitters that are sampled, and from a
uniform direction, along which a path goes on through all of the scene. Either counts in proportion
to how well it does (multiple importance sampling).
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.transport.path import Media, Start, power_heuristic, sample_emitter, trace


def contributions(
    scene: mi.Scene,
    media: Media,
    position: mi.Point3f,
    pointer: mi.MediumPtr,
    spread: list[mi.Float],
    rng: mi.PCG32,
    max_depth: mi.UInt32,
    rr_depth: mi.UInt32,
    apart: Sequence[mi.EmitterPtr] = (),
) -> list[tuple[mi.Vector3f, mi.Spectrum, mi.Spectrum]]:
    """One sample per lane of the light at ``position``, in the medium ``pointer``: directions (to
    where it comes from), and what comes from there uncollided and scattered. The sum is an
    unbiased estimate of the irradiance; any moment of the radiance follows from the directions.

    ``spread`` are four uniform numbers for the directions. Light straight from the emitters
    ``apart``, which have no extent, is left out.
    """
    vertex, always = dr.zeros(mi.Interaction3f), mi.Bool(True)
    vertex.p = position
    sample = mi.Point2f(spread[0], spread[1])
    record, light, rng = sample_emitter(scene, media, vertex, pointer, sample, rng, always)
    density = dr.select(record.delta, 0, dr.inv_four_pi)
    light *= power_heuristic(record.pdf, density)
    for emitter in apart:
        light = dr.select(record.emitter == emitter, 0, light)
    direction = mi.warp.square_to_uniform_sphere(mi.Point2f(spread[2], spread[3]))
    start = Start(mi.Ray3f(position, direction), pointer, depth=1, pdf=dr.inv_four_pi)
    straight, scattered, *_ = trace(scene, media, start, max_depth, rr_depth, False, rng, always)
    sphere = 4 * dr.pi
    return [
        (record.d, light, mi.Spectrum(0)),
        (direction, sphere * straight, sphere * scattered),
    ]


def estimate(directional: AngularBasis | None, *args: object) -> list[mi.Spectrum]:
    """One sample of the irradiance, uncollided and scattered, and of the moments of the radiance if
    the medium is ``directional``; the others are the arguments of `contributions`.
    """
    found = contributions(*args)
    layers = [sum(f[1] for f in found), sum(f[2] for f in found)]
    return layers + (directional.moments(args[2], found) if directional is not None else [])
