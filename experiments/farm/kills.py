"""Workers, and the command with its scheduler, killed at random while they fill a cache, or sweep a
volume larger than memory.

    python -m experiments.farm.kills [--kills 100] [--force] [--document docs/how-to/farm.md]

A worker process is killed at random times; every tenth time the command itself, scheduler included,
which is started again with --resume. The cache is compared, byte by byte, with that of one process
that nobody disturbs, the irradiance of the volume with that of an undisturbed worker. Writes
output/farm/kills.json; exits with 1 if any byte differs.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from experiments.farm.commands import (
    begun,
    cache_arguments,
    cache_of_one_process,
    command,
    finished,
)
from experiments.farm.volumes import write_scene
from experiments.support.documents import replace_tables
from experiments.support.options import parser_of
from mitsuba_irrcache.compare.tables import Table

#: A cache of 18 batches per job, each of which takes about a second.
SETTINGS = {"solver": "path", "resolution": 24, "cache_spp": 144 * 160}
#: Seconds between kills, at least and at most; and how many of them spare the command.
SHORTEST, LONGEST, SPARED = 0.3, 4.0, 9


#: Voxels along a side of the volume, and its directions.
SIDE, DIRECTIONS = 192, 256


@dataclass(frozen=True)
class Kind:
    """Files of one kind: their suffix; the arguments of ``irrcache farm cache`` for a file; and a
    function that makes one undisturbed.
    """

    suffix: str
    arguments: Callable[[Path], list]
    make: Callable[[Path], object]


def kinds_in(folder: Path) -> dict[str, Kind]:
    """Return the kinds, after writing the volume to a folder."""
    scene = write_scene(folder, SIDE)
    settings = {"depth": 2, "directions": DIRECTIONS, "memory": "1GB", "light": folder / "x.npy"}
    defined = [part for key, value in settings.items() for part in ("-D", f"{key}={value}")]

    def volume(file: Path) -> list:
        return [scene, "-o", file, *defined]

    return {
        "cache": Kind(
            "cache",
            lambda file: cache_arguments(file, **SETTINGS),
            lambda file: cache_of_one_process(file, **SETTINGS),
        ),
        "volume": Kind(
            "npy", volume, lambda file: finished("farm", "cache", *volume(file), "--workers", 1)
        ),
    }


def kill_farm(folder: Path, name: str, kills: int, seed: int = 0) -> dict:
    """Return numbers of kills, and of files that differ from the undisturbed one, over as many
    files as the kills need.
    """
    rng, kind = np.random.default_rng(seed), kinds_in(folder)[name]
    whole = folder / f"whole.{kind.suffix}"
    kind.make(whole)
    done = {"workers": 0, "commands": 0, "caches": 0, "differing": 0, "seconds": 0.0}
    started = time.perf_counter()
    while done["workers"] + done["commands"] < kills:
        file = folder / f"{done['caches']}.{kind.suffix}"
        _disturb(kind, file, kills, done, rng)
        done["caches"] += 1
        done["differing"] += file.read_bytes() != whole.read_bytes()
    return done | {"seconds": time.perf_counter() - started}


def _disturb(kind: Kind, file: Path, kills: int, done: dict, rng: np.random.Generator) -> None:
    """Make one file, and kill until there are ``kills`` in all, or it is complete."""
    process = _start(kind, file)
    while process.poll() is None:
        time.sleep(rng.uniform(SHORTEST, LONGEST))
        total = done["workers"] + done["commands"]
        if total >= kills:
            process.wait()
        elif total % (SPARED + 1) == SPARED:
            process.kill()
            process.wait()
            done["commands"] += 1
            process = _start(kind, file)
        elif workers := _workers(process.pid):
            workers[rng.integers(len(workers))].kill()
            done["workers"] += 1
        print(f"{total} kills", flush=True)
    if process.returncode:
        raise RuntimeError((file.with_suffix(".log")).read_text())


def _start(kind: Kind, file: Path) -> subprocess.Popen:
    with open(file.with_suffix(".log"), "ab") as log:
        return subprocess.Popen(
            command("farm", "cache", *kind.arguments(file), "--resume", "--workers", 2),
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


def table(rows: dict[str, dict]) -> Table:
    """Return the table of the documentation."""
    names = ("workers", "commands", "caches", "differing")
    head = ["", "workers killed", "commands killed", "files made", "files that differ"]
    lines = [[kind, *(str(row[name]) for name in names)] for kind, row in rows.items()]
    return Table("Kills", head, lines)


def main() -> int:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--kills", type=int, default=100)
    args, store = begun(parser, "kills")
    rows = {}
    for name in ("cache", "volume"):
        with tempfile.TemporaryDirectory() as scratch:
            rows[name] = store.row(
                f"{name} {args.kills}",
                lambda name=name, folder=scratch: kill_farm(Path(folder), name, args.kills),
            )
    found = table(rows)
    print(found.as_text())
    if args.document:
        replace_tables(args.document, {"farm-kills": found})
    return int(any(row["differing"] for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
