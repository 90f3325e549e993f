"""Studies: measurements of `irrcache compare` for several scenes, by many workers."""

from __future__ import annotations

import argparse
import copy
import tempfile
from collections import Counter
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path

from mitsuba_irrcache.compare.command import write_report
from mitsuba_irrcache.compare.processes import run_job
from mitsuba_irrcache.compare.reference import Reference
from mitsuba_irrcache.compare.results import Measurement, file_name
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.jobs import Environment, Job, scene_arguments
from mitsuba_irrcache.farm.results import Outcome, Results

#: Folders of a report that measurements are written to.
FOLDERS = ("measurements", "images", "logs")


class SceneStudy:
    """All integrators on one scene, with a report of its own in a folder."""

    def __init__(
        self, args: argparse.Namespace, job: dict, budgets: list[float], environment: Environment
    ) -> None:
        """``args`` are those of ``irrcache compare``, for this scene; ``job`` is the result of
        `common_job` for them.
        """
        self._args, self._budgets, self._environment = args, budgets, environment
        self._job, self._folder = job, Path(args.output)
        self._results = Results(self._folder)
        self._checked: dict = {}

    def alone(self, resume: bool) -> AbstractContextManager[None]:
        """Return a context for all that follows: no other command writes to the folder."""
        return self._results.alone(resume)

    def begin(self, resume: bool) -> list[Job]:
        """Check scene and integrators; return the jobs of measurements that remain."""
        self._results.begin(resume)
        with tempfile.TemporaryDirectory(prefix="irrcache-farm-") as scratch:
            wanted = self._job | {"integrators": [*self._args.integrator, self._args.reference]}
            files = Path(scratch) / "checked.json", Path(scratch) / "log"
            self._checked = run_job("check", wanted, *files)
        for name in FOLDERS:
            (self._folder / name).mkdir(exist_ok=True)
        good = {measurement.name for measurement in self.measurements if not measurement.error}
        return [job for job in self._jobs if job.arguments["name"] not in good]

    @cached_property
    def _jobs(self) -> list[Job]:
        where, jobs = (self._job["scene"], self._job["parameters"]), []
        for number, integrator in enumerate(self._args.integrator):
            scene = scene_arguments(*where, integrator)
            name = file_name(number, integrator)
            own = {"scene": scene, "job": self._job, "integrator": integrator, "name": name}
            own["budgets"] = self._budgets
            jobs.append(Job(f"{self._folder.name}-{name}", "measurement", own, self._environment))
        return jobs

    def store(self, job: Job, outcome: Outcome) -> None:
        """Store the measurements of one integrator."""
        self._results.store(job, outcome)

    @property
    def measurements(self) -> list[Measurement]:
        """Return the finished measurements, some of which may hold an error."""
        names = [job.arguments["name"] for job in self._jobs if self._results.has(job)]
        return [Measurement.load(self._folder / "measurements" / f"{name}.json") for name in names]

    def report(self, reference: Reference) -> Path:
        """Write the report of all finished measurements; return its file."""
        measurements = self.measurements
        if not measurements:
            raise IrrcacheError(f'there are no measurements in "{self._folder}" to report.')
        write_report(
            self._args, self._folder, measurements, reference, self._budgets, self._checked
        )
        return self._folder / "report.html"


def arguments_by_scene(args: argparse.Namespace) -> list[argparse.Namespace]:
    """Return the arguments of ``irrcache compare`` for each scene of a study, whose ``output`` is
    a folder in that of the study. Raises IrrcacheError where two scenes have the same name.
    """
    names = Counter(_name(scene) for scene in args.scenes)
    for name, count in names.items():
        if count > 1:
            raise IrrcacheError(
                f'{count} scenes are called "{name}", so that their reports would be in one '
                "folder; rename one of them."
            )
    found = []
    for scene in args.scenes:
        own = copy.copy(args)
        own.scene, own.output = scene, str(Path(args.output) / _name(scene))
        found.append(own)
    return found


def _name(scene: str) -> str:
    """Return the name of a scene: that of its folder where the file is called scene.xml."""
    path = Path(scene).resolve()
    return path.parent.name if path.stem == "scene" else path.stem
