"""Compare the structure of two versions of the package: modules, imports, calls, functions, times.

    python -m experiments.docs.restructuring [--before COMMIT] [--rounds N] [--document FILE]

The versions are the last commit before the package was divided into folders, and the present one.
The former is checked out into a temporary folder by ``git worktree``, and uses the installed
Mitsuba and Dr.Jit. Prints the tables; given docs/developing/restructuring.md, writes them there.

- *Import levels*: a module that imports no other one of the package has level 1, all others have
  one more than the highest that they import; modules that import each other share a level. Imports
  within functions and for type checkers count.
- *A render* is traced by `traced_render`. Of calls between the same two functions only the first
  counts. A call goes *up* if the callee's module imports the caller's, for example a callback.
- *Times* are those of the processor, of processes that run for the versions in turn, with compiled
  kernels and modules.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from experiments.docs import traced_render
from experiments.support.documents import replace_tables
from mitsuba_irrcache.compare.tables import Table

ROOT = Path(__file__).resolve().parents[2]
#: The last commit with all modules in one folder.
BEFORE = "e748e49"
SCENE = ROOT / "scenes/cloud.xml"
#: Limits above which functions are counted as long, or as having many parameters.
LINES, PARAMETERS = 60, 7
#: Number of functions in the table of the longest ones.
LONGEST = 10
#: Programs whose time is measured, by what they do.
PROGRAMS = {
    "`import mitsuba_irrcache`": "import mitsuba_irrcache",
    "`import mitsuba_irrcache`, a variant, the plugin": (
        "import mitsuba as mi, mitsuba_irrcache; mi.set_variant('llvm_ad_rgb'); "
        "mi.load_dict({'type': 'irrcache'})"
    ),
    "`irrcache render`, 16 x 16 pixels, a cache of 16³ voxels": (
        "import sys; from mitsuba_irrcache.cli import command; "
        f"sys.argv = ['irrcache', 'render', {str(SCENE)!r}, '-o', 'small.exr', '-D', 'size=16', "
        "'--spp', '1', '-i', 'irrcache{solver=sweep,resolution=16,cache_spp=32}']; command()"
    ),
}


def main() -> None:
    """Measure, print and write the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--before", default=BEFORE, help="commit (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=9, help="times are medians of this many")
    parser.add_argument("--document", type=Path, help="file whose tables are replaced")
    args = parser.parse_args()
    with checked_out(args.before) as old:
        checkouts = {"before": old, "now": ROOT}
        tables = {
            "restructuring-modules": modules_table(checkouts),
            "restructuring-render": render_table(checkouts),
            "restructuring-way": way_table(checkouts),
            "restructuring-functions": functions_table(checkouts),
            "restructuring-times": times_table(checkouts, args.rounds),
        }
    for table in tables.values():
        print(table.as_text(), end="\n\n")
    if args.document:
        replace_tables(args.document, tables)


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Check a commit out into a temporary folder for the time of the context."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / commit
        subprocess.run(["git", "worktree", "add", "--detach", folder, commit], cwd=ROOT, check=True)
        try:
            for name in ("integrators", "scenes"):  # as the installation maps them
                (folder / "mitsuba_irrcache" / name).symlink_to(folder / name)
            yield folder
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", folder], cwd=ROOT, check=True)


# Imports


def modules_of(checkout: Path) -> dict[str, Path]:
    """Return the files of all modules by their names within the package.

    Files that hold nothing but a docstring do not count.
    """
    package = checkout / "mitsuba_irrcache"
    found = {
        p: ".".join(p.relative_to(package).with_suffix("").parts)
        for p in sorted(package.rglob("*.py"))
    }
    plugins = sorted((checkout / "integrators").glob("*.py"))
    found |= {path: f"integrators.{path.stem}" for path in plugins}
    return {
        name.removesuffix(".__init__"): path
        for path, name in found.items()
        if len(ast.parse(path.read_text(encoding="utf-8")).body) > 1
        and not (package in path.parents and name.startswith(("integrators.", "scenes.")))
    }  # fmt: skip


def imports_of(modules: dict[str, Path]) -> dict[str, set[str]]:
    """Return which of the ``modules`` each of them imports, anywhere in its file."""
    found = {}
    for module, path in modules.items():
        names = set(_imported(module, path))
        names = {name if name in modules else name.rpartition(".")[0] for name in names}
        found[module] = names & modules.keys() - {module}
    return found


def _imported(module: str, path: Path) -> Iterator[str]:
    """Yield the names within the package that a module imports: of modules or of their contents."""
    package = "mitsuba_irrcache"
    parts = [package, *module.split(".")]
    if path.name == "__init__.py" and module != "__init__":
        parts.append("__init__")
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = ".".join(parts[: len(parts) - node.level]) if node.level else ""
            base = ".".join(filter(None, (above, node.module)))
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (n.removeprefix(f"{package}.") for n in names if n.startswith(f"{package}."))


def reached_by(imports: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return which modules each one imports, directly or by way of others."""
    reached: dict[str, set[str]] = {}
    for module in imports:
        todo, seen = [module], set()
        while todo:
            new = imports[todo.pop()] - seen
            seen |= new
            todo += new
        reached[module] = seen
    return reached


def levels_of(imports: dict[str, set[str]]) -> tuple[dict[str, int], set[str]]:
    """Return the import level of each module, and the modules that import each other."""
    reached = reached_by(imports)
    circles = {m: {n for n in reached[m] if m in reached[n]} | {m} for m in imports}
    levels: dict[str, int] = {}

    def level(module: str) -> int:
        if module not in levels:
            below = {name for m in circles[module] for name in imports[m]} - circles[module]
            levels[module] = 1 + max(map(level, below), default=0)
        return levels[module]

    return {module: level(module) for module in imports}, {m for m in imports if m in reached[m]}


def folder_of(module: str) -> str:
    """Return the folder of a module; one that is in no folder counts as one by itself."""
    return module.partition(".")[0]


def modules_table(checkouts: dict[str, Path]) -> Table:
    """Tabulate modules, folders and imports."""
    columns = []
    for checkout in checkouts.values():
        modules = modules_of(checkout)
        imports = imports_of(modules)
        levels, circles = levels_of(imports)
        folders: dict[str, set[str]] = {folder_of(module): set() for module in modules}
        for module, names in imports.items():
            folders[folder_of(module)] |= {folder_of(n) for n in names} - {folder_of(module)}
        between = sum(
            folder_of(name) != folder_of(module)
            for module, names in imports.items()
            for name in names
        )
        lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in modules.values())
        columns.append([
            len(modules),
            sum("." not in module for module in modules),
            lines,
            round(lines / len(modules)),
            sum(map(len, imports.values())),
            max(levels.values()),
            len(circles),
            len(folders),
            between,
            len({(f, n) for f, names in folders.items() for n in names}),
            max(levels_of(folders)[0].values()),
            len(levels_of(folders)[1]),
        ])  # fmt: skip
    names = [
        "modules",
        "of them in no folder",
        "lines",
        "lines per module",
        "imports of one module by another",
        "import levels of modules",
        "modules that import each other in a circle",
        "folders, and modules in none",
        "imports between these",
        "pairs of these of which one imports the other",
        "import levels of these",
        "of these in a circle",
    ]
    return _by_version("Modules and imports", checkouts, names, columns)


# A render


def render_table(checkouts: dict[str, Path]) -> Table:
    """Tabulate the calls between modules of a first render."""
    columns = []
    for checkout in checkouts.values():
        imports = imports_of(modules_of(checkout))
        columns.append(calls_between(traced_calls(checkout), reached_by(imports)))
    names = [
        "functions that are called",
        "their modules",
        "calls between functions",
        "calls into another module, and returns from it",
        "of them into modules that had been entered before",
        "of them up",
        "calls into another folder",
        "of them into folders that had been entered before",
    ]
    return _by_version("A render", checkouts, names, columns)


def traced_calls(checkout: Path) -> list[tuple]:
    """Return the pairs of caller and callee, each (module, function), of a first render."""
    traced = _run(checkout, [traced_render.__file__, str(checkout), str(SCENE)])
    return [tuple(map(tuple, pair)) for pair in json.loads(traced)]


def calls_between(calls: list[tuple], reached: dict[str, set[str]]) -> list[int]:
    """Return the numbers of `render_table`, given the calls, and `reached_by` of the modules."""
    across = [(a, b) for (a, _), (b, _) in calls if a != b]
    between = [(folder_of(a), folder_of(b)) for a, b in across if folder_of(a) != folder_of(b)]
    first = calls[0][0][0]
    return [
        len({function for pair in calls for function in pair}),
        len({module for pair in calls for module, _ in pair}),
        len(calls),
        len(across),
        len(across) - len({b for _, b in across} - {first}),
        sum(a in reached.get(b, ()) for a, b in across),
        len(between),
        len(between) - len({b for _, b in between} - {folder_of(first)}),
    ]


def way_table(checkouts: dict[str, Path]) -> Table:
    """Tabulate the folders, or modules in none, in the order in which a render enters them."""
    rows = []
    for version, checkout in checkouts.items():
        calls = traced_calls(checkout)
        entered = dict.fromkeys(folder_of(module) for pair in calls for module, _ in pair)
        rows.append([version, " → ".join(entered)])
    return Table(
        "The way of a render", ["", "folders, and modules in none, as they are entered"], rows
    )


# Functions


def functions_of(checkout: Path) -> list[tuple[int, int, str]]:
    """Return lines, number of parameters (without ``self``) and name of each function."""
    found = []
    for module, path in modules_of(checkout).items():
        for node, name in _functions(ast.parse(path.read_text(encoding="utf-8"))):
            arguments = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
            count = len(arguments) - bool(arguments and arguments[0].arg in ("self", "cls"))
            lines = node.end_lineno - node.lineno + 1
            found.append((lines, count, f"`{name}` in {module.replace('.', '/')}"))
    return sorted(found, key=lambda item: (-item[0], item[2]))


def _functions(node: ast.AST, within: str = "") -> Iterator[tuple[ast.FunctionDef, str]]:
    """Yield functions and their qualified names; functions within functions are parts of these."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield child, within + child.name
        elif isinstance(child, ast.ClassDef):
            yield from _functions(child, f"{within}{child.name}.")
        else:
            yield from _functions(child, within)


def functions_table(checkouts: dict[str, Path]) -> Table:
    """Tabulate the longest functions side by side."""
    columns, counts = [], []
    for checkout in checkouts.values():
        functions = functions_of(checkout)
        columns.append(functions[:LONGEST])
        counts.append([
            f"{len(functions)} functions",
            f"{sum(lines > LINES for lines, _, _ in functions)} of more than {LINES} lines",
            f"{sum(count > PARAMETERS for _, count, _ in functions)} of more than {PARAMETERS} "
            "parameters",
        ])  # fmt: skip
    rows = [
        [str(number), *(cell for lines, _, name in row for cell in (name, str(lines)))]
        for number, row in enumerate(zip(*columns, strict=True), 1)
    ]
    for row in zip(*counts, strict=True):
        rows.append(["", *(cell for text in row for cell in (text, ""))])
    head = ["", *(cell for version in checkouts for cell in (version, "lines"))]
    return Table("Longest functions", head, rows)


# Times


def times_table(checkouts: dict[str, Path], rounds: int) -> Table:
    """Tabulate the median processor time of each program, and the median of the differences."""
    with tempfile.TemporaryDirectory() as modules:
        rows = [_times(checkouts, *item, rounds, modules) for item in PROGRAMS.items()]
    note = f"Processor time, medians of {rounds}; the difference is that of processes in turn."
    return Table("Time", ["process", *checkouts, "difference"], rows, note)


def _times(
    checkouts: dict[str, Path], title: str, program: str, rounds: int, modules: str
) -> list[str]:
    """Return the row of a program."""
    measured: dict[str, list[float]] = {version: [] for version in checkouts}
    for number in range(rounds + 1):
        for version, checkout in checkouts.items():
            seconds = _seconds(checkout, program, modules)
            if number:  # the first one compiles kernels and modules
                measured[version].append(seconds)
    first, *_, last = measured.values()
    difference = statistics.median(b - a for a, b in zip(first, last, strict=True))
    medians = [f"{statistics.median(values):.2f} s" for values in measured.values()]
    return [title, *medians, f"{difference:+.2f} s"]


def _seconds(checkout: Path, program: str, modules: str) -> float:
    """Return the processor time of a process, with all of its own processes.

    Compiled modules are kept in the folder ``modules``.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _run(checkout, ["-X", f"pycache_prefix={modules}", "-c", program])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _run(checkout: Path, arguments: list[str]) -> str:
    """Run Python with the package of a checkout, and return what it prints."""
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as folder:
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=folder,
            env=environment,
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        ).stdout


def _by_version(
    title: str, checkouts: dict[str, Path], names: list[str], columns: list[list[int]]
) -> Table:
    rows = [[name, *map(str, row)] for name, *row in zip(names, *columns, strict=True)]
    return Table(title, ["", *checkouts], rows)


if __name__ == "__main__":
    main()
