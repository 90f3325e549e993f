"""The scenes of the experiments: real volumes if available, else procedural phantoms.

Real volumes are looked up in the folder that IRRCACHE_DATA names, or in ../shared/data.
"""

from __future__ import annotations

import os
import tarfile
from dataclasses import dataclass
from pathlib import Path

from mitsuba_irrcache.cli.main import main as irrcache

DATA = Path(os.environ.get("IRRCACHE_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))


@dataclass(frozen=True)
class Source:
    """A volume's origin and import options.

    Attributes:
        about: description for a caption.
        arguments: of ``irrcache import``. "data:" marks files below DATA, "tar:" archives there
            that are unpacked first, "phantom" a chest and "phantom:cloud" a cloud of the requested
            size.
        longest: default voxels along the longest side; 0: those of the data.
        substitute: name of the source that replaces it if its data are missing.
    """

    about: str
    arguments: tuple[str, ...]
    longest: int = 0
    substitute: str = ""


_CT_HEAD = (
    "data:unc_cthead/CThead.*",
    *("--raw-shape", "256,256,113", "--raw-type", "uint16", "--raw-endian", "big"),
    *("--raw-spacing", "0.9,0.9,1.8", "--rescale", "1,-1024", "--flip", "z"),
)
# Cropped to the patient; -300 HU separates the body from the table.
_CT_CHEST = ("tar:lidc_chest_ct/*.tar.gz", "--isolate", "-300", "--crop")
_ORGANS = str(Path(__file__).with_name("abdomen.json"))

SOURCES = {
    "phantom": Source("thorax phantom", ("phantom", "--preset", "ct-chest"), 128),
    "cloud": Source(
        "Disney cloud, 1/16",
        ("data:wdas_cloud/wdas_cloud_sixteenth.vol", "--density", "40", "--albedo", "0.99"),
    ),
    "procedural": Source(
        "procedural cloud", ("phantom:cloud", "--density", "20", "--albedo", "0.99"), 128
    ),
    "head": Source("UNC CT head", (*_CT_HEAD, "--preset", "ct-bone"), 128, "phantom-bones"),
    "chest": Source(
        "chest CT LIDC-IDRI-0314",
        (*_CT_CHEST, ":,60:456,:", "--preset", "ct-chest", "--supersample", "2"),
        128,
        "phantom",
    ),
    "abdomen": Source(
        "upper abdomen of LIDC-IDRI-0314",
        (*_CT_CHEST, ":,60:456,0:115", "--transfer-function", _ORGANS, "--supersample", "2"),
        128,
        "phantom-organs",
    ),
    "phantom-paper": Source(
        "thorax phantom as large as the paper's chest",
        ("phantom:thorax:512,150,350", "--preset", "ct-chest"),
    ),
    "phantom-bones": Source("thorax phantom, bones", ("phantom", "--preset", "ct-bone"), 128),
    "phantom-organs": Source(
        "thorax phantom, organs", ("phantom", "--transfer-function", _ORGANS), 128
    ),
}


def scene_file(name: str, output: Path, longest: int = 0) -> Path | None:
    """Return the scene's XML below ``output``, imported if missing; None if its data are
    missing.
    """
    source = SOURCES[name]
    path = output / "scenes" / (f"{name}-{longest}" if longest else name) / "scene.xml"
    if path.exists():
        return path
    arguments: list[str] = []
    size = longest or source.longest
    for argument in source.arguments:
        found = _resolve(argument, output, size)
        if not found:
            print(f"{name}: no {argument.partition(':')[2]} in {DATA}")
            return None
        arguments += found
    if size and source.arguments[0].partition(":")[0] != "phantom":
        arguments += ["--longest", str(size)]
    path.parent.parent.mkdir(parents=True, exist_ok=True)
    if irrcache(["import", *arguments, "-o", str(path.parent)]):
        raise SystemExit(1)
    return path


def available(name: str) -> str:
    """Return ``name``, or its substitute if its data are missing."""
    first = SOURCES[name].arguments[0]
    marker, _, pattern = first.partition(":")
    if marker in ("data", "tar") and not any(DATA.glob(pattern)):
        return SOURCES[name].substitute
    return name


def _resolve(argument: str, output: Path, longest: int) -> list[str]:
    """Resolve an argument for the command line; None if data are missing."""
    marker, _, pattern = argument.partition(":")
    if argument == "phantom":
        return [f"phantom:thorax:{longest},{5 * longest // 8},{7 * longest // 8}"]
    if argument == "phantom:cloud":
        return [f"phantom:cloud:{longest},{longest},{longest}"]
    if marker == "data":
        return [str(path) for path in sorted(DATA.glob(pattern), key=_natural)]
    if marker == "tar":
        return _unpacked(sorted(DATA.glob(pattern)), output / "data" / pattern.partition("/")[0])
    return [argument]


def _unpacked(archives: list[Path], folder: Path) -> list[str]:
    """Return the folder with the contents of all ``archives``."""
    if not archives:
        return []
    for archive in archives:
        done = folder / f"{archive.name}.done"
        if not done.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with tarfile.open(archive) as file:
                file.extractall(folder, filter="data")
            done.touch()
    return [str(folder)]


def _natural(path: Path) -> tuple[int, str]:
    suffix = path.suffix[1:]
    return (int(suffix) if suffix.isdigit() else 0, path.name)
