"""Direct illumination by small area emitters and point-like emitters among surfaces, sampled from
each voxel (next event estimation).

Tracks, which all voxels share, rarely hit an emitter, and then contribute to many voxels at once.
Points on emitters are therefore sampled from each voxel, and tracks ignore these emitters. Emitters
that surround most voxels are hit by tracks instead. Emitters near the medium whose solid angle has
a closed form (`cache/area_light`) are treated in neither way.

Lookups interpolate square roots, whose mean is too small by an eighth of the relative variance of
their squares. The number of points therefore follows from the measured variance.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis, empty_sums, with_radiance
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import hashed_seed, kronecker, random_stream
from mitsuba_irrcache.core.spectrum import channel_mean
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of, varies_in_space
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.medium_probe import probe
from mitsuba_irrcache.transport.path import Media, position_on, visibility
from mitsuba_irrcache.transport.tracking import medium_transmittance

#: Mean solid angle [sr] of an emitter, seen from the voxels, above which tracks hit it.
LARGE_SOLID_ANGLE = 3.5
#: Number of pairs of a point in the voxels' box and one on the emitter for this estimate.
POINTS = 1024
#: Minimum and maximum number of points on all area emitters together in an estimate for each voxel,
#: and maximum over all voxels above this minimum; largest relative variance of the mean of two such
#: estimates, and number of positions at which it is measured.
FEWEST_SAMPLES, MOST_SAMPLES, MOST_RAYS = 16, 256, 1 << 24
LARGEST_VARIANCE, TESTS = 0.02, 2048


def is_area_emitter(emitter: mi.Emitter) -> bool:
    """Return whether it is an area emitter that emits in all directions."""
    return kind_of(emitter) is EmitterKind.AREA


def split_by_solid_angle(
    scene: mi.Scene, grid: Grid, lower: np.ndarray, upper: np.ndarray
) -> tuple[list[mi.Emitter], list[mi.Emitter]]:
    """Split the area emitters into small and large ones, seen from a box of voxels of ``grid``.

    The box lies between ``lower`` and ``upper`` (x, y, z).
    """
    small, large = [], []
    for emitter in scene.emitters():
        if is_area_emitter(emitter):
            angle = _solid_angle(emitter, grid, lower, upper)
            (small if angle < LARGE_SOLID_ANGLE else large).append(emitter)
    return small, large


def _solid_angle(emitter: mi.Emitter, grid: Grid, lower: np.ndarray, upper: np.ndarray) -> float:
    """Estimate the mean solid angle over positions in the box, ignoring occlusion."""
    rng = np.random.default_rng(POINTS)
    u = np.float32(rng.random((5, POINTS)))
    found = emitter.get_shape().sample_position(0.0, mi.Point2f(u[:2]))
    box = np.float32(lower[:, None] + u[2:] * (upper - lower)[:, None])
    offset = found.p - grid.world.point(mi.Point3f(box))
    distance = dr.norm(offset)
    cosine = dr.abs(dr.dot(offset, found.n)) / distance
    angle = cosine / (dr.square(distance) * found.pdf)
    return float(dr.mean(dr.minimum(angle, 2 * dr.pi))[0])


class EmitterSampling:
    """Irradiance at world positions ``p`` in ``medium`` from ``small`` area emitters, with moments
    if there is an angular basis, and from ``point_lights``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        small: Sequence[mi.Emitter],
        point_lights: Sequence[mi.Emitter],
        p: mi.Point3f,
        angular_basis: AngularBasis | None = None,
        is_shared: bool = False,
    ) -> None:
        """``is_shared`` states that positions in the box of ``medium`` may be in other media, or in
        none.
        """
        self.scene, self.medium, self.p = scene, medium, p
        self.angular_basis, self._is_shared = angular_basis, is_shared
        self._media = Media.around(medium)
        self._other_media = self._media.without(medium)
        self._small = len(small)
        self._is_textured = any(varies_in_space(emitter) for emitter in small)
        if small:
            pointers = [mi.EmitterPtr(e) for e in small]
            self._emitters = dr.zeros(mi.EmitterPtr, len(small) + 1)
            for i, emitter in enumerate(pointers):
                dr.scatter(self._emitters, emitter, mi.UInt32(i))
            dr.eval(self._emitters)
        #: number of points on small area emitters in an estimate for each position
        self.points_per_voxel = self._number_of_points() if small else 0
        #: the irradiance from each point-like emitter
        self.from_points = [self._from(light) for light in point_lights]

    @property
    def has_area_emitters(self) -> bool:
        """Whether there are small area emitters."""
        return self._small > 0

    def from_area_emitters(self, seed: tuple[int, int]) -> list[mi.Spectrum]:
        """Return an unbiased estimate for all small area emitters: the irradiance, then its
        moments.
        """
        return self._estimate(self.p, seed, self.points_per_voxel)

    def _estimate(self, p: mi.Point3f, seed: tuple[int, int], samples: int) -> list[mi.Spectrum]:
        """Return the result of `from_area_emitters` at ``p`` with this number of ``samples``."""
        lane = dr.arange(mi.UInt32, dr.width(p))
        rng = random_stream(mi.sample_tea_32(lane, hashed_seed(seed)[1]))
        count, samples = (dr.opaque(mi.UInt32, n) for n in (self._small, samples))
        found = _mean_irradiance(self, p, self._emitters, count, samples, rng)
        dr.eval(found)
        return found

    def _number_of_points(self) -> int:
        """Return the power of two that reduces the variance to `LARGEST_VARIANCE`, from
        `FEWEST_SAMPLES`, or one for each emitter if there are more, to `MOST_SAMPLES`.

        The variance is relative to the square of the irradiance, and is averaged over positions
        with the radiance that they scatter as the weight. It is that of the noisiest channel.
        """
        fewest = min(max(FEWEST_SAMPLES, self._small), MOST_SAMPLES)
        most = int(np.clip(MOST_RAYS // dr.width(self.p), fewest, MOST_SAMPLES))
        if most == fewest:
            return fewest
        rng = np.random.default_rng(TESTS)
        number = mi.UInt32(rng.integers(dr.width(self.p), size=TESTS).astype(np.uint32))
        p = dr.gather(mi.Point3f, self.p, number)
        first, second = (self._estimate(p, (TESTS, k), fewest)[0] for k in (0, 1))
        scattering = channel_mean(self.medium.sigma_t.at_world(p))
        mean, variance = 0.5 * (first + second), 0.25 * dr.square(first - second)
        weights = mi.Spectrum(scattering) * mean
        relative = dr.select(mean > 0, variance / dr.square(mean), 0)
        sums = [(dr.sum(w), dr.sum(w * v)) for w, v in zip(weights, relative, strict=True)]
        dr.eval(sums)
        variance = max(float(v[0]) / max(float(total[0]), 1e-30) for total, v in sums)
        required = fewest * 2 ** np.ceil(np.log2(max(variance / LARGEST_VARIANCE, 1)))
        return int(min(required, most))

    def sample(
        self,
        p: mi.Point3f,
        emitter: mi.EmitterPtr,
        sample: mi.Point2f,
        rng: mi.PCG32,
        by_shape: mi.Bool = False,
    ) -> tuple[mi.Spectrum, mi.Vector3f, mi.PCG32]:
        """Sample the irradiance at ``p`` straight from an emitter.

        ``by_shape`` is as in `_sample_textured`. Returns the irradiance, the direction towards the
        emitter, and the random generator.
        """
        medium = self.medium
        vertex = dr.zeros(mi.Interaction3f, dr.width(p))
        vertex.p = p
        if self._is_textured:
            record, irradiance = _sample_textured(emitter, vertex, sample, by_shape)
        else:
            record, irradiance = emitter.sample_direction(vertex, sample)
        visible, target = dr.max(irradiance) > 0, position_on(record, vertex)
        if self._is_shared:
            pointer = probe(self.scene, p, record.d)
            passed, rng = visibility(
                self.scene, self._media, vertex, target, pointer, rng, visible, exact=True
            )
            return dr.select(visible, irradiance * passed, 0), record.d, rng
        # The transmittance of this medium is integrated separately, without noise.
        passed, rng = visibility(
            self.scene, self._other_media, vertex, target, medium.pointer, rng, visible
        )
        visible &= dr.max(passed) > 0
        passed *= medium_transmittance(medium, mi.Ray3f(p, record.d), record.dist, visible)
        return dr.select(visible, irradiance * passed, 0), record.d, rng

    def _from(self, emitter: mi.Emitter) -> mi.Spectrum:
        """Compute the irradiance from a point-like emitter."""
        irradiance, *_ = self.sample(self.p, emitter, mi.Point2f(0.5), mi.PCG32(dr.width(self.p)))
        dr.eval(irradiance)
        return irradiance


def _sample_textured(
    emitter: mi.EmitterPtr, vertex: mi.Interaction3f, sample: mi.Point2f, by_shape: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """Sample the irradiance from an area emitter whose radiance may vary, by one of two strategies
    that are used equally often (balance heuristic).

    Mitsuba samples textures in proportion to their luminance: few points then have the colour of
    darker texels. Half of the points are therefore sampled from the shape alone, ``by_shape``;
    not those of spheres, whose samples have no texture coordinates. All of those on cylinders are:
    Mitsuba samples their textures with densities of other positions.
    """
    shape = emitter.get_shape()
    is_sphere = shape.shape_type() == int(mi.ShapeType.Sphere)
    is_cylinder = shape.shape_type() == int(mi.ShapeType.Cylinder)
    record, irradiance = emitter.sample_direction(vertex, sample)
    other = shape.sample_direction(vertex, sample)
    record = dr.select(is_cylinder | (by_shape & ~is_sphere), other, record)
    of_shape = shape.pdf_direction(vertex, record)
    of_texture = dr.select(is_cylinder, of_shape, emitter.pdf_direction(vertex, record))
    density = of_texture + of_shape
    radiance = emitter.eval_direction(vertex, record)
    mixture = dr.select(density > 0, radiance * 2 / density, 0)
    return record, dr.select(is_sphere, irradiance, mixture)


@symbolic
def _mean_irradiance(sampling, p, emitters, count, samples, rng):
    """Average samples of the irradiance at ``p`` from all ``count`` emitters, and its moments."""
    shift = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    total, k = empty_sums(sampling.angular_basis), mi.UInt32(0)
    weight = mi.Float(count) / mi.Float(samples)
    while dr.hint(k < samples, label="area emitters"):
        # Distribute the points evenly among the emitters and over each of them.
        which = mi.UInt32((mi.Float(k) + shift.z) / mi.Float(samples) * mi.Float(count))
        emitter = dr.gather(mi.EmitterPtr, emitters, dr.minimum(which, count - 1))
        sample = mi.Point2f(kronecker(k, 2, (shift.x, shift.y)))
        by_shape = (k & 1) == 1
        irradiance, towards, rng = sampling.sample(p, emitter, sample, rng, by_shape)
        total = with_radiance(
            total, p, towards, irradiance * weight, mi.Spectrum(0), sampling.angular_basis
        )
        k += 1
    return total
