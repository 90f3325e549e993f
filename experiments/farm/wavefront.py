"""Model of a sweep over bricks: messages, bytes and idle time of the wavefronts of all octants.

    python -m experiments.farm.wavefront [--force] [--document docs/developing/bricks.md]

A volume is divided into bricks, one per worker. Along a direction, a brick can be swept when the
radiance on the faces of the up to three bricks before it has arrived. Directions of the eight
octants begin in the eight corners; a worker takes, of the directions that are ready, the one with
the longest way to go. The model is a simulation of all these events. It is checked with Dask on
this machine: tasks that wait as long as a sweep would take, and pass on faces of the right size.
Writes output/farm/wavefront.json.
"""

from __future__ import annotations

import heapq
import itertools
import time
from dataclasses import asdict, dataclass

import numpy as np

from experiments.farm.commands import begun
from experiments.support.documents import replace_tables
from experiments.support.options import parser_of
from mitsuba_irrcache.compare.tables import Table

#: Rounds of the check, of which the fastest counts.
ROUNDS = 3
#: Bytes of the radiance of one track and channel.
BYTES = 4


@dataclass(frozen=True)
class Case:
    """A volume of ``side`` cubed voxels in ``bricks`` (x, y, z), one for each worker.

    ``seconds`` are those of one voxel and direction, ``bandwidth`` is in bytes per second and
    ``latency`` in seconds, of each message; ``directions`` are those that are swept together.
    """

    side: int
    bricks: tuple[int, int, int]
    directions: int
    channels: int = 3
    seconds: float = 0.25e-9
    bandwidth: float = 1.25e9
    latency: float = 1e-3

    @property
    def workers(self) -> int:
        """Number of bricks."""
        return int(np.prod(self.bricks))

    @property
    def task(self) -> float:
        """Seconds of one direction in one brick."""
        return self.side**3 / self.workers * self.seconds


@dataclass
class Outcome:
    """Seconds of a set of directions, the idle share of the workers, messages, and bytes."""

    seconds: float
    idle: float
    messages: int
    bytes: float


def directions_of(count: int, seed: int = 0) -> np.ndarray:
    """Return directions (count, 3), evenly spread over the sphere, opposite ones in pairs."""
    index = np.arange(count // 2) + 0.5
    z = 1 - index / (count // 2)
    angle = index * np.pi * (3 - 5**0.5) + np.random.default_rng(seed).uniform(0, 2 * np.pi)
    radius = np.sqrt(1 - z**2)
    half = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return np.concatenate([half, -half])


def face_bytes(case: Case, directions: np.ndarray) -> np.ndarray:
    """Return the bytes (n, 3) that pass one face of a brick across each axis.

    Across its dominant axis a direction has one track per voxel of the face; through the other
    faces pass as many as move sideways by a voxel from slice to slice.
    """
    sides = case.side / np.array(case.bricks)
    areas = np.prod(sides) / sides
    slopes = np.abs(directions) / np.abs(directions).max(axis=1, keepdims=True)
    return areas * slopes * case.channels * BYTES


def simulate(case: Case) -> Outcome:
    """Return what the sweep of one set of directions costs."""
    directions, shape = directions_of(case.directions), np.array(case.bricks)
    sizes = face_bytes(case, directions)
    signs = np.where(directions > 0, 1, -1)
    delays = case.latency + sizes / case.bandwidth
    waiting = np.empty((case.directions, *case.bricks), np.int8)
    places = list(itertools.product(*map(range, case.bricks)))
    for d, place in itertools.product(range(case.directions), places):
        waiting[(d, *place)] = sum(
            0 <= at - s < n for at, s, n in zip(place, signs[d], shape, strict=True)
        )
    ready: dict[tuple, list] = {place: [] for place in places}
    events: list[tuple] = []  # (time, kind, direction, place); an end of a task is kind 0
    busy = dict.fromkeys(places, False)
    messages = total = now = 0

    def left(d: int, place: tuple) -> int:
        return sum(
            n - 1 - a if s > 0 else a for a, s, n in zip(place, signs[d], shape, strict=True)
        )

    def start(place: tuple, now: float) -> None:
        if not busy[place] and ready[place]:
            _, d = heapq.heappop(ready[place])
            busy[place] = True
            heapq.heappush(events, (now + case.task, 0, d, place))

    for d, place in itertools.product(range(case.directions), places):
        if not waiting[(d, *place)]:
            heapq.heappush(ready[place], (-left(d, place), d))
    for place in places:
        start(place, 0.0)
    while events:
        now, kind, d, place = heapq.heappop(events)
        if kind:
            waiting[(d, *place)] -= 1
            if not waiting[(d, *place)]:
                heapq.heappush(ready[place], (-left(d, place), d))
        else:
            busy[place] = False
            for axis in range(3):
                at = place[axis] + signs[d][axis]
                if 0 <= at < shape[axis]:
                    behind = (*place[:axis], int(at), *place[axis + 1 :])
                    heapq.heappush(events, (now + delays[d, axis], 1, d, behind))
                    messages, total = messages + 1, total + sizes[d, axis]
        start(place, now)
    return Outcome(float(now), 1 - case.directions * case.task / now, messages, float(total))


#: The volume of the model: a cluster of 1000 workers with about eight times the memory bandwidth of
#: the machine whose sweeps take 2 ns per voxel and direction, and a network of 10 Gbit/s.
LARGE = [Case(8192, (10, 10, 10), n) for n in (16, 64, 256)]
#: Checked on this machine: bricks of workers that wait.
SMALL = [
    Case(256, bricks, directions, 1, 0.25 * np.prod(bricks) / 256**3, 1e9, 5e-3)
    for bricks, directions in (((2, 1, 1), 2), ((2, 1, 1), 16), ((2, 2, 1), 2), ((2, 2, 1), 16))
]


def check(case: Case) -> float:
    """Return the seconds of the same tasks by workers of Dask that wait in place of a sweep."""
    from distributed import Client, LocalCluster

    directions = directions_of(case.directions)
    sizes, signs = face_bytes(case, directions), np.where(directions > 0, 1, -1)
    options = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with LocalCluster(n_workers=case.workers, **options) as cluster, Client(cluster) as client:
        places = list(itertools.product(*map(range, case.bricks)))
        owners = dict(zip(places, client.nthreads(), strict=True))
        client.gather(_submit(client, case, owners, signs, sizes, 0.0))  # opens connections
        took = []
        for _ in range(ROUNDS):
            started = time.perf_counter()
            client.gather(_submit(client, case, owners, signs, sizes, case.task))
            took.append(time.perf_counter() - started)
        return min(took)


def _submit(client, case: Case, owners: dict, signs: np.ndarray, sizes: np.ndarray, task: float):
    """Submit all tasks; return the futures of the bricks where directions end."""
    ends, shape = [], case.bricks
    for d in range(case.directions):
        done: dict[tuple, object] = {}
        steps = [
            range(n) if s > 0 else range(n - 1, -1, -1)
            for n, s in zip(shape, signs[d], strict=True)
        ]
        for place in itertools.product(*steps):
            before = [(*place[:a], place[a] - signs[d][a], *place[a + 1 :]) for a in range(3)]
            faces = [done[b][a] for a, b in enumerate(before) if b in done]
            left = sum(
                n - 1 - p if s > 0 else p for p, s, n in zip(place, signs[d], shape, strict=True)
            )
            found = client.submit(
                wait_and_pass, task, [int(size) for size in sizes[d]], *faces,
                workers=[owners[place]], priority=left, pure=False,
            )  # fmt: skip
            pick = [
                client.submit(_item, found, a, workers=[owners[place]], priority=99, pure=False)
                if 0 <= place[a] + signs[d][a] < shape[a] else None
                for a in range(3)
            ]  # fmt: skip
            done[place] = pick
            if not any(pick):
                ends.append(client.submit(len, found, workers=[owners[place]], pure=False))
    return ends


def wait_and_pass(seconds: float, sizes: list[int], *faces: bytes) -> list[bytes]:
    """Wait as long as a sweep takes; return what passes the faces."""
    time.sleep(seconds)
    return [bytes(size) for size in sizes]


def _item(faces: list[bytes], axis: int) -> bytes:
    return faces[axis]


#: Streaming of 1024^3 grey voxels from a disk, slab by slab, once for each of the three dominant
#: axes: bytes per voxel that are read and written. Extinction in two words; source, irradiance,
#: loss and weight in one each, of which all are read and the last three are written; uncollided
#: irradiance in one, read and written.
STREAMED = (
    ("single scattering, 256 directions", 256, 8 + 4 + 4),
    ("all orders, a pass of 16", 16, 8 + 16 + 12),
    ("all orders, a pass of 64", 64, 8 + 16 + 12),
)
SLABS, DISK, PER_DIRECTION = 1024**3, 2e9, 2e-9


def disk_table() -> Table:
    """Return the table of arithmetic and disk, from the numbers above."""
    rows = []
    for name, directions, moved in STREAMED:
        arithmetic, disk = SLABS * directions * PER_DIRECTION, 3 * SLABS * moved / DISK
        rows.append(
            [
                name,
                f"{3 * moved}",
                f"{arithmetic:.0f} s",
                f"{disk:.0f} s",
                f"{disk / arithmetic:.2f}",
            ]
        )
    head = ["", "bytes per voxel", "arithmetic", "disk", "disk / arithmetic"]
    return Table("Slabs from a disk", head, rows)


def model_table(cases: list[Case], outcomes: list[dict]) -> Table:
    """Return the table of the model."""
    head = ["directions", "seconds", "idle", "messages", "of each", "per worker and second"]
    rows = []
    for case, found in zip(cases, outcomes, strict=True):
        mean = found["bytes"] / found["messages"]
        rate = found["bytes"] / case.workers / found["seconds"]
        rows.append(
            [
                str(case.directions),
                f"{found['seconds']:.1f}",
                f"{found['idle']:.0%}",
                f"{found['messages']:.3g}",
                f"{mean / 1e6:.1f} MB",
                f"{rate / 1e6:.0f} MB",
            ]
        )
    return Table("Sweep over bricks: model", head, rows)


def check_table(cases: list[Case], outcomes: list[dict], measured: list[float]) -> Table:
    """Return the table of the check."""
    head = ["workers", "directions", "idle", "model", "measured", "measured / model"]
    rows = [
        [
            str(case.workers),
            str(case.directions),
            f"{found['idle']:.0%}",
            f"{found['seconds']:.2f} s",
            f"{seconds:.2f} s",
            f"{seconds / found['seconds']:.2f}",
        ]
        for case, found, seconds in zip(cases, outcomes, measured, strict=True)
    ]
    return Table("Sweep over bricks: check", head, rows)


def main() -> None:
    """Run the model and its check, or show their results."""
    parser = parser_of(__doc__)
    args, store = begun(parser, "wavefront")

    def row(case: Case) -> dict:
        key = f"model {case}"
        return store.row(key, lambda: asdict(simulate(case)))

    measured = [
        store.row(f"check {case}", lambda case=case: {"seconds": check(case)})["seconds"]
        for case in SMALL
    ]
    tables = {
        "bricks-model": model_table(LARGE, list(map(row, LARGE))),
        "bricks-check": check_table(SMALL, list(map(row, SMALL)), measured),
        "bricks-disk": disk_table(),
    }
    for table in tables.values():
        print(table.as_text())
    if args.document:
        replace_tables(args.document, tables)


if __name__ == "__main__":
    main()
