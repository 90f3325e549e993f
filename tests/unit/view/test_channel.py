"""Messages between the viewer and the components on its page."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest

pytest.importorskip("viser")
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.view import channel
from mitsuba_irrcache.view.channel import PATH
from mitsuba_irrcache.view.server import Server
from mitsuba_irrcache.view.transfer_panel import STEPS, History, edited
from mitsuba_irrcache.volumes.transfer import load_preset


@pytest.fixture(scope="module")
def server():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(channel, "ALIVE_SECONDS", 3600)
        server = Server("127.0.0.1", 8770)
        yield server
        server.stop()


def open_channel(server: Server, **options):
    return connect(f"ws://127.0.0.1:{server.port}{PATH}", **options)


def received(connection) -> dict:
    return json.loads(connection.recv(timeout=60))


def test_windows_receive_the_newest_messages_to_them(server):
    """A window receives the newest messages to all, then its own, and none of other windows."""
    channel = server.channel
    for text in ("first", "second"):
        server.show_message(text)
    own, other = channel.open(), channel.open()
    channel.send("note", "for another", other)
    channel.send("note", "yours", own)
    with open_channel(server) as connection:
        assert received(connection) == {"kind": "wait", "value": "second"}
        connection.send(json.dumps({"kind": "window", "value": own}))
        assert received(connection) == {"kind": "note", "value": "yours"}
        channel.send("note", "for another", other)
        channel.send("picture", b"\x00\xff", own)
        assert connection.recv(timeout=60) == b"picture\0\x00\xff"
    channel.close(own)
    channel.send("note", "nobody is there", own)


def test_windows_are_told_why_there_is_nothing(server):
    """Windows that wait for a volume learn why it cannot be read."""
    server.show_message("reading ...")
    with open_channel(server) as connection:
        assert received(connection)["value"] == "reading ..."
        server.show_failure("no such file")
        assert received(connection) == {"kind": "wait", "value": "error: no such file"}
    server.show_message("")


def test_an_idle_viewer_says_that_it_responds(server, monkeypatch):
    """Without it, a page could not tell a viewer that waits from one that hangs."""
    monkeypatch.setattr(channel, "ALIVE_SECONDS", 0.05)
    with open_channel(server) as connection:
        kinds = [json.loads(connection.recv(timeout=60))["kind"] for _ in range(4)]
    assert kinds[-2:] == ["alive", "alive"]


def test_messages_of_windows(server):
    """Messages reach the receiver of their kind; what is none, or is refused, does no harm."""
    channel, values, arrived = server.channel, [], threading.Event()

    def take(value: object) -> None:
        if value == "last":
            arrived.set()
        values.append(float(value))

    channel.receive("number", take)
    with open_channel(server) as connection:
        for text in ("no JSON", "[]", "3", '{"kind": []}', "[" * 60000, '{"kind": "number"}'):
            connection.send(text)
        for value in (1, "x", 2, "last"):
            connection.send(json.dumps({"kind": "number", "value": value}))
        assert arrived.wait(60)
    assert values == [1, 2]


def test_pages_of_other_sites_are_refused(server):
    with open_channel(server, origin="http://example.org") as connection:
        with pytest.raises(ConnectionClosed):
            connection.recv(timeout=60)


def test_edits_by_a_browser():
    """Points replace those of the function, and what is no curve is refused."""
    function = load_preset("ct-bone")
    opacity, colour = [[0.0, 0.1], [5.0, 0.9]], [[1, [0.1, 0.2, 0.3]], [2, [1, 1, 1]]]
    found = edited(function, {"opacity": opacity, "colour": colour})
    np.testing.assert_array_equal(found.opacity_values, [0, 5])
    np.testing.assert_array_equal(found.colours, [[0.1, 0.2, 0.3], [1, 1, 1]])
    assert found.length == function.length and found.unit == function.unit
    for wrong in ([[5, 0.1], [0, 0.9]], [[0, 0.1], [5, 1.0]], [[0, "x"]], [], [[0, 0]] * 999, 3):
        with pytest.raises((IrrcacheError, ValueError, TypeError)):
            edited(function, {"opacity": wrong, "colour": colour})


def test_history():
    """Steps are undone and redone; a new one drops those that were undone."""
    history = History("a", "preset")
    assert not history.can(-1) and not history.can(1)
    history.add("b", "")
    history.add("c", "")
    history.travel(-2)
    assert (history.bounded(-3), history.bounded(9)) == (0, 2)
    assert history.now == ("a", "preset") and history.at(1) == ("b", "")
    history.travel(1)
    history.add("d", "")
    assert history.now == ("d", "") and not history.can(1) and history.at(-1) == ("b", "")
    for number in range(2 * STEPS):
        history.add(number, "")
    assert history.can(1 - STEPS) and not history.can(-STEPS)
