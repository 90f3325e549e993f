"""The irradiance caches of the displayed scene and their progressive refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.builder import CacheBuilder, CacheSettings
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.pipeline.progressive import FIRST, OPENING
from mitsuba_irrcache.render.camera import ClosedFormCameraRays, TracedCameraRays, camera_rays_of
from mitsuba_irrcache.scene.medium_probe import medium_at

#: Caches with more voxels than this are preceded by one of `COARSE` voxels along its longest side,
#: so that changed illumination is displayed at once.
MANY_VOXELS, COARSE = 48**3, 32
#: Directions per batch of `sweep`; larger batches would delay the first image.
DIRECTIONS = 32
#: The same in emissive media, whose voxels trace rays in each direction, without interruption.
EMISSIVE_DIRECTIONS = 8


@dataclass(frozen=True)
class MarchSettings:
    """Ray-marching settings, named as the plugin's properties."""

    hide_emitters: bool = False
    quadrature: str = "exponential"
    step: float = 1.0


class CacheSnapshot:
    """An immutable copy of the caches for camera rays, unaffected by further refinement."""

    def __init__(
        self,
        scene: mi.Scene,
        parts: list[CachedMedium],
        camera_rays: ClosedFormCameraRays | TracedCameraRays,
        layered: bool,
    ) -> None:
        self.scene, self.camera_rays, self.layered = scene, camera_rays, layered
        self._parts = parts
        one = isinstance(camera_rays, ClosedFormCameraRays)
        self._projections = [camera_rays.projection] if one else camera_rays.projections
        self._steps = [p.step for p in self._projections]

    def stride(self, factor: float) -> None:
        """Set the factor by which steps along rays are longer than the integrator's setting."""
        for projection, step in zip(self._projections, self._steps, strict=True):
            projection.step = step * dr.opaque(mi.Float, factor)
            dr.eval(projection.step)

    def medium_at(self, position: np.ndarray) -> object | None:
        """Return the medium that contains a camera at ``position`` (3), or None."""
        medium = self._parts[0].medium
        if medium.is_isolated:
            return medium if medium.boundary.contains(position) else None
        pointer = medium_at(self.scene, position)
        return None if (pointer == None)[0] else pointer  # noqa: E711


class Light:
    """The irradiance caches of a ``scene``; each `refine` improves them.

    ``pause`` is called repeatedly during refinement and may raise an exception to interrupt it.
    """

    def __init__(
        self,
        scene: mi.Scene,
        settings: CacheSettings,
        march: MarchSettings,
        pause: Callable[[], None] | None = None,
    ) -> None:
        self.scene, self.settings, self.march = scene, settings, march
        emission, factor = scene.integrator().emission
        samples = DIRECTIONS if emission is None else EMISSIVE_DIRECTIONS
        settings = replace(settings, samples=samples, with_error=False)
        self._builder = CacheBuilder(settings, emission, factor)
        self._builder.pause.action = pause
        self._builder.early = True
        #: the media of the scene; empty before `prepare`
        self.parts: list[CachedMedium] = []
        # the media with coarse caches, until their own have been refined; empty if not needed
        self._coarse: list[CachedMedium] = []
        #: incremented whenever better caches are available
        self.revision = 0
        #: seconds spent in the solver
        self.seconds = 0.0
        #: whether the last refinement raised an exception
        self.failed = False
        self._snapshots: dict[tuple[bool, bool], tuple[int, CacheSnapshot]] = {}

    @property
    def samples(self) -> int:
        """Return the samples per voxel."""
        return self._builder.done

    @property
    def solver(self) -> str:
        return self.parts[0].solver.name if self.parts else ""

    @property
    def error(self) -> float:
        """Return the relative standard error of the caches, or NaN if it is not known yet."""
        return self._builder.relative_error

    @property
    def is_preliminary(self) -> bool:
        """Return whether coarse caches are displayed, or none yet."""
        return bool(self._coarse)

    @property
    def is_dark(self) -> bool:
        """Return whether the caches are zero and need no refinement."""
        return bool(self._builder.parts) and self._builder.is_dark

    @property
    def is_emissive(self) -> bool:
        """Return whether the media emit, which ``volpath`` does not render."""
        return any(part.medium.emission is not None for part in self.parts)

    def prepare(self) -> None:
        """Find the media of the scene, and create empty caches, at first coarse ones if the others
        would delay the first image.

        Raises IrrcacheError for scenes that cannot be rendered and for scenes without a medium.
        """
        self.parts = self._builder.describe(self.scene)
        if not self.parts:
            raise IrrcacheError(
                "view: the scene has no medium that a camera could see; irrcache render shows it."
            )
        if self._is_slow:
            self._coarse = [self._started_coarse(part) for part in self.parts]
        else:
            self._builder.fit(self.scene)

    def refine(self) -> None:
        """Refine the caches once; the first refinement may use a coarse grid."""
        started = perf_counter()
        self.failed = True
        try:
            self._refine()
        finally:
            self.seconds += perf_counter() - started
        self.failed = False

    def _refine(self) -> None:
        builder = self._builder
        if self._coarse and not self.revision:
            for part in self._coarse:
                if not part.is_dark:
                    part.refine(self.scene, part.cache.batch, False, None)
        else:
            if self._coarse:
                builder.fit(self.scene)
                self.parts = builder.parts
            if not builder.is_dark:  # an image without emitters shows emission and transmittance
                self._refine_fully()
            self._coarse = []
        self.revision += 1

    def _refine_fully(self) -> None:
        """Refine the caches of the whole resolution."""
        builder = self._builder
        done, batch = builder.done, self.parts[0].cache.batch if self.parts[0].cache else 0
        if builder.has_preview and done < OPENING:
            builder.samples = max(2 * done, FIRST)
        else:
            builder.samples = done + batch
        builder.update(self.scene, lambda *_: builder.pause())

    @property
    def _is_slow(self) -> bool:
        """Return whether coarse grids would be much faster."""
        grids = [p.grid for p in self.parts if not p.solver.has_preview and p.grid is not None]
        return any(grid.voxel_count > MANY_VOXELS for grid in grids)

    def _started_coarse(self, part: CachedMedium) -> CachedMedium:
        """Return a medium with an empty cache on a coarse grid."""
        settings = replace(part.settings, resolution=COARSE)
        solver = part.solver, "a first look"
        coarse = CachedMedium(
            self.scene, part.description, part.medium, settings, solver, "", self._builder.pause
        )
        coarse.start(self.scene)
        return coarse

    def snapshot(self, layered: bool, with_error: bool) -> CacheSnapshot:
        """Return a copy of the current caches; `camera_rays_of` computes the requested layers."""
        key = layered, with_error
        known = self._snapshots.get(key)
        if known is None or known[0] != self.revision:
            parts = self._coarse or self.parts
            s = self.march
            camera_rays = camera_rays_of(
                parts, self.settings, s.hide_emitters, s.quadrature, s.step, layered, with_error
            )
            known = self.revision, CacheSnapshot(self.scene, parts, camera_rays, layered)
            # Release the fields of the previous caches: they are as large as the cache itself.
            self._snapshots = {k: v for k, v in self._snapshots.items() if v[0] == self.revision}
            self._snapshots[key] = known
        return known[1]


@dataclass(frozen=True)
class Status:
    """The progress of the cache refinement."""

    samples: int = 0
    error: float = float("nan")
    seconds: float = 0.0
    solver: str = ""
    improving: bool = True
    message: str = ""

    @classmethod
    def of(cls, light: Light | None, improving: bool, message: str) -> Status:
        """Return the status of ``light``, which may be None."""
        if light is None:
            return cls(improving=improving, message=message)
        error = light.error if light.samples else float("nan")
        return cls(light.samples, error, light.seconds, light.solver, improving, message)
