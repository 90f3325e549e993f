"""Caches filled by many workers, with the same bits as by a single machine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.jobs import Environment, Job
from mitsuba_irrcache.farm.results import Checkpoints, OrderedParts, Outcome, Results
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.pipeline.stream_parts import missing_parts

#: Patterns of the names of parts that wait.
PARTS = ("batches-*.part", "medium-*-batches-*.part")


def waiting_parts(file: Path) -> Results:
    """Return the parts that wait beside the file of a cache."""
    return Results(file.with_name(f"{file.name}.parts"), names=PARTS)


class CacheRun:
    """The caches of a scene, and the batches that they lack.

    The file of a cache holds a number of first batches. Later ones wait as files in a folder beside
    it until those before them are there: parts are appended in the order of their numbers, whatever
    the order in which they arrive.
    """

    def __init__(
        self, scene: dict, loaded: mi.Scene, environment: Environment, file: Path, resume: bool
    ) -> None:
        """``scene`` is a result of `scene_arguments` for the ``loaded`` one.

        Raises IrrcacheError where no cache can be made, or if there are files, unless this is to
        ``resume``.
        """
        self._arguments, self._environment = scene, environment
        self._results = waiting_parts(file)
        self._scene = loaded
        integrator = loaded.integrator()
        if not hasattr(integrator, "cached_media"):
            raise IrrcacheError(f'"{scene["scene"]}" is rendered without a cache; add -i irrcache.')
        media = enumerate(integrator.cached_media(self._scene))
        #: media with a cache, by their indices in the scene
        self._media = {number: medium for number, medium in media if medium.cache is not None}
        if not self._media:
            raise IrrcacheError(f'no medium of "{scene["scene"]}" needs a cache.')
        for medium in self._media.values():
            medium.use_file(self._scene, file)
        present = [file for file in self.files if Path(file).exists()]
        present += [self._results.folder] if self._results.has_any else []
        if present and not resume:
            raise IrrcacheError(
                f'"{present[0]}" exists already; add --resume to continue it, or name another file.'
            )
        self._parts: dict[int, OrderedParts] = {}  # by the numbers of the media
        self._checkpoints = Checkpoints()

    @property
    def files(self) -> list[str]:
        """The files of the caches."""
        return [medium.file for medium in self._media.values()]

    def begin(self) -> list[Job]:
        """Append the stored parts of an earlier run, and return the jobs that remain."""
        self._results.begin(resume=True)
        for number, medium in self._media.items():
            if medium.is_dark:
                medium.refine(self._scene, medium.settings.samples, False, None)
                continue
            jobs = self._jobs(number, medium)
            self._parts[number] = OrderedParts(self._results, jobs, self._append)
            self._parts[number].advance()
        return [job for parts in self._parts.values() for job in parts.missing]

    def _jobs(self, number: int, medium: CachedMedium) -> Iterator[Job]:
        for first, count in missing_parts(medium):
            name = f"batches-{first}-{first + count - 1}"
            name = f"medium-{number}-{name}" if len(self._media) > 1 else name
            arguments = {
                "scene": self._arguments,
                "medium": number,
                "first": first,
                "count": count,
                "batch": medium.cache.batch,
                "file": f"{name}.part",
            }
            yield Job(name, "cache_part", arguments, self._environment)

    def _append(self, job: Job, file: Path) -> None:
        cache = self._media[job.arguments["medium"]].cache
        cache.append(IrradianceCache.load(file), job.arguments["first"])

    def store(self, job: Job, outcome: Outcome) -> None:
        """Store a part, and append all parts that are next in order to their caches."""
        self._parts[job.arguments["medium"]].store(job, outcome)
        if self._checkpoints.is_due:
            self.save()

    def save(self) -> None:
        """Write the caches, then remove the parts that are in them."""
        with self._checkpoints.measured():
            for medium in self._media.values():
                if medium.cache.samples > medium.saved_samples:
                    if not medium.is_ahead(medium.file):
                        medium.cache.save(medium.file)
                    medium.saved_samples = medium.cache.samples
        for parts in self._parts.values():
            parts.forget()

    def finish(self) -> bool:
        """Write the caches; return whether all parts are in them, and if so remove the folder."""
        self.save()
        if not all(parts.is_complete for parts in self._parts.values()):
            return False
        self._results.remove_all()
        return True
