"""A line on the terminal that says which stage of a command is running, and for how long."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import TextIO

#: Interval between updates [s]; duration after which a stage is named on a stream other than a
#: terminal [s].
_INTERVAL, _LONG = 0.5, 1.0
_CLEAR = "\r\x1b[K"


class StageDisplay:
    """Display the current stage of a command, the time it has taken, and the share that is done.

    A thread updates the line, because compiling and rendering block for seconds. On a stream other
    than a terminal, stages that take longer than a second are named once.
    """

    def __init__(self, stream: TextIO | None = None, is_updated: bool = True) -> None:
        """Write to ``stream``, by default the standard error.

        ``is_updated`` is False if stages have progress bars of their own.
        """
        self._is_updated = is_updated
        self._stream = sys.stderr if stream is None else stream
        self._is_terminal = self._stream is not None and self._stream.isatty()
        self._lock = threading.Lock()
        self._stage, self._started, self._share, self._named = "", 0.0, "", False

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Show ``name`` while the context lasts."""
        if self._stream is None:
            yield
            return
        ended = threading.Event()
        self._begin(name)
        thread = threading.Thread(target=self._run, args=(ended,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            with self._lock:
                self._stage = ""
                self._write(_CLEAR if self._is_terminal else "")

    def advance(self, name: str, done: int, total: int) -> None:
        """Rename the current stage, and show which share of it is done."""
        with self._lock:
            self._stage = name
            self._share = f" {min(done / total, 1.0):4.0%}" if total else ""

    def print(self, text: str) -> None:
        """Print a line of output without mixing it with the line of the stage."""
        with self._lock:
            self._write(_CLEAR if self._is_terminal else "")
            print(text, flush=True)

    def _begin(self, name: str) -> None:
        with self._lock:
            self._stage, self._share, self._named = name, "", False
            self._started = perf_counter()
        self._show()

    def _run(self, ended: threading.Event) -> None:
        while not ended.wait(_INTERVAL):
            if self._is_updated or not self._is_terminal:
                self._show()

    def _show(self) -> None:
        with self._lock:
            seconds = perf_counter() - self._started
            if self._is_terminal and not self._is_updated:
                self._write(f"{_CLEAR}{self._stage}")
            elif self._is_terminal:
                self._write(f"{_CLEAR}{self._stage}{self._share}  {seconds:.0f} s")
            elif seconds >= _LONG and not self._named:
                self._named = True
                self._write(f"{self._stage}\n")

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()
