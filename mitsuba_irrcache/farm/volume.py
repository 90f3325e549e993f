"""The irradiance of a volume larger than memory, swept by many workers: the bits are those of one
machine that sweeps the same slabs alone.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.cluster import Connection
from mitsuba_irrcache.farm.dispatch import Dispatch
from mitsuba_irrcache.farm.jobs import Environment, Job
from mitsuba_irrcache.farm.results import Outcome, Results
from mitsuba_irrcache.farm.volume_jobs import (
    FEWEST_SLABS,
    FOUND,
    PAIRS,
    PLAN,
    SweepPlan,
    by_length_of_way,
    require_unchanged,
    slices_of,
    steps_of,
)
from mitsuba_irrcache.out_of_core.brick_file import BrickFile
from mitsuba_irrcache.out_of_core.slab_sweep import PairsOfOrdinates, Progress, SlabSweep
from mitsuba_irrcache.out_of_core.slabs import even_slabs
from mitsuba_irrcache.out_of_core.survey import MappedField

#: Digits of the name of a folder of working files, and the pattern of such names.
DIGITS = 16
NAMES = "[0-9a-f]" * DIGITS


class FarmSweep(SlabSweep):
    """Sweeps by the workers of a ``connection``, with working files in a folder that all of them
    see; ``memory`` is that of each worker.

    Finished jobs are kept there: with the same ``inputs``, the digest of all that the irradiance
    depends on, a later run continues. It has the slabs of the first run, whatever its ``memory``.
    """

    def __init__(
        self,
        sigma_t: MappedField,
        folder: Path,
        memory: int,
        connection: Connection,
        environment: Environment,
        inputs: str,
    ) -> None:
        self._connection, self._environment = connection, environment
        settings = [inputs, PAIRS, FEWEST_SLABS, environment.variant, environment.software]
        # Nothing is read that workers of an earlier run, of other inputs, may still be writing.
        digest = hashlib.sha256(json.dumps(settings).encode()).hexdigest()
        own = folder.resolve() / digest[:DIGITS]
        # All files there are of runs, also where a command was killed while it removed them.
        self._results = Results(own, "finished", names=["*"])
        folder.mkdir(exist_ok=True)
        self._results.begin(resume=True)
        super().__init__(sigma_t, own, _memory_of_first_run(own, memory))

    @property
    def has_folder(self) -> bool:
        """Whether the folder of the working files is there: a command that finishes removes it."""
        return self._results.has_folder

    def file(self, name: str, dtype: np.dtype = np.float32, channels: int = 1) -> BrickFile:
        """Create or open a working file for values of all voxels."""
        return BrickFile(self._folder / name, self.grid.shape, dtype, channels)

    def _irradiance(
        self,
        name: str,
        ordinates: PairsOfOrdinates,
        incoming: np.ndarray,
        source: BrickFile | None,
        progress: Progress,
    ) -> BrickFile:
        channels = incoming.shape[2]
        is_new = not (self._folder / name).exists()
        file = self.file(name, channels=channels)
        plan = SweepPlan(
            name,
            self.grid.shape,
            self.grid.to_world,
            self._tracks.quantum,
            self._memory,
            ordinates,
            incoming,
            "" if source is None else source.path.name,
        )
        plan.save(self._folder)
        jobs, used = self._jobs(plan)
        # A job of `add_axes` has written to the file, which may have been lost since.
        missing = [
            job for job in jobs if not self._results.has(job) or (is_new and job.kind == "add_axes")
        ]
        self._check(file, jobs, missing, used)
        file.close()

        def store(job: Job, outcome: Outcome) -> None:
            self._results.store(job, outcome)
            for read in used.get(job.name, ()):
                (self._folder / read).unlink(missing_ok=True)

        failed = Dispatch(self._connection, missing, store).run()
        if failed:
            first, reason = next(iter(failed.items()))
            raise IrrcacheError(
                f"{first}: {reason.rstrip('.')}; {len(jobs) - len(failed)} of {len(jobs)} jobs are "
                "finished and kept. Remove the cause and start the command again with --resume."
            )
        for path in self._folder.glob(f"{name}-*.npy"):
            path.unlink(missing_ok=True)
        if source is not None:
            source.path.unlink(missing_ok=True)
        # Opened now, since network file systems show what others have written on opening.
        return self.file(name, channels=channels)

    def _check(
        self,
        file: BrickFile,
        jobs: list[Job],
        missing: list[Job],
        used: dict[str, list[str]],
    ) -> None:
        """Raise IrrcacheError if what finished jobs have written to working files, and is still
        needed by the ``missing`` ones or by the command, has been changed since.

        ``file`` is that of the sweep, which its last jobs write; ``used`` as `_jobs` returns it.
        """
        rest, written = {job.name for job in missing}, {}
        for job in (job for job in jobs if job.name not in rest):
            digests = self._results.digests(job)
            if job.kind == "add_axes":
                found = file.digest(*job.arguments["slices"])
                require_unchanged(file.path, digests.get(file.path.name, ""), found)
            else:
                written |= digests
        needed = {name for job in missing for name in used.get(job.name, ())}
        if any(job.kind == "add_axes" for job in missing):
            needed |= {name for name in written if name.endswith(FOUND)}
        for name in sorted(needed & written.keys()):
            require_unchanged(self._folder / name, written[name])

    def _jobs(self, plan: SweepPlan) -> tuple[list[Job], dict[str, list[str]]]:
        """Return the jobs of a sweep, and the files by job that nothing else reads."""
        sweeps = plan.sweeps(self._folder)
        numbers = [
            (len(plan.slabs(sweep)), len(list(even_slabs(sweep.pair_count, PAIRS))))
            for sweep in sweeps
        ]
        steps = by_length_of_way(list(steps_of(plan.name, numbers)))
        folder = str(self._folder)
        jobs = [
            Job(
                step.name,
                "cross_slabs",
                {"folder": folder, "step": asdict(step)},
                self._environment,
                step.after,
            )
            for step in steps
        ]
        last = tuple(step.name for step in steps if step.completes)
        for first, end in slices_of(self.grid.shape):
            arguments = {"folder": folder, "sweep": plan.name, "slices": [first, end]}
            name = f"{plan.name}-slices-{first}-{end - 1}"
            jobs.append(Job(name, "add_axes", arguments, self._environment, last))
        return jobs, {step.name: step.reads for step in steps}


def _memory_of_first_run(folder: Path, memory: int) -> int:
    """Return the memory for which an earlier run has chosen its slabs; ``memory`` without one."""
    for file in folder.glob(f"*{PLAN}"):
        return SweepPlan.load(folder, file.name.removesuffix(PLAN)).memory
    return memory
