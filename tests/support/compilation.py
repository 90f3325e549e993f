"""Kernels of tests: compiled quickly, and kept apart from those of users.

Most of the time of the tests is LLVM's, which compiles thousands of kernels that run for some
milliseconds each. More than a third of it follows from inlining: of the functions of shapes, BSDFs
and emitters, which Mitsuba calls through tables. Of the rest, a third goes into optimisations that
kernels which run once do not repay, and a fifth into writing messages about what is skipped, word
by word. Without these, images stay the same to the bit.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
from pathlib import Path

#: LLVM's option that prevents inlining, and the one that skips all passes that are optional.
OPTIONS = "-inline-threshold=-100000", "-opt-bisect-limit=0"
#: C++ functions of LLVM: the first one returns the stream of its messages, the others give it a
#: buffer, and write what it has and take it away.
STREAM = "_ZN4llvm4errsEv"
BUFFERED, UNBUFFERED = (f"_ZN4llvm11raw_ostream{n}Ev" for n in ("11SetBuffered", "13SetUnbuffered"))
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
        if all(hasattr(library, name) for name in (STREAM, BUFFERED, UNBUFFERED)):
            _write_in_blocks(library)


def _write_in_blocks(library: ctypes.CDLL) -> None:
    """Give LLVM's stream of messages a buffer, and discard what it has at the end."""
    stream = library[STREAM]
    stream.restype = ctypes.c_void_p
    method, messages = ctypes.CFUNCTYPE(None, ctypes.c_void_p), ctypes.c_void_p(stream())
    begin, end = (method((name, library)) for name in (BUFFERED, UNBUFFERED))
    begin(messages)

    def discard() -> None:
        sys.stderr.flush()
        error, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        end(messages)
        os.dup2(error, 2)
        os.close(error)
        os.close(nowhere)

    atexit.register(discard)


def without_skipped(text: str) -> str:
    """Return what a test printed without LLVM's lines about `SKIPPED` passes."""
    return "".join(line for line in text.splitlines(True) if not line.startswith(SKIPPED))
