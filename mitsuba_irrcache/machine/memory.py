"""Available memory of this machine, and returning freed memory to the system."""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import drjit as dr

from mitsuba_irrcache.errors import IrrcacheError

#: Where Linux keeps its control groups, and those of this process.
CONTROL_GROUPS, PROCESS_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
#: Where Linux states the memory of the machine.
MACHINE_MEMORY = Path("/proc/meminfo")
#: Value that represents no limit [bytes].
UNLIMITED = 2**63
#: Arrays of at least this many bytes are returned to the system when freed: glibc's initial
#: threshold.
MMAP_THRESHOLD = 1 << 17
#: Number of voxels above which Dr.Jit's free arrays are returned to the system after every pass.
FLUSH_ABOVE = 1 << 22
#: M_MMAP_THRESHOLD of glibc's malloc.h.
_M_MMAP_THRESHOLD = -3


def available_memory() -> int:
    """Return the bytes that can be allocated without swapping, within the limit of a container."""
    return max(0, min(_of_machine("MemAvailable", "available"), _left_in_container()))


def total_memory() -> int:
    """Return the bytes of memory of the machine, or of the container if it is limited."""
    limits = (_bytes(folder / limit) for folder, limit, *_ in _control_groups())
    return min(_of_machine("MemTotal", "total"), *limits, UNLIMITED)


def _of_machine(entry: str, attribute: str) -> int:
    """Return a number of bytes: an ``entry`` of `MACHINE_MEMORY`, else an ``attribute`` of psutil.

    On Linux psutil reads the same file, but takes 10 ms to import.
    """
    with suppress(OSError, ValueError, IndexError):
        for line in MACHINE_MEMORY.read_text().splitlines():
            name, _, value = line.partition(":")
            if name == entry:
                return int(value.split()[0]) << 10
    import psutil

    return getattr(psutil.virtual_memory(), attribute)


def _left_in_container() -> int:
    """Return the bytes that the control groups of this process still permit to allocate.

    `UNLIMITED` if no group has a limit.
    """
    left = UNLIMITED
    for folder, limit, usage, cache in _control_groups():
        allowed = _bytes(folder / limit)
        if allowed < UNLIMITED:
            # Cached files count as used, but are dropped when memory is needed.
            used = _bytes(folder / usage) - _statistic(folder / "memory.stat", cache)
            left = min(left, allowed - used)
    return left


def _control_groups() -> Iterator[tuple[Path, str, str, str]]:
    """Yield folders of Linux' control groups of this process, from its own up to the root.

    Each comes with the names of its limit, its usage, and its statistic of cached files. In a
    container the own group may be at the root, whatever its path on the host.
    """
    groups = {"": Path("/")}
    with suppress(OSError):
        for line in PROCESS_GROUPS.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            groups |= {controller: Path(path) for controller in controllers.split(",")}
    for controller, mount, names in (
        ("", CONTROL_GROUPS, ("memory.max", "memory.current", "inactive_file")),
        (
            "memory",
            CONTROL_GROUPS / "memory",
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ),
    ):
        own = groups.get(controller, Path("/"))
        for path in (own, *own.parents):
            folder = mount / path.relative_to("/")
            if (folder / names[0]).is_file():
                yield folder, *names


def _bytes(file: Path) -> int:
    """Return the number in a file of a control group; `UNLIMITED` if it holds no number."""
    try:
        return min(int(file.read_text()), UNLIMITED)
    except (OSError, ValueError):  # "max"
        return UNLIMITED


def _statistic(file: Path, name: str) -> int:
    with suppress(OSError, ValueError):
        for line in file.read_text().splitlines():
            if line.split()[0] == name:
                return int(line.split()[1])
    return 0


def require_memory(needed: int, what: str, remedy: str) -> None:
    """Raise IrrcacheError if fewer than ``needed`` bytes are available.

    The message names ``what`` needs them and the ``remedy``.
    """
    available = available_memory()
    if needed > available:
        raise IrrcacheError(
            f"{what} needs {min(needed, 1 << 200) / 2**30:.1f} GiB, and {available / 2**30:.1f} "
            f"GiB are free; {remedy}."
        )


def free_at_once() -> None:
    """Make glibc return arrays to the system as soon as they are freed.

    By default it raises its threshold when the first large array is freed, so that arrays of up to
    32 MiB stay in up to eight arenas per core, where `malloc_trim` leaves up to 64 MiB at the end
    of each.
    """
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).mallopt(
            _M_MMAP_THRESHOLD, MMAP_THRESHOLD
        )  # also disables the dynamic threshold


def release_unused_memory(voxels: int) -> None:
    """Return Dr.Jit's free arrays to the system after a pass over ``voxels`` voxels.

    Dr.Jit retains freed arrays for reuse at the same size, which the next pass may not need. For
    small grids allocating them again would take longer than the memory is worth.
    """
    if voxels >= FLUSH_ABOVE:
        dr.flush_malloc_cache()
