"""Starts `irrcache` as users do, and times it."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from mitsuba_irrcache.scenes import scene_path

from experiments.support.options import add_document, begin
from experiments.support.store import Store
from mitsuba_irrcache.machine import doctor

#: The scene of caches here: a ball of fog under a sun.
SCENE = str(scene_path("cloud"))


def begun(parser: argparse.ArgumentParser, name: str) -> tuple[argparse.Namespace, Store]:
    """Parse the command line of an experiment; return its options and its rows of this ``name``."""
    add_document(parser)
    args = parser.parse_args()
    begin()
    folder = args.output / "farm"
    folder.mkdir(parents=True, exist_ok=True)
    return args, Store(folder / f"{name}.json", args.force)


@dataclass
class Finished:
    """What a command printed, and its seconds."""

    text: str
    seconds: float


def command(*arguments: object) -> list[str]:
    """Return the command line of ``irrcache`` with these arguments."""
    return [sys.executable, "-m", "mitsuba_irrcache", *map(str, arguments)]


def finished(*arguments: object) -> Finished:
    """Run ``irrcache`` to its end; raise RuntimeError with what it printed if it fails."""
    started = time.perf_counter()
    done = subprocess.run(
        command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stdout)
    return Finished(done.stdout, time.perf_counter() - started)


def cache_arguments(file: Path, **settings: object) -> list[str]:
    """Return the arguments after ``farm cache`` for a cache of `SCENE` with these settings."""
    text = ",".join(f"{key}={value}" for key, value in settings.items())
    return [SCENE, "-o", str(file), "-i", f"irrcache{{{text}}}"]


def cache_of_one_process(file: Path, **settings: object) -> Finished:
    """Fill a cache of `SCENE` by ``irrcache render``."""
    scene, _, _, option, text = cache_arguments(file, **settings)
    text = text.replace("}", f",cache_file={file}}}")
    size = ("-D", "size=4", "--spp", "1", "-o", file.with_suffix(".exr"))
    return finished("render", scene, option, text, *size)


def load() -> float:
    """Return the mean number of processes that wanted a core, over the last minutes."""
    return os.getloadavg()[1]


def load_note(value: float) -> str:
    """Return the note of a table whose seconds depend on the ``value`` of `load`."""
    cores = doctor.examine_system()["cores"]
    return (
        f"On average {value:.0f} processes, those of other users included, wanted the {cores} "
        "cores meanwhile."
    )
