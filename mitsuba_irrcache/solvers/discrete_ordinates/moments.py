"""Light by its direction, as the lines of the solver ``sweep`` tell it.

Where a medium does not scatter alike to all sides, what is solved for is not the irradiance alone,
but all coefficients of the radiance in spherical harmonics that the phase function asks for: as
many times the voxels in one array, degree by degree. The first of them is the irradiance itself;
L_lm is multiplied by g_l wherever light is scattered (see `phase`).
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.solvers.discrete_ordinates.layout import concatenated, layer_and_index
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import BoundaryOrdinateSet, OrdinateSet
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup, TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks, values_at_centres

#: Highest degree of what is corrected on coarser grids.
SMOOTH = 1


class Moments:
    """Those of a ``directional`` medium."""

    def __init__(self, directional: AngularBasis, order: int | None = None) -> None:
        """Up to ``order`` (None: all that there are)."""
        self.directional = directional
        self.order = directional.order if order is None else order
        #: their degrees
        self.degrees = [n for n in range(self.order + 1) for _ in range(2 * n + 1)]
        factors = [directional.phase.moments[n] for n in self.degrees]
        #: by how much each of them is less once light is scattered
        self.factors = mi.Float([float(g) for g in factors])

    @property
    def count(self) -> int:
        return len(self.degrees)

    def basis(self, direction: mi.Vector3f) -> list[mi.Float]:
        """What light that comes from ``direction`` adds to each for an irradiance of 1."""
        return [mi.Float(1), *dr.sh_eval(direction, self.order)[1:]]

    def of(self, light: mi.Float, direction: mi.Vector3f) -> mi.Float:
        """Moments of the irradiance ``light`` from ``direction``, at each place."""
        return concatenated([light * y for y in self.basis(direction)])

    def part(self, values: mi.Float, number: int) -> mi.Float:
        """One of the moments at all places."""
        width = dr.width(values) // self.count
        index = dr.arange(mi.UInt32, width) + number * dr.opaque(mi.UInt32, width)
        return dr.gather(mi.Float, values, index)

    def carry(
        self,
        lattice: Tracks,
        directions: np.ndarray,
        light: np.ndarray,
        offsets: np.ndarray,
        entering: Callable | None = None,
    ) -> mi.Float:
        """As `Tracks.carry`: moments of the light that enters."""
        table = lattice.table(directions, light, np.zeros(len(light)), offsets, by_slice=True)
        table.boundary_source = entering(table) if entering is not None else None
        wanted = lattice.active
        sums = self.nothing(dr.width(wanted))
        box = lattice.lower, lattice.lower + lattice.size
        for axis, group, copies in lattice.sweep_separately(table):
            sums = _with_light(self, sums, copies, group, axis, lattice.grid, *box, wanted)
            dr.eval(sums)
        return concatenated(sums)

    def nothing(self, width: int) -> list[mi.Float]:
        """No light, at so many places."""
        return [dr.opaque(mi.Float, 0, width) for _ in range(self.count)]

    def uncollided(
        self, passes: list[OrdinateSet] | list[BoundaryOrdinateSet], lattice: Tracks
    ) -> tuple[mi.Float, list[mi.Float | None]]:
        """Moments of the light straight from emitters along lines at the wanted voxels, the sum of
        all ``passes``, but for that of narrow lights; and those of each narrow light (none where it
        is not far away).
        """
        found = [
            self.carry(lattice, *rows) if len(rows[0]) else None
            for rows in passes[0].straight(passes, self.directional)
        ]
        smooth = dr.opaque(mi.Float, 0, self.count * dr.width(lattice.active))
        return (smooth if found[0] is None else found[0]), found[1:]


class AnisotropicMultigridLevel(MultigridLevel):
    """A `MultigridLevel` whose light are the ``moments``, one after the other."""

    def __init__(self, *arguments: object, moments: Moments) -> None:
        """``arguments`` are those of `MultigridLevel`."""
        super().__init__(*arguments)
        self.moments = moments

    def _coarse(self, *arguments: object) -> AnisotropicMultigridLevel:
        # What is slow to converge is smooth, and so are its directions.
        smooth = Moments(self.moments.directional, min(self.moments.order, SMOOTH))
        return AnisotropicMultigridLevel(*arguments, self.evenly, moments=smooth)

    def restrict(self, values: mi.Float) -> mi.Float:
        coarser = self.coarser
        moment, place = layer_and_index(coarser.lattice.active_count, coarser.moments.count)
        begin, result = moment * dr.opaque(mi.UInt32, self.lattice.active_count), mi.Float(0)
        for child, weight in self._children:
            voxel = begin + dr.gather(mi.UInt32, child, place)
            result += dr.gather(mi.Float, values, voxel) * dr.gather(mi.Float, weight, place)
        dr.eval(result)
        return result

    def prolong(self, values: mi.Float) -> mi.Float:
        """As of `MultigridLevel`; moments that the coarser one does not have are 0."""
        moments = self.coarser.moments
        moment, place = layer_and_index(self.lattice.active_count, self.moments.count)
        known = moment < dr.opaque(mi.UInt32, moments.count)
        begin = dr.select(known, moment, 0) * dr.opaque(
            mi.UInt32, self.coarser.lattice.active_count
        )
        return dr.select(known, self._interpolated(values, place, 1, begin), 0)

    def scatter(self, phi: mi.Float | None, table: TrackTable) -> tuple[mi.Float, mi.Float]:
        """As of `MultigridLevel`, all moments of it."""
        moments, wanted, voxels = self.moments, self.lattice.active, self.grid.voxel_count
        if phi is not None and table.boundary_source is not None:
            table.boundary_source.receive(phi)
        received, lost = (moments.nothing(self.lattice.active_count) for _ in range(2))
        depth = dr.opaque(mi.Float, 0, self.lattice.active_count)
        scattered = None if phi is None else self._scattered(phi)

        def sent(group: PairGroup) -> mi.Float:
            source = dr.opaque(mi.Float, 0, 2 * len(group) * voxels)
            if scattered is not None:
                _send_out(moments, source, scattered, group, wanted, voxels)
                dr.eval(source)
            return source

        for _, group, copies in self.lattice.sweep_separately(table, sent):
            found = _with_collisions(moments, received, lost, depth, copies, group, wanted, voxels)
            dr.eval(found)
            received, lost, depth = found
        # Weighted by their depths, what lines lose lets as much be scattered as collides.
        collided = [4 * dr.pi * lost[0] / dr.select(depth > 0, depth, 1), *lost[1:]]
        if scattered is not None:
            # Directions tell what differs from what a voxel sends out, whose moments are known.
            received = [light + moments.part(scattered, k) for k, light in enumerate(received)]
            collided = [mean + moments.part(scattered, k) for k, mean in enumerate(collided)]
        pairs = zip(collided, received, strict=True)
        collided = [self.known_from(depth, mean, light) for mean, light in pairs]
        return concatenated(received), concatenated(collided)

    def seen(self, phi: mi.Float, place: mi.UInt32, heading: mi.Vector3f | None) -> mi.Float:
        """As of `MultigridLevel`."""
        step, result = (
            dr.opaque(mi.UInt32, self.lattice.active_count),
            dr.gather(mi.Float, phi, place),
        )
        basis = self.moments.directional.basis(heading)
        for factor in basis[: self.moments.count - 1]:
            place = place + step
            result = dr.fma(factor, dr.gather(mi.Float, phi, place), result)
        return result

    def _scattered(self, phi: mi.Float) -> mi.Float:
        """Moments of the light that is sent out, per optical depth."""
        moment, place = layer_and_index(self.lattice.active_count, self.moments.count)
        factor = dr.gather(mi.Float, self.moments.factors, moment)
        scattered = phi * factor * dr.gather(mi.Float, self.albedo, place)
        dr.eval(scattered)
        return scattered


@symbolic
def _with_light(moments, sums: list, copies, group, axis: int, grid, lower, upper, wanted):
    """``sums`` and the moments of the light that lines of a group have left."""
    voxels = dr.opaque(mi.UInt32, grid.voxel_count)
    k, begin = mi.UInt32(0), mi.UInt32(0)
    while dr.hint(k < group.count, label="light of pairs"):
        there = values_at_centres(copies, grid, lower, upper, axis, wanted, begin=begin)
        back = values_at_centres(copies, grid, lower, upper, axis, wanted, begin=begin + voxels)
        basis = moments.basis(-group.direction(k))
        sums = _with_both(moments, sums, basis, there, back)
        k += 1
        begin += 2 * voxels
    return sums


@symbolic
def _with_collisions(
    moments, received: list, lost: list, depth, copies, group, wanted, voxels: int
):
    """Moments of the light in the ``wanted`` ones of so many voxels, without what they send out;
    what lines lose there, and moments of this per depth; the ``depth`` of these times solid angles:
    each with those of a group.
    """
    step = dr.opaque(mi.UInt32, voxels)
    k, place = mi.UInt32(0), mi.UInt32(wanted)
    while dr.hint(k < group.count, label="collisions of pairs"):
        there = dr.gather(mi.Vector4f, copies, place)
        back = dr.gather(mi.Vector4f, copies, place + step)
        basis = moments.basis(-group.direction(k))
        received = _with_both(moments, received, basis, there.y, back.y)
        # Of their own depth: in a voxel that few of them find matter in, the others would be
        # missing from the integral over directions, which then has a norm above 1.
        per_depth = [dr.select(v.w > 0, v.z / v.w, 0) for v in (there, back)]
        lost = [lost[0] + there.z + back.z, *_with_both(moments, lost, basis, *per_depth)[1:]]
        depth = depth + group.weight(k) * (there.w + back.w)
        k += 1
        place += 2 * step
    return received, lost, depth


def _with_both(moments: Moments, sums: list, basis: list, there: mi.Float, back: mi.Float) -> list:
    """Sums with light from the directions of ``basis`` and their opposites."""
    even, odd = there + back, there - back
    return [
        dr.fma(y, odd if degree % 2 else even, value)
        for degree, y, value in zip(moments.degrees, basis, sums, strict=True)
    ]


@symbolic
def _send_out(moments, source, scattered, group, wanted, voxels: int):
    """Writes the radiance per optical depth that the ``wanted`` ones of so many voxels send along
    the lines of a group, and against them.
    """
    parts = [moments.part(scattered, i) for i in range(moments.count)]
    step = dr.opaque(mi.UInt32, voxels)
    k, place = mi.UInt32(0), mi.UInt32(wanted)
    while dr.hint(k < group.count, label="light of voxels"):
        even, odd = parts[0] * dr.inv_four_pi, mi.Float(0)
        basis = moments.basis(-group.direction(k))
        for i in range(1, moments.count):
            if dr.hint(moments.degrees[i] % 2 == 1, mode="scalar"):
                odd = dr.fma(basis[i], parts[i], odd)
            else:
                even = dr.fma(basis[i], parts[i], even)
        dr.scatter(source, even + odd, place)
        dr.scatter(source, even - odd, place + step)
        k += 1
        place += 2 * step
