"""The subcommand ``irrcache import``: convert a volume file to a Mitsuba scene."""

from __future__ import annotations

import argparse
import math
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from mitsuba_irrcache.core.argument_types import argument, finite, finite_number, whole
from mitsuba_irrcache.core.stage_display import StageDisplay
from mitsuba_irrcache.errors import IrrcacheError, suggestion
from mitsuba_irrcache.volumes import processing, transfer_files
from mitsuba_irrcache.volumes.colours import USES, Colours, ColourVolume, linear, read_colours
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.detached import OPTION
from mitsuba_irrcache.volumes.formats import format_of, suffixes
from mitsuba_irrcache.volumes.options import CloudVariables, ReadOptions
from mitsuba_irrcache.volumes.raw import RawLayout
from mitsuba_irrcache.volumes.readers import read_volume
from mitsuba_irrcache.volumes.scene import SceneSettings, write_scene
from mitsuba_irrcache.volumes.transfer import (
    DensityMapping,
    TransferFunction,
    load_preset,
    preset_names,
)

#: Mean cosine of scattering by the droplets of a water cloud in visible light.
CLOUD_ASYMMETRY = 0.85
#: Radiance of the sky and irradiance of the sun in scenes of clouds, in arbitrary units.
CLOUD_SKY, CLOUD_SUN = 0.1, 4.0
_PHANTOMS = ("thorax", "cloud")
#: Voxels of phantoms for a first look.
SMALL = "64,40,55"
# Air is -1000 HU; data in Hounsfield units without air are rare.
_AIR_LIKE = -200


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``irrcache import`` on ``parser``."""
    add_input(parser)
    parser.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="a new folder, or FOLDER/scene.xml"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier import")
    add_options(parser)


def add_input(parser: argparse.ArgumentParser, besides: str = "") -> None:
    """Declare the argument for the input; ``besides`` describes other accepted inputs."""
    parser.add_argument(
        "input",
        nargs="+",
        metavar="INPUT",
        help=f"{besides}a volume file ({suffixes()}), a DICOM folder, a folder or list of slices "
        "(TIFF, PNG, JPEG, BMP), raw file(s) in one or in slices, or one made here: "
        "phantom:thorax (a chest), phantom:cloud (needs --density), each with :X,Y,Z after it for "
        "another size",
    )


def add_options(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Declare the options for reading a volume and for its appearance.

    They are also declared where the input may be a scene.
    """
    needed = "one is needed" if required else "for volumes: one is needed"
    _add_appearance(parser.add_argument_group(f"appearance ({needed})"), required)
    _add_processing(parser.add_argument_group("processing, in this order"))
    _add_selection(parser.add_argument_group("files with several volumes, or without a spacing"))
    _add_raw(parser.add_argument_group("raw files"))
    parser.add_argument(
        OPTION,
        action="append",
        default=[],
        metavar="FOLDER",
        help="other folder in which a header (NRRD, MetaImage) may name data files; repeatable",
    )
    parser.add_argument("--series", metavar="UID", help="which series of a DICOM folder")
    parser.add_argument(
        "--replace-nan",
        type=finite,
        metavar="VALUE",
        help="replace NaN and infinite values by VALUE",
    )
    parser.add_argument(
        "--max-depth",
        type=whole(-1),
        help="default of the scene (2: single scattering, the default; -1, all orders, with "
        "--asymmetry or --cloud)",
    )
    parser.add_argument(
        "--up",
        choices=("z", "y"),
        help="axis up in the picture (default: that of the format, mostly z)",
    )


def run(args: argparse.Namespace) -> int:
    """Import as specified by ``args`` and print a summary; return the exit status 0.

    Raises:
        IrrcacheError: invalid input; no files are written then.
    """
    display = StageDisplay(is_updated=False)  # large volumes have progress bars
    if args.colour is not None:
        return _run_in_colour(args, display)
    with display.stage(f"reading {args.input[0]}"):
        volume, mapping = _volume(args)
    with display.stage("computing extinction and albedo"):
        baked = processing.bake(volume, mapping, _target_size(volume, args), args.supersample)
    return _write(args, display, mapping, baked)


def _run_in_colour(args: argparse.Namespace, display: StageDisplay) -> int:
    """Import channels as albedo, emission or extinction."""
    mapping = _mapping(args)
    _check_colour(args, mapping)
    with display.stage(f"reading {args.input[0]}"):
        channels = read_colours(args.input[0], args.colour, lambda number: _read(args, number))
    with display.stage("computing extinction and albedo"):
        size = _target_size(_cropped(channels.density, args), args)
        if args.colour == "extinction":
            parts = [_process(channel, args) for channel in channels.rgb]
            baked = [processing.bake(part, mapping, size, args.supersample) for part in parts]
            resampled, _, albedo = baked[0]
            sigma_t = np.stack([extinction for _, extinction, _ in baked], axis=-1)
            return _write(args, display, mapping, (resampled, sigma_t, albedo))
        density = _process(channels.density, args)
        resampled, sigma_t, albedo = processing.bake(density, mapping, size, args.supersample)
        rgb = _resampled_rgb(channels, size, args)
    if args.colour == "albedo":
        return _write(args, display, mapping, (resampled, sigma_t, np.minimum(rgb, 1.0)))
    return _write(args, display, mapping, (resampled, sigma_t, albedo), rgb)


def _check_colour(args: argparse.Namespace, mapping: TransferFunction | DensityMapping) -> None:
    option = f"--colour {args.colour}"
    if args.cloud or args.channel is not None:
        other = "--cloud" if args.cloud else "--channel"
        raise IrrcacheError(f"{option} and {other} exclude each other; leave one of them out")
    if args.raw_shape is not None or args.input[0].startswith("phantom:"):
        raise IrrcacheError(f"{args.input[0]}: {option} needs a file with 3 or 4 channels")
    if args.colour == "albedo" and args.albedo is not None:
        raise IrrcacheError(f"{option} and --albedo both state the albedo; leave one of them out")
    if args.colour == "extinction" and not isinstance(mapping, DensityMapping):
        raise IrrcacheError(f"{option} needs --density: a transfer function maps one channel")
    if args.colour == "extinction" and args.isolate is not None:
        raise IrrcacheError(f"{option} does not support --isolate; import one --channel with it")


def _cropped(volume: VolumeData, args: argparse.Namespace) -> VolumeData:
    """Apply the steps that move voxels and do not change their values."""
    if args.flip:
        volume = processing.flip(volume, args.flip)
    return volume if args.crop is None else processing.crop(volume, args.crop)


def _resampled_rgb(
    channels: ColourVolume, size: processing.Size, args: argparse.Namespace
) -> np.ndarray:
    """Return linear colours at ``size`` voxels, float32 ``(z, y, x, 3)``."""
    parts = [_cropped(linear(channel, args.colour), args) for channel in channels.rgb]
    if size != parts[0].size:
        parts = [processing.resample(part, size) for part in parts]
    return np.stack([part.values for part in parts], axis=-1)


def _write(
    args: argparse.Namespace,
    display: StageDisplay,
    mapping: TransferFunction | DensityMapping,
    baked: tuple[VolumeData, np.ndarray, np.ndarray],
    emission: np.ndarray | None = None,
) -> int:
    resampled, sigma_t, albedo = baked
    settings = scene_settings(args, "volpath" if emission is None else "irrcache")
    with display.stage(f"writing {args.output}"):
        written = write_scene(
            args.output, resampled, mapping, sigma_t, albedo, settings, args.overwrite, emission
        )
    print(_summary(resampled, sigma_t, albedo, written, args.output))
    if emission is not None:
        print(f"emission       0 .. {emission.max():.4g} per unit length (integrator irrcache)")
    return 0


def read(
    args: argparse.Namespace,
) -> tuple[VolumeData, TransferFunction | DensityMapping, Colours | None]:
    """Read the volume given by ``args`` at the requested resolution, and its appearance."""
    if args.colour is not None:
        return _read_in_colour(args)
    volume, mapping = _volume(args)
    return _resampled(volume, args), mapping, None


def _read_in_colour(
    args: argparse.Namespace,
) -> tuple[VolumeData, TransferFunction | DensityMapping, Colours]:
    _check_appearance(args)
    mapping = _mapping(args)
    _check_colour(args, mapping)
    channels = read_colours(args.input[0], args.colour, lambda number: _read(args, number))
    density = _resampled(_process(channels.density, args), args)
    if args.colour == "extinction":
        parts = [_resampled(_process(channel, args), args).values for channel in channels.rgb]
        rgb = np.stack(parts, axis=-1).astype(np.float32)
    else:
        rgb = _resampled_rgb(channels, density.size, args)
    if args.colour == "albedo":
        rgb = np.minimum(rgb, 1.0)
    return density, mapping, Colours(args.colour, rgb)


def read_small(
    args: argparse.Namespace,
) -> tuple[VolumeData, TransferFunction | DensityMapping] | None:
    """Make a volume like that of `read` in few voxels; None where a file has to be read."""
    name = args.input[0].removeprefix("phantom:").partition(":")[0]
    if not _is_phantom(args) or name not in _PHANTOMS or args.crop is not None:
        return None
    return _volume(argparse.Namespace(**vars(args) | {"input": [f"phantom:{name}:{SMALL}"]}))


def _resampled(volume: VolumeData, args: argparse.Namespace) -> VolumeData:
    """Return a volume at the requested resolution."""
    size = _target_size(volume, args)
    return volume if size == volume.size else processing.resample(volume, size)


def _volume(args: argparse.Namespace) -> tuple[VolumeData, TransferFunction | DensityMapping]:
    _check_appearance(args)
    mapping = _mapping(args)
    volume = _process(_read(args), args)
    _warn_about_unit(volume, mapping)
    return volume, mapping


def scene_settings(args: argparse.Namespace, integrator: str = "volpath") -> SceneSettings:
    """Return the defaults of the scene's parameters for ``args``."""
    asymmetry = args.asymmetry
    if asymmetry is None:
        asymmetry = CLOUD_ASYMMETRY if args.cloud else 0.0
    max_depth = args.max_depth
    if max_depth is None:
        max_depth = -1 if asymmetry else 2
    settings = SceneSettings(
        integrator=integrator, max_depth=max_depth, asymmetry=asymmetry, up=up_axis(args)
    )
    # A cloud that absorbs nothing is invisible before a uniform environment: add a sun.
    return replace(settings, radiance=CLOUD_SKY, sun=CLOUD_SUN) if args.cloud else settings


def _check_appearance(args: argparse.Namespace) -> None:
    if not has_appearance(args):
        raise IrrcacheError(
            f"{args.input[0]}: give --preset, --transfer-function, --density or --cloud."
        )


def has_appearance(args: argparse.Namespace) -> bool:
    """Return whether ``args`` specify the appearance of a volume."""
    given = (args.preset, args.transfer_function, args.density)
    return args.cloud or any(v is not None for v in given)


def _add_appearance(group: argparse._ArgumentGroup, required: bool) -> None:
    choice = group.add_mutually_exclusive_group(required=required)
    choice.add_argument("--preset", metavar="NAME", help=", ".join(preset_names()))
    choice.add_argument(
        "--transfer-function",
        metavar="FILE",
        help="a JSON file, of VPT, too, or 3D Slicer's volume property: .vp, or presets.xml:NAME",
    )
    choice.add_argument(
        "--density",
        type=finite,
        nargs="?",
        const=1.0,
        metavar="SCALE",
        help="the values are densities: sigma_t = SCALE * value (default: 1)",
    )
    choice.add_argument(
        "--cloud",
        action="store_true",
        help="NetCDF or Zarr with liquid water content and effective radius: "
        "sigma_t = 3 LWC / (2 rho_water r_eff), asymmetry 0.85",
    )
    group.add_argument(
        "--albedo",
        type=_numbers,
        metavar="A | R,G,B",
        help="with --density or --cloud: the albedo (default: 1)",
    )
    group.add_argument(
        "--asymmetry",
        type=_asymmetry,
        metavar="G",
        help="mean cosine of the Henyey-Greenstein phase function (default: 0, isotropic)",
    )
    group.add_argument(
        "--liquid-water", metavar="NAME", help="with --cloud: its variable, if not found by name"
    )
    group.add_argument(
        "--effective-radius",
        metavar="NAME | UM",
        help="with --cloud: its variable, or one radius in micrometres",
    )
    group.add_argument(
        "--air-density",
        type=finite,
        metavar="KG_PER_M3",
        help="with --cloud: for mixing ratios, if the file has no density of air",
    )


def _add_processing(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--flip", metavar="AXES", type=_axes, default="", help="mirror, e.g. z, xz")
    group.add_argument(
        "--crop", type=_ranges, metavar="X0:X1,Y0:Y1,Z0:Z1", help="crop to these voxels"
    )
    group.add_argument(
        "--rescale",
        type=_numbers,
        metavar="SLOPE,INTERCEPT",
        help="for example to Hounsfield units",
    )
    group.add_argument(
        "--clip",
        type=_interval,
        metavar="A:B",
        help="limit the values to A..B; write --clip=-100:500 where A is negative",
    )
    group.add_argument(
        "--isolate",
        type=finite,
        metavar="VALUE",
        help="keep the largest object above VALUE; -300 removes the table below a patient",
    )
    size = group.add_mutually_exclusive_group()
    size.add_argument("--voxel-size", type=finite, metavar="MM", help="resample to cubic voxels")
    size.add_argument(
        "--longest", type=int, metavar="N", help="resample to N voxels along the longest side"
    )
    group.add_argument(
        "--supersample",
        type=int,
        default=1,
        metavar="K",
        help="apply the transfer function at K times the resolution; preserves thin bone",
    )


def _add_selection(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--field", metavar="NAME", help="the array, variable, grid or data set")
    group.add_argument(
        "--channel", type=whole(0), metavar="N", help="which value of each voxel, counted from 0"
    )
    group.add_argument(
        "--colour",
        choices=USES,
        help="read 3 channels as red, green and blue: the albedo or emission of a density, which "
        "is a 4th channel or their luminance; or extinctions (with --density)",
    )
    group.add_argument("--frame", type=whole(0), metavar="N", help="which time step, from 0")
    group.add_argument(
        "--spacing",
        type=_numbers,
        metavar="X,Y,Z",
        help="distance between voxel centres, in place of that of the file",
    )


def _add_raw(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--raw-shape", type=_counts, metavar="X,Y,Z", help="voxels; marks raw input")
    group.add_argument("--raw-type", default="uint8", help="e.g. uint16, float32 (default: uint8)")
    group.add_argument("--raw-endian", choices=("little", "big"), default="little")
    group.add_argument("--raw-spacing", type=_numbers, default=(1.0, 1.0, 1.0), metavar="X,Y,Z")
    group.add_argument("--raw-offset", type=whole(0), default=0, metavar="BYTES")


def _mapping(args: argparse.Namespace) -> TransferFunction | DensityMapping:
    if args.density is None and not args.cloud and args.albedo is not None:
        raise IrrcacheError(
            "--albedo needs --density or --cloud; a transfer function has its own colours"
        )
    if args.preset is not None:
        return load_preset(args.preset)
    if args.transfer_function is not None:
        return transfer_files.load(args.transfer_function)
    albedo = args.albedo or (1.0,)
    scale = 1.0 if args.cloud else args.density
    return DensityMapping(scale, albedo * 3 if len(albedo) == 1 else albedo)


def _read(args: argparse.Namespace, channel: int | None = None) -> VolumeData:
    source = args.input[0]
    if _is_phantom(args):
        return _phantom(source)
    raw = None
    if args.raw_shape is not None:
        raw = RawLayout(
            args.raw_shape, args.raw_type, args.raw_endian, args.raw_spacing, args.raw_offset
        )
    return read_volume(
        source if len(args.input) == 1 else args.input,
        raw=raw,
        series=args.series,
        replace_nan=args.replace_nan,
        options=ReadOptions(
            args.field,
            args.channel if channel is None else channel,
            args.frame,
            args.spacing,
            args.data_folder,
        ),
        cloud=_cloud(args),
    )


def _is_phantom(args: argparse.Namespace) -> bool:
    return args.input[0].partition(":")[0] == "phantom" and len(args.input) == 1


def _cloud(args: argparse.Namespace) -> CloudVariables | None:
    """Return the variables of a cloud, None without --cloud."""
    given = (args.liquid_water, args.effective_radius, args.air_density)
    if not args.cloud and any(value is not None for value in given):
        raise IrrcacheError(
            "--liquid-water, --effective-radius and --air-density need --cloud; add it"
        )
    if not args.cloud:
        return None
    radius = args.effective_radius
    with suppress(TypeError, ValueError):  # None, or the name of a variable
        radius = float(radius)
    if isinstance(radius, float) and not 0 < radius < math.inf:
        raise IrrcacheError(f"--effective-radius is {radius:g}; give micrometres above 0")
    if args.air_density is not None and args.air_density <= 0:
        raise IrrcacheError(f"--air-density is {args.air_density:g}; give kg/m^3 above 0")
    return CloudVariables(args.liquid_water, radius, args.air_density)


def _phantom(source: str) -> VolumeData:
    """Create ``phantom:NAME``, or ``phantom:NAME:X,Y,Z`` with the number of voxels."""
    # Imported here because no other input needs it.
    from mitsuba_irrcache.volumes import phantom

    name, _, size = source.removeprefix("phantom:").partition(":")
    if name not in _PHANTOMS:
        known = " and ".join(f"phantom:{known}" for known in _PHANTOMS)
        raise IrrcacheError(f"no phantom {name!r}{suggestion(name, _PHANTOMS)}; there are {known}")
    make = getattr(phantom, name)
    if not size:
        return make()
    try:
        x, y, z = _counts(size)
    except argparse.ArgumentTypeError as error:
        raise IrrcacheError(f"phantom size {error}") from None
    return make((z, y, x))


def _process(volume: VolumeData, args: argparse.Namespace) -> VolumeData:
    volume = _cropped(volume, args)
    if args.rescale is not None:
        if len(args.rescale) != 2:
            raise IrrcacheError(f"--rescale {args.rescale}: give SLOPE,INTERCEPT")
        volume = processing.rescale(volume, *args.rescale)
    if args.clip is not None:
        volume = processing.clip(volume, *args.clip)
    if args.isolate is not None:
        volume = processing.isolate(volume, args.isolate)
    return volume


def _target_size(volume: VolumeData, args: argparse.Namespace) -> processing.Size:
    if args.voxel_size is not None:
        return processing.size_for_voxel(volume, args.voxel_size)
    if args.longest is not None:
        return processing.size_for_longest(volume, args.longest)
    return volume.size


def up_axis(args: argparse.Namespace) -> str:
    """Return the up axis: y for graphics volumes, z (to the patient's head) for medical ones."""
    if args.up is not None:
        return args.up
    known = format_of(Path(args.input[0]))
    return known.up if known is not None else "z"


def _warn_about_unit(volume: VolumeData, mapping: TransferFunction | DensityMapping) -> None:
    if isinstance(mapping, DensityMapping) or mapping.unit != "HU" or volume.unit == "HU":
        return
    low = float(volume.values.min())
    if low > _AIR_LIKE:
        print(
            f"warning: the transfer function is in HU, but the least value of {volume.source} is "
            f"{low:g}, not about -1000; if air is 0 there, give --rescale 1,-1000",
            file=sys.stderr,
        )


def _summary(
    volume: VolumeData, sigma_t: np.ndarray, albedo: np.ndarray, written: int, output: str
) -> str:
    """Summarise the import in a few lines that make a wrong unit or spacing obvious."""
    extinction = sigma_t if sigma_t.ndim == 3 else sigma_t.max(axis=-1)
    depths = [
        float((extinction.sum(axis=2 - axis, dtype=np.float64) * spacing).max())
        for axis, spacing in enumerate(volume.spacing)
    ]
    size = " x ".join(str(n) for n in volume.size)
    spacing = " x ".join(f"{s:.4g}" for s in volume.spacing)
    extent = " x ".join(f"{e:.4g}" for e in volume.physical_size)
    empty = 1.0 - np.count_nonzero(extinction) / extinction.size
    values = np.asarray(volume.values)
    unit = f" {volume.unit}" if volume.unit else ""
    length = f" ({volume.length_unit})" if volume.length_unit else ""
    lines = [
        f"source         {volume.source}",
        f"size           {size} voxels of {spacing}, {extent} in all{length}",
        f"values         {values.min():.6g} .. {values.max():.6g}{unit}",
        f"sigma_t        {sigma_t.min():.4g} .. {sigma_t.max():.4g} per unit length, "
        f"{empty:.1%} of voxels empty",
        f"albedo         {albedo.min():.3g} .. {albedo.max():.3g}",
        "optical depth  at most " + ", ".join(f"{d:.3g}" for d in depths) + " along x, y, z",
        f"written        {written / 1e6:,.2f} MB to {output}",
    ]
    return "\n".join(lines)


@argument("numbers separated by commas, for example 0.9 or 0.9,0.5,0.4")
def _numbers(text: str) -> tuple[float, ...]:
    return tuple(finite_number(part) for part in text.split(","))


@argument("a mean cosine between -1 and 1, for example 0.85")
def _asymmetry(text: str) -> float:
    value = finite_number(text)
    if not -1 < value < 1:
        raise ValueError
    return value


@argument("three whole numbers of voxels X,Y,Z, each at least 1, for example 40,32,24")
def _counts(text: str) -> tuple[int, ...]:
    counts = tuple(int(part) for part in text.split(","))
    if len(counts) != 3 or min(counts) < 1:
        raise ValueError
    return counts


@argument("some of the letters x, y, z")
def _axes(text: str) -> str:
    if set(text) - set("xyz"):
        raise ValueError
    return text


@argument("A:B, two numbers of which one may be left out, for example -100:500")
def _interval(text: str) -> tuple[float, float]:
    low, separator, high = text.partition(":")
    if not separator:
        raise ValueError
    return (float(low) if low else -math.inf, float(high) if high else math.inf)


@argument("X0:X1,Y0:Y1,Z0:Z1 in whole voxels, for example 10:50,:,0:20; a bare : keeps all")
def _ranges(text: str) -> list[tuple[int | None, int | None]]:
    parts = text.split(",")
    if len(parts) != 3 or any(part.count(":") != 1 for part in parts):
        raise ValueError
    return [tuple(int(n) if n else None for n in part.split(":")) for part in parts]
