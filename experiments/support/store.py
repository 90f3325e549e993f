"""Results in a JSON file, each computed once."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from mitsuba_irrcache.compare.results import write_json


class Store:
    """Rows by key. Each row is written when it is complete, so that an interrupted run can
    continue.

    ``force`` discards earlier rows.
    """

    def __init__(self, path: Path, force: bool = False) -> None:
        self.path = path
        self.rows: dict[str, dict] = {} if force or not path.exists() else read_json(path)

    def row(self, key: str, compute: Callable[[], dict]) -> dict:
        """Return the row ``key``, computed if it is missing."""
        if key not in self.rows:
            self.rows[key] = compute()
            write_json(self.path, self.rows)
        return self.rows[key]


def read_json(path: Path) -> dict:
    """Read the results of an experiment's run.py."""
    return json.loads(path.read_text())
