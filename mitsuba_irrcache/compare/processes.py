"""Worker processes, one per job, so that a crash ends one job only."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mitsuba_irrcache.errors import IrrcacheError

#: Environment variable with the folder of Dr.Jit's compiled kernels.
KERNEL_CACHE = "DRJIT_CACHE_DIR"


class WorkerError(IrrcacheError):
    """A worker process that failed; the message says why."""


def run_job(
    kind: str,
    job: dict,
    result: Path,
    log: Path,
    kernels: Path | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> dict:
    """Run one job in a process of its own and return the JSON that it wrote to ``result``.

    Args:
        kind: one of `worker.KINDS`.
        job: the arguments of the job, JSON-serialisable.
        result: file that the worker writes.
        log: file for the worker's standard error; removed if it is empty.
        kernels: folder for compiled kernels; None for the user's own.
        report: called with each line of progress.

    Raises:
        WorkerError: the worker failed or was killed; its finished results are in ``result``.
    """
    environment = dict(os.environ)
    if kernels is not None:
        environment[KERNEL_CACHE] = str(kernels)
    with tempfile.TemporaryDirectory(prefix="irrcache-compare-") as folder:
        error, path = Path(folder) / "error.json", Path(folder) / "job.json"
        started = {"kind": kind, "result": str(result), "error": str(error), "started": time.time()}
        path.write_text(json.dumps(job | started))
        status = _run(path, log, environment, report)
        said = json.loads(error.read_text())["error"] if error.exists() else ""
    text = log.read_text(errors="replace").strip()
    if not text:
        log.unlink()
    if status:
        raise WorkerError(said or _failure(status, text))
    return json.loads(result.read_text())


def _run(job: Path, log: Path, environment: dict, report: Callable[[str], None]) -> int:
    command = [sys.executable, "-m", "mitsuba_irrcache.compare.worker", str(job)]
    with (
        open(log, "wb") as errors,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment
        ) as process,
    ):
        try:
            for line in process.stdout:
                report(line.rstrip())
        except BaseException:
            process.kill()
            raise
    return process.returncode


def _failure(status: int, log: str) -> str:
    """Return why a process failed: its exit status, and the last line of its log."""
    lines = log.splitlines()
    last = f": {lines[-1]}" if lines else ""
    if status < 0:
        return f"the process was ended by {signal.Signals(-status).name}{last}"
    return f"the process ended with status {status}{last}"
