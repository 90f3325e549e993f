"""The class hierarchy of exceptions for callers."""

from __future__ import annotations

import errno

import pytest

import mitsuba_irrcache
from mitsuba_irrcache.cli import render
from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import (
    CacheFileError,
    IrrcacheError,
    UnsupportedSceneError,
    original_message,
    reason,
)


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


def test_the_message_of_an_irrcache_error_is_not_that_of_its_cause():
    """Mitsuba wraps exceptions of plugins, which may have a cause."""
    try:
        try:
            raise IrrcacheError("the file is damaged; delete it") from EOFError("no data")
        except IrrcacheError as error:
            raise RuntimeError("a plugin failed") from error
    except RuntimeError as error:
        assert original_message(error) == "the file is damaged; delete it"


def test_one_except_clause_catches_them_all():
    for kind in (CacheFileError, UnsupportedSceneError):
        assert issubclass(kind, IrrcacheError)
    assert issubclass(IrrcacheError, ValueError)
    assert mitsuba_irrcache.IrrcacheError is IrrcacheError
