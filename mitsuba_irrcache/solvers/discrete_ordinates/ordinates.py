"""Ordinate sets: the directions of one pass of the solver, and the sweeps along them.

A pass sweeps one set of ordinates. `OrdinateSet` is for a medium with distant and point-like
emitters only; `BoundaryOrdinateSet` for a medium among surfaces, where the incoming radiance
differs from track to track.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import (
    Ordinates,
    hemisphere_ordinates,
    joint_ordinates,
    merged,
)
from mitsuba_irrcache.solvers.discrete_ordinates.boundary_condition import (
    IncomingRadiance,
    SurfaceBoundary,
)
from mitsuba_irrcache.solvers.discrete_ordinates.crossings import SurfaceCrossings
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Number of ordinates of a pass (opposite ones count as two) along which radiance enters among
#: surfaces. It varies more between directions than the radiance scattered between voxels.
BOUNDARY_ORDINATES = 64
#: The same in boxes of glass, where all tracks of an ordinate hit a face at the same angle, so that
#: all or none are totally reflected: with 64 ordinates the mean irradiance under an area emitter
#: has a noise of 1.3 %.
BOUNDARY_ORDINATES_IN_GLASS = 256


class OrdinateSet:
    """Ordinates for the radiance of distant emitters and of voxels, in some ``channels``."""

    def __init__(self, ordinates: Ordinates, channels: Sequence[int], suns: int = 0) -> None:
        """The last ``suns`` pairs belong to suns, whose irradiance is kept separate."""
        count, incoming = len(ordinates.weights), ordinates.incoming
        self._is_sun = np.arange(count) >= count - suns if suns else None
        own = incoming if incoming.shape[-1] == 1 else incoming[..., list(channels)]
        self.ordinates = ordinates._replace(incoming=own)

    @staticmethod
    def uncollided(
        sets: Sequence[OrdinateSet], angular_basis: AngularBasis | None = None
    ) -> list[tuple]:
        """Return arguments of `Tracks.uncollided` for the radiance of distant emitters along all
        ``sets``.

        With an ``angular_basis``, the first tuple is for all but the narrow sources, and the
        following ones for each of these. If the irradiance of suns is separate, it comes last.
        """
        directions, incoming, _, offsets = merged([each.ordinates for each in sets])
        suns = []
        if sets[0]._is_sun is not None:
            is_sun = np.concatenate([each._is_sun for each in sets])[:, None, None]
            suns = [np.where(is_sun, incoming, 0)]
            incoming = np.where(is_sun, 0, incoming)
        parts = (
            [incoming]
            if angular_basis is None
            else angular_basis.split_by_source(directions, incoming)
        )
        parts += suns
        used = [part.any(axis=(1, 2)) for part in parts]
        return [
            (directions[rows], part[rows], offsets[rows])
            for part, rows in zip(parts, used, strict=True)
        ]

    def sweep(self, level: MultigridLevel, phi: mi.Float | None) -> tuple[mi.Float, mi.Float]:
        """Run `MultigridLevel.sweep` with the incoming radiance."""
        return level.sweep(phi, level.tracks.table(*self.ordinates))

    def collisions(self, level: MultigridLevel, phi: mi.Float | None) -> mi.Float:
        """Return the second result of `sweep`."""
        return level.collisions(phi, level.tracks.table(*self.ordinates))

    def solve(self, level: MultigridLevel, b: mi.Float, passes: int) -> mi.Float:
        """Solve for all orders of scattering, given the uncollided ``b``.

        The tolerance grows with the number of ``passes`` that follow, because each of them reduces
        the error of the solution, and so does their mean.
        """
        return level.solve(b, self.scattering, tolerance=max(1.0, passes / 2))

    def corrected(self, level: MultigridLevel, phi: mi.Float, swept: mi.Float) -> mi.Float:
        """Apply `MultigridLevel.corrected_along` to a sweep along the ordinates of this set."""
        return level.corrected_along(self.scattering, phi, swept)

    @property
    def scattering(self) -> Ordinates:
        """The ordinates of radiance that voxels emit and scatter."""
        return self.ordinates.scattering()


class BoundaryOrdinateSet:
    """Ordinates of a pass among surfaces: radiance enters along ``ordinates``, and voxels exchange
    radiance along fewer ordinates, ``scattering``.

    ``incoming`` is the incoming radiance of all passes; that along the ``ordinates`` of this one
    starts at index ``start``. ``reflected`` is the radiance that leaves the medium and returns to
    it along the ``scattering`` ordinates, by paths of its own (in glass by those of ``incoming``);
    only `solve` uses it (None in all sets but the first, and without further orders). ``crossings``
    are those of the tracks of ``scattering`` with surfaces among the voxels. ``channels`` are the
    channels of ``incoming`` and ``reflected`` to use.
    """

    def __init__(
        self,
        ordinates: Ordinates,
        scattering: Ordinates,
        incoming: IncomingRadiance,
        start: int,
        reflected: IncomingRadiance | None,
        crossings: SurfaceCrossings | None,
        channels: Sequence[int],
    ) -> None:
        self.ordinates, self.scattering, self._crossings = ordinates, scattering, crossings
        self.incoming, self.reflected, self.channels = incoming, reflected, channels
        self.numbers = np.arange(start, start + len(ordinates.directions))

    @staticmethod
    def uncollided(
        sets: Sequence[BoundaryOrdinateSet], angular_basis: AngularBasis | None = None
    ) -> list[tuple]:
        """Return arguments as `OrdinateSet.uncollided`."""
        directions, unused, _, offsets = merged([each.ordinates for each in sets])
        incoming, channels = sets[0].incoming, sets[0].channels
        numbers = np.concatenate([each.numbers for each in sets])
        parts = []
        for part, mask in enumerate(incoming.has_emitters):
            used = mask[numbers]
            source = partial(incoming.emitter_source, channels, numbers=numbers[used], part=part)
            parts.append((directions[used], unused[used], offsets[used], source))
        return parts

    def sweep(self, level: MultigridLevel, phi: mi.Float | None) -> tuple[mi.Float, mi.Float]:
        """Run `MultigridLevel.sweep` with the incoming radiance."""
        table = self._table(level)
        table.boundary_source.update(phi)
        found = level.sweep(None, table)
        if phi is None:
            return found
        # Sweep both separately: the collisions of each balance the loss along its own tracks.
        scattered = self.exchanged(level, phi)
        both = tuple(a + b for a, b in zip(found, scattered, strict=True))
        dr.eval(both)
        return both

    def collisions(self, level: MultigridLevel, phi: mi.Float | None) -> mi.Float:
        """Return the second result of `sweep`."""
        return self.sweep(level, phi)[1]

    def exchanged(self, level: MultigridLevel, phi: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Run `MultigridLevel.sweep` without incoming radiance."""
        table = level.tracks.table(*self.scattering)
        if self._crossings is not None:
            table.crossings = self._crossings.of_table(np.arange(len(self.scattering.directions)))
        return level.sweep(phi, table)

    def uncollided_collisions(self, level: MultigridLevel) -> mi.Float:
        """Return the mean irradiance of collisions due to radiance straight from emitters."""
        if not any(part.any() for part in self.incoming.has_emitters):
            return dr.zeros(mi.Float, level.tracks.active_count * level.channels)
        table = level.tracks.table(*self.ordinates)
        source = self.incoming.emitter_source(self.channels, table, self.numbers)
        table.boundary_source = source
        return level.sweep(None, table)[1]

    def _table(self, level: MultigridLevel) -> TrackTable:
        """Return the track table of the ordinates, with the incoming radiance along them."""
        table = level.tracks.table(*self.ordinates)
        of_table = self.channels, level, table, self.numbers
        table.boundary_source = self.incoming.reflected_source(*of_table, emitted=True)
        return table

    def corrected(self, level: MultigridLevel, phi: mi.Float, swept: mi.Float) -> mi.Float:
        """Apply `MultigridLevel.corrected_along` to a sweep along the ordinates of this set.

        It is omitted with surfaces among the voxels, through which coarse corrections would leak.

        In dense media the result would otherwise depend on the ordinates of the first set alone.
        """
        if self.incoming.crossings is not None:
            return swept
        return level.corrected_along(self.scattering, phi, swept)

    def solve(self, level: MultigridLevel, b: mi.Float, passes: int) -> mi.Float:
        """Solve for all orders, given the uncollided ``b``; radiance may leave the medium and
        return from surfaces.
        """
        numbers = np.arange(len(self.scattering.directions))
        return level.solve(
            b,
            self.scattering,
            lambda *of_table: self.reflected.reflected_source(
                self.channels, *of_table, numbers, emitted=False
            ),
        )


class JointOrdinateSet(BoundaryOrdinateSet):
    """The same ordinates for incoming radiance and radiance of voxels, so that quadrature errors of
    both cancel where their sum is isotropic.

    It is used for anisotropic scattering, and for media in glass, which reflects most of the
    radiance inside and thus multiplies such errors.
    """

    def sweep(self, level: MultigridLevel, phi: mi.Float | None) -> tuple[mi.Float, mi.Float]:
        table = self._table(level)
        if phi is None:
            table.boundary_source.update(phi)
        return level.sweep(phi, table)

    def exchanged(self, level: MultigridLevel, phi: mi.Float) -> tuple[mi.Float, mi.Float]:
        if self._crossings is not None or self.incoming.crossings is None:
            return super().exchanged(level, phi)
        table = level.tracks.table(*self.scattering)
        table.crossings = self.incoming.crossings.of_table(self.numbers)
        return level.sweep(phi, table)


def boundary_ordinate_sets(
    boundary: SurfaceBoundary,
    illumination: DistantIllumination,
    tracks: Tracks,
    passes: int,
    pairs: int,
    rng: np.random.Generator,
    seed: tuple[int, int],
) -> tuple[Callable[[Sequence[int]], list[BoundaryOrdinateSet]], list[list[mi.Float]]]:
    """Create the ordinate sets of all passes among surfaces.

    Returns a function from the channels that are swept together to the ordinate sets, and all
    spectra that may differ between channels. With several passes, the first one can solve for all
    orders. ``pairs`` is the number of pairs of scattering ordinates.
    """
    several = passes > 1
    joint = boundary.angular_basis is not None or boundary.refracts
    flat = boundary.refracts and boundary.surfaces is None
    many = BOUNDARY_ORDINATES_IN_GLASS if flat else BOUNDARY_ORDINATES
    many = max(many // 2, pairs) if several else pairs
    # The first set is independent; the union of the others is evenly distributed.
    # In glass, radiance of the environment enters by refraction.
    share = None if boundary.refracts else partial(boundary.visible_share, tracks)
    sets = illumination.ordinates(1, many, rng, share)
    if several:
        sets += illumination.ordinates(passes - 1, many, rng, share)
    if joint:
        scattering = [each.scattering() for each in sets]
    else:
        scattering = _scattering_ordinates(passes, pairs, rng)
    incoming = IncomingRadiance(boundary, tracks, merged(sets), several, (*seed, 0))
    reflected, crossings = None, [None] * passes
    if several and boundary.refracts:
        # Use the same paths, so that radiance of emitters and of voxels adds up without noise.
        reflected = incoming
    elif several:
        reflected = IncomingRadiance(boundary, tracks, scattering[0], several, (*seed, 1))
        rest = (boundary.crossings(tracks, each) for each in scattering[1:])
        crossings = [reflected.crossings, *rest]
    starts = np.cumsum([0] + [len(each.directions) for each in sets])
    spectra = [*incoming.spectra, *(reflected.spectra if several else ())]

    def of(channels: Sequence[int]) -> list[BoundaryOrdinateSet]:
        kind = JointOrdinateSet if joint else BoundaryOrdinateSet
        return [
            kind(
                each.without_incoming(),
                own.without_incoming(),
                incoming,
                start,
                None if number else reflected,
                crossed,
                channels,
            )
            for number, (each, own, start, crossed) in enumerate(
                zip(sets, scattering, starts, crossings, strict=False)
            )
        ]

    return of, spectra


def _scattering_ordinates(passes: int, pairs: int, rng: np.random.Generator) -> list[Ordinates]:
    """Return, for each pass, the ordinates of the radiance between voxels, with ``incoming`` 0."""
    none = np.zeros((pairs, 2, dr.size_v(mi.Spectrum)))
    sets = [hemisphere_ordinates(pairs, rng)]
    if passes > 1:
        sets += joint_ordinates(passes - 1, pairs, rng)
    return [
        Ordinates(directions, none, weights, rng.random((pairs, 2))) for directions, weights in sets
    ]
