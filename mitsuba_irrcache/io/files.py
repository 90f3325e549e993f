"""Atomic writing of files."""

from __future__ import annotations

import hashlib
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from mitsuba_irrcache.errors import IrrcacheError

#: Age [s] at which an unmodified temporary file is considered left over from a killed process.
ABANDONED = 3600.0
_MASKING = threading.Lock()


@contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block ends; delete it if the block raises.

    The data is written to a temporary file in the same folder, flushed to disk, then renamed.
    Temporary files left over from killed processes are removed. Raises IrrcacheError if ``path`` is
    not writable.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise IrrcacheError(f'cannot write "{path}": the folder "{path.parent}" does not exist.')
    prefix, suffix = f".{path.name}.", ".tmp"
    _remove_abandoned(path.parent, prefix, suffix)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=prefix, suffix=suffix)
    except OSError as error:
        raise IrrcacheError(f'cannot write "{path}": {error.strerror}.') from error
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        if isinstance(error, OSError):
            reason = error.strerror or str(error)
            raise IrrcacheError(f'cannot write "{path}": {reason}.') from error
        raise


def file_digest(path: str | os.PathLike) -> bytes:
    """Return the SHA-256 of the content of a file."""
    sha = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            sha.update(block)
    return sha.digest()


def check_folder_of(file: Path, name: str) -> None:
    """Raise IrrcacheError if the folder of a file cannot be written to; ``name`` is that of the
    property which names the file.
    """
    if not os.path.isdir(file.parent):  # returns False where Path.is_dir may raise
        raise IrrcacheError(
            f'irrcache: {name} "{file}": the folder "{file.parent}" does not exist.'
        )
    if not os.access(file.parent, os.W_OK | os.X_OK):
        raise IrrcacheError(
            f'irrcache: {name} "{file}": nothing can be written to the folder "{file.parent}"; '
            "name another one."
        )


def _remove_abandoned(folder: Path, prefix: str, suffix: str) -> None:
    """Remove temporary files with this name that are no longer being written."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if entry.name.startswith(prefix) and entry.name.endswith(suffix):
                with suppress(OSError):
                    if time.time() - entry.stat().st_mtime > ABANDONED:
                        os.unlink(entry.path)


def _umask() -> int:
    """Return the umask of the process.

    Reading the umask requires setting it, for all threads; without the lock, two threads could
    leave it at 0.
    """
    with _MASKING:
        mask = os.umask(0o077)  # a file created meanwhile by another thread stays private
        os.umask(mask)
    return mask
