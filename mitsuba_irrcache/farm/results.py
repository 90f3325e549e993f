"""Results of jobs as files, written atomically, each with a record of its inputs."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from time import perf_counter
from typing import BinaryIO

from mitsuba_irrcache.compare.results import write_json
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.jobs import Job
from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.pipeline.builder import CHECKPOINT_SECONDS, CHECKPOINT_SHARE

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

#: Name of the file in the folder of records that a command locks while it uses the folder.
LOCK = "lock"
#: Time for which a command waits for another one that may end at once [s].
LOCK_SECONDS = 1.0


@dataclass(frozen=True)
class Outcome:
    """What a worker returns: ``files`` by name, or why there are none.

    Attributes:
        worker: its address.
        seconds: duration of the job.
        files: contents by name.
        digests: SHA-256 of what the job has written to, or read from, files that stay where they
            are, by name.
        unfit: why this worker cannot run the jobs of this run, while others may.
        error: why the job failed.
    """

    worker: str
    seconds: float = 0.0
    files: dict[str, bytes] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    unfit: str = ""
    error: str = ""


class Results:
    """Finished jobs of a folder.

    The record of a job is written after its files: a job with a record is finished. It holds the
    digest of the job's inputs, those of its files, and the `Outcome.digests`.
    """

    def __init__(self, folder: Path, records: str = ".farm", names: Sequence[str] = ()) -> None:
        """``records`` is the name of the folder in ``folder`` that holds them; ``names`` are
        patterns of all other names that runs write to ``folder``, if it is removed in the end.
        """
        self.folder, self._records, self._names = folder, folder / records, tuple(names)

    @contextmanager
    def alone(self, resume: bool) -> Iterator[None]:
        """Return a context in which no other command uses the folder; `begin` is called first.

        What is empty in the end is removed. Raises IrrcacheError if another command is in such a
        context. File systems without locks let both of them in.
        """
        is_new, deadline = not self.folder.exists(), time.monotonic() + LOCK_SECONDS
        while (lock := self._locked(resume)) is None:
            if time.monotonic() > deadline:
                raise IrrcacheError(
                    f'another command is using "{self.folder}"; when it has ended, start this one '
                    "again with --resume, or name another output."
                )
            time.sleep(0.1)
        with lock:
            try:
                yield
            finally:
                with suppress(OSError):
                    if self._is_named(lock):
                        self._lock.unlink()
                for folder in (self._records, *([self.folder] if is_new else [])):
                    with suppress(OSError):
                        folder.rmdir()

    def _locked(self, resume: bool) -> BinaryIO | None:
        """Create the folders, and return the file by which they are locked; None if another command
        uses them, or is just removing them.
        """
        self.begin(resume)
        try:
            lock = open(self._lock, "wb")
        except FileNotFoundError:
            return None
        except OSError as error:
            raise IrrcacheError(f'cannot write "{self._lock}": {error.strerror}.') from error
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not self._is_named(lock):
                    raise BlockingIOError
        except BlockingIOError:
            lock.close()
            return None
        except OSError:  # there are no locks
            pass
        return lock

    def _is_named(self, lock: BinaryIO) -> bool:
        """Return whether an open file is the one that other commands would lock."""
        try:
            return os.path.samestat(os.fstat(lock.fileno()), os.stat(self._lock))
        except FileNotFoundError:
            return False

    @property
    def _lock(self) -> Path:
        return self._records / LOCK

    def begin(self, resume: bool) -> None:
        """Create the folders; raise IrrcacheError if there are results that are not to be resumed,
        or if the folder holds anything else.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise IrrcacheError(f'"{self.folder}" is a file; name a folder.')
        if not self.folder.parent.is_dir():
            raise IrrcacheError(
                f'cannot write "{self.folder}": "{self.folder.parent}" does not exist.'
            )
        if self.has_any and not resume:
            raise IrrcacheError(
                f'"{self.folder}" holds results of an earlier run; add --resume to continue it, '
                "or name another folder."
            )
        if not self._records.is_dir() and (others := self._others()):
            raise IrrcacheError(
                f'"{self.folder}" is not empty and holds no results of irrcache farm, but '
                f'"{others[0]}"; name another folder.'
            )
        try:
            self._records.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise IrrcacheError(f'cannot write "{self.folder}": {error.strerror}.') from error

    def _others(self) -> list[str]:
        """Return the names in the folder that runs do not write, whatever their records."""
        if not self.folder.is_dir():
            return []
        found = sorted(path.name for path in self.folder.iterdir() if path != self._records)
        return [name for name in found if not self._is_own(name)]

    def _is_own(self, name: str) -> bool:
        """Return whether runs write this name, or its temporary file (see `atomic_write`)."""
        return any(fnmatch(name, own) or fnmatch(name, f".{own}.*.tmp") for own in self._names)

    def remove_all(self) -> None:
        """Remove all that runs write, and the folder unless it holds anything else.

        Records are removed last, so that another run continues where this is interrupted.
        """
        with suppress(OSError):
            for path in [path for path in self.folder.iterdir() if self._is_own(path.name)]:
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)
            for record in self._records.iterdir():
                if record.name != LOCK:
                    record.unlink(missing_ok=True)
            self._lock.unlink(missing_ok=True)  # whoever comes next makes its own
            self._records.rmdir()
            self.folder.rmdir()

    @property
    def has_folder(self) -> bool:
        """Whether the folder that `begin` has created is there."""
        return self._records.is_dir()

    @property
    def has_any(self) -> bool:
        """Whether there is any finished job."""
        return self._records.is_dir() and any(self._records.glob("*.json"))

    def has(self, job: Job) -> bool:
        """Return whether the job has finished with the same inputs, and its files are unchanged."""
        digest, files, _ = self._known(job)
        try:
            return digest == job.digest and all(
                _digest((self.folder / name).read_bytes()) == known for name, known in files.items()
            )
        except OSError:
            return False

    def digests(self, job: Job) -> dict[str, str]:
        """Return the `Outcome.digests` of a finished job."""
        return self._known(job)[2]

    def store(self, job: Job, outcome: Outcome) -> None:
        """Write the files of a job, then its record.

        Raises IrrcacheError where the folder is gone: files without records would be of no use.
        """
        if not self.has_folder:
            raise IrrcacheError(
                f'the folder "{self.folder}" was removed during the run, as by another command for '
                "the same output that has finished; see whether that is there, otherwise start "
                "this command again with --resume."
            )
        self._record(job).unlink(missing_ok=True)
        for name, content in outcome.files.items():
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.folder / name) as file:
                file.write(content)
        record = {
            "digest": job.digest,
            "files": {name: _digest(content) for name, content in outcome.files.items()},
            "digests": outcome.digests,
            "seconds": outcome.seconds,
            "worker": outcome.worker,
        }
        write_json(self._record(job), record)

    def remove(self, job: Job) -> None:
        """Remove the files of a job and its record."""
        _, files, _ = self._known(job)
        self._record(job).unlink(missing_ok=True)
        for name in files:
            (self.folder / name).unlink(missing_ok=True)

    def others(self, jobs: Iterable[Job]) -> list[str]:
        """Return the names of the files there of all jobs but these."""
        names, found = {job.name for job in jobs}, []
        for record in self._records.glob("*.json"):
            if record.stem not in names:
                found += [n for n in self._read(record)[1] if (self.folder / n).exists()]
        return sorted(found)

    def _known(self, job: Job) -> tuple[str, dict[str, str], dict[str, str]]:
        """Return the digests in the record of a job: of its inputs, "" without a readable record,
        of its files by name, and the `Outcome.digests`.
        """
        return self._read(self._record(job))

    @staticmethod
    def _read(file: Path) -> tuple[str, dict[str, str], dict[str, str]]:
        try:
            record = json.loads(file.read_text())
            return str(record["digest"]), dict(record["files"]), dict(record["digests"])
        except (OSError, ValueError, KeyError, TypeError):  # no record, or a damaged one
            return "", {}, {}

    def _record(self, job: Job) -> Path:
        return self._records / f"{job.name}.json"


class OrderedParts:
    """Results that finish in any order and are added to a whole in the order of their jobs.

    Each waits as a file; `missing` are the jobs without one. ``add`` is called with each job and
    its file; the file is removed by `forget`, once the whole is written.
    """

    def __init__(
        self, results: Results, jobs: Iterable[Job], add: Callable[[Job, Path], None]
    ) -> None:
        self._results, self._add = results, add
        self._queue = deque(jobs)
        self._present = {job.name for job in self._queue if results.has(job)}
        self._added: list[Job] = []
        self.missing = [job for job in self._queue if job.name not in self._present]

    @property
    def is_complete(self) -> bool:
        """Whether all parts were added."""
        return not self._queue

    def store(self, job: Job, outcome: Outcome) -> None:
        """Store the result of a job, and add all results that are next in order."""
        self._results.store(job, outcome)
        self._present.add(job.name)
        self.advance()

    def advance(self) -> None:
        """Add all results that are next in order.

        A result that cannot be added is removed, so that another run computes it again.
        """
        while self._queue and self._queue[0].name in self._present:
            job = self._queue[0]
            try:
                self._add(job, self._results.folder / job.arguments["file"])
            except IrrcacheError:
                self._results.remove(job)
                raise
            self._added.append(self._queue.popleft())

    def forget(self) -> None:
        """Remove the files of results that were added."""
        for job in self._added:
            self._results.remove(job)
        self._added = []


class Checkpoints:
    """Decide when a whole is written again, such that writing takes a small share of the time."""

    def __init__(self) -> None:
        self._ended, self._took = perf_counter(), 0.0

    @property
    def is_due(self) -> bool:
        """Whether the whole should be written now."""
        limit = max(CHECKPOINT_SECONDS, self._took / CHECKPOINT_SHARE)
        return perf_counter() - self._ended >= limit

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Measure the time of writing within this context."""
        started = perf_counter()
        yield
        self._ended = perf_counter()
        self._took = self._ended - started


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
