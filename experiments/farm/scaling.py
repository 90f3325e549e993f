"""Time of one cache by one and two workers, and by one process without any: efficiency, and
overhead per job.

    python -m experiments.farm.scaling [--rounds 4] [--force] [--document docs/how-to/farm.md]

A ball of fog under a sun, by both solvers, with one thread of Dr.Jit per process. Seconds are those
from the first job to the last, without the start of processes. Processor time per job is that of
all processes together, also of the scheduler and of the command: the difference between runs of
many and of few jobs, so that the start is not in it. It depends less on what else the machine does
than seconds do. The efficiency is the processor time of a job in one process over that with
workers: jobs do not wait for each other. Of several rounds, in turns, the least counts. Writes
output/farm/scaling.json.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from experiments.farm.commands import SCENE, cache_arguments, finished, load, load_note
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from mitsuba_irrcache.compare.tables import Table

#: Settings of each solver, and samples of a job: 64 batches, and one batch.
KINDS = {
    "path": ({"solver": "path", "resolution": 16}, 512),
    "sweep": ({"solver": "sweep", "resolution": 32}, 256),
}
WORKERS = (1, 2)
#: Jobs of the runs that are compared.
FEW, MANY = 4, 20
#: One process with one thread: seconds and processor time for a cache.
_ALONE = """
import sys, time
import drjit as dr, mitsuba as mi
import mitsuba_irrcache
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from mitsuba_irrcache.io.scene_files import load_scene
scene = load_scene(sys.argv[1], {}, sys.argv[2])
started, used = time.perf_counter(), time.process_time()
scene.integrator().prepare(scene)
dr.sync_thread()
print(time.perf_counter() - started, time.process_time() - used)
"""


def measure(kind: str, rounds: int) -> dict:
    """Return seconds and processor time per job of a kind, by numbers of workers, "none" without
    any.
    """
    ways = {"none": _alone} | {str(n): partial(_farmed, n) for n in WORKERS}
    runs: dict = {way: {FEW: [], MANY: []} for way in ways}
    for _ in range(rounds):
        for way, run in ways.items():
            for jobs in (FEW, MANY):
                settings, samples = KINDS[kind]
                runs[way][jobs].append(run(settings | {"cache_spp": jobs * samples}))
    found = {}
    for way, by_jobs in runs.items():
        used = {jobs: min(row[1] for row in rows) for jobs, rows in by_jobs.items()}
        found[way] = {
            "seconds": min(row[0] for row in by_jobs[MANY]),
            "per_job": (used[MANY] - used[FEW]) / (MANY - FEW),
        }
    return found | {"load": load()}


def _alone(settings: dict) -> tuple[float, float]:
    specification = cache_arguments(Path("-"), **settings)[-1]
    command = [sys.executable, "-c", _ALONE, SCENE, specification]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    seconds, used = map(float, done.stdout.split())
    return seconds, used


def _farmed(workers: int, settings: dict) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as folder:
        arguments = cache_arguments(Path(folder) / "light.cache", **settings)
        done = finished("farm", "cache", *arguments, "--workers", workers, "--threads", 1)
    seconds = re.search(r"^\d+ jobs in ([\d.]+) s", done.text, re.MULTILINE)[1]
    return float(seconds), done.processor


def table(rows: dict[str, dict]) -> Table:
    """Return the table of the documentation."""
    head = ["solver", "workers", f"{MANY} jobs", "processor time per job", "overhead", "efficiency"]
    cells = []
    for kind, row in rows.items():
        alone = row["none"]
        for workers, found in ((key, row[key]) for key in ("none", *map(str, WORKERS))):
            own, used = alone["per_job"], found["per_job"]
            cells.append(
                [
                    f"`{kind}`" if found is alone else "",
                    workers,
                    f"{found['seconds']:.1f} s",
                    f"{used:.3f} s",
                    "" if found is alone else f"{1000 * (used - own):.0f} ms",
                    "" if found is alone else f"{own / used:.0%}",
                ]
            )
    return Table("Scaling", head, cells, load_note(max(row["load"] for row in rows.values())))


def main() -> None:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=int, default=4)
    add_document(parser)
    args = parser.parse_args()
    begin()
    folder = args.output / "farm"
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / "scaling.json", args.force)
    rows = {kind: store.row(kind, partial(measure, kind, args.rounds)) for kind in KINDS}
    print(table(rows).as_text())
    if args.document:
        replace_tables(args.document, {"farm-scaling": table(rows)})


if __name__ == "__main__":
    main()
