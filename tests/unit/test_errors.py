"""The class hierarchy of exceptions for callers."""

from __future__ import annotations

import mitsuba_irrcache
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError, UnsupportedSceneError


def test_one_except_clause_catches_them_all():
    for kind in (CacheFileError, UnsupportedSceneError):
        assert issubclass(kind, IrrcacheError)
    assert issubclass(IrrcacheError, ValueError)
    assert mitsuba_irrcache.IrrcacheError is IrrcacheError
