"""``irrcache farm``: render on many workers: caches, frames, references, studies.

Workers are processes of this machine, or those of a Dask scheduler that runs already, on a cluster
with SLURM or Kubernetes, for example. Finished results are written at once and are never computed
again: after any interruption ``--resume`` continues.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mitsuba_irrcache.cli.render import add_scene_options
from mitsuba_irrcache.compare.command import (
    add_measurement_options,
    add_modules,
    add_reference_options,
)
from mitsuba_irrcache.core.argument_types import whole
from mitsuba_irrcache.farm.cluster import add_cluster_options
from mitsuba_irrcache.machine.extras import require


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the kinds of runs and their options."""
    kinds = parser.add_subparsers(title="kinds", required=True, metavar="KIND", dest="kind")
    for name, text, declare in (
        ("cache", "fill one cache", _add_cache_options),
        ("frames", "render many frames", _add_frame_options),
        ("reference", "render a reference for irrcache compare", _add_reference_options),
        ("study", "compare integrators on several scenes", _add_study_options),
    ):
        kind = kinds.add_parser(name, help=text, description=f"{text}, on many workers")
        declare(kind)
        add_scene_options(kind)
        kind.add_argument("--resume", action="store_true", help="continue an earlier run")
        add_modules(kind)
        add_cluster_options(kind)


def _add_cache_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", help="scene XML")
    parser.add_argument("-o", "--output", type=Path, required=True, help="file of the cache")
    _add_integrator(parser)


def _add_frame_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("scene", help="scene XML, a template with $parameters")
    add("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder of the images")
    _add_integrator(parser)
    add(
        "--vary", action="append", default=[], metavar="KEY=VALUES",
        help="values of a $parameter, one per frame: first:last:count, a list a,b,c, or a pattern "
        "of file names beside the scene; several vary together; repeatable",
    )  # fmt: skip
    add(
        "--table", type=Path, metavar="CSV",
        help="table of $parameters: a column for each, a row per frame (a camera path, ...)",
    )  # fmt: skip
    add("--sensors", default="0", metavar="LIST", help='indices such as 0,2, or "all" (default: 0)')
    add("--spp", type=whole(0), default=0, help="samples per pixel (default: the scene's)")
    add("--seed", type=whole(0), default=0, help="seed of the camera samples (default: 0)")


def _add_reference_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", help="scene XML")
    _add_reference(parser)


def _add_study_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenes", nargs="+", metavar="scene", help="scene XML; repeatable")
    add_measurement_options(parser)
    parser.add_argument(
        "-o", "--output", required=True, metavar="FOLDER", help="folder with a report per scene"
    )
    _add_reference(parser)


def _add_integrator(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-i", "--integrator", metavar="NAME{KEY=VALUE,...}",
        help="integrator and its properties (default: irrcache in place of a path tracer)",
    )  # fmt: skip


def _add_reference(parser: argparse.ArgumentParser) -> None:
    add_reference_options(parser)
    parser.add_argument(
        "--reference-spp", type=whole(1), default=1024, metavar="N",
        help="samples per pixel of each of the two halves of the reference (default: %(default)s)",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Run all jobs that are missing; return 1 if some failed."""
    require("distributed", "farm", "irrcache farm")
    from mitsuba_irrcache.farm import runs

    return runs.KINDS[args.kind](args)
