"""The snippets of README.md and of the documentation's pages run as they stand."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

ROOT = Path(__file__).parents[2]
PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("index", "install", "faq")),
    *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "docs/how-to").glob("*.md"))),
)
#: So that snippets, which name a scene of the repository, take no time.
SMALL = {"size": "16", "spp": "4"}


def snippets(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.M)


def pages(language: str) -> list[str]:
    """Return the pages that have snippets in a language."""
    return [page for page in PAGES if snippets(page, language)]


def test_there_are_snippets():
    assert {"README.md", "docs/index.md", "docs/how-to/gradients.md"} <= set(pages("python"))
    assert {"README.md", "docs/how-to/scene.md", "docs/how-to/emission.md"} <= set(pages("xml"))
    assert {"README.md", "docs/install.md", "docs/how-to/command-line.md"} <= set(pages("sh"))


@pytest.mark.parametrize("page", pages("python"))
def test_python(page, monkeypatch, tmp_path):
    """All snippets of a page one after the other, as a reader would type them."""
    load = mi.load_file
    monkeypatch.setattr(mi, "load_file", lambda path: load(path, **SMALL))
    monkeypatch.chdir(tmp_path)
    known: dict[str, object] = {}
    for snippet in snippets(page, "python"):
        exec(compile(snippet, page, "exec"), known)
    images = [np.array(known[name]) for name in ("image", "single", "layers") if name in known]
    for image in images:
        assert image.shape[:2] == (16, 16) and np.isfinite(image).all() and image.max() > 0
    assert images or "mi.render" not in "".join(snippets(page, "python"))
    if "cache" in known:
        assert known["cache"].samples > 0
    if "merged" in known:
        assert known["merged"].samples == 2 * known["second"].cache.samples


def test_a_moved_camera_reuses_the_cache(monkeypatch):
    """As README.md says of its snippet."""
    load = mi.load_file
    monkeypatch.setattr(mi, "load_file", lambda path: load(path, **SMALL))
    known: dict[str, object] = {}
    first, rest = snippets("README.md", "python")[0].split("sensor = ")
    exec(first, known)
    before = known["irrcache"].cache
    exec("sensor = " + rest, known)
    assert known["cache"] is before
    assert np.abs(np.array(known["other"]) - np.array(known["image"])).max() > 0


@pytest.mark.parametrize("page", pages("xml"))
def test_xml(page, tmp_path):
    """Each integrator loads, with all of its properties known and at values that are admitted."""
    values = np.ones((2, 2, 2, 1), np.float32)
    mi.VolumeGrid(values).write(str(tmp_path / "fire.vol"))
    for snippet in snippets(page, "xml"):
        path = tmp_path / "scene.xml"
        path.write_text(f'<scene version="3.0.0">{snippet}</scene>')
        scene = mi.load_file(str(path))
        assert type(scene.integrator()).__name__ == "IrradianceCachingIntegrator"
        ElementTree.parse(path)


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
    """Subcommands of ``irrcache`` with options that they have, and targets of make."""
    from mitsuba_irrcache.cli.main import _parser

    makefile = (ROOT / "Makefile").read_text()
    for page in pages("sh"):
        for line in "\n".join(snippets(page, "sh")).splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["make"]:
                assert f"\n{words[1]}:" in makefile
            elif words[:1] == ["irrcache"]:
                try:
                    _parser(words[1:]).parse_args(words[1:])
                except SystemExit:
                    pytest.fail(f"{page}: {line}")


def test_the_reference_has_every_command():
    from mitsuba_irrcache.cli.main import COMMANDS

    page = (ROOT / "docs/api/command-line.md").read_text()
    for name, *_ in COMMANDS:
        assert f"```{{command-output}} irrcache {name} --help\n" in page
