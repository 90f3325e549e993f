"""The jobs on a worker: functions of JSON arguments that write files."""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.interpolation import PLAIN
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.cli.render import described
from mitsuba_irrcache.compare.command import measure_integrator
from mitsuba_irrcache.compare.reference import render_halves
from mitsuba_irrcache.errors import IrrcacheError, original_message
from mitsuba_irrcache.farm import volume_jobs
from mitsuba_irrcache.farm.jobs import (
    Environment,
    UnfitWorkerError,
    caches_of,
    contents_of,
    difference,
    software,
    source_digest,
)
from mitsuba_irrcache.farm.results import Outcome
from mitsuba_irrcache.io.images import write_image
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.machine.doctor import available_cores
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.machine.modules import import_modules
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium
from mitsuba_irrcache.pipeline.stream_parts import StreamParts

#: Held by the thread that works: a worker with several threads runs one job at a time, since Dr.Jit
#: uses all cores.
_WORKING = threading.Lock()


class _Kept:
    """A value that one job leaves for the next one, if that has the same scene."""

    def __init__(self) -> None:
        self.key, self.value = "", None

    def get(self, key: str, make: Callable[[], object]) -> object:
        """Return the value of the last job if it had the same ``key``, otherwise a new one."""
        if key != self.key:
            self.key, self.value = "", None  # released first
            self.value, self.key = make(), key
        return self.value


_SCENES, _CACHES = _Kept(), _Kept()


def run_job(kind: str, arguments: dict, environment: Environment) -> Outcome:
    """Run one job, and return its files or the reason why there are none."""
    from distributed import get_worker

    worker, started = get_worker().address, time.perf_counter()
    with _WORKING, tempfile.TemporaryDirectory(prefix="irrcache-farm-") as scratch:
        folder = Path(scratch)
        try:
            set_up(environment)
            digests = KINDS[kind](arguments, folder) or {}
        except UnfitWorkerError as error:
            return Outcome(worker, unfit=str(error))
        except Exception as error:
            said = original_message(error).removeprefix("irrcache: ") or type(error).__name__
            return Outcome(worker, error=said)
        files = {
            str(path.relative_to(folder)): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }
        return Outcome(worker, time.perf_counter() - started, files, digests)


def set_up(environment: Environment) -> None:
    """Prepare this process for jobs; raise UnfitWorkerError if it is of another kind."""
    for (name, wanted), (_, found) in zip(environment.software, software(), strict=True):
        if wanted != found:
            raise UnfitWorkerError(difference(name, found, wanted))
    try:
        if environment.variant.startswith("llvm"):
            require_llvm()
        if mi.variant() != environment.variant:
            mi.set_variant(environment.variant)
        mi.set_log_level(mi.LogLevel.Error)
        # With a single thread Mitsuba waits for ever when it reads an EXR file.
        threads = max(2, environment.threads or available_cores())
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)
        dr.eval(dr.arange(mi.Float, 4))
    except Exception as error:
        message = original_message(error)
        raise UnfitWorkerError(f"{environment.variant} cannot be used: {message}") from error
    try:
        import_modules(environment.modules)
    except IrrcacheError as error:
        raise UnfitWorkerError(str(error).rstrip(".")) from error
    for module, wanted in environment.sources:
        if source_digest(module) != wanted:
            raise UnfitWorkerError(
                f'it has imported another version of the module "{module}" than the command; give '
                "it the same files, and start it anew after they were edited"
            )


def cache_part(arguments: dict, folder: Path) -> None:
    """Compute consecutive batches of the cache of one medium."""
    number, batch = arguments["medium"], arguments["batch"]
    key = json.dumps([arguments["scene"], number, batch], sort_keys=True)

    def opened() -> StreamParts:
        scene = _loaded(arguments["scene"])
        return StreamParts(scene, scene.integrator().cached_media(scene)[number], batch)

    parts = _SCENES.get(key, opened)
    part = parts.compute(arguments["first"], arguments["count"])
    part.save(folder / arguments["file"])


def frame(arguments: dict, folder: Path) -> dict[str, str]:
    """Render an image; the caches of the last frame are used again where they fit.

    Returns the digests of the cache files of the scene: a frame does not depend on what it writes
    to them, but it does on what others write later.
    """
    scene = _loaded(arguments["scene"])
    integrator = scene.integrator()
    sensor, seed, spp = (arguments[name] for name in ("sensor", "seed", "spp"))
    if not getattr(integrator, "depends_on_view", True) and integrator.mapped_medium is None:
        if integrator.uses_cache(scene, sensor, spp):
            _prepare(scene)
    image = np.array(mi.render(scene, sensor=sensor, seed=seed, spp=spp))
    source, parameters = arguments["scene"]["scene"], arguments["scene"]["parameters"]
    about = described(scene, source, sensor, seed, spp) | {"parameters": json.dumps(parameters)}
    names = getattr(scene.integrator(), "aov_names", list)()
    write_image(folder / arguments["file"], image, about, names)
    return caches_of(arguments["scene"])


def _prepare(scene: mi.Scene) -> None:
    """Fill the caches of a scene with those of the last frame if all that they depend on agrees.

    The samples are the same as those that would be computed, so images do not depend on which
    worker renders which frame.
    """
    media = _with_caches_of_their_own(scene)
    for medium in media:
        medium.cache.fingerprint = medium.fingerprint(scene)
    settings = [
        (
            (m.settings.seed, m.settings.rr_depth, m.target(m.settings.samples)),
            (m.cache.batch, m.cache.fingerprint),
        )
        for m in media
    ]
    key = json.dumps(settings)
    if key == _CACHES.key:
        for medium, known in zip(media, _CACHES.value, strict=True):
            medium.cache.append(known, 0)
    scene.integrator().prepare(scene)
    if media == _with_caches_of_their_own(scene):  # otherwise they were replaced by new ones
        _CACHES.key, _CACHES.value = key, [_bare(medium.cache) for medium in media]


def _with_caches_of_their_own(scene: mi.Scene) -> list[CachedMedium]:
    """Return the media of a scene whose caches are neither zero nor in files."""
    media = scene.integrator().cached_media(scene)
    return [medium for medium in media if not medium.is_dark and not medium.settings.file]


def _bare(cache: IrradianceCache) -> IrradianceCache:
    """Return a copy without the objects of a scene that lookups need, which it would keep."""
    copy = cache.empty_copy()
    copy.interpolation = PLAIN
    copy.append(cache, 0)
    return copy


def reference_part(arguments: dict, folder: Path) -> None:
    """Render one launch of both halves of a reference."""
    scene = _SCENES.get(
        json.dumps(arguments["scene"], sort_keys=True), lambda: _loaded(arguments["scene"])
    )
    found = render_halves(scene, arguments["sensor"], arguments["first"], arguments["spp"])
    found.save(folder / arguments["file"])


def measurement(arguments: dict, folder: Path) -> None:
    """Measure one integrator as `irrcache compare` does."""
    _check_contents(arguments["scene"])
    for name in ("measurements", "images", "logs"):
        (folder / name).mkdir()
    job, integrator, name = (arguments[key] for key in ("job", "integrator", "name"))
    job = job | {"working_folder": arguments["scene"]["folder"]}
    measure_integrator(job, integrator, name, arguments["budgets"], folder)


def _loaded(scene: dict) -> mi.Scene:
    """Load the scene of a job."""
    _check_contents(scene)
    names = "scene", "parameters", "integrator", "folder"
    path, parameters, integrator, folder = (scene[name] for name in names)
    return load_scene(path, parameters, integrator, folder=folder)


def _check_contents(scene: dict) -> None:
    """Raise UnfitWorkerError if the files of a scene are not those of the client."""
    path = Path(scene["scene"])
    if not path.is_file():
        raise UnfitWorkerError(f'it has no file "{path}"; use a folder that all machines share')
    if contents_of(scene) != scene["contents"]:
        raise UnfitWorkerError(f'the files of "{path}" differ there from those here')


KINDS = {
    "cache_part": cache_part,
    "frame": frame,
    "reference_part": reference_part,
    "measurement": measurement,
    "cross_slabs": volume_jobs.cross_slabs,
    "add_axes": volume_jobs.add_axes,
}
