"""Controls whose changes are applied one after the other, only the newest of each control."""

from __future__ import annotations

import html
import logging
import re
import threading
from collections.abc import Callable

from viser import GuiEvent, GuiInputHandle

from mitsuba_irrcache.errors import IrrcacheError

LOG = logging.getLogger(__name__)


def plain(text: str) -> str:
    """Escape ``text`` so that Markdown displays it literally.

    Part of the text may come from any client, and browsers would interpret HTML in it.
    """
    return re.sub(r"([\\`*_{}\[\]()#+\-!|~.:])", r"\\\1", html.escape(text))


class Editing:
    """Apply changes one after the other in a thread of its own.

    While one change is applied, only the newest change of each control stays in the queue. If a
    change is refused, its control is reset to the previous value, and ``report`` receives the
    reason, or "" after a change that succeeds.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._waiting: dict[str, Callable[[], None]] = {}
        self._busy = False

    def submit(self, key: str, change: Callable[[], None]) -> None:
        """Queue ``change``; it replaces a queued change of the same ``key``."""
        with self._lock:
            self._waiting[key] = change
            if self._busy:
                return
            self._busy = True
        threading.Thread(target=self._work, daemon=True).start()

    def bind(self, handle: GuiInputHandle, apply: Callable[[object], None]) -> None:
        """Call ``apply`` with the value of a control whenever a user has changed it."""
        good = [handle.value]

        def change() -> None:
            value = handle.value
            try:
                apply(value)
            except IrrcacheError:
                handle.value = good[0]
                raise
            good[0] = value

        def updated(event: GuiEvent) -> None:
            if event.client is None:  # changed by the program, not by a user
                good[0] = handle.value
            else:
                self.submit(str(id(handle)), change)

        handle.on_update(updated)

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    self._busy = False
                    return
                change = self._waiting.pop(next(iter(self._waiting)))
            try:
                change()
                self._report("")
            except IrrcacheError as error:
                self._report(str(error))
            except Exception as error:
                LOG.exception("a change in the viewer failed")
                self._report(f"{type(error).__name__}: {error}")
