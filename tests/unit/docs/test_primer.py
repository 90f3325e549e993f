"""docs/primer and the code cite each other: equations, functions and links exist in both."""

from __future__ import annotations

import ast
import re
from math import log2
from pathlib import Path

import pytest

import mitsuba_irrcache
from mitsuba_irrcache.cache import uncertainty
from mitsuba_irrcache.lights import falloff
from mitsuba_irrcache.render import denoise, raymarch
from mitsuba_irrcache.solvers import grid_size
from mitsuba_irrcache.solvers.discrete_ordinates import anderson, multigrid
from mitsuba_irrcache.solvers.path.solver import PathSolver
from mitsuba_irrcache.solvers.sweep import SweepSolver

PACKAGE = Path(mitsuba_irrcache.__file__).parent
ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
PAGES = sorted((DOCS / "primer").glob("[0-9]-*.md"))
MARKDOWN = [*DOCS.rglob("*.md"), *ROOT.glob("*.md")]
LABEL = re.compile(r"^\$\$ \(eq-(\d+)-(\d+)\)$", re.MULTILINE)
NUMBER = re.compile(r"\((\d\.\d+)\)")


def labels() -> list[str]:
    return [f"{a}.{b}" for page in PAGES for a, b in LABEL.findall(page.read_text())]


def citations() -> dict[str, set[str]]:
    """Equations that each module of the package cites."""
    found: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        for line in path.read_text().splitlines():
            if "docs/primer, eq" in line:
                found.setdefault(str(path.relative_to(PACKAGE)), set()).update(NUMBER.findall(line))
    return found


def defined(path: Path) -> set[str]:
    """Functions, classes, the methods of these, and constants of a module."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            names |= {found.id for found in ast.walk(node) if isinstance(found, ast.Name)}
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            for own in node.body:
                if isinstance(own, ast.FunctionDef):
                    names.add(f"{node.name}.{own.name}")
                if isinstance(own, ast.AnnAssign) and isinstance(own.target, ast.Name):
                    names.add(f"{node.name}.{own.target.id}")
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_equations_are_numbered_one_after_the_other_and_all_have_a_label(page):
    text, number = page.read_text(), page.stem[0]
    found = LABEL.findall(text)
    assert found == [(number, str(i)) for i in range(1, len(found) + 1)]
    assert text.count("\n$$\n") == len(found)  # openings; ends carry a label
    assert text.count("\n$$") == 2 * len(found)


def test_every_equation_is_cited_by_the_code_and_every_citation_exists():
    cited = set().union(*citations().values())
    assert cited == set(labels())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_references_to_equations_exist(page):
    text = " ".join(page.read_text().split())
    named = [
        n
        for part in re.findall(r"eqs?\. [^A-Za-z]*(?:to \S+)?", text)
        for n in NUMBER.findall(part)
    ]
    assert set(named) <= set(labels())


@pytest.mark.parametrize("page", MARKDOWN, ids=lambda page: str(page.relative_to(ROOT)))
def test_functions_that_documents_name_exist(page):
    for module, name in re.findall(r"`([\w/]+\.py)::([\w.]+)`", page.read_text()):
        roots = [
            root for root in (PACKAGE, ROOT, ROOT / "tests/system") if (root / module).exists()
        ]
        assert roots, f"{page.name}: {module}"
        assert name in defined(roots[0] / module), f"{page.name}: {module}::{name}"


@pytest.mark.parametrize("page", MARKDOWN, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_images_lead_to_files(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", MARKDOWN, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_line_is_taken_for_a_comment(page):
    """MyST leaves out lines that begin with a per cent sign."""
    assert not re.findall(r"^%.*", page.read_text(), re.MULTILINE)


CONSTANTS = [
    ("2-representation", r"\\frac\{\((\d+) h\)\^2\}", (falloff.MOST_DISTANCE,)),
    ("4-sweep", r"4\\pi \\cdot ([\d.]+)\) < 1", (multigrid.THIN,)),
    ("4-sweep", r"of at most (\d+) voxels along a side", (multigrid.COARSEST,)),
    ("4-sweep", r"\$\[-0.5, (\d+)\]\$", (anderson.MAX_EXTRAPOLATION,)),
    ("4-sweep", r"is below (\S+) of the field", (multigrid.TOLERANCE,)),
    ("5-projection", r"by more than (\S+) of what", (raymarch.EARLY_STOP,)),
    (
        "5-projection",
        r"where at most (\d+) % and (\d+) % can",
        (100 * raymarch.COARSER, 100 * raymarch.COARSEST),
    ),
    ("6-error", r"times ([\d.]+) where eq", (uncertainty.CONSERVATIVE_FACTOR,)),
    ("6-error", r"\\delta = ([\d.]+)\$", (denoise.PERTURBATION,)),
    ("6-error", r"\$e\$ is ([\d.]+) of the mean", (denoise.FIXED_WIDTH,)),
    (
        "7-defaults",
        r"\\epsilon_B = ([\d.]+) \\, d\^\{([\d.]+)\}",
        (grid_size.BORDER_ERROR, grid_size.BORDER_ORDER),
    ),
    (
        "7-defaults",
        r"min\(d_v, ([\d.]+)\)\}\{([\d.]+)\} .*\^\{([\d.]+)\} , \\; 1 , \\; (\d+) ",
        (
            grid_size.OPAQUE,
            grid_size.RESOLVED,
            grid_size.OPAQUE_POWER,
            grid_size.MOST_PER_DATA_VOXEL,
        ),
    ),
    (
        "7-defaults",
        r"; up to (\d+) where \$d_v > (\d+)\$",
        (grid_size.MOST_PER_OPAQUE_VOXEL, grid_size.VERY_OPAQUE),
    ),
    (
        "7-defaults",
        r"at most \$([\d.]+) \\, d\^\{([\d.]+)\}\$ %",
        (grid_size.SMOOTH_BORDER_ERROR, grid_size.SMOOTH_BORDER_ORDER),
    ),
    ("7-defaults", r"\\epsilon_B\$ exceeds (\d+) %", (grid_size.LARGE_BORDER_ERROR,)),
    (
        "7-defaults",
        r"at most \$2\^\{(\d+)\}\$ voxels .*, \$2\^\{(\d+)\}\$ where that is finer",
        (log2(grid_size.MOST_VOXELS), log2(grid_size.MOST_REFINED)),
    ),
    (
        "7-defaults",
        r"\\epsilon = ([\d.]+)\$ % for `sweep`, (\d+) % for `path`",
        (grid_size.TARGET_ERROR, PathSolver.size_rule.target_error),
    ),
    (
        "7-defaults",
        r"1\. (\d+) along the longest side \(`path`: (\d+)\)",
        (SweepSolver.size_rule.fewest, PathSolver.size_rule.fewest),
    ),
    (
        "7-defaults",
        r"at most (\d+)\s+along each axis \(`path`: (\d+)\)",
        (SweepSolver.size_rule.most_by_contrast, PathSolver.size_rule.most_by_contrast),
    ),
    (
        "7-defaults",
        r"most ([\d.]+) %: \$([\d.]+) \\, d \+ (\d+) \\, a \\, \\min\(d, ([\d.]+)\)\$ %",
        (
            grid_size.SMOOTH_ERROR,
            grid_size.DEPTH_ERROR,
            grid_size.DETAIL_ERROR,
            grid_size.MOST_DETAIL_DEPTH,
        ),
    ),
    ("7-defaults", r"\\sigma_B\$, at most (\d+) ", (SweepSolver.size_rule.most_by_border,)),
]


@pytest.mark.parametrize(("page", "text", "values"), CONSTANTS)
def test_constants_are_those_of_the_code(page, text, values):
    (path,) = (p for p in PAGES if p.stem == page)
    found = re.search(text, " ".join(path.read_text().split()))
    assert found, f"{page} does not say {text}"
    assert [float(x) for x in found.groups()] == pytest.approx(values)


def test_pages_name_functions_for_their_equations():
    for page in PAGES:
        text = page.read_text()
        assert len(re.findall(r"`[\w/]+\.py::[\w.]+`", text)) >= len(LABEL.findall(text)) // 2


def test_cited_works_are_in_the_list_of_references():
    listed = (DOCS / "primer/references.md").read_text()
    for page in PAGES:
        for names, year in re.findall(
            r"([A-ZŠ][\w-]+(?: et al\.| and [A-Z]\w+)?),? (\d{4})",
            " ".join(page.read_text().split()),
        ):
            name = names.split()[0]
            assert any(name in line and year in line for line in listed.split("\n- ")), (name, year)
