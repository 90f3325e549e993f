"""References for `irrcache compare`, rendered by many workers."""

from __future__ import annotations

import glob
from collections.abc import Iterator
from pathlib import Path

from mitsuba_irrcache.compare.reference import CHUNK, Reference, joined
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.jobs import Environment, Job
from mitsuba_irrcache.farm.results import Checkpoints, OrderedParts, Outcome, Results


def waiting_launches(path: Path) -> Results:
    """Return the launches that wait beside the file of a reference; create the folder of both."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IrrcacheError(
            f'cannot write to "{path.parent}" ({error.strerror}); name another folder by '
            "--references."
        ) from error
    return Results(path.with_name(f"{path.name}.parts"), names=[f"{glob.escape(path.stem)}-*.npz"])


class ReferenceRun:
    """The file of a reference, and the launches that it lacks.

    Launches have the seeds that one machine would use, and are added in its order.
    """

    def __init__(
        self, scene: dict, sensor: int, path: Path, spp: int, environment: Environment
    ) -> None:
        """``scene`` is a result of `scene_arguments`; ``path`` one of `reference_path`; ``spp`` are
        the samples per pixel of each half. An existing reference is continued.
        """
        self.path, self._results = path, waiting_launches(path)
        self.found = Reference.load(path) if path.exists() else None
        self._saved = 0 if self.found is None else self.found.spp
        self._results.begin(resume=True)
        jobs = self._jobs(scene, sensor, spp, environment)
        self._parts = OrderedParts(self._results, jobs, self._add)
        self._parts.advance()
        self._checkpoints = Checkpoints()
        self._is_finished = False

    @property
    def missing(self) -> list[Job]:
        """Return the jobs that no earlier run has finished."""
        return self._parts.missing

    def _jobs(self, scene: dict, sensor: int, spp: int, environment: Environment) -> Iterator[Job]:
        chunk = min(CHUNK, spp)
        for first in range(self._saved, spp, chunk):
            name = f"{self.path.stem}-{first}-{first + chunk - 1}"
            arguments = {"scene": scene, "sensor": sensor, "first": first, "spp": chunk}
            arguments["file"] = f"{name}.npz"
            yield Job(name, "reference_part", arguments, environment)

    def _add(self, job: Job, file: Path) -> None:
        self.found = joined(self.found, Reference.load(file))

    def store(self, job: Job, outcome: Outcome) -> None:
        """Store the samples of one launch, and add all that are next in order."""
        self._parts.store(job, outcome)
        if self._checkpoints.is_due:
            self.save()

    def save(self) -> None:
        """Write the reference, then remove the launches that are in it."""
        with self._checkpoints.measured():
            if self.found is not None and self.found.spp > self._saved:
                self.found.save(self.path)
                self._saved = self.found.spp
        self._parts.forget()

    def finish(self) -> bool:
        """Write the reference; return whether it is complete, and if so remove the folder."""
        if self._is_finished:  # another command may be adding more samples
            return True
        self.save()
        if not self._parts.is_complete:
            return False
        self._results.remove_all()
        self._is_finished = True
        return True
