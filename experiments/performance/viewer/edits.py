"""Edits in quick succession: ``python -m experiments.performance.viewer.edits [--voxels 128]
[--edits 200] [--wait 0.25]``.

A session without a browser displays a dense procedural cloud under a sky and a sun. The sun and the
density are changed in turn, each ``--wait`` seconds after the first image of the edit before.
Prints, for each tenth of the edits: median and longest time from an edit to its first image, and
the memory of the process. Memory that grows with the edits is a leak.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from experiments.performance.viewer.load import resident_memory
from mitsuba_irrcache.machine.llvm import require_llvm
from mitsuba_irrcache.view.document import Document
from mitsuba_irrcache.view.picture import Look
from mitsuba_irrcache.view.session import Session
from mitsuba_irrcache.view.window import View

SIZE = (400, 400)
#: Seconds until the first image, and after it until the caches are refined.
BEGIN, SETTLE = 240, 6
#: The extinction differs from 0 at the boundary: the radiance of the sun is not interpolated there.
SCENE = """<scene version="3.0.0">
    <integrator type="irrcache"/>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="2, 1, 3" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
    </sensor>
    <emitter type="constant"/>
    <emitter type="directional"> <vector name="direction" value="1, -2, -1"/> </emitter>
    <shape type="cube">
        <bsdf type="null"/>
        <medium name="interior" type="heterogeneous">
            <float name="scale" value="60"/>
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="density.vol"/>
                <transform name="to_world">
                    <matrix value="2 0 0 -1 0 2 0 -1 0 0 2 -1 0 0 0 1"/>
                </transform>
            </volume>
            <rgb name="albedo" value="0.9, 0.8, 0.7"/>
        </medium>
    </shape>
</scene>
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--voxels", type=int, default=128, help="of the data along each side")
    parser.add_argument("--edits", type=int, default=200)
    parser.add_argument("--wait", type=float, default=0.25, help="seconds between edits")
    args = parser.parse_args()
    require_llvm()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    with tempfile.TemporaryDirectory() as folder:
        mi.VolumeGrid(density(args.voxels)).write(f"{folder}/density.vol")
        scene = Path(folder) / "scene.xml"
        scene.write_text(SCENE)
        session = Session(Document.load(scene))
        session.start()
        try:
            edit(session, args.edits, args.wait)
        finally:
            session.stop()


def density(voxels: int) -> np.ndarray:
    """Return a ball with waves in thin matter, float32 (z, y, x, 1)."""
    x, y, z = np.mgrid[:voxels, :voxels, :voxels] / (voxels - 1) * 2 - 1
    radius = np.sqrt(x**2 + y**2 + z**2)
    values = np.clip(1.2 - 1.5 * radius, 0, 1) + 0.2 * np.sin(8 * x) * np.sin(9 * y) + 0.5
    return np.clip(values, 0, None).astype(np.float32)[..., None]


def edit(session: Session, count: int, wait: float) -> None:
    """Edit sun and density in turn, and print the results."""
    shown = threading.Event()
    window = session.open(lambda _: shown.set())
    camera = next(iter(session.cameras.values()))
    session.look(window, View(camera, SIZE, Look()))
    shown.wait(BEGIN)
    time.sleep(SETTLE)
    print(f"{'edits':>8}{'median [s]':>12}{'longest [s]':>12}{'memory [MB]':>12}")
    times, group = [], max(count // 10, 1)
    for number in range(count):
        sun = replace(session.document.lighting, sun=3.0, azimuth=30.0 + 20 * (number % 7))
        factor = 1 + 0.05 * (number % 5)
        started = time.perf_counter()
        shown.clear()
        if number % 2:
            session.edit(lambda document, factor=factor: document.set_density(factor))
        else:
            session.edit(lambda document, sun=sun: document.set_lighting(sun))
        if not shown.wait(BEGIN):
            raise SystemExit(f"edit {number}: no image within {BEGIN} s")
        times.append(time.perf_counter() - started)
        time.sleep(wait)
        if (number + 1) % group == 0:
            last, memory = times[-group:], resident_memory(os.getpid())
            print(f"{number + 1:8}{np.median(last):12.2f}{max(last):12.2f}{memory:12.0f}")


if __name__ == "__main__":
    main()
