"""``irrcache doctor`` reports working variants, and survives libraries that abort the process."""

from __future__ import annotations

import argparse
import json
import os

import pytest

from mitsuba_irrcache.machine import doctor, llvm

OLD = [library.path for library in llvm.find_llvm() if library.problem]
needs_llvm = pytest.mark.skipif(llvm.usable_llvm() is None, reason="needs a usable LLVM")


@pytest.fixture
def good_llvm(monkeypatch):
    """Return an LLVM for the trials, also if Dr.Jit itself has found none."""
    monkeypatch.setenv(llvm.LLVM_VARIABLE, str(llvm.usable_llvm().path))


@pytest.fixture
def no_trials(monkeypatch):
    """Replace the trials of variants, which take time, by failures."""
    failed = {"works": False, "seconds": 0.0, "problem": "refused by the test"}
    monkeypatch.setattr(doctor, "try_variant", lambda variant: failed)


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    doctor.add_arguments(parser)
    return parser.parse_args(arguments)


@needs_llvm
def test_a_working_variant_is_reported_and_succeeds(good_llvm, capsys):
    assert doctor.run(parse("--json", "-m", "llvm_ad_mono")) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"]
    assert report["remedies"] == []
    assert report["variants"]["tried"]["llvm_ad_mono"]["works"]
    assert "llvm_ad_rgb" in report["variants"]["built"]
    assert {"mitsuba", "drjit", "SimpleITK"} <= {package["name"] for package in report["packages"]}
    assert report["system"]["cores"] >= 1


@pytest.mark.parametrize("path", ["/missing/libLLVM.so", __file__], ids=["missing", "text"])
def test_an_llvm_that_cannot_be_loaded_is_a_failed_trial(monkeypatch, path):
    monkeypatch.setenv(llvm.LLVM_VARIABLE, path)
    trial = doctor.try_variant("llvm_ad_rgb")
    assert not trial["works"]
    assert trial["problem"]
    assert doctor.examine_llvm()["problem"]


@pytest.mark.skipif(not OLD, reason="needs a libLLVM that is too old")
@pytest.mark.parametrize("path", OLD, ids=lambda path: path.name)
def test_an_llvm_that_aborts_is_a_failed_trial(monkeypatch, path):
    monkeypatch.setenv(llvm.LLVM_VARIABLE, str(path))
    trial = doctor.try_variant("llvm_ad_rgb")
    assert not trial["works"]
    assert "LLVM" in trial["problem"]


@pytest.mark.skipif(not OLD, reason="needs a libLLVM that is too old")
def test_report_on_a_bad_llvm_ends_in_the_remedy(monkeypatch, capsys):
    monkeypatch.setenv(llvm.LLVM_VARIABLE, str(OLD[0]))
    assert doctor.run(parse("-m", "llvm_ad_rgb")) == 1
    text = capsys.readouterr().out
    assert "does not work" in text
    assert f"{OLD[0]}: too old" in text
    assert "\nLLVM: " in text.rstrip()[-2000:]


def test_failure_of_all_variants_gives_a_remedy_for_each_backend(no_trials, capsys):
    assert doctor.run(parse()) == 1
    text = capsys.readouterr().out
    assert "refused by the test" in text
    assert "\nLLVM: " in text
    assert "\nCUDA: " in text


def test_an_unknown_variant_fails_with_its_name():
    trial = doctor.try_variant("llvm_ad_nonsense")
    assert not trial["works"]
    assert "llvm_ad_nonsense" in trial["problem"]


def test_a_trial_that_hangs_is_ended(monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "_PROBE_TIMEOUT", 0.5)
    assert "no answer" in doctor.try_variant("llvm_ad_rgb")["problem"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="signals of POSIX")
def test_a_trial_that_crashes_names_the_signal(monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE", "import os; os.abort()")
    assert "SIGABRT" in doctor.try_variant("llvm_ad_rgb")["problem"]


def test_missing_package_is_named_with_the_command(monkeypatch, no_trials, capsys):
    installed = doctor.versions.installed_version
    monkeypatch.setattr(
        doctor.versions,
        "installed_version",
        lambda name: None if name == "tqdm" else installed(name),
    )
    assert doctor.run(parse()) == 1
    text = capsys.readouterr().out
    assert "MISSING" in text
    assert 'pip install --upgrade "tqdm' in text


def test_kernel_cache_folder_is_that_of_dr_jit(monkeypatch, tmp_path):
    (tmp_path / "0123.llvm.v6.bin").write_bytes(bytes(100))
    monkeypatch.setenv("DRJIT_CACHE_DIR", str(tmp_path))
    cache = doctor.examine_kernel_cache()
    assert cache == {"folder": str(tmp_path), "bytes": 100, "writable": True}


def test_optional_packages_may_be_absent(monkeypatch, capsys):
    works = {"works": True, "seconds": 0.0, "problem": ""}
    installed = doctor.versions.installed_version
    monkeypatch.setattr(doctor, "try_variant", lambda variant: works)
    monkeypatch.setattr(
        doctor.versions,
        "installed_version",
        lambda name: None if name == "SimpleITK" else installed(name),
    )
    assert doctor.run(parse()) == 0
    assert "not installed" in capsys.readouterr().out
