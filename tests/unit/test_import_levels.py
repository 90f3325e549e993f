"""Imports point down only: a folder of the package imports lower levels and itself."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import mitsuba_irrcache
from experiments.docs.structure import LEVELS, ONLY

PACKAGE = Path(mitsuba_irrcache.__file__).parent
#: Modules that re-export names of the package.
TOP = {"__init__", "__main__", "_register"}

ALLOWED = {name: set(below) for name, below in ONLY.items()} | {
    name: set().union(*LEVELS[:level]) | ({"volumes"} if name == "view" else set())
    for level, names in enumerate(LEVELS)
    for name in names
}


def modules() -> dict[str, Path]:
    """Return all modules of the package by their names within it."""
    found = {
        ".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in PACKAGE.rglob("*.py")
    }
    plugins = (PACKAGE.parent / "integrators").glob("*.py")
    return found | {f"integrators.{p.stem}": p for p in plugins}


def imported(module: str, path: Path) -> set[str]:
    """Return the modules of the package that a module imports anywhere; ``""`` is the package
    itself.

    This includes imports in functions and for type checkers.
    """
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = ["mitsuba_irrcache", *module.split(".")]
            base = ".".join(parts[: len(parts) - node.level]) if node.level else ""
            base = ".".join(filter(None, (base, node.module)))
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        found |= {name for name in names if name.split(".")[0] == "mitsuba_irrcache"}
    return {name.partition(".")[2] for name in found}


MODULES = modules()
FOLDERS = {name.split(".")[0] for name in MODULES} - TOP


def test_every_folder_has_a_level():
    assert FOLDERS == ALLOWED.keys()


@pytest.mark.parametrize("folder", sorted(FOLDERS))
def test_imports_point_down(folder):
    wrong = [
        f"{module} imports {name}"
        for module, path in MODULES.items()
        if module.split(".")[0] == folder
        for name in imported(module, path)
        if (target := name.split(".")[0]) in FOLDERS and target not in ALLOWED[folder] | {folder}
    ]
    assert wrong == []


def test_no_module_imports_the_package_itself_but_for_its_version():
    wrong = [
        f"{module} imports {name or 'the package'}"
        for module, path in MODULES.items()
        if module not in TOP
        for name in imported(module, path)
        if name.split(".")[0] not in FOLDERS and name != "__version__"
    ]
    assert wrong == []


def test_modules_do_not_import_each_other_in_a_circle():
    edges = {
        module: {name for name in targets(module, path) if name != module}
        for module, path in MODULES.items()
        if module not in TOP
    }
    while leaves := {module for module, needed in edges.items() if not needed & edges.keys()}:
        edges = {module: needed for module, needed in edges.items() if module not in leaves}
    assert edges == {}


def test_no_test_imports_another():
    tests = Path(__file__).parents[1]
    wrong = [
        f"{path.relative_to(tests)} imports {name}"
        for path in tests.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in [getattr(node, "module", None), *(alias.name for alias in node.names)]
        if name and name.rpartition(".")[2].startswith("test_")
    ]
    assert wrong == []


def targets(module: str, path: Path) -> set[str]:
    """Return the imported modules; an imported name may be a module or be defined in one."""
    names = imported(module, path)
    return {m for name in names for m in (name, name.rpartition(".")[0]) if m in MODULES}
