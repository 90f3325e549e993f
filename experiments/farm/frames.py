"""24 frames of a cloud that evolves under a moving camera: by workers, and by one process in
sequence.

    python -m experiments.farm.frames [--rounds 2] [--force] [--document docs/how-to/farm.md]

Each frame has a volume of its own (64^3 voxels, all orders of scattering) and a position of the
camera, from a table of parameters. The process that renders them one by one uses both cores, the
two workers one each. Of several rounds, in turns, the shortest counts. Compares the images pixel by
pixel. Writes output/farm/frames.json.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.farm.commands import begun, finished, load, load_note
from experiments.support.documents import replace_tables
from experiments.support.options import parser_of
from mitsuba_irrcache.compare.tables import Table
from mitsuba_irrcache.io.images import read_image
from mitsuba_irrcache.volumes.phantom.cloud import cloud

FRAMES, VOXELS, PIXELS = 24, 64, 256
DENSITY = 20.0
SCENE = f"""<scene version="3.0.0">
    <integrator type="irrcache"/>
    <sensor type="perspective">
        <float name="fov" value="34"/>
        <transform name="to_world">
            <lookat origin="$x, $y, 0.4" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"> <integer name="sample_count" value="16"/> </sampler>
        <film type="hdrfilm">
            <integer name="width" value="{PIXELS}"/> <integer name="height" value="{PIXELS}"/>
            <string name="component_format" value="float32"/>
        </film>
    </sensor>
    <emitter type="constant"> <rgb name="radiance" value="0.25, 0.35, 0.55"/> </emitter>
    <emitter type="directional">
        <vector name="direction" x="-1" y="1" z="-1.2"/>
        <rgb name="irradiance" value="3, 2.8, 2.4"/>
    </emitter>
    <shape type="cube">
        <bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="$volume"/>
                <transform name="to_world">
                    <translate value="-.5, -.5, -.5"/> <scale value="2"/>
                </transform>
            </volume>
            <float name="albedo" value="0.99"/>
        </medium>
    </shape>
</scene>
"""
#: Renders the rows of a table one by one in one process, and prints its seconds.
_IN_SEQUENCE = """
import csv, sys, time
started = time.perf_counter()
import mitsuba as mi, numpy as np
import mitsuba_irrcache
from mitsuba_irrcache.io.images import write_image
from mitsuba_irrcache.io.scene_files import load_scene
mi.set_variant("llvm_ad_rgb")
with open(sys.argv[2]) as file:
    for number, row in enumerate(csv.DictReader(file)):
        scene = load_scene(sys.argv[1], row)
        image = np.array(mi.render(scene, seed=0))
        write_image(f"{sys.argv[3]}/{number}.exr", image, {})
print(time.perf_counter() - started)
"""


def write_frames(folder: Path) -> tuple[Path, Path]:
    """Write the scene, its volumes, and the table of parameters; return scene and table."""
    first = cloud((VOXELS,) * 3).values
    last = np.roll(first[:, ::-1, ::-1], 3, axis=0)
    for number in range(FRAMES):
        share = number / (FRAMES - 1)
        values = DENSITY * ((1 - share) * first + share * last)
        mi.VolumeGrid(values.astype(np.float32)[..., None]).write(str(folder / f"{number}.vol"))
    angles = np.linspace(0, np.pi / 2, FRAMES)
    with open(folder / "table.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["volume", "x", "y"])
        for number, angle in enumerate(angles):
            place = f"{5 * np.sin(angle):.6g}", f"{-5 * np.cos(angle):.6g}"
            rows.writerow([f"{number}.vol", *place])
    (folder / "scene.xml").write_text(SCENE)
    return folder / "scene.xml", folder / "table.csv"


def measure(rounds: int) -> dict:
    """Return the shortest seconds in sequence and by two workers, and the largest difference of
    their pixels.
    """
    sequence, farm, difference = [], [], 0.0
    with tempfile.TemporaryDirectory() as scratch:
        scene, table_file = write_frames(Path(scratch))
        for number in range(rounds + 1):  # the first round compiles kernels
            alone, images = Path(scratch) / f"alone-{number}", Path(scratch) / f"farm-{number}"
            alone.mkdir()
            command = [sys.executable, "-c", _IN_SEQUENCE, scene, table_file, alone]
            started = time.perf_counter()
            subprocess.run(list(map(str, command)), check=True, capture_output=True)
            sequence.append(time.perf_counter() - started)
            options = ("--table", table_file, "--workers", 2)
            farm.append(finished("farm", "frames", scene, "-o", images, *options).seconds)
            for frame in range(FRAMES):
                pair = alone / f"{frame}.exr", images / f"frame-{frame:04d}.exr"
                a, b = map(read_image, pair)
                difference = max(difference, float(np.abs(a - b).max()))
    return {
        "sequence": min(sequence[1:]),
        "farm": min(farm[1:]),
        "difference": difference,
        "load": load(),
    }


def table(row: dict) -> Table:
    """Return the table of the documentation."""
    head = ["", "one process, both cores", "two workers, one core each", "ratio", "difference"]
    cells = [
        f"{FRAMES} frames, start included",
        f"{row['sequence']:.1f} s",
        f"{row['farm']:.1f} s",
        f"{row['sequence'] / row['farm']:.2f}",
        "none" if not row["difference"] else f"{row['difference']:.2g}",
    ]
    return Table("Frames of an evolving cloud", head, [cells], load_note(row["load"]))


def main() -> None:
    """Run the experiment, or show its results."""
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=int, default=2)
    args, store = begun(parser, "frames")
    row = store.row("frames", lambda: measure(args.rounds))
    print(table(row).as_text())
    if args.document:
        replace_tables(args.document, {"farm-frames": table(row)})


if __name__ == "__main__":
    main()
