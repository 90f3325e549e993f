"""Uncollided irradiance from an emissive medium, sampled voxel by voxel.

A position in or close to the emission sees it under large solid angles, which random directions
sample well; a position far from a small emissive region does not, and samples points in the region
instead. With the emission coefficient j, averaged over the channels, the transmittance T and the
distance r, the irradiance is the sum of both parts of the integral of T j / r^2 over the volume,

    c / (j r^2 + c) along directions,    j r^2 / (j r^2 + c) from points of density j,

which have no singularity. The length (c / j)^(1/2), at which both are equal, is a fraction of the
size of the emissive region.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis, empty_sums, with_radiance
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import hashed_seed, kronecker_words, random_stream, unit_floats
from mitsuba_irrcache.core.spectrum import channel_mean
from mitsuba_irrcache.media.emission import Emission
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.tracking import free_flight, medium_transmittance

#: Distance at which both parts are equal, over half the edge of a cube of the emissive volume.
NEAR = 0.35


class EmissionPoints:
    """Points of an emissive grid with a density proportional to its emission j.

    Attributes:
        power: integral of j, averaged over the channels.
        distance: distance at which both parts of the irradiance are equal where j has its
            power-weighted mean.
        split: the constant c of the module.
    """

    def __init__(self, emission: Emission) -> None:
        field, self._grid = emission.field, emission.grid
        nx = self._grid.shape[-1]
        values = np.array(field.data, dtype=np.float64).reshape(-1, field.channels).mean(axis=1)
        values *= float(field.scale[0])
        total, squares = values.sum(), np.square(values).sum()
        voxel = float(np.abs(np.linalg.det(self._grid.to_world[:3, :3]))) / len(values)
        distance = NEAR * 0.5 * np.cbrt(total**2 / squares * voxel)
        self.power = dr.opaque(mi.Float, total * voxel)
        self.distance = dr.opaque(mi.Float, distance)
        self.split = dr.opaque(mi.Float, distance**2 * squares / total)
        # A row of voxels is chosen first, then a voxel of the row.
        along = np.cumsum(values.reshape(-1, nx), axis=1)
        rows = np.cumsum(along[:, -1])
        along /= np.maximum(along[:, -1:], 1e-300)
        self._count = dr.opaque(mi.UInt32, len(rows))
        self._rows = mi.Float(np.float32(rows / rows[-1]))
        self._along = mi.Float(np.float32(along).ravel())

    @symbolic
    def sample(self, u: list[mi.Float], rng: mi.PCG32):
        """Return the world position of a point, and the random number generator.

        ``u`` are two numbers in [0, 1). The weight of a voxel's value in trilinear interpolation is
        a tent of two voxels along each axis, clamped at the faces of the grid.
        """
        nx, ny, _ = (mi.UInt32(side) for side in self._grid.sides)
        row = _first_above(self._rows, mi.UInt32(0), self._count, u[0])
        x = _first_above(self._along, row * nx, nx, u[1])
        place = mi.Point3f(mi.Float(x), mi.Float(row % ny), mi.Float(row // ny)) + 0.5
        for axis, side in enumerate(self._grid.sides):
            place[axis] += rng.next_float32() - rng.next_float32()
            # Beyond a face, interpolation is constant: points are reflected at the face.
            place[axis] = dr.abs(place[axis])
            place[axis] = dr.minimum(place[axis], 2 * mi.Float(side) - place[axis])
        return self._grid.world.point(place), rng


@symbolic
def _first_above(values: mi.Float, first: mi.UInt32, count: mi.UInt32, bound: mi.Float):
    """Return the index, from ``first`` on, of the first of ``count`` ascending values that exceeds
    ``bound``, or that of the last one.
    """
    low, high = mi.UInt32(0), mi.UInt32(count - 1)
    while dr.hint(low < high, label="bisection"):
        middle = (low + high) // 2
        below = dr.gather(mi.Float, values, first + middle) <= bound
        low = dr.select(below, middle + 1, low)
        high = dr.select(below, high, middle)
    return low


def emission_irradiance(
    medium: MediumGrid,
    points: EmissionPoints | None,
    position: mi.Point3f,
    count: int,
    seed: tuple[int, int],
    angular_basis: AngularBasis | None = None,
) -> list[mi.Spectrum]:
    """Estimate the irradiance at ``position`` from the emission of ``medium``, unbiased.

    ``points`` are those of its grid; None for constant emission. Returns the irradiance, followed
    by its moments if there is an angular basis. The ``count`` directions, and as many points, are a
    Kronecker sequence with a random shift at each position. ``seed`` is the seed of the cache and
    the index of the batch.
    """
    place = dr.arange(mi.UInt32, dr.width(position))
    rng = random_stream(mi.sample_tea_32(place, hashed_seed(seed)[0]), 1)
    shift = [rng.next_uint32() for _ in range(3)]
    count = dr.opaque(mi.UInt32, count)
    if points is None:
        total = _along_directions(medium, position, count, shift, rng, angular_basis)
    else:
        total = _in_both_parts(medium, points, position, count, shift, rng, angular_basis)
    dr.eval(total)
    return total


@symbolic
def _along_directions(medium, position, count, shift, rng, angular_basis):
    """Sample collisions along random directions; emission is integrated up to them."""
    total, weight, k = empty_sums(angular_basis), 4 * dr.pi / mi.Float(count), mi.UInt32(0)
    while dr.hint(k < count, label="emission"):
        sample = mi.Point2f(unit_floats(kronecker_words(k, shift[:2])))
        ray = mi.Ray3f(position, mi.warp.square_to_uniform_sphere(sample))
        hit, near, far = medium.intersect(ray)
        *_, rng, emitted = free_flight(
            medium, ray, dr.maximum(near, 0), far, mi.Spectrum(1), rng, hit
        )
        # As the scattered part: emission does not come from narrow sources.
        total = with_radiance(
            total, position, ray.d, mi.Spectrum(0), emitted * weight, angular_basis
        )
        k += 1
    return total


@symbolic
def _in_both_parts(medium, points, position, count, shift, rng, angular_basis):
    """Sample places along random directions, and points in the emissive grid."""
    emission, split, scale = medium.emission, points.split, points.distance
    total, weight, k = empty_sums(angular_basis), 1 / mi.Float(count), mi.UInt32(0)
    while dr.hint(k < count, label="emission"):
        # The density of places along a ray is proportional to 1 / (t^2 + scale^2).
        x, y, place = unit_floats(kronecker_words(k, shift))
        ray = mi.Ray3f(position, mi.warp.square_to_uniform_sphere(mi.Point2f(x, y)))
        hit, near, far = medium.intersect(ray)
        begin, end = emission.interval(ray, dr.maximum(near, 0), far)
        seen = hit & (begin < end)
        low, high = dr.atan(begin / scale), dr.atan(end / scale)
        t = scale * dr.tan(dr.lerp(low, high, place))
        t = dr.select(seen, dr.clip(t, begin, end), 0)
        j = mi.Spectrum(emission.at_world(ray(t), seen))
        share = split / dr.fma(channel_mean(j), dr.square(t), split)
        passed = mi.Spectrum(medium_transmittance(medium, ray, t, seen))
        length = (high - low) * (dr.square(t) + dr.square(scale)) / scale
        part = dr.select(seen, j * passed * (4 * dr.pi * weight * share * length), 0)
        total = with_radiance(total, position, ray.d, mi.Spectrum(0), part, angular_basis)

        p, rng = points.sample([x, y], rng)
        offset = p - position
        square = dr.squared_norm(offset)
        distance = dr.sqrt(square)
        seen = medium.contains(p) & (distance > 0)
        direction = dr.select(seen, offset / distance, mi.Vector3f(0, 0, 1))
        j = mi.Spectrum(emission.at_world(p, seen))
        ray = mi.Ray3f(position, direction)
        passed = mi.Spectrum(medium_transmittance(medium, ray, distance, seen))
        share = points.power * weight / dr.fma(channel_mean(j), square, split)
        part = dr.select(seen, j * passed * share, 0)
        total = with_radiance(total, position, direction, mi.Spectrum(0), part, angular_basis)
        k += 1
    return total
