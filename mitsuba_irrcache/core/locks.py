"""Locks for objects whose Dr.Jit arrays are computed and read by several threads."""

from __future__ import annotations

from threading import RLock
from typing import Any

import drjit as dr
import mitsuba as mi


class ComputationLock:
    """A reentrant lock for objects that contain Dr.Jit arrays.

    Dr.Jit refuses to compile an array that depends on one of a later scope. The thread that
    acquires the lock therefore begins a new scope, which is later than those of all arrays that
    other threads have computed while they had the lock.
    """

    def __init__(self) -> None:
        self._lock = RLock()

    def __enter__(self) -> None:
        """Acquire the lock."""
        self._lock.acquire()
        if dr.is_jit_v(mi.Float):
            dr.detail.new_scope(dr.backend_v(mi.Float))

    def __exit__(self, *error: Any) -> None:
        """Release the lock."""
        self._lock.release()
