"""Sweeps of a volume by several workers find, bit by bit, what one machine finds by the same slabs,
in whatever order, and however often, jobs are run.
"""

from __future__ import annotations

import re
import shutil
from collections import Counter
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm import volume, volume_jobs
from mitsuba_irrcache.farm.cluster import Connection
from mitsuba_irrcache.farm.jobs import Environment, UnfitWorkerError
from mitsuba_irrcache.farm.results import Outcome
from mitsuba_irrcache.farm.volume import FarmSweep
from mitsuba_irrcache.farm.volume_jobs import SlabStep, by_length_of_way, steps_of
from mitsuba_irrcache.farm.work import KINDS
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.out_of_core import irradiance_file, rendering, scattering, slab_sweep
from mitsuba_irrcache.out_of_core.brick_file import BrickFile
from mitsuba_irrcache.out_of_core.slab_sweep import SlabSweep
from mitsuba_irrcache.out_of_core.survey import MappedField
from mitsuba_irrcache.out_of_core.volume_files import VolumeFile
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import joint_ordinates
from tests.support.scenes import boundary, load, medium, placement

SHAPE, MEMORY = (41, 37, 34), 1 << 30
ENVIRONMENT = Environment("llvm_ad_rgb")


@pytest.fixture
def sigma_t(rgb, tmp_path):
    """A noisy volume in a file, whose voxels are not cubes."""
    np.save(tmp_path / "density.npy", np.random.default_rng(1).random(SHAPE, dtype=np.float32))
    grid = Grid(SHAPE, np.diag([1.0, 1.2, 0.9, 1.0]))
    return MappedField(VolumeFile(tmp_path / "density.npy"), grid, 6.0, "density")


class Workers:
    """Run jobs here, in a random order that their ``after`` allows, and sometimes twice, as where a
    worker is lost before it answers. ``limit``: the run ends after so many jobs.
    """

    def __init__(self, monkeypatch, seed: int, limit: int = 1 << 30) -> None:
        self.rng, self.limit, self.runs = np.random.default_rng(seed), limit, Counter()
        monkeypatch.setattr(volume, "Dispatch", self)

    def __call__(self, connection, jobs, store):
        self.jobs, self.store = list(jobs), store
        return self

    def run(self) -> dict:
        waiting = {job.name: job for job in self.jobs}
        while waiting:
            ready = [job for job in waiting.values() if not set(job.after) & waiting.keys()]
            job = ready[self.rng.integers(len(ready))]
            if sum(self.runs.values()) >= self.limit:
                raise KeyboardInterrupt
            digests = KINDS[job.kind](job.arguments, None)
            self.runs[job.name] += 1
            if self.rng.random() < 0.8:
                self.store(job, Outcome("here", 1.0, digests=digests))
                del waiting[job.name]
        return {}


def ordinates_of(pairs: int, channels: int) -> tuple:
    rng = np.random.default_rng(2)
    directions, weights = joint_ordinates(1, pairs, rng)[0]
    return directions, weights, rng.random((pairs, 2, channels)), rng.random((pairs, 2))


def both_sweeps(sweep: SlabSweep, pairs: int, channels: int) -> list[np.ndarray]:
    """Return the uncollided irradiance, and what a noisy source adds."""
    directions, weights, incoming, offsets = ordinates_of(pairs, channels)
    whole = (0, 0, 0), SHAPE
    source = sweep.file("source-0", channels=channels)
    values = np.random.default_rng(3).random((*SHAPE, channels), dtype=np.float32)
    source.write(whole[0], values)
    found = [
        sweep.uncollided(directions, incoming, offsets),
        sweep.scattered("scattered-0", (directions, weights, offsets), source),
    ]
    return [file.read(*whole) for file in found]


def farm_sweep(sigma_t, folder, inputs: str = "a", memory: int = MEMORY) -> FarmSweep:
    return FarmSweep(sigma_t, folder / "parts", memory, Connection(None), ENVIRONMENT, inputs)


def by_one_machine(sigma_t, folder, pairs: int, channels: int) -> list[np.ndarray]:
    folder = folder / "alone"
    folder.mkdir()
    return both_sweeps(SlabSweep(sigma_t, folder, MEMORY), pairs, channels)


@pytest.mark.parametrize(
    ("most", "batch", "pairs", "channels"),
    [(5, 2, 10, 1), (6, 3, 10, 3), (9, 1, 4, 1), (14, 8, 12, 3), (20, 2, 7, 1), (64, 2, 10, 1)],
)
def test_workers_find_the_bits_of_one_machine(
    sigma_t, tmp_path, monkeypatch, most, batch, pairs, channels
):
    monkeypatch.setattr(slab_sweep, "MOST_SLICES", most)
    monkeypatch.setattr(volume_jobs, "FEWEST_SLABS", 1)
    monkeypatch.setattr(volume_jobs, "PAIRS", batch)
    monkeypatch.setattr(volume, "PAIRS", batch)
    expected = by_one_machine(sigma_t, tmp_path, pairs, channels)
    Workers(monkeypatch, seed=most)
    found = both_sweeps(farm_sweep(sigma_t, tmp_path), pairs, channels)
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_run_that_is_interrupted_again_and_again_ends_with_the_same_bits(
    sigma_t, tmp_path, monkeypatch
):
    monkeypatch.setattr(slab_sweep, "MOST_SLICES", 6)
    monkeypatch.setattr(volume, "PAIRS", 3)
    monkeypatch.setattr(volume_jobs, "PAIRS", 3)
    monkeypatch.setattr(volume_jobs, "FEWEST_SLABS", 1)
    expected, interruptions = by_one_machine(sigma_t, tmp_path, 10, 1), 0
    while True:
        workers = Workers(monkeypatch, interruptions, limit=20)
        try:
            found = both_sweeps(farm_sweep(sigma_t, tmp_path), 10, 1)
            break
        except KeyboardInterrupt:
            interruptions += 1
    assert interruptions > 3 and sum(workers.runs.values()) < 20
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_run_that_ends_at_any_time_is_continued_to_the_same_bits(sigma_t, tmp_path, monkeypatch):
    """All orders; whatever the command does by itself is interrupted, too."""
    for module, name in ((scattering, "COARSE"), (slab_sweep, "MOST_SLICES")):
        monkeypatch.setattr(module, name, 12)

    def computed(file) -> np.ndarray:
        files = {"sigma_t_file": str(tmp_path / "density.npy"), "max_memory": "1GB"}
        settings = {"type": "irrcache", "solver": "sweep", "max_depth": -1, "cache_spp": 32}
        scene = load(settings | files, boundary(medium(3.0, 0.9, placement()), placement()))
        mapped = scene.integrator().mapped_medium
        mapped.use_file(tmp_path / file)

        def begin(field, inputs) -> FarmSweep:
            folder = tmp_path / f"{file}.parts"
            return FarmSweep(field, folder, MEMORY, Connection(None), ENVIRONMENT, inputs)

        mapped.compute(scene, begin, None)
        return np.load(tmp_path / file)

    Workers(monkeypatch, 1)
    expected = computed("undisturbed.npy")
    write, written = BrickFile.write, Counter()

    def interrupted(file, lower, values) -> None:
        write(file, lower, values)
        written[file.path.name] += 1
        if written[file.path.name] in (1, 3):
            raise KeyboardInterrupt

    def not_written(*_) -> None:
        monkeypatch.setattr(rendering, "write", irradiance_file.write)
        raise KeyboardInterrupt

    monkeypatch.setattr(BrickFile, "write", interrupted)
    monkeypatch.setattr(rendering, "write", not_written)
    found = None
    while found is None:
        Workers(monkeypatch, written.total())
        try:
            found = computed("disturbed.npy")
        except KeyboardInterrupt:
            continue
    np.testing.assert_array_equal(found, expected)
    assert written.keys() >= {"extinction", "uncollided", "source-0", "scattered-0"}


def test_finished_jobs_of_other_inputs_are_not_used(sigma_t, tmp_path, monkeypatch):
    Workers(monkeypatch, 1)
    both_sweeps(farm_sweep(sigma_t, tmp_path), 4, 1)
    again = Workers(monkeypatch, 1)
    both_sweeps(farm_sweep(sigma_t, tmp_path), 4, 1)
    assert not again.runs
    both_sweeps(farm_sweep(sigma_t, tmp_path, inputs="b"), 4, 1)
    assert again.runs


def test_working_files_without_records_are_computed_again(sigma_t, tmp_path, monkeypatch):
    """As where a command is killed while it removes them."""
    Workers(monkeypatch, 1)
    expected = both_sweeps(farm_sweep(sigma_t, tmp_path), 4, 1)
    (records,) = tmp_path.glob("parts/*/finished")
    shutil.rmtree(records)
    again = Workers(monkeypatch, 1)
    found = both_sweeps(farm_sweep(sigma_t, tmp_path), 4, 1)
    assert again.runs
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_run_with_other_memory_continues_with_the_same_slabs(sigma_t, tmp_path, monkeypatch):
    """As with another number of workers, among which the memory of a machine is divided."""
    little = 1 << 20
    (tmp_path / "undisturbed").mkdir()
    counts, found = [], []
    for memory in (MEMORY, little):
        workers = Workers(monkeypatch, 1)
        folder = tmp_path / "undisturbed" / str(memory)
        folder.mkdir()
        found.append(both_sweeps(farm_sweep(sigma_t, folder, memory=memory), 4, 1))
        counts.append(len(workers.runs))
    assert counts[0] < counts[1]  # the slabs differ
    first = Workers(monkeypatch, 1, limit=20)
    with pytest.raises(KeyboardInterrupt):
        both_sweeps(farm_sweep(sigma_t, tmp_path), 4, 1)
    second = Workers(monkeypatch, 1)
    resumed = both_sweeps(farm_sweep(sigma_t, tmp_path, memory=little), 4, 1)
    assert len(first.runs | second.runs) == counts[0] and len(second.runs) < counts[0]
    for mine, theirs in zip(resumed, found[0], strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_result_that_was_lost_is_not_taken_for_zeros(sigma_t, tmp_path, monkeypatch):
    Workers(monkeypatch, 1)
    sweep = farm_sweep(sigma_t, tmp_path)
    both_sweeps(sweep, 4, 1)
    (tmp_path / "parts").joinpath(sweep.file("uncollided").path).unlink()
    with pytest.raises(IrrcacheError, match=r"uncollided-.*found.*remove the folder"):
        both_sweeps(farm_sweep(sigma_t, tmp_path), 4, 1)


@pytest.mark.parametrize("damage", ["lost", "cut", "of another shape"])
@pytest.mark.parametrize("kind", ["faces", "sums", "found"])
def test_a_damaged_working_file_ends_the_run_with_its_name(
    sigma_t, tmp_path, monkeypatch, damage, kind
):
    monkeypatch.setattr(slab_sweep, "MOST_SLICES", 9)
    workers, folder = Workers(monkeypatch, 2), tmp_path / "parts"

    class Damaging(Workers):
        def __call__(self, connection, jobs, store):
            def damaged(job, outcome) -> None:
                store(job, outcome)
                for file in folder.glob(f"*/uncollided-*.{kind}.npy"):
                    if damage == "lost":
                        file.unlink()
                    elif damage == "cut":
                        file.write_bytes(file.read_bytes()[:-1])
                    else:
                        np.save(file, np.zeros((3, 2), np.float32))

            return super().__call__(connection, jobs, damaged)

    del workers
    Damaging(monkeypatch, 2)
    with pytest.raises(IrrcacheError, match=rf"uncollided-.*{kind}\.npy.*remove the folder"):
        both_sweeps(farm_sweep(sigma_t, tmp_path), 4, 1)


def uncollided_of(sweep: SlabSweep) -> np.ndarray:
    directions, _, incoming, offsets = ordinates_of(10, 1)
    return sweep.uncollided(directions, incoming, offsets).read((0, 0, 0), SHAPE)


def changed(content: bytes, how: str) -> bytes:
    """Return the content of a file with another bit in its values, or zeros of the same size."""
    at = len(content) // 2
    return {
        "a bit": content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :],
        "zeros": bytes(len(content)),
        "zeros after the header": content[:128] + bytes(len(content) - 128),
    }[how]


@pytest.mark.parametrize("how", ["a bit", "zeros", "zeros after the header"])
@pytest.mark.parametrize("kind", ["-*.faces.npy", "-*.sums.npy", "-*.found.npy", ""])
def test_a_file_that_is_damaged_between_runs_ends_the_next_one_with_its_name(
    sigma_t, tmp_path, monkeypatch, kind, how
):
    """At whatever time the first run ends; where the file is no longer needed, nothing differs."""
    monkeypatch.setattr(volume_jobs, "FEWEST_SLABS", 3)
    Workers(monkeypatch, 2)
    expected = uncollided_of(farm_sweep(sigma_t, tmp_path))
    refused = 0
    for limit in (5, 18, 40, 1 << 30):
        folder = tmp_path / str(limit)
        folder.mkdir()
        Workers(monkeypatch, 2, limit)
        with suppress(KeyboardInterrupt):
            uncollided_of(farm_sweep(sigma_t, folder))
        for path in sorted(folder.glob(f"parts/*/uncollided{kind}"))[:1]:
            path.write_bytes(changed(path.read_bytes(), how))
        again = Workers(monkeypatch, 2)
        try:
            np.testing.assert_array_equal(uncollided_of(farm_sweep(sigma_t, folder)), expected)
        except IrrcacheError as error:
            assert re.search(
                rf'uncollided{kind.replace("*", ".*")}".*remove the folder', str(error)
            )
            assert not again.runs
            refused += 1
    assert refused


def test_a_worker_without_the_folder_is_of_another_kind(tmp_path):
    step = {"sweep": "a", "axis": 0, "step": 0, "batch": 0, "slabs": 1, "batches": 1}
    for kind, own in (("cross_slabs", {"step": step}), ("add_axes", {"slices": [0, 1]})):
        with pytest.raises(UnfitWorkerError, match="no folder"):
            KINDS[kind]({"folder": str(tmp_path / "none"), "sweep": "a", **own}, tmp_path)


@pytest.mark.parametrize("slabs", [1, 2, 3, 4, 7, 8])
@pytest.mark.parametrize("batches", [1, 2, 5])
def test_every_file_has_one_writer_that_its_only_reader_waits_for(slabs, batches):
    steps = list(steps_of("a", [(slabs, batches)]))
    writers: dict[str, list[SlabStep]] = {}
    for step in steps:
        names = [step.faces] if step.step < slabs - 1 else []
        names += [(step.found if step.completes else step.sums)(number) for number in step.numbers]
        for name in names:
            writers.setdefault(name, []).append(step)
    assert all(len(found) == 1 for found in writers.values())
    reads = Counter(name for step in steps for name in step.reads)
    assert set(reads.values()) <= {1}
    found = {name for name in writers if name.endswith("found.npy")}
    assert len(found) == slabs and reads.keys() == writers.keys() - found
    for step in steps:
        assert {writers[name][0].name for name in step.reads} == set(step.after)
    # Each batch crosses each slab both ways.
    assert Counter(n for step in steps for n in (step.step, slabs - 1 - step.step)) == {
        number: 2 * batches for number in range(slabs)
    }
    order = [step.name for step in by_length_of_way(steps)]
    assert all(order.index(n) < order.index(step.name) for step in steps for n in step.after)


def test_a_damaged_plan_is_named(tmp_path):
    for content in (b"", b"PK", b"x" * 100):
        (tmp_path / f"a{volume_jobs.PLAN}").write_bytes(content)
        with pytest.raises(IrrcacheError, match=r"a\.plan\.npz.*remove the folder"):
            volume_jobs.SweepPlan.load(tmp_path, "a")


def test_plans_hold_no_pickles(tmp_path):
    directions, weights, incoming, offsets = ordinates_of(3, 1)
    ordinates = directions, weights, offsets
    plan = volume_jobs.SweepPlan("a", SHAPE, np.eye(4), 0.5, 7, ordinates, incoming, "source-0")
    plan.save(tmp_path)
    known = volume_jobs.SweepPlan.load(tmp_path, "a")
    assert (known.shape, known.quantum, known.memory, known.source) == (SHAPE, 0.5, 7, "source-0")
    np.testing.assert_array_equal(known.incoming, incoming)
    for mine, theirs in zip(known.ordinates, ordinates, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert replace(plan, source="").source == ""
