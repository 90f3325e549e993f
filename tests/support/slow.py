"""Parameters of which `make test` runs some, and `make stress` the others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pytest


def with_slow(cases: Mapping[str, object] | Iterable[object], *slow: object) -> list:
    """Return parameters of a test, of which those in ``slow`` are marked.

    ``cases`` are values, or by name tuples or values; then names are ids, and ``slow`` are names.
    """
    named = isinstance(cases, Mapping)
    keys = list(cases)
    assert all(key in keys for key in slow), f"{slow} are not all among {keys}"
    found = []
    for key in keys:
        value = cases[key] if named else key
        values = value if isinstance(value, tuple) else (value,)
        name = key if named or isinstance(key, str) else None
        found.append(pytest.param(*values, id=name, marks=[pytest.mark.slow] * (key in slow)))
    return found
