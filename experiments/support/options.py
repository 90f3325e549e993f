"""Sizes, folders and command line of all experiments."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.machine.llvm import require_llvm


@dataclass(frozen=True)
class Size:
    """The size of the paper's experiments.

    Attributes:
        longest: voxels of a volume along its longest side.
        pixels: of an image, per side.
        horizon: seconds for every method on the chest.
        others: seconds for every method on the other volumes.
        reference: seconds for the reference of the chest; half of it for the others'.
    """

    longest: int
    pixels: int
    horizon: float
    others: float
    reference: float


#: As many cache voxels per pixel as in the paper, in about half an hour on two cores.
QUICK = Size(longest=96, pixels=128, horizon=60, others=20, reference=180)
#: The paper's size: a chest of 512 x 150 x 350 voxels, 1024 x 1024 pixels, 5 minutes.
FULL = Size(longest=512, pixels=1024, horizon=300, others=100, reference=3600)


@dataclass(frozen=True)
class Options:
    """Size, output folder, whether to recompute existing results, and a Markdown file.

    The marked tables of the Markdown file are replaced.
    """

    size: Size = QUICK
    output: Path = Path("output")
    force: bool = False
    document: Path | None = None

    def folder(self, experiment: str) -> Path:
        """Return the folder of an experiment; the full size has its own."""
        path = self.output / ("full" if self.size == FULL else "") / experiment
        path.mkdir(parents=True, exist_ok=True)
        return path


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of all experiments that save results."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--force", action="store_true", help="compute again what is there")
    parser.add_argument("-o", "--output", type=Path, default=Path("output"))
    return parser


def add_document(parser: argparse.ArgumentParser) -> None:
    """Declare the option of experiments whose tables are part of the documentation."""
    parser.add_argument(
        "--document", type=Path, help="Markdown file whose marked tables are replaced"
    )


def begin(variant: str = "llvm_ad_rgb") -> None:
    """Set Mitsuba's variant."""
    if variant.startswith("llvm"):
        require_llvm()
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)


def parse(description: str | None, documented: bool = False) -> Options:
    """Parse the command line, with ``--document`` if ``documented``; set Mitsuba's variant."""
    parser = parser_of(description)
    if documented:
        add_document(parser)
    parser.add_argument("--full", action="store_true", help="the paper's sizes: hours")
    args = parser.parse_args()
    begin()
    document = args.document if documented else None
    return Options(FULL if args.full else QUICK, args.output, args.force, document)
