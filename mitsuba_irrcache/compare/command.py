"""``irrcache compare``: error against rendering time of several integrators on one scene.

Any integrators of Mitsuba can be compared, stock or not. Each runs in a process of its own and is
measured against a reference that is rendered once and stored. ``filter=bilateral`` is accepted for
any integrator: if a plugin has no such property, its images are filtered here, so that it competes
on equal terms with integrators that have a filter.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.core.argument_types import finite, seconds, whole
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.scene_files import check_scene_file, parse_integrator, parse_parameters
from mitsuba_irrcache.machine import doctor
from mitsuba_irrcache.machine.extras import require
from mitsuba_irrcache.machine.versions import installed_version

from .processes import WorkerError, run_job
from .reference import Reference, default_folder
from .results import Measurement, file_name
from .summary import maximum_depths

DEFAULT_REFERENCE = "volpath"
#: Default time for the reference in units of the longest budget.
REFERENCE_SHARE = 4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``irrcache compare``."""
    add = parser.add_argument
    add("scene", help="scene XML")
    add_measurement_options(parser)
    add("-o", "--output", required=True, metavar="FOLDER", help="folder for the report")
    add("-m", "--mode", default="llvm_ad_rgb", help="variant of Mitsuba (default: %(default)s)")
    add(
        "-D", "--define", action="append", default=[], metavar="KEY=VALUE",
        help="value of a $parameter of the scene; repeatable",
    )  # fmt: skip
    add_reference_options(parser)
    effort = parser.add_mutually_exclusive_group()
    effort.add_argument(
        "--reference-spp", type=whole(0), default=0, metavar="N",
        help="samples per pixel of each of the two halves of the reference",
    )  # fmt: skip
    effort.add_argument(
        "--reference-seconds", type=seconds, default=0.0, metavar="S",
        help=f"time for the reference (default: {REFERENCE_SHARE} times the longest budget)",
    )  # fmt: skip
    add_modules(parser)
    add("--overwrite", action="store_true", help="replace an existing report in the folder")


def add_measurement_options(parser: argparse.ArgumentParser) -> None:
    """Declare what is measured: integrators and times."""
    add = parser.add_argument
    add(
        "-i", "--integrator", action="append", required=True, metavar="NAME{KEY=VALUE,...}",
        help="integrator to compare, quoted, with properties; repeatable",
    )  # fmt: skip
    add(
        "--budget", default="1,3,12", metavar="SECONDS,...",
        help="times to compare errors at, with compiled kernels (default: %(default)s)",
    )  # fmt: skip
    add(
        "--exposure",
        type=finite,
        default=0.0,
        metavar="EV",
        help="exposure of the displayed images in stops",
    )


def add_reference_options(parser: argparse.ArgumentParser) -> None:
    """Declare which reference is rendered, and where it is stored."""
    add = parser.add_argument
    add("-s", "--sensor", type=whole(0), default=0, help="index of the sensor (default: 0)")
    add(
        "--reference", default=DEFAULT_REFERENCE, metavar="NAME{KEY=VALUE,...}",
        help="unbiased integrator that makes the reference (default: %(default)s)",
    )  # fmt: skip
    add(
        "--references", type=Path, default=None, metavar="FOLDER",
        help="folder of the references (default: irrcache/references in your cache folder)",
    )  # fmt: skip


def add_modules(parser: argparse.ArgumentParser) -> None:
    """Declare the modules that register plugins."""
    parser.add_argument(
        "--import", dest="modules", action="append", default=[], metavar="MODULE",
        help="Python module that registers third-party plugins; repeatable",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Measure, write the report and print the tables; return 1 if an integrator failed."""
    require("matplotlib", "compare", "irrcache compare")
    job, budgets = common_job(args), budgets_of(args.budget)
    integrators = integrators_of(args)
    folder = check_folder(Path(args.output), args.overwrite)
    with tempfile.TemporaryDirectory(prefix="irrcache-compare-") as scratch:
        log = Path(scratch) / "log"
        checked = run_job(
            "check", job | {"integrators": [*integrators, args.reference]},
            Path(scratch) / "checked.json", log,
        )  # fmt: skip
        reference = _reference(args, job, budgets, Path(scratch) / "reference.json", log)
    make_folders(folder)
    measurements, interrupted = [], False
    for index, integrator in enumerate(integrators):
        try:
            name = file_name(index, integrator)
            measurements.append(measure_integrator(job, integrator, name, budgets, folder))
        except KeyboardInterrupt:
            interrupted = True
            measurements += _kept(folder, name, integrator, "It was interrupted.")
            break
    tables = write_report(args, folder, measurements, reference, budgets, checked)
    for table in tables:
        print(f"\n{table.as_text()}")
    print(f"\nreport         {folder / 'report.html'}")
    for measurement in measurements:
        if measurement.error:
            print(f"irrcache: {measurement.integrator}: {measurement.error}", file=sys.stderr)
    return 130 if interrupted else int(any(m.error for m in measurements))


def measure_integrator(
    job: dict, integrator: str, name: str, budgets: list[float], folder: Path
) -> Measurement:
    """Measure one integrator in two processes: with an empty and a filled kernel cache.

    The first process renders all budgets.
    """
    result = folder / "measurements" / f"{name}.json"
    log = folder / "logs" / f"{name}.txt"
    own = job | {"integrator": integrator, "name": name, "budgets": budgets}
    own |= {"images": str(folder / "images")}
    print(f"{integrator}: first image, with an empty kernel cache", flush=True)

    def report(line: str) -> None:
        print(f"{integrator}: {line}", flush=True)

    with tempfile.TemporaryDirectory(prefix="irrcache-kernels-") as kernels:
        try:
            run_job("measure", own, result, log, Path(kernels), report)
            warm = run_job(
                "start", own, Path(kernels) / "warm.json", Path(kernels) / "log", Path(kernels)
            )
        except WorkerError as error:
            return _kept(folder, name, integrator, str(error))[0]
    measurement = Measurement.load(result)
    measurement.warm = warm
    measurement.save(result)
    return measurement


def _kept(folder: Path, name: str, integrator: str, why: str) -> list[Measurement]:
    """Return what an integrator had finished when an error ended its process."""
    result = folder / "measurements" / f"{name}.json"
    measurement = Measurement.load(result) if result.exists() else Measurement(integrator, name)
    measurement.error = why
    measurement.save(result)
    return [measurement]


def _reference(
    args: argparse.Namespace, job: dict, budgets: list[float], result: Path, log: Path
) -> Reference:
    seconds = args.reference_seconds
    if not seconds and not args.reference_spp:
        seconds = REFERENCE_SHARE * max(budgets)
    print(f"reference: {args.reference}", flush=True)
    wanted = {
        "integrator": args.reference,
        "folder": str((args.references or default_folder()).resolve()),
        "spp": args.reference_spp,
        "seconds": seconds,
    }
    found = run_job("reference", job | wanted, result, log, report=_progress_printer("reference"))
    reference = Reference.load(Path(found["path"]))
    print(f"reference: {2 * reference.spp} samples per pixel, {found['path']}", flush=True)
    return reference


def write_report(
    args: argparse.Namespace,
    folder: Path,
    measurements: list[Measurement],
    reference: Reference,
    budgets: list[float],
    checked: dict,
) -> list:
    """Write the report to ``folder``; return its tables.

    ``checked`` is the result of the job `worker.check`.
    """
    from .output import Comparison, write_output

    facts = _facts(args, reference, checked)
    depths = maximum_depths(checked["described"])
    who = " against ".join(m.integrator for m in measurements)
    if len(measurements) > 2:
        who = f"{len(measurements)} integrators"
    title = f"{who} on {_scene_name(args)}"
    comparison = Comparison(title, budgets, measurements, reference, facts, depths, args.exposure)
    return write_output(comparison, folder)


def _facts(args: argparse.Namespace, reference: Reference, checked: dict) -> dict[str, str]:
    system = doctor.examine_system()
    width, height = checked["size"]
    parameters = " ".join(args.define)
    return {
        "scene": f"{_scene_name(args)}{f' with {parameters}' if parameters else ''}",
        "image": f"{width} × {height} pixels",
        "sensor": f"{args.sensor} of {checked['sensors']}",
        "integrators": "; ".join(checked["described"][i] for i in args.integrator),
        "reference": f"{args.reference}, {2 * reference.spp} samples per pixel in two halves, "
        f"{reference.seconds:.0f} s",
        "variant": args.mode,
        "software": f"Mitsuba {installed_version('mitsuba')}, Dr.Jit {installed_version('drjit')}",
        "machine": f"{system['processor']}, {system['cores']} cores",
        "date": time.strftime("%Y-%m-%d %H:%M"),
    }


def _scene_name(args: argparse.Namespace) -> str:
    """Return the file name with its folder, since many scenes are called scene.xml."""
    return "/".join(Path(args.scene).resolve().parts[-2:])


def common_job(args: argparse.Namespace) -> dict:
    """Return what all jobs of a comparison have in common, checked."""
    source = check_scene_file(args.scene)
    if args.mode not in mi.variants():
        raise IrrcacheError(f'-m is "{args.mode}"; this Mitsuba has {", ".join(mi.variants())}.')
    return {
        "scene": str(source.resolve()),
        "parameters": parse_parameters(args.define),
        "sensor": args.sensor,
        "variant": args.mode,
        "modules": args.modules,
    }


def integrators_of(args: argparse.Namespace) -> list[str]:
    """Return the integrators; raise IrrcacheError for one that cannot be read or is repeated."""
    for specification in [*args.integrator, args.reference]:
        parse_integrator(specification)
    doubled = [i for i in args.integrator if args.integrator.count(i) > 1]
    if doubled:
        raise IrrcacheError(f"-i {doubled[0]} is given twice; the runs would be the same.")
    return args.integrator


def budgets_of(text: str) -> list[float]:
    """Return the seconds in ``--budget``, sorted."""
    try:
        budgets = sorted({float(part) for part in text.split(",")})
    except ValueError:
        budgets = []
    if not budgets or not all(0 < b < math.inf for b in budgets):
        raise IrrcacheError(f'--budget is "{text}"; write seconds above 0, for example 1,3,12.')
    return budgets


def check_folder(folder: Path, overwrite: bool) -> Path:
    """Check the folder for the report before any rendering starts."""
    if folder.exists() and not folder.is_dir():
        raise IrrcacheError(f'-o "{folder}" is a file; name a folder.')
    if not folder.resolve().parent.is_dir():
        raise IrrcacheError(f'cannot write "{folder}": "{folder.parent}" does not exist.')
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / "measurements").is_dir():
            raise IrrcacheError(
                f'"{folder}" is not empty and holds no report; name another folder.'
            )
        if not overwrite:
            raise IrrcacheError(
                f'"{folder}" already holds a report; name another folder, or add --overwrite.'
            )
    return folder


def make_folders(folder: Path) -> None:
    """Create the empty report folders; only files of a former report are removed."""
    folder.mkdir(exist_ok=True)
    for name in ("results.json", "results.csv", "report.html"):
        (folder / name).unlink(missing_ok=True)
    for name in ("images", "figures", "logs", "measurements"):
        shutil.rmtree(folder / name, ignore_errors=True)
    for name in ("images", "logs", "measurements"):
        (folder / name).mkdir()


def _progress_printer(name: str) -> Callable[[str], None]:
    """Return a function that prints lines of progress, at most one every five seconds."""
    printed = time.monotonic()

    def report(line: str) -> None:
        nonlocal printed
        if time.monotonic() - printed >= 5:
            printed = time.monotonic()
            print(f"{name}: {line}", flush=True)

    return report
