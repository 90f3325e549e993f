"""Results that are kept in a JSON file, each computed once."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from mitsuba_irrcache.compare.results import write_json


class Store:
    """Rows by key. A row is written as soon as it is there, so that an interrupted experiment goes
    on where it stopped; ``force`` forgets those of before.
    """

    def __init__(self, path: Path, force: bool = False) -> None:
        self.path = path
        self.rows: dict[str, dict] = {} if force or not path.exists() else read_json(path)

    def row(self, key: str, compute: Callable[[], dict]) -> dict:
        """The row called ``key``, computed if it is not there yet."""
        if key not in self.rows:
            self.rows[key] = compute()
            write_json(self.path, self.rows)
        return self.rows[key]


def read_json(path: Path) -> dict:
    """What an experiment's run.py left."""
    return json.loads(path.read_text())
