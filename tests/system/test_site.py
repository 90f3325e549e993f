"""The documentation site builds without warnings, and its equations have the numbers cited."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs/primer").glob("[0-9]-*.md"))

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, its notebooks executed."""
    pytest.importorskip("sphinx", reason="the extra docs is not installed: make docs")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs", folder],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_equations_have_the_numbers_of_their_labels(site, page):
    shown = re.findall(
        r'id="equation-eq-(\d+)-(\d+)">\s*<span class="eqno">\((\d+)\.(\d+)\)',
        re.sub(r"<a [^>]*>.*?</a>", "", (site / f"primer/{page.stem}.html").read_text()),
    )
    labels = re.findall(r"^\$\$ \(eq-(\d+)-(\d+)\)$", page.read_text(), re.MULTILINE)
    assert [(a, b) for a, b, _, _ in shown] == labels
    assert all((a, b) == (c, d) for a, b, c, d in shown)


def test_citations_are_links(site):
    text = (site / "primer/4-sweep.html").read_text()
    assert len(re.findall(r'href="#equation-eq-4-\d+"', text)) > 5


def test_the_page_of_the_plugin_has_all_its_parameters(site):
    source = (ROOT / "integrators/irrcache.py").read_text()
    text = (site / "plugins/index.html").read_text()
    names = re.findall(r"^     \* - (\w+)$", source, re.MULTILINE)
    assert len(names) > 12
    assert all(f"<p>{name}</p>" in text for name in names)


def test_every_notebook_has_pictures(site):
    for page in (ROOT / "docs/tutorials").glob("*.md"):
        if page.stem != "index":
            assert "_images" in (site / f"tutorials/{page.stem}.html").read_text(), page.stem
