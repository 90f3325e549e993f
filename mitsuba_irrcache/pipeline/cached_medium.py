"""One visible medium of a scene, and its cache."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import (
    AngularBasis,
    order_of_direct_light,
    warn_of_noise,
    warn_of_sharp_shadows,
)
from mitsuba_irrcache.cache.area_light import area_lights_of
from mitsuba_irrcache.cache.border import THIN, BorderProfile
from mitsuba_irrcache.cache.direct_light import DirectLight, direct_lights_of
from mitsuba_irrcache.cache.interpolation import Interpolation
from mitsuba_irrcache.cache.peak_depths import PeakDepths
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import marked
from mitsuba_irrcache.io.files import check_folder_of
from mitsuba_irrcache.lights.emitters import EmitterKind, position_of
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.lights.narrow_sources import MAX_LAMPS, sources_of
from mitsuba_irrcache.machine.memory import release_unused_memory, require_memory
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.pipeline.defaults import needs_no_cache
from mitsuba_irrcache.pipeline.neglected_moments import error_of_neglected_moments
from mitsuba_irrcache.scene.consistency import camera_rays
from mitsuba_irrcache.scene.description import SceneDescription
from mitsuba_irrcache.scene.fine_shadows import warn_of_fine_shadows
from mitsuba_irrcache.scene.fingerprint import differing, digests
from mitsuba_irrcache.scene.media_shares import why_shared
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses
from mitsuba_irrcache.solvers.base import Preview, Progress, Solver, SolverTask
from mitsuba_irrcache.solvers.grid_size import (
    SMALL_BORDER_ERROR,
    choose_grid,
    densest_border_depth,
    error_at_boundary,
    mean_extinction,
    warn_of_dense_border,
    warn_of_opaque_voxels,
    warn_of_unresolved_detail,
    warn_of_unresolved_objects,
)
from mitsuba_irrcache.solvers.half_space import HalfSpace

#: Optical depth of a medium along its longest side above which shadows in it are notable.
SMALL_DEPTH = 0.15
#: Relative variance of voxels above which a warning is logged: images around a lamp or a flame that
#: few directions meet are 0.4 % too dark with 0.03, 1 to 3 % with 0.12 (14 % in parts), 2 to 4 %
#: with 0.2, and 40 % with 0.7.
LARGE_VARIANCE = 0.06
#: Relative variance that paths from each voxel reach by default with up to MOST_SAMPLES times as
#: many samples, where the default number does not suffice.
SMALL_VARIANCE, MOST_SAMPLES = 0.03, 4
#: LARGE_VARIANCE for voxels around a sensor within the medium, weighted by the radiance that it
#: receives from them: images from within haze of ten mean free paths have errors of 2 to 5 % with
#: 0.1, and 4 to 15 % with 0.3.
LARGE_VARIANCE_AROUND_SENSOR = 0.06
#: Noise of directions that voxels share, above which a warning is logged. It is 1 to 1.5 % in most
#: scenes with surfaces; with 1.6 to 2 % parts of images are off by up to 6 %, with 2.5 to 4 % means
#: by 3 % and parts by 12 %.
LARGE_DIRECTION_NOISE = 0.016
#: Error of images due to neglected moments of the phase function, above which a warning is logged.
LARGE_ERROR_OF_MOMENTS = 0.025
#: Number of rays whose mean origin is the position of a sensor.
SENSOR_RAYS = 16
#: Lock of the thread that writes a cache file.
_SAVING = Lock()


@dataclass(frozen=True)
class CacheSettings:
    """Properties of the integrator on which caches depend; see the plugin's documentation."""

    max_depth: int = -1
    rr_depth: int = 5
    solver: str = "auto"
    resolution: int = 0
    samples: int = 0
    seed: int = 0
    file: str = ""
    with_error: bool = False  # whether a standard error is needed: at least two batches
    warns: bool = True  # of expected errors; a search and the viewer report these themselves


class CachedMedium:
    """A medium with its cache, which is None before `start`, and if none is needed (``max_depth``
    0 or 1, or a closed form).

    Args:
        solver: result of `choose_solver`.
        name: distinguishes the medium from other visible ones of the scene; "" without others.
        pause: as in `CacheBuilder`.
        grid: grid of the cache before an edit, which is kept while parameters carry gradients,
            because an objective would jump if it changed. None: choose a grid.
    """

    def __init__(
        self,
        scene: mi.Scene,
        description: SceneDescription,
        medium: MediumGrid,
        settings: CacheSettings,
        solver: tuple[type[Solver], str],
        name: str,
        pause: Callable[[], None] = lambda: None,
        grid: Grid | None = None,
    ) -> None:
        """Choose the grid of the cache.

        Raises IrrcacheError if the cache would exceed the available memory.
        """
        self.settings, self.medium, self.name = settings, medium, name
        self.description = description
        self._pause = pause
        #: samples per voxel in the file
        self.saved_samples = 0
        #: the solver, and why it was chosen
        self.solver, self._reason = solver
        self._opening: Preview | None = None
        self._preview: IrradianceCache | None = None
        self._kept_solver: Solver | None = None
        self._direction_noise = 0.0
        self._has_known_noise = self._has_known_order = False
        self.cache: IrradianceCache | None = None
        #: closed form that replaces the cache; None if there is a cache, or no scattering
        self.half_space: HalfSpace | None = None
        #: why the medium does not fill a box or sphere alone; None if it does, see `why_shared`
        self.shared: str | None = None
        #: grid of the cache; None if no cache is needed
        self.grid: Grid | None = None
        if settings.max_depth in (0, 1):
            return
        if grid is not None and grid.shared(Grid(grid.shape, medium.frame)) is grid:
            grid = None  # the medium has moved
        resolution = settings.resolution or (max(grid.shape) if grid is not None else 0)
        reason = needs_no_cache(scene, medium, settings.max_depth, resolution)
        if reason is None:
            self.grid, self._size_reason = self._choose_grid(grid)
            self._basis = _angular_basis(scene, medium)
            self._check_memory(self.grid, self._basis.count if self._basis is not None else 0)
            return
        mi.Log(
            mi.LogLevel.Info,
            f'irrcache: medium "{medium.name}" is {reason}: its radiance is that of a half-space, '
            "no cache is built. Set resolution for a cache.",
        )
        self.half_space = HalfSpace(scene, medium, settings.max_depth)

    def start(self, scene: mi.Scene, edited: bool = False) -> None:
        """Create the cache if one is needed: load it from its file, or leave it empty.

        ``edited``: whether the scene is an edited version of one that had a cache.
        """
        if self.grid is not None:
            self.cache = self._start_cache(scene, edited)

    @property
    def label(self) -> str:
        """Prefix of messages about this medium."""
        return f'medium "{self.name}": ' if self.name else ""

    @property
    def file(self) -> str:
        """File of the cache; with several visible media it contains the name of the medium."""
        if not self.settings.file or not self.name:
            return self.settings.file
        file = Path(self.settings.file)
        safe = re.sub(r"[^\w.-]", "_", self.name)  # an id may contain path separators
        return str(file.with_name(f"{file.stem}.{safe}{file.suffix}"))

    @property
    def shown(self) -> IrradianceCache | None:
        """Cache to render, or a preview of it while its first batches are incomplete."""
        return self._preview or self.cache

    def target(self, samples: int) -> int:
        """Return the target of samples per voxel: ``samples`` (0: the default), rounded up to a
        multiple of the cache's batch.
        """
        batch = self.cache.batch
        samples = samples or self.solver.default_samples(
            self.medium, self.cache.max_depth, self.cache.active_count
        )
        return max(-(-samples // batch), 2 if self.settings.with_error else 1) * batch

    @property
    def refinement(self) -> int:
        """Samples of the cache over their default number, rounded down to a power of two, at least
        1.
        """
        if self.is_dark:
            return 1
        return 1 << max(self.cache.samples // self._default_target, 1).bit_length() - 1

    @property
    def is_dark(self) -> bool:
        """Whether there is no cache or it is zero, so that samples have no effect."""
        return self.cache is None or not self.cache.active_count

    @property
    def cost(self) -> float:
        """Cost of the empty cache with its default samples, see `Solver.cost`."""
        if self.is_dark:
            return 0.0
        count = self.cache.active_count
        return self.solver.cost(self.medium, count, self.target(self.settings.samples))

    def refine(self, scene: mi.Scene, samples: int, early: bool, progress: Progress | None) -> bool:
        """Fill the cache up to ``samples`` per voxel (0: the default).

        If ``early``, the first two batches are built up over several calls, and `shown` is their
        preview. Returns whether the cache or the preview may have changed.
        """
        if early and self.solver.has_preview and not self.is_dark and not self.cache.samples:
            return self._open(scene, samples, progress)
        closed = self._opening is not None and not early and self.close()
        if self.cache is None or self.cache.samples >= self.target(samples):
            return closed
        self._fill(scene, self.target(samples) - self.cache.samples, progress)
        if not samples and self._default_target > self.cache.samples:
            self._fill(scene, self._default_target - self.cache.samples, progress)
        if not self.is_dark and not self.cache.is_finite:
            self.cache, self._kept_solver = self._start_cache(scene, edited=False), None
            raise IrrcacheError(
                f"irrcache: {self.label}the irradiance in the medium is not finite in single "
                "precision; "
                "lower the radiance of the emitters, and check sigma_t and albedo."
            )
        if not self.is_dark and self.settings.warns:
            self._warn_of_noise(scene)
            self._warn_of_neglected_moments(scene)
        return True

    @property
    def _default_target(self) -> int:
        """Default samples per voxel of a cache that has at least `target` of them: as many as
        reduce the variance of paths from each voxel to `SMALL_VARIANCE`, or as far as
        `MOST_SAMPLES` permits.
        """
        if self.is_dark or self.solver.is_correlated or not self.cache.has_own_errors:
            return self.target(0)
        needed = self.cache.samples * self.cache.relative_variance / SMALL_VARIANCE
        default = self.target(0)
        return self.target(int(min(max(needed, default), MOST_SAMPLES * default)))

    def _warn_of_neglected_moments(self, scene: mi.Scene) -> None:
        """Log a warning, once for a cache, if the order of the moments of the radiance is too low
        for what the sensors of the scene see.
        """
        phase = self.medium.phase
        if self._has_known_order or phase.is_isotropic or not self.medium.is_isolated:
            return
        self._has_known_order = True
        error = error_of_neglected_moments(scene, phase, self.settings.max_depth)
        if error > LARGE_ERROR_OF_MOMENTS:
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: {self.label}the image has an error of about {100 * error:.0f} %, in "
                f"parts of it three times as much: the cache represents its phase function by "
                f"{phase.order} Legendre moments, and little of the light of the environment is "
                'scattered towards the sensor. Use a broader phase function, or "volpath".',
            )

    def _warn_of_noise(self, scene: mi.Scene) -> None:
        """Log a warning, once for a cache, if voxels that are sampled alone have too much noise.

        Voxels around sensors of the scene have a limit of their own.
        """
        enough = self.cache.samples >= self.target(self.settings.samples)
        if self._has_known_noise or not enough:
            return
        self._has_known_noise = True
        if self._direction_noise > LARGE_DIRECTION_NOISE:
            # The solver "path" refuses sharp phase functions.
            sharp = self.cache.directional is not None and self.medium.original is not None
            other = "render with volpath" if sharp else "set solver to path"
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: {self.label}the irradiance has a noise of about "
                f"{100 * self._direction_noise:.1f} % that neighbouring voxels share, because few "
                "directions meet what emits: errors of several percent are expected in parts of "
                f"the image. Raise cache_spp (now {self.cache.samples}), or {other}.",
            )
        if not self.cache.has_own_errors:
            return
        variance = self.cache.relative_variance
        if variance > LARGE_VARIANCE:
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: {self.label}the irradiance of single voxels has a noise of "
                f"{100 * np.sqrt(variance):.0f} %, because few samples meet what emits: the image "
                f"is too dark where it is scattered. Raise cache_spp (now {self.cache.samples}).",
            )
            return
        variance = max(map(self._variance_seen_by, scene.sensors()), default=0.0)
        if variance > LARGE_VARIANCE_AROUND_SENSOR:
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: {self.label}the irradiance of voxels around the sensor has a noise of "
                f"{100 * np.sqrt(variance):.0f} %, because few paths reach an emitter from there: "
                f"errors of several percent are expected. Raise cache_spp (now "
                f"{self.cache.samples}).",
            )

    def _variance_seen_by(self, sensor: mi.Sensor) -> float:
        """Return the relative variance of the voxels around a sensor; 0 if it is not within the
        medium.
        """
        ray, _ = camera_rays(sensor, SENSOR_RAYS)
        position = np.array(ray.o, dtype=float).reshape(3, -1).mean(axis=1)
        if not self.medium.contains(mi.Point3f(*position.tolist()))[0]:
            return 0.0
        return self.cache.relative_variance_seen_from(position, mean_extinction(self.medium))

    def close(self) -> bool:
        """Discard incomplete batches; return whether there were any."""
        dropped = self._preview is not None
        self._opening = self._preview = None
        return dropped

    def _start_cache(self, scene: mi.Scene, edited: bool) -> IrradianceCache:
        """Load the cache from its file if it exists; otherwise create an empty one."""
        self._has_known_noise = self._has_known_order = False
        settings, medium, solver = self.settings, self.medium, self.solver
        grid, basis = self.grid, self._basis
        if settings.warns:
            warn_of_dense_border(medium, grid, settings.max_depth)
            if not warn_of_opaque_voxels(medium, grid, settings.max_depth):
                warn_of_unresolved_detail(medium, grid)
            warn_of_unresolved_objects(medium, grid)
            if not medium.is_isolated:
                longest = np.linalg.norm(medium.frame[:3, :3], axis=0).max()
                if mean_extinction(medium) * longest > SMALL_DEPTH:
                    name = f'medium "{medium.name}"'
                    warn_of_fine_shadows(scene, grid, self.description.emitters, name)
        whole = np.zeros(3, int), grid.resolution
        self.shared = None if medium.is_isolated else why_shared(scene, medium, grid, whole)
        active, classes = self._active_voxels(scene, grid)
        self._log_choices(grid, self._size_reason, dr.width(active))
        samples = settings.samples or solver.default_samples(
            medium, settings.max_depth, dr.width(active)
        )
        if basis is not None:
            name = f'medium "{medium.name}"'
            warn_of_noise(basis, samples, name)
            reason = self._why_shadows_are_too_bright()
            if reason is not None:
                warn_of_sharp_shadows(medium.phase.forward, name, reason)
        samples = -(-samples // 2) if settings.with_error else samples
        border_depth = densest_border_depth(medium, grid)
        direct_lights = self._direct_lights(scene, grid, active, classes, samples, border_depth)
        known = [light.emitter for light in direct_lights]
        falloff = InverseSquareFactor.of(scene, grid, known)
        if known:
            wide = [light.emitter for light in direct_lights if light.is_wide]
            basis = _angular_basis(scene, medium, known, wide)
        moments = basis.count if basis is not None else 0
        peak_depths = None
        if medium.original is not None and basis.sources and dr.width(active):
            peak_depths = PeakDepths(medium, grid, active, basis.sources)
        border = None
        # Refracted light is sampled: its noise would be amplified.
        if border_depth > THIN and not medium.refracts:
            border = BorderProfile(medium, grid, settings.max_depth == 2, border_depth)
        interpolation = Interpolation(basis, falloff, direct_lights, classes, peak_depths, border)

        def empty(fingerprint: dict[str, str]) -> IrradianceCache:
            return IrradianceCache(
                grid,
                active,
                1 if mi.is_monochromatic else 3,
                settings.max_depth,
                fingerprint,
                solver.batch_size(medium, settings.max_depth, samples, basis),
                solver.is_correlated,
                moments,
                interpolation,
            )

        self.saved_samples = 0
        if not self.file:
            return empty({})
        return self._resume(empty(self._fingerprint(scene, grid, moments)), edited) or empty({})

    def _why_shadows_are_too_bright(self) -> str | None:
        """Return why scattering into a forward peak counts as unscattered for the irradiance of
        surfaces, which makes shadows too bright; None if it does not.
        """
        description = self.description
        if self.medium.original is None or not description.has_surfaces:
            return None
        if len(description.visible) < len(description.media.grids):
            return "another medium is behind surfaces, so no irradiance is cached on surfaces"
        lamps = len(description.emitters.of(EmitterKind.AREA))
        if lamps > MAX_LAMPS:
            return f"there are {lamps} area emitters, and only {MAX_LAMPS} are treated as narrow"
        return None

    def _choose_grid(self, known: Grid | None) -> tuple[Grid, str]:
        """Return the grid of the cache, the ``known`` one if any, and why it has its size."""
        if known is None:
            return choose_grid(self.medium, self.settings.resolution, self.solver.size_rule)
        grid = known.shared(self.medium.sigma_t.grid, self.medium.albedo.grid)
        return grid, "as before, since parameters carry gradients"

    def _active_voxels(self, scene: mi.Scene, grid: Grid) -> tuple[mi.UInt32, VoxelClasses | None]:
        """Return the flat indices of the voxels whose irradiance is needed and not 0, and the
        classification of all voxels by surfaces and media (None without any among them).
        """
        medium = self.medium
        active = self.solver.active_voxels(scene, medium, grid)
        classes = self.solver.voxel_classes(scene, self.description.media, medium, grid, active)
        if classes is not None:
            active = dr.compress(classes.readable & marked(grid, active))
        if medium.albedo.maximum == 0 or not self._has_sources:
            active = mi.UInt32()
        return active, classes

    def _log_choices(self, grid: Grid, size_reason: str, active: int) -> None:
        mi.Log(
            mi.LogLevel.Info,
            f"irrcache: {self.label}solver {self.solver.name} ({self._reason}); cache of "
            f"{' x '.join(map(str, grid.shape[::-1]))} voxels ({size_reason}), {active} "
            f"of {grid.voxel_count} are active",
        )

    def _direct_lights(
        self,
        scene: mi.Scene,
        grid: Grid,
        active: mi.UInt32,
        classes: VoxelClasses | None,
        samples: int,
        border_depth: float,
    ) -> list[DirectLight]:
        """Return the emitters whose irradiance camera rays evaluate in closed form.

        ``samples`` is the number of samples per voxel of the cache, ``border_depth`` the largest
        optical depth of a voxel at the boundary.
        """
        medium, lights = self.medium, []
        if self.solver.knows_direct_lights(scene, medium, grid, active):
            dense = error_at_boundary(border_depth, medium, -1) > SMALL_BORDER_ERROR
            lights = direct_lights_of(scene, medium, grid, active, dense, classes, self._pause)
            lights += area_lights_of(scene, medium, grid, active, classes, samples)
        if medium.refracts:  # radiance of emitters outside reaches voxels only by refraction
            lights = [light for light in lights if _is_within(medium, light.emitter)]
        return lights

    def fingerprint(self, scene: mi.Scene) -> dict[str, str]:
        """Return the digests of all that the cache depends on, see `IrradianceCache`."""
        return self.cache.fingerprint or self._fingerprint(
            scene, self.cache.grid, self.cache.moments
        )

    @property
    def _has_sources(self) -> bool:
        """Whether the scene has any emitter, or this medium emits."""
        return bool(self.description.emitters) or self.medium.emission is not None

    def _check_memory(self, grid: Grid, moments: int) -> None:
        """Raise IrrcacheError if the cache would exceed the available memory while it is filled or
        looked up.

        The field of its errors doubles the memory (experiments/paper/memory).
        """
        channels, max_depth = 1 if mi.is_monochromatic else 3, self.settings.max_depth
        numbers = self.solver.numbers_per_voxel(
            self.medium, max_depth, moments, grid.voxel_count, channels
        )
        needed = 4 * grid.voxel_count * (numbers + 8) * (2 if self.settings.with_error else 1)
        if moments and not self.medium.is_isolated:
            # Moments of the radiance directly from area emitters, in single precision.
            order = order_of_direct_light(self.medium.phase)
            needed += 4 * grid.voxel_count * 2 * (order + 1) ** 2
        what = f"irrcache: a cache of {' x '.join(map(str, grid.shape[::-1]))} voxels"
        require_memory(needed, what, "lower resolution")
        if grid.voxel_count >= 2**32:
            raise IrrcacheError(f"{what} exceeds the limit of 2^32 - 1 voxels; lower resolution.")

    def _fingerprint(self, scene: mi.Scene, grid: Grid, moments: int) -> dict[str, str]:
        count = f", moments {moments}" if moments else ""
        return digests(scene, self.description.media, self.medium) | {
            "settings": f"solver {self.solver.name}, max_depth {self.settings.max_depth}, "
            f"grid {grid.shape[::-1]}{count}"
        }

    def _resume(self, cache: IrradianceCache, edited: bool) -> IrradianceCache | None:
        """Load the cache from its file if it belongs to the same scene; without a file return the
        empty ``cache``.

        Returns None if the file belongs to the scene before it was ``edited``: the new cache then
        has no file, so that this one is not overwritten. Raises CacheFileError for the file of
        another scene.
        """
        file = Path(self.file)
        if not os.path.exists(file):  # returns False where Path.exists may raise
            check_folder_of(file, "cache_file")
            return cache
        stored = IrradianceCache.load(file, cache.interpolation)
        others = differing(cache.fingerprint, stored.fingerprint)
        if not others:
            _check_like(cache, stored, file)
            mi.Log(mi.LogLevel.Info, f'irrcache: {stored.samples} samples per voxel from "{file}"')
            self.saved_samples = stored.samples
            return stored
        if edited:
            mi.Log(
                mi.LogLevel.Warn,
                f'irrcache: the scene was edited ({", ".join(others)}): "{file}" is not updated, '
                "and keeps the irradiance of the scene before the edit.",
            )
            return None
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

    def _open(self, scene: mi.Scene, samples: int, progress: Progress | None) -> bool:
        """Extend the preview of the first two batches to ``samples`` per voxel in total.

        Complete batches are moved to the cache. Returns whether any samples were added.
        """
        cache = self.cache
        if self._opening is None:
            self._opening = self.new_solver(scene).preview()
        size = min(samples // 2, cache.batch)
        if size <= self._opening.size:
            return False
        self._opening.grow(size, progress)
        if size == cache.batch:
            self._opening.fill(cache)
            self._opening = self._preview = None
        else:
            self._preview = cache.empty_copy(size)
            self._opening.fill(self._preview)
        return True

    def _fill(self, scene: mi.Scene, missing: int, progress: Progress | None) -> None:
        solver = self._kept_solver or self.new_solver(scene)
        if solver.is_kept:
            self._kept_solver = solver
        solver.use(scene)
        try:
            solver.refine(missing, progress)
        finally:
            solver.use(None)
        self._direction_noise = solver.direction_noise
        release_unused_memory(self.cache.grid.voxel_count)

    def new_solver(self, scene: mi.Scene, cache: IrradianceCache | None = None) -> Solver:
        """Return a solver that fills the cache, or another ``cache`` of the same voxels."""
        settings = self.settings
        return self.solver(
            SolverTask(
                scene,
                self.description,
                self.medium,
                cache or self.cache,
                settings.seed,
                settings.rr_depth,
                self._pause,
            )
        )

    def use_file(self, scene: mi.Scene, file: str | Path) -> None:
        """Use ``file`` as ``cache_file``: load the cache from it, or empty the cache if it does not
        exist.
        """
        self.settings = replace(self.settings, file=str(file))
        empty = self.cache.empty_copy()
        empty.fingerprint = self._fingerprint(scene, empty.grid, empty.moments)
        self.saved_samples = 0
        self.cache, self._kept_solver = self._resume(empty, edited=False), None

    def save_as(self, scene: mi.Scene, file: str | Path) -> None:
        """Write a copy of the cache, with the fingerprint of ``scene``, to a file of any name."""
        cache = self.cache
        cache.save(file, self._fingerprint(scene, cache.grid, cache.moments))

    def save(self) -> None:
        """Save the cache unless its file, possibly updated by another process, already holds at
        least as many samples. Log a warning if the file cannot be written.
        """
        file, cache = self.file, self.cache
        if not file or cache is None or not cache.fingerprint:
            return
        if cache.samples <= self.saved_samples:
            return
        try:
            with _SAVING:  # no other thread writes the file between check and writing
                if not self.is_ahead(file):
                    cache.save(file)
            self.saved_samples = cache.samples
        except IrrcacheError as error:
            mi.Log(
                mi.LogLevel.Warn,
                f"irrcache: {self.label}the cache was not saved: {str(error).rstrip('.')}. It is "
                "used nevertheless.",
            )

    def is_ahead(self, file: str) -> bool:
        """Return whether another process has written at least as many samples of the same scene.

        Raises CacheFileError if the file now belongs to another scene.
        """
        if not Path(file).exists():
            return False
        fingerprint, samples = IrradianceCache.description_of(file)
        if differing(fingerprint, self.cache.fingerprint):
            raise CacheFileError(
                f'"{file}" has been replaced by the cache of another scene; give each scene a file '
                "of its own"
            )
        return samples >= self.cache.samples


def _angular_basis(
    scene: mi.Scene,
    medium: MediumGrid,
    known: Sequence[mi.Emitter] = (),
    wide: Sequence[mi.Emitter] = (),
) -> AngularBasis | None:
    """Create the angular basis of anisotropic scattering in a scene; None if it is isotropic.

    The emitters ``known``, whose irradiance camera rays evaluate in closed form, are not among its
    sources; those that are ``wide`` are not narrow either.
    """
    if medium.phase.is_isotropic:
        return None
    sources, others = sources_of(scene, known)
    if wide:
        _, others = sources_of(scene, [emitter for emitter in known if emitter not in wide])
    return AngularBasis(medium.phase, sources, others)


def _is_within(medium: MediumGrid, emitter: mi.Emitter) -> bool:
    """Return whether an emitter lies in the boundary of a medium, by the centre of its shape if
    any.
    """
    shape = emitter.get_shape()
    if shape is None:
        return medium.boundary.contains(position_of(emitter))
    box = shape.bbox()
    return medium.boundary.contains(0.5 * (np.array(box.min) + np.array(box.max)))


def _check_like(cache: IrradianceCache, stored: IrradianceCache, file: Path) -> None:
    """Raise CacheFileError if the contents of a file contradict its fingerprint."""
    alike = ("active_count", "channels", "correlated", "max_depth", "moments")
    unlike = [name for name in alike if getattr(cache, name) != getattr(stored, name)]
    if stored.grid.shared(cache.grid) is not cache.grid:
        unlike.append("grid")
    if unlike:
        raise CacheFileError(
            f'irrcache: cache_file "{file}" is inconsistent: {", ".join(unlike)} do not fit its '
            "fingerprint. Delete it."
        )
