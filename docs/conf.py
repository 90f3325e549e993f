"""Configuration of the documentation site; ``make docs`` builds it."""

from __future__ import annotations

import os
import re
import sys
from importlib import metadata
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "extensions"))
# Notebooks and shown commands run "irrcache" of the environment that builds the site.
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
os.environ["COLUMNS"] = "96"

import mitsuba as mi  # noqa: E402

import mitsuba_irrcache  # noqa: E402

# The integrator's class exists for a variant only.
mi.set_variant("llvm_ad_rgb")

project = "mitsuba_irrcache"
author = copyright = "The mitsuba_irrcache developers"
release = version = mitsuba_irrcache.__version__
urls = dict(
    entry.split(", ", 1) for entry in metadata.metadata(project).get_all("Project-URL") or []
)

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx-mathjax-offline",  # equations appear without access to other servers
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_tabs.tabs",
    "sphinxcontrib.programoutput",
    "code_breaks",
    "mitsuba_plugins",
]
exclude_patterns = ["extensions", "README.md"]
templates_path: list[str] = []
default_role = "code"
nitpicky = False

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
nb_ipywidgets_js: dict = {}

# Equations are numbered by page of the primer, as their labels say: tests compare both.
numfig = True
math_numfig = True
numfig_secnum_depth = 1

autodoc_typehints = "none"  # docstrings state types and shapes
autodoc_preserve_defaults = True  # as written, not as printed
autodoc_member_order = "bysource"
napoleon_use_rtype = False
copybutton_prompt_text = "$ "
sphinx_tabs_disable_tab_closing = True

html_theme = "furo"
html_title = f"mitsuba_irrcache {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {"source_branch": "main", "source_directory": "docs/"}
if "Source" in urls:
    html_theme_options["source_repository"] = urls["Source"]
linkcheck_timeout = 15

#: "eq. (4.7)", or "eqs. (4.6), (4.7) and (5.1)".
_EQUATIONS = re.compile(
    r"(?<=eq\.\s)\(\d\.\d+\)|(?<=eqs\.\s)(?:\(\d\.\d+\)(?:,|\s+and|\s+to|\s+or)?\s*)+"
)
_LABELS = {
    label
    for page in (HERE / "primer").glob("[0-9]-*.md")
    for label in re.findall(r"^\$\$ \((eq-\d+-\d+)\)$", page.read_text(), re.MULTILINE)
}


def _link_equations(app, name: str, source: list[str]) -> None:
    """Make a link of each equation that is cited by its number, such as "eq. (4.7)"."""

    def link(number: re.Match) -> str:
        label = f"eq-{number[1]}-{number[2]}"
        return f"{{eq}}`{label}`" if label in _LABELS else number[0]

    def links(found: re.Match) -> str:
        return re.sub(r"\((\d)\.(\d+)\)", link, found[0])

    # Code and formulas, in blocks and in lines, stay as they are.
    parts = re.split(
        r"(^```.*?^```|^\$\$.*?^\$\$|`[^`\n]+`|\$[^$]+\$)",
        source[0],
        flags=re.DOTALL | re.MULTILINE,
    )
    source[0] = "".join(p if i % 2 else _EQUATIONS.sub(links, p) for i, p in enumerate(parts))


def setup(app) -> None:
    """Connect the hook."""
    app.connect("source-read", _link_equations)
