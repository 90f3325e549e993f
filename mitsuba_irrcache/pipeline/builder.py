"""Build the caches of a scene, and detect which remain valid when the scene changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import perf_counter

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.cancellation import Pause
from mitsuba_irrcache.core.locks import ComputationLock
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.bake_emission import bake_emission
from mitsuba_irrcache.media.emission import Emission
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium, CacheSettings
from mitsuba_irrcache.pipeline.defaults import choose_solver
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.scene.fingerprint import SceneVersion
from mitsuba_irrcache.solvers.base import Progress as SolverProgress

__all__ = ["CacheBuilder", "CacheSettings", "Progress"]

#: Minimum seconds between two checkpoints, and maximum share of the time spent on writing.
CHECKPOINT_SECONDS = 30.0
CHECKPOINT_SHARE = 0.1

#: called with (stage, done, total)
Progress = Callable[[str, int, int], None]


@dataclass(eq=False)
class Stage:
    """Request of a progressive run: a number of ``samples`` per voxel (0: none yet), and whether
    the first two batches may be rendered while they are incomplete (``early``).
    """

    samples: int = 0
    early: bool = False


class CacheBuilder:
    """Keep the media and caches of one scene up to date without repeating work.

    Threads may share it: media and caches change only while its ``lock`` is held. Hold the lock to
    read several attributes consistently.
    """

    def __init__(
        self, settings: CacheSettings, emission: object = None, emission_scale: float = 1.0
    ) -> None:
        """``emission`` is the argument of `bake_emission`; None: media do not emit."""
        self.settings = settings
        self.lock = ComputationLock()
        self._emission, self._emission_scale = emission, emission_scale
        #: samples per voxel to build up to (0: the default); a higher number refines the caches
        self.samples = settings.samples
        #: increases with every change of a medium or a cache
        self.revision = 0
        #: the visible media of the scene, each with its cache
        self.parts: list[CachedMedium] = []
        self._version: SceneVersion | None = None
        # the media of this version before their caches are created, and whether the version before
        # it was of the same objects
        self._described: list[CachedMedium] = []
        self._edited = False
        # whether grids were kept because parameters carried gradients
        self._keeps_grids = False
        self._stages: list[Stage] = []
        self._checkpointed = 0  # number of active `checkpoints` contexts, which save the caches
        #: whether the first two batches may be rendered while incomplete; see `Solver.preview`
        self.early = False
        #: callback between kernel launches of a solver, which may launch other kernels; if it
        #: raises, the batch in progress is discarded
        self.pause = Pause()

    @property
    def medium(self) -> MediumGrid | None:
        """The first visible medium of the scene; None without one."""
        return self.parts[0].medium if self.parts else None

    @property
    def cache(self) -> IrradianceCache | None:
        """The cache of the first visible medium; None if it needs none."""
        return self.parts[0].cache if self.parts else None

    @property
    def solver(self) -> str:
        """Name of the solver of the first medium."""
        return self.parts[0].solver.name if self.parts else ""

    @property
    def has_preview(self) -> bool:
        """Whether the first two batches of the first medium may be shown while incomplete."""
        return bool(self.parts) and self.parts[0].solver.has_preview

    def update(self, scene: mi.Scene, progress: Progress | None = None) -> None:
        """Update media and caches to ``scene``."""
        with self.lock:
            self.fit(scene)
            for number, part in enumerate(self.parts):
                self._refine(scene, part, _progress_of_one(progress, number, len(self.parts)))

    def adopt(self, other: CacheBuilder) -> None:
        """Take over media and caches of another builder of the same scene, and its settings."""
        with self.lock:
            if self.parts is other.parts:
                return
            self.settings, self.samples = other.settings, other.samples
            self.parts, self._version = other.parts, other._version
            self._described = []
            self.revision += 1

    def fit(self, scene: mi.Scene) -> None:
        """Update the media to ``scene``; replace caches that are no longer valid by empty ones."""
        with self.lock:
            self._describe(scene)
            if not self._described:
                return
            # An exception may end this half-way.
            version, self._version = self._version, None
            parts, self._described = self._described, []
            for part in parts:
                part.start(scene, self._edited)
            self.parts, self._version = parts, version
            self.revision += 1

    def describe(self, scene: mi.Scene) -> list[CachedMedium]:
        """Update the media to ``scene`` and return them, without the caches that `fit` creates."""
        with self.lock:
            self._describe(scene)
            return self._described or self.parts

    def _describe(self, scene: mi.Scene) -> None:
        volume = self._emission if isinstance(self._emission, mi.Volume) else None
        version = SceneVersion(scene, volume, self._version)
        changes = version.changes(self._version) if self._version is not None else []
        if self._keeps_grids and not version.carries_gradients:
            changes = changes or ["no parameter carries gradients any more"]
        if self._version is None or changes:
            self._edited = bool(changes) and version.shares_objects_with(self._version)
            if self._edited:
                names = ", ".join(changes[:4])
                mi.Log(mi.LogLevel.Info, f"irrcache: the scene changed ({names}): new cache")
            # Keep grids while parameters carry gradients: another grid makes the objective jump.
            grids = _grids(self.parts) if self._edited and version.carries_gradients else {}
            self._keeps_grids = bool(grids)
            self.parts, self._described, self._version = [], [], None
            self.revision += 1
            description = compile_scene(scene, self._baked_emission(), self.settings.max_depth)
            media = description.visible
            wanted = (self.settings.solver, self.settings.max_depth, self.settings.resolution)
            settings = replace(self.settings, samples=self._wanted)
            self._described = [
                CachedMedium(
                    scene,
                    description,
                    medium,
                    settings,
                    choose_solver(scene, medium, *wanted),
                    medium.name if len(media) > 1 else "",
                    self.pause,
                    grids.get((medium.name, _data_shape(medium))),
                )
                for medium in media
            ]
        self._version = version

    def _baked_emission(self) -> Emission | None:
        if self._emission is None:
            return None
        return bake_emission(self._emission, self._emission_scale)

    def _refine(self, scene: mi.Scene, part: CachedMedium, progress: SolverProgress | None) -> None:
        changed = True  # an exception may end the solver half-way
        try:
            early = self.early or any(stage.early for stage in self._stages)
            changed = part.refine(scene, self._wanted, early, progress)
        finally:
            self.revision += changed
        if changed:
            dr.sync_thread()
            if not self._checkpointed:
                part.save()

    def save(self) -> None:
        """Write the caches to their files unless these have at least as many samples."""
        with self.lock:
            for part in self.parts:
                part.save()

    def close(self) -> None:
        """Reset `early`, and discard incomplete batches."""
        with self.lock:
            self.early = False
            if any(stage.early for stage in self._stages):
                return  # another thread shows incomplete batches
            for part in self.parts:
                self.revision += part.close()

    @contextmanager
    def stage(self) -> Iterator[Stage]:
        """Return a context whose `Stage` overrides ``samples`` while it is active."""
        stage = Stage()
        with self.lock:
            self._stages.append(stage)
        try:
            yield stage
        finally:
            with self.lock:
                self._stages.remove(stage)
                self.close()

    @property
    def is_untouched(self) -> bool:
        """Whether all caches are empty, and no progressive run is refining them."""
        return not self._stages and all(p.is_dark or not p.shown.samples for p in self.parts)

    @property
    def carries_gradients(self) -> bool:
        """Whether any parameter of the scene carries gradients."""
        return self._version is not None and self._version.carries_gradients

    @property
    def _wanted(self) -> int:
        """Current target of samples per voxel; 0: the default."""
        return max((stage.samples for stage in self._stages), default=0) or self.samples

    @property
    def done(self) -> int:
        """Minimum samples per voxel over the caches, including incomplete batches."""
        shown = [p.shown.samples for p in self._nonzero or self.parts if p.shown is not None]
        return min(shown, default=0)

    @property
    def saved_samples(self) -> int:
        """Minimum samples per voxel over the cache files."""
        return min((p.saved_samples for p in self._nonzero), default=0)

    @property
    def relative_error(self) -> float:
        """The largest relative error of the caches; 0 if all are zero."""
        return max((p.shown.relative_error for p in self._nonzero), default=0.0)

    @property
    def target(self) -> int:
        """Target samples per voxel of `update`, the maximum over the caches."""
        return max((p.target(self._wanted) for p in self.parts if p.cache is not None), default=0)

    @property
    def is_dark(self) -> bool:
        """Whether there are no caches or all are zero, so that samples have no effect."""
        return not self._nonzero

    @property
    def _nonzero(self) -> list[CachedMedium]:
        """The media whose caches are not known to be zero."""
        return [p for p in self.parts if not p.is_dark]

    @contextmanager
    def checkpoints(self) -> Iterator[Callable[[], None]]:
        """Return a context in which `update` does not save caches, for runs of many passes.

        It yields a function that saves them if the last save is long enough ago. They are also
        saved when the context is left.
        """
        ended, took = perf_counter(), 0.0

        def checkpoint() -> None:
            nonlocal ended, took
            started = perf_counter()
            if started - ended >= max(CHECKPOINT_SECONDS, took / CHECKPOINT_SHARE):
                self.save()
                ended = perf_counter()
                took = ended - started

        with self.lock:
            self._checkpointed += 1
        try:
            yield checkpoint
        finally:
            with self.lock:
                self._checkpointed -= 1
                self.save()


def _data_shape(medium: MediumGrid) -> tuple[int, ...]:
    """Return the shape of the extinction's grid, () for a homogeneous medium."""
    return () if medium.sigma_t.grid is None else medium.sigma_t.grid.shape


def _grids(parts: list[CachedMedium]) -> dict[tuple, Grid]:
    """Return the grids of caches by (name of the medium, shape of its data)."""
    return {
        (part.medium.name, _data_shape(part.medium)): part.cache.grid
        for part in parts
        if part.cache is not None
    }


def _progress_of_one(progress: Progress | None, number: int, count: int) -> SolverProgress | None:
    """Return a callback for the solver of cache ``number`` that reports the ``progress`` of all."""
    if progress is None:
        return None
    return lambda done, total: progress("cache", number * total + done, count * total)
