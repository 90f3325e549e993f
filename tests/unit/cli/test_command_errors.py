"""Commands without optional packages, with invalid files and values: one error with a remedy."""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from importlib import import_module

import pytest

from mitsuba_irrcache.cli.main import COMMANDS, main
from mitsuba_irrcache.core.argument_types import finite, seconds, whole
from mitsuba_irrcache.machine import doctor, versions
from mitsuba_irrcache.machine.extras import missing_package

NAMES = [name for name, *_ in COMMANDS]
#: Runs commands with the packages of all extras hidden.
WITHOUT = """
import sys
from mitsuba_irrcache.machine import versions
core = {r.name for r in versions.requirements()}
for extra in versions.extras():
    for requirement in versions.requirements(extra):
        if requirement.name not in core:
            sys.modules[requirement.name.replace("-", "_")] = None
from mitsuba_irrcache.cli.main import main
for arguments in sys.argv[1:]:
    try:
        status = main(arguments.split())
    except SystemExit as end:
        status = end.code
    print("status", status, flush=True)
    print("status", status, file=sys.stderr, flush=True)
"""


def without_extras(*commands: str, cwd=None) -> list[tuple[int, str, str]]:
    """Return status, output and errors of commands, run in one process to save start-up time."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, *commands], capture_output=True, text=True, cwd=cwd
    )
    texts = [re.split(r"status (\d+)\n", text) for text in (done.stdout, done.stderr)]
    assert len(texts[0]) == 2 * len(commands) + 1, done.stderr
    return [
        (int(texts[0][2 * k + 1]), texts[0][2 * k], texts[1][2 * k]) for k in range(len(commands))
    ]


# Optional packages


def test_help_needs_no_extras():
    for status, output, error in without_extras(*(f"{name} --help" for name in NAMES)):
        assert status == 0 and output.startswith("usage: irrcache") and not error, error


def test_missing_packages_are_named_with_the_command(tmp_path):
    """Each command names the extra it needs, also if a package is imported late."""
    (tmp_path / "scene.xml").write_text("<scene version='3.0.0'/>")
    (tmp_path / "ct.nrrd").write_text("NRRD0004\n")
    (tmp_path / "slices").mkdir()
    (tmp_path / "slices" / "1.dcm").write_text("none")
    commands = {
        "import ct.nrrd --density -o out": ("SimpleITK", "volumes"),
        "import slices --density -o out": ("SimpleITK", "volumes"),
        "view scene.xml": ("viser", "view"),
        "compare scene.xml -i irrcache -o out": ("matplotlib", "compare"),
    }
    for (package, extra), (status, output, error) in zip(
        commands.values(), without_extras(*commands, cwd=tmp_path), strict=True
    ):
        assert status == 1 and not output
        assert error.startswith("irrcache: error: ") and error.count("\n") == 1
        assert f'"{package}"' in error and f'pip install "mitsuba_irrcache[{extra}]"' in error
    assert sorted(os.listdir(tmp_path)) == ["ct.nrrd", "scene.xml", "slices"]


def test_every_requirement_belongs_to_an_extra_that_is_named():
    """Every requirement is found in an extra by the module name of the import error.

    An unknown module is not attributed to an extra: that would be a bug in the code.
    """
    for extra in ("", *versions.extras()):
        for requirement in versions.requirements(extra):
            module = {"colour-science": "colour", "flip-evaluator": "flip_evaluator"}
            name = module.get(requirement.name, requirement.name)
            error = ModuleNotFoundError(name=f"{name}.inner")
            assert name in str(missing_package(error, "irrcache"))
    assert missing_package(ModuleNotFoundError(name="none_such"), "irrcache", "view") is None
    assert missing_package(ModuleNotFoundError(), "irrcache") is None


def test_a_mistake_in_the_code_stays_a_traceback(monkeypatch):
    def run(args: argparse.Namespace) -> int:
        raise ModuleNotFoundError(
            "No module named 'mitsuba_irrcache.gone'", name="mitsuba_irrcache"
        )

    monkeypatch.setattr(doctor, "run", run)
    with pytest.raises(ModuleNotFoundError):
        main(["doctor"])


# The doctor


@pytest.fixture
def working(monkeypatch):
    monkeypatch.setattr(doctor, "_probe", lambda variant, environment: "")


def test_the_doctor_lists_all_extras_for_users(working, capsys):
    assert main(["doctor", "-m", "llvm_ad_rgb"]) == 0
    printed = capsys.readouterr().out
    assert printed.rstrip().endswith("All is well.")
    assert set(doctor.DEVELOPMENT) < set(versions.extras())
    for extra in versions.extras():
        assert (f"[{extra}]" in printed) == (extra not in doctor.DEVELOPMENT)
        for requirement in versions.requirements(extra):
            assert requirement.name in printed or extra in doctor.DEVELOPMENT
    assert "viser" in printed


@pytest.mark.parametrize("variant", ["foo", "", "llvm_ad_rgbx"])
def test_the_doctor_refuses_unknown_variants(working, capsys, variant):
    assert main(["doctor", "-m", variant or " "]) == 1
    out, error = capsys.readouterr()
    assert not out and f'no variant "{variant or " "}"' in error and "llvm_ad_rgb" in error


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral"])
@pytest.mark.parametrize("json", [[], ["--json"]])
def test_doctor_fails_if_irrcache_does_not_run(working, capsys, variant, json):
    """The doctor reports a failure if irrcache does not run, whatever Mitsuba itself can do."""
    assert main(["doctor", "-m", variant, *json]) == 1
    printed = capsys.readouterr().out
    assert "All is well" not in printed and "llvm_ad_mono" in printed


def test_doctor_failure_without_a_remedy(monkeypatch):
    """After a failure without a remedy, the last line is the verdict."""
    monkeypatch.setattr(doctor, "_probe", lambda variant, environment: "broken")
    report = doctor.examine(["llvm_ad_rgb"]) | {"remedies": []}
    assert not report["ok"] and "All is well" not in doctor.as_text(report)


# Invalid files


def refused(capsys, *arguments: str) -> str:
    """Return the error of a refused command."""
    assert main(list(arguments)) == 1
    error = capsys.readouterr().err
    assert error.startswith("irrcache: error: ") and error.count("\n") == 1, error
    return error


def test_invalid_scene_files_are_refused(tmp_path, capsys, monkeypatch, rgb):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.xml").mkdir()
    (tmp_path / "empty.xml").touch()
    os.symlink("loop.xml", "loop.xml")
    os.mkfifo("pipe.xml")
    names = {
        ".": r"is a folder; name an XML file, for example \S*empty\.xml",
        "..": "is a folder",
        "/": "is a folder",
        "": "is a folder",
        "folder.xml": "is a folder",
        "empty.xml": "is empty",
        "none.xml": "there is no scene file",
        "loop.xml": "there is no scene file",
        "pipe.xml": "there is no scene file",
        "empty.xml/none.xml": "there is no scene file",
        "x" * 300 + ".xml": "name too long",
        "a\0b.xml": "null character",
    }
    before = set(os.listdir(tmp_path))
    for name, message in names.items():
        assert re.search(message, refused(capsys, "render", name)), name
        assert re.search(message, refused(capsys, "compare", name, "-i", "irrcache", "-o", "out"))
        if name.endswith(".xml"):
            assert re.search(message, refused(capsys, "view", name))
    assert set(os.listdir(tmp_path)) == before


def test_invalid_volume_and_output_files_are_refused(tmp_path, capsys, monkeypatch, rgb):
    import mitsuba as mi
    import numpy as np

    monkeypatch.chdir(tmp_path)
    mi.VolumeGrid(np.ones((4, 4, 4, 1), np.float32)).write("ok.vol")
    (tmp_path / "folder").mkdir()
    (tmp_path / "scene.xml").mkdir()
    (tmp_path / "scene.xml" / "precious").touch()
    (tmp_path / "image.exr").mkdir()
    for name in ("e.nrrd", "e.mhd", "e.nii", "e.dcm", "e.vol", "e.json", "e.xml"):
        (tmp_path / name).touch()
    (tmp_path / "e.xml").write_text("<scene version='3.0.0'/>")

    def importing(*arguments: str) -> str:
        return refused(capsys, "import", *arguments)

    for name in ("e.nrrd", "e.mhd", "e.nii", "e.dcm"):
        assert f"{name} is empty" in importing(name, "--density", "-o", "out")
    assert "e.vol is empty" in importing("e.vol", "--density", "-o", "out")
    assert "folder is empty" in importing("folder", "--density", "-o", "out")
    error = importing("folder", "--density", "--raw-shape", "4,4,4", "-o", "out")
    assert "is a folder" in error
    error = importing("ok.vol", "--transfer-function", "folder", "-o", "out")
    assert "is a folder; name a JSON file" in error
    error = importing("ok.vol", "--density", "-o", "scene.xml", "--overwrite")
    assert "scene.xml is a folder and is not replaced" in error
    assert (tmp_path / "scene.xml" / "precious").exists()
    assert "is a folder; name a file" in refused(capsys, "render", "e.xml", "-o", "image.exr")


# Values of the wrong type


def options(name: str) -> list[argparse.Action]:
    """Return the options of a command that convert their value."""
    parser = argparse.ArgumentParser()
    module = import_module(f"mitsuba_irrcache.{next(c[1] for c in COMMANDS if c[0] == name)}")
    module.add_arguments(parser)
    return [action for action in parser._actions if action.type is not None]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("text", ["x", "", "40x32x24", "nan", "1,,2", ":", "9" * 5000])
def test_errors_of_wrong_values_name_no_functions(name, text):
    """Errors of wrong values contain no function names; all are argparse errors."""
    for action in options(name):
        try:
            action.type(text)
        except argparse.ArgumentTypeError as error:
            assert "it must be" in str(error) and "_" not in str(error) and len(str(error)) < 250
        except ValueError:
            assert action.type in (int, float)  # argparse has its own messages for these


def test_types():
    assert whole(0)("12") == 12 and finite("-1.5") == -1.5 and seconds("0.1") == 0.1
    for convert, wrong in ((whole(0), "-1"), (whole(0), "2147483648"), (whole(1, 5), "6")):
        with pytest.raises(argparse.ArgumentTypeError, match=f"'{wrong}' given"):
            convert(wrong)
    for convert, wrong in ((finite, "inf"), (seconds, "0"), (seconds, "-1"), (seconds, "nan")):
        with pytest.raises(argparse.ArgumentTypeError, match="it must be"):
            convert(wrong)


CALLS = {
    "raw shape": (["import", "a", "--density", "--raw-shape", "40x32x24", "-o", "o"], "40,32,24"),
    "flip": (["import", "a.vol", "--density", "--flip", "w", "-o", "o"], "x, y, z"),
    "clip": (["import", "a.vol", "--density", "--clip=a:b", "-o", "o"], "-100:500"),
    "crop": (["import", "a.vol", "--density", "--crop", "1:2", "-o", "o"], "10:50"),
    "NaN for NaN": (["import", "a.vol", "--density", "--replace-nan", "nan", "-o", "o"], "finite"),
    "depth": (["import", "a.vol", "--density", "--max-depth", "9" * 12, "-o", "o"], "2147483647"),
    "seed": (["render", "a.xml", "--seed=-1"], "4294967295"),
    "port": (["view", "a.xml", "--port", "99999"], "65535"),
    "time": (["compare", "a.xml", "-i", "x", "-o", "o", "--reference-seconds", "inf"], "above 0"),
    "exposure": (["compare", "a.xml", "-i", "x", "-o", "o", "--exposure", "nan"], "finite"),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "wanted"), CALLS.values(), ids=CALLS)
def test_calls_with_wrong_values(capsys, arguments, wanted):
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    error = capsys.readouterr().err.splitlines()[-1]
    assert "given; it must be" in error and wanted in error and "invalid" not in error
