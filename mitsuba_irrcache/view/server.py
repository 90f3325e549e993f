"""The viewer's local web server, with one visitor per browser window."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import socket
import threading
import warnings
from pathlib import Path

import viser
import viser._messages as messages

from mitsuba_irrcache.view.access import Access, check_host, guarded, is_own_page, is_wildcard
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.panel import LightPanel
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.transfer_panel import TransferPanel
from mitsuba_irrcache.view.visitor import Visitor

LOG = logging.getLogger(__name__)


class Server:
    """Display a started ``session`` on ``host`` and ``port``, or on the next free port."""

    def __init__(
        self,
        session: Session,
        host: str = "127.0.0.1",
        port: int = 8080,
        folder: Path | None = None,
        appearance: Appearance | None = None,
    ) -> None:
        self.session, self.host = session, host
        check_host(host)
        ignore_closed_connections()
        self._access = Access(host)
        # Viser prints a greeting of its own; `command` prints ours.
        with contextlib.redirect_stdout(io.StringIO()), guarded(self._access):
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
        # The browser's own 3-D scene is empty and needs no lights.
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
        """Return the address to open in a browser on this machine."""
        if is_wildcard(self.host):
            return self._address_at("::1" if ":" in self.host else "127.0.0.1")
        return self._address_at(self.host)

    @property
    def address_from_elsewhere(self) -> str:
        """Return the address to open in a browser on another machine."""
        return self._address_at(socket.gethostname() if is_wildcard(self.host) else self.host)

    def _address_at(self, host: str) -> str:
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/{self._access.query()}"

    def stop(self) -> None:
        """Close all windows and the server."""
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
        """Disable what viser offers to other hosts.

        These are tunnels to its relay, which any window could request, and windows of pages of
        other sites.
        """
        websockets = self._server._websock_server
        for message in (messages.ShareUrlRequest, messages.ShareUrlDisconnect):
            websockets.unregister_handler(message)

        async def check(connection: object) -> None:
            live = websockets._live_connections[connection.client_id]
            if not is_own_page(live.request.headers, self._access):
                LOG.warning("a page of another site was refused")
                await live.close(1008, "pages of other sites are refused")

        websockets._client_connect_cb.insert(0, check)


def ignore_closed_connections() -> None:
    """Suppress viser's warnings of messages to a closed connection.

    Images are sent until the server notices that a browser has closed its window.
    """
    warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)
