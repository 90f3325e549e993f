"""Direct light in voxels that surfaces cut, from emitters whose irradiance is known in closed form.

A voxel has one source. If a surface cuts it, that is the source on the side of its centre, and the
part on the other side scatters what a neighbouring voxel does (`crossings`). Next to an emitting
surface, the irradiance of the emitter differs by a large factor between both. So here

- the mean irradiance of a cut voxel is that over the side of its centre;
- on the other side, the light of emitters that is scattered once is computed from the irradiance
  there: the difference to what the neighbouring voxel scatters is known before the iteration, and
  is added to the radiance along the tracks (`boundary_condition`).
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.crossings import SurfaceCrossings, SurfaceVoxels

#: Number of points along each edge of a cut voxel over which irradiance is averaged.
POINTS = 6
#: Largest optical depth of a part of a track for which its attenuation is compensated.
MOST_DEPTH = 4.0


class CutVoxelLight:
    """Irradiance of the ``lights`` in the ``voxels`` (flat indices) of ``surfaces.grid``.

    ``means`` are the mean irradiances over the voxels, in those that surfaces cut over the side of
    the centre, for each light (by the identity of its irradiance).
    """

    def __init__(
        self,
        lights: Sequence[DirectLight],
        medium: MediumGrid,
        surfaces: SurfaceVoxels,
        voxels: mi.UInt32,
    ) -> None:
        self._lights, self._medium, self._surfaces = lights, medium, surfaces
        place = dr.compress(surfaces.is_cut_at(voxels))
        cut = dr.gather(mi.UInt32, voxels, place)
        self.means: dict[int, mi.Spectrum] = {}
        self._total = dr.zeros(mi.Spectrum, surfaces.grid.voxel_count)
        total = mi.Spectrum(0)
        for light in lights:
            mean = mi.Spectrum(light.means + dr.zeros(mi.Float, dr.width(voxels)))
            if dr.width(cut):
                dr.eval(mean)
                dr.scatter(mean, self._mean_on_the_side_of_the_centre(light, cut), place)
            dr.eval(mean)
            self.means[id(light.irradiance)] = mean
            total += mean
        dr.scatter(self._total, total, voxels)
        dr.eval(self._total)

    def scattered_radiance(self, p: mi.Point3f, voxel: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """Return by how much the radiance that is scattered once, per unit of albedo, exceeds that
        of a ``voxel`` at world positions.
        """
        total = mi.Spectrum(0)
        for light in self._lights:
            total += self._irradiance(light, p, active)
        difference = total - dr.gather(mi.Spectrum, self._total, voxel, active)
        return dr.select(active, difference * dr.inv_four_pi, 0)

    def along_hidden_parts(self, crossings: SurfaceCrossings, rng: mi.PCG32) -> mi.Spectrum:
        """Return the radiance of `scattered_radiance` that leaves the parts of tracks that are
        hidden from the centre of their voxel, for each crossing, both ways in turn.

        Behind a surface, it is the radiance at the beginning of the part, which is then attenuated.
        """
        # docs/primer, eq. (4.17)
        begin, end, voxel, crosses, hidden = crossings.hidden_parts()
        p = dr.lerp(begin, end, rng.next_float32())
        length = dr.norm(end - begin)
        depth = mi.Spectrum(self._medium.sigma_t.at_world(p)) * length
        depth = dr.minimum(depth, MOST_DEPTH)
        leaving = dr.select(crosses, dr.exp(depth) - 1, 1 - dr.exp(-depth))
        albedo = mi.Spectrum(self._medium.albedo.at_world(p))
        return leaving * albedo * self.scattered_radiance(p, voxel, hidden & (length > 0))

    @staticmethod
    def _irradiance(light: DirectLight, p: mi.Point3f, active: mi.Bool) -> mi.Spectrum:
        """Return the irradiance of a ``light`` at world positions."""
        passed = dr.exp(-light.depth(p, active)) * light.past_others(p, active)
        return mi.Spectrum(passed) * light.unobstructed(p, active)

    @symbolic
    def _mean_on_the_side_of_the_centre(self, light: DirectLight, voxel: mi.UInt32):
        """Average the irradiance of a ``light`` over the points of voxels that are visible from
        their centres.
        """
        grid = self._surfaces.grid
        corner, centre = mi.Point3f(*grid.voxel_indices(voxel)), grid.centers(voxel)
        total, count, k = mi.Spectrum(0), mi.Float(0), mi.UInt32(0)
        n = dr.opaque(mi.UInt32, POINTS)
        while dr.hint(k < n * n * n, label="points in a cut voxel"):
            place = mi.Point3f(k % n, (k // n) % n, k // (n * n)) + 0.5
            p = grid.world.point(corner + place / mi.Float(n))
            hidden, _ = self._surfaces.hidden(voxel, centre, p, mi.Bool(True))
            counts = ~hidden & self._medium.contains(p)
            total += self._irradiance(light, p, counts)
            count += dr.select(counts, mi.Float(1), 0)
            k += 1
        return dr.select(count > 0, total / dr.maximum(count, 1), 0)
