"""Write the tables of the structure: folders and their levels, equations and functions, modules.

    python -m experiments.docs.structure

They follow from the docstrings of folders and modules and from the equations that the code cites,
and are written to docs/developing/structure.md and docs/developing/modules.md, which a test
compares with the code. The levels below are the import rule itself, which a test enforces.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from experiments.support.documents import replace_tables
from mitsuba_irrcache.compare.tables import Table

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "mitsuba_irrcache"
DOCUMENTS = tuple(ROOT / "docs/developing" / name for name in ("structure.md", "modules.md"))
#: Folders of the package from the lowest level to the highest: each imports those below. Folders of
#: one level do not import each other.
LEVELS = (
    ("errors",),
    ("core",),
    ("io", "machine"),
    ("grids",),
    ("media", "lights"),
    ("transport",),
    ("scene",),
    ("cache",),
    ("solvers",),
    ("pipeline",),
    ("render",),
    ("gradients", "out_of_core"),
    ("imaging",),
    ("integrators", "cli", "compare"),
    ("farm", "view"),
)
#: Folders that import less than their level permits.
ONLY = {"volumes": ("errors", "core", "io", "machine")}
#: Folders that the installation maps into the package; here they lie beside it.
MAPPED = ("integrators", "scenes")
CITATION, EQUATION = re.compile(r"docs/primer, eqs?\."), re.compile(r"\((\d)\.(\d+)\)")


def main() -> None:
    """Write the tables."""
    for document in DOCUMENTS:
        replace_tables(document, tables(), origin="")
        print(document.relative_to(ROOT))


def tables() -> dict[str, Table]:
    """Return the tables by the names of their marks."""
    return {"folders": folders(), "equations": equations(), "modules": modules()}


def folders() -> Table:
    """Tabulate the folders, the highest level first."""
    rows = [
        [str(level), f"`{name}`", summary(_docstring_of_folder(name))]
        for level, names in reversed(list(enumerate(LEVELS, 1)))
        for name in names
    ]
    for name, permitted in ONLY.items():
        imports = ", ".join(f"`{each}`" for each in permitted)
        about = summary(_docstring_of_folder(name))
        rows.append(["", f"`{name}`", f"{about}; imports {imports} only"])
    return Table("Folders", ["level", "folder", "holds"], rows)


def equations() -> Table:
    """Tabulate the numbered equations, and the functions that cite them."""
    found: dict[tuple[int, int], list[str]] = {}
    for name, path in _modules():
        text = path.read_text(encoding="utf-8")
        scopes = list(_scopes(ast.parse(text)))
        for number, line in enumerate(text.splitlines(), 1):
            if not CITATION.search(line):
                continue
            inside = [scope for first, last, scope in scopes if first <= number <= last]
            place = f"`{name}::{inside[-1]}`" if inside else f"`{name}`"
            for pair in EQUATION.findall(line):
                found.setdefault((int(pair[0]), int(pair[1])), []).append(place)
    rows = [[f"eq. ({a}.{b})", ", ".join(sorted(found[a, b]))] for a, b in sorted(found)]
    return Table("Equations", ["primer", "functions"], rows)


def modules() -> Table:
    """Tabulate all modules by folder."""
    rows = []
    for name, path in _modules():
        if path.name in ("__init__.py", "__main__.py"):
            continue
        about = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        rows.append([f"`{name}`", summary(about)])
    return Table("Modules", ["module", "holds"], rows)


def summary(docstring: str) -> str:
    """Return the first sentence of a docstring, without its full stop; code is marked as in
    Markdown.
    """
    paragraph = " ".join(docstring.split("\n\n")[0].split())
    first = re.split(r"(?<=[^.])(?<!\beq)(?<!\beqs)\.(?: |$)", paragraph)[0]
    return re.sub(r"`+([^`]+)`+", r"`\1`", first)


def _docstring_of_folder(name: str) -> str:
    single, folder = PACKAGE / f"{name}.py", PACKAGE / name
    if name in MAPPED:
        folder = ROOT / name
    path = single if single.exists() else folder / "__init__.py"
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def _modules() -> Iterator[tuple[str, Path]]:
    """All modules by their place in the package."""
    found = {str(p.relative_to(PACKAGE)): p for p in PACKAGE.rglob("*.py")}
    found = {name: p for name, p in found.items() if not name.startswith(MAPPED)}
    found |= {f"{name}/{p.name}": p for name in MAPPED for p in (ROOT / name).glob("*.py")}
    yield from sorted(found.items(), key=lambda item: (item[0].rpartition("/")[0], item[0]))


def _scopes(node: ast.AST, within: str = "") -> Iterator[tuple[int, int, str]]:
    """Yield the lines and qualified names of classes and of functions that are no part of others,
    outer ones first.
    """
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.FunctionDef):
            name = f"{within}{child.name}"
            yield child.lineno, child.end_lineno, name
            if isinstance(child, ast.ClassDef):
                yield from _scopes(child, f"{name}.")


if __name__ == "__main__":
    main()
