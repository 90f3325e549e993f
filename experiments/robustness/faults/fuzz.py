"""Damaged files: each is read, or refused with an IrrcacheError.

Readers run in a process of their own with limited memory and time: a crash or a hang is counted,
and the next file is tried.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import multiprocessing
import os
import resource
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError

#: Bytes of additional address space for reading a file of some kilobytes.
MEMORY = 4 << 30
#: Time limit in seconds for one file.
PATIENCE = 20.0


@dataclass
class Tally:
    """Outcomes for the files of one format; ``errors`` are those other than IrrcacheError."""

    tried: int = 0
    read: int = 0
    refused: int = 0
    crashes: int = 0
    hangs: int = 0
    peak_megabytes: int = 0
    errors: list[str] = field(default_factory=list)

    @property
    def failed(self) -> bool:
        return bool(self.crashes or self.hangs or self.errors)

    def row(self) -> dict:
        """Return the tally for JSON."""
        return asdict(self)


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a damaged file."""
    data, size = bytearray(content), len(content)
    for _ in range(rng.integers(1, 4)):
        start = int(rng.integers(0, max(len(data), 1)))
        length = int(rng.integers(1, 9))
        kind = rng.integers(0, 7)
        if kind == 0:  # some bytes
            for place in rng.integers(0, max(len(data), 1), length):
                data[place] = rng.integers(0, 256)
        elif kind == 1:
            del data[start:]
        elif kind == 2:
            data[start:start] = rng.bytes(length)
        elif kind == 3:
            data[start : start + length] = bytes(length)
        elif kind == 4:
            data[start:start] = data[start // 2 : start // 2 + int(rng.integers(1, size + 1))]
        else:  # numbers of the header
            digits = [i for i, b in enumerate(data[:2048]) if 48 <= b <= 57]
            if digits:
                place = digits[int(rng.integers(0, len(digits)))]
                said = [b"-1", b"0", b"999999999999", b"1e400", b"nan", b"2147483648", b"x", b""]
                data[place : place + 1] = said[int(rng.integers(0, len(said)))]
        if not data:
            break
    return bytes(data)


def mutated_gzip(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a compressed file that was damaged before or after compression.

    A stream that does not match its checksum would not be read any further.
    """
    if rng.random() < 0.3:
        return mutated(content, rng)
    return gzip.compress(mutated(gzip.decompress(content), rng))


def lying_cache(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a valid cache file with one inconsistent entry."""
    if rng.random() < 0.3:
        return mutated(content, rng)
    arrays = dict(np.load(io.BytesIO(content)))
    description = json.loads(arrays["description"].tobytes())
    wrong = [
        None, -1, 0, 1, 2.5, 1e300, float("nan"), 2**31, 2**63, 2**80, "", "x", [], {}, [1], True,
        [2**20, 2**20, 2**20], [1, 1], [[1.0]], {"0": -8}, {"0": 2**70}, {"x": 8}, [[0] * 4] * 4,
        [[float("inf")] * 4] * 4,
    ]  # fmt: skip
    if rng.random() < 0.6:
        key = str(rng.choice(list(description)))
        value = wrong[int(rng.integers(0, len(wrong)))]
        if rng.random() < 0.2:
            del description[key]
        else:
            description[key] = value
        arrays["description"] = np.frombuffer(json.dumps(description).encode(), np.uint8)
    else:
        name = str(rng.choice(["active", "totals", "spreads"]))
        values = np.array(arrays[name])
        kind = rng.integers(0, 5)
        if kind == 0 and values.size:
            values.flat[int(rng.integers(0, values.size))] = (
                2**32 - 1 if name == "active" else rng.choice([np.nan, -1.0, np.inf, 1e300])
            )
        elif kind == 1:
            values = values[..., : int(rng.integers(0, values.shape[-1] + 1))]
        elif kind == 2:
            values = values.astype(rng.choice(["<f2", "<i8", "|S4", "<c16"]))
        elif kind == 3:
            values = values[..., ::-1]
        else:
            values = np.zeros((0, 0), values.dtype)
        arrays[name] = values
    file = io.BytesIO()
    np.savez(file, **arrays)
    if rng.random() < 0.1:  # the same, compressed
        packed = io.BytesIO()
        with zipfile.ZipFile(file) as old, zipfile.ZipFile(packed, "w", 8) as new:
            for name in old.namelist():
                new.writestr(name, old.read(name))
        return packed.getvalue()
    return file.getvalue()


@contextlib.contextmanager
def own_folder() -> Iterator[None]:
    """Work in a new empty folder, in which relative file names end up."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


def files_here() -> set[str]:
    """Return the files in and below the working folder."""
    return {str(p) for p in Path().rglob("*") if p.is_file()}


def try_files(
    valid: Path,
    mutate: Callable[[bytes, np.random.Generator], bytes],
    read: Callable[[Path], object],
    count: int,
    folder: Path,
) -> Tally:
    """Read ``count`` mutants of the file ``valid``, written to ``folder`` under its name."""
    tally, first = Tally(), 0
    context = multiprocessing.get_context("spawn")
    while first < count:
        ours, theirs = context.Pipe()
        arguments = (valid, mutate, read, first, count, folder, theirs)
        process = context.Process(target=_worker, args=arguments)
        process.start()
        theirs.close()
        first = _listen(ours, process, tally, first, count)
    return tally


def _listen(pipe, process, tally: Tally, first: int, count: int) -> int:
    """Receive a worker's results until it ends, or until a file crashes it; return the next
    file.
    """
    index, patience = first - 1, 10 * PATIENCE  # the worker starts with imports
    try:
        while index < count - 1:
            if not pipe.poll(patience):
                tally.hangs += 1
                return index + 2
            index, outcome, error, peak = pipe.recv()
            patience = PATIENCE
            tally.tried += 1
            setattr(tally, outcome, getattr(tally, outcome) + 1) if outcome else None
            tally.peak_megabytes = max(tally.peak_megabytes, peak)
            if error:
                tally.errors.append(f"mutant {index}: {error}")
        process.join(PATIENCE)  # let it exit: killed processes leave semaphores behind
        return count
    except EOFError:
        tally.crashes += 1
        tally.errors.append(f"mutant {index + 1}: the process ended")
        return index + 2
    finally:
        process.kill()
        process.join()


def _worker(valid, mutate, read, first, count, folder, pipe) -> None:
    content = valid.read_bytes()
    target = folder / valid.name
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 2)  # libraries print messages to the terminal
    read(valid)  # import everything in advance
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for index in range(first, count):
        target.write_bytes(mutate(content, np.random.default_rng((1, index))))
        outcome, error = "read", ""
        try:
            read(target)
        except IrrcacheError:
            outcome = "refused"
        except Exception as other:  # exceptions that a reader should not raise
            outcome, error = "", f"{type(other).__name__}: {str(other)[:200]}"
        peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
        pipe.send((index, outcome, error, peak))
