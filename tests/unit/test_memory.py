"""Memory that is free again is the system's, in processes that run for long."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

#: Arrays of 8 MiB, of which every other one is freed; one of 24 MiB before makes glibc learn.
PROGRAM = """
import re
from pathlib import Path
import numpy as np
from mitsuba_irrcache.memory import give_back

def resident():
    return int(re.search(r"VmRSS:\\s+(\\d+)", Path("/proc/self/status").read_text()).group(1))

np.ones(3 << 20)
arrays = [np.ones(1 << 20) for _ in range(20)]
full = resident()
del arrays[::2]
give_back()
print((full - resident()) / 1024)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc needs it")
def test_freed_arrays_are_the_systems_though_others_lie_between():
    """As many MiB as were freed; by itself glibc keeps them."""
    program = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    assert float(done.stdout) == pytest.approx(80, abs=4)
