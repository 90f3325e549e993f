"""Processor time by process, from Linux's /proc."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

_TICK = 1 / os.sysconf("SC_CLK_TCK")


def processor_seconds() -> dict[str, float]:
    """Return the processor seconds of this program's descendants so far, and of all others.

    The keys are "viewer", Chromium's process types, and "others".
    """
    found: dict[str, float] = {}
    for pid in _descendants():
        try:
            name, seconds = _name(_words(pid)), _seconds(pid)
        except (FileNotFoundError, ProcessLookupError):  # the process has just ended
            continue
        found[name] = found.get(name, 0.0) + seconds
    columns = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    idle = int(columns[3]) + int(columns[4])
    busy = sum(int(c) for c in columns[:8]) - idle
    found["others"] = _TICK * busy - sum(found.values())
    return found


def viewer_memory() -> float:
    """Return the resident memory of the viewers that this program has started, MB."""
    total = 0.0
    for pid in _descendants():
        with suppress(FileNotFoundError, ProcessLookupError, AttributeError):
            if _name(_words(pid)) == "viewer":
                total += resident_memory(pid)
    return total


def resident_memory(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    text = (Path("/proc") / str(pid) / "status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", text).group(1)) / 1024


def _descendants() -> list[int]:
    """Return the processes that this one has started, and their descendants."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int(_fields(int(folder.name))[1])
        except (FileNotFoundError, ProcessLookupError):
            continue
    found, level = [], {os.getpid()}
    while level:
        level = {pid for pid, parent in parents.items() if parent in level}
        found += level
    return found


def _words(pid: int) -> list[str]:
    """Return a command line; Chromium separates words by spaces."""
    line = (Path("/proc") / str(pid) / "cmdline").read_bytes()
    return line.replace(b"\0", b" ").decode(errors="replace").split()


def _seconds(pid: int) -> float:
    fields = _fields(pid)
    return _TICK * (int(fields[11]) + int(fields[12]))


def _fields(pid: int) -> list[str]:
    """Return the fields of /proc/PID/stat after the name, which may contain any characters."""
    return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()


def _name(words: list[str]) -> str:
    if "mitsuba_irrcache" in words:
        return "viewer"
    kind = next((w.partition("=")[2] for w in words if w.startswith("--type=")), None)
    if kind is not None:
        return f"browser, {kind}"
    return "browser" if words and "chrom" in words[0] else "driver"
