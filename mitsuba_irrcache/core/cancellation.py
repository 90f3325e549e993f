"""When rendering has to end early: Mitsuba's ``cancel`` and ``timeout``."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter


class Stopped(Exception):  # noqa: N818 (no error: the user wants it)
    """Ends the build of a cache; what is complete stays."""


class Pause:
    """What a solver calls between its launches: ``action``, which may be set at any time."""

    def __init__(self) -> None:
        self.action: Callable[[], None] | None = None

    def __call__(self) -> None:
        if self.action is not None:
            self.action()


class Stopping:
    """Says when to stop: once `cancel` was called, from any thread, or so long after `begin`."""

    def __init__(self) -> None:
        self._cancelled, self._deadline = False, math.inf

    def begin(self, timeout: float = 0.0) -> None:
        """Forgets what was before, as Mitsuba does at the start of every rendering; there are
        ``timeout`` seconds for this one, if that is above 0.
        """
        self._cancelled = False
        self._deadline = perf_counter() + timeout if timeout > 0 else math.inf

    def end(self) -> None:
        """Time does not count any more."""
        self._deadline = math.inf

    def cancel(self) -> None:
        self._cancelled = True

    @property
    def is_due(self) -> bool:
        """Whether to stop."""
        return self._cancelled or perf_counter() > self._deadline

    def checked(self, progress: Callable | None) -> Callable:
        """``progress``, which also raises `Stopped` when it is time."""

        def advance(stage: str, done: int, total: int) -> None:
            if progress is not None:
                progress(stage, done, total)
            if self.is_due:
                raise Stopped

        return advance
