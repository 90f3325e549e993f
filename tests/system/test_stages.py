"""``irrcache render`` names its stages from the first one on, and compilation is one of its own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pty = pytest.importorskip("pty", reason="this system has no pseudo-terminals")

SCENE = """<scene version="3.0.0">
<integrator type="volpath"><integer name="max_depth" value="2"/></integrator>
<sensor type="perspective"><transform name="to_world">
<lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
</sensor>
<emitter type="constant"/>
<shape type="cube"><bsdf type="null"/><medium type="homogeneous" name="interior">
<float name="sigma_t" value="1"/><float name="albedo" value="0.5"/></medium></shape>
</scene>"""


def rendered(folder, integrator: str) -> tuple[str, str]:
    """Render on a terminal with an empty kernel cache; return its standard error and output."""
    scene = folder / "scene.xml"
    scene.write_text(SCENE)
    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "mitsuba_irrcache", "render", str(scene), "-i", integrator]
    done = subprocess.run(
        [*command, "--spp", "1"],
        env={**os.environ, "DRJIT_CACHE_DIR": str(folder / "kernels")},
        stderr=follower,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    os.close(follower)
    shown = b""
    while True:
        try:
            part = os.read(leader, 4096)
        except OSError:  # the other end is closed and all is read
            break
        if not part:
            break
        shown += part
    os.close(leader)
    return shown.decode(), done.stdout


@pytest.mark.parametrize(
    ("integrator", "stages"),
    [
        ("volpath", ["loading scene.xml", "rendering"]),
        ("irrcache{solver=path,resolution=4}", ["loading scene.xml", "cache", "rendering"]),
        ("irrcache{solver=sweep,resolution=4}", ["loading scene.xml", "cache", "rendering"]),
    ],
)
def test_stages_are_named_and_compilation_is_measured(tmp_path, integrator, stages):
    shown, printed = rendered(tmp_path, integrator)
    places = [shown.find(stage) for stage in stages]
    assert min(places) >= 0 and places == sorted(places)
    assert shown.endswith("\r\x1b[K")  # nothing is left of the line
    assert "compilation" in printed and "load" in printed
    again = rendered(tmp_path, integrator)[1]
    assert "compilation" not in again  # the kernels of the first run are there
