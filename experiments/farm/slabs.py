"""Single scattering in volumes larger than memory, slab by slab, against sweeps in memory.

    python -m experiments.farm.slabs [--force] [--side 1024] [--document docs/developing/bricks.md]

Each case is a process of its own, which tells its largest resident memory. Seconds are those of the
processor, of all threads, since the machine may have other users: what waits for a disk is not part
of them, but in the column of elapsed seconds. Needs 16 bytes of free disk space for each voxel of
the largest volume. Writes output/farm/slabs.json.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from experiments.farm.commands import begun
from experiments.support.documents import replace_tables
from experiments.support.options import begin, parser_of
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.out_of_core.slab_sweep import SlabSweep
from mitsuba_irrcache.out_of_core.survey import MappedField
from mitsuba_irrcache.out_of_core.volume_files import VolumeFile
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import joint_ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Voxels along a side where both ways fit into memory; directions; memory for slabs of the volume
#: that fits, a small part of it, and of the larger one [bytes].
SIDE, DIRECTIONS, LITTLE, MOST = 384, 128, 300 << 20, 7 << 30
#: Directions of the large volume.
FEWER = 64
#: Rounds of the volume that fits, each way in turn, of which the fastest counts.
ROUNDS = 2
#: Optical depth of the volume along a side, about.
DEPTH = 4.0


def write_volume(path: Path, side: int) -> None:
    """Write a volume of smooth clouds as uint8, slice by slice."""
    volume = np.lib.format.open_memmap(path, "w+", np.uint8, (side,) * 3)
    x = np.linspace(0, 1, side, dtype=np.float32)
    waves = [np.sin(2 * np.pi * (f * x + f / 7)) for f in (1, 3, 8, 21)]
    for z in range(side):
        sums = sum(w[:, None] * w[None, :] * w[z] for w in waves) + 0.3
        volume[z] = np.clip(sums * 120, 1, 255)
    volume.flush()


def ordinates(directions: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of ordinates under a sky of radiance 1."""
    rng = np.random.default_rng(1)
    pairs = directions // 2
    found, weights = joint_ordinates(1, pairs, rng)[0]
    return found, np.ones((pairs, 2, 1)) * weights[:, None, None], rng.random((pairs, 2))


def child(case: dict) -> dict:
    """Run one case; return its seconds and memory."""
    begin()
    side, folder = case["side"], Path(case["folder"])
    grid, scale = Grid((side,) * 3, np.eye(4)), DEPTH / 128
    file, arguments = VolumeFile(folder / "volume.npy"), ordinates(case["directions"])
    started = time.perf_counter()
    if case["memory"]:
        before = time.process_time()
        sigma_t = MappedField(file, grid, scale, "volume")
        sweep = SlabSweep(sigma_t, folder, case["memory"])
        prepared = time.process_time() - before
        found = sweep.uncollided(*arguments)
        seconds = time.process_time() - before - prepared
        mean = float(found.read((side // 2, 0, 0), (side // 2 + 1, side, side)).mean())
    else:
        sigma_t = mi.Float(file.read(0, side).ravel()) * scale
        tracks = Tracks(grid, sigma_t, np.zeros(3, int), grid.resolution)
        dr.eval()
        dr.sync_thread()
        before, prepared = time.process_time(), 0.0
        values = tracks.uncollided(*arguments)
        dr.sync_thread()
        seconds = time.process_time() - before
        mean = float(np.array(values).reshape(grid.shape)[side // 2].mean())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    elapsed = time.perf_counter() - started
    result = {"prepared": prepared, "sweep": seconds, "elapsed": elapsed}
    return result | {"peak": peak, "mean": mean}


def run(side: int, directions: int, memory: int, folder: str) -> dict:
    """Run one case in a process of its own."""
    case = {"side": side, "directions": directions, "memory": memory, "folder": folder}
    command = [sys.executable, "-m", "experiments.farm.slabs", "--child", json.dumps(case)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def compared(side: int, directions: int) -> dict[str, dict]:
    """Return the fastest of several rounds in memory and by slabs."""
    rounds: dict[str, list[dict]] = {"in memory": [], "slabs": []}
    with tempfile.TemporaryDirectory(dir=".") as folder:
        write_volume(Path(folder) / "volume.npy", side)
        for _ in range(ROUNDS):
            for name, memory in (("in memory", 0), ("slabs", LITTLE)):
                rounds[name].append(run(side, directions, memory, folder))
    return {name: min(found, key=lambda row: row["sweep"]) for name, found in rounds.items()}


def large(side: int, directions: int) -> dict:
    """Return what the large volume takes."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        write_volume(Path(folder) / "volume.npy", side)
        return run(side, directions, MOST, folder)


def table(rows: list[tuple[str, int, int, dict]]) -> Table:
    """Return the table; ratios are those of seconds per voxel and direction to the first row."""

    def cost(side: int, directions: int, row: dict) -> float:
        return (row["prepared"] + row["sweep"]) / side**3 / directions * 1e9

    first = cost(*rows[0][1:])
    head = ["", "directions", "peak memory", "elapsed", "ns per voxel and direction", "ratio"]
    lines = []
    for name, side, directions, row in rows:
        here = cost(side, directions, row)
        lines.append(
            [
                f"{side}³, {name}",
                f"{directions}",
                f"{row['peak'] / 2**30:.1f} GiB",
                f"{row['elapsed']:.0f} s",
                f"{here:.1f}",
                f"{here / first:.2f}",
            ]
        )
    return Table("Slabs against memory", head, lines)


def main() -> None:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--side", type=int, default=1024, help="voxels of the large volume")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    if "--child" in sys.argv:
        print(json.dumps(child(json.loads(parser.parse_args().child))))
        return
    args, store = begun(parser, "slabs")
    both = store.row(f"{SIDE} {DIRECTIONS}", lambda: compared(SIDE, DIRECTIONS))
    whole = store.row(f"{args.side} {FEWER}", lambda: large(args.side, FEWER))
    rows = [(name, SIDE, DIRECTIONS, row) for name, row in both.items()]
    found = table([*rows, ("slabs", args.side, FEWER, whole)])
    print(found.as_text())
    if args.document:
        replace_tables(args.document, {"bricks-slabs": found})


if __name__ == "__main__":
    main()
