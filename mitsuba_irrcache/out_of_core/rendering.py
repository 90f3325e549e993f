"""Media whose extinction stays in a file: which scenes are supported, and their camera rays."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.errors import IrrcacheError, UnsupportedSceneError
from mitsuba_irrcache.grids.fields import ConstantField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import EmitterKind, illuminating, kind_of
from mitsuba_irrcache.machine.memory import available_memory
from mitsuba_irrcache.machine.versions import DISTRIBUTION, installed_version
from mitsuba_irrcache.media.medium import MediumGrid, axis_aligned
from mitsuba_irrcache.out_of_core.brick_file import BrickFile
from mitsuba_irrcache.out_of_core.irradiance_file import (
    IrradianceFile,
    check_replaceable,
    recorded,
    write,
)
from mitsuba_irrcache.out_of_core.scattering import ScatteredIrradiance, add
from mitsuba_irrcache.out_of_core.slab_march import MappedIrradiance, SlabProjection
from mitsuba_irrcache.out_of_core.slab_sweep import SlabSweep
from mitsuba_irrcache.out_of_core.survey import MappedField
from mitsuba_irrcache.out_of_core.volume_files import VolumeFile
from mitsuba_irrcache.out_of_core.volume_settings import VolumeSettings, check_settings, work_folder
from mitsuba_irrcache.pipeline.cached_medium import CacheSettings
from mitsuba_irrcache.render.camera import ClosedFormCameraRays
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.scene.description import SceneDescription
from mitsuba_irrcache.scene.fingerprint import SceneVersion, digests
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import Ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.extinction import DENSE
from mitsuba_irrcache.solvers.discrete_ordinates.incident import (
    DistantIllumination,
    samples_in_isolated_media,
)
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import OrdinateSet
from mitsuba_irrcache.solvers.sweep import DEFAULT_DIRECTIONS

#: Emitters whose radiance enters along tracks.
EMITTERS = (EmitterKind.CONSTANT_ENVIRONMENT, EmitterKind.ENVIRONMENT_MAP, EmitterKind.SUN)
#: Share of the free memory that is used by default; memory of it that Python, Mitsuba and kernels
#: need [bytes].
SHARE, BASE = 0.5, 700 << 20
#: Ordinates come in pairs, and batches in memory are multiples of this number.
MULTIPLE = 32

Progress = Callable[[str, int, int], None]
#: creates the sweeps of an extinction, given the digest of all inputs of the irradiance
BeginSweep = Callable[[MappedField, str], SlabSweep]


class MappedMedium:
    """The medium of a scene whose extinction stays in a file, and its irradiance."""

    def __init__(self, settings: CacheSettings, files: VolumeSettings, whole: bool) -> None:
        """Store the settings.

        ``whole`` states that only the radiance is requested, and that the medium is not emissive.
        """
        self._settings, self._files, self._whole = settings, files, whole
        self._version: SceneVersion | None = None
        #: states of the files from which the irradiance was computed
        self._states: list | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        self._medium: MediumGrid | None = None
        self._irradiance: tuple[BrickFile | IrradianceFile, np.ndarray] | None = None
        self._rays: ClosedFormCameraRays | None = None

    def camera_rays(
        self,
        scene: mi.Scene,
        hide_emitters: bool,
        quadrature: str,
        step: float,
        progress: Progress | None = None,
    ) -> ClosedFormCameraRays:
        """Create the camera rays for ``scene``.

        The irradiance is computed first if it was not yet, or if the scene or a file has changed.
        """
        version = SceneVersion(scene, None, self._version)
        paths = [path for path in (self._files.sigma_t, self._files.albedo) if path]
        states = [VolumeFile(path).opened_state for path in paths]
        changed = states != self._states or version.changes(self._version)
        if self._rays is None or changed:
            self._rays = None
            self.compute(scene, self._on_this_machine, progress)
            field = MappedIrradiance(*self._irradiance, self._medium.sigma_t.grid)
            arguments = self._medium, field, quadrature, step, self._memory
            projection = SlabProjection(*arguments)
            self._rays = ClosedFormCameraRays(projection, self._settings.max_depth, hide_emitters)
            self._version, self._states = version, states
        return self._rays

    @property
    def _memory(self) -> int:
        wanted = self._files.max_memory or int(SHARE * available_memory())
        return memory_beside_python(wanted)

    @property
    def max_memory(self) -> int:
        """The property ``max_memory`` of the integrator [bytes]; 0 if it is not set."""
        return self._files.max_memory

    def use_file(self, path: Path) -> None:
        """Replace ``irradiance_file``."""
        self._files = replace(self._files, irradiance=str(path))

    def compute(self, scene: mi.Scene, begin: BeginSweep, progress: Progress | None) -> None:
        """Compute the irradiance of a scene by the sweeps that ``begin`` creates.

        An ``irradiance_file`` that was computed from the same inputs is read instead.
        """
        check_settings(self._settings, self._files, self._whole)
        description = compile_scene(scene, max_depth=self._settings.max_depth)
        medium, files = _only_medium(scene, description), self._files
        sigma_t_file = VolumeFile(files.sigma_t)
        grid = Grid(sigma_t_file.shape, _placement(medium))
        sigma_t = MappedField(
            sigma_t_file, grid, _scale(medium), f'sigma_t of medium "{medium.name}"'
        )
        changes = {"sigma_t": sigma_t, "macrocells": sigma_t.macrocells()}
        if files.albedo:
            changes["albedo"] = _albedo(VolumeFile(files.albedo), grid, medium.name)
        mapped = [changes[name] for name in ("sigma_t", "albedo") if name in changes]
        inputs = self._inputs(scene, description, medium, mapped)
        self._medium = medium.replaced(**changes)
        if self._irradiance is not None:
            self._irradiance[0].close()
        known = recorded(Path(files.irradiance), inputs) if files.irradiance else None
        if known is not None:
            self._irradiance = known, np.ones(1 if mi.is_monochromatic else 3)
            mi.Log(mi.LogLevel.Info, f'irrcache: the irradiance is read from "{files.irradiance}"')
            return
        if files.irradiance:
            check_replaceable(Path(files.irradiance))
        _log_start(grid, sigma_t)
        sweep = begin(sigma_t, inputs)
        if sweep.is_dense:
            mi.Log(
                mi.LogLevel.Warn,
                f'irrcache: voxels of medium "{medium.name}" have optical depths of more than '
                f"{DENSE:g}: their irradiance is less accurate than that of a volume in memory.",
            )
        ordinates, colour = self._ordinates(scene)

        def report(done: int, total: int) -> None:
            if progress is not None:
                progress("cache", done, total)

        shown = range(ordinates.incoming.shape[-1])
        (arguments,) = OrdinateSet.uncollided([OrdinateSet(ordinates, shown)])
        found = sweep.uncollided(*arguments, report)
        if self._settings.max_depth < 0:
            directions, _, weights, offsets = ordinates.scattering()
            known = self._medium, found, colour, (directions, weights, offsets)
            scattering = ScatteredIrradiance(sweep, *known)
            scattering.solve(scene, description, replace(self._settings, samples=0))
            found = add(found, scattering.find(report), sweep.file("both", channels=found.channels))
        sweep.close()
        for field in mapped:
            field.file.require_unchanged()
        self._irradiance = found, colour
        if files.irradiance:
            write(Path(files.irradiance), found, colour, inputs)

    def _on_this_machine(self, sigma_t: MappedField, _: str) -> SlabSweep:
        self._folder = work_folder(self._files)
        return SlabSweep(sigma_t, Path(self._folder.name), self._memory)

    def _inputs(
        self,
        scene: mi.Scene,
        description: SceneDescription,
        medium: MediumGrid,
        mapped: list[MappedField],
    ) -> str:
        """Return the SHA-256 of everything that the irradiance depends on.

        ``medium`` is that of the scene, ``mapped`` are the fields in files.
        """
        settings, grid = self._settings, mapped[0].grid
        parts = [
            [field.digest for field in mapped],
            [grid.shape, grid.to_world.tolist(), _scale(medium)],
            [settings.max_depth, settings.samples, settings.seed, settings.resolution],
            digests(scene, description.media, medium),
            installed_version(DISTRIBUTION),
        ]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def _ordinates(self, scene: mi.Scene) -> tuple[Ordinates, np.ndarray]:
        """Return the ordinates and the factors of channels.

        For single scattering, the ordinates are those of the first batch of a cache in memory.
        """
        all_orders = self._settings.max_depth < 0
        samples = self._settings.samples or (1 if all_orders else 2) * DEFAULT_DIRECTIONS
        pairs = -(-samples // MULTIPLE) * MULTIPLE // 2
        rng = np.random.default_rng((self._settings.seed, 0))
        channels = 1 if mi.is_monochromatic else 3
        sampling = samples_in_isolated_media(self._settings.max_depth, True)
        illumination = DistantIllumination(scene, False, *sampling)
        if all_orders and self._medium.albedo.channels > 1:
            return illumination.ordinates(1, pairs, rng)[0], np.ones(channels)
        sets, colour = illumination.factored_ordinates(1, pairs, channels, rng)
        return sets[0], colour


def memory_beside_python(size: int) -> int:
    """Return the bytes that a process of this size can use for voxels."""
    return max(size - BASE, 64 << 20)


def _only_medium(scene: mi.Scene, description: SceneDescription) -> MediumGrid:
    """Return the medium of a scene whose extinction can stay in a file.

    Raises UnsupportedSceneError, naming the object, for all other scenes.
    """
    if len(description.media.grids) != 1 or not description.visible:
        _refuse(f"the scene has {len(description.media.grids)} media; it must have one")
    (medium,) = description.visible
    name = f'medium "{medium.name}"'
    if not medium.is_isolated:
        _refuse(f"there are surfaces or area emitters beside {name}, or it fills no box")
    if not medium.phase.is_isotropic:
        _refuse(f"{name} does not scatter isotropically")
    if medium.boundary.kind != "box":
        _refuse(f"{name} fills a {medium.boundary.kind} and not a box")
    if medium.sigma_t.channels != 1:
        _refuse(f"the extinction of {name} is coloured")
    for emitter in illuminating(scene):
        kind = kind_of(emitter)
        if kind not in EMITTERS:
            _refuse(f'emitter "{emitter.id()}" ({emitter.class_name()}) is not far away')
    return medium


def _refuse(reason: str) -> None:
    raise UnsupportedSceneError(
        f"irrcache: {reason}, which is not supported for a medium in sigma_t_file. Such scenes "
        "need one medium with isotropic scattering in a box, without surfaces, under environments "
        "and suns; reduce the volume to one that fits into memory for all others."
    )


def _placement(medium: MediumGrid) -> np.ndarray:
    """Return ``to_world`` of the voxels: that of the scene's grid, or the axis-aligned box."""
    linear = medium.boundary.to_world[:3, :3]
    ends = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1)
    corners = medium.boundary.frame[:3, :3] @ ends + medium.boundary.frame[:3, 3:]
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    if medium.sigma_t.grid is None:
        if (np.count_nonzero(np.abs(linear) > 1e-6 * np.abs(linear).max(), axis=0) != 1).any():
            _refuse(f'the box of medium "{medium.name}" is rotated')
        return axis_aligned(lower, upper)
    frame = medium.sigma_t.grid.to_world
    own = frame[:3, :3] @ ends + frame[:3, 3:]
    # Axes may be mirrored or exchanged: each corner is one of the other box.
    distances = np.linalg.norm(own[:, :, None] - corners[:, None, :], axis=0)
    if distances.min(axis=1).max() > 1e-5 * (upper - lower).max():
        _refuse(f'the grid of medium "{medium.name}" is not its box')
    return frame


def _scale(medium: MediumGrid) -> float:
    """Return the factor of the file's values: the scene's ``scale`` and constant extinction."""
    sigma_t = medium.sigma_t
    if isinstance(sigma_t, ConstantField):
        return sigma_t.maximum
    return float(sigma_t.scale[0])


def _albedo(file: VolumeFile, grid: Grid, name: str) -> MappedField:
    if file.shape != grid.shape:
        raise IrrcacheError(
            f'irrcache: albedo_file "{file.path}" has shape {file.shape}, and sigma_t_file '
            f"{grid.shape} (z, y, x); they must have the same voxels."
        )
    field = MappedField(file, grid, 1.0, f'albedo of medium "{name}"')
    if field.maximum > 1 + 1e-6:
        raise IrrcacheError(
            f'irrcache: the albedo in "{file.path}" reaches {field.maximum:g}; above 1 a medium '
            "creates energy. Clip it to [0, 1]."
        )
    return field


def _log_start(grid: Grid, sigma_t: MappedField) -> None:
    depth = sigma_t.maximum * grid.voxel_size.max()
    mi.Log(
        mi.LogLevel.Info,
        f"irrcache: {' x '.join(map(str, grid.shape[::-1]))} voxels, the densest of {depth:.2g} "
        "optical depths, are read from a file slab by slab",
    )
