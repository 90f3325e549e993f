"""Parts of the random stream of a cache, computed apart from each other, for several machines.

A batch is a function of the seed and of its number. Solvers add a number of batches to the cache at
once (`Solver.batches_at_once`); a part consists of so many. Appended in the order of their numbers,
parts give the same bits as one run that computes them all (`IrradianceCache.append`).
"""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium


class _Collector(IrradianceCache):
    """Looks to a solver like a cache that has the batches before a part already, and collects what
    the solver adds in another one.
    """

    def __init__(self, like: IrradianceCache, fingerprint: dict[str, str]) -> None:
        """Take the voxels and settings of another cache."""
        super().__init__(
            like.grid,
            like.active,
            like.channels,
            like.max_depth,
            fingerprint,
            like.batch,
            like.correlated,
            like.moments,
            like.interpolation,
        )
        self.found: IrradianceCache | None = None

    def begin(self, seed: int, batches: int) -> None:
        """Forget what was collected; the stream ``seed`` has so many ``batches``."""
        self._sums = self._sums.empty().with_count(seed, batches * self.batch)
        self.found = self.empty_copy()

    def add(self, seed: int, samples: int, blocks: list[tuple]) -> None:
        self.found.add(seed, samples, blocks)
        self.note_samples(seed, samples)


def missing_parts(cached: CachedMedium) -> Iterator[tuple[int, int]]:
    """Yield the first batch and the number of batches of each part that the cache of a medium needs
    up to the samples of its settings.
    """
    cache = cached.cache
    at_once = cached.solver.batches_at_once(cache)
    last = cached.target(cached.settings.samples) // cache.batch
    for first in range(cache.samples // cache.batch, last, at_once):
        yield first, min(at_once, last - first)


class StreamParts:
    """Computes parts of the random stream of the cache of one medium, in any order.

    ``cached`` keeps its cache as it is. A solver that holds tables is made once.
    """

    def __init__(self, scene: mi.Scene, cached: CachedMedium) -> None:
        self._seed = cached.settings.seed
        self._collector = _Collector(cached.cache, cached.fingerprint(scene))
        self._solver = cached.new_solver(scene, self._collector)

    def compute(self, first: int, count: int) -> IrradianceCache:
        """Return ``count`` batches that begin with number ``first``."""
        collector = self._collector
        collector.begin(self._seed, first)
        self._solver.refine(count * collector.batch)
        return collector.found
