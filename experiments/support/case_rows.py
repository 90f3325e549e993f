"""Rows of an experiment on many cases, each computed once and printed as it is complete."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import mitsuba as mi

from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from mitsuba_irrcache.compare.tables import Table

Case = TypeVar("Case")


class CaseRows:
    """The command line, the folder and the stored rows of the experiment ``name``.

    Options are those of all experiments, ``--document``, and ``--only`` to choose cases by name.
    """

    def __init__(
        self,
        description: str | None,
        name: str,
        declare: Callable[[argparse.ArgumentParser], object] = lambda parser: None,
        variant: str = "llvm_ad_rgb",
        arguments: list[str] | None = None,
    ) -> None:
        """Parse the command line, with the options that ``declare`` adds, and set the variant.

        With an option ``budget``, no case is begun after so many seconds.
        """
        parser = parser_of(description)
        add_document(parser)
        parser.add_argument("--only", default="", help="cases whose name contains this")
        declare(parser)
        self.args = parser.parse_args(arguments)
        begin()
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
        self.folder = self.args.output / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self.store = Store(self.folder / "results.json", self.args.force)
        self._started = time.perf_counter()

    def file(self, title: str) -> Path:
        """Return the file of an array that belongs to a title, such as a reference."""
        return self.folder / f"{re.sub('[^0-9a-z]+', '-', title)}.npy"

    def rows(
        self,
        cases: Iterable[tuple[str, Case]],
        measure: Callable[[Case], dict],
        shown: Callable[[str, Case, dict], str],
    ) -> Iterator[tuple[Case, dict]]:
        """Yield the chosen cases with their rows, and print each row as it is ``shown``.

        ``cases`` are titles, by which rows are stored, and arguments of ``measure``, which computes
        the rows that are missing.
        """
        for title, case in cases:
            if self.args.only not in title:
                continue
            if title not in self.store.rows and self._is_late():
                print(f"{title:55} not computed yet; run again", flush=True)
                continue
            row = self.store.row(title, lambda case=case: measure(case))
            print(shown(title, case, row), flush=True)
            yield case, row

    def write(self, tables: dict[str, Table]) -> None:
        """Write tables to the ``--document`` if it is given."""
        if self.args.document:
            replace_tables(self.args.document, tables)

    def _is_late(self) -> bool:
        budget = getattr(self.args, "budget", None)
        return budget is not None and time.perf_counter() - self._started > budget


def with_budget(seconds: float) -> Callable[[argparse.ArgumentParser], object]:
    """Return a function that declares ``--budget`` with this default."""
    return lambda parser: parser.add_argument(
        "--budget", type=float, default=seconds, help="no case is begun later"
    )


def with_reference(seconds: float) -> Callable[[argparse.ArgumentParser], object]:
    """Return a function that declares ``--seconds``, the time of each reference by volpath."""
    return lambda parser: parser.add_argument(
        "--seconds", type=float, default=seconds, help="of volpath for each case"
    )
