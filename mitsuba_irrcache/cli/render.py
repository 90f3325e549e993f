"""``irrcache render``: render a scene file to an EXR and a PNG."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import time
from contextlib import closing, contextmanager
from importlib import metadata
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache import __version__
from mitsuba_irrcache.core.argument_types import argument, finite, share, whole
from mitsuba_irrcache.core.stage_display import StageDisplay
from mitsuba_irrcache.errors import IrrcacheError, origin
from mitsuba_irrcache.io.display import TONES, Display, linear_colour
from mitsuba_irrcache.io.images import check_output, write_image
from mitsuba_irrcache.io.scene_files import (
    check_scene_file,
    check_sensor,
    has_cache,
    integrator_of,
    load_scene,
    parse_integrator,
    parse_parameters,
)
from mitsuba_irrcache.machine.variants import SUPPORTED, select_variant
from mitsuba_irrcache.pipeline.progressive import Frame, render_progressive

#: Stock integrators that ``irrcache`` replaces when a scene uses one of them.
REPLACED = ("path", "volpath", "volpathmis", "prbvolpath")

_colour = argument("a colour such as white or #202530")(linear_colour)


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options for loading a scene: the variant and the scene's parameters."""
    parser.add_argument(
        "-m",
        "--mode",
        default="llvm_ad_rgb",
        choices=SUPPORTED,
        metavar="VARIANT",
        help=f"{', '.join(SUPPORTED)} (default: %(default)s)",
    )
    parser.add_argument(
        "-D", "--define", action="append", default=[], metavar="KEY=VALUE",
        help="value of a $parameter of the scene; repeatable",
    )  # fmt: skip


def chosen_integrator(
    scene: Path, parameters: dict[str, str], integrator: str | None
) -> str | None:
    """Return the integrator to render with; None for the scene's own.

    It is ``integrator`` if that is given, otherwise ``irrcache`` for scenes with one of the
    integrators `REPLACED`.
    """
    if integrator is None and integrator_of(scene, parameters) in REPLACED:
        return "irrcache"
    return integrator


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``irrcache render``, named as those of ``mitsuba``."""
    parser.add_argument("scene", help="scene XML")
    parser.add_argument("-o", "--output", help="EXR to write (default: beside the scene)")
    add_scene_options(parser)
    parser.add_argument(
        "-i", "--integrator", metavar="NAME{KEY=VALUE,...}",
        help="integrator and its properties (default: irrcache in place of a path tracer)",
    )  # fmt: skip
    parser.add_argument(
        "--spp", type=int, default=0, help="samples per pixel (default: the scene's)"
    )
    parser.add_argument(
        "-s", "--sensor", type=int, default=0, help="index of the sensor (default: 0)"
    )
    parser.add_argument(
        "--seed",
        type=whole(0, 2**32 - 1),
        default=0,
        help="seed of the camera samples (default: 0)",
    )
    parser.add_argument(
        "--budget", type=float, metavar="SECONDS",
        help="refine the cache and render repeatedly for this many seconds after the scene is "
        "loaded; Ctrl-C ends it earlier",
    )  # fmt: skip
    parser.add_argument(
        "--error", type=float, metavar="E",
        help="refine until the relative standard error of the cache is this, e.g. 0.02",
    )  # fmt: skip
    parser.add_argument(
        "--tolerance", type=share, metavar="E",
        help="choose resolution, directions, steps and, without --spp, samples per pixel for this "
        "error of the image in units of its mean, e.g. 0.5%%, and print the estimated error",
    )  # fmt: skip
    add_display_options(parser)
    parser.add_argument("-v", "--verbose", action="store_true", help="show Mitsuba's log")


def add_display_options(parser: argparse.ArgumentParser) -> None:
    """Declare how the PNG displays the image; the EXR stays linear radiance."""
    parser.add_argument(
        "--exposure", type=finite, default=0.0, metavar="EV", help="of the PNG, in stops"
    )
    parser.add_argument(
        "--tone", choices=tuple(TONES), default="sRGB", help="tone curve of the PNG"
    )
    parser.add_argument(
        "--background", type=_colour, metavar="COLOUR",
        help="behind the image in the PNG, e.g. white or #202530; for films with alpha "
        "(pixel_format rgba), where emitters are hidden or there is no environment",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Render, and print the time of each stage."""
    source = check_scene_file(args.scene)
    output = check_output(args.output or source.with_suffix(".exr"))
    if args.spp < 0:
        raise IrrcacheError(
            f"--spp is {args.spp}; it must be at least 1 (or 0 for the scene's own)."
        )
    _check_targets(args)
    select_variant(args.mode)
    mi.set_log_level(mi.LogLevel.Info if args.verbose else mi.LogLevel.Warn)
    seconds: dict[str, float] = {}
    display = StageDisplay()
    with _stopwatch(seconds, "load"), display.stage(f"loading {source.name}"):
        parameters = parse_parameters(args.define)
        integrator = chosen_integrator(source, parameters, args.integrator)
        used = integrator or integrator_of(source, parameters)
        properties = {}
        if args.tolerance:
            _check_tolerance(used, args)
            properties["tolerance"] = args.tolerance
        scene = load_scene(source, parameters, integrator, properties)
    check_sensor(args.sensor, scene)
    if integrator is None and used != "irrcache":
        print(
            f'irrcache: the scene\'s own integrator "{used}" renders the image; '
            "-i irrcache replaces it.",
            file=sys.stderr,
        )
    _check_background(scene, args)
    if args.budget or args.error:
        _require_progressive(scene, used)
        _render_progressive(scene, args, seconds, output, display)
    else:
        image = _render(scene, args, seconds, display)
        if args.tolerance:
            print(scene.integrator().certificate)
        _write(output, image, scene, args, seconds)
    return 0


def _check_tolerance(integrator: str, args: argparse.Namespace) -> None:
    """Refuse a tolerance together with other targets, or for other integrators."""
    if args.budget or args.error:
        raise IrrcacheError(
            "--tolerance is itself a target; leave --budget and --error away, or limit the time by "
            "the property timeout."
        )
    name, _ = parse_integrator(integrator)
    if name != "irrcache":
        raise IrrcacheError(f'--tolerance is a property of irrcache; "{name}" has none.')


def _uses_cache(scene: mi.Scene, args: argparse.Namespace) -> bool:
    """Return whether an image is rendered with the cache of the integrator, which has one."""
    uses = getattr(scene.integrator(), "uses_cache", None)
    return uses is None or uses(scene, args.sensor, args.spp)


def _render(
    scene: mi.Scene, args: argparse.Namespace, seconds: dict[str, float], display: StageDisplay
) -> np.ndarray:
    integrator = scene.integrator()
    name = "projection" if has_cache(scene) else "render"
    try:
        # With a tolerance, the cache depends on the view.
        if has_cache(scene) and not args.tolerance and _uses_cache(scene, args):
            with _kernel_stopwatch(seconds, "cache"), progress_bar(integrator, display):
                integrator.prepare(scene)
        with _kernel_stopwatch(seconds, name), display.stage("rendering (compiling kernels first)"):
            image = mi.render(scene, sensor=args.sensor, seed=args.seed, spp=args.spp)
            dr.sync_thread()
    except (KeyboardInterrupt, RuntimeError) as error:
        _add_message_to_interrupt(error, "no image was written")
        raise
    return np.array(image)


def _render_progressive(
    scene: mi.Scene,
    args: argparse.Namespace,
    seconds: dict[str, float],
    output: Path,
    display: StageDisplay,
) -> None:
    """Render progressively and write the last image, also if the run is interrupted."""
    frame = None
    targets = {"seconds": args.budget or math.inf, "standard_error": args.error or 0.0}
    try:
        with (
            progress_bar(scene.integrator(), display),
            terminated_like_interrupted(),
            closing(
                render_progressive(scene, args.sensor, args.spp, args.seed, **targets)
            ) as frames,
        ):
            for frame in frames:
                display.print(f"{frame.elapsed:8.2f} s  {_reached(frame)}")
    except (KeyboardInterrupt, RuntimeError) as error:
        left = f"the image of {_reached(frame)} was written" if frame else "no image was written"
        _add_message_to_interrupt(error, left)
        raise
    finally:
        if frame is not None:
            seconds |= frame.seconds
            _write(output, np.array(frame.image), scene, args, seconds, frame.samples)


def _add_message_to_interrupt(error: BaseException, left: str) -> None:
    """Add a message about the written image to an interrupt, which has none of its own."""
    if isinstance(origin(error), KeyboardInterrupt):
        raise KeyboardInterrupt(left) from None


def _reached(frame: Frame) -> str:
    if not frame.samples:
        return "no cache"
    error = "" if math.isnan(frame.standard_error) else f", error {frame.standard_error:.2%}"
    return f"{frame.samples} samples per voxel{error}"


def _write(
    output: Path,
    image: np.ndarray,
    scene: mi.Scene,
    args: argparse.Namespace,
    seconds: dict[str, float],
    samples: int = 0,
) -> None:
    about = _describe(scene, args, seconds, samples)
    display = Display(args.exposure, args.tone, args.background)
    png = write_image(output, image, about, scene.integrator().aov_names(), display)
    print(f"wrote {output} and {png}")
    print("  ".join(f"{name} {value:.2f} s" for name, value in seconds.items()))


@contextmanager
def terminated_like_interrupted():
    """Treat a request to terminate like Ctrl-C within this context."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def progress_bar(integrator: mi.Integrator, display: StageDisplay | None = None):
    """Show the progress of the cache, from the compilation of its kernels on."""
    display = display or StageDisplay()
    with display.stage("cache: preparing the scene, compiling kernels"):
        integrator.progress = display.advance
        try:
            yield
        finally:
            integrator.progress = None


@contextmanager
def _stopwatch(seconds: dict[str, float], name: str):
    started = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - started


@contextmanager
def _kernel_stopwatch(seconds: dict[str, float], name: str):
    """Measure a stage without the compilation of its kernels, which is a stage of its own."""
    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    try:
        with _stopwatch(seconds, name):
            yield
        missed = (k for k in dr.kernel_history() if not k.get("cache_hit", True))
        compiling = sum(k["codegen_time"] + k["backend_time"] for k in missed) / 1000
        if compiling:
            seconds[name] -= compiling
            seconds["compilation"] = seconds.get("compilation", 0.0) + compiling
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, before)


def _check_targets(args: argparse.Namespace) -> None:
    for name, value, wanted in (
        ("budget", args.budget, "a number of seconds"),
        ("error", args.error, "a relative error, for example 0.02,"),
    ):
        if value is not None and not 0 < value < math.inf:
            raise IrrcacheError(f"--{name} is {value:g}; it must be {wanted} above 0.")


def _check_background(scene: mi.Scene, args: argparse.Namespace) -> None:
    film = scene.sensors()[args.sensor].film()
    if args.background is not None and not mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
        raise IrrcacheError(
            "--background needs a film with alpha; set its pixel_format to rgba in the scene."
        )


def _require_progressive(scene: mi.Scene, integrator: str) -> None:
    if not hasattr(scene.integrator(), "progressive"):
        raise IrrcacheError(
            f'--budget and --error need an integrator with a cache to refine, and "{integrator}" '
            "has none; use irrcache, or --spp."
        )


def _describe(
    scene: mi.Scene, args: argparse.Namespace, seconds: dict[str, float], samples: int = 0
) -> dict[str, object]:
    """Describe how the image was made, for the header of the EXR; see `described`."""
    found = described(scene, args.scene, args.sensor, args.seed, args.spp, samples)
    return found | {f"seconds_{name}": value for name, value in seconds.items()}


def described(
    scene: mi.Scene, source: str | Path, sensor: int, seed: int, spp: int, samples: int = 0
) -> dict[str, object]:
    """Describe how an image of the file ``source`` was made, for the header of the EXR.

    ``spp`` is the number of samples per pixel, or 0 for that of the scene; ``samples`` is that per
    voxel of the cache that the image shows, or 0 for the present one.
    """
    found = {
        "version": __version__,
        "mitsuba": metadata.version("mitsuba"),
        "drjit": metadata.version("drjit"),
        "variant": mi.variant(),
        "scene": Path(source).name,
        "integrator": " ".join(str(scene.integrator()).split()),
        "sensor": sensor,
        "seed": seed,
        "spp": spp or scene.sensors()[sensor].sampler().sample_count(),
    }
    certificate = getattr(scene.integrator(), "certificate", None)
    if certificate is not None:
        found |= {"spp": certificate.settings["spp"], "error": str(certificate)}
    caches = getattr(scene.integrator(), "caches", {})
    cache = next(iter(caches.values()), None) if len(caches) == 1 else None
    if cache is not None:
        sides = "x".join(map(str, cache.grid.shape[::-1]))
        found["cache"] = f"{sides} voxels, {samples or cache.samples} samples"
    return found
