"""The snippets of README.md and docs/guide.md run as they stand."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

ROOT = Path(__file__).parents[2]
PAGES = "README.md", "docs/guide.md"
#: So that snippets, which name a scene of the repository, take no time.
SMALL = {"size": "16", "spp": "4"}


def snippets(page: str, language: str) -> list[str]:
    found = re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.M)
    assert found, f"{page} has no {language}"
    return found


@pytest.mark.parametrize("page", PAGES)
def test_python(page, monkeypatch, tmp_path):
    """All snippets of a page one after the other, as a reader would type them."""
    load = mi.load_file
    monkeypatch.setattr(mi, "load_file", lambda path: load(str(ROOT / path), **SMALL))
    monkeypatch.chdir(tmp_path)
    known: dict[str, object] = {}
    for snippet in snippets(page, "python"):
        exec(compile(snippet, page, "exec"), known)
    image = np.array(known["image"])
    assert image.shape == (16, 16, 3) and np.isfinite(image).all() and image.max() > 0
    assert known["cache"].samples > 0
    if "merged" in known:
        assert known["merged"].samples == known["cache"].samples + known["second"].cache.samples


def test_a_moved_camera_reuses_the_cache(monkeypatch):
    """As README.md says of its snippet."""
    load = mi.load_file
    monkeypatch.setattr(mi, "load_file", lambda path: load(str(ROOT / path), **SMALL))
    known: dict[str, object] = {}
    first, rest = snippets("README.md", "python")[0].split("sensor = ")
    exec(first, known)
    before = known["scene"].integrator().cache
    exec("sensor = " + rest, known)
    assert known["cache"] is before
    assert np.abs(np.array(known["other"]) - np.array(known["image"])).max() > 0


@pytest.mark.parametrize("page", PAGES)
def test_xml(page, tmp_path):
    """Each integrator loads, with all of its properties known and at values that are admitted."""
    values = np.ones((2, 2, 2, 1), np.float32)
    mi.VolumeGrid(values).write(str(tmp_path / "fire.vol"))
    for snippet in snippets(page, "xml"):
        path = tmp_path / "scene.xml"
        path.write_text(f'<scene version="3.0.0">{snippet}</scene>')
        scene = mi.load_file(str(path))
        assert type(scene.integrator()).__name__ == "IrradianceCachingIntegrator"
        ElementTree.fromstring(snippet)


def test_properties_are_those_of_the_integrator():
    """The table of README.md: names and defaults as the plugin documents them."""
    table = re.findall(r"^\| `(\w+)` \| (\S*) ?\|", (ROOT / "README.md").read_text(), re.M)
    documented = (ROOT / "integrators/irrcache.py").read_text()
    assert len(table) > 8
    for name, default in table:
        entry = documented[documented.index(f"* - {name}\n") :]
        said = re.search(r"\(Default: ([^)]*)\)", entry)[1]
        assert default.strip("`") == {"none": ""}.get(said, said).strip("`") or name == "filter", (
            name
        )


def test_every_command_is_one():
    """Subcommands of ``irrcache``, and targets of make."""
    from mitsuba_irrcache.cli.main import main

    makefile = (ROOT / "Makefile").read_text()
    for page in PAGES:
        for snippet in snippets(page, "sh"):
            for line in snippet.splitlines():
                words = line.split()
                if words[:1] == ["make"]:
                    assert f"\n{words[1]}:" in makefile
                elif words[:1] == ["irrcache"]:
                    with pytest.raises(SystemExit) as ended:
                        main([words[1], "--help"])
                    assert ended.value.code == 0, line
