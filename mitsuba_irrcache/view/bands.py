"""Pictures in pieces, so that who is at work can stop when a camera moves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

#: Seconds that a band should take: a mouse that begins to move waits for so long.
SECONDS = 0.1
#: Pixels of the first band, and of the smallest one: each costs some 10 ms, however small.
FIRST, SMALLEST = 1 << 15, 1 << 14


class Bands:
    """How many pixels are computed at once, learned from the time that the last ones took."""

    def __init__(self) -> None:
        self._count = FIRST

    def at(self, first: int, pixels: int) -> range:
        """The band that begins at ``first``, of so many ``pixels``."""
        return range(first, min(first + self._count, pixels))

    @contextmanager
    def timed(self, band: range) -> Iterator[None]:
        """Learns from a block that computes ``band``, and has done so when it ends."""
        started = perf_counter()
        yield
        self._learn(len(band), perf_counter() - started)

    def _learn(self, count: int, seconds: float) -> None:
        """Makes the next band as large as time wants it, but no more than twice as large."""
        wanted = int(count * SECONDS / max(seconds, 1e-4))
        self._count = max(min(wanted, 2 * self._count), SMALLEST)
