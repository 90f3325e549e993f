"""Early termination of a rendering: Mitsuba's ``cancel`` and ``timeout``."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter


class Stopped(Exception):  # noqa: N818 (requested by the user, not an error)
    """Raised to end the construction of a cache; completed passes are retained."""


class Pause:
    """Callback that solvers invoke between kernel launches; ``action`` may change at any time."""

    def __init__(self) -> None:
        self.action: Callable[[], None] | None = None

    def __call__(self) -> None:
        if self.action is not None:
            self.action()


class StopCondition:
    """Decides when to stop: after `cancel` (from any thread), or when the timeout has expired."""

    def __init__(self) -> None:
        self._cancelled, self._deadline = False, math.inf

    def begin(self, timeout: float = 0.0) -> None:
        """Clear an earlier cancellation and start the timeout; ``timeout`` <= 0 means no limit.

        Mitsuba also clears it at the start of every rendering.
        """
        self._cancelled = False
        self._deadline = perf_counter() + timeout if timeout > 0 else math.inf

    def end(self) -> None:
        """Disable the timeout."""
        self._deadline = math.inf

    def cancel(self) -> None:
        self._cancelled = True

    @property
    def is_due(self) -> bool:
        """Whether rendering was cancelled or the timeout has expired."""
        return self._cancelled or perf_counter() > self._deadline

    def raising(self, progress: Callable | None) -> Callable:
        """Wrap ``progress`` such that it also raises `Stopped` when stopping is due."""

        def advance(stage: str, done: int, total: int) -> None:
            if progress is not None:
                progress(stage, done, total)
            if self.is_due:
                raise Stopped

        return advance
