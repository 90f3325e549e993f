"""The solver ``sweep`` for a medium that does not scatter alike to all sides."""

from __future__ import annotations

from itertools import zip_longest

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.layout import concatenated
from mitsuba_irrcache.solvers.discrete_ordinates.moments import AnisotropicMultigridLevel, Moments
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import OrdinateSet
from mitsuba_irrcache.solvers.discrete_ordinates.solver import Sweep

#: Directions of a pass for moments up to order 4, and beyond. They have to integrate products of
#: these: under a sun, with g = 0.5 and 0.85, half as many left twice and five times the error.
DIRECTIONS, MORE_DIRECTIONS = 32, 64


def directions_of(order: int) -> int:
    """Directions of a pass."""
    return DIRECTIONS if order <= 4 else MORE_DIRECTIONS


def least_batch(order: int) -> int:
    """The directions of a batch of a cache with moments up to ``order``: two passes."""
    return 2 * directions_of(order)


class AnisotropicSweep(Sweep):
    """Fills ``cache``, which has moments."""

    def __init__(
        self, scene: mi.Scene, medium: MediumGrid, cache: IrradianceCache, *rest: object
    ) -> None:
        self._moments, self._sources = Moments(cache.directional), cache.directional.sources
        self.directions = directions_of(self._moments.order)
        super().__init__(scene, medium, cache, *rest)
        if not cache.active_count:
            return
        # Point-like lights, in the order of `DistantIllumination.near`.
        points = [s for s in self._sources if s.sharp and not s.far]
        self._towards = [s.seen_from(self._places)[0] for s in points]

    def _new_level(self, *arguments: object) -> MultigridLevel:
        return AnisotropicMultigridLevel(
            *arguments, not self._medium.is_isolated, moments=self._moments
        )

    def _solved(self, passes: list[OrdinateSet], channels: tuple[int, ...]) -> list[tuple]:
        """As of `Sweep`; narrow lights are not in the moments of the light straight from emitters,
        but beside them.
        """
        moments, several = self._moments, self.cache.max_depth != 2
        lattice = self._lattice(channels)
        arriving = passes[1:] if several else passes
        scale = dr.opaque(mi.Float, 1 / len(arriving))
        smooth, own = moments.uncollided(arriving, lattice)
        swept = sum((light for light in own if light is not None), smooth) * scale
        smooth *= scale
        # What is known beside the lines: irradiance of point-like lights, moments of others.
        beside = [[m[channels[0]] for m in light] for light in (*self._direct, *self._emitted)]
        points, others = beside[: len(self._towards)], beside[len(self._towards) :]
        points = iter(points)
        narrow = []
        for number, (source, swept_light) in enumerate(zip(self._sources, own, strict=True)):
            light = dr.zeros(mi.Float, self.cache.active_count)
            if swept_light is not None:
                light += moments.part(swept_light, 0) * scale
            if source.sharp and not source.far:
                light += next(points)[0]
            narrow.append(light + sum(more[moments.count + number] for more in others))
        uncollided = moments.part(swept, 0) + sum(light[0] for light in beside)
        scattered = None
        if several:
            scattered = self._received(self._level(channels), passes, channels) - swept
            smooth = smooth + scattered
            scattered = dr.maximum(moments.part(scattered, 0), 0)
        further = [
            moments.part(smooth, k) + sum(light[k] for light in others)
            for k in range(1, moments.count)
        ]
        dr.eval(uncollided, scattered, further, narrow)
        return [(uncollided, scattered, *further, *narrow)]

    def _near_light(self, channel: int) -> list[mi.Float]:
        """As of `Sweep`, its moments."""
        count, found = self._moments.count, []
        for direction, (irradiance, *more) in zip_longest(self._towards, self._direct):
            light = irradiance[channel] * self._spread
            if direction is not None:
                found.append(self._moments.of(light, direction))
            else:
                rest = [moment[channel] * self._spread for moment in more[: count - 1]]
                found.append(concatenated([light, *rest]))
        for emitted in self._emitted:
            found.append(concatenated([moment[channel] for moment in emitted[:count]]))
        return found
