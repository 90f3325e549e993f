"""The process that runs one integrator: ``python -m mitsuba_irrcache.compare.worker JOB.json``.

A job is JSON; its ``kind`` names one of the functions below. Results are written to the file
``result`` step by step, so that a crash loses only the unfinished ones. Lines on standard output
report the progress.
"""

from __future__ import annotations

import json
import re
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.errors import original_message
from mitsuba_irrcache.io.images import write_image
from mitsuba_irrcache.io.scene_files import check_sensor
from mitsuba_irrcache.machine.modules import import_modules
from mitsuba_irrcache.machine.variants import select_variant

from . import runners
from .metrics import colours
from .reference import reference, reference_path
from .results import Measurement, write_json
from .runners import Subject

try:
    import resource
except ImportError:  # Windows
    resource = None

#: Samples per pixel of the first image, for which the kernels are compiled.
FIRST_SPP = 4


def check(job: dict) -> None:
    """Load the scene with every integrator once, to find wrong names and properties early."""
    described = {}
    for integrator in job["integrators"]:
        scene = _subject(job, integrator).load()
        check_sensor(job["sensor"], scene)
        film = scene.sensors()[job["sensor"]].film()
        described[integrator] = _described(scene.integrator())
    write_json(
        Path(job["result"]),
        {
            "size": [int(n) for n in film.crop_size()],
            "sensors": len(scene.sensors()),
            "described": described,
        },
    )


def _described(integrator: mi.Integrator) -> str:
    """Return the integrator's string representation on one line, or its class name."""
    try:
        return " ".join(str(integrator).split())
    except RuntimeError:  # a plugin in Python without to_string
        return type(integrator).__name__


def make_reference(job: dict) -> None:
    """Render, continue or find the reference."""
    where = (Path(job["scene"]), job["parameters"], job["integrator"])
    folder = Path(job["folder"])

    def advance(spp: int, seconds: float) -> None:
        print(f"{spp} samples per pixel in each half, {seconds:.0f} s", flush=True)

    found = reference(
        *where, folder, job["spp"], job["seconds"], sensor=job["sensor"], advance=advance
    )
    path = reference_path(*where, job["sensor"], folder)
    write_json(Path(job["result"]), {"path": str(path), "spp": found.spp, "seconds": found.seconds})


def measure(job: dict) -> None:
    """Measure a first image with an empty kernel cache, snapshots, another view, and memory."""
    result, images = Path(job["result"]), Path(job["images"])
    measurement = Measurement(job["integrator"], job["name"])
    subject, scene = _first_image(job, measurement.cold)
    measurement.first_spp = FIRST_SPP
    _note_memory(measurement)
    measurement.save(result)
    for snapshot, image in runners.run(subject, scene, job["budgets"]):
        path = images / f"{job['name']}-{snapshot.budget:g}s.exr"
        about = {"integrator": job["integrator"], "seconds": snapshot.total, "spp": snapshot.spp}
        write_image(path, colours(image), about)
        snapshot.image = f"{images.name}/{path.name}"
        measurement.snapshots.append(snapshot)
        _note_memory(measurement)
        measurement.save(result)
        print(f"{snapshot.total:.2f} s, {snapshot.spp} samples per pixel", flush=True)
    measurement.again = _another_view(subject, scene)
    measurement.save(result)


def start(job: dict) -> None:
    """Measure a first image in a process that finds its kernels compiled."""
    seconds: dict[str, float] = {}
    _first_image(job, seconds)
    write_json(Path(job["result"]), seconds)


def _first_image(job: dict, seconds: dict[str, float]) -> tuple[Subject, mi.Scene]:
    """Load the scene and render it twice; the difference of the times is the kernels' share.

    Fills ``seconds``: import, load, cache, image, filter, and of them kernels (tracing, code
    generation and compilation), whose parts are given by ``dr.kernel_history``.
    """
    seconds["import"] = job["imported"] - job["started"]
    began = time.perf_counter()
    subject = _subject(job, job["integrator"])
    scene = subject.load()
    seconds["load"] = time.perf_counter() - began
    cached = runners.has_cache(scene)
    effort = {}
    if cached and not runners.states_error(scene) and runners.effort_is_free(subject):
        effort = {runners.EFFORT: runners.LEAST_EFFORT}
        scene = subject.load(**effort)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        first = _cache_and_image(subject, scene, cached)
        history = dr.kernel_history()
    scene = subject.load(**effort) if cached else scene
    stages = _cache_and_image(subject, scene, cached)
    seconds["kernels"] = max(sum(first.values()) - sum(stages.values()), 0.0)
    seconds.update(stages)
    seconds["codegen"] = 1e-3 * sum(k.get("codegen_time", 0.0) for k in history)
    seconds["backend"] = 1e-3 * sum(k.get("backend_time", 0.0) for k in history)
    return subject, scene


def _cache_and_image(subject: Subject, scene: mi.Scene, cached: bool) -> dict[str, float]:
    seconds = {"cache": runners.prepare(scene)} if cached else {}
    return seconds | subject.render(scene, FIRST_SPP)[1]


def _another_view(subject: Subject, scene: mi.Scene) -> dict[str, float]:
    """Return the seconds by stage for another sensor, or another seed if there is only one."""
    sensor = (subject.sensor + 1) % len(scene.sensors())
    runners.render(scene, sensor, FIRST_SPP, seed=10**6)
    seconds = {"cache": runners.prepare(scene)} if runners.has_cache(scene) else {}
    return seconds | runners.render(scene, sensor, FIRST_SPP, seed=10**6 + 1)[1]


def _note_memory(measurement: Measurement) -> None:
    peak = peak_memory()
    if peak:
        measurement.memory = {"first_image": peak} | measurement.memory | {"peak": peak}


def peak_memory() -> int:
    """Return the peak memory of this process in bytes; 0 if the system does not report it.

    On Linux ``getrusage`` starts at the peak of the parent process, so /proc is read first.
    """
    with suppress(OSError):
        text = Path("/proc/self/status").read_text()
        if found := re.search(r"^VmHWM:\s*(\d+) kB", text, re.MULTILINE):
            return int(found[1]) * 1024
    if resource is None:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _subject(job: dict, integrator: str) -> Subject:
    folder = job.get("working_folder", "")
    return Subject(Path(job["scene"]), job["parameters"], integrator, job["sensor"], folder)


def _set_up(job: dict) -> None:
    """Set up the variant, the log and the modules that register other plugins."""
    select_variant(job["variant"])
    mi.set_log_level(mi.LogLevel.Error)
    import_modules(job["modules"])


KINDS = {"check": check, "reference": make_reference, "measure": measure, "start": start}


def main() -> int:
    """Run the job; an exception is written to its ``error`` file."""
    job = json.loads(Path(sys.argv[1]).read_text())
    if hasattr(signal, "pthread_sigmask"):
        # Workers of irrcache farm, which may start this process, block interrupts.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        _set_up(job)
        job["imported"] = time.time()
        KINDS[job["kind"]](job)
    except Exception as error:
        write_json(Path(job["error"]), {"error": original_message(error) or type(error).__name__})
        raise
    return 0


if __name__ == "__main__":
    sys.exit(main())
