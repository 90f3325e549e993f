"""Renders the image at the top of README.md: ``python -m experiments.docs.cover``.

A chest phantom with single scattering, and a cloud with all orders, both at default settings; half
a minute on two cores. Writes docs/images/cover.jpg.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.support.options import begin
from mitsuba_irrcache.cli.main import main as irrcache
from mitsuba_irrcache.io.scene_files import load_scene

SIZE, SPP, QUALITY = 400, 32, 88
#: Arguments of ``irrcache import``, and parameters of the scene that it writes.
CHEST = ["phantom:thorax:190,120,165", "--preset", "ct-chest", "--supersample", "2"]
CHEST_SCENE = {"max_depth": "2", "hide_emitters": "true", "radiance": "2"}
CLOUD = ["phantom:cloud", "--density", "60", "--albedo", "0.995"]
CLOUD_SCENE = {"max_depth": "-1"}
#: In place of the even sky of the imported scene.
SKY = '<rgb name="radiance" value="0.16, 0.3, 0.55"/>'
SUN = """</emitter>
    <emitter type="directional">
        <vector name="direction" x="-0.7" y="1" z="-0.8"/>
        <rgb name="irradiance" value="2.4, 2.2, 1.9"/>
    </emitter>
"""


def main() -> None:
    """Renders both images, one beside the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images/cover.jpg"))
    args = parser.parse_args()
    begin()
    with tempfile.TemporaryDirectory() as folder:
        chest = rendered(Path(folder) / "chest", CHEST, CHEST_SCENE)
        cloud = rendered(Path(folder) / "cloud", CLOUD, CLOUD_SCENE, under_a_sun)
    strip = mi.Bitmap(np.concatenate([chest, cloud], axis=1).astype(np.float32))
    strip = strip.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    strip.write(str(args.output), quality=QUALITY)
    print(args.output)


def rendered(folder: Path, source: list[str], parameters: dict, edit=lambda text: text):
    """The image of an imported volume."""
    if irrcache(["import", *source, "-o", str(folder)]):
        raise SystemExit(1)
    path = folder / "scene.xml"
    path.write_text(edit(path.read_text()))
    size = {"width": str(SIZE), "height": str(SIZE)}
    scene = load_scene(path, parameters | size, "irrcache")
    return np.array(mi.render(scene, spp=SPP))[..., :3]


def under_a_sun(text: str) -> str:
    """The text of a scene with a blue sky and a sun."""
    white = '<rgb name="radiance" value="$radiance, $radiance, $radiance"/>'
    return text.replace(white, SKY).replace("</emitter>\n", SUN, 1)


if __name__ == "__main__":
    main()
