"""The class hierarchy of exceptions for callers."""

from __future__ import annotations

import errno

import pytest

import mitsuba_irrcache
from mitsuba_irrcache.cli import render
from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError, UnsupportedSceneError, reason


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (FileNotFoundError(errno.ENOENT, "No such file", "a.xml"), '"a.xml": No such file'),
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (OSError("cannot be read"), "cannot be read"),
    ],
)
def test_errors_of_the_operating_system_have_no_number(error, said, monkeypatch, capsys):
    def fail(*_):
        raise error

    monkeypatch.setattr(render, "run", fail)
    assert main(["render", "scene.xml"]) == 1
    assert capsys.readouterr().err == f"irrcache: error: {said}\n"
    assert said.endswith(reason(error))


def test_one_except_clause_catches_them_all():
    for kind in (CacheFileError, UnsupportedSceneError):
        assert issubclass(kind, IrrcacheError)
    assert issubclass(IrrcacheError, ValueError)
    assert mitsuba_irrcache.IrrcacheError is IrrcacheError
