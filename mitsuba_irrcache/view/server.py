"""The viewer's local web server, with one visitor per browser window."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import socket
import threading
import time
import warnings
from pathlib import Path

import viser
import viser._messages as messages
from PIL import Image
from websockets.http11 import Request, Response

from mitsuba_irrcache.view.access import Access, check_host, guarded, is_own_page, is_wildcard
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.view.channel import PATH, Channel
from mitsuba_irrcache.view.crop_panel import CropPanel
from mitsuba_irrcache.view.panel import LightPanel
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.slice_panel import SlicePanel
from mitsuba_irrcache.view.time_panel import TimePanel, TimeSteps
from mitsuba_irrcache.view.transfer_panel import TransferPanel
from mitsuba_irrcache.view.visitor import Visitor
from mitsuba_irrcache.view.web_page import page

LOG = logging.getLogger(__name__)


#: Time in which windows receive a last message.
FAREWELL_SECONDS = 0.5


class Server:
    """Serve the page on ``host`` and ``port``, or on the next free port.

    The page displays the text of `show_message` until `show` gives it something to display. Files
    that visitors save go to ``folder``, or to their browsers if it is None.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        folder: Path | None = None,
        title: str = "irrcache",
    ) -> None:
        self.host, self._folder = host, folder
        check_host(host)
        ignore_closed_connections()
        self._access = Access(host)
        self.channel = Channel(self._access)
        self.session: Session | None = None
        self._visitors: dict[int, Visitor] = {}
        self._lock = threading.Lock()

        def pages(request: Request) -> Response | None:
            is_page = request.path.partition("?")[0] == "/"
            is_socket = request.headers.get("Upgrade", "").lower() == "websocket"
            return page(title, request.headers) if is_page and not is_socket else None

        # Viser prints a greeting of its own; `command` prints ours.
        with (
            contextlib.redirect_stdout(io.StringIO()),
            guarded(self._access, pages, {PATH: self.channel.serve}),
        ):
            self._server = viser.ViserServer(host, port, label="irrcache", verbose=False)
        self.port = self._server.get_port()
        self._refuse_other_hosts()
        server = self._server
        server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="medium"
        )
        server.gui.main_panel.dock_right()  # beside the image, which it never covers
        # Without any control viser would show its own settings.
        self._placeholder = server.gui.add_markdown("Loading the controls ...")
        # The browser's own 3-D scene is empty and needs no lights.
        server.scene.configure_default_lights(False)
        server.scene.configure_environment_map(None)

    def show_message(self, text: str) -> None:
        """Display what the page waits for in all windows without an image."""
        self.channel.send("wait", text)

    def show_failure(self, text: str) -> None:
        """Display why nothing will be displayed, before the server stops."""
        self.show_message(f"error: {text}")
        if self.channel.has_windows:
            time.sleep(FAREWELL_SECONDS)

    def send_preview(self, session: Session) -> None:
        """Send an image that the page displays until viser's client asks for one."""
        encoded = io.BytesIO()
        Image.fromarray(session.first_look).save(encoded, "JPEG", quality=90)
        self.channel.send("preview", encoded.getvalue())

    def show(
        self,
        session: Session,
        appearance: Appearance | None = None,
        steps: TimeSteps | None = None,
    ) -> None:
        """Display a started ``session`` in all windows, also in those that are open already."""
        self.session = session
        self.send_preview(session)
        self.show_message("loading the controls ...")
        self._set_first_camera(session)
        self._placeholder.remove()
        self.panel = LightPanel(self._server, session, self.channel)
        if appearance is not None and appearance.is_editable:
            TransferPanel(self._server, session, appearance, self.panel.editing, self.channel)
        if appearance is not None:
            shared = self._server, session, appearance, self.panel.editing
            with self._server.gui.add_folder("Crop and slices", order=4.5, expand_by_default=False):
                CropPanel(*shared)
                slices = SlicePanel(*shared, self.channel, self._look_again)
        if steps is not None:
            TimePanel(*shared, steps, slices.show)
        anatomical = appearance is not None and appearance.volume.unit == "HU"
        self.channel.send("axes", ["L", "P", "S"] if anatomical else ["x", "y", "z"])
        session.on_status = self.panel.show
        self.panel.show(session.status)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

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
        if self.session is not None:
            self.session.on_status = lambda status: None
        for client in list(self._visitors):
            self._forget(client)
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _set_first_camera(self, session: Session) -> None:
        camera = next(iter(session.cameras.values()))
        place, first = session.placement.to_browser, self._server.initial_camera
        self._server.scene.set_up_direction(camera.up)
        first.position, first.look_at = place(camera.position), place(camera.target)
        first.up, first.fov = camera.up, math.radians(camera.fov)

    def _look_again(self) -> None:
        """Request new images for all windows."""
        for visitor in list(self._visitors.values()):
            visitor.look_again()

    def _connected(self, client: viser.ClientHandle) -> None:
        self.channel.send("preview", b"")  # windows that open later would show an old state
        visitor = Visitor(client, self.session, self._folder, self.channel)
        with self._lock:
            self._visitors[client.client_id] = visitor

    def _gone(self, client: viser.ClientHandle) -> None:
        self._forget(client.client_id)

    def _forget(self, client: int) -> None:
        with self._lock:
            visitor = self._visitors.pop(client, None)
        if visitor is not None:
            visitor.close()

    def _refuse_other_hosts(self) -> None:
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
