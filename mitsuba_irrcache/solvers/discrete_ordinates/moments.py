"""Anisotropic scattering: spherical-harmonic moments of the radiance (S_N with P_L scattering).

Where the phase function is not isotropic, the unknown is not the irradiance alone but all moments
of the radiance up to the order of the phase function's Legendre expansion: as many times the voxels
in one array, degree by degree. The first moment is the irradiance; scattering multiplies a moment
of degree l by the phase function's moment g_l (see `phase`; Lewis and Miller 1984, chapter 4).
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.jit import concatenated, symbolic
from mitsuba_irrcache.solvers.discrete_ordinates.layout import layer_and_index
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import (
    BoundaryOrdinateSet,
    OrdinateSet,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup, TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks, values_at_centres

#: Highest degree of the moments that are corrected on coarser grids.
COARSE_ORDER = 1


class Moments:
    """Spherical-harmonic moments of the radiance, in the basis of an `AngularBasis`."""

    def __init__(self, angular_basis: AngularBasis, order: int | None = None) -> None:
        """Up to degree ``order`` (None: all that the phase function needs)."""
        self.angular_basis = angular_basis
        self.order = angular_basis.order if order is None else order
        #: degree of each moment
        self.degrees = [n for n in range(self.order + 1) for _ in range(2 * n + 1)]
        factors = [angular_basis.phase.moments[n] for n in self.degrees]
        #: what scattering multiplies each moment by
        self.factors = mi.Float([float(g) for g in factors])

    @property
    def count(self) -> int:
        """How many moments there are."""
        return len(self.degrees)

    def basis(self, direction: mi.Vector3f) -> list[mi.Float]:
        """The moments of an irradiance of 1 that comes from ``direction``."""
        return [mi.Float(1), *dr.sh_eval(direction, self.order)[1:]]

    def from_direction(self, irradiance: mi.Float, direction: mi.Vector3f) -> mi.Float:
        """The moments of an irradiance that comes from ``direction``, at each position."""
        return concatenated([irradiance * y for y in self.basis(direction)])

    def moment(self, values: mi.Float, number: int) -> mi.Float:
        """One of the moments at all positions."""
        width = dr.width(values) // self.count
        index = dr.arange(mi.UInt32, width) + dr.opaque(mi.UInt32, number * width)
        return dr.gather(mi.Float, values, index)

    def sweep_uncollided(
        self,
        tracks: Tracks,
        directions: np.ndarray,
        incoming: np.ndarray,
        offsets: np.ndarray,
        boundary_source: Callable | None = None,
    ) -> mi.Float:
        """Moments at the centres of the active voxels of what `Tracks.uncollided` finds."""
        none = np.zeros(len(incoming))
        table = tracks.table(directions, incoming, none, offsets, by_slice=True)
        table.boundary_source = boundary_source(table) if boundary_source is not None else None
        active = tracks.active
        sums = self.zeros(dr.width(active))
        box = tracks.lower, tracks.lower + tracks.size
        for axis, group, copies in tracks.sweep_separately(table):
            sums = _add_uncollided(self, sums, copies, group, axis, tracks.grid, *box, active)
            dr.eval(sums)
        return concatenated(sums)

    def zeros(self, width: int) -> list[mi.Float]:
        """Zero moments, at so many positions."""
        return [dr.opaque(mi.Float, 0, width) for _ in range(self.count)]

    def uncollided(
        self, sets: list[OrdinateSet] | list[BoundaryOrdinateSet], tracks: Tracks
    ) -> tuple[mi.Float, list[mi.Float | None]]:
        """Moments of the uncollided radiance along tracks at the active voxels, the sum of all
        ordinate ``sets``, without that of narrow sources; and those of each narrow source (None
        where it is not distant).
        """
        found = [
            self.sweep_uncollided(tracks, *arguments) if len(arguments[0]) else None
            for arguments in sets[0].uncollided(sets, self.angular_basis)
        ]
        smooth = dr.opaque(mi.Float, 0, self.count * dr.width(tracks.active))
        return (smooth if found[0] is None else found[0]), found[1:]


class AnisotropicMultigridLevel(MultigridLevel):
    """A `MultigridLevel` whose unknowns are the ``moments``, one after the other."""

    def __init__(
        self,
        sigma_t: mi.Float,
        albedo: mi.Float,
        tracks: Tracks,
        all_axes: bool = False,
        *,
        moments: Moments,
    ) -> None:
        super().__init__(sigma_t, albedo, tracks, all_axes)
        self.moments = moments

    def _new_level(
        self, sigma_t: mi.Float, albedo: mi.Float, tracks: Tracks
    ) -> AnisotropicMultigridLevel:
        # Errors that converge slowly are smooth in space, and so in direction.
        smooth = Moments(self.moments.angular_basis, min(self.moments.order, COARSE_ORDER))
        return AnisotropicMultigridLevel(sigma_t, albedo, tracks, self.all_axes, moments=smooth)

    def restrict(self, values: mi.Float) -> mi.Float:
        coarser = self.coarser
        moment, place = layer_and_index(coarser.tracks.active_count, coarser.moments.count)
        begin, result = moment * dr.opaque(mi.UInt32, self.tracks.active_count), mi.Float(0)
        for child, weight in self._children:
            voxel = begin + dr.gather(mi.UInt32, child, place)
            result += dr.gather(mi.Float, values, voxel) * dr.gather(mi.Float, weight, place)
        dr.eval(result)
        return result

    def prolong(self, values: mi.Float) -> mi.Float:
        """As `MultigridLevel.prolong`; moments that the coarser level does not have are 0."""
        moments, count = self.coarser.moments, self.coarser.tracks.active_count
        moment, place = layer_and_index(self.tracks.active_count, moments.count)
        begin = moment * dr.opaque(mi.UInt32, count)
        known = self._interpolated(values, place, 1, begin)
        result = dr.opaque(mi.Float, 0, self.moments.count * self.tracks.active_count)
        dr.scatter(result, known, dr.arange(mi.UInt32, dr.width(known)))
        dr.eval(result)
        return result

    def sweep(self, phi: mi.Float | None, table: TrackTable) -> tuple[mi.Float, mi.Float]:
        """As `MultigridLevel.sweep`, for all moments."""
        moments, active, voxels = self.moments, self.tracks.active, self.grid.voxel_count
        if phi is not None and table.boundary_source is not None:
            table.boundary_source.update(phi)
        received, lost = (moments.zeros(self.tracks.active_count) for _ in range(2))
        depth = dr.opaque(mi.Float, 0, self.tracks.active_count)
        scattered = None if phi is None else self._scattered(phi)

        def source(group: PairGroup) -> mi.Float:
            return self.source_along(scattered, group)

        for _, group, copies in self.tracks.sweep_separately(table, source):
            found = _add_collided(moments, received, lost, depth, copies, group, active, voxels)
            dr.eval(found)
            received, lost, depth = found
        # Weighting by optical depth makes scattering conserve the collided energy.
        collided = [4 * dr.pi * lost[0] / dr.select(depth > 0, depth, 1), *lost[1:]]
        if scattered is not None:
            # Ordinates integrate the difference from a voxel's source, whose moments are known.
            received = [mean + moments.moment(scattered, k) for k, mean in enumerate(received)]
            collided = [mean + moments.moment(scattered, k) for k, mean in enumerate(collided)]
        pairs = zip(collided, received, strict=True)
        collided = [self.collided_irradiance(depth, mean, other) for mean, other in pairs]
        return concatenated(received), concatenated(collided)

    def source_along(self, scattered: mi.Float | None, group: PairGroup) -> mi.Float:
        """Radiance that ``scattered`` moments (None for 0) have along both ways of all pairs of a
        group, pair by pair.
        """
        voxels = self.grid.voxel_count
        values = dr.opaque(mi.Float, 0, 2 * len(group) * voxels)
        if scattered is not None:
            _write_source(self.moments, values, scattered, group, self.tracks.active, voxels)
            dr.eval(values)
        return values

    def scattered_radiance(
        self, phi: mi.Float, index: mi.UInt32, direction: mi.Vector3f | None
    ) -> mi.Float:
        """As `MultigridLevel.scattered_radiance`."""
        step = dr.opaque(mi.UInt32, self.tracks.active_count)
        result = dr.gather(mi.Float, phi, index)
        basis = self.moments.angular_basis.basis(direction)
        for factor in basis[: self.moments.count - 1]:
            index = index + step
            result = dr.fma(factor, dr.gather(mi.Float, phi, index), result)
        return result

    def _scattered(self, phi: mi.Float) -> mi.Float:
        """Moments of the scattered radiance, per optical depth."""
        moment, place = layer_and_index(self.tracks.active_count, self.moments.count)
        factor = dr.gather(mi.Float, self.moments.factors, moment)
        scattered = phi * factor * dr.gather(mi.Float, self.albedo, place)
        dr.eval(scattered)
        return scattered


@symbolic
def _add_uncollided(moments, sums: list, copies, group, axis: int, grid, lower, upper, active):
    """``sums`` and the moments of the irradiance that a sweep of a group has left in ``copies``."""
    voxels = dr.opaque(mi.UInt32, grid.voxel_count)
    k, begin = mi.UInt32(0), mi.UInt32(0)
    while dr.hint(k < group.count, label="uncollided pairs"):
        forward = values_at_centres(copies, grid, lower, upper, axis, active, begin=begin)
        backward = values_at_centres(copies, grid, lower, upper, axis, active, begin=begin + voxels)
        basis = moments.basis(-group.direction(k))
        sums = _add_pair(moments, sums, basis, forward, backward)
        k += 1
        begin += 2 * voxels
    return sums


@symbolic
def _add_collided(moments, received: list, lost: list, depth, copies, group, active, voxels: int):
    """Adds the results of a sweep of a group, in ``copies``, at the ``active`` ones of so many
    voxels: to the moments of the radiance without the voxel's own source; to the radiance lost and
    its moments per optical depth; and to the optical ``depth`` times solid angles.
    """
    step = dr.opaque(mi.UInt32, voxels)
    k, place = mi.UInt32(0), mi.UInt32(active)
    while dr.hint(k < group.count, label="collided pairs"):
        forward = dr.gather(mi.Vector4f, copies, place)
        backward = dr.gather(mi.Vector4f, copies, place + step)
        basis = moments.basis(-group.direction(k))
        received = _add_pair(moments, received, basis, forward.y, backward.y)
        # Per depth of each track: with the sum of depths, tracks without matter would be missing
        # from the integral over directions, and the operator would have a norm above 1.
        per_depth = [dr.select(v.w > 0, v.z / v.w, 0) for v in (forward, backward)]
        higher = _add_pair(moments, lost, basis, *per_depth)[1:]
        lost = [lost[0] + forward.z + backward.z, *higher]
        depth = depth + group.weight(k) * (forward.w + backward.w)
        k += 1
        place += 2 * step
    return received, lost, depth


def _add_pair(
    moments: Moments, sums: list, basis: list, forward: mi.Float, backward: mi.Float
) -> list:
    """Sums with what comes from the direction of ``basis``, and from its opposite."""
    even, odd = forward + backward, forward - backward
    return [
        dr.fma(y, odd if degree % 2 else even, value)
        for degree, y, value in zip(moments.degrees, basis, sums, strict=True)
    ]


@symbolic
def _write_source(moments, source, scattered, group, active, voxels: int):
    """Writes the radiance per optical depth that the ``active`` ones of so many voxels scatter
    along the ordinates of a group, and along their opposites.
    """
    parts = [moments.moment(scattered, i) for i in range(moments.count)]
    step = dr.opaque(mi.UInt32, voxels)
    k, place = mi.UInt32(0), mi.UInt32(active)
    while dr.hint(k < group.count, label="sources of pairs"):
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
