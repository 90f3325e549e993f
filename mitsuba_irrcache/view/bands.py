"""Rendering an image in bands, so that it can be interrupted when a camera moves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

#: Target duration of a band in seconds: the longest delay before a moving camera is served.
SECONDS = 0.1
#: Pixels of the first and of the smallest band: each costs some 10 ms, however small it is.
FIRST, SMALLEST = 1 << 15, 1 << 14


class Bands:
    """Adapt the number of pixels per band to the time that the previous bands took."""

    def __init__(self) -> None:
        self._count = FIRST

    def at(self, first: int, pixels: int) -> range:
        """Return the band of pixels that begins at ``first``, of ``pixels`` in all."""
        return range(first, min(first + self._count, pixels))

    @contextmanager
    def timed(self, band: range) -> Iterator[None]:
        """Measure the duration of a block that computes ``band``, to adapt the next size."""
        started = perf_counter()
        yield
        self._learn(len(band), perf_counter() - started)

    def _learn(self, count: int, seconds: float) -> None:
        """Scale the next band to the target duration, by at most a factor of two."""
        wanted = int(count * SECONDS / max(seconds, 1e-4))
        self._count = max(min(wanted, 2 * self._count), SMALLEST)
