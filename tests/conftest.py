"""Shared fixtures: the variant of Mitsuba, and builders of small scenes."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from types import SimpleNamespace

from tests.support.compilation import (  # isort: skip (before Dr.Jit)
    shorten_compilation,
    without_skipped,
)

import drjit as dr
import mitsuba as mi
import pytest

import mitsuba_irrcache  # noqa: F401 (registers the plugin)
from tests.support.scenes import (
    ISOTROPIC_SKY,
    SUN,
    boundary,
    description,
    image,
    load,
    medium,
    placement,
    texture,
    volume,
)

shorten_compilation()
#: Dr.Jit backend of the variants under test: "llvm" or "cuda".
BACKEND = os.environ.get("IRRCACHE_TEST_BACKEND", "llvm")
# Idle threads of Dr.Jit wait actively: more of them than cores take a quarter of the time.
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
THREADS = max(1, (os.cpu_count() or 1) // WORKERS)


@pytest.fixture(scope="module", autouse=True)
def _threads(request):
    """Select the number of threads of Dr.Jit for the tests of a file.

    With a single one, Mitsuba waits for ever when it reads an EXR file.
    """
    needed = 2 if _reads_exr(request.path) else 1
    if dr.thread_count() != (count := max(needed, THREADS)):
        dr.set_thread_count(count)


def _reads_exr(test_file: Path) -> bool:
    """Whether tests may read EXR files: those that name one, and the snippets of the README."""
    return test_file.name == "test_readme.py" or ".exr" in test_file.read_text(encoding="utf-8")


@pytest.fixture(scope="module", autouse=True)
def _modules_are_not_searched():
    """Exclude what exists before a file's tests from garbage collection, which is fast then."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _everything_is_collected():
    """Undo `_modules_are_not_searched` at the end."""
    yield
    gc.unfreeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item, nextitem):
    """Tell `mono` about the next test."""
    item.next_fixtures = () if nextitem is None else nextitem.fixturenames


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Leave out of a failed test's output what LLVM prints about passes that it skips."""
    report = yield
    report.sections = [(name, without_skipped(text)) for name, text in report.sections]
    return report


@pytest.fixture
def rgb(request):
    """Select the variant ``llvm_ad_rgb`` (or ``cuda_ad_rgb``) and silence the log."""
    if "mono" not in request.fixturenames:
        _set_variant(f"{BACKEND}_ad_rgb")


@pytest.fixture
def mono(request):
    """Select the variant ``llvm_ad_mono`` for one test, and leave it to the next one if that
    selects it, too: each change takes a tenth of a second.
    """
    _set_variant(f"{BACKEND}_ad_mono")
    yield
    if "mono" not in request.node.next_fixtures:
        _set_variant(f"{BACKEND}_ad_rgb")


def _set_variant(name: str) -> None:
    """Select a variant, without the objects of earlier scenes: their methods would be compiled into
    every kernel.
    """
    gc.collect()
    if mi.variant() != name:
        mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)


@pytest.fixture
def scenes() -> SimpleNamespace:
    """Return builders of scene dictionaries; see the functions of the same names in
    `support.scenes`.
    """
    return SimpleNamespace(
        volume=volume,
        medium=medium,
        placement=placement,
        boundary=boundary,
        description=description,
        load=load,
        texture=texture,
        image=image,
        sky=ISOTROPIC_SKY,
        sun=SUN,
    )


@pytest.fixture
def refine_calls(monkeypatch) -> list[int]:
    """Record the samples per voxel of each call of the solver `path`."""
    from mitsuba_irrcache.solvers.path import solver as path_solver

    calls: list[int] = []
    refine = path_solver.PathSolver.refine

    def counted(solver, samples, *args):
        calls.append(samples)
        return refine(solver, samples, *args)

    monkeypatch.setattr(path_solver.PathSolver, "refine", counted)
    return calls


@pytest.fixture
def kernels():
    """Return a function that lists the kernels that Dr.Jit launches while ``action`` runs.

    Garbage collection is disabled meanwhile: a collection during tracing would change the slots in
    Dr.Jit's call tables, which are part of the kernels, and so the kernels' hashes.
    """

    def record(action) -> list[dict]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            gc.collect()
            gc.disable()
            try:
                dr.kernel_history_clear()
                action()
                dr.sync_thread()
                return [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
            finally:
                gc.enable()

    return record


@pytest.fixture
def out_of_bounds(capfd):
    """Return a function that lists Dr.Jit's messages about out-of-bounds accesses of ``action``.

    Debug mode adds the checks.
    """

    def during(action) -> list[str]:
        level = dr.log_level()
        capfd.readouterr()
        dr.set_log_level(dr.LogLevel.Warn)
        try:
            with dr.scoped_set_flag(dr.JitFlag.Debug):
                action()
                dr.sync_thread()
        finally:
            dr.set_log_level(level)
        lines = "".join(capfd.readouterr()).splitlines()
        return [line for line in lines if "out-of-bounds" in line]

    return during


@pytest.fixture
def logged(monkeypatch) -> list[str]:
    """Record what is logged."""
    texts: list[str] = []
    monkeypatch.setattr(mi, "Log", lambda _, text: texts.append(text))
    return texts
