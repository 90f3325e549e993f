"""A pass of the solver ``sweep``: directions, and the light that enters along them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import spread, spread_together
from mitsuba_irrcache.solvers.discrete_ordinates.boundary_condition import (
    IncomingRadiance,
    SurfaceBoundary,
)
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import TrackTable
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Directions and what belongs to them, as `Tracks.table` wants it.
Rows = Sequence[np.ndarray]
#: Directions of a pass along which light arrives where there are surfaces: it differs from one to
#: the next by more than the light between voxels.
ARRIVING = 64


class OrdinateSet:
    """Directions, light from far away along them in some ``channels`` or alike in all, weights and
    offsets: light that enters and light from voxels goes the same ways.
    """

    def __init__(self, rows: Rows, channels: Sequence[int], suns: int = 0) -> None:
        """``suns`` of the last rows are those of suns, whose light is wanted apart."""
        directions, light, weights, offsets = rows
        self._suns = np.arange(len(weights)) >= len(weights) - suns if suns else None
        own = light if light.shape[-1] == 1 else light[..., list(channels)]
        self.rows = directions, own, weights, offsets

    @staticmethod
    def straight(
        passes: Sequence[OrdinateSet], directional: AngularBasis | None = None
    ) -> list[tuple]:
        """The light of all ``passes`` that comes straight from emitters, as `Tracks.carry` takes
        it; where it is told by its direction, first without that of narrow lights, then that of
        each; where that of suns is wanted apart, it comes last.
        """
        directions, light, _, offsets = merged([p.rows for p in passes])
        parts = [light] if directional is None else directional.apart(directions, light)
        if passes[0]._suns is not None:
            suns = np.concatenate([p._suns for p in passes])[:, None, None]
            parts = [np.where(suns, 0, light), np.where(suns, light, 0)]
        lit = [part.any(axis=(1, 2)) for part in parts]
        return [
            (directions[rows], part[rows], offsets[rows])
            for part, rows in zip(parts, lit, strict=True)
        ]

    def scatter(self, level: MultigridLevel, phi: mi.Float | None) -> tuple[mi.Float, mi.Float]:
        """As `MultigridLevel.scatter`, with the light that enters."""
        return level.scatter(phi, level.lattice.table(*self.rows))

    def solve(self, level: MultigridLevel, b: mi.Float, passes: int) -> mi.Float:
        """All orders of scattering, of which ``b`` is the first, for so many further ``passes``:
        what is left of its error these correct, and divide by their number.
        """
        return level.solve(b, self.between, tolerance=max(1.0, passes / 2))

    def corrected(self, level: MultigridLevel, phi: mi.Float, swept: mi.Float) -> mi.Float:
        """As `MultigridLevel.corrected`, of a sweep along the lines of this pass."""
        coarse = [] if level.coarsest else level.coarser.tables(self.between)
        return level.corrected(phi, swept, coarse)

    @property
    def between(self) -> Rows:
        """Those along which voxels send light, none from outside."""
        return between(self.rows)


class BoundaryOrdinateSet:
    """Among surfaces: light that arrives comes along more directions than light between voxels,
    ``inner`` ones.

    ``arrivals`` are those along the ``rows``, which are from number ``start`` on there; ``returns``
    those along the inner ones, by which light that leaves the medium comes back to it while all
    orders are solved for, if they are in this pass. Some ``channels`` are taken of both.
    """

    def __init__(
        self,
        rows: Rows,
        inner: Rows,
        arrivals: IncomingRadiance,
        start: int,
        returns: IncomingRadiance | None,
        channels: Sequence[int],
    ) -> None:
        self.rows, self.inner, self.between = rows, inner, inner
        self.arrivals, self.returns, self.channels = arrivals, returns, channels
        self.numbers = np.arange(start, start + len(rows[0]))

    @staticmethod
    def straight(
        passes: Sequence[BoundaryOrdinateSet], directional: AngularBasis | None = None
    ) -> list[tuple]:
        """As `OrdinateSet.straight`."""
        directions, light, _, offsets = merged([p.rows for p in passes])
        arrivals, channels = passes[0].arrivals, passes[0].channels
        numbers = np.concatenate([p.numbers for p in passes])
        parts = []
        for part, rows in enumerate(arrivals.lit):
            lit = rows[numbers]
            entering = partial(arrivals.directly, channels, rows=numbers[lit], part=part)
            parts.append((directions[lit], light[lit], offsets[lit], entering))
        return parts

    def scatter(self, level: MultigridLevel, phi: mi.Float | None) -> tuple[mi.Float, mi.Float]:
        """As `MultigridLevel.scatter`, with the light that arrives."""
        table = self._arriving(level)
        table.boundary_source.receive(phi)
        found = level.scatter(None, table)
        if phi is None:
            return found
        # Apart from each other: either lets as much collide as its own lines lose.
        between = level.scatter(phi, level.lattice.table(*self.inner))
        both = tuple(a + b for a, b in zip(found, between, strict=True))
        dr.eval(both)
        return both

    def _arriving(self, level: MultigridLevel) -> TrackTable:
        """The rows, with the light that arrives along them."""
        table = level.lattice.table(*self.rows)
        of_table = self.channels, level, table, self.numbers
        table.boundary_source = self.arrivals.returning(*of_table, emitted=True)
        return table

    def corrected(self, level: MultigridLevel, phi: mi.Float, swept: mi.Float) -> mi.Float:
        """The sweep as it is: what differs between passes here is light that arrives."""
        return swept

    def solve(self, level: MultigridLevel, b: mi.Float, passes: int) -> mi.Float:
        """All orders, of which ``b`` is the first; light may leave the medium between two."""
        numbers = np.arange(len(self.inner[0]))
        return level.solve(
            b,
            self.inner,
            lambda *of_table: self.returns.returning(
                self.channels, *of_table, numbers, emitted=False
            ),
        )


class JointOrdinateSet(BoundaryOrdinateSet):
    """Of light by its direction: what arrives and what voxels send go the same ways. What even
    directions make of their sum, where it is alike from all sides, is what they make of nothing.
    """

    def scatter(self, level: MultigridLevel, phi: mi.Float | None) -> tuple[mi.Float, mi.Float]:
        table = self._arriving(level)
        if phi is None:
            table.boundary_source.receive(phi)
        return level.scatter(phi, table)


def arriving(
    around: SurfaceBoundary,
    sky: DistantIllumination,
    lattice: Tracks,
    passes: int,
    pairs: int,
    rng: np.random.Generator,
    seed: tuple[int, int],
) -> tuple[Callable[[Sequence[int]], list[BoundaryOrdinateSet]], list[list[mi.Float]]]:
    """Passes among surfaces, made of the channels that are wanted together, of which the first
    one's orders can be solved for if there are several; and what differs between channels.
    ``pairs`` are those between voxels.
    """
    several, joint = passes > 1, around.directional is not None
    many = max(ARRIVING // 2, pairs) if several else pairs
    # The first one is apart, the others are even together.
    rows = sky.rows(1, many, rng) + (sky.rows(passes - 1, many, rng) if several else [])
    inner = [between(row) for row in rows] if joint else _inner(passes, pairs, rng)
    arrivals = IncomingRadiance(around, lattice, merged(rows), several, (*seed, 0))
    returns = IncomingRadiance(around, lattice, inner[0], several, (*seed, 1)) if several else None
    starts = np.cumsum([0] + [len(row[0]) for row in rows])
    kinds = [*arrivals.kinds, *(returns.kinds if several else ())]

    def of(channels: Sequence[int]) -> list[BoundaryOrdinateSet]:
        parts = enumerate(zip(rows, inner, starts, strict=False))
        kind = JointOrdinateSet if joint else BoundaryOrdinateSet
        return [
            kind(dark(row), dark(own), arrivals, start, None if i else returns, channels)
            for i, (row, own, start) in parts
        ]

    return of, kinds


def _inner(passes: int, pairs: int, rng: np.random.Generator) -> list[tuple]:
    """Rows of light between voxels, where it goes other ways than light that arrives."""
    black = np.zeros((pairs, 2, dr.size_v(mi.Spectrum)))
    sets = [spread(pairs, rng)] + (spread_together(passes - 1, pairs, rng) if passes > 1 else [])
    return [(directions, black, weights, rng.random((pairs, 2))) for directions, weights in sets]


def merged(rows: Sequence[Rows]) -> tuple[np.ndarray, ...]:
    """Several sets as one."""
    return tuple(np.concatenate(parts) for parts in zip(*rows, strict=True))


def between(rows: Rows) -> Rows:
    """Those along which voxels send light, none from outside."""
    directions, light, weights, offsets = rows
    even = weights != 0  # the others carry light of emitters only
    none = np.zeros_like(light)
    return [part[even] for part in (directions, none, weights, offsets)]


def dark(rows: Rows) -> Rows:
    """Rows for light that does not enter as tables tell."""
    directions, _, weights, offsets = rows
    return directions, np.zeros((len(directions), 2)), weights, offsets
