"""Viewer windows in a real browser: resized, closed during an update, and with an access token.

Skipped if there is no Chromium.
"""

from __future__ import annotations

import re
import time

import pytest

pytest.importorskip("playwright")
from experiments.performance.viewer.browser import Browser, chromium, viewer

pytestmark = [
    pytest.mark.usefixtures("rgb"),
    pytest.mark.skipif(chromium() is None, reason="there is no Chromium on this machine"),
]


def test_windows_that_are_resized_and_closed(tmp_path):
    """Every resize gives a final image of the new size, and closing windows prints nothing.

    The server accepts other machines, so it requires the token.
    """
    volume = ("phantom:thorax:24,16,20", "--preset", "ct-chest")
    arguments = (*volume, "--host", "0.0.0.0", "--port", "8710")
    log = tmp_path / "log.txt"
    with viewer(arguments, log) as address, Browser() as browser:
        assert re.search(r"/\?token=\S{32,}$", address)
        refused = browser.open(address.partition("?")[0])
        assert "token" in refused.page.inner_text("body")
        window = browser.open(address)
        window.wait_for("^(at rest|final): 512 x 512", 60)
        for width, height in ((420, 300), (430, 310), (640, 280)):
            window.page.set_viewport_size({"width": width, "height": height})
            window.wait_for(f"^(at rest|final): {width} x {height}", 60)
            window.wait_until_shown((width, height), 60)
        for _ in range(3):
            other = browser.open(address, (300, 200))
            other.wait_for("per pixel$", 60)
            other.orbit(5, 10, 0.02)
            other.page.close()
        time.sleep(1)
        assert window.errors == []
    assert not re.search("Traceback|rror|Warning|leaked", log.read_text()), log.read_text()
