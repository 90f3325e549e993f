"""Windows of the viewer in a real browser: sizes, token, files, comparison, random interactions.

Skipped if there is no Chromium.
"""

from __future__ import annotations

import io
import json
import re
import time
import zipfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.compare.metrics import block_means
from mitsuba_irrcache.io.images import read_image
from mitsuba_irrcache.volumes.transfer import load_preset

pytest.importorskip("playwright")
from experiments.performance.viewer.browser import Browser, chromium, viewer
from experiments.performance.viewer.usage import use
from tests.support.viewer_windows import SIZE, after, difference, screen, settled

pytestmark = [
    pytest.mark.usefixtures("rgb"),
    pytest.mark.skipif(chromium() is None, reason="there is no Chromium on this machine"),
]

CHEST = ("phantom:thorax:40,28,36", "--preset", "ct-chest")
SENSORS = """<scene version="3.0.0">
    <integrator type="volpath"> <integer name="max_depth" value="2"/> </integrator>
    <sensor type="perspective" id="front"> <float name="fov" value="40"/>
        <transform name="to_world"> <lookat origin="0, 1, -5" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
    </sensor>
    <sensor type="perspective" id="inside"> <float name="fov" value="70"/>
        <transform name="to_world">
            <lookat origin="0.1, 0.2, -0.5" target="0, 0, 0.3" up="0, 1, 0"/>
        </transform>
    </sensor>
    <emitter type="envmap"> <string name="filename" value="sky.exr"/> </emitter>
    <medium type="heterogeneous" id="cloud">
        <volume name="sigma_t" type="gridvolume"> <string name="filename" value="density.vol"/>
            <transform name="to_world"> <scale value="2"/> <translate x="-1" y="-1" z="-1"/>
            </transform>
        </volume>
        <rgb name="albedo" value="0.9, 0.8, 0.6"/>
    </medium>
    <shape type="cube"> <bsdf type="null"/> <ref name="interior" id="cloud"/> </shape>
    <shape type="rectangle"> <bsdf type="diffuse"/>
        <transform name="to_world"> <scale value="4"/> <rotate x="1" angle="-90"/>
            <translate y="-1.3"/> </transform>
    </shape>
</scene>"""
#: JavaScript: whether the panel is beside the image of a window of this width.
PANEL_IS_BESIDE = """width => {
    const box = document.querySelector('#root canvas[data-engine]').getBoundingClientRect();
    return box.x == 0 && 250 < width - box.width && width - box.width < 350;
}"""


@pytest.fixture(scope="module")
def browser():
    with Browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def reachable(tmp_path_factory):
    """Start a viewer that other machines can reach and that has no folder; return its address."""
    log = tmp_path_factory.mktemp("reachable") / "log.txt"
    volume = ("phantom:thorax:24,16,20", "--preset", "ct-chest")
    with viewer((*volume, "--host", "0.0.0.0", "--port", "8710"), log) as address:
        yield address
    assert not re.search("Traceback|rror|Warning|leaked", log.read_text()), log.read_text()


def test_windows_that_are_resized_and_closed(browser, reachable):
    """Every resize gives a final image of the free area, and closing windows prints nothing.

    The server accepts other machines, so it requires the token.
    """
    assert re.search(r"/\?token=\S{32,}$", reachable)
    refused = browser.open(reachable.partition("?")[0])
    assert "token" in refused.page.inner_text("body")
    window = browser.open(reachable, SIZE)
    window.wait_for("^(at rest|final)")
    for width, height in ((800, 300), (830, 310), (600, 280)):
        window.page.set_viewport_size({"width": width, "height": height})
        window.page.wait_for_function(PANEL_IS_BESIDE, arg=width)
        window.wait_until_shown((round(window.canvas()["width"]), height))
    for _ in range(2):
        other = browser.open(reachable, (600, 200))
        other.wait_for("per pixel$")
        other.orbit(5, 10, 0.02)
        other.page.close()
    time.sleep(0.5)
    assert window.errors == []
    window.page.close()


@pytest.mark.slow  # downloads of the browser take minutes on busy machines
def test_transfer_functions_and_archives_are_exchanged(browser, reachable, tmp_path):
    """Transfer functions and scenes are exchanged through the browser.

    A saved JSON is accepted by ``irrcache import``, and a loaded one changes the image. Without an
    output folder, the downloaded archive holds a scene that renders to the displayed image.
    """
    window = browser.open(reachable, SIZE)
    page = window.page
    window.unfold("Scattering and error")
    window.enter("target error %", 25)
    first = settled(window)
    with page.expect_download() as download:
        page.locator("irrcache-transfer [data-id=save]").click()
    saved = tmp_path / "saved.json"
    download.value.save_as(saved)
    given = json.loads(load_preset("ct-chest").to_json())
    assert json.loads(saved.read_text()).keys() == given.keys()

    def load(file: Path) -> None:
        with page.expect_file_chooser() as chooser:
            page.locator("irrcache-transfer [data-id=load]").click()
        chooser.value.set_files(str(file))

    other = tmp_path / "bone.json"
    other.write_text(load_preset("ct-bone").to_json())
    assert difference(after(window, lambda: load(other)), first) > 3
    broken = tmp_path / "<b>broken.json"
    broken.write_text('{"opacity": 3}')
    load(broken)
    page.get_by_text("Refused:").first.wait_for()
    back = after(window, lambda: load(saved))
    page.get_by_text("Refused:").first.wait_for(state="hidden")
    assert difference(back, first) < 1.5

    page.get_by_text("Save", exact=True).click()
    with page.expect_download() as download:
        page.get_by_role("button", name="download view", exact=True).click()
        page.get_by_text("downloaded view.zip").wait_for()
    archive = tmp_path / "view.zip"
    download.value.save_as(archive)
    assert window.errors == []
    page.close()
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(tmp_path / "kept")
    assert {f.suffix for f in (tmp_path / "kept").iterdir()} == {".png", ".exr", ".xml", ".vol"}
    kept = tmp_path / "kept" / "view-scene.xml"
    assert main(["render", str(kept), "-o", str(tmp_path / "again.exr")]) == 0
    again = np.rint(255 * read_image(tmp_path / "again.png"))
    assert difference(again, back) < 1.5


@pytest.mark.slow
def test_cameras_and_environment_of_a_scene_with_surfaces(browser, tmp_path, scenes):
    """The viewer offers a scene's cameras, rotates its environment and compares with volpath.

    One of the cameras is in the medium.
    """
    density = scenes.texture((12, 12, 12, 1), 0.2, 4, 1)
    mi.VolumeGrid(density).write(str(tmp_path / "density.vol"))
    sky = np.full((8, 16, 3), 0.2, np.float32)
    sky[2:4, 3:6] = 6.0
    mi.Bitmap(sky).write(str(tmp_path / "sky.exr"))
    (tmp_path / "scene.xml").write_text(SENSORS)
    arguments = (str(tmp_path / "scene.xml"), "--port", "8720")
    with viewer(arguments, tmp_path / "log.txt") as address:
        window = browser.open(address, SIZE)
        window.unfold("Scattering and error")
        window.enter("target error %", 20)
        front = settled(window)
        assert front.std() > 10
        inside = after(window, lambda: window.choose("camera", "inside"))
        assert difference(inside, front) > 3
        back = after(window, lambda: window.choose("camera", "front"))
        assert difference(back, front) < 2
        turned = after(window, lambda: window.enter("rotation, °", 120))
        assert difference(turned, front) > 3

        # The comparison: a caption from the beginning, then volpath on the right of the divider.
        window.choose("compare", "swipe")
        window.page.locator("#irrcache-overlay .right", has_text="volpath").wait_for()
        window.wait_for(r"volpath, \d{2,} samples per pixel.*; RMSE")
        divider = window.page.locator("#irrcache-overlay .divider").bounding_box()
        mouse, middle = window.page.mouse, divider["y"] + divider["height"] / 2
        mouse.move(divider["x"] + divider["width"] / 2, middle)
        mouse.down()
        mouse.move(window.canvas()["x"], middle, steps=3)
        mouse.up()
        reference = window.page.locator("#irrcache-overlay img[data-id=reference]")
        assert "inset(0" in reference.get_attribute("style") and reference.is_visible()
        captions = "#irrcache-overlay > div, #irrcache-overlay svg {visibility: hidden}"
        hidden = window.page.add_style_tag(content=captions)
        shot = window.page.screenshot(clip=window.canvas())
        hidden.evaluate("style => style.remove()")
        theirs = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=float)
        ours = screen(window)
        assert ours.std() > 10 and abs(ours.mean() - theirs.mean()) < 3
        squares = [block_means(image, 10).ravel() for image in (ours, theirs)]  # without noise
        assert np.corrcoef(*squares)[0, 1] > 0.9
        window.choose("compare", "error")
        window.page.locator("#irrcache-overlay .scale", has_text="% of the mean").wait_for()
        assert window.errors == []
    log = (tmp_path / "log.txt").read_text()
    assert "Traceback" not in log, log


@pytest.mark.slow
def test_random_interactions(browser, tmp_path):
    """Half a minute of random interactions causes no error, however many the machine completes."""
    usage = use(browser, [*CHEST, "--port", "8730"], 30, 5, tmp_path / "log.txt")
    assert usage.errors == []
    assert sum(usage.done.values()) >= 3 and usage.pictures > 3
    assert re.search("http://", (tmp_path / "log.txt").read_text())
