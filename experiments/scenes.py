"""The scenes of the experiments: phantoms that are generated, and real volumes where they are at
hand.

Real volumes are looked for in the folder that IRRCACHE_DATA names, or in ../shared/data.
"""

from __future__ import annotations

import os
from pathlib import Path

from mitsuba_irrcache.cli import main as irrcache

DATA = Path(os.environ.get("IRRCACHE_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))

#: arguments of ``irrcache import``; the first ones that are paths below DATA are marked by "data:"
IMPORTS = {
    "phantom": ["phantom:thorax:128,80,112", "--preset", "ct-chest"],
    "cloud": ["data:wdas_cloud/wdas_cloud_sixteenth.vol", "--density", "40", "--albedo", "0.99"],
    "head": [
        "data:unc_cthead/CThead.*",
        *("--raw-shape", "256,256,113", "--raw-type", "uint16", "--raw-endian", "big"),
        *("--raw-spacing", "0.9,0.9,1.8", "--rescale", "1,-1024", "--flip", "z"),
        *("--longest", "128", "--preset", "ct-bone"),
    ],
}


def scene_file(name: str, output: Path) -> Path | None:
    """The scene's XML below ``output``, imported if it is not there yet; None where its data are
    not at hand.
    """
    path = output / "scenes" / name / "scene.xml"
    if path.exists():
        return path
    arguments: list[str] = []
    for argument in IMPORTS[name]:
        if argument.startswith("data:"):
            found = sorted(DATA.glob(argument.removeprefix("data:")), key=_natural)
            if not found:
                print(f"{name}: skipped, no {argument.removeprefix('data:')} in {DATA}")
                return None
            arguments += map(str, found)
        else:
            arguments.append(argument)
    path.parent.parent.mkdir(parents=True, exist_ok=True)
    if irrcache(["import", *arguments, "-o", str(path.parent)]):
        raise SystemExit(1)
    return path


def _natural(path: Path) -> tuple[int, str]:
    suffix = path.suffix[1:]
    return (int(suffix) if suffix.isdigit() else 0, path.name)
