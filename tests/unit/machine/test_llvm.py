"""The search for an LLVM that Dr.Jit can use; others are refused before they abort the process."""

from __future__ import annotations

import ctypes.util
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from mitsuba_irrcache.machine import install_llvm, llvm

ELF = b"\x7fELF" + bytes(60)

linux_only = pytest.mark.skipif(platform.system() != "Linux", reason="names of Linux libraries")


@pytest.fixture
def minimum_17(monkeypatch):
    monkeypatch.setattr(llvm, "minimum_llvm", lambda: 17)


@pytest.fixture
def folder_of_libraries(tmp_path, monkeypatch, minimum_17):
    """Restrict the search to LLVM libraries in this folder."""
    monkeypatch.setattr(llvm, "_llvm_patterns", lambda: [f"{tmp_path}/libLLVM*.so*"])
    monkeypatch.setenv(llvm.LLVM_VARIABLE, "")
    return tmp_path


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_bytes(ELF)


@linux_only
@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM-15.so.1", (15,)),
        ("libLLVM-17.so", (17,)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM.so.22.1.8", (22, 1, 8)),
    ],
)
def test_version_is_read_from_the_names_that_distributions_use(tmp_path, minimum_17, name, version):
    put(tmp_path, name)
    library = llvm.inspect_llvm(tmp_path / name)
    assert library.version == version
    assert bool(library.problem) == (version[0] < 17)


@linux_only
def test_version_is_read_from_a_link_and_from_neighbours(tmp_path, minimum_17):
    put(tmp_path, "libLLVM.so.19.1")
    (tmp_path / "libLLVM-unversioned.so").symlink_to("libLLVM.so.19.1")
    assert llvm.inspect_llvm(tmp_path / "libLLVM-unversioned.so").version == (19, 1)

    (tmp_path / "llvm/lib/clang/18").mkdir(parents=True)
    put(tmp_path / "llvm/lib", "libLLVM.so")
    assert llvm.inspect_llvm(tmp_path / "llvm/lib/libLLVM.so").version == (18,)

    (tmp_path / "Cellar/llvm/20.1.7_1/lib").mkdir(parents=True)
    put(tmp_path / "Cellar/llvm/20.1.7_1/lib", "libLLVM.so")
    found = llvm.inspect_llvm(tmp_path / "Cellar/llvm/20.1.7_1/lib/libLLVM.so")
    assert found.version == (20, 1, 7)


@linux_only
def test_newest_usable_library_is_chosen(folder_of_libraries):
    put(folder_of_libraries, "libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM-17.so.1")
    put(folder_of_libraries, "libLLVM.so.19.1", "libLLVMSPIRVLib.so.99")
    (folder_of_libraries / "libLLVM.so.99.1").write_text("not a library")

    found = [library.path.name for library in llvm.find_llvm()]
    assert found == ["libLLVM.so.19.1", "libLLVM-17.so.1", "libLLVM-15.so.1", "libLLVM-9.so.1"]

    llvm.prepare_llvm()
    assert os.environ[llvm.LLVM_VARIABLE] == str(folder_of_libraries / "libLLVM.so.19.1")


@linux_only
def test_no_library_is_chosen_if_none_is_usable(folder_of_libraries):
    put(folder_of_libraries, "libLLVM-14.so.1", "libLLVM-15.so.1")
    llvm.prepare_llvm()
    assert os.environ[llvm.LLVM_VARIABLE] == ""
    assert llvm.usable_llvm() is None


def test_choice_of_the_user_is_respected(monkeypatch):
    monkeypatch.setenv(llvm.LLVM_VARIABLE, "/my/own/libLLVM.so")
    llvm.prepare_llvm()
    assert os.environ[llvm.LLVM_VARIABLE] == "/my/own/libLLVM.so"


#: Runs ``prepare_llvm`` with an empty variable and without the rest of the package; prints what of
#: `COSTLY` happened in it, whether Dr.Jit was imported, and what a process started later reports.
PREPARE = """
import subprocess, sys
package = type(sys)("mitsuba_irrcache")
package.__path__ = [sys.argv[1]]
sys.modules["mitsuba_irrcache"] = package
from mitsuba_irrcache.machine import llvm
costly, events = set(sys.argv[2:]), set()
sys.addaudithook(lambda name, arguments: events.add(name))
llvm.prepare_llvm()
print(sorted(events & costly), "drjit" in sys.modules)
subprocess.run([sys.executable, "-c", ""])
print(sorted(events & costly))
"""
#: Audit events of starting a process and of loading a library.
COSTLY = ("ctypes.dlopen", "os.fork", "os.posix_spawn", "os.system", "subprocess.Popen")


def test_preparing_starts_no_process_and_loads_no_library():
    """``prepare_llvm``, which every import of the package calls, does no expensive work.

    It starts no process and loads neither an LLVM nor Dr.Jit. Python reports such operations as
    audit events, here in a process of its own, since audit hooks cannot be removed.
    """
    folder = Path(llvm.__file__).parents[1]
    result = subprocess.run(
        [sys.executable, "-c", PREPARE, folder, *COSTLY],
        env=os.environ | {llvm.LLVM_VARIABLE: ""},
        capture_output=True,
        text=True,
    )
    prepared, started = result.stdout.splitlines()
    assert prepared == "[] False", result.stderr
    assert "subprocess.Popen" in started


def test_files_that_are_no_libraries_are_refused(tmp_path):
    text = tmp_path / "libLLVM.so.19.1"
    text.write_text("LLVM")
    assert "not a shared library" in llvm.inspect_llvm(text).problem
    assert "no such file" in llvm.inspect_llvm(tmp_path / "missing.so").problem
    assert "not a file" in llvm.inspect_llvm(tmp_path).problem


@linux_only
def test_another_library_is_not_mistaken_for_llvm():
    name = ctypes.util.find_library("c")
    library = llvm.inspect_llvm(name)
    assert library.version == ()
    assert "not libLLVM" in library.problem


@pytest.mark.skipif(not llvm.find_llvm(), reason="needs an LLVM library")
def test_a_library_states_the_version_that_its_name_has():
    for library in llvm.find_llvm():
        assert llvm._version_by_loading(library.path)[:1] == library.version[:1]


def run_with_llvm(path: str, code: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, llvm.LLVM_VARIABLE: path}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120
    )


REQUIRE = """
from mitsuba_irrcache.machine import llvm
try:
    llvm.require_llvm()
except llvm.LLVMUnusableError as error:
    print(error)
    raise SystemExit(3)
"""


def bad_libraries() -> list:
    old = [library.path for library in llvm.find_llvm() if library.problem]
    if not old:
        reason = "needs a libLLVM that is too old, such as that of Debian's libllvm15"
        return [pytest.param("", marks=pytest.mark.skip(reason=reason), id="old")]
    return [pytest.param(str(path), id=path.name) for path in old]


@pytest.mark.parametrize(
    "path",
    [
        *bad_libraries(),
        pytest.param("/missing/libLLVM.so", id="missing"),
        pytest.param(__file__, id="text"),
    ],
)
def test_bad_llvm_ends_in_an_error_that_names_it_and_the_remedy(path):
    done = run_with_llvm(path, REQUIRE)
    assert done.returncode == 3, done.stderr
    assert path in done.stdout
    assert "Remedy: " in done.stdout


@pytest.mark.skipif(llvm.usable_llvm() is None, reason="needs a usable LLVM")
def test_usable_llvm_is_accepted_and_is_the_one_that_dr_jit_loads():
    library = llvm.usable_llvm()
    done = run_with_llvm(str(library.path), REQUIRE + "print(*llvm.loaded_llvm())")
    assert done.returncode == 0, done.stderr
    loaded = tuple(map(int, done.stdout.split()))
    assert loaded[: len(library.version)] == library.version


@linux_only
def test_a_library_loaded_before_ours_was_chosen_is_explained(folder_of_libraries, monkeypatch):
    put(folder_of_libraries, "libLLVM.so.19.1")
    llvm.prepare_llvm()
    monkeypatch.setattr(llvm, "loaded_llvm", lambda: (15, 0, 6))
    with pytest.raises(llvm.LLVMUnusableError, match=r"15\.0\.6(?s:.)*import mitsuba_irrcache"):
        llvm.require_llvm()


@pytest.mark.parametrize(
    ("system", "words"),
    [
        ("Linux", ["libllvm19", "conda-forge", "DRJIT_LIBLLVM_PATH"]),
        ("Darwin", ["brew install llvm", "conda-forge"]),
        ("Windows", ["installer", "LLVM-C.dll", "DRJIT_LIBLLVM_PATH"]),
    ],
)
def test_remedy_fits_the_platform(monkeypatch, system, words):
    monkeypatch.setattr(llvm, "usable_llvm", lambda: None)
    monkeypatch.setattr(platform, "system", lambda: system)
    remedy = llvm.llvm_remedy()
    assert [word for word in words if word not in remedy] == []


@pytest.mark.parametrize(
    ("packages", "chosen"),
    [
        (["libllvm14", "libllvm15", "libllvm16", "libllvm19", "libllvm22"], "libllvm19"),
        (["libllvm15", "libllvm17t64", "libllvm18"], "libllvm18"),
        (["libllvm15", "libllvm17t64"], "libllvm17t64"),
        (["libllvm14", "libllvm15"], None),
        ([], None),
    ],
)
def test_installer_takes_llvm_19_or_the_newest(minimum_17, packages, chosen):
    listing = "".join(f"{name} - Modular compiler, runtime library\n" for name in packages)
    assert install_llvm.choose_package(listing) == chosen
