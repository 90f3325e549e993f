"""Kernels of tests: compiled quickly, and kept apart from those of users.

Most of the time of the tests is LLVM's, which compiles thousands of kernels that run for some
milliseconds each. More than a third of it follows from inlining: of the functions of shapes, BSDFs
and emitters, which Mitsuba calls through tables. Of the rest, a third goes into optimisations that
kernels which run once do not repay, and a fifth into writing messages about what is skipped, word
by word. Without these, images stay the same to the bit.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

#: LLVM's option that prevents inlining, and the one that skips all passes that are optional.
OPTIONS = "-inline-threshold=-100000", "-opt-bisect-limit=0"
#: C++ functions of LLVM: one returns the stream of its messages, the other one gives it a buffer.
STREAM, BUFFERED = "_ZN4llvm4errsEv", "_ZN4llvm11raw_ostream11SetBufferedEv"
#: How the lines begin that LLVM prints about each pass that it skips.
SKIPPED = "BISECT: "
#: Where the kernels are kept. Their names do not tell by which options they were compiled.
FOLDER = Path(__file__).parents[2] / ".pytest_cache" / "kernels"

FOLDER.mkdir(parents=True, exist_ok=True)
os.environ.setdefault("DRJIT_CACHE_DIR", str(FOLDER))

from mitsuba_irrcache.machine.llvm import LLVM_VARIABLE  # noqa: E402 (imports Dr.Jit)


def shorten_compilation() -> None:
    """Let the LLVM that Dr.Jit uses in this process inline no functions, optimise nothing, and
    write its messages in blocks.
    """
    path = os.environ.get(LLVM_VARIABLE)
    if path:  # otherwise Dr.Jit finds one by itself, or none
        words = [b"tests", *map(str.encode, OPTIONS)]
        library = ctypes.CDLL(path)
        library.LLVMParseCommandLineOptions(
            len(words), (ctypes.c_char_p * len(words))(*words), None
        )
        if hasattr(library, STREAM) and hasattr(library, BUFFERED):
            stream, buffered = library[STREAM], library[BUFFERED]
            stream.restype = ctypes.c_void_p
            buffered.argtypes, buffered.restype = [ctypes.c_void_p], None
            buffered(stream())


def without_skipped(text: str) -> str:
    """Return what a test printed without LLVM's lines about `SKIPPED` passes."""
    return "".join(line for line in text.splitlines(True) if not line.startswith(SKIPPED))
