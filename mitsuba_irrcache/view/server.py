"""The viewer in the browser: a local server, and a visitor for every window."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import logging
import math
import threading
from pathlib import Path
from urllib.parse import urlsplit

import viser
import viser._messages as messages

from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.panel import LightPanel
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.transfer_panel import TransferPanel
from mitsuba_irrcache.view.visitor import Visitor

LOG = logging.getLogger(__name__)

LOCAL = ("localhost", "127.0.0.1", "::1")


class Server:
    """Shows ``session`` (started) on ``host`` and ``port`` (or the next free one)."""

    def __init__(
        self,
        session: Session,
        host: str = "127.0.0.1",
        port: int = 8080,
        folder: Path | None = None,
        appearance: Appearance | None = None,
    ) -> None:
        self.session, self.host = session, host
        with contextlib.redirect_stdout(io.StringIO()):  # it greets; so do we
            self._server = viser.ViserServer(host, port, label="irrcache", verbose=False)
        self.port = self._server.get_port()
        self._keep_to_ourselves()
        self._visitors: dict[int, Visitor] = {}
        self._lock = threading.Lock()
        self._folder = folder
        server = self._server
        server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="medium"
        )
        # There is nothing in the browser's own scene: no light has to be computed for it.
        server.scene.configure_default_lights(False)
        server.scene.configure_environment_map(None)
        self._set_first_camera()
        self.panel = LightPanel(server, session)
        if appearance is not None and appearance.is_editable:
            TransferPanel(server, session, appearance, self.panel.editing)
        session.on_status = self.panel.show
        self.panel.show(session.status)
        server.on_client_connect(self._connected)
        server.on_client_disconnect(self._gone)

    @property
    def address(self) -> str:
        """To be opened in a browser; the picture is made for the pixels of the screen."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/"

    def stop(self) -> None:
        """Closes all windows."""
        self.session.on_status = lambda status: None
        for client in list(self._visitors):
            self._forget(client)
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _set_first_camera(self) -> None:
        camera = next(iter(self.session.cameras.values()))
        place, first = self.session.placement.to_browser, self._server.initial_camera
        self._server.scene.set_up_direction(camera.up)
        first.position, first.look_at = place(camera.position), place(camera.target)
        first.up, first.fov = camera.up, math.radians(camera.fov)

    def _connected(self, client: viser.ClientHandle) -> None:
        visitor = Visitor(client, self.session, self._folder)
        with self._lock:
            self._visitors[client.client_id] = visitor

    def _gone(self, client: viser.ClientHandle) -> None:
        self._forget(client.client_id)

    def _forget(self, client: int) -> None:
        with self._lock:
            visitor = self._visitors.pop(client, None)
        if visitor is not None:
            visitor.close()

    def _keep_to_ourselves(self) -> None:
        """Refuses what viser would offer to the world: tunnels to its relay, which any window could
        ask for, and windows that belong to pages of other sites.
        """
        websockets = self._server._websock_server
        for message in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
            websockets.unregister_handler(message)

        async def check(connection: object) -> None:
            live = websockets._live_connections[connection.client_id]
            if not is_own_page(live.request.headers, self.host):
                LOG.warning("a page of another site was refused")
                await live.close(1008, "pages of other sites are refused")

        websockets._client_connect_cb.insert(0, check)


def is_own_page(headers: dict[str, str], host: str) -> bool:
    """Whether a browser's request comes from the page that was served here: its origin is the host
    that it asks, and on this machine alone that has no name but those of this machine. Programs
    send no origin.
    """
    origin = headers.get("Origin")
    if origin is None:
        return True
    asked = urlsplit(f"//{headers.get('Host', '')}")
    own = urlsplit(origin)
    if (own.scheme, own.netloc) != ("http", asked.netloc):
        return False
    return not is_local(host) or (asked.hostname or "") in LOCAL


def is_local(host: str) -> bool:
    """Whether only this machine can connect to ``host``."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"
