"""``irrcache farm``: render on many workers: caches, frames, references, studies.

Workers are processes of this machine, or those of a Dask scheduler that runs already, on a cluster
with SLURM or Kubernetes, for example. Finished results are written at once and are never computed
again: after any interruption ``--resume`` continues.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mitsuba_irrcache.cli.render import add_scene_options
from mitsuba_irrcache.core.argument_types import finite, whole
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
        kind.add_argument(
            "--import", dest="modules", action="append", default=[], metavar="MODULE",
            help="Python module that registers third-party plugins; repeatable",
        )  # fmt: skip
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
    parser.add_argument("-s", "--sensor", type=whole(0), default=0, help="index (default: 0)")
    _add_reference(parser)


def _add_study_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("scenes", nargs="+", metavar="scene", help="scene XML; repeatable")
    add(
        "-i", "--integrator", action="append", required=True, metavar="NAME{KEY=VALUE,...}",
        help="integrator to compare, quoted, with properties; repeatable",
    )  # fmt: skip
    add("-o", "--output", required=True, metavar="FOLDER", help="folder with a report per scene")
    add(
        "--budget", default="1,3,12", metavar="SECONDS,...",
        help="times to compare errors at (default: %(default)s); run one worker per machine",
    )  # fmt: skip
    add("-s", "--sensor", type=whole(0), default=0, help="index of the sensor (default: 0)")
    add("--exposure", type=finite, default=0.0, metavar="EV", help="of displayed images, in stops")
    _add_reference(parser)


def _add_integrator(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-i", "--integrator", metavar="NAME{KEY=VALUE,...}",
        help="integrator and its properties (default: irrcache in place of a path tracer)",
    )  # fmt: skip


def _add_reference(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--reference", default="volpath", metavar="NAME{KEY=VALUE,...}",
        help="unbiased integrator that makes the reference (default: %(default)s)",
    )  # fmt: skip
    add(
        "--reference-spp", type=whole(1), default=1024, metavar="N",
        help="samples per pixel of each of its two halves (default: %(default)s)",
    )  # fmt: skip
    add(
        "--references", type=Path, default=None, metavar="FOLDER",
        help="folder of the references (default: irrcache/references in your cache folder)",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Run all jobs that are missing; return 1 if some failed."""
    require("distributed", "farm", "irrcache farm")
    from mitsuba_irrcache.farm import runs

    return runs.KINDS[args.kind](args)
