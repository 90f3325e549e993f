"""Light of small emitters nearby, at each voxel of the solver ``sweep`` among surfaces.

The lines that all voxels share meet a small lamp rarely, and then all at once. So points on lamps
are sampled from each voxel, and the lines do not count what they meet of these. Lamps that fill
much of what the voxels see are left to the lines: few points on them matter to a voxel close by.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis, added, nothing
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.core.sequences import hashed_seed, kronecker, random_stream
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.path import visibility
from mitsuba_irrcache.transport.tracking import medium_transmittance

#: Solid angle of an emitter, on average over the voxels, from which on lines are relied upon to
#: meet it [sr].
LARGE = 2.0
#: Points of the voxels' box, and as many on an emitter, that tell of its solid angle.
POINTS = 1024
#: Points on lamps that are sampled from each voxel in a batch; one on each, if there are more, but
#: never more than the latter.
SAMPLES, MOST_SAMPLES = 4, 16


def is_lamp(emitter: mi.Emitter) -> bool:
    """Whether it is an area light that shines in all directions."""
    flags = emitter.flags()
    return mi.has_flag(flags, mi.EmitterFlags.Surface) and not mi.has_flag(
        flags, mi.EmitterFlags.Delta
    )


def split(
    scene: mi.Scene, grid: Grid, lower: np.ndarray, upper: np.ndarray
) -> tuple[list[mi.Emitter], list[mi.Emitter]]:
    """Area lights that are small, and that are large, as seen from the box of voxels of ``grid``
    between ``lower`` and ``upper`` (x, y, z).
    """
    small, large = [], []
    for emitter in scene.emitters():
        if is_lamp(emitter):
            angle = _solid_angle(emitter, grid, lower, upper)
            (small if angle < LARGE else large).append(emitter)
    return small, large


def _solid_angle(emitter: mi.Emitter, grid: Grid, lower: np.ndarray, upper: np.ndarray) -> float:
    """On average over places in the box, about; what is in the way does not count."""
    rng = np.random.default_rng(POINTS)
    u = np.float32(rng.random((5, POINTS)))
    found = emitter.get_shape().sample_position(0.0, mi.Point2f(u[:2]))
    box = np.float32(lower[:, None] + u[2:] * (upper - lower)[:, None])
    way = found.p - grid.world.point(mi.Point3f(box))
    distance = dr.norm(way)
    cosine = dr.abs(dr.dot(way, found.n)) / distance
    angle = cosine / (dr.square(distance) * found.pdf)
    return float(dr.mean(dr.minimum(angle, 2 * dr.pi))[0])


class Lamps:
    """Irradiance at world positions ``p`` in ``medium``: from ``small`` area lights, with moments
    where light is told by its direction, and from point-like ``lights``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        small: Sequence[mi.Emitter],
        lights: Sequence[mi.Emitter],
        p: mi.Point3f,
        directional: AngularBasis | None = None,
    ) -> None:
        self._scene, self._medium, self._p = scene, medium, p
        self._directional = directional
        self._others = medium.surroundings.media.around(medium).without(medium)
        self._small = len(small)
        if small:
            pointers = [mi.EmitterPtr(e) for e in small]
            self._emitters = dr.zeros(mi.EmitterPtr, len(small) + 1)
            for i, emitter in enumerate(pointers):
                dr.scatter(self._emitters, emitter, mi.UInt32(i))
            dr.eval(self._emitters)
        self._lights = [self._from(light) for light in lights]

    def light(self, seed: tuple[int, int]) -> list[list[mi.Spectrum]]:
        """Irradiance from each point-like light; a sample of that from all lamps, and of its
        moments.
        """
        if not self._small:
            return self._lights
        samples = min(max(SAMPLES, self._small), MOST_SAMPLES)
        lane = dr.arange(mi.UInt32, dr.width(self._p))
        rng = random_stream(mi.sample_tea_32(lane, hashed_seed(seed)[1]))
        light = _sampled(
            self._scene, self._medium, self._others, self._emitters, self._p,
            dr.opaque(mi.UInt32, self._small), dr.opaque(mi.UInt32, samples), rng,
            self._directional,
        )  # fmt: skip
        dr.eval(light)
        return [*self._lights, light]

    def _from(self, emitter: mi.Emitter) -> list[mi.Spectrum]:
        """Irradiance from a point-like emitter."""
        rng = mi.PCG32(dr.width(self._p))
        light, *_ = _shone(
            self._scene, self._medium, self._others, emitter, self._p,
            mi.Point2f(0.5), rng,
        )  # fmt: skip
        dr.eval(light)
        return [light]


def _shone(scene, medium, others, emitter, p, sample, rng) -> tuple:
    """One sample of the irradiance at ``p`` straight from an emitter, the direction it comes from,
    and the random generator.
    """
    vertex = dr.zeros(mi.Interaction3f, dr.width(p))
    vertex.p = p
    record, light = emitter.sample_direction(vertex, sample)
    lit = dr.max(light) > 0
    # The medium itself is marched through apart, without noise.
    passed, rng = visibility(scene, others, vertex, record.p, medium.pointer, rng, lit)
    lit &= dr.max(passed) > 0
    passed *= medium_transmittance(medium, mi.Ray3f(p, record.d), record.dist, lit)
    return dr.select(lit, light * passed, 0), record.d, rng


@symbolic
def _sampled(scene, medium, others, emitters, p, count, samples, rng, directional):
    """The mean of samples of the irradiance from all of ``count`` lamps, and of its moments."""
    shift = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    total, k = nothing(directional), mi.UInt32(0)
    weight = mi.Float(count) / mi.Float(samples)
    while dr.hint(k < samples, label="lamps"):
        # The same number on each lamp, as far as it goes; evenly spread over it.
        which = mi.UInt32((mi.Float(k) + shift.z) / mi.Float(samples) * mi.Float(count))
        emitter = dr.gather(mi.EmitterPtr, emitters, dr.minimum(which, count - 1))
        sample = mi.Point2f(kronecker(k, 2, (shift.x, shift.y)))
        light, towards, rng = _shone(scene, medium, others, emitter, p, sample, rng)
        total = added(total, p, towards, light * weight, mi.Spectrum(0), directional)
        k += 1
    return total
