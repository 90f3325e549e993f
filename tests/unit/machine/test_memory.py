"""Freed memory is returned to the operating system in long-running processes."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

#: Six threads allocate 40 MiB each in arenas of their own; then every other of 20 arrays is freed.
#: An array of 24 MiB before makes glibc raise its mmap threshold.
PROGRAM = """
import re, threading
from pathlib import Path
import numpy as np
from mitsuba_irrcache.machine.memory import free_at_once

def resident():
    found = re.search(r"VmRSS:\\s+(\\d+)", Path("/proc/self/status").read_text())
    return int(found.group(1)) / 1024

free_at_once()
np.ones(3 << 20)
all_there = threading.Barrier(6)

def work():
    arrays = [np.ones(1 << 20) for _ in range(5)]
    all_there.wait()

before = resident()
threads = [threading.Thread(target=work) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(resident() - before)
arrays = [np.ones(1 << 20) for _ in range(20)]
full = resident()
del arrays[::2]
print(full - resident())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc needs it")
def test_freed_arrays_are_returned_to_the_system():
    """Arrays of ended threads, and arrays between others, are returned at once; in MiB."""
    program = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    kept, returned = map(float, done.stdout.split())
    assert kept == pytest.approx(0, abs=4)
    assert returned == pytest.approx(80, abs=4)
