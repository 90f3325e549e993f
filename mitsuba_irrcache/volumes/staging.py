"""Atomic creation of folders: they are built under a temporary name and then renamed."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mitsuba_irrcache.errors import IrrcacheError


@contextmanager
def staged_folder(folder: str | os.PathLike, names: set[str], overwrite: bool) -> Iterator[Path]:
    """Create a temporary folder that becomes ``folder`` if the block ends without an exception.

    Args:
        folder: the final folder; it may exist if it is empty.
        names: the files of the result. Only a folder without other files is replaced, so that
            ``overwrite`` can never delete unrelated files.
        overwrite: replace an earlier result, and only on success.

    Raises:
        IrrcacheError: ``folder`` is a file, or is not empty and may not be replaced.
    """
    folder = Path(folder).absolute()
    _check_replaceable(folder, names, overwrite)
    with _temporary_beside(folder) as temporary:
        built = temporary / "new"
        built.mkdir()
        yield built
        replaced = temporary / "old"
        if folder.exists():
            os.rename(folder, replaced)
        try:
            os.rename(built, folder)
        except OSError:
            if replaced.exists():
                os.rename(replaced, folder)
            raise


@contextmanager
def staged_files(folder: str | os.PathLike, names: set[str], overwrite: bool) -> Iterator[Path]:
    """Create a temporary folder whose files move into the existing ``folder`` on success.

    Args:
        folder: an existing folder, whose other files are not changed.
        names: the files of the result.
        overwrite: replace files of these names; on a failure the old ones are restored.

    Raises:
        IrrcacheError: ``folder`` does not exist, or holds one of ``names`` already; or one of these
            is a folder, which is never replaced, since it may hold unrelated files.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        raise IrrcacheError(f"folder {folder} does not exist; create it")
    folders = sorted(name for name in names if (folder / name).is_dir())
    if folders:
        raise IrrcacheError(f"{folder / folders[0]} is a folder and is not replaced; name a file")
    taken = sorted(name for name in names if (folder / name).exists())
    if taken and not overwrite:
        raise IrrcacheError(
            f"{folder} has {', '.join(taken)} already; choose another folder, or give --overwrite"
        )
    with _temporary_beside(folder / "scene") as temporary:
        built = temporary / "new"
        built.mkdir()
        yield built
        _move_into(folder, built, temporary)


def _move_into(folder: Path, built: Path, backup: Path) -> None:
    """Move every file of ``built`` into ``folder``; undo all moves if one fails."""
    moved: list[str] = []
    names = sorted(path.name for path in built.iterdir())
    try:
        for name in names:
            if (folder / name).exists():
                os.rename(folder / name, backup / name)
            os.rename(built / name, folder / name)
            moved.append(name)
    except OSError:
        for name in moved:
            os.unlink(folder / name)
        for name in names:
            if (backup / name).exists():
                os.rename(backup / name, folder / name)
        raise


def _check_replaceable(folder: Path, names: set[str], overwrite: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise IrrcacheError(f"{folder} is a file; name a folder, or a scene ending in .xml")
    if not folder.parent.is_dir():
        raise IrrcacheError(f"folder {folder.parent} does not exist; create it")
    present = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    foreign = sorted(present - names)
    if foreign:
        raise IrrcacheError(
            f"folder {folder} holds other files ({', '.join(foreign[:3])}"
            f"{', ...' if len(foreign) > 3 else ''}) and is not replaced; choose another folder"
        )
    if present and not overwrite:
        raise IrrcacheError(f"folder {folder} is not empty; choose another, or give --overwrite")


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    """Create a folder on the file system of ``path``, for atomic renames; it is always removed."""
    try:
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise IrrcacheError(f"cannot write to {path.parent}: {error.strerror}") from error
    try:
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
