"""Anisotropic scattering: spherical-harmonic moments of the radiance (S_N with P_L scattering).

For anisotropic phase functions, the unknowns are not the irradiance alone but all moments of the
radiance up to the order of the phase function's Legendre expansion. They are stored in one array,
moment after moment, ordered by degree; channels that are swept together are adjacent. The first one
is the irradiance Phi = sqrt(4 pi) L_00, the others are the L_lm of eq. (1.5), with Y_lm of the
direction from which the radiance comes, opposite to that of propagation; scattering multiplies a
moment of degree l by the phase function's moment g_l (see `phase`; Lewis and Miller 1984, chapter
4).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from operator import itemgetter

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.jit import concatenated, symbolic
from mitsuba_irrcache.solvers.discrete_ordinates.antidiffusion import Antidiffusion
from mitsuba_irrcache.solvers.discrete_ordinates.kernel import collisions
from mitsuba_irrcache.solvers.discrete_ordinates.layout import (
    block_and_index,
    interleaved_channels,
    voxel_and_channel,
)
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import (
    BoundaryOrdinateSet,
    OrdinateSet,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import PairGroup, TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import (
    SweptBox,
    Tracks,
    face_factor,
    values_at_centres,
)

#: Highest degree of the moments that are corrected on coarser grids.
COARSE_ORDER = 1


class Moments:
    """Spherical-harmonic moments of the radiance, in the basis of an `AngularBasis`."""

    def __init__(self, angular_basis: AngularBasis, order: int | None = None) -> None:
        """Use moments up to degree ``order`` (None: the order of ``angular_basis``)."""
        self.angular_basis = angular_basis
        self.order = angular_basis.order if order is None else order
        #: degree of each moment
        self.degrees = [n for n in range(self.order + 1) for _ in range(2 * n + 1)]
        factors = [angular_basis.phase.moments[n] for n in self.degrees]
        #: factor g_l of each moment in scattering
        self.factors = mi.Float([float(g) for g in factors])

    @property
    def count(self) -> int:
        """Number of moments."""
        return len(self.degrees)

    def basis(self, direction: mi.Vector3f) -> list[mi.Float]:
        """Return the moments of an irradiance of 1 from ``direction``."""
        return [mi.Float(1), *dr.sh_eval(direction, self.order)[1:]]

    def from_direction(self, irradiance: mi.Float, direction: mi.Vector3f) -> mi.Float:
        """Return the moments of an irradiance from ``direction``, at each position."""
        return concatenated([irradiance * y for y in self.basis(direction)])

    def moment(self, values: mi.Float, number: int) -> mi.Float:
        """Return the moment with this ``number`` at all positions."""
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
        """Return the moments of the radiance whose irradiance `Tracks.uncollided` computes, at the
        same positions.
        """
        none = np.zeros(len(incoming))
        table = tracks.table(directions, incoming, none, offsets, by_slice=True)
        table.boundary_source = boundary_source(table) if boundary_source is not None else None
        channels = (table if table.boundary_source is None else table.boundary_source).channels
        sums, layers = self.zeros(tracks.active_count * channels), tracks.layers
        ends = tracks.lower, tracks.lower + tracks.size
        place, channel = voxel_and_channel(tracks.active_count, channels)
        values = dr.gather(mi.UInt32, tracks.active, place), channel, channels
        swept = tracks.sweep_separately(table, channels=channels)
        for axis, groups in groupby(swept, itemgetter(0)):
            box = SweptBox(tracks.grid, *ends, axis)
            own = self.zeros(tracks.active_count * channels) if layers else sums
            for _, group, copies in groups:
                own = _add_uncollided(self, own, copies, group, box, values, layers)
                dr.eval(own)
            if layers:
                # A single ordinate may miss voxels, where no mean follows from its values.
                factor = face_factor(own[0], tracks.grid, values, layers, [axis])
                own = [a + factor * b for a, b in zip(sums, own, strict=True)]
                dr.eval(own)
            sums = own
        return concatenated(sums)

    def zeros(self, width: int) -> list[mi.Float]:
        """Return moments of 0 at ``width`` positions."""
        return [dr.opaque(mi.Float, 0, width) for _ in range(self.count)]

    def uncollided(
        self, sets: list[OrdinateSet] | list[BoundaryOrdinateSet], tracks: Tracks, channels: int
    ) -> list[mi.Float | None]:
        """Compute the moments of the uncollided radiance along tracks at the active voxels, summed
        over all ordinate ``sets``.

        Returns the moments of the radiance without narrow sources, followed by those of each narrow
        source (None if it is not distant), with interleaved ``channels``.
        """
        width, found = self.count * tracks.active_count, []
        for arguments in sets[0].uncollided(sets, self.angular_basis):
            swept = self.sweep_uncollided(tracks, *arguments) if len(arguments[0]) else None
            if swept is not None and dr.width(swept) < width * channels:
                swept = interleaved_channels([swept] * channels)
            found.append(swept)
        smooth = dr.opaque(mi.Float, 0, width * channels)
        return [smooth if found[0] is None else found[0], *found[1:]]


#: Number of moments of degrees 0 and 1.
DIFFUSING = 4


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
        # Errors that converge slowly are smooth in space, and hence in direction.
        smooth = Moments(self.moments.angular_basis, min(self.moments.order, COARSE_ORDER))
        return AnisotropicMultigridLevel(sigma_t, albedo, tracks, self.all_axes, moments=smooth)

    @property
    def _measured(self) -> int:
        # Slowly converging errors are smooth in direction.
        return min(self.moments.count, (COARSE_ORDER + 1) ** 2)

    def restrict(self, values: mi.Float) -> mi.Float:
        coarser = self.coarser
        moment, place, channel = coarser._indices(coarser.moments.count)
        begin, result = moment * dr.opaque(mi.UInt32, self._width) + channel, mi.Float(0)
        for child, weight in self._children:
            at = begin + dr.gather(mi.UInt32, child, place) * self.channels
            result += dr.gather(mi.Float, values, at) * dr.gather(mi.Float, weight, place)
        dr.eval(result)
        return result

    def prolong(self, values: mi.Float) -> mi.Float:
        """Prolong as `MultigridLevel.prolong`; moments that the coarser level lacks are 0."""
        moment, place, channel = self._indices(self.coarser.moments.count)
        begin = moment * dr.opaque(mi.UInt32, self.coarser._width) + channel
        known = self._interpolated(values, place, self.channels, begin)
        result = dr.opaque(mi.Float, 0, self.moments.count * self._width)
        dr.scatter(result, known, dr.arange(mi.UInt32, dr.width(known)))
        dr.eval(result)
        return result

    def sweep(
        self, phi: mi.Float | None, table: TrackTable, plain: bool = False
    ) -> tuple[mi.Float, mi.Float]:
        """Sweep as `MultigridLevel.sweep`, for all moments."""
        return self._swept(phi, table, True, plain)

    def collisions(self, phi: mi.Float | None, table: TrackTable) -> mi.Float:
        return self._swept(phi, table, False)[1]

    def _swept(
        self,
        phi: mi.Float | None,
        table: TrackTable,
        with_irradiance: bool,
        plain: bool = False,
    ) -> tuple[mi.Float | None, mi.Float]:
        """Return the results of `sweep`; the first one is None without ``with_irradiance``."""
        moments, scattered = self.moments, None
        if phi is not None:
            flat = self._scattered(phi)
            scattered = flat if plain else self.antidiffused(flat)
            if table.boundary_source is not None:
                table.boundary_source.update(phi)

        def source(group: PairGroup) -> mi.Float:
            return self.source_along(scattered, group)

        collided = moments.zeros(self._width)
        received = moments.zeros(self._width) if with_irradiance else None
        lost, depth = (dr.opaque(mi.Float, 0, self._width) for _ in range(2))
        where = self._slots(), self._swept_values
        groups = self.tracks.sweep_separately(table, source, self.channels, not with_irradiance)
        for _, group, copies in groups:
            sums = received, collided, lost, depth
            received, collided, lost, depth = add_collided(moments, sums, copies, group, *where)
            dr.eval(received, collided, lost, depth)
        # Weighting by optical depth makes scattering conserve the energy of collisions.
        weighted = 4 * dr.pi * lost / dr.select(depth > 0, depth, 1)
        collided[0] = self.collided_irradiance(depth, weighted, collided[0])
        if scattered is not None:
            # Ordinates integrate the difference L - S from a voxel's source S; add its moments.
            own = [moments.moment(scattered, k) for k in range(moments.count)]
            collided = [a + b for a, b in zip(collided, own, strict=True)]
            if received is not None:
                received = [a + b for a, b in zip(received, own, strict=True)]
                voxel_depth = self._voxel_depth(depth)
                for k in range(min(moments.count, DIFFUSING)):
                    change = own[k] - moments.moment(flat, k)
                    received[k] -= Antidiffusion.at_centre(change, voxel_depth)
        return None if received is None else concatenated(received), concatenated(collided)

    def source_along(self, scattered: mi.Float | None, group: PairGroup) -> mi.Float:
        """Evaluate the radiance with the moments ``scattered`` (None for 0) along both ways of all
        pairs of a group, pair by pair.
        """
        count = self._swept_values
        values = dr.opaque(mi.Float, 0, 2 * len(group) * count)
        if scattered is not None:
            _write_source(self.moments, values, scattered, group, self._slots(), count)
            dr.eval(values)
        return values

    def scattered_radiance(
        self, phi: mi.Float, index: mi.UInt32, direction: mi.Vector3f | None
    ) -> mi.Float:
        """Evaluate as `MultigridLevel.scattered_radiance`."""
        step = dr.opaque(mi.UInt32, self._width)
        result = dr.gather(mi.Float, phi, index)
        basis = self.moments.angular_basis.basis(direction)
        for factor in basis[: self.moments.count - 1]:
            index = index + step
            result = dr.fma(factor, dr.gather(mi.Float, phi, index), result)
        return result

    def _scattered(self, phi: mi.Float) -> mi.Float:
        """Return the moments of the scattered radiance, per optical depth."""
        moment, place = block_and_index(self._width, self.moments.count)
        factor = dr.gather(mi.Float, self.moments.factors, moment)
        scattered = phi * factor * dr.gather(mi.Float, self.albedo, place)
        dr.eval(scattered)
        return scattered

    def antidiffused(self, values: mi.Float) -> mi.Float:
        # Diffusion is due to the moments of degrees 0 and 1.
        moment, place, channel = self._indices(min(self.moments.count, DIFFUSING))
        begin = moment * dr.opaque(mi.UInt32, self._width) + channel
        index, result = dr.arange(mi.UInt32, dr.width(place)), dr.copy(values)
        first = dr.gather(mi.Float, values, index)
        dr.scatter(result, self._antidiffused(first, place, self.channels, begin), index)
        dr.eval(result)
        return result

    # Arrays

    @property
    def _width(self) -> int:
        """Number of values of one moment: active voxels times channels."""
        return self.tracks.active_count * self.channels

    @property
    def _swept_values(self) -> int:
        """Number of values that the sweep of one ordinate writes: all voxels times channels."""
        return self.grid.voxel_count * self.channels

    def _slots(self) -> mi.UInt32:
        """Return the indices of the active voxels and channels among the values of an ordinate."""
        place, channel = voxel_and_channel(self.tracks.active_count, self.channels)
        return dr.gather(mi.UInt32, self.tracks.active, place) * self.channels + channel

    def _indices(self, moments: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Return moment, active voxel and channel of each value of an array of ``moments``."""
        moment, place = block_and_index(self._width, moments)
        if self.channels == 1:
            return moment, place, mi.UInt32(0)
        voxel = place // self.channels
        return moment, voxel, place - voxel * self.channels


@symbolic
def _add_uncollided(
    moments: Moments,
    sums: list,
    copies: mi.Float,
    group: PairGroup,
    box: SweptBox,
    values: tuple[mi.UInt32, mi.UInt32, int],
    layers: int,
):
    """Add the moments of the irradiance that a sweep of a group has written to ``copies``.

    ``values`` are the voxel and the channel of each of the ``sums``, and the number of channels;
    ``layers`` is that of `values_at_centres`; means along the axis are not applied.
    """
    voxels, (voxel, channel, channels) = dr.opaque(mi.UInt32, box.grid.voxel_count), values
    k, begin = mi.UInt32(0), mi.UInt32(0)
    while dr.hint(k < group.count, label="uncollided pairs"):
        where = copies, box, voxel, channel, channels
        rest = {"layers": layers, "along_axis": False}
        forward = values_at_centres(*where, begin=begin, **rest)
        backward = values_at_centres(*where, begin=begin + voxels, **rest)
        basis = moments.basis(-group.direction(k))
        sums = _add_pair(moments, sums, basis, forward, backward)
        k += 1
        begin += 2 * voxels
    return sums


@symbolic
def add_collided(
    moments: Moments,
    sums: tuple,
    copies: mi.Float,
    group: PairGroup,
    slots: mi.UInt32,
    values: int,
):
    """Add the results of a sweep of a group to ``sums``, and return these.

    The results, without the voxels' own source, are in ``copies``, at these ``slots`` of the
    ``values`` of each ordinate. The sums are the moments of the radiance in the middle of voxels
    (None: not computed) and of collisions; the radiance that collides; and the optical depth times
    solid angle.
    """
    received, collided, lost, depth = sums
    step = dr.opaque(mi.UInt32, values)
    k, place = mi.UInt32(0), mi.UInt32(slots)
    while dr.hint(k < group.count, label="collided pairs"):
        basis = moments.basis(-group.direction(k))
        # Divide by the depth of each track: with the sum of depths, tracks through empty voxels
        # would be missing from the integral over directions, and the operator norm would exceed 1.
        if dr.hint(received is None, mode="scalar"):
            forward = dr.gather(mi.Vector2f, copies, place)
            backward = dr.gather(mi.Vector2f, copies, place + step)
        else:
            tallies = [dr.gather(mi.Vector4f, copies, i) for i in (place, place + step)]
            received = _add_pair(moments, received, basis, *(t.y for t in tallies))
            forward, backward = collisions(tallies)
        collided = _add_pair(moments, collided, basis, forward.x, backward.x)
        lost = lost + forward.x * forward.y + backward.x * backward.y
        depth = depth + group.weight(k) * (forward.y + backward.y)
        k += 1
        place += 2 * step
    return received, collided, lost, depth


def _add_pair(
    moments: Moments, sums: list, basis: list, forward: mi.Float, backward: mi.Float
) -> list:
    """Return ``sums`` plus the moments of irradiance from the direction of ``basis``
    (``forward``) and from its opposite (``backward``).
    """
    even, odd = forward + backward, forward - backward
    return [
        dr.fma(y, odd if degree % 2 else even, value)
        for degree, y, value in zip(moments.degrees, basis, sums, strict=True)
    ]


@symbolic
def _write_source(moments, source, scattered, group, slots, values: int):
    """Write the radiance scattered along the ordinates of a group and their opposites, per optical
    depth, to these ``slots`` of the ``values`` of each ordinate.
    """
    parts = [moments.moment(scattered, i) for i in range(moments.count)]
    step = dr.opaque(mi.UInt32, values)
    k, place = mi.UInt32(0), mi.UInt32(slots)
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
