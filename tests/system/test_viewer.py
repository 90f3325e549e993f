"""``irrcache view`` in a process of its own with a real headless browser.

Skipped if there is no Chromium.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.io.images import read_image
from tests.support.viewer_windows import (
    SIZE,
    after,
    difference,
    drag_until_coarse,
    finally_,
    screen,
    settled,
)

pytest.importorskip("playwright")
from experiments.performance.viewer.browser import Browser, chromium, viewer

pytestmark = [
    pytest.mark.usefixtures("rgb"),
    pytest.mark.skipif(chromium() is None, reason="there is no Chromium on this machine"),
]


@pytest.fixture(scope="module")
def browser():
    with Browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    """Start a viewer of a chest with few voxels; return its address and the folder of its files."""
    folder = tmp_path_factory.mktemp("viewer")
    volume = ("phantom:thorax:32,22,29", "--preset", "ct-chest")
    arguments = (*volume, "-o", str(folder / "kept"), "--port", "8700")
    with viewer(arguments, folder / "log.txt") as address:
        yield address, folder
    log = (folder / "log.txt").read_text()
    assert not re.search("Traceback|rror|leaked|Warning", log), log


def test_edit_save_reload_and_second_window(browser, started):
    """Drag, wheel, edit, save, reload and a second window change the image as expected.

    Saved scenes render to the displayed image.
    """
    address, folder = started
    window = browser.open(address, SIZE)
    window.unfold("Scattering and error")
    window.enter("target error %", 25)
    first = settled(window)
    assert first.std() > 20
    assert window.page.title() == "phantom:thorax:32,22,29 - irrcache"
    assert window.field("preset").input_value() == "ct-chest"
    # The window was open before the camera was known.
    assert window.field("field of view, °").input_value() == "30"

    # Dragging rotates the camera, the wheel moves it closer; meanwhile images have low resolution.
    drag_until_coarse(window, first.shape[1])
    settled(window)
    window.page.mouse.move(100, 200)
    closer = after(window, lambda: window.zoom(-3))
    assert window.shown()[-1]["width"] == first.shape[1]
    assert difference(closer, first) > 3

    # A saved scene renders to the displayed image.
    window.unfold("Save")
    window.page.get_by_role("button", name="save view", exact=True).click()
    window.page.get_by_text("saved view").wait_for(state="attached")  # whether folded or not
    kept = folder / "kept" / "view-scene.xml"
    assert main(["render", str(kept), "-o", str(folder / "again.exr")]) == 0
    again = np.rint(255 * read_image(folder / "again.png"))
    assert again.shape == closer.shape
    assert difference(again, closer) < 1.5
    shown = np.rint(255 * read_image(folder / "kept" / "view.png"))
    assert difference(shown, closer) < 1

    # A point of the transfer function is dragged, added and removed on the plot, and undone.
    points, count = window.curve(), len(window.shown())
    window.drag_point(8, 120, 0.6)
    assert window.curve()[8] == pytest.approx([120, 0.6], abs=4)
    window.page.mouse.click(*window.place_of(-600, 0.4))
    window.wait_for_curve(len(points) + 1)
    window.wait_for_picture(count)
    denser = screen(window)
    window.page.keyboard.press("Delete")
    window.wait_for_curve(len(points))
    for _ in range(3):
        window.page.keyboard.press("Control+z")
    undone = finally_(window, lambda shot: difference(shot, closer) < 1)
    assert window.curve() == points
    assert difference(denser, closer) > 2

    # The sun is dragged on its sphere.
    sphere = window.page.locator("irrcache-light canvas")
    denser = after(window, lambda: sphere.click(position={"x": 50, "y": 20}))
    assert difference(denser, undone) > 2 and window.field("sun").input_value() == "3"

    # A second window has a camera of its own; invalid input is refused where it was entered.
    other = browser.open(address, SIZE)
    elsewhere = settled(other)
    assert difference(elsewhere, denser) > 3
    assert difference(screen(window), denser) < 0.5
    other.unfold("Save")
    other.enter("name", "../escaped")
    other.page.get_by_role("button", name="save view", exact=True).click()
    other.page.get_by_text("is no name for a file").first.wait_for()
    assert not list(folder.parent.glob("escaped*")) and not list(folder.glob("escaped*"))

    # The background has a name of CSS; other words are refused beside it.
    other.unfold("Camera, tone, background")
    field = other.page.locator("irrcache-background input[type=text]")
    field.fill("blurple")
    field.press("Enter")
    other.page.get_by_text('"blurple" is no colour').wait_for()
    field.fill("white")
    field.press("Enter")
    on_white = finally_(other, lambda shot: shot[-40, 10:40].min() > 250)
    assert difference(on_white, elsewhere) > 50
    # Keys with Ctrl move no camera, but undo wherever the focus is.
    points = other.curve()
    other.drag_point(8, 150, 0.02)
    other.page.mouse.click(20, 20)
    other.page.wait_for_function("document.querySelector('irrcache-transfer').state.undo")
    other.page.keyboard.press("Control+a", delay=200)
    other.page.keyboard.press("Control+z")
    other.page.wait_for_function("!document.querySelector('irrcache-transfer').state.undo")
    assert other.curve() == points
    finally_(other, lambda shot: difference(shot, on_white) < 0.5)

    # A reload preserves the shared state.
    other.page.reload()
    assert difference(settled(other), elsewhere) < 0.5
    assert window.errors == [] and other.errors == []


# It is a third of the time of both; `tests/unit/view/test_slices.py` has slices without a browser.
@pytest.mark.slow
def test_slices_are_dragged(browser, started):
    """A slice appears at its place, and is dragged by an arrow."""
    other = browser.open(started[0], SIZE)
    other.unfold("Scattering and error")
    other.enter("target error %", 25)
    elsewhere = settled(other)
    other.unfold("Crop and slices")
    sliced = after(other, lambda: other.choose("in the image", "this one"))
    assert difference(sliced, elsewhere) > 1.5
    place, mouse = other.canvas(), other.page.mouse
    mouse.move(place["x"] + place["width"] / 2, place["y"] + 0.46 * place["height"])
    mouse.down()
    mouse.move(place["x"] + place["width"] / 2, place["y"] + 0.3 * place["height"], steps=5)
    mouse.up()
    finally_(other, lambda _: int(other.field("position, %").input_value()) > 60)
    whole = after(other, lambda: other.choose("in the image", "none"))
    assert difference(whole, elsewhere) < 0.5
    assert other.errors == []


def test_pages_of_other_sites_are_refused(started):
    """Requests from pages of other sites are refused, also under a name that resolves to this
    host.
    """
    from viser import __version__
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    from mitsuba_irrcache.view.access import Access, is_own_page

    address = started[0].replace("http", "ws")

    def answers(origin: str) -> bool:
        protocol = [f"viser-v{__version__}"]
        with connect(address, origin=origin, subprotocols=protocol, max_size=None) as connection:
            try:
                connection.recv(timeout=60)
            except ConnectionClosed:
                return False
            return True

    assert answers(started[0].rstrip("/"))
    assert not answers("http://example.org")
    assert not answers(started[0].rstrip("/").replace("http", "https"))
    local = Access("127.0.0.1")
    assert is_own_page({"Origin": "http://localhost:80", "Host": "localhost:80"}, local)
    assert not is_own_page({"Origin": "http://a.org:80", "Host": "a.org:80"}, local)
    assert not is_own_page({"Origin": "http://a.org:80", "Host": "a.org:80"}, Access("0.0.0.0"))
