"""The solver ``sweep`` for a medium that does not scatter alike to all sides."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache import IrradianceCache
from mitsuba_irrcache.medium import MediumGrid
from mitsuba_irrcache.solvers.moments import DirectionalLevel, Moments
from mitsuba_irrcache.solvers.passes import Pass
from mitsuba_irrcache.solvers.scattering import Level
from mitsuba_irrcache.solvers.sweep import Sweep

#: Directions of a pass for moments up to order 4, and beyond. They have to integrate products of
#: these: under a sun, with g = 0.5 and 0.85, half as many left twice and five times the error.
DIRECTIONS, MORE_DIRECTIONS = 32, 64


def directions_of(order: int) -> int:
    """Directions of a pass."""
    return DIRECTIONS if order <= 4 else MORE_DIRECTIONS


def least_batch(order: int) -> int:
    """The directions of a batch of a cache with moments up to ``order``: two passes."""
    return 2 * directions_of(order)


class DirectionalSweep(Sweep):
    """Fills ``cache``, which has moments, over a ``medium`` that is alone."""

    def __init__(
        self, scene: mi.Scene, medium: MediumGrid, cache: IrradianceCache, *rest: object
    ) -> None:
        self._moments, sources = Moments(cache.directional), cache.directional.sources
        self.directions = directions_of(self._moments.order)
        super().__init__(scene, medium, cache, *rest)
        if not cache.active_count:
            return
        # Point-like lights, in the order of `Sky.near`.
        self._towards = [s.seen_from(self._places)[0] for s in sources if not s.far]

    def _new_level(self, *arguments: object) -> Level:
        return DirectionalLevel(*arguments, moments=self._moments)

    def _solved(self, passes: list[Pass], channels: tuple[int, ...]) -> list[tuple]:
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
        none = dr.zeros(mi.Float, self.cache.active_count)
        direct = [emitted[channels[0]] for emitted in self._direct]
        near = iter(direct)
        narrow = [
            next(near) if not source.far else none if n is None else moments.part(n, 0) * scale
            for source, n in zip(self.cache.directional.sources, own, strict=True)
        ]
        uncollided = moments.part(swept, 0) + sum(direct)
        scattered = None
        if several:
            scattered = self._received(self._level(channels), passes, channels) - swept
            smooth = smooth + scattered
            scattered = dr.maximum(moments.part(scattered, 0), 0)
        further = [moments.part(smooth, k) for k in range(1, moments.count)]
        dr.eval(uncollided, scattered, further, narrow)
        return [(uncollided, scattered, *further, *narrow)]

    def _near_light(self, channel: int) -> list[mi.Float]:
        """As of `Sweep`, its moments."""
        light = super()._near_light(channel)
        return [self._moments.of(e, d) for e, d in zip(light, self._towards, strict=True)]
