"""From a scene to a filled cache, and when an old one still holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import drjit as dr
import mitsuba as mi

from .cache import BATCH, IrradianceCache, active_voxels
from .choices import SINGLE, choose_grid, choose_samples, choose_solver, warn_of_dense_border
from .errors import CacheFileError, IrrcacheError
from .fingerprint import Snapshot, digests
from .grid import Grid
from .medium import MediumGrid
from .memory import available_memory
from .scene import bake_scene
from .solvers import path, sweep

#: Between two checkpoints: at least so many seconds, and the time of writing over this share.
CHECKPOINT_SECONDS = 30.0
CHECKPOINT_SHARE = 0.1

#: called with (stage, done, total)
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class CacheSettings:
    """What a cache is asked to be; see the plugin's documentation."""

    max_depth: int = -1
    rr_depth: int = 5
    solver: str = "auto"
    resolution: int = 0
    samples: int = 0
    seed: int = 0
    file: str = ""
    with_error: bool = False  # enough samples for a standard error: two batches at least


class CacheBuilder:
    """Keeps the medium and the cache of one scene up to date, and does no work twice.

    ``medium`` is None for a scene without one; ``cache`` is None where no light needs caching (no
    medium, or ``max_depth`` below 2).
    """

    def __init__(self, settings: CacheSettings) -> None:
        self.settings = settings
        #: samples per voxel to build up to (0: chosen); a higher number refines the cache
        self.samples = settings.samples
        #: goes up with every change of ``medium`` or ``cache``
        self.revision = 0
        #: samples per voxel in the file
        self.saved_samples = 0
        self.medium: MediumGrid | None = None
        self.cache: IrradianceCache | None = None
        # Not the scene itself: it owns the integrator, and neither would ever be freed.
        self._scene_id = 0
        self._snapshot: Snapshot | None = None
        self._saves_when_filled = True
        #: whether the first two batches may be shown in pieces; see `path.Opening`
        self.early = False
        self._opening: path.Opening | None = None
        self._preview: IrradianceCache | None = None
        #: the solver of ``cache``: path or sweep
        self.solver = ""
        self._sweep: sweep.Sweep | None = None

    def update(self, scene: mi.Scene, progress: Progress | None = None) -> None:
        """Makes ``medium`` and ``cache`` fit ``scene``."""
        snapshot = Snapshot(scene)
        changes = snapshot.changes(self._snapshot) if self._snapshot is not None else []
        stale = self._snapshot is None or bool(changes)
        if stale:
            edited = bool(changes) and id(scene) == self._scene_id
            if edited:
                names = ", ".join(changes[:4])
                mi.Log(mi.LogLevel.Info, f"irrcache: the scene changed ({names}): new cache")
            self.medium = self.cache = self._snapshot = None
            self._opening = self._preview = self._sweep = None
            self.revision += 1
            self.medium = bake_scene(scene)
            if self.medium is not None and self.settings.max_depth not in (0, 1):
                self.cache = self._start_cache(scene, self.medium, edited)
            self._scene_id, self._snapshot = id(scene), snapshot
        opens = self.early and self.solver == "path"
        if opens and not self.is_dark and not self.cache.samples:
            self._open(scene, progress)
        elif self.cache is not None and self.cache.samples < self.target:
            self._fill(scene, progress)

    def close(self) -> None:
        """Ends `early`; incomplete batches are dropped."""
        if self._preview is not None:
            self.revision += 1
        self.early, self._opening, self._preview = False, None, None

    @property
    def shown(self) -> IrradianceCache | None:
        """The cache, or the incomplete batches that stand for it so far."""
        return self._preview or self.cache

    @property
    def target(self) -> int:
        """Samples per voxel that `update` builds up to, a multiple of the cache's batch."""
        samples, batch = self.samples or choose_samples(self.cache, self.solver), self.cache.batch
        return max(-(-samples // batch), 2 if self.settings.with_error else 1) * batch

    @property
    def is_dark(self) -> bool:
        """Whether the cache is zero, or there is none: samples change nothing."""
        return self.cache is None or not self.cache.active_count

    @contextmanager
    def checkpoints(self) -> Iterator[Callable[[], None]]:
        """For a cache that is filled in many passes: they do not save it while this lasts. The
        function that it gives does, when it is time; and its end does, however it comes.
        """
        ended, took = perf_counter(), 0.0

        def checkpoint() -> None:
            nonlocal ended, took
            started = perf_counter()
            if started - ended >= max(CHECKPOINT_SECONDS, took / CHECKPOINT_SHARE):
                self._save()
                ended = perf_counter()
                took = ended - started

        self._saves_when_filled = False
        try:
            yield checkpoint
        finally:
            self._saves_when_filled = True
            self._save()

    def _start_cache(self, scene: mi.Scene, medium: MediumGrid, edited: bool) -> IrradianceCache:
        settings = self.settings
        self.solver, reason = choose_solver(scene, settings.solver)
        grid, size_reason = choose_grid(medium, settings.resolution, self.solver)
        _check_memory(grid, self.solver, settings.max_depth, settings.with_error)
        warn_of_dense_border(medium, grid)
        active = active_voxels(medium, grid)
        if medium.albedo.maximum == 0 or not scene.emitters():
            active = mi.UInt32()
        mi.Log(
            mi.LogLevel.Info,
            f"irrcache: solver {self.solver} ({reason}); cache of "
            f"{' x '.join(map(str, grid.shape[::-1]))} voxels ({size_reason}), {dr.width(active)} "
            f"of {grid.voxel_count} see the medium",
        )
        channels = 1 if mi.is_monochromatic else 3
        swept, depth = self.solver == "sweep", settings.max_depth
        batch = sweep.batch_of(self.samples or SINGLE, depth) if swept else BATCH
        cache = IrradianceCache(grid, active, channels, depth, batch=batch, correlated=swept)
        self.saved_samples = 0
        if not settings.file:
            return cache
        cache.fingerprint = digests(scene, medium) | {
            "settings": f"solver {self.solver}, max_depth {settings.max_depth}, "
            f"grid {grid.shape[::-1]}"
        }
        return self._resume(cache, edited)

    def _resume(self, cache: IrradianceCache, edited: bool) -> IrradianceCache:
        """The cache on disk where it is of the same light; a foreign file is refused, never
        overwritten.
        """
        file = Path(self.settings.file)
        if not file.exists():
            if not file.parent.is_dir():
                raise IrrcacheError(
                    f'irrcache: cache_file "{file}": the folder "{file.parent}" does not exist.'
                )
            return cache
        stored = IrradianceCache.load(file)
        differing = [
            k for k in cache.fingerprint if stored.fingerprint.get(k) != cache.fingerprint[k]
        ]
        if not differing:
            mi.Log(mi.LogLevel.Info, f'irrcache: {stored.samples} samples per voxel from "{file}"')
            self.saved_samples = stored.samples
            return stored
        if edited:
            mi.Log(
                mi.LogLevel.Warn,
                f'irrcache: the scene was edited ({", ".join(differing)}): "{file}" keeps the '
                "light of before.",
            )
            cache.fingerprint = {}
            return cache
        detail = (
            f" ({stored.fingerprint.get('settings')} in the file, {cache.fingerprint['settings']} "
            "here)"
            if differing == ["settings"]
            else ""
        )
        raise CacheFileError(
            f'irrcache: cache_file "{file}" belongs to another scene: {", ".join(differing)} '
            f"differ{detail}. "
            "Delete the file, or give this scene a cache_file of its own."
        )

    def _open(self, scene: mi.Scene, progress: Progress | None) -> None:
        """Adds to the first two batches up to ``samples`` in all."""
        cache, settings = self.cache, self.settings
        if self._opening is None:
            self._opening = path.Opening(
                scene, self.medium, cache, settings.seed, settings.rr_depth
            )
        size = min(self.samples // 2, cache.batch)
        if size <= self._opening.size:
            return
        self._opening.grow(size, _of_the_cache(progress))
        self.revision += 1
        if size == cache.batch:
            self._opening.fill(cache)
            self._opening = self._preview = None
        else:
            self._preview = IrradianceCache(
                cache.grid, cache.active, cache.channels, cache.max_depth, batch=size
            )
            self._opening.fill(self._preview)

    def _fill(self, scene: mi.Scene, progress: Progress | None) -> None:
        settings, cache = self.settings, self.cache
        missing, progress = self.target - cache.samples, _of_the_cache(progress)
        try:
            if self.solver == "sweep":
                if self._sweep is None:
                    self._sweep = sweep.Sweep(scene, self.medium, cache, settings.seed)
                self._sweep.refine(missing, progress)
            else:
                path.refine(
                    scene, self.medium, cache, missing, settings.seed, settings.rr_depth, progress
                )
        finally:
            self.revision += 1  # the solver may have been stopped half-way
        dr.sync_thread()
        if self._saves_when_filled:
            self._save()

    def _save(self) -> None:
        """Writes the cache to its file, where it has one that has fewer samples."""
        file, cache = self.settings.file, self.cache
        if file and cache is not None and cache.fingerprint and cache.samples > self.saved_samples:
            cache.save(file)
            self.saved_samples = cache.samples


def _of_the_cache(progress: Progress | None) -> path.Progress | None:
    """``progress`` for a solver, which does not know its stage."""
    return None if progress is None else lambda *n: progress("cache", *n)


def _check_memory(grid: Grid, solver: str, max_depth: int, with_error: bool) -> None:
    """Refuses a cache that cannot be held, with what it takes to make it and to look it up; for the
    field of its errors as much again (experiments/memory).
    """
    channels = 1 if mi.is_monochromatic else 3
    if solver == "sweep":
        # Extinction with its neighbours, the light that lines carry, sums and spreads; and where
        # light is scattered again, the voxels' own and what is kept between sweeps.
        numbers = 5 + 2 * channels + (0 if max_depth == 2 else 12 + 3 * channels)
    else:
        numbers = channels * (3 * 2 + 3) + 5  # sums in float64
    needed = 4 * grid.voxel_count * (numbers + 8) * (2 if with_error else 1)
    available = available_memory()
    if needed > available or grid.voxel_count >= 2**32:
        sides = " x ".join(map(str, grid.shape[::-1]))
        raise IrrcacheError(
            f"irrcache: a cache of {sides} voxels needs {needed / 2**30:.1f} GiB, and "
            f"{available / 2**30:.1f} GiB are "
            "free; lower resolution."
        )
