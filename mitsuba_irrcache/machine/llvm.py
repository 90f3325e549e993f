"""Find an LLVM that Dr.Jit can use, and report a clear error if there is none.

Dr.Jit 1.5 emits ``llvm.minimum``, which LLVM cannot select on x86-64 before version 17: the process
aborts at the first such kernel (observed with 15 and 16; 19 and 22 work). Dr.Jit loads LLVM when it
is imported, so a suitable one must be named in ``DRJIT_LIBLLVM_PATH`` before that.
"""

from __future__ import annotations

import glob
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from mitsuba_irrcache.errors import IrrcacheError

LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"

_ELF = (b"\x7fELF",)
_NATIVE_MAGIC = {
    "Darwin": (b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe"),
    "Windows": (b"MZ",),
}
# libLLVM-15.so.1, libLLVM-14.0.6.so.1, libLLVM.so.19.1, libLLVM.19.1.dylib, libLLVM.so, LLVM-C.dll
_LIBRARY_NAME = re.compile(
    r"libLLVM(?:[-.](?P<start>\d+(?:\.\d+)*))?\.(?:so|dylib)(?:\.(?P<end>[\d.]+))?$|LLVM-C\.dll$"
)
_PROBE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
version = [ctypes.c_uint() for _ in range(3)]
if hasattr(library, "LLVMGetVersion"):
    library.LLVMGetVersion(*map(ctypes.byref, version))
    print(*(number.value for number in version))
elif hasattr(library, "LLVMDisposeMessage"):
    # LLVMGetVersion is new in 16, LLVMDeleteInstruction in 15
    print(15 if hasattr(library, "LLVMDeleteInstruction") else 14)
"""


class LLVMUnusableError(IrrcacheError):
    """No LLVM that Dr.Jit can use was found; the message states what was found and a remedy."""


@dataclass(frozen=True)
class LLVMLibrary:
    """A file that may be the LLVM shared library.

    Attributes:
        path: as found.
        version: the known components, for example ``(19, 1)``; empty if unknown.
        problem: why Dr.Jit cannot use it, or ``""``.
    """

    path: Path
    version: tuple[int, ...]
    problem: str

    @property
    def version_text(self) -> str:
        """The version as text, or ``"unknown"``."""
        return ".".join(map(str, self.version)) or "unknown"


def minimum_llvm() -> int:
    """Return the lowest major version of LLVM that Dr.Jit supports on this processor."""
    return 17 if platform.machine().lower() in ("x86_64", "amd64") else 15


def version_problem(version: tuple[int, ...]) -> str:
    """Return why an LLVM of this version cannot be used here, or ``""``."""
    if version[0] >= minimum_llvm():
        return ""
    return f"too old: Dr.Jit refuses it or aborts with it; {minimum_llvm()} or newer is needed"


def inspect_llvm(path: str | Path) -> LLVMLibrary:
    """Determine the version of a library and whether Dr.Jit can use it, without loading it here.

    The version is taken from the file's name and its neighbours; if they do not contain it, a
    subprocess loads the library. A name without a folder is resolved by the system's loader.
    """
    path = Path(path)
    if path.parent != Path():
        problem = _file_problem(path)
        if problem:
            return LLVMLibrary(path, (), problem)
    return _judge(path, _version_from_name(path) or _version_by_loading(path))


def find_llvm() -> list[LLVMLibrary]:
    """Find all LLVM libraries where package managers install them, best first.

    Usable libraries come first, newest first, those of unknown version last. Nothing is loaded and
    no process is started, so this takes a few milliseconds.
    """
    found: dict[Path, LLVMLibrary] = {}
    for pattern in _llvm_patterns():
        for name in glob.glob(pattern):
            path = Path(name).resolve()
            if _LIBRARY_NAME.match(path.name) and path not in found and not _file_problem(path):
                version = _version_from_name(path)
                problem = version_problem(version) if version else ""
                found[path] = LLVMLibrary(path, version, problem)
    return sorted(
        found.values(),
        key=lambda library: (not library.problem, bool(library.version), library.version),
        reverse=True,
    )


def prepare_llvm() -> None:
    """Set ``DRJIT_LIBLLVM_PATH`` to the newest usable LLVM unless the user has set it.

    Must be called before Dr.Jit is imported. Never fails: if nothing usable is found, Dr.Jit
    searches by itself, and `require_llvm` reports the outcome.
    """
    if os.environ.get(LLVM_VARIABLE):
        return
    usable = usable_llvm()
    if usable:
        os.environ[LLVM_VARIABLE] = str(usable.path)


def usable_llvm() -> LLVMLibrary | None:
    """Return the first entry of `find_llvm` without a problem, or None."""
    return next((library for library in find_llvm() if not library.problem), None)


def loaded_llvm() -> tuple[int, ...]:
    """Return the version of the LLVM that Dr.Jit has loaded; empty if it has loaded none."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        return ()
    return dr.detail.llvm_version()


def require_llvm() -> None:
    """Check that the LLVM loaded by Dr.Jit works, before a kernel makes it abort the process.

    Raises:
        LLVMUnusableError: LLVM was not loaded or is too old; the message states the remedy.
    """
    version = loaded_llvm()
    if not version or version_problem(version):
        raise LLVMUnusableError(f"{_explain_llvm(version)}\nRemedy: {llvm_remedy()}")


def llvm_remedy() -> str:
    """Describe how to obtain an LLVM that Dr.Jit can use on this system."""
    usable = usable_llvm()
    if usable:
        chosen = os.environ.get(LLVM_VARIABLE, "")
        if chosen and Path(chosen) != usable.path:
            return f"unset {LLVM_VARIABLE}, or set it to {usable.path}."
        return (
            "import mitsuba_irrcache before mitsuba and drjit, which choose an LLVM of their own "
            f"when they are imported; or set {LLVM_VARIABLE}={usable.path}."
        )
    return _install_remedy()


def _llvm_patterns() -> list[str]:
    """Return glob patterns of the LLVM library on this system."""
    conda = os.environ.get("CONDA_PREFIX")
    prefixes = [glob.escape(prefix) for prefix in (conda, sys.base_prefix) if prefix]
    if platform.system() == "Windows":
        programs = os.environ.get("PROGRAMFILES", r"C:\Program Files")
        own = [rf"{prefix}\Library\bin" for prefix in prefixes]
        folders = [rf"{programs}\LLVM\bin", *own, *_folders_in("PATH")]
        return [os.path.join(folder, "LLVM-C.dll") for folder in folders]
    if platform.system() == "Darwin":
        brew = ["/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib"]
        own = [f"{prefix}/lib" for prefix in prefixes]
        folders = [*brew, "/opt/local/libexec/llvm-*/lib", *own]
        return [f"{folder}/libLLVM*.dylib" for folder in folders]
    triplet = f"{platform.machine()}-linux-gnu"
    system = [f"/usr/lib/{triplet}", "/usr/lib/llvm-*/lib", "/usr/lib64", "/usr/lib64/llvm*/lib*"]
    local = ["/usr/lib", "/usr/lib/llvm/*/lib*", "/usr/local/lib"]
    own = [f"{prefix}/lib" for prefix in prefixes]
    folders = [*system, *local, *own, *_folders_in("LD_LIBRARY_PATH")]
    return [f"{folder}/libLLVM*.so*" for folder in folders]


def _folders_in(variable: str) -> list[str]:
    folders = os.environ.get(variable, "").split(os.pathsep)
    return [glob.escape(folder) for folder in folders if folder]


def _file_problem(path: Path) -> str:
    """Return why a file cannot be a shared library of this system, or ``""``."""
    if not path.exists():
        return "there is no such file"
    if not path.is_file():
        return "it is not a file"
    try:
        with path.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        return f"it cannot be read ({error.strerror})"
    return (
        ""
        if magic.startswith(_NATIVE_MAGIC.get(platform.system(), _ELF))
        else "it is not a shared library"
    )


def _judge(path: Path, version: tuple[int, ...]) -> LLVMLibrary:
    problem = version_problem(version) if version else "it is not libLLVM, or cannot be loaded"
    return LLVMLibrary(path, version, problem)


def _version_from_name(path: Path) -> tuple[int, ...]:
    """Return the version in the name, folder or neighbouring files of a library, or ``()``."""
    real = path.resolve()
    match = _LIBRARY_NAME.match(real.name)
    stated = match and (match["start"] or match["end"])
    if stated:
        return _numbers(stated)
    # Homebrew: Cellar/llvm/19.1.7/lib/libLLVM.dylib
    folder = re.fullmatch(r"\d+(\.\d+)+(_\d+)?", real.parent.parent.name)
    if folder:
        return _numbers(folder[0].split("_")[0])
    # an LLVM installation has the headers of its own compiler in lib/clang/<version>
    clang = [_numbers(entry.name) for entry in (real.parent.parent / "lib/clang").glob("[1-9]*")]
    return max(clang, default=())


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", text)[:3])


def _version_by_loading(path: Path) -> tuple[int, ...]:
    """Return the version reported by the library itself, loaded in a subprocess, or ``()``."""
    try:
        probe = subprocess.run(
            [sys.executable, "-I", "-c", _PROBE, str(path)],
            capture_output=True,
            text=True,
            timeout=60,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ()
    return _numbers(probe.stdout) if probe.returncode == 0 else ()


def _explain_llvm(version: tuple[int, ...]) -> str:
    """Describe what is wrong with the current LLVM."""
    chosen = os.environ.get(LLVM_VARIABLE, "")
    library = inspect_llvm(chosen) if chosen else None
    if library and library.problem:
        return f"{LLVM_VARIABLE} is {chosen!r}: {library.problem}."
    if version:
        return f"Dr.Jit has loaded LLVM {'.'.join(map(str, version))}: {version_problem(version)}."
    return "Dr.Jit could not load LLVM, which the llvm_* variants need to run on the CPU."


def _install_remedy() -> str:
    """Return how to install LLVM on this system, with and without administrator rights."""
    if platform.system() == "Darwin":
        return "`brew install llvm`; or, " + _conda_remedy("libllvm19", "libLLVM*.dylib in lib")
    if platform.system() == "Windows":
        return (
            "install LLVM with its Windows installer (LLVM-<version>-win64.exe among the releases "
            f"of github.com/llvm/llvm-project) and set {LLVM_VARIABLE} to "
            r"C:\Program Files\LLVM\bin\LLVM-C.dll; or, "
            + _conda_remedy("libllvm-c19", r"LLVM-C.dll in Library\bin")
        )
    return (
        f"{_system_remedy()} (any version from {minimum_llvm()} on will do); or, "
        + _conda_remedy("libllvm19", "libLLVM.so.19.1 in lib")
    )


def _conda_remedy(package: str, file: str) -> str:
    return (
        f"without administrator's rights, `conda create -p ./llvm -c conda-forge {package}` (or "
        f"micromamba) and set {LLVM_VARIABLE} to the full path of {file} there"
    )


def _system_remedy() -> str:
    commands = {
        "apt-get": "sudo apt-get update && sudo apt-get install libllvm19",
        "dnf": "sudo dnf install llvm-libs",
        "pacman": "sudo pacman -S llvm-libs",
        "zypper": "sudo zypper install libLLVM19",
    }
    for manager, command in commands.items():
        if shutil.which(manager):
            return f"`{command}`"
    return "install the shared library of LLVM 19 with your package manager"
