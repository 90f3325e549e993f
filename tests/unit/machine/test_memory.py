"""Available memory, and freed memory that returns to the operating system."""

from __future__ import annotations

import platform
import subprocess
import sys

import psutil
import pytest

from mitsuba_irrcache.machine import memory

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


def group(folder, limit, usage, cached, names=("memory.max", "memory.current", "inactive_file")):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / names[0]).write_text(f"{limit}\n")
    (folder / names[1]).write_text(f"{usage}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{names[2]} {cached}\nother 7\n")


@pytest.fixture
def groups(tmp_path, monkeypatch):
    """Replace the control groups of this process; return their root and list of groups."""
    listed = tmp_path / "cgroup"
    monkeypatch.setattr(memory, "CONTROL_GROUPS", tmp_path / "fs")
    monkeypatch.setattr(memory, "PROCESS_GROUPS", listed)
    return tmp_path / "fs", listed


def test_memory_without_limits_is_that_of_the_machine(groups):
    root, listed = groups
    listed.write_text("0::/user/session\n")
    group(root / "user" / "session", "max", 4096, 0)
    assert memory.total_memory() == psutil.virtual_memory().total
    free = psutil.virtual_memory().available
    assert memory.available_memory() == pytest.approx(free, rel=0.2)


@pytest.mark.parametrize("text", [None, "", "MemTotal:\nMemAvailable: many kB\n"])
def test_memory_of_other_systems_is_that_of_psutil(groups, monkeypatch, tmp_path, text):
    file = tmp_path / "meminfo"
    if text is not None:
        file.write_text(text)
    monkeypatch.setattr(memory, "MACHINE_MEMORY", file)
    assert memory.total_memory() == psutil.virtual_memory().total
    free = psutil.virtual_memory().available
    assert memory.available_memory() == pytest.approx(free, rel=0.2)


def test_memory_is_limited_by_the_container(groups):
    root, listed = groups
    listed.write_text("0::/on/the/host\n")  # not the path inside of the container
    group(root, 64 << 20, 50 << 20, 20 << 20)
    assert memory.total_memory() == 64 << 20
    assert memory.available_memory() == (64 - 50 + 20) << 20
    group(root, 64 << 20, 90 << 20, 0)
    assert memory.available_memory() == 0


def test_the_tightest_of_nested_limits_holds(groups):
    root, listed = groups
    listed.write_text("0::/outer/inner\n")
    group(root / "outer", 32 << 20, 30 << 20, 0)
    group(root / "outer" / "inner", 64 << 20, 1 << 20, 0)
    assert memory.total_memory() == 32 << 20
    assert memory.available_memory() == 2 << 20


def test_limits_of_the_first_version_of_control_groups(groups):
    root, listed = groups
    listed.write_text("5:cpu,cpuacct:/a\n7:memory:/job\n")
    names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
    group(root / "memory" / "job", 48 << 20, 40 << 20, 1 << 20, names)
    assert memory.available_memory() == 9 << 20


def test_what_does_not_fit_is_refused_with_its_remedy(groups):
    root, _ = groups
    group(root, 3 << 30, 1 << 30, 0)
    memory.require_memory(2 << 30, "a volume", "crop it")
    with pytest.raises(ValueError, match=r"a volume needs 2.5 GiB, and 2.0 GiB are free; crop it"):
        memory.require_memory(5 << 29, "a volume", "crop it")
