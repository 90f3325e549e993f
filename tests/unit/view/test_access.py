"""Access control of the viewer, and waking of its thread when a camera comes to rest."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import urllib.error
import urllib.request
import warnings
from time import monotonic

import numpy as np
import pytest

pytest.importorskip("viser")
import viser
from viser import _messages as messages
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view.access import Access, check_host
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.channel import PATH
from mitsuba_irrcache.view.server import Server, ignore_closed_connections
from mitsuba_irrcache.view.session import Session, Superseded
from mitsuba_irrcache.view.window import View

CAMERA = Camera((0.0, -5.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0)


@pytest.fixture(params=["127.0.0.1", "0.0.0.0"])
def served(request):
    """Return the access control of a server that displays nothing yet, and its port."""
    server = Server(request.param, 8750)
    server.show_message("reading ...")
    yield server._access, server.port
    server.stop()


def page(port: int, path: str = "/", **headers: str) -> tuple[int, str]:
    """Return status and cookie of a page."""
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=60) as response:
            return response.status, response.headers.get("Set-Cookie", "")
    except urllib.error.HTTPError as error:
        return error.code, error.headers.get("Set-Cookie", "")


def connects(port: int, path: str = "/", host: str = "", **headers: str) -> bool:
    """Return whether a window's connections are accepted: viser's, and that of our components."""
    own, viewers = PATH + path[1:], [f"viser-v{viser.__version__}"]
    accepted = {
        _connects(port, path, viewers, host, headers),
        _connects(port, own, None, host, headers),
    }
    assert len(accepted) == 1, "the two connections differ"
    return accepted.pop()


def _connects(port: int, path: str, protocol: list | None, host: str, headers: dict) -> bool:
    try:
        with connect(
            f"ws://{host or '127.0.0.1'}:{port}{path}",
            additional_headers=headers,
            subprotocols=protocol,
            max_size=None,
            sock=socket.create_connection(("127.0.0.1", port)),
        ) as connection:
            connection.recv(timeout=60)
            return True
    except InvalidStatus as refused:
        assert refused.response.status_code == 403
        return False


def test_a_token_is_needed_where_other_machines_can_connect(served):
    access, port = served
    if access.host == "127.0.0.1":
        assert access.token == "" and page(port) == (200, "") and connects(port)
        return
    assert len(access.token) >= 32 and access.token != Access("0.0.0.0").token
    assert page(port) == (403, "") and not connects(port)
    wrong = access.token[:-1] + ("a" if access.token[-1] != "a" else "b")
    assert page(port, f"/?token={wrong}") == (403, "")
    assert not connects(port, f"/?token={wrong}")
    status, cookie = page(port, f"/{access.query()}&fixedDpr=1")
    assert status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
    pair = cookie.partition(";")[0]
    assert page(port, Cookie=pair)[0] == 200 and connects(port, Cookie=pair)
    name = pair.partition("=")[0]
    for forged in (f"{name}={wrong}", f"{name}=", "token", "a=b; =;;", f"other={access.token}"):
        assert page(port, Cookie=forged)[0] == 403
        assert not connects(port, Cookie=forged)


def test_rebound_host_names_are_refused(served):
    """Host names that resolve to this machine (DNS rebinding) are refused, even with the token."""
    access, port = served
    for host in ("evil.example.org", "127.0.0.1.example.org", "localhost.example.org", "["):
        assert page(port, f"/{access.query()}", Host=f"{host}:{port}")[0] == 403
    assert not connects(port, f"/{access.query()}", host="evil.example.org")
    assert page(port, f"/{access.query()}", Host=f"localhost:{port}")[0] == 200
    if access.host == "0.0.0.0":
        for host in ("192.0.2.7", "[2001:db8::1]", socket.gethostname()):
            assert page(port, f"/{access.query()}", Host=f"{host}:{port}")[0] == 200


def test_the_address_has_the_token(monkeypatch):
    """The printed address contains the token; a wildcard is replaced by an address."""
    server = Server.__new__(Server)
    server.host, server.port, server._access = "0.0.0.0", 8080, Access("0.0.0.0")
    query = f"/?token={server._access.token}"
    assert server.address == f"http://127.0.0.1:8080{query}"
    assert server.address_from_elsewhere == f"http://{socket.gethostname()}:8080{query}"
    server.host, server._access = "::1", Access("::1")
    assert server.address == server.address_from_elsewhere == "http://[::1]:8080/"


@pytest.mark.parametrize(
    "host", ["", "no-such-host.invalid", "300.1.1.1", "192.0.2.7", "a\u0100" * 99]
)
def test_hosts_that_cannot_be_listened_on_are_refused(host):
    """Hosts that cannot be listened on are refused, for which viser would search ports
    endlessly.
    """
    with pytest.raises(IrrcacheError, match="--host"):
        check_host(host)
    for good in ("127.0.0.1", "localhost", "0.0.0.0"):
        check_host(good)


def test_messages_for_a_closed_window_are_no_warnings():
    """Messages for a closed window cause no warnings; a browser may disconnect at any time."""
    loop = asyncio.new_event_loop()
    buffer = AsyncMessageBuffer(loop, persistent_messages=False)
    buffer.set_done()
    update = messages.GuiUpdateMessage("id", {"content": "moving"})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        buffer.push(update)
        assert len(caught) == 1  # viser's own log record
        ignore_closed_connections()
        buffer.push(update)
        warnings.warn("something else", UserWarning, stacklevel=1)
        assert len(caught) == 2
    loop.close()


@pytest.fixture
def moving(monkeypatch):
    """Record the timeouts of the session's thread while one camera moves."""
    session, waited = Session(None, "llvm_ad_rgb"), []
    window = session.open(lambda picture: None)
    window.want(View(CAMERA, (40, 30)))
    window.fresh = False

    def begin() -> None:
        window.moved = monotonic()

    def wait(timeout: float | None = None) -> None:
        waited.append(timeout)
        session._stopped = True

    monkeypatch.setattr(session._news, "wait", wait)
    monkeypatch.setattr(session, "_begin", begin)
    begin()
    return session, window, waited


def test_thread_wakes_when_a_camera_comes_to_rest(moving, monkeypatch):
    """The thread wakes when a camera comes to rest after it was last checked.

    Otherwise the image would remain as coarse as that of a moving camera.
    """
    session, window, waited = moving

    def step() -> bool:
        window.moved = -np.inf
        return False

    monkeypatch.setattr(session, "_step", step)
    session._run()
    (timeout,) = waited
    assert timeout is not None and 0 < timeout < 1


@pytest.mark.parametrize("looks", range(1, 5))
def test_solver_pause_ends_when_a_camera_comes_to_rest(moving, monkeypatch, looks):
    """The solver's wait ends when a camera comes to rest between launches, after any number of
    checks.
    """
    session, window, waited = moving
    session._shown, seen = object(), []

    def is_moving(self) -> bool:
        seen.append(self)
        return len(seen) <= looks

    monkeypatch.setattr(type(window), "is_moving", property(is_moving))
    monkeypatch.setattr(session, "_show_resting", lambda first: False)
    with contextlib.suppress(Superseded):
        session._pause()
    assert None not in waited
