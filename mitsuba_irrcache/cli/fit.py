"""``irrcache fit``: fit a volume to images of it, one for each sensor of the scene."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from time import perf_counter

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cli.render import REPLACED, add_scene_options
from mitsuba_irrcache.core.argument_types import whole
from mitsuba_irrcache.errors import IrrcacheError, origin
from mitsuba_irrcache.gradients.fit import fit
from mitsuba_irrcache.gradients.fit_state import LOSSES, METHODS, Result, Settings, View
from mitsuba_irrcache.io.mitsuba_vol import write_vol
from mitsuba_irrcache.io.scene_files import (
    check_scene_file,
    integrator_of,
    load_scene,
    parse_parameters,
)
from mitsuba_irrcache.machine.variants import select_variant

#: The integrator in place of a path tracer; only this solver has gradients.
INTEGRATOR = "irrcache{solver=sweep}"
#: Shortest time between checkpoints [s].
CHECKPOINT_SECONDS = 30.0
CHECKPOINT = "fit.npz"
IMAGES = (".exr", ".png", ".jpg", ".jpeg", ".hdr", ".pfm")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``irrcache fit``."""
    parser.add_argument("scene", help="scene XML with the start volume and a sensor for each image")
    parser.add_argument(
        "--images", nargs="+", required=True, metavar="FILE",
        help="images in the order of the sensors, or a folder of them, sorted by name and by the "
        "numbers in names; those with 8 bits are taken to be sRGB",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", required=True, metavar="FOLDER",
        help=f"folder for a .vol of each parameter and the checkpoint {CHECKPOINT}",
    )  # fmt: skip
    parser.add_argument(
        "-p", "--parameter", action="append", metavar="NAME",
        help="sigma_t, albedo, emission, the id of an emitter, or a key of mi.traverse(scene) or "
        "its end, such as g; repeatable (default: sigma_t)",
    )  # fmt: skip
    parser.add_argument(
        "--held-out", type=whole(0), default=0, metavar="N",
        help="number of images at the end that are held out to measure the error (default: 0)",
    )  # fmt: skip
    _add_settings(parser)
    earlier = parser.add_mutually_exclusive_group()
    earlier.add_argument(
        "--resume", action="store_true", help=f"continue from {CHECKPOINT} in the output folder"
    )
    earlier.add_argument(
        "--overwrite", action="store_true", help="replace an earlier fit in the output folder"
    )
    parser.add_argument(
        "-i", "--integrator", metavar="NAME{KEY=VALUE,...}",
        help=f"integrator and its properties (default: {INTEGRATOR} in place of a path tracer)",
    )  # fmt: skip
    add_scene_options(parser)
    parser.add_argument("-v", "--verbose", action="store_true", help="show Mitsuba's log")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """Declare the options that are fields of `Settings`."""
    own = Settings()
    parser.add_argument(
        "--method", choices=METHODS, default=own.method, help="optimiser (default: %(default)s)"
    )
    parser.add_argument(
        "--loss", choices=[*LOSSES], default=own.loss,
        help="squared errors, absolute ones, or squared relative to the image "
        "(default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--steps", type=whole(1), default=own.steps, help="steps (default: %(default)s)"
    )
    parser.add_argument(
        "--rate", type=float, default=own.rate,
        help="first step size of adam, relative to the scale (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--scale", type=float, default=own.scale,
        help="expected extinction or emission (default: that of the start)",
    )  # fmt: skip
    parser.add_argument(
        "--smoothness", type=float, default=own.smoothness,
        help="weight of squared differences between neighbours (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--spp", type=whole(1), default=own.spp, help="samples per pixel (default: %(default)s)"
    )
    parser.add_argument(
        "--views", type=whole(0), default=own.views,
        help="images of each step of adam, in turn (default: 0, all)",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=whole(0), default=own.seed, help="seed of the samples (default: 0)"
    )


def run(args: argparse.Namespace) -> int:
    """Fit, print the progress, and write the volumes."""
    source, names = check_scene_file(args.scene), args.parameter or ["sigma_t"]
    files = _image_files(args.images)
    shared = {name: getattr(args, name) for name in Settings.__dataclass_fields__}
    settings, output = Settings(**shared), Path(args.output)
    checkpoint = output / CHECKPOINT
    if checkpoint.exists() and not (args.resume or args.overwrite):
        raise IrrcacheError(
            f'"{output}" already holds a fit ({CHECKPOINT}); continue it with --resume, name '
            "another folder, or add --overwrite."
        )
    select_variant(args.mode)
    mi.set_log_level(mi.LogLevel.Info if args.verbose else mi.LogLevel.Warn)
    parameters = parse_parameters(args.define)
    integrator = args.integrator
    if integrator is None and integrator_of(source, parameters) in REPLACED:
        integrator = INTEGRATOR
    scene = load_scene(source, parameters, integrator)
    sensors = scene.sensors()
    if len(files) != len(sensors):
        raise IrrcacheError(
            f"--images names {len(files)} image(s), but the scene has {len(sensors)} sensor(s); "
            "give one for each, in the same order."
        )
    views = [View(s, _pixels(f), f'image "{f}"') for s, f in zip(sensors, files, strict=True)]
    fitted = len(views) - args.held_out
    if fitted < 1:
        raise IrrcacheError(
            f"--held-out is {args.held_out} of {len(views)} image(s); leave at least one to fit."
        )
    _make_folder(output)
    start = Result.load(checkpoint, settings) if args.resume else None
    report = _Report(checkpoint, settings)
    try:
        result = fit(scene, views[:fitted], names, settings, views[fitted:], start, report)
    except (KeyboardInterrupt, RuntimeError) as error:
        if isinstance(origin(error), KeyboardInterrupt) and report.result is not None:
            _write(output, report.result, settings)
            raise KeyboardInterrupt(
                f"step {report.result.step} was written; continue with --resume"
            ) from None
        raise
    _write(output, result, settings)
    return 0


class _Report:
    """Print the progress, and write a checkpoint every `CHECKPOINT_SECONDS` at most."""

    def __init__(self, checkpoint: Path, settings: Settings) -> None:
        self._checkpoint, self._settings = checkpoint, settings
        self._begun = self._saved = perf_counter()
        #: the state after the last step
        self.result: Result | None = None

    def __call__(self, result: Result) -> None:
        self.result, now = result, perf_counter()
        step, loss, error = result.history[-1]
        held_out = "" if math.isnan(error) else f"  held out {error:.2%}"
        if held_out or step % 10 == 0 or step in (1, self._settings.steps):
            count = f"{step}/{self._settings.steps}"
            print(
                f"{now - self._begun:8.1f} s  step {count}  loss {loss:.3e}{held_out}", flush=True
            )
        if now - self._saved >= CHECKPOINT_SECONDS:
            result.save(self._checkpoint, self._settings)
            self._saved = perf_counter()


def _image_files(given: list[str]) -> list[Path]:
    """Return the image files; those of a folder in their natural order."""
    paths = [Path(name) for name in given]
    if len(paths) == 1 and paths[0].is_dir():
        folder = paths[0]
        paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES]
        paths.sort(key=_natural)
        if not paths:
            raise IrrcacheError(f'the folder "{folder}" has no images ({", ".join(IMAGES)}).')
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise IrrcacheError(f'there is no image "{missing[0]}".')
    return paths


def _natural(path: Path) -> tuple:
    """Return a key that sorts numbers in names by their values: 2.exr before 10.exr."""
    # The parts of a name are text and digits in turn.
    parts = re.split(r"([0-9]+)", path.stem)
    return [int(part) if odd % 2 else part for odd, part in enumerate(parts)], path.name


def _pixels(file: Path) -> np.ndarray:
    """Return linear radiance (height, width, 3), or 1 channel in a monochromatic variant and of
    grey images.
    """
    forms = mi.Bitmap.PixelFormat
    try:
        bitmap = mi.Bitmap(str(file))
        is_grey = mi.is_monochromatic or bitmap.pixel_format() in (forms.Y, forms.YA)
        form = forms.Y if is_grey else forms.RGB
        bitmap = bitmap.convert(form, mi.Struct.Type.Float32, srgb_gamma=False)
    except RuntimeError as error:
        raise IrrcacheError(f'cannot read the image "{file}": {error}') from error
    image = np.array(bitmap)
    return image if image.ndim == 3 else image[..., None]


def _make_folder(output: Path) -> None:
    try:
        output.mkdir(exist_ok=True)
    except OSError as error:
        raise IrrcacheError(f'cannot make the folder "{output}": {error.strerror}.') from error


def _write(output: Path, result: Result, settings: Settings) -> None:
    """Write the checkpoint, and each parameter: grids as .vol, others as text."""
    result.save(output / CHECKPOINT, settings)
    for name, value in result.values.items():
        name = re.sub(r"[^\w.-]", "_", name)  # a name in a scene is no path
        if value.ndim == 4:
            file = output / f"{name}.vol"
            write_vol(file, value)
        else:
            file = output / f"{name}.txt"
            np.savetxt(file, value.reshape(1, -1))
        print(f"wrote {file}")
