"""Spot lights, whose beams may be narrower than the voxels of a cache.

The irradiance of a spot light is E(p) V(p): what it would be without any matter, known in closed
form from the emitter, and the transmittance V of the way from the light, which is smooth. Only V is
interpolated. A cache holds the mean of E over each voxel times V, from which light is scattered
further; camera rays see that replaced by E(p) V(p).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.lights.emitters import position_of, spot_lights
from mitsuba_irrcache.lights.falloff import VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.path import visibility
from mitsuba_irrcache.transport.tracking import medium_transmittance

#: Points along each axis of a voxel over which a beam is averaged.
POINTS = 8
#: Points of a segment of a camera ray at which a beam is looked at.
SEGMENT_POINTS = 4


class Beam:
    """The irradiance of ``emitter`` at the ``voxels`` (flat indices) of ``grid`` in ``medium``."""

    def __init__(
        self,
        scene: mi.Scene,
        emitter: mi.Emitter,
        medium: MediumGrid,
        grid: Grid,
        voxels: mi.UInt32,
    ) -> None:
        self.emitter, self._grid, self._voxels = emitter, grid, voxels
        position = mi.Point3f([dr.opaque(mi.Float, float(v)) for v in position_of(emitter)])
        p = VoxelSamplePoints(scene, grid).of(voxels)
        way = position - p
        distance = dr.norm(way)
        ray = mi.Ray3f(p, way / dr.maximum(distance, 1e-30))
        passed = mi.Spectrum(medium_transmittance(medium, ray, distance, mi.Bool(True)))
        if medium.surroundings is not None:
            passed *= _past_others(scene, medium, p, position)
        mean = self._mean(voxels)
        dr.eval(passed, mean)
        #: V at the voxels
        self.transmittance = passed
        #: means over the voxels of E, times V
        self.irradiance = mean * passed
        dr.eval(self.irradiance)

    def unobstructed(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Spectrum:
        """E at world positions, without what the medium absorbs."""
        at = dr.zeros(mi.Interaction3f, dr.width(p))
        at.p = p
        _, light = self.emitter.sample_direction(at, mi.Point2f(0.5), active)
        return dr.select(active, light, 0)

    def field(self) -> RootField:
        """V for lookups, of one channel where all agree."""
        channels = [dr.sqrt(c) for c in self.transmittance]
        if all(dr.all(c == channels[0])[0] for c in channels[1:]):
            channels = channels[:1]
        count = len(channels)
        values = dr.zeros(mi.Float, self._grid.voxel_count * count)
        for c, value in enumerate(channels):
            dr.scatter(values, value, self._voxels * count + c)
        dr.eval(values)
        return RootField(self._grid, values, count)

    @symbolic
    def _mean(self, voxel: mi.UInt32):
        """Means of E over voxels."""
        corner, total, k = mi.Point3f(*self._grid.places(voxel)), mi.Spectrum(0), mi.UInt32(0)
        n = dr.opaque(mi.UInt32, POINTS)
        while dr.hint(k < n * n * n, label="points in a voxel"):
            place = mi.Point3f(k % n, (k // n) % n, k // (n * n)) + 0.5
            total += self.unobstructed(self._grid.world.point(corner + place / mi.Float(n)))
            k += 1
        return total / mi.Float(n * n * n)


def beams_of(scene: mi.Scene, medium: MediumGrid, grid: Grid, voxels: mi.UInt32) -> list[Beam]:
    """The beams of all spot lights of a scene; none in media that do not scatter isotropically,
    whose caches hold the irradiance of spots apart from that of other lights.
    """
    if medium.phase is not None or not dr.width(voxels):
        return []
    return [Beam(scene, emitter, medium, grid, voxels) for emitter in spot_lights(scene)]


def _past_others(
    scene: mi.Scene, medium: MediumGrid, p: mi.Point3f, target: mi.Point3f
) -> mi.Spectrum:
    """What surfaces and other media let through between ``p`` and ``target``."""
    others = medium.surroundings.media.around(medium).without(medium)
    vertex = dr.zeros(mi.Interaction3f, dr.width(p))
    vertex.p = p
    rng = mi.PCG32(dr.width(p))
    passed, _ = visibility(scene, others, vertex, target, medium.pointer, rng, mi.Bool(True))
    return passed


class BeamAlongRays:
    """A beam for camera rays: E in closed form, V interpolated."""

    def __init__(self, beam: Beam) -> None:
        self._beam, self._transmittance = beam, beam.field()

    def at(self, p: mi.Point3f, active: mi.Bool) -> mi.Spectrum:
        """Irradiance at world positions."""
        passed = mi.Spectrum(self._transmittance.at_world(p, active))
        return passed * self._beam.unobstructed(p, active)

    def scattered(
        self, ray: mi.Ray3f, a: mi.Float, b: mi.Float, weights: tuple, albedo: tuple
    ) -> mi.Spectrum:
        """Radiance scattered towards the camera between the distances ``a`` and ``b``, where
        ``weights`` are those of sources that fall and rise linearly, of `projection.segment`, and
        ``albedo`` is that at both ends. The density of the weights along the segment is taken as
        linear.
        """
        near, far = (mi.Spectrum(w) for w in weights)
        whole = near + far
        slope = dr.clip(3 * (far - near) / dr.select(whole > 0, whole, 1), -1, 1)
        total = mi.Spectrum(0)
        for i in range(SEGMENT_POINTS):
            u = (i + 0.5) / SEGMENT_POINTS
            p = ray(dr.lerp(a, b, u))
            share = dr.fma(slope, 2 * u - 1, 1) * (1 / SEGMENT_POINTS)
            total += share * mi.Spectrum(dr.lerp(*albedo, u)) * self.at(p, mi.Bool(True))
        return total * whole * dr.inv_four_pi
