"""Available memory of this machine, and returning freed memory to the system."""

from __future__ import annotations

import ctypes
import os
import platform
from contextlib import suppress
from pathlib import Path

import drjit as dr

from mitsuba_irrcache.errors import IrrcacheError

#: Arrays of at least this many bytes are returned to the system when freed: glibc's initial
#: threshold.
MMAP_THRESHOLD = 1 << 17
#: Number of voxels above which Dr.Jit's free arrays are returned to the system after every pass.
FLUSH_ABOVE = 1 << 22
#: M_MMAP_THRESHOLD of glibc's malloc.h.
_M_MMAP_THRESHOLD = -3


def available_memory() -> int:
    """Bytes that can be allocated without swapping; 2^63 if the system does not report it."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with suppress(AttributeError, ValueError, OSError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 2**63


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
