"""Points, spots and suns: emitters whose radiance comes from one direction at each position."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.sequences import kronecker_words, unit_floats
from mitsuba_irrcache.gradients.scattering import Components, IsotropicScattering, OrdinatePart
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import suns
from mitsuba_irrcache.lights.falloff import InverseSquareFactor, VoxelSamplePoints
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from mitsuba_irrcache.transport.tracking import medium_transmittance

#: Transmittance between a light and the middle of a voxel below which its irradiance counts as 0.
OPAQUE = 1e-30


class LightsOfOneDirection:
    """All points and spots of ``scene``, followed by its suns.

    Attributes:
        emitters: the emitters; ``points`` is the number of those that are not suns.
        positions: where each voxel is irradiated.
        at_positions: irradiance there of each point and spot.
        irradiance: irradiance of each emitter in the voxels: means for points and spots.
        parts: index of the part of the radiance to which each emitter belongs.
        even: number of ordinates that precede those of suns; each sun has ``sun_tracks``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        grid: Grid,
        scattering: IsotropicScattering,
        illumination: DistantIllumination,
    ) -> None:
        self._scattering = scattering
        self.points = len(illumination.point_lights)
        self.emitters = [*illumination.point_lights, *suns(scene)]
        voxels = dr.arange(mi.UInt32, grid.voxel_count)
        self.positions = VoxelSamplePoints(scene, grid).of(voxels)
        self.at_positions = illumination.point_irradiance(medium, self.positions)
        falloff = InverseSquareFactor.of(scene, grid) if self.at_positions else None
        #: ratio of means over the voxels to values at the positions, for points and spots
        self.spread = falloff.spread(voxels) if falloff is not None else mi.Float(1)
        self.irradiance = [irradiance * self.spread for irradiance in self.at_positions]
        dr.eval(self.at_positions, self.irradiance)
        self.parts = scattering.point_parts(self.points)
        self._medium, self._grid = medium, grid

    def add_suns(self, ordinates: Ordinates, parts: Sequence[OrdinatePart], pairs: int) -> None:
        """Compute the irradiance of the suns, whose ``pairs`` of ordinates are the last ones."""
        suns = len(self.emitters) - self.points
        self.sun_tracks = pairs // max(suns, 1)
        self.even = len(ordinates.directions) - pairs
        for number in range(suns):
            first = self.even + number * self.sun_tracks
            entering = ordinates.incoming[first : first + self.sun_tracks].sum(axis=(0, 1))
            values = mi.Spectrum(*(dr.opaque(mi.Float, float(v)) for v in entering))
            self.irradiance.append(values * self.transmittance(self.points + number))
            own = (n for n, part in enumerate(parts) if part.receives(first))
            self.parts.append(next(own, 0))
        dr.eval(self.irradiance)

    def towards(self, light: int) -> mi.Vector3f:
        """Return the direction from each voxel to an emitter, given its index."""
        return self._record(light, self.positions).d

    def transmittance(self, light: int) -> mi.Spectrum:
        """Return the transmittance of the medium between each voxel and an emitter."""
        return self._transmittance(light, self.positions)

    def positions_within(self, light: int, count: int) -> Iterator[tuple[mi.Point3f, mi.Spectrum]]:
        """Yield ``count`` positions in every voxel, one after the other; and the irradiance there
        over that in the middle of the voxel and over ``count``.

        A single position is the middle; several are those of a low-discrepancy sequence.
        """
        # docs/primer, below eq. (8.9)
        if count == 1:
            yield self.positions, mi.Spectrum(dr.opaque(mi.Float, 1, dr.width(self.positions)))
            return
        middle = self.transmittance(light)
        per_middle = dr.select(middle > OPAQUE, dr.rcp(dr.maximum(middle, OPAQUE)), 0) / count
        world, voxels = self._grid.world, dr.arange(mi.UInt32, self._grid.voxel_count)
        for number in range(count):
            index = voxels * dr.opaque(mi.UInt32, count) + dr.opaque(mi.UInt32, number)
            place = unit_floats(kronecker_words(index, [mi.UInt32(0)] * 3))
            p = self.positions + world.vector(mi.Vector3f(*place) - 0.5)
            share = self._transmittance(light, p) * per_middle
            dr.eval(p, share)
            yield p, share

    def unattenuated(self, light: int, irradiance: mi.Spectrum) -> mi.Spectrum:
        """Return an ``irradiance`` in the voxels without what the medium on the way removes."""
        passed = self.transmittance(light)
        return dr.select(passed > OPAQUE, irradiance / dr.maximum(passed, OPAQUE), 0)

    def _transmittance(self, light: int, p: mi.Point3f) -> mi.Spectrum:
        record = self._record(light, p)
        through = medium_transmittance(
            self._medium, mi.Ray3f(p, record.d), record.dist, mi.Bool(True)
        )
        return mi.Spectrum(through)

    def _record(self, light: int, p: mi.Point3f) -> mi.DirectionSample3f:
        at = dr.zeros(mi.Interaction3f, dr.width(p))
        at.p = p
        return self.emitters[light].sample_direction(at, mi.Point2f(0.5))[0]

    def derivative(self, light: int, direct: list[list[Components]]) -> mi.Spectrum:
        """Return the derivatives with respect to the irradiance of an emitter, by voxel.

        ``direct`` is that of `Derivatives`.
        """
        direction, part = self.towards(light), self.parts[light]
        return mi.Spectrum(*(self._scattering.into(own[part], direction) for own in direct))

    def with_points(self, channel: int, components: Components) -> Components:
        """Add the radiance of points and spots to the ``components`` of collisions."""
        from_lights = [
            self._scattering.from_direction(self.irradiance[light][channel], self.towards(light))
            for light in range(self.points)
        ]
        if not from_lights:
            return components
        return [a + sum(own) for a, *own in zip(components, *from_lights, strict=True)]
