"""Radiance behind media that the forward peaks of their phase functions scatter into camera rays.

The transmittance of the scaled medium (see `delta_m`) includes what the peak scatters, as if it
came from the direction of the ray. Here are the differences from that: radiance of the environment,
and of surfaces, in a few directions around the ray, see `peak_blur`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.media.peak_blur import DIRECTIONS
from mitsuba_irrcache.transport.path import unobstructed


def peak_depth(transmittance: mi.Spectrum, unscattered: mi.Spectrum) -> mi.Float:
    """Return the optical depth of scattering into the peak, mean over the channels, from the
    transmittances of the scaled and of the original medium.
    """
    total, original = dr.sum(transmittance), dr.sum(unscattered)
    return dr.select(original > 0, dr.log(total / dr.maximum(original, 1e-30)), dr.inf)


def blurred_directions(
    lights: AngularBasis, direction: mi.Vector3f, depth: mi.Float, u: mi.Point2f
) -> list[tuple[mi.Vector3f, mi.Float]]:
    """Sample directions from which a forward peak scatters radiance into ``direction``.

    ``lights`` has the phase function, and the narrow sources, which are not blurred; ``depth`` is
    the optical depth of scattering into the peak, and ``u`` are two random numbers. The sum of the
    returned weights times differences of radiance from that in ``direction`` estimates by how much
    the blur changes the latter.
    """
    counts, found = ~_is_narrow(lights, direction), []
    for other, weight in lights.phase.blur.deflected(direction, depth, u):
        used = counts & ~_is_narrow(lights, other)
        found.append((other, dr.select(used, weight * (1 / DIRECTIONS), 0)))
    return found


def environment_along(scene: mi.Scene, ray: mi.Ray3f, direction: mi.Vector3f) -> mi.Spectrum:
    """Return the radiance of the environment for ``ray`` with another ``direction``."""
    escaped = dr.zeros(mi.SurfaceInteraction3f)
    escaped.wi, escaped.wavelengths, escaped.time = -direction, ray.wavelengths, ray.time
    return scene.environment().eval(escaped)


@dataclass
class SurroundingsChange:
    """By how much a forward peak changes the radiance behind a ray, over what it scatters.

    Attributes:
        environment: the part of environments.
        surface: factor of the radiance of the surface that the ray hits.
        direction: direction towards another surface, whose radiance is the third part.
        weight: factor of that radiance, 0 where there is none.
    """

    environment: mi.Spectrum
    surface: mi.Float
    direction: mi.Vector3f
    weight: mi.Float


def surroundings_change(
    scene: mi.Scene,
    lights: AngularBasis,
    ray: mi.Ray3f,
    escaped: mi.Bool,
    depth: mi.Float,
    rng: mi.PCG32,
    active: mi.Bool,
) -> SurroundingsChange:
    """Estimate by how much the blur changes the radiance of surfaces and of the environment.

    ``ray`` starts within the medium; ``escaped`` states whether it hits no surface.
    """
    has_environment = scene.environment() is not None
    u = mi.Point2f(rng.next_float32(active), rng.next_float32(active))
    chosen_by = rng.next_float32(active)
    before = mi.Spectrum(0)
    if has_environment:
        before = dr.select(escaped, environment_along(scene, ray, ray.d), 0)
    change = SurroundingsChange(mi.Spectrum(0), mi.Float(0), mi.Vector3f(ray.d), mi.Float(0))
    hits = mi.Float(0)
    for direction, weight in blurred_directions(lights, ray.d, depth, u):
        used = active & (weight != 0)
        weight = dr.select(used, weight, 0)
        other = mi.Ray3f(ray.o, direction)
        clear = unobstructed(scene, other, used)
        if has_environment:
            radiance = environment_along(scene, ray, direction)
            change.environment += weight * dr.select(clear, radiance, 0)
        change.environment -= weight * before
        change.surface -= dr.select(clear & ~escaped, weight, 0)
        # Choose one of the directions towards surfaces, each with the same probability.
        hits_surface = used & ~clear
        hits += dr.select(hits_surface, 1, 0)
        chosen = hits_surface & (chosen_by * hits < 1)
        chosen_by = dr.select(
            hits_surface, dr.select(chosen, chosen_by * hits, _rest(chosen_by, hits)), chosen_by
        )
        change.direction = dr.select(chosen, direction, change.direction)
        change.weight = dr.select(chosen, weight, change.weight)
    change.weight *= hits
    change.surface -= dr.select(escaped, 0, change.weight)
    return change


def _rest(number: mi.Float, hits: mi.Float) -> mi.Float:
    """Return a random number again, given that it is at least 1 / ``hits``."""
    return (number * hits - 1) * dr.rcp(dr.maximum(hits - 1, 1))


def _is_narrow(lights: AngularBasis, direction: mi.Vector3f) -> mi.Bool:
    """Return whether there is a narrow distant source in a direction."""
    return lights.hits_source(mi.Point3f(0), direction, mi.Bool(True), mi.Bool(False))
