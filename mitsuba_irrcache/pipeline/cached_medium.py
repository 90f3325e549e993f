"""One medium of a scene, and the cache of the light in it."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis, sources_of
from mitsuba_irrcache.cache.direct_light import direct_lights_of
from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import active_voxels, marked
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.machine.memory import give_back, require_memory
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.defaults import (
    SMALL_BORDER_ERROR,
    border_error,
    choose_grid,
    choose_samples,
    follows_straight_ways,
    needs_no_cache,
    swept_samples,
    warn_of_dense_border,
)
from mitsuba_irrcache.scene.fingerprint import differing, digests
from mitsuba_irrcache.solvers.discrete_ordinates import solver as sn_solver
from mitsuba_irrcache.solvers.discrete_ordinates.anisotropic import AnisotropicSweep, least_batch
from mitsuba_irrcache.solvers.discrete_ordinates.solver import Sweep
from mitsuba_irrcache.solvers.half_space import HalfSpace
from mitsuba_irrcache.solvers.path import solver as path_solver

#: Held by the thread that writes a cache file.
_SAVING = Lock()


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


class CachedMedium:
    """A medium with its cache, which is None where no light needs caching (``max_depth`` below
    2).

    ``solver`` is what `defaults.choose_solver` says; ``name`` tells the medium from the
    scene's others, "" where there are none; ``pause`` is as in `CacheBuilder`.
    """

    def __init__(
        self,
        scene: mi.Scene,
        medium: MediumGrid,
        settings: CacheSettings,
        solver: tuple[str, str],
        name: str,
        edited: bool,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        self.settings, self.medium, self.name = settings, medium, name
        self._pause = pause
        #: samples per voxel in the file
        self.saved_samples = 0
        #: path or sweep, and why
        self.solver, self._reason = solver
        self._opening: path_solver.Opening | None = None
        self._preview: IrradianceCache | None = None
        self._sweep: Sweep | None = None
        self.cache: IrradianceCache | None = None
        #: closed form in place of a cache; None where there is one, or nothing to be computed
        self.half_space: HalfSpace | None = None
        if settings.max_depth in (0, 1):
            return
        reason = needs_no_cache(scene, medium, settings.max_depth, settings.resolution)
        if reason is None:
            self.cache = self._start_cache(scene, edited)
            return
        mi.Log(
            mi.LogLevel.Info,
            f'irrcache: medium "{medium.name}" is {reason}: its radiance is that of a half-space, '
            "no cache is built. Set resolution for a cache.",
        )
        self.half_space = HalfSpace(scene, medium, settings.max_depth)

    @property
    def label(self) -> str:
        """Before a message about it."""
        return f'medium "{self.name}": ' if self.name else ""

    @property
    def file(self) -> str:
        """Its own where there are several media, with the medium's name in it."""
        if not self.settings.file or not self.name:
            return self.settings.file
        file = Path(self.settings.file)
        own = re.sub(r"[^\w.-]", "_", self.name)  # a name in a scene is no path
        return str(file.with_name(f"{file.stem}.{own}{file.suffix}"))

    @property
    def shown(self) -> IrradianceCache | None:
        """The cache, or the incomplete batches that stand for it so far."""
        return self._preview or self.cache

    def target(self, samples: int) -> int:
        """Samples per voxel to build up to where ``samples`` (0: chosen) are wanted, a multiple of
        the cache's batch.
        """
        batch = self.cache.batch
        samples = samples or choose_samples(self.cache, self.solver, self.medium)
        return max(-(-samples // batch), 2 if self.settings.with_error else 1) * batch

    @property
    def is_dark(self) -> bool:
        """Whether the cache is zero, or there is none: samples change nothing."""
        return self.cache is None or not self.cache.active_count

    def refine(
        self, scene: mi.Scene, samples: int, early: bool, progress: path_solver.Progress | None
    ) -> bool:
        """Fills the cache up to ``samples`` (0: chosen), the first two batches in pieces if
        ``early``; whether anything may have changed.
        """
        if early and self.solver == "path" and not self.is_dark and not self.cache.samples:
            return self._open(scene, samples, progress)
        closed = self._opening is not None and not early and self.close()
        if self.cache is None or self.cache.samples >= self.target(samples):
            return closed
        self._fill(scene, self.target(samples) - self.cache.samples, progress)
        if not self.is_dark and not self.cache.is_finite:
            self.cache, self._sweep = self._start_cache(scene, edited=False), None
            raise IrrcacheError(
                f"irrcache: {self.label}the light in the medium is not finite in single precision; "
                "lower the radiance of the emitters, and look through sigma_t and albedo."
            )
        return True

    def close(self) -> bool:
        """Drops incomplete batches; whether there were any."""
        dropped = self._preview is not None
        self._opening = self._preview = None
        return dropped

    def _start_cache(self, scene: mi.Scene, edited: bool) -> IrradianceCache:
        settings, medium = self.settings, self.medium
        grid, size_reason = choose_grid(medium, settings.resolution, self.solver)
        directional = None
        if medium.phase is not None:
            directional = AngularBasis(medium.phase, sources_of(scene))
        moments = directional.count if directional is not None else 0
        together = sn_solver.swept_together(medium, grid.voxel_count)
        _check_memory(grid, self.solver, settings.max_depth, settings.with_error, moments, together)
        warn_of_dense_border(medium, grid)
        active, survey = active_voxels(medium, grid), None
        if medium.surroundings is not None and self.solver == "path":  # else nothing is among them
            survey = medium.surroundings.survey(scene, grid, medium)
            active = dr.compress(survey.reach & marked(grid, active))
        dark = not scene.emitters() and medium.emission is None
        if medium.albedo.maximum == 0 or dark:
            active = mi.UInt32()
        mi.Log(
            mi.LogLevel.Info,
            f"irrcache: {self.label}solver {self.solver} ({self._reason}); cache of "
            f"{' x '.join(map(str, grid.shape[::-1]))} voxels ({size_reason}), {dr.width(active)} "
            f"of {grid.voxel_count} see the medium",
        )
        channels = 1 if mi.is_monochromatic else 3
        swept, depth = self.solver == "sweep", settings.max_depth
        batch = BATCH
        if swept:
            wanted = settings.samples or swept_samples(depth, medium)
            wanted = -(-wanted // 2) if settings.with_error else wanted
            least = sn_solver.BATCH if directional is None else least_batch(directional.order)
            batch = sn_solver.batch_of(wanted, least)
        cache = IrradianceCache(
            grid, active, channels, depth, batch=batch, correlated=swept, moments=moments
        )
        cache.survey, cache.directional = survey, directional
        dense = border_error(medium, grid) > SMALL_BORDER_ERROR
        if swept or follows_straight_ways(scene, medium, grid, active):
            cache.direct_lights = direct_lights_of(scene, medium, grid, active, dense, survey)
        cache.falloff = InverseSquareFactor.of(
            scene, grid, [light.emitter for light in cache.direct_lights]
        )
        self.saved_samples = 0
        if not self.file:
            return cache
        cache.fingerprint = self._fingerprint(scene, cache)
        return self._resume(cache, edited)

    def _fingerprint(self, scene: mi.Scene, cache: IrradianceCache) -> dict[str, str]:
        moments = f", moments {cache.moments}" if cache.moments else ""
        return digests(scene, self.medium) | {
            "settings": f"solver {self.solver}, max_depth {cache.max_depth}, "
            f"grid {cache.grid.shape[::-1]}{moments}"
        }

    def _resume(self, cache: IrradianceCache, edited: bool) -> IrradianceCache:
        """The cache on disk where it is of the same light; a foreign file is refused, never
        overwritten.
        """
        file = Path(self.file)
        if not os.path.exists(file):  # says no, where Path.exists may raise
            if not os.path.isdir(file.parent):
                raise IrrcacheError(
                    f'irrcache: cache_file "{file}": the folder "{file.parent}" does not exist.'
                )
            if not os.access(file.parent, os.W_OK | os.X_OK):
                raise IrrcacheError(
                    f'irrcache: cache_file "{file}": nothing can be written to the folder '
                    f'"{file.parent}"; name another one.'
                )
            return cache
        stored = IrradianceCache.load(file)
        others = differing(cache.fingerprint, stored.fingerprint)
        if not others:
            _check_like(cache, stored, file)
            mi.Log(mi.LogLevel.Info, f'irrcache: {stored.samples} samples per voxel from "{file}"')
            self.saved_samples = stored.samples
            stored.lie_like(cache)
            return stored
        if edited:
            mi.Log(
                mi.LogLevel.Warn,
                f'irrcache: the scene was edited ({", ".join(others)}): "{file}" keeps the '
                "light of before.",
            )
            cache.fingerprint = {}
            return cache
        detail = (
            f" ({stored.fingerprint.get('settings')} in the file, {cache.fingerprint['settings']} "
            "here)"
            if others == ["settings"]
            else ""
        )
        raise CacheFileError(
            f'irrcache: cache_file "{file}" belongs to another scene: {", ".join(others)} '
            f"differ{detail}. "
            "Delete the file, or give this scene a cache_file of its own."
        )

    def _open(self, scene: mi.Scene, samples: int, progress: path_solver.Progress | None) -> bool:
        """Adds to the first two batches up to ``samples`` in all; whether anything was added."""
        cache, settings = self.cache, self.settings
        if self._opening is None:
            self._opening = path_solver.Opening(
                scene, self.medium, cache, settings.seed, settings.rr_depth
            )
        size = min(samples // 2, cache.batch)
        if size <= self._opening.size:
            return False
        self._opening.grow(size, progress)
        if size == cache.batch:
            self._opening.fill(cache)
            self._opening = self._preview = None
        else:
            self._preview = IrradianceCache(
                cache.grid,
                cache.active,
                cache.channels,
                cache.max_depth,
                batch=size,
                moments=cache.moments,
            )
            self._preview.lie_like(cache)
            self._opening.fill(self._preview)
        return True

    def _fill(self, scene: mi.Scene, missing: int, progress: path_solver.Progress | None) -> None:
        settings, cache = self.settings, self.cache
        if self.solver == "sweep":
            if self._sweep is None:
                arguments = settings.seed, settings.rr_depth, self._pause
                kind = Sweep if cache.directional is None else AnisotropicSweep
                self._sweep = kind(scene, self.medium, cache, *arguments)
            self._sweep.refine(missing, progress)
        else:
            path_solver.refine(
                scene, self.medium, cache, missing, settings.seed, settings.rr_depth, progress
            )
        give_back(cache.grid.voxel_count)

    def save_as(self, scene: mi.Scene, file: str | Path) -> None:
        """Writes a copy of the cache that fits ``scene`` to a file of any name."""
        self.cache.fingerprint = self._fingerprint(scene, self.cache)
        self.cache.save(file)

    def save(self) -> None:
        """Writes the cache to its file, where it has one that has fewer samples, also by now: other
        processes may share it. The light is not lost with a file that cannot be written.
        """
        file, cache = self.file, self.cache
        if not file or cache is None or not cache.fingerprint:
            return
        if cache.samples <= self.saved_samples:
            return
        try:
            with _SAVING:  # no other thread writes the file between looking and writing
                if not self._is_ahead(file):
                    cache.save(file)
            self.saved_samples = cache.samples
        except IrrcacheError as error:
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: {self.label}the cache was not saved: {str(error).rstrip('.')}. It is "
                "used all the same.",
            )

    def _is_ahead(self, file: str) -> bool:
        """Whether another process has written as many samples of the same light meanwhile. Raises
        CacheFileError if it is other light.
        """
        if not Path(file).exists():
            return False
        fingerprint, samples = IrradianceCache.description_of(file)
        if differing(fingerprint, self.cache.fingerprint):
            raise CacheFileError(f'"{file}" has come to hold the light of another scene')
        return samples >= self.cache.samples


def _check_like(cache: IrradianceCache, stored: IrradianceCache, file: Path) -> None:
    """Raises CacheFileError if a file says of itself what it is not."""
    alike = ("active_count", "channels", "correlated", "max_depth", "moments")
    unlike = [name for name in alike if getattr(cache, name) != getattr(stored, name)]
    if stored.grid.shared(cache.grid) is not cache.grid:
        unlike.append("grid")
    if unlike:
        raise CacheFileError(
            f'irrcache: cache_file "{file}" contradicts itself: {", ".join(unlike)} do not fit '
            "its fingerprint. Delete it."
        )


def _check_memory(
    grid: Grid,
    solver: str,
    max_depth: int,
    with_error: bool,
    moments: int = 0,
    together: bool = False,
) -> None:
    """Refuses a cache that cannot be held, with what it takes to make it and to look it up; for the
    field of its errors as much again (experiments/paper/memory). ``together``: all channels are
    swept at once.
    """
    channels = 1 if mi.is_monochromatic else 3
    if solver == "sweep":
        # Extinction with its neighbours, the light that lines carry, sums and spreads; and where
        # light is scattered again, the voxels' own and what is kept between sweeps.
        sets = channels if together else 1
        numbers = 5 + 2 * channels + (0 if max_depth == 2 else 5 + 12 * sets + 3 * channels)
        # Moments of one channel are solved for at a time.
        numbers += moments * (3 * channels + (4 if max_depth == 2 else 10))
    else:
        numbers = channels * (3 * 2 + 3) + 5  # sums in float64
        numbers += channels * moments * 3
    needed = 4 * grid.voxel_count * (numbers + 8) * (2 if with_error else 1)
    what = f"irrcache: a cache of {' x '.join(map(str, grid.shape[::-1]))} voxels"
    require_memory(needed, what, "lower resolution")
    if grid.voxel_count >= 2**32:
        raise IrrcacheError(f"{what} has 2^32 of them or more; lower resolution.")
