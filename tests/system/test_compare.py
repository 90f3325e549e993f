"""``irrcache compare`` from the command line to the report, including failures."""

from __future__ import annotations

import ast
import csv
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813 (the name its documentation uses)
import pytest

import mitsuba_irrcache.compare
from mitsuba_irrcache.cli.main import main

SCENE = """<scene version="3.0.0">
    <default name="density" value="1"/>
    <integrator type="volpath"> <integer name="max_depth" value="3"/> </integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0, 0, -5" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="48"/>
            <integer name="height" value="32"/>
            <string name="pixel_format" value="rgba"/>
        </film>
    </sensor>
    <shape type="cube">
        <bsdf type="null"/>
        <medium name="interior" type="homogeneous">
            <float name="sigma_t" value="$density"/>
            <rgb name="albedo" value="0.9, 0.8, 0.5"/>
        </medium>
    </shape>
    <emitter type="directional"> <vector name="direction" x="1" y="-1" z="1"/> </emitter>
</scene>
"""

# A third-party integrator that renders like volpath until it is killed.
PLUGIN = """
import os, signal
import mitsuba as mi

class Mortal(mi.SamplingIntegrator):
    def __init__(self, props):
        super().__init__(props)
        self.left = int(props.get("lives", 1000))
        self.inner = mi.load_dict({"type": "volpath", "max_depth": props.get("max_depth", -1)})

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return self.inner.render(scene, sensor, seed, spp, develop, evaluate)

mi.register_integrator("mortal", lambda props: Mortal(props))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a scene and an importable plugin module."""
    folder = tmp_path_factory.mktemp("compare")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "mortal_plugin.py").write_text(PLUGIN)
    return folder


def compare(folder: Path, *arguments) -> int:
    references = ["--references", folder / "references", "--reference-spp", 4096]
    return main(["compare", str(folder / "scene.xml"), *map(str, [*references, *arguments])])


@pytest.fixture(scope="module")
def report(folder):
    """Create a report in which one of three integrators is killed after its first snapshot.

    Five images determine the number of samples whose image takes 50 ms. The twelve after them
    take about 0.6 s, far from both budgets on slower and faster machines.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        integrators = ["-i", "volpath", "-i", "mortal{lives=17}", "-i", "irrcache{resolution=12}"]
        options = ["--budget", "0.1,1.5", "--import", "mortal_plugin", "-o", folder / "report"]
        status = compare(folder, *integrators, *options)
    assert status == 1 and (folder / "report" / "report.html").exists()  # one failed
    return folder / "report"


def read(report: Path) -> dict:
    return json.loads((report / "results.json").read_text())


def test_finished_measurements_survive_a_crash(report):
    """The other measurements are complete; the killed integrator's first snapshot is included."""
    stock, killed, ours = read(report)["measurements"]
    for measurement in (stock, ours):
        assert not measurement["error"]
        assert [s["budget"] for s in measurement["snapshots"]] == [0.1, 1.5]
        assert all(measurement[start] for start in ("cold", "warm", "again", "memory"))
    assert "SIGKILL" in killed["error"]
    assert [s["budget"] for s in killed["snapshots"]] == [0.1]
    assert "mortal{lives=17} did not finish" in (report / "report.html").read_text(encoding="utf-8")


def test_stages(report):
    """A cold start compiles kernels, a warm one loads them, and another view reuses the cache."""
    stock, _, ours = read(report)["measurements"]
    for measurement in (stock, ours):
        cold, warm = measurement["cold"], measurement["warm"]
        assert (
            cold["backend"] > warm["backend"]
        )  # "kernels" is a difference, noise of a busy machine
        assert 0 < cold["import"] < 60 and cold["load"] > 0
    assert "cache" not in stock["cold"]
    assert ours["again"]["cache"] < 0.5 * ours["cold"]["cache"]
    for snapshot in ours["snapshots"]:
        assert set(snapshot["seconds"]) == {"cache", "image"}


def test_errors(report):
    """volpath's error is noise that decreases with time; both integrators converge to one image.

    The errors of 1536 pixels are known to some 5 %.
    """
    stock, _, ours = read(report)["measurements"]
    first, last = stock["snapshots"]
    fall = first["errors"]["rmse"] / last["errors"]["rmse"]
    assert fall == pytest.approx(np.sqrt(last["spp"] / first["spp"]), rel=0.35)
    assert ours["snapshots"][-1]["errors"]["rmse"] < 0.1
    errors = last["errors"]
    assert abs(errors["bias"]) < 5 * errors["bias_uncertainty"] + 0.005
    assert errors["invalid"] == 0


def test_json_csv_and_images_agree(report):
    with open(report / "results.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    snapshots = [s for m in read(report)["measurements"] for s in m["snapshots"]]
    assert len(rows) == len(snapshots) == 5
    for row, snapshot in zip(rows, snapshots, strict=True):
        assert float(row["rmse"]) == pytest.approx(snapshot["errors"]["rmse"])
        assert float(row["seconds"]) == pytest.approx(sum(snapshot["seconds"].values()))
        image = oiio.ImageBuf(str(report / snapshot["image"]))
        assert (image.spec().width, image.spec().height, image.nchannels) == (48, 32, 3)
        assert image.spec().format == oiio.FLOAT


def test_memory_is_the_integrators_own(report):
    """The reported memory is that of the worker, not inherited from its parent process."""
    memory = read(report)["measurements"][0]["memory"]
    assert 2**26 < memory["first_image"] <= memory["peak"] < 2**31


def test_the_report_is_self_contained(report):
    """The report loads no other file, contains all plots, and its tags are balanced."""

    class Page(HTMLParser):
        def __init__(self):
            super().__init__()
            self.drawings, self.links, self.open = 0, [], []

        def handle_starttag(self, tag, attributes):
            if tag not in ("meta", "br"):
                self.open.append(tag)
            self.drawings += tag == "svg"
            self.links += [v for k, v in attributes if k in ("src", "href", "xlink:href")]

        def handle_endtag(self, tag):
            assert self.open.pop() == tag

    text = (report / "report.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert not page.open
    assert page.drawings == len(list((report / "figures").glob("*.svg"))) == 3
    assert page.links and all(link.startswith("#") for link in page.links)
    assert "http" not in re.sub(r"\"data\": \"[^\"]*\"", "", text)


def test_the_report_in_a_browser(report):
    """Opened from disk, the report shows the pixels of the EXR files and the values of its plots.

    Skipped if there is no Chromium.
    """
    pytest.importorskip("playwright")
    from experiments.performance.viewer.browser import Browser, chromium

    if chromium() is None:
        pytest.skip("there is no Chromium on this machine")
    snapshots = [s for m in read(report)["measurements"] for s in m["snapshots"]]
    with Browser() as browser:
        window = browser.open((report / "report.html").as_uri(), (1200, 900))
        page, requests = window.page, []
        page.on("request", lambda request: requests.append(request.url))
        canvas = page.locator("[data-id=canvas]")
        page.get_by_text("move the pointer over").wait_for()

        def pointed(x: float, y: float) -> str:
            """Point at a place of the image; (0, 0) is its upper left corner, in pixels."""
            canvas.scroll_into_view_if_needed()
            box = canvas.bounding_box()
            scale = min(box["width"] / 48, box["height"] / 32)
            left = box["x"] + box["width"] / 2 + (x - 24) * scale
            page.mouse.move(left, box["y"] + box["height"] / 2 + (y - 16) * scale)
            return page.locator("[data-id=values]").inner_text()

        # The first image of the choices is on the left of the divider, the reference on the right.
        page.locator(".choices button").first.click()
        said = pointed(20.5, 15.5).splitlines()
        pixels = oiio.ImageBuf(str(report / snapshots[0]["image"])).get_pixels(oiio.FLOAT)
        truth = oiio.ImageBuf(str(report / "images" / "reference.exr")).get_pixels(oiio.FLOAT)
        assert said[0] == "pixel 20, 15"
        for line, image in ((said[1], pixels), (said[2], truth)):
            shown = [float(number) for number in line.split()[:3]]
            assert shown == pytest.approx(image[15, 20].tolist(), rel=2e-3)
        error = float(re.search(r"error (\S+) % of the mean", said[1])[1])
        exact = 100 * (pixels[15, 20].mean() - truth[15, 20].mean()) / truth.mean()
        assert error == pytest.approx(exact, abs=0.3)

        # The wheel zooms about the pointer, and zooms of all images are common.
        page.mouse.wheel(0, -400)
        assert page.locator("[data-id=values]").inner_text().startswith("pixel 20, 15")
        canvas.press("d")
        canvas.press("r")
        page.locator("[data-id=high]", has_text="10 % and more").wait_for()
        canvas.press("r")
        canvas.press(" ")
        page.locator(".choices button.a", has_text="reference").wait_for()

        marker = page.locator('[id="rmse-0"] use').last
        marker.scroll_into_view_if_needed()
        place = marker.bounding_box()
        page.mouse.move(place["x"] + place["width"] / 2, place["y"] + place["height"] / 2)
        tip = page.locator(".tip:visible").inner_text()
        last = next(m for m in read(report)["measurements"] if m["integrator"] == "volpath")
        shown = last["snapshots"][-1]
        seconds, error = re.fullmatch(r"volpath\n(\S+) s, RMSE (\S+) %( or less)?", tip).groups()[
            :2
        ]
        assert float(seconds) == pytest.approx(sum(shown["seconds"].values()), rel=0.01)
        assert float(error) >= 100 * shown["errors"]["rmse"] * 0.99
        assert window.errors == [] and requests == []


def test_nothing_temporary_is_left(report):
    names = {path.name for path in report.iterdir()}
    folders = {"figures", "images", "logs", "measurements"}
    assert names == folders | {"report.html", "results.json", "results.csv"}
    assert not [path for path in report.rglob(".*")]


def test_another_run_finds_the_reference(folder, report, capsys):
    """A report is replaced on request only, and the reference is reused."""
    kept = {p: p.stat().st_mtime_ns for p in (folder / "references").iterdir()}
    before = (report / "report.html").read_bytes()
    assert compare(folder, "-i", "path", "--budget", "0.1", "-o", report) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert (report / "report.html").read_bytes() == before
    other = folder / "other"
    assert compare(folder, "-i", "path", "--budget", "0.1", "-o", other) == 0
    assert "Error after equal time" in capsys.readouterr().out
    assert {p: p.stat().st_mtime_ns for p in (folder / "references").iterdir()} == kept


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-i", "volpth"], "volpth"),
        (["-i", "volpath{rr_dpth=5}"], "rr_dpth"),
        (["-i", "volpath", "--reference", "volpaht"], "volpaht"),
        (["-i", "volpath", "-i", "volpath"], "twice"),
        (["-i", "volpath", "--budget", "1,-3"], "--budget"),
        (["-i", "volpath", "-s", "3"], "--sensor is 3"),
        (["-i", "volpath", "-m", "llvm_rgb"], "llvm_rgb"),
        (["-i", "volpath", "-D", "densty=3"], "densty"),
        (["-i", "volpath{"], "volpath{"),
    ],
)
def test_wrong_arguments(folder, capsys, arguments, said):
    """Invalid arguments are named before rendering, and no files are written."""
    before = set(folder.iterdir())
    assert compare(folder, *arguments, "-o", folder / "never") == 1
    error = capsys.readouterr().err
    assert said in error and error.startswith("irrcache: error:") and "Traceback" not in error
    assert set(folder.iterdir()) == before


def test_wrong_folders(folder, capsys):
    """Files, folders with other contents and folders without a parent are refused as output."""
    for output, said in (("scene.xml", "is a file"), (".", "no report"), ("a/b", "does not exist")):
        assert compare(folder, "-i", "volpath", "-o", folder / output) == 1
        assert said in capsys.readouterr().err


def test_a_scene_that_does_not_load(tmp_path, capsys):
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.replace("homogeneous", "heterogenious"))
    assert main(["compare", str(scene), "-i", "volpath", "-o", str(tmp_path / "out")]) == 1
    assert "heterogenious" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [scene]


def test_integrators_are_known_by_name_only():
    """The comparison imports nothing of irrcache's method."""
    shared = {"cli", "compare", "core", "errors", "io", "machine"}
    for file in Path(mitsuba_irrcache.compare.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and not node.level:
                package, _, rest = node.module.partition(".")
                if rest == "render.denoise":  # works on any image
                    continue
                names = {rest.split(".")[0]} if rest else {alias.name for alias in node.names}
                assert package != "mitsuba_irrcache" or names <= shared, file.name
            assert not (isinstance(node, ast.ImportFrom) and node.level > 1), file.name
