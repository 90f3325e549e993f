"""Workers, and the command with its scheduler, killed at random while they fill a cache.

    python -m experiments.farm.kills [--kills 100] [--force] [--document docs/how-to/farm.md]

A worker process is killed at random times; every tenth time the command itself, scheduler included,
which is started again with --resume. The cache is compared, byte by byte, with that of one process
that nobody disturbs. Writes output/farm/kills.json; exits with 1 if any byte differs.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from experiments.farm.commands import begun, cache_arguments, cache_of_one_process, command
from experiments.support.documents import replace_tables
from experiments.support.options import parser_of
from mitsuba_irrcache.compare.tables import Table

#: A cache of 18 batches per job, each of which takes about a second.
SETTINGS = {"solver": "path", "resolution": 24, "cache_spp": 144 * 160}
#: Seconds between kills, at least and at most; and how many of them spare the command.
SHORTEST, LONGEST, SPARED = 0.3, 4.0, 9


def kill_farm(folder: Path, kills: int, seed: int = 0) -> dict:
    """Return numbers of kills, and of caches that differ from the undisturbed one, over as many
    caches as the kills need.
    """
    rng = np.random.default_rng(seed)
    whole = folder / "whole.cache"
    cache_of_one_process(whole, **SETTINGS)
    done = {"workers": 0, "commands": 0, "caches": 0, "differing": 0, "seconds": 0.0}
    started = time.perf_counter()
    while done["workers"] + done["commands"] < kills:
        file = folder / f"{done['caches']}.cache"
        _disturb(file, kills, done, rng)
        done["caches"] += 1
        done["differing"] += file.read_bytes() != whole.read_bytes()
    return done | {"seconds": time.perf_counter() - started}


def _disturb(file: Path, kills: int, done: dict, rng: np.random.Generator) -> None:
    """Fill one cache, and kill until there are ``kills`` in all, or it is complete."""
    process = _start(file)
    while process.poll() is None:
        time.sleep(rng.uniform(SHORTEST, LONGEST))
        total = done["workers"] + done["commands"]
        if total >= kills:
            process.wait()
        elif total % (SPARED + 1) == SPARED:
            process.kill()
            process.wait()
            done["commands"] += 1
            process = _start(file)
        elif workers := _workers(process.pid):
            workers[rng.integers(len(workers))].kill()
            done["workers"] += 1
        print(f"{total} kills", flush=True)
    if process.returncode:
        raise RuntimeError((file.with_suffix(".log")).read_text())


def _start(file: Path) -> subprocess.Popen:
    arguments = cache_arguments(file, **SETTINGS)
    with open(file.with_suffix(".log"), "ab") as log:
        return subprocess.Popen(
            command("farm", "cache", *arguments, "--resume", "--workers", 2),
            stdout=log,
            stderr=subprocess.STDOUT,
        )


def _workers(pid: int) -> list[psutil.Process]:
    """Return the worker processes of a command."""
    try:
        children = psutil.Process(pid).children(recursive=True)
        return [c for c in children if "spawn_main" in " ".join(c.cmdline())]
    except psutil.Error:  # ended meanwhile
        return []


def table(row: dict) -> Table:
    """Return the table of the documentation."""
    cells = [row["workers"], row["commands"], row["caches"], row["differing"]]
    head = ["workers killed", "commands killed", "caches filled", "caches that differ"]
    return Table("Kills", head, [[str(cell) for cell in cells]])


def main() -> int:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--kills", type=int, default=100)
    args, store = begun(parser, "kills")
    with tempfile.TemporaryDirectory() as scratch:
        row = store.row(f"{args.kills}", lambda: kill_farm(Path(scratch), args.kills))
    print(table(row).as_text())
    if args.document:
        replace_tables(args.document, {"farm-kills": table(row)})
    return int(row["differing"] > 0)


if __name__ == "__main__":
    sys.exit(main())
