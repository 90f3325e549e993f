"""Uncollided irradiance from an emissive medium, sampled voxel by voxel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis, empty_sums, with_radiance
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import hashed_seed, kronecker_words, random_stream, unit_floats
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.tracking import free_flight


@symbolic
def emission_irradiance(
    medium: MediumGrid,
    position: mi.Point3f,
    count: int,
    seed: tuple[int, int],
    angular_basis: AngularBasis | None = None,
) -> list[mi.Spectrum]:
    """Estimate the irradiance at ``position`` from the emission of ``medium``, unbiased.

    Returns the irradiance, followed by its moments if there is an angular basis. The ``count``
    directions are a Kronecker sequence with a random shift at each position. ``seed`` is the seed
    of the cache and the index of the batch.
    """
    place = dr.arange(mi.UInt32, dr.width(position))
    rng = random_stream(mi.sample_tea_32(place, hashed_seed(seed)[0]), 1)
    shift = [rng.next_uint32(), rng.next_uint32()]
    total, weight = empty_sums(angular_basis), dr.opaque(mi.Float, 4 * dr.pi / count)
    k, count = mi.UInt32(0), dr.opaque(mi.UInt32, count)
    while dr.hint(k < count, label="emission"):
        ray = mi.Ray3f(position, _direction(shift, k))
        hit, near, far = medium.intersect(ray)
        *_, rng, emitted = free_flight(
            medium, ray, dr.maximum(near, 0), far, mi.Spectrum(1), rng, hit
        )
        # As the scattered part: emission does not come from narrow sources.
        total = with_radiance(
            total, position, ray.d, mi.Spectrum(0), emitted * weight, angular_basis
        )
        k += 1
    dr.eval(total)
    return total


def _direction(shift: list[mi.UInt32], k: mi.UInt32) -> mi.Vector3f:
    """Return direction ``k`` of the sequence with this random shift."""
    return mi.warp.square_to_uniform_sphere(mi.Point2f(unit_floats(kronecker_words(k, shift))))
