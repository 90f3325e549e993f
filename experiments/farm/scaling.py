"""Time of one cache by one and two workers, and by one process without any: efficiency, and
overhead per job.

    python -m experiments.farm.scaling [--rounds 3] [--force] [--document docs/how-to/farm.md]

A ball of fog under a sun, by both solvers. All use one thread of Dr.Jit per process. The time of a
run is that of its jobs, from the first to the last, without the start of processes, which is listed
beside it; of several rounds, in turns, the shortest counts. The overhead is what workers spend
between jobs: run time times workers, less the time within jobs, per job. Writes
output/farm/scaling.json.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from experiments.farm.commands import SCENE, cache_arguments, finished
from experiments.support.documents import replace_tables
from experiments.support.options import add_document, begin, parser_of
from experiments.support.store import Store
from mitsuba_irrcache.compare.tables import Table

#: Settings of each solver: 24 jobs of 64 batches, and of one batch each.
KINDS = {
    "path": {"solver": "path", "resolution": 16, "cache_spp": 24 * 512},
    "sweep": {"solver": "sweep", "resolution": 48, "cache_spp": 24 * 256},
}
WORKERS = (1, 2)
#: One process with one thread: its seconds for the same cache, with loaded kernels.
_ALONE = """
import sys, time
import drjit as dr, mitsuba as mi
import mitsuba_irrcache
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(1)
from mitsuba_irrcache.io.scene_files import load_scene
scene = load_scene(sys.argv[1], {}, sys.argv[2])
started = time.perf_counter()
scene.integrator().prepare(scene)
dr.sync_thread()
print(time.perf_counter() - started)
"""


def measure(kind: str, rounds: int) -> dict:
    """Return the shortest times of a kind: alone, and by numbers of workers."""
    settings = KINDS[kind]
    found: dict = {"alone": [], "workers": {str(n): [] for n in WORKERS}}
    for number in range(rounds + 1):  # the first round compiles kernels
        alone = _alone(settings)
        farmed = {str(n): _farmed(settings, n) for n in WORKERS}
        if number:
            found["alone"].append(alone)
            for key, row in farmed.items():
                found["workers"][key].append(row)
    best = {n: min(rows, key=lambda row: row["seconds"]) for n, rows in found["workers"].items()}
    return {"alone": min(found["alone"]), "workers": best}


def _alone(settings: dict) -> float:
    specification = cache_arguments(Path("-"), **settings)[-1]
    command = [sys.executable, "-c", _ALONE, SCENE, specification]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _farmed(settings: dict, workers: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        arguments = cache_arguments(Path(folder) / "light.cache", **settings)
        options = ("--workers", workers, "--threads", 1)
        done = finished("farm", "cache", *arguments, *options)
    count, seconds, work = re.search(
        r"^(\d+) jobs in ([\d.]+) s, ([\d.]+) s of work", done.text, re.MULTILINE
    ).groups()
    return {
        "jobs": int(count),
        "seconds": float(seconds),
        "work": float(work),
        "total": done.seconds,
    }


def table(rows: dict[str, dict]) -> Table:
    """Return the table of the documentation."""
    head = ["solver", "workers", "jobs", "jobs, all", "speed-up", "overhead per job", "in all"]
    cells = []
    for kind, row in rows.items():
        cells.append([f"`{kind}`", "none", "", f"{row['alone']:.1f} s", "1", "", ""])
        for workers, found in row["workers"].items():
            overhead = (int(workers) * found["seconds"] - found["work"]) / found["jobs"]
            cells.append(
                [
                    "",
                    workers,
                    str(found["jobs"]),
                    f"{found['seconds']:.1f} s",
                    f"{row['alone'] / found['seconds']:.2f}",
                    f"{1000 * overhead:.0f} ms",
                    f"{found['total']:.1f} s",
                ]
            )
    return Table("Scaling", head, cells)


def main() -> None:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=int, default=3)
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
