"""Parts of the random stream of a cache, computed independently of each other on several machines.

A batch is determined by the seed and its index in the stream. Solvers add several batches to the
cache at once (`Solver.batches_at_once`), and a part consists of that many. Parts that are appended
in the order of their batches give bit by bit the cache of a single run (`IrradianceCache.append`).
"""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium


class _Collector(IrradianceCache):
    """Stand-in for the cache of a solver: it reports the batches before a part as present, and
    collects the batches that the solver adds in another cache, ``found``.
    """

    def __init__(self, like: IrradianceCache, fingerprint: dict[str, str], batch: int) -> None:
        """Take the voxels and settings of another cache, but its own ``batch``."""
        super().__init__(
            like.grid,
            like.active,
            like.channels,
            like.max_depth,
            fingerprint,
            batch,
            like.correlated,
            like.moments,
            like.interpolation,
        )
        self.found: IrradianceCache | None = None

    def begin(self, seed: int, batches: int) -> None:
        """Discard collected batches, and count ``batches`` of the stream ``seed`` as present."""
        self._sums = self._sums.empty().with_count(seed, batches * self.batch)
        self.found = self.empty_copy()

    def add(self, seed: int, samples: int, blocks: list[tuple], own_spreads=None) -> None:
        self.found.add(seed, samples, blocks, own_spreads)
        self.note_samples(seed, samples)


def missing_parts(cached: CachedMedium) -> Iterator[tuple[int, int]]:
    """Yield (index of the first batch, number of batches) of each part that the cache of a medium
    lacks to have the samples of its settings. They continue the stream of its own seed, whatever
    the seeds of the samples that are there.
    """
    cache = cached.cache
    at_once = cached.solver.batches_at_once(cache)
    begin = cache.streams.get(cached.settings.seed, 0) // cache.batch
    missing = (cached.target(cached.settings.samples) - cache.samples) // cache.batch
    for first in range(begin, begin + missing, at_once):
        yield first, min(at_once, begin + missing - first)


class StreamParts:
    """Computes parts of the random stream of the cache of one medium, in any order.

    The cache of ``cached`` is not changed. One solver, with its tables, serves all parts. ``batch``
    is that of the cache to which they are appended, which has it from its file if this was begun
    with other settings; 0: that of the cache of ``cached``.
    """

    def __init__(self, scene: mi.Scene, cached: CachedMedium, batch: int = 0) -> None:
        self._seed = cached.settings.seed
        cache = cached.cache
        self._collector = _Collector(cache, cached.fingerprint(scene), batch or cache.batch)
        self._solver = cached.new_solver(scene, self._collector)

    def compute(self, first: int, count: int) -> IrradianceCache:
        """Return a cache with ``count`` batches, starting with the batch of index ``first``."""
        collector = self._collector
        collector.begin(self._seed, first)
        self._solver.refine(count * collector.batch)
        return collector.found
