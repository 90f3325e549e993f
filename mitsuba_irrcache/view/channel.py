"""Messages between the viewer and the components that it adds to viser's page.

Viser has no widget for editing a curve or for dragging a light, and its own connection carries no
messages other than its own. So the components in `page/` have a websocket of their own: on the same
port, behind the same checks of `access`, for pages of this server only.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
from collections.abc import Callable
from contextlib import suppress

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.access import Access, is_own_page

LOG = logging.getLogger(__name__)

#: Path of the websocket.
PATH = "/irrcache"
#: Largest accepted message in bytes.
LARGEST_MESSAGE = 1 << 19
#: Seconds without a message after which an empty one says that the viewer still responds.
ALIVE_SECONDS = 2.0

#: Called with the value of a message.
Receiver = Callable[[object], None]


class Channel:
    """Send messages to all windows or to one, and receive theirs. Thread-safe.

    A message has a ``kind`` and a ``value`` (JSON, or bytes towards a window). Of each kind only
    the newest message waits for a slow window. A window that connects, or connects again, receives
    the newest of those to all and of those to itself.
    """

    def __init__(self, access: Access) -> None:
        self._access = access
        self._loop: asyncio.AbstractEventLoop | None = None
        self._links: list[_Link] = []
        self._shared: dict[str, object] = {}
        self._receivers: dict[str, Receiver] = {}
        # receivers, and newest messages, of single windows by their keys
        self._own: dict[str, dict[str, Receiver]] = {}
        self._private: dict[str, dict[str, object]] = {}

    @property
    def has_windows(self) -> bool:
        """Return whether any window is connected."""
        return bool(self._links)

    def receive(self, kind: str, receiver: Receiver, key: str = "") -> None:
        """Call ``receiver`` in the server's thread, which it must not block, for each message.

        With a ``key`` only messages of this window are meant.
        """
        (self._own[key] if key else self._receivers)[kind] = receiver

    def open(self) -> str:
        """Return the key by which a window that will connect can be addressed."""
        key = secrets.token_urlsafe(16)
        self._own[key], self._private[key] = {}, {}
        return key

    def close(self, key: str) -> None:
        """Forget a window."""
        self._own.pop(key, None)
        self._private.pop(key, None)

    def send(self, kind: str, value: object, key: str = "") -> None:
        """Send a message to one window, or to all windows, also to later ones."""
        known = self._private.get(key) if key else self._shared
        if known is None:
            return  # the window has been closed
        known[kind] = value
        if self._loop is not None:
            with suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._queue, kind, value, key)

    def _queue(self, kind: str, value: object, key: str) -> None:
        for link in self._links:
            if not key or link.key == key:
                link.queue(kind, value)

    async def serve(self, connection: ServerConnection) -> None:
        """Exchange messages with one window until it closes."""
        if not is_own_page(connection.request.headers, self._access):
            LOG.warning("a page of another site was refused")
            await connection.close(1008, "pages of other sites are refused")
            return
        self._loop = asyncio.get_running_loop()
        link = _Link(connection)
        for kind, value in self._shared.items():
            link.queue(kind, value)
        self._links.append(link)
        sender = asyncio.create_task(link.work())
        try:
            async for text in connection:
                self._take(link, text)
        except ConnectionClosed:
            pass
        finally:
            self._links.remove(link)
            sender.cancel()

    def _take(self, link: _Link, text: str | bytes) -> None:
        """Pass a message on; what is no message of a component is ignored."""
        try:
            message = json.loads(text[:LARGEST_MESSAGE])
            kind, value = str(message["kind"]), message.get("value")
        except (ValueError, TypeError, KeyError, RecursionError):
            return
        if kind == "window":
            link.key = value if isinstance(value, str) and value in self._own else ""
            for known, newest in list(self._private.get(link.key, {}).items()):
                link.queue(known, newest)
            return
        receiver = self._own.get(link.key, {}).get(kind) or self._receivers.get(kind)
        if receiver is None:
            return
        try:
            receiver(value)
        except (IrrcacheError, ValueError, TypeError, KeyError, IndexError) as error:
            LOG.warning("a message %r was refused: %s", kind, error)


class _Link:
    """The connection of one window, and its messages that wait."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection, self.key = connection, ""
        self._waiting: dict[str, object] = {}
        self._news = asyncio.Event()

    def queue(self, kind: str, value: object) -> None:
        self._waiting.pop(kind, None)
        self._waiting[kind] = value
        self._news.set()

    async def work(self) -> None:
        """Send what waits, until the connection closes."""
        with suppress(ConnectionClosed):
            while True:
                try:
                    await asyncio.wait_for(self._news.wait(), ALIVE_SECONDS)
                except asyncio.TimeoutError:  # before Python 3.11 not the built-in one
                    self._waiting.setdefault("alive", "")
                self._news.clear()
                while self._waiting:
                    kind = next(iter(self._waiting))
                    await self.connection.send(_encoded(kind, self._waiting.pop(kind)))


def _encoded(kind: str, value: object) -> str | bytes:
    """Return a message as JSON; bytes follow the name of their kind and a null byte."""
    if isinstance(value, bytes):
        return kind.encode() + b"\0" + value
    return json.dumps({"kind": kind, "value": value})
