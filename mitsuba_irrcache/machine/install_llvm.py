"""Install an LLVM that Dr.Jit can use if no confirmation is required; otherwise print a remedy.

``python -m mitsuba_irrcache.machine.install_llvm`` is a step of ``make setup``. It installs only if
no usable LLVM is found, apt-get exists, and the user is root or may use sudo without a password.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

from mitsuba_irrcache.machine import llvm

_PREFERRED = 19
_PACKAGE = re.compile(r"^(libllvm(\d+)(?:t64)?) ", re.MULTILINE)


def main() -> int:
    """Ensure that a usable LLVM is installed; return the exit status, 0 if there is one."""
    if not llvm.usable_llvm():
        _install()
    library = llvm.usable_llvm()
    if library is None:
        print(
            f"No LLVM was found that Dr.Jit can use.\nRemedy: {llvm.llvm_remedy()}",
            file=sys.stderr,
        )
        return 1
    print(f"LLVM {library.version_text}: {library.path}")
    return 0


def choose_package(search_output: str) -> str | None:
    """Choose the package to install from the output of ``apt-cache search '^libllvm'``.

    Returns:
        The package of LLVM 19, else the newest one that is supported, else None.
    """
    packages = {int(version): name for name, version in _PACKAGE.findall(search_output)}
    usable = [version for version in packages if version >= llvm.minimum_llvm()]
    if not usable:
        return None
    return packages[_PREFERRED if _PREFERRED in usable else max(usable)]


def _install() -> None:
    """Install the LLVM runtime library with apt-get, if possible without interaction."""
    prefix = _as_root()
    if prefix is None or not shutil.which("apt-get"):
        return
    package = choose_package(_available())
    if package is None:
        print("Refreshing the list of packages to find LLVM (apt-get update)", flush=True)
        subprocess.run([*prefix, "apt-get", "update"], check=False)
        package = choose_package(_available())
    if package:
        print(f"Installing {package} (apt-get install), about 30 MB", flush=True)
        command = ["apt-get", "install", "--yes", "--no-install-recommends", package]
        subprocess.run([*prefix, *command], check=False)


def _as_root() -> list[str] | None:
    """Return the command prefix that runs a command as root, or None if that is not possible."""
    if not hasattr(os, "geteuid"):
        return None
    if os.geteuid() == 0:
        return ["env", "DEBIAN_FRONTEND=noninteractive"]
    if not shutil.which("sudo"):
        return None
    allowed = subprocess.run(["sudo", "--non-interactive", "true"], capture_output=True)
    if allowed.returncode != 0:
        return None
    return ["sudo", "--non-interactive", "env", "DEBIAN_FRONTEND=noninteractive"]


def _available() -> str:
    search = ["apt-cache", "search", "--names-only", r"^libllvm[0-9]+(t64)?$"]
    return subprocess.run(search, capture_output=True, text=True).stdout


if __name__ == "__main__":
    sys.exit(main())
