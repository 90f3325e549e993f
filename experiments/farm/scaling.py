"""Overhead of the jobs of one cache, and their time by one and two workers and by one process.

    python -m experiments.farm.scaling [--rounds 2] [--force] [--document docs/how-to/farm.md]

A ball of fog under a sun, by both solvers. Each worker has one thread of Dr.Jit, and the processes
of a run as many cores as workers: the thread that records kernels executes them, too, so that a
process with one thread of Dr.Jit uses up to two cores. Processor time per job, the median of
several: in one process without any farm; in the function that a worker runs; of Dask for a job that
does nothing, but returns as many bytes; of the command, which stores the result and adds it to the
cache. Processor time depends less than seconds do on what else the machine does. Beside it the
seconds of many jobs from the first to the last, of several rounds the least. Writes
output/farm/scaling.json.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from statistics import median

import drjit as dr
import psutil

from experiments.farm.commands import SCENE, begun, cache_arguments, finished, load, load_note
from experiments.support.documents import replace_tables
from experiments.support.options import parser_of
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.farm import work
from mitsuba_irrcache.farm.cache import CacheRun
from mitsuba_irrcache.farm.cluster import ClusterOptions, add_cluster_options, connected
from mitsuba_irrcache.farm.jobs import Environment, scene_arguments
from mitsuba_irrcache.farm.results import Outcome
from mitsuba_irrcache.io.scene_files import load_scene

JOBS = 16
#: Settings of each solver: jobs of 64 batches, and of one batch.
KINDS = {
    "path": {"solver": "path", "resolution": 16, "cache_spp": JOBS * 512},
    "sweep": {"solver": "sweep", "resolution": 32, "cache_spp": JOBS * 256},
}
WORKERS = (1, 2)
#: Jobs of Dask that do nothing.
EMPTY_JOBS = 100
#: One process with one thread: seconds and processor time for a cache.
_ALONE = """
import sys, time
import drjit as dr, mitsuba as mi
import mitsuba_irrcache
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
mi.set_log_level(mi.LogLevel.Error)  # the output is read
from mitsuba_irrcache.io.scene_files import load_scene
scene = load_scene(sys.argv[1], {}, sys.argv[2])
started, used = time.perf_counter(), time.process_time()
scene.integrator().prepare(scene)
dr.sync_thread()
print(time.perf_counter() - started, time.process_time() - used)
"""


def measure(kind: str, rounds: int) -> dict:
    """Return processor times per job, and seconds of all by numbers of workers."""
    settings = KINDS[kind]
    worker, store, size = _parts(settings)
    with _cores(1):
        alone = [_alone(settings) for _ in range(rounds)]
    farmed = {}
    for n in WORKERS:
        with _cores(n):
            farmed[str(n)] = min(_farmed(n, settings) for _ in range(rounds))
    return {
        "alone": min(used for _, used in alone) / JOBS,
        "worker": worker,
        "store": store,
        "dask": _dask(size),
        "seconds": {"none": min(seconds for seconds, _ in alone)} | farmed,
        "load": load(),
    }


@contextmanager
def _cores(count: int) -> Iterator[None]:
    """Start processes on so many cores within this context."""
    own = psutil.Process()
    everything = own.cpu_affinity()
    own.cpu_affinity(everything[:count])
    try:
        yield
    finally:
        own.cpu_affinity(everything)


def _parts(settings: dict) -> tuple[float, float, int]:
    """Return the processor time of a job on a worker and of the command, and bytes of a result."""
    dr.set_thread_count(1)
    specification = cache_arguments(Path("-"), **settings)[-1]
    environment, used, stored, size = Environment.here("llvm_ad_rgb", [], 1), [], [], 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        arguments = scene_arguments(SCENE, {}, specification)
        scene = load_scene(SCENE, {}, specification)
        run = CacheRun(arguments, scene, environment, folder / "light.cache", False)
        for job in run.begin():
            made = folder / job.name
            made.mkdir()
            times = [time.process_time()]
            work.set_up(environment)
            work.KINDS[job.kind](job.arguments, made)
            files = {path.name: path.read_bytes() for path in made.iterdir()}
            times.append(time.process_time())
            run.store(job, Outcome("here", 1.0, files))
            times.append(time.process_time())
            used.append(times[1] - times[0])
            stored.append(times[2] - times[1])
            size = sum(map(len, files.values()))
    return median(used), median(stored), size


def _dask(size: int) -> dict[str, float]:
    """Return the processor time of Dask per job that returns so many bytes: of the command with its
    scheduler, and of a worker.
    """
    parser = argparse.ArgumentParser()
    add_cluster_options(parser)
    options = ClusterOptions.of(parser.parse_args(["--workers", "1"]))
    with connected(options) as connection:
        client = connection.client
        client.wait_for_workers(1)
        worker = psutil.Process(next(iter(client.run(os.getpid).values())))
        client.submit(bytes, size, pure=False).result()
        began, before = time.process_time(), worker.cpu_times()
        for _ in range(EMPTY_JOBS):
            client.submit(bytes, size, pure=False).result()
        after = worker.cpu_times()
        here = time.process_time() - began
    there = after.user + after.system - before.user - before.system
    return {"command": here / EMPTY_JOBS, "worker": there / EMPTY_JOBS}


def _alone(settings: dict) -> tuple[float, float]:
    specification = cache_arguments(Path("-"), **settings)[-1]
    command = [sys.executable, "-c", _ALONE, SCENE, specification]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    seconds, used = map(float, done.stdout.split())
    return seconds, used


def _farmed(workers: int, settings: dict) -> float:
    with tempfile.TemporaryDirectory() as folder:
        arguments = cache_arguments(Path(folder) / "light.cache", **settings)
        done = finished("farm", "cache", *arguments, "--workers", workers, "--threads", 1)
    return float(re.search(r"^\d+ jobs in ([\d.]+) s", done.text, re.MULTILINE)[1])


def table(rows: dict[str, dict]) -> Table:
    """Return the table of the documentation."""
    head = [
        "solver",
        "job in one process",
        "job on a worker",
        "Dask: worker, command",
        "storing, adding",
        "efficiency",
        "workers for one command",
        f"{JOBS} jobs: one process, 1 worker (1 core), 2 workers (2 cores)",
    ]
    cells = []
    for kind, row in rows.items():
        dask, command = row["dask"], row["store"] + row["dask"]["command"]
        seconds = ", ".join(f"{row['seconds'][key]:.0f}" for key in ("none", *map(str, WORKERS)))
        cells.append(
            [
                f"`{kind}`",
                f"{1000 * row['alone']:.0f} ms",
                f"{1000 * row['worker']:.0f} ms",
                f"{1000 * dask['worker']:.1f}, {1000 * dask['command']:.1f} ms",
                f"{1000 * row['store']:.1f} ms",
                f"{row['worker'] / (row['worker'] + dask['worker']):.0%}",
                f"{row['worker'] / command:.0f}",
                f"{seconds} s",
            ]
        )
    return Table("Scaling", head, cells, load_note(max(row["load"] for row in rows.values())))


def main() -> None:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=int, default=2)
    args, store = begun(parser, "scaling")
    rows = {kind: store.row(kind, partial(measure, kind, args.rounds)) for kind in KINDS}
    print(table(rows).as_text())
    if args.document:
        replace_tables(args.document, {"farm-scaling": table(rows)})


if __name__ == "__main__":
    main()
