"""Atomic file creation."""

from __future__ import annotations

import os
import stat

import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.files import atomic_write


def test_replaces_the_old_file(tmp_path):
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    with atomic_write(target) as file:
        file.write(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_no_file_remains_after_an_error(tmp_path, error):
    with pytest.raises(error), atomic_write(tmp_path / "a.bin") as file:
        file.write(b"half")
        raise error
    assert os.listdir(tmp_path) == []


def test_permissions_are_those_of_a_new_file(tmp_path):
    """Permissions are those of a new file, not the 0600 of a temporary file."""
    with atomic_write(tmp_path / "a.bin"):
        pass
    (tmp_path / "b.bin").write_bytes(b"")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a.bin", "b.bin")]
    assert modes[0] == modes[1]


def test_missing_folder_is_named(tmp_path):
    with (
        pytest.raises(IrrcacheError, match=r"nowhere.*does not exist"),
        atomic_write(tmp_path / "nowhere" / "a.bin"),
    ):
        pass
