"""File transfer between the viewer and a real browser, and random interactions.

Skipped if there is no Chromium.
"""

from __future__ import annotations

import json
import re
import time
import zipfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cli.main import main
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


@pytest.fixture(scope="module")
def browser():
    with Browser() as browser:
        yield browser


def test_transfer_functions_and_archives_are_exchanged(browser, tmp_path):
    """Transfer functions and scenes are exchanged through the browser.

    A saved JSON is accepted by ``irrcache import``, and a loaded one changes the image. Without an
    output folder, the downloaded archive holds a scene that renders to the displayed image.
    """
    with viewer((*CHEST, "--port", "8710"), tmp_path / "log.txt") as address:
        window = browser.open(address, SIZE)
        page = window.page
        page.add_style_tag(content="[class*=Notification] {display: none !important}")
        window.enter("target error %", 6)
        first = settled(window)
        with page.expect_download() as download:
            page.get_by_role("button", name="save JSON").click()
        saved = tmp_path / "saved.json"
        download.value.save_as(saved)
        given = json.loads(load_preset("ct-chest").to_json())
        assert json.loads(saved.read_text()).keys() == given.keys()

        def load(file: Path) -> None:
            with page.expect_file_chooser() as chooser:
                page.get_by_role("button", name="load JSON").click()
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
        with page.expect_download(timeout=90_000) as download:
            page.get_by_role("button", name="download", exact=True).click()
            page.get_by_text("downloaded view.zip").wait_for(timeout=80_000)
        archive = tmp_path / "view.zip"
        download.value.save_as(archive)
        assert window.errors == []
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(tmp_path / "kept")
    assert {f.suffix for f in (tmp_path / "kept").iterdir()} == {".png", ".exr", ".xml", ".vol"}
    kept = tmp_path / "kept" / "view.xml"
    assert main(["render", str(kept), "-o", str(tmp_path / "again.exr")]) == 0
    again = np.rint(255 * read_image(tmp_path / "again.png"))[:, : back.shape[1]]
    assert difference(again, back) < 1.5


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
        window.page.add_style_tag(content="[class*=Notification] {display: none !important}")
        window.enter("target error %", 20)
        front = settled(window)
        assert front.std() > 10
        inside = after(window, lambda: window.choose("camera", "inside"))
        assert difference(inside, front) > 3
        back = after(window, lambda: window.choose("camera", "front"))
        assert difference(back, front) < 2
        turned = after(window, lambda: window.enter("rotation", 120))
        assert difference(turned, front) > 3
        window.tick("compare with volpath")
        window.wait_for(r"volpath, \d{2,} samples per pixel; RMSE", 90)
        window.page.add_style_tag(content=".mantine-Paper-root {visibility: hidden}")
        # The image follows the text, and the sRGB curve biases its noise, so samples are awaited.
        latest = time.monotonic() + 30
        apart = np.inf
        while not apart < 3 and time.monotonic() < latest:
            ours, theirs = np.split(screen(window, SIZE[0]), 2, axis=1)
            apart = abs(ours.mean() - theirs.mean())
        assert ours.std() > 10 and apart < 3
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
