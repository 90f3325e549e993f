"""Kernels of tests: compiled quickly, and kept apart from those of users.

Most of the time of the tests is LLVM's, which compiles thousands of kernels that run for some
milliseconds each. Half of that is spent on scheduling instructions and on inlining. Without these,
operations on floating-point numbers stay the same, and so do images, to the bit.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

#: Options of LLVM's code generator and of its inliner. LLVM ignores those that it does not know.
OPTIONS = ("-enable-misched=false", "-pre-RA-sched=fast", "-inline-threshold=-100000")
#: Where the kernels are kept. Their names do not tell by which options they were compiled.
FOLDER = Path(__file__).parents[2] / ".pytest_cache" / "kernels"

FOLDER.mkdir(parents=True, exist_ok=True)
os.environ.setdefault("DRJIT_CACHE_DIR", str(FOLDER))

from mitsuba_irrcache.machine.llvm import LLVM_VARIABLE  # noqa: E402 (imports Dr.Jit)


def shorten_compilation() -> None:
    """Set the `OPTIONS` of the LLVM that Dr.Jit uses in this process."""
    path = os.environ.get(LLVM_VARIABLE)
    if path:  # otherwise Dr.Jit finds one by itself, or none
        words = [b"tests", *(option.encode() for option in OPTIONS)]
        arguments = (ctypes.c_char_p * len(words))(*words)
        ctypes.CDLL(path).LLVMParseCommandLineOptions(len(words), arguments, None)
