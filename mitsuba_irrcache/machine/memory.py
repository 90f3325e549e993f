"""Memory of this machine."""

from __future__ import annotations

import ctypes
import os
import platform
from contextlib import suppress
from pathlib import Path

import drjit as dr

from mitsuba_irrcache.errors import IrrcacheError

#: Bytes of the smallest array that is freed at once; where glibc begins.
LARGE = 1 << 17
#: Voxels of a cache from which on arrays are the system's again after every step of work.
MANY = 1 << 22
#: glibc's name of that, from its malloc.h.
_M_MMAP_THRESHOLD = -3


def available_memory() -> int:
    """Bytes that a new array can take without swapping; 2^63 where the system does not say."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with suppress(AttributeError, ValueError, OSError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 2**63


def require_memory(needed: int, what: str, remedy: str) -> None:
    """Raises IrrcacheError where ``what``, which takes so many bytes, finds less; it names both and
    the ``remedy``.
    """
    available = available_memory()
    if needed > available:
        raise IrrcacheError(
            f"{what} needs {min(needed, 1 << 200) / 2**30:.1f} GiB, and {available / 2**30:.1f} "
            f"GiB are free; {remedy}."
        )


def free_at_once() -> None:
    """From now on arrays are the system's again as soon as they are freed. Only glibc needs it: it
    learns from the first large array that is freed to keep those of up to 32 MiB in arenas, up to
    eight for each core, and `malloc_trim` leaves what lies at the end of each, up to 64 MiB.
    """
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, LARGE)  # and it learns no more


def give_back(voxels: int) -> None:
    """Hands arrays that are free again back to the system, after a step of work on so many voxels.
    Dr.Jit keeps them for others of their size, which the next step may not want. Small ones stay:
    to have them anew would take longer than they are worth.
    """
    if voxels >= MANY:
        dr.flush_malloc_cache()
