"""Single scattering in volumes larger than memory, slab by slab, against sweeps in memory.

    python -m experiments.farm.slabs [--force] [--document docs/developing/bricks.md]

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

#: Volumes that fit into memory, too: shape (z, y, x), directions, memory for slabs [bytes], and
#: rounds, each way in turn, of which the fastest counts. The second one has the slices of the large
#: volume.
BOTH_WAYS = (
    ((384, 384, 384), 128, 300 << 20, 2),
    ((256, 1024, 1024), 64, 1 << 30, 1),
)
#: The large volume.
LARGE = (1024, 1024, 1024), 64, 7 << 30
#: Optical depth of the volume along a side, about.
DEPTH = 4.0


def write_volume(path: Path, shape: tuple[int, int, int]) -> None:
    """Write a volume of smooth clouds as uint8, slice by slice."""
    volume = np.lib.format.open_memmap(path, "w+", np.uint8, shape)
    x = np.linspace(0, 1, shape[2], dtype=np.float32)
    waves = [np.sin(2 * np.pi * (f * x + f / 7)) for f in (1, 3, 8, 21)]
    for z in range(shape[0]):
        sums = sum(w[: shape[1], None] * w[None, :] * w[z] for w in waves) + 0.3
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
    shape, folder = tuple(case["shape"]), Path(case["folder"])
    edges = np.array(shape[::-1]) / max(shape)
    grid, scale = Grid(shape, np.diag([*edges, 1.0])), DEPTH / 128
    middle = shape[0] // 2
    file, arguments = VolumeFile(folder / "volume.npy"), ordinates(case["directions"])
    started = time.perf_counter()
    if case["memory"]:
        before = time.process_time()
        sigma_t = MappedField(file, grid, scale, "volume")
        sweep = SlabSweep(sigma_t, folder, case["memory"])
        prepared = time.process_time() - before
        found = sweep.uncollided(*arguments)
        seconds = time.process_time() - before - prepared
        mean = float(found.read((middle, 0, 0), (middle + 1, *shape[1:])).mean())
    else:
        sigma_t = mi.Float(file.read(0, shape[0]).ravel()) * scale
        tracks = Tracks(grid, sigma_t, np.zeros(3, int), grid.resolution)
        dr.eval()
        dr.sync_thread()
        before, prepared = time.process_time(), 0.0
        values = tracks.uncollided(*arguments)
        dr.sync_thread()
        seconds = time.process_time() - before
        mean = float(np.array(values).reshape(grid.shape)[middle].mean())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    elapsed = time.perf_counter() - started
    result = {"prepared": prepared, "sweep": seconds, "elapsed": elapsed}
    return result | {"peak": peak, "mean": mean}


def run(shape: tuple, directions: int, memory: int, folder: str) -> dict:
    """Run one case in a process of its own."""
    case = {"shape": shape, "directions": directions, "memory": memory, "folder": folder}
    command = [sys.executable, "-m", "experiments.farm.slabs", "--child", json.dumps(case)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def compared(shape: tuple, directions: int, memory: int, count: int) -> dict[str, dict]:
    """Return the fastest of several rounds in memory and by slabs."""
    rounds: dict[str, list[dict]] = {"in memory": [], "slabs": []}
    with tempfile.TemporaryDirectory(dir=".") as folder:
        write_volume(Path(folder) / "volume.npy", shape)
        for _ in range(count):
            for name, size in (("in memory", 0), ("slabs", memory)):
                rounds[name].append(run(shape, directions, size, folder))
    return {name: min(found, key=lambda row: row["sweep"]) for name, found in rounds.items()}


def large(shape: tuple, directions: int, memory: int) -> dict:
    """Return what the large volume takes."""
    with tempfile.TemporaryDirectory(dir=".") as folder:
        write_volume(Path(folder) / "volume.npy", shape)
        return run(shape, directions, memory, folder)


def cost(shape: tuple, directions: int, row: dict) -> float:
    """Return the nanoseconds of a voxel and direction."""
    return (row["prepared"] + row["sweep"]) / float(np.prod(shape)) / directions * 1e9


def line(name: str, shape: tuple, directions: int, row: dict, reference: float) -> list[str]:
    """Return a line of the table; the ratio is that to a ``reference`` cost in memory."""
    here = cost(shape, directions, row)
    return [
        " x ".join(map(str, shape[::-1])),
        name,
        f"{directions}",
        f"{row['peak'] / 2**30:.1f} GiB",
        f"{row['elapsed']:.0f} s",
        f"{here:.1f}",
        f"{here / reference:.2f}",
    ]


def main() -> None:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    if "--child" in sys.argv:
        print(json.dumps(child(json.loads(parser.parse_args().child))))
        return
    args, store = begun(parser, "slabs")
    lines, reference = [], 0.0
    for shape, directions, memory, count in BOTH_WAYS:
        key, arguments = f"{shape} {directions}", (shape, directions, memory, count)
        both = store.row(key, lambda arguments=arguments: compared(*arguments))
        reference = cost(shape, directions, both["in memory"])
        lines += [line(n, shape, directions, row, reference) for n, row in both.items()]
    shape, directions, _ = LARGE
    row = store.row(f"{shape} {directions}", lambda: large(*LARGE))
    lines.append(line("slabs", shape, directions, row, reference))
    head = ["voxels", "", "directions", "peak memory", "elapsed", "ns per voxel and direction"]
    found = Table("Slabs against memory", [*head, "ratio"], lines)
    print(found.as_text())
    if args.document:
        replace_tables(args.document, {"bricks-slabs": found})


if __name__ == "__main__":
    main()
