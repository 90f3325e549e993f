"""Processes killed while they fill and write a cache: earlier samples must survive."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.errors import CacheFileError

SCENE = """<scene version="3.0.0">
    <integrator type="volpath"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0,0,-5" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="4"/> <integer name="height" value="4"/>
        </film>
    </sensor>
    <shape type="cube">
        <bsdf type="null"/>
        <medium name="interior" type="homogeneous">
            <float name="sigma_t" value="0.5"/> <float name="albedo" value="0.5"/>
        </medium>
    </shape>
    <emitter type="constant"/>
</scene>
"""
#: Voxels along each side: a file of 18 MB, which takes some time to write.
RESOLUTION = 64


@dataclass
class Toll:
    """Outcomes of the kills: during a write, lost caches, and runs that did not continue.

    A cache is lost if its file is damaged, or has fewer samples than before.
    """

    kills: int = 0
    while_writing: int = 0
    lost: int = 0
    not_continued: int = 0


def kill_renders(folder: Path, rounds: int, seed: int = 0) -> Toll:
    """Start ``irrcache render`` repeatedly with one cache file, and kill it.

    Each run requests one batch more; in turns it is killed at any time, and while it writes.
    """
    rng, toll = np.random.default_rng(seed), Toll()
    (folder / "scene.xml").write_text(SCENE)
    file, samples = folder / "light.cache", 0
    started = time.perf_counter()
    _start(folder, file, BATCH).wait()
    usual, samples = time.perf_counter() - started, _samples(file)
    for number in range(rounds):
        process = _start(folder, file, samples + BATCH)
        if number % 2:
            _until_writing(process, folder)
            time.sleep(rng.uniform(0, 0.1))
        else:
            time.sleep(rng.uniform(0, usual))
        process.kill()
        process.wait()
        toll.kills += 1
        toll.while_writing += any(folder.glob(f".{file.name}.*.tmp"))
        found = _samples(file)
        toll.lost += found < samples
        samples = max(found, samples)
        for left in folder.glob(f".{file.name}.*.tmp"):
            left.unlink()  # as the next run does after an hour
    _start(folder, file, samples + BATCH).wait()
    toll.not_continued += _samples(file) != samples + BATCH
    return toll


def _start(folder: Path, file: Path, samples: int) -> subprocess.Popen:
    properties = (
        f"solver=path,resolution={RESOLUTION},cache_spp={samples},max_depth=2,cache_file={file}"
    )
    command = [sys.executable, "-m", "mitsuba_irrcache", "render", folder / "scene.xml"]
    command += ["-o", folder / "out.exr", "--spp", "1", "-i", f"irrcache{{{properties}}}"]
    return subprocess.Popen(
        [str(c) for c in command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def _until_writing(process: subprocess.Popen, folder: Path) -> None:
    while process.poll() is None and not any(folder.glob(".light.cache.*.tmp")):
        time.sleep(0.002)


def _samples(file: Path) -> int:
    """Return the samples in a valid file; -1 for a damaged one."""
    if not file.exists():
        return 0
    try:
        return IrradianceCache.load(file).samples
    except CacheFileError:
        return -1
