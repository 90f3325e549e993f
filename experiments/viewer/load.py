"""Who uses the processor: seconds by process, from Linux's /proc."""

from __future__ import annotations

import os
import re
from pathlib import Path

_TICK = 1 / os.sysconf("SC_CLK_TCK")


def processor_seconds() -> dict[str, float]:
    """Seconds of processor time so far of this program's children, theirs too: of the "viewer", of
    Chromium's processes by their type, and of "others", all else on this machine.
    """
    found: dict[str, float] = {}
    for pid in _descendants():
        try:
            line = (Path("/proc") / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ")
            seconds = _seconds(pid)
        except (FileNotFoundError, ProcessLookupError):  # it has just ended
            continue
        name = _name(line.decode(errors="replace").split())
        found[name] = found.get(name, 0.0) + seconds
    columns = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    idle = int(columns[3]) + int(columns[4])
    busy = sum(int(c) for c in columns[:8]) - idle
    found["others"] = _TICK * busy - sum(found.values())
    return found


def memory(pid: int) -> float:
    """Resident memory of a process in MB."""
    text = (Path("/proc") / str(pid) / "status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", text).group(1)) / 1024


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
    return "browser" if "chrom" in words[0] else "driver"
