"""Locks for objects whose Dr.Jit arrays are computed and read by several threads."""

from __future__ import annotations

from contextlib import ExitStack
from threading import RLock
from typing import Any

import drjit as dr
import mitsuba as mi


class ComputationLock:
    """A reentrant lock for computations with Dr.Jit arrays that threads share.

    Dr.Jit refuses to compile an array that depends on one of a later scope. The thread that
    acquires the lock therefore begins a new scope, which is later than those of all arrays that
    other threads have computed while they had the lock.

    Meanwhile, kernels do not store registers in shared memory: ptxas 13 aborts the process if one
    does so that has calls which cannot be inlined, for example those of emitters in the backward
    passes of gradients. This was as fast on an H200.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        self._flags: list[ExitStack] = []  # one per acquisition

    def __enter__(self) -> None:
        """Acquire the lock."""
        self._lock.acquire()
        flags = ExitStack()
        flags.enter_context(dr.scoped_set_flag(dr.JitFlag.SpillToSharedMemory, False))
        self._flags.append(flags)
        if dr.is_jit_v(mi.Float):
            dr.detail.new_scope(dr.backend_v(mi.Float))

    def __exit__(self, *error: Any) -> None:
        """Release the lock."""
        self._flags.pop().close()
        self._lock.release()
