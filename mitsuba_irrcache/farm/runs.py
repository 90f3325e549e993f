"""The runs of ``irrcache farm``: from its arguments to jobs, and from their results to files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.cli.render import chosen_integrator, terminated_like_interrupted
from mitsuba_irrcache.compare.command import budgets_of, common_job, integrators_of
from mitsuba_irrcache.compare.reference import (
    default_folder,
    reference_path,
    require_emission,
)
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm.cache import CacheRun, waiting_parts
from mitsuba_irrcache.farm.cluster import MOST_WORKERS, ClusterOptions, connected
from mitsuba_irrcache.farm.dispatch import Dispatch
from mitsuba_irrcache.farm.frames import begin_frames, frame_jobs
from mitsuba_irrcache.farm.jobs import Environment, Job, scene_arguments
from mitsuba_irrcache.farm.references import ReferenceRun, waiting_launches
from mitsuba_irrcache.farm.results import Outcome, Results
from mitsuba_irrcache.farm.studies import SceneStudy, arguments_by_scene
from mitsuba_irrcache.farm.volume import NAMES, FarmSweep
from mitsuba_irrcache.io.scene_files import (
    check_scene_file,
    check_sensor,
    load_scene,
    parse_integrator,
    parse_parameters,
)
from mitsuba_irrcache.machine.memory import total_memory
from mitsuba_irrcache.machine.modules import import_modules
from mitsuba_irrcache.machine.variants import select_variant
from mitsuba_irrcache.out_of_core.irradiance_file import check_replaceable
from mitsuba_irrcache.out_of_core.rendering import memory_beside_python
from mitsuba_irrcache.out_of_core.survey import MappedField

#: Largest number of files that a message names.
MOST_NAMES = 8

Store = Callable[[Job, Outcome], None]


def run_cache(args: argparse.Namespace) -> int:
    """Fill the caches of a scene."""
    options, environment = _begin(args)
    scene, parameters, integrator = _scene(args)
    _check_parent(args.output, scene)
    integrator = chosen_integrator(scene, parameters, integrator)
    loaded = load_scene(scene, parameters, integrator)
    if getattr(loaded.integrator(), "mapped_medium", None) is not None:
        return _fill_volume(args, options, environment, loaded)
    arguments = scene_arguments(scene, parameters, integrator)
    with waiting_parts(args.output).alone(resume=True):
        cache = CacheRun(arguments, loaded, environment, args.output, args.resume)
        jobs = cache.begin()
        try:
            status = _dispatch(options, jobs, cache.store)
        finally:
            complete = cache.finish()
    if complete:
        print(f"wrote {', '.join(cache.files)}")
    return status


def _fill_volume(
    args: argparse.Namespace, options: ClusterOptions, environment: Environment, scene: mi.Scene
) -> int:
    """Fill the irradiance of a medium whose extinction is in a file."""
    file, parts = args.output, args.output.with_name(f"{args.output.name}.parts")
    check_replaceable(file)
    present = [path for path in (file, parts) if path.exists()]
    if present and not args.resume:
        raise IrrcacheError(
            f'"{present[0]}" exists already; add --resume to continue it, or name another file.'
        )
    medium = scene.integrator().mapped_medium
    medium.use_file(file)
    sharing = 1 if options.scheduler else options.workers
    memory = memory_beside_python(medium.max_memory or total_memory() // (2 * sharing))
    sweep: FarmSweep | None = None
    work = Results(parts, names=[NAMES])
    try:
        with (
            work.alone(resume=True),
            terminated_like_interrupted(),
            connected(options) as connection,
        ):

            def begin(sigma_t: MappedField, inputs: str) -> FarmSweep:
                nonlocal sweep
                sweep = FarmSweep(sigma_t, parts, memory, connection, environment, inputs)
                return sweep

            medium.compute(scene, begin, None)
            work.remove_all()
    except (IrrcacheError, OSError) as error:
        if sweep is None or sweep.has_folder:
            raise
        raise IrrcacheError(
            f'the folder "{parts}" was removed during the run, as by another command for the same '
            f'-o "{file}" that has finished; see whether that file is there, otherwise start this '
            "command again."
        ) from error
    print(f"wrote {file}")
    return 0


def run_frames(args: argparse.Namespace) -> int:
    """Render the frames of a scene."""
    options, environment = _begin(args)
    results = Results(args.output)
    with results.alone(args.resume):
        jobs = list(frame_jobs(args, *_scene(args), environment))
        status = _dispatch(options, begin_frames(jobs, results), results.store)
        there, others = sum(map(results.has, jobs)), results.others(jobs)
    print(f"{there} of {len(jobs)} frames are in {args.output}")
    if others:
        more = f" and {len(others) - MOST_NAMES} more" if len(others) > MOST_NAMES else ""
        print(
            f'irrcache: "{args.output}" also holds files of an earlier run that are no frames of '
            f"this one, {', '.join(others[:MOST_NAMES])}{more}; delete them, or name another "
            "folder.",
            file=sys.stderr,
        )
    if not status and there < len(jobs):
        print(
            f'irrcache: frames in "{args.output}" were changed meanwhile: another command may be '
            "using the folder. When it has ended, start this one again with --resume, or name "
            "another folder.",
            file=sys.stderr,
        )
        return 1
    return status


def run_reference(args: argparse.Namespace) -> int:
    """Render, or continue, a reference."""
    options, environment = _begin(args)
    scene, parameters, _ = _scene(args)
    with ExitStack() as used:
        reference = _reference(args, scene, parameters, environment, {}, used)
        try:
            status = _dispatch(options, reference.missing, reference.store)
        finally:
            reference.finish()
    if reference.found is not None:
        print(f"{2 * reference.found.spp} samples per pixel in two halves, {reference.path}")
    return status


def run_study(args: argparse.Namespace) -> int:
    """Measure all integrators on all scenes, and write a report for each scene."""
    options, environment = _begin(args, most_workers=1)
    integrators_of(args)
    budgets, folder = budgets_of(args.budget), Path(args.output)
    with ExitStack() as used:
        used.enter_context(_folder_of_runs(folder))
        return _study(args, options, environment, budgets, used)


@contextmanager
def _folder_of_runs(folder: Path) -> Iterator[None]:
    """Create a folder for those of runs, and remove it in the end if it is empty."""
    if folder.exists() and not folder.is_dir():
        raise IrrcacheError(f'-o "{folder}" is a file; name a folder.')
    if not folder.parent.is_dir():
        raise IrrcacheError(f'cannot write "{folder}": "{folder.parent}" does not exist.')
    is_new = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise IrrcacheError(f'cannot write "{folder}": {error.strerror}.') from error
    try:
        yield
    finally:
        with suppress(OSError):
            if is_new:
                folder.rmdir()


def _study(
    args: argparse.Namespace,
    options: ClusterOptions,
    environment: Environment,
    budgets: list[float],
    used: ExitStack,
) -> int:
    """Measure and report; ``used`` keeps other commands from the folders until the end."""
    studies, references = {}, {}
    jobs: list[Job] = []
    stores: dict[str, Store] = {}  # by names of jobs
    for own in arguments_by_scene(args):
        job = common_job(own)
        study = SceneStudy(own, job, budgets, environment)
        used.enter_context(study.alone(args.resume))
        missing = study.begin(args.resume)
        place = Path(job["scene"]), job["parameters"]
        studies[study] = _reference(args, *place, environment, references, used)
        stores |= {each.name: study.store for each in missing}
        jobs += missing
    for reference in references.values():
        stores |= {each.name: reference.store for each in reference.missing}
        jobs = [*reference.missing, *jobs]
    try:
        status = _dispatch(options, jobs, lambda job, outcome: stores[job.name](job, outcome))
    finally:
        finished = {path: reference.finish() for path, reference in references.items()}
    complete = [study for study, reference in studies.items() if finished[reference.path]]
    for study in complete:
        print(f"report {study.report(studies[study].found)}")
        for measurement in study.measurements:
            if measurement.error:
                print(f"irrcache: {measurement.integrator}: {measurement.error}", file=sys.stderr)
                status = 1
    return status if len(complete) == len(studies) else 1


KINDS = {
    "cache": run_cache,
    "frames": run_frames,
    "reference": run_reference,
    "study": run_study,
}


def _begin(
    args: argparse.Namespace, most_workers: int = MOST_WORKERS
) -> tuple[ClusterOptions, Environment]:
    """Check the options of all runs, and set the variant."""
    options = ClusterOptions.of(args, most_workers)
    select_variant(args.mode)
    mi.set_log_level(mi.LogLevel.Warn)
    import_modules(args.modules)
    return options, Environment.here(args.mode, args.modules, options.threads)


def _scene(args: argparse.Namespace) -> tuple[Path, dict[str, str], str | None]:
    """Return the checked scene file, its parameters, and the integrator that replaces its own."""
    scene, parameters = check_scene_file(args.scene), parse_parameters(args.define)
    integrator = getattr(args, "integrator", None)
    if integrator is not None:
        parse_integrator(integrator)
    return scene, parameters, integrator


def _check_parent(file: Path, scene: Path) -> None:
    """Raise IrrcacheError if a cache cannot be written to a file, which may be the ``scene``."""
    if not file.parent.is_dir():
        raise IrrcacheError(f'cannot write "{file}": the folder "{file.parent}" does not exist.')
    if file.is_dir():
        raise IrrcacheError(f'cannot write "{file}": it is a folder; name a file.')
    if file.exists() and file.samefile(scene):
        raise IrrcacheError(f'-o "{file}" is the scene itself; name another file for the cache.')


def _reference(
    args: argparse.Namespace,
    scene: Path,
    parameters: dict[str, str],
    environment: Environment,
    known: dict[Path, ReferenceRun],
    used: ExitStack,
) -> ReferenceRun:
    """Return the reference of a scene, which is one of those ``known`` where the contents are the
    same; ``used`` keeps other commands from its folder if there is anything to be computed.
    """
    require_emission(scene, parameters, args.reference)
    arguments = scene_arguments(scene, parameters, args.reference)
    check_sensor(args.sensor, load_scene(scene, parameters, args.reference))
    folder = (args.references or default_folder()).resolve()
    path = reference_path(scene, parameters, args.reference, args.sensor, folder)
    if path in known:
        return known[path]
    with ExitStack() as alone:
        alone.enter_context(waiting_launches(path).alone(resume=True))
        settings = args.sensor, path, args.reference_spp, environment
        known[path] = ReferenceRun(arguments, *settings)
        if known[path].missing:
            used.push(alone.pop_all())
        else:  # others may use it, too
            known[path].finish()
    return known[path]


def _dispatch(options: ClusterOptions, jobs: Sequence[Job], store: Store) -> int:
    """Run jobs on the cluster; return 1, and print why, if some failed."""
    if not jobs:
        return 0
    with terminated_like_interrupted(), connected(options) as connection:
        failed = Dispatch(connection, jobs, store).run()
    for name, message in failed.items():
        print(f"irrcache: {name}: {message}", file=sys.stderr)
    return int(bool(failed))
