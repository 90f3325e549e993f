"""Volumes larger than memory: all orders and an image of a large one; sweeps by several workers,
and a model of them.

    python -m experiments.farm.volumes [--side 1024] [--directions 32] [--force]
        [--document docs/developing/bricks.md]

All are commands of users: ``irrcache render`` of a volume in a file, with all orders of scattering,
within 8 GB; ``irrcache farm cache`` by one, two and four workers against one process. The time of
the sweeps is compared with a model, which starts jobs in the order of the farm as soon as those
that they need have ended and a worker is free. The same model tells what larger volumes would cost
on clusters. Needs 31 bytes of free disk space per voxel. Writes output/farm/volumes.json.
"""

from __future__ import annotations

import heapq
import os
import re
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from experiments.farm.commands import begun, command, load, load_note
from experiments.farm.slabs import write_volume
from experiments.support.documents import replace_tables
from experiments.support.options import parser_of
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.farm.volume_jobs import (
    FEWEST_SLABS,
    PAIRS,
    SlabStep,
    by_length_of_way,
    steps_of,
)
from mitsuba_irrcache.out_of_core import slab_sweep

SCENE = """<scene version="3.0.0">
    <integrator type="irrcache">
        <integer name="max_depth" value="$depth"/>
        <integer name="cache_spp" value="$directions"/>
        <string name="sigma_t_file" value="density.npy"/>
        <string name="irradiance_file" value="$light"/>
        <string name="max_memory" value="$memory"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="34"/>
        <transform name="to_world">
            <lookat origin="2, 1.5, 4.5" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="512"/> <integer name="height" value="512"/>
        </film>
    </sensor>
    <shape type="cube">
        <bsdf type="null"/>
        <medium name="interior" type="homogeneous">
            <rgb name="sigma_t" value="1, 1, 1"/>
            <rgb name="albedo" value="0.95, 0.95, 0.95"/>
            <float name="scale" value="0.06"/>
        </medium>
    </shape>
    <emitter type="directional">
        <vector name="direction" x="0.4" y="-1" z="0.5"/>
        <rgb name="irradiance" value="3, 3, 3"/>
    </emitter>
    <emitter type="constant"/>
</scene>
"""
#: The volume that is swept by workers, and its directions.
SIDE, DIRECTIONS = 256, 64


@dataclass(frozen=True)
class Measured:
    """What a command printed, its seconds, those of processors, and its largest resident memory."""

    text: str
    seconds: float
    processor: float
    peak: int


def run(*arguments: object) -> Measured:
    """Run ``irrcache`` to its end; raise RuntimeError with what it printed if it fails."""
    started = time.perf_counter()
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command(*arguments), stdout=log, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = status
        log.seek(0)
        text = log.read().decode()
    if status:
        raise RuntimeError(text)
    seconds = time.perf_counter() - started
    return Measured(text, seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)


def write_scene(folder: Path, side: int) -> Path:
    """Write a volume of this side, and a scene with it; return the scene."""
    write_volume(folder / "density.npy", (side, side, side))
    (folder / "scene.xml").write_text(SCENE)
    return folder / "scene.xml"


def all_orders(side: int, directions: int) -> dict:
    """Return what an image of a volume with all orders of scattering costs, and one more view."""
    with tempfile.TemporaryDirectory(dir=".") as name:
        folder = Path(name)
        scene = write_scene(folder, side)
        settings = {"depth": -1, "directions": directions, "memory": "7.5GB"}
        settings["light"] = folder / "light.npy"
        options = ["-v", "--spp", "4", "-o", folder / "image.exr"]
        for key, value in settings.items():
            options += ["-D", f"{key}={value}"]
        first, second = run("render", scene, *options), run("render", scene, *options)
    changes = re.findall(r"changed the irradiance by ([\d.]+)%", first.text)
    return {
        "passes": len(changes),
        "change": float(changes[-1]),
        "seconds": first.seconds,
        "processor": first.processor,
        "peak": first.peak,
        "again": second.processor,
        "load": load(),
    }


def by_workers(workers: int) -> dict:
    """Return the seconds of the sweeps, and those of each job by its name; without workers the
    seconds of one process.
    """
    with tempfile.TemporaryDirectory(dir=".") as name:
        folder = Path(name)
        scene = write_scene(folder, SIDE)
        options = ["-D", "depth=2", "-D", f"directions={DIRECTIONS}", "-D", "memory=2GB"]
        options += ["-D", f"light={folder / 'light.npy'}"]
        if not workers:
            done = run("render", scene, *options, "--spp", "1", "-o", folder / "image.exr")
            return {"seconds": done.seconds, "processor": done.processor, "load": load()}
        options += ["--workers", workers, "--threads", 1]
        done = run("farm", "cache", scene, *options, "-o", folder / "light.npy")
    jobs = re.findall(r"^\[\d+/\d+\] (\S+): ([\d.]+) s on", done.text, re.MULTILINE)
    sweeps = float(re.search(r"^\d+ jobs in ([\d.]+) s", done.text, re.MULTILINE)[1])
    return {
        "sweeps": sweeps,
        "jobs": {name: float(seconds) for name, seconds in jobs},
        "seconds": done.seconds,
        "processor": done.processor,
        "load": load(),
    }


def simulated(
    steps: list[SlabStep], seconds: dict[str, float], workers: int
) -> tuple[float, float]:
    """Return the time of all steps by so many workers, and the share for which these are idle."""
    waits = {step.name: len(step.after) for step in steps}
    followers: dict[str, list[int]] = {}
    for number, step in enumerate(steps):
        for name in step.after:
            followers.setdefault(name, []).append(number)
    ready = [number for number, step in enumerate(steps) if not step.after]
    heapq.heapify(ready)
    running: list[tuple[float, int]] = []
    now = 0.0
    while ready or running:
        while ready and len(running) < workers:
            number = heapq.heappop(ready)
            heapq.heappush(running, (now + seconds[steps[number].name], number))
        now, number = heapq.heappop(running)
        for other in followers.get(steps[number].name, ()):
            waits[steps[other].name] -= 1
            if not waits[steps[other].name]:
                heapq.heappush(ready, other)
    return now, 1 - sum(seconds.values()) / (workers * now)


@dataclass(frozen=True)
class Cluster:
    """A grey volume of ``side`` cubed voxels swept along all ``directions`` by ``workers``: seconds
    per voxel and direction, bytes per second that each reads or writes, and bytes of memory.
    """

    side: int
    workers: int
    directions: int = 256
    seconds: float = 0.25e-9
    bandwidth: float = 1.25e9
    memory: float = 64e9


CLUSTERS = [
    Cluster(1024, 4, seconds=5e-9, bandwidth=0.5e9, memory=4e9),  # workers as this machine
    Cluster(2048, 16, seconds=5e-9, bandwidth=0.5e9, memory=16e9),
    Cluster(1024, 4),
    Cluster(2048, 16),
    Cluster(4096, 64),
    Cluster(8192, 1000),
]


def modelled(case: Cluster) -> dict:
    """Return what the sweeps of a cluster cost, without preparing and adding up the volume."""
    tracks, batches = case.side**2, -(-case.directions // 2 // 3 // PAIRS)
    carried = (PAIRS + 1) * 2 * tracks * 2 * 4
    each = 2 * tracks * (slab_sweep.BYTES + slab_sweep.BYTES_OF_CHANNEL)
    most = min(
        int((case.memory - carried) // each),
        slab_sweep.MOST_VALUES // (2 * tracks),
        slab_sweep.MOST_SLICES,
        case.side // FEWEST_SLABS,
    )
    slabs = -(-case.side // max(most, 1))
    voxels = 2 * case.side / slabs * tracks
    faces, sums, extinction = 2 * PAIRS * 2 * 2 * tracks * 4, 2 * voxels * 4, 2 * voxels
    moved = faces + sums + extinction
    arithmetic = voxels * PAIRS * case.seconds
    steps = by_length_of_way(list(steps_of("sweep", [(slabs, batches)] * 3)))
    took = arithmetic + moved / case.bandwidth
    seconds, idle = simulated(steps, dict.fromkeys((s.name for s in steps), took), case.workers)
    ideal = sum(arithmetic for _ in steps) / case.workers
    return {
        "jobs": len(steps),
        "seconds": seconds,
        "idle": idle,
        "moved": moved,
        "arithmetic": arithmetic,
        "efficiency": ideal / seconds,
    }


def orders_table(side: int, directions: int, row: dict) -> Table:
    """Return the table of all orders and an image."""
    head = ["voxels", "directions", "passes", "last change", "peak memory", "elapsed", "processor"]
    swept = side**3 * directions * (1 + row["passes"])
    cells = [
        " x ".join([str(side)] * 3),
        str(directions),
        str(row["passes"]),
        f"{row['change']:.1f} %",
        f"{row['peak'] / 2**30:.1f} GiB",
        f"{row['seconds']:.0f} s",
        f"{row['processor']:.0f} s",
        f"{row['processor'] / swept * 1e9:.1f}",
        f"{row['again']:.0f} s",
    ]
    head += ["ns per voxel, direction and sweep", "another image"]
    return Table("All orders and an image", head, [cells], load_note(row["load"]))


def workers_table(rows: dict[int, dict]) -> Table:
    """Return the table of sweeps by workers, with the model of the same jobs."""
    head = ["workers", "processor", "sweeps", "work", "idle", "model", "idle there", "overhead"]
    alone = rows[0]
    lines = [["none", f"{alone['processor']:.0f} s", *["-"] * 6]]
    for workers, row in rows.items():
        if not workers:
            continue
        seconds = row["jobs"]
        own = [re.fullmatch(r"uncollided-(\d+)-(\d+)-(\d+)", name) for name in seconds]
        found = [tuple(map(int, match.groups())) for match in own if match]
        sizes = [
            tuple(max(s[k] for s in found if s[0] == axis) + 1 for k in (1, 2))
            for axis in sorted({axis for axis, _, _ in found})
        ]
        steps = by_length_of_way(list(steps_of("uncollided", sizes)))
        rest = sum(s for name, s in seconds.items() if "slices" in name) / workers
        swept = {step.name: seconds[step.name] for step in steps}
        model = simulated(steps, swept, workers)[0] + rest
        work = sum(seconds.values())
        lines.append(
            [
                str(workers),
                f"{row['processor']:.0f} s",
                f"{row['sweeps']:.1f} s",
                f"{work:.1f} s",
                f"{1 - work / workers / row['sweeps']:.0%}",
                f"{model:.1f} s",
                f"{1 - work / workers / model:.0%}",
                f"{(row['sweeps'] - model) * workers / len(seconds) * 1e3:.0f} ms",
            ]
        )
    worst = max(row["load"] for row in rows.values())
    return Table("Sweeps by workers", head, lines, load_note(worst))


def model_table(cases: list[Cluster]) -> Table:
    """Return the table of the model."""
    head = ["voxels", "workers", "ns per voxel and direction", "jobs", "seconds", "idle"]
    head += ["moved per job", "to and from storage", "efficiency"]
    rows = []
    for case in cases:
        found = modelled(case)
        seconds = found["moved"] / case.bandwidth
        rows.append(
            [
                f"{case.side}³",
                str(case.workers),
                f"{case.seconds * 1e9:g}",
                str(found["jobs"]),
                f"{found['seconds']:.0f} s",
                f"{found['idle']:.0%}",
                f"{found['moved'] / 1e9:.1f} GB",
                f"{seconds / (seconds + found['arithmetic']):.0%}",
                f"{found['efficiency']:.1%}",
            ]
        )
    return Table("Sweeps by slabs: model", head, rows)


def main() -> None:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--side", type=int, default=1024)
    parser.add_argument("--directions", type=int, default=32)
    args, store = begun(parser, "volumes")
    rows = {n: store.row(f"workers {n}", lambda n=n: by_workers(n)) for n in (0, 1, 2, 4)}
    tables = {"volumes-workers": workers_table(rows), "volumes-model": model_table(CLUSTERS)}
    for table in tables.values():
        print(table.as_text(), flush=True)
    key = f"orders {args.side} {args.directions}"
    row = store.row(key, lambda: all_orders(args.side, args.directions))
    tables["volumes-orders"] = orders_table(args.side, args.directions, row)
    print(tables["volumes-orders"].as_text())
    if args.document:
        replace_tables(args.document, tables)


if __name__ == "__main__":
    main()
