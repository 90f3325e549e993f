"""Arrays that several threads compute in turn."""

from __future__ import annotations

from threading import Thread

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.locks import ComputationLock

pytestmark = pytest.mark.usefixtures("rgb")


def in_another_thread(action) -> list:
    found = []
    thread = Thread(target=lambda: found.append(action()))
    thread.start()
    thread.join()
    return found


def test_a_thread_continues_the_computation_of_another():
    """An array that another thread has not evaluated is read in a scope after its own."""
    lock = ComputationLock()

    def begin():
        with lock:
            for _ in range(5):
                dr.detail.new_scope(dr.backend_v(mi.Float))
            return dr.arange(mi.Float, 3) * dr.opaque(mi.Float, 2, 3)

    (array,) = in_another_thread(begin)
    with lock:
        result = array + 1
    np.testing.assert_array_equal(np.array(result), [1, 3, 5])


def test_the_lock_excludes_other_threads_and_is_reentrant():
    lock, order = ComputationLock(), []

    def other():
        with lock:
            order.append("other")

    thread = Thread(target=other)
    with lock, lock:
        thread.start()
        thread.join(0.05)
        order.append("own")
    thread.join()
    assert order == ["own", "other"]


def test_registers_are_not_stored_in_shared_memory():
    """The flag is off while the lock is held, and then as before, also after an error."""
    lock, flag = ComputationLock(), dr.JitFlag.SpillToSharedMemory
    for before in (True, False):
        with dr.scoped_set_flag(flag, before):
            with pytest.raises(ValueError, match="inner"), lock, lock:
                assert not dr.flag(flag)
                raise ValueError("inner")
            assert dr.flag(flag) == before
