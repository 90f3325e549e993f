"""Mutation tests: apply each mutant to a copy of the project, and run the tests that should
fail.

    python -m experiments.robustness.mutation.run [--only PART_OF_A_NAME] [--force] [-o output]

The tests are part of ``make test``. Writes output/mutation/results.json, a row for each mutant, and
prints the table: whether and by which test it was detected. Exits with 1 if one survives.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

from experiments.robustness.mutation.mutants import MUTANTS, Mutant
from experiments.robustness.mutation.outside import OUTSIDE
from experiments.robustness.mutation.slips import SLIPS
from experiments.robustness.mutation.surfaces import SURFACES
from experiments.support.options import parser_of
from experiments.support.store import Store
from mitsuba_irrcache.compare.tables import Table

PROJECT = Path(__file__).resolve().parents[3]
PARTS = ("mitsuba_irrcache", "integrators", "scenes", "tests", "experiments", "pyproject.toml")
#: Packages that an installation maps into another one: in a copy they are links.
MAPPED = ("integrators", "scenes")
SURVIVED = "survived"
ALL = (*MUTANTS, *OUTSIDE, *SLIPS, *SURFACES)


def main() -> int:
    """Run the mutants without a result."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", default="", help="mutants with this in their names")
    args = parser.parse_args()
    folder = args.output / "mutation"
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / "results.json", args.force)
    rows = {
        mutant.name: store.row(mutant.name, partial(verdict, mutant))
        for mutant in ALL
        if args.only in mutant.name
    }
    print(tabulated(rows).as_text())
    survivors = [name for name, row in rows.items() if row["by"] == SURVIVED]
    print(f"\n{len(rows)} mutants, {len(rows) - len(survivors)} caught")
    return 1 if survivors else 0


def verdict(mutant: Mutant) -> dict:
    """Return the first test that fails with ``mutant``."""
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder))
        apply(mutant, copy / "mitsuba_irrcache")
        started = time.perf_counter()
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-m", "not slow"]
        environment = os.environ | {"PYTHONPATH": str(copy)}
        done = subprocess.run(
            [*command, *mutant.tests], cwd=copy, env=environment, capture_output=True, text=True
        )
    failed = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"the tests did not run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return {"by": failed[0] if failed else SURVIVED, "seconds": time.perf_counter() - started}


def copied(folder: Path) -> Path:
    """Create a copy of the project that is imported from its own folder."""
    ignored = shutil.ignore_patterns("__pycache__", *MAPPED)
    for part in PARTS:
        source = PROJECT / part
        if source.is_dir():
            shutil.copytree(source, folder / part, ignore=ignored)
        else:
            shutil.copy(source, folder / part)
    for name in MAPPED:
        (folder / "mitsuba_irrcache" / name).symlink_to(folder / name)
    return folder


def apply(mutant: Mutant, package: Path) -> None:
    """Change the only occurrence; raise ValueError if there is none or more than one."""
    file = package / mutant.file
    text = file.read_text(encoding="utf-8")
    if text.count(mutant.old) != 1:
        raise ValueError(f'{mutant.file} has {text.count(mutant.old)} times "{mutant.old}"')
    file.write_text(text.replace(mutant.old, mutant.new))


def tabulated(rows: dict[str, dict]) -> Table:
    """Tabulate a row for each mutant."""
    cells = [[name, row["by"].removeprefix("tests/")] for name, row in rows.items()]
    return Table("Mutants", ["mutant", "caught by"], cells)


if __name__ == "__main__":
    sys.exit(main())
