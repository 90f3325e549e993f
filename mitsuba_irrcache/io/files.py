"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from mitsuba_irrcache.errors import IrrcacheError

#: Seconds after which a temporary file that nobody has written to is left over from a process that
#: was killed.
ABANDONED = 3600.0
_MASKING = threading.Lock()


@contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """A binary file that replaces ``path`` when the block ends, and vanishes if the block raises.

    It is written beside ``path`` under a temporary name, flushed to the disk, then renamed. Those
    that killed processes have left are removed. Raises IrrcacheError where it cannot be written.
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


def _remove_abandoned(folder: Path, prefix: str, suffix: str) -> None:
    """Removes temporary files of one name that nobody writes to any more."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if entry.name.startswith(prefix) and entry.name.endswith(suffix):
                with suppress(OSError):
                    if time.time() - entry.stat().st_mtime > ABANDONED:
                        os.unlink(entry.path)


def _umask() -> int:
    """The mask of the process. Reading it means setting it, for all threads: two that did this at
    once could leave it at 0.
    """
    with _MASKING:
        mask = os.umask(0o077)  # a file that another thread makes meanwhile is nobody else's
        os.umask(mask)
    return mask
