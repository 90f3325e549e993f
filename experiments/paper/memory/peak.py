"""Print the peak memory, in bytes, of this process after one image.

    python -m experiments.paper.memory.peak SCENE PIXELS INTEGRATOR

Each measurement has its own process, because allocated memory is seldom returned.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mitsuba as mi

from mitsuba_irrcache.compare.worker import peak_memory
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.machine.llvm import require_llvm


def measure_peak(scene: Path, pixels: int, integrator: str) -> int:
    """Return the peak memory in bytes of a new process that renders an image of one sample per
    pixel.
    """
    command = [sys.executable, "-m", __name__, str(scene), str(pixels), integrator]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return int(done.stdout.split()[-1])


def main() -> None:
    """Render as the command line specifies."""
    path, pixels, integrator = sys.argv[1:]
    require_llvm()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    parameters = {"max_depth": "2", "width": pixels, "height": pixels}
    mi.render(load_scene(path, parameters, integrator), spp=1)
    print(peak_memory())


if __name__ == "__main__":
    main()
