"""Who uses the processor: seconds by process, from Linux's /proc."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

_TICK = 1 / os.sysconf("SC_CLK_TCK")


def processor_seconds() -> dict[str, float]:
    """Seconds of processor time so far of this program's children, theirs too: of the "viewer", of
    Chromium's processes by their type, and of "others", all else on this machine.
    """
    found: dict[str, float] = {}
    for pid in _descendants():
        try:
            name, seconds = _name(_words(pid)), _seconds(pid)
        except (FileNotFoundError, ProcessLookupError):  # it has just ended
            continue
        found[name] = found.get(name, 0.0) + seconds
    columns = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    idle = int(columns[3]) + int(columns[4])
    busy = sum(int(c) for c in columns[:8]) - idle
    found["others"] = _TICK * busy - sum(found.values())
    return found


def viewer_memory() -> float:
    """Resident memory of the viewers that this program has started, MB."""
    total = 0.0
    for pid in _descendants():
        with suppress(FileNotFoundError, ProcessLookupError, AttributeError):
            if _name(_words(pid)) == "viewer":
                text = (Path("/proc") / str(pid) / "status").read_text()
                total += int(re.search(r"VmRSS:\s+(\d+)", text).group(1)) / 1024
    return total


def _descendants() -> list[int]:
    """Processes that this one has started, and those that they have."""
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
    """Its command line; Chromium puts spaces between words."""
    line = (Path("/proc") / str(pid) / "cmdline").read_bytes()
    return line.replace(b"\0", b" ").decode(errors="replace").split()


def _seconds(pid: int) -> float:
    fields = _fields(pid)
    return _TICK * (int(fields[11]) + int(fields[12]))


def _fields(pid: int) -> list[str]:
    """Of /proc/PID/stat, from the state on: the name before it may hold anything."""
    return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()


def _name(words: list[str]) -> str:
    if "mitsuba_irrcache" in words:
        return "viewer"
    kind = next((w.partition("=")[2] for w in words if w.startswith("--type=")), None)
    if kind is not None:
        return f"browser, {kind}"
    return "browser" if words and "chrom" in words[0] else "driver"
