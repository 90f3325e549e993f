"""``irrcache farm`` on worker processes of this machine, some of which are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import psutil
import pytest
from mitsuba_irrcache.scenes import scene_path

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.io.images import read_image
from mitsuba_irrcache.io.scene_files import load_scene
from tests.support.scenes import VOLUME_IN_FILE

pytestmark = pytest.mark.usefixtures("rgb")

SCENE = str(scene_path("cloud"))
#: Seven jobs of a third of a second, each of so many samples.
PART = 512
INTEGRATOR = "irrcache{solver=path,resolution=16,max_depth=3,cache_spp=3584}"


def farm(*arguments: object) -> subprocess.Popen:
    """Start ``irrcache farm`` with two workers."""
    command = [sys.executable, "-m", "mitsuba_irrcache", "farm", *map(str, arguments)]
    return subprocess.Popen(
        [*command, "--workers", "2"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def lines_until(process: subprocess.Popen, count: int) -> list[str]:
    """Return what a command prints until ``count`` jobs are finished."""
    lines: list[str] = []
    for line in process.stdout:
        lines.append(line)
        if sum(line.startswith("[") for line in lines) == count:
            break
    return lines


def kill_worker(process: subprocess.Popen) -> None:
    """Kill one worker of a command, if that has not ended."""
    children = psutil.Process(process.pid).children(recursive=True)
    for worker in [c for c in children if "spawn_main" in " ".join(c.cmdline())][:1]:
        worker.kill()


def test_kills_of_workers_and_of_the_command_leave_no_trace(tmp_path):
    """The cache file equals that of one process that nobody disturbs, byte by byte."""
    file, arguments = tmp_path / "light.cache", ["cache", SCENE, "-i", INTEGRATOR, "-o"]
    process = farm(*arguments, file)
    lines = lines_until(process, 1)
    # A warning may precede it.
    (addresses,) = (line for line in lines if "scheduler tcp://127.0.0.1:" in line)
    assert "dashboard http://127.0.0.1:" in addresses
    kill_worker(process)
    lines_until(process, 1)
    process.kill()
    process.communicate()
    # On a slow machine the cache may have been saved in between, with its first parts.
    saved = IrradianceCache.description_of(file)[1] if file.exists() else 0
    assert saved + PART * len(list(Path(f"{file}.parts").glob("*.part"))) >= 2 * PART
    assert main(["farm", *arguments, str(file)]) == 1  # not without --resume
    process = farm(*arguments, file, "--resume")
    lines_until(process, 1)
    kill_worker(process)
    said = process.communicate()[0]
    assert process.returncode == 0 and f"wrote {file}" in said, said
    assert not Path(f"{file}.parts").exists()
    alone = INTEGRATOR.replace("}", f",cache_file={tmp_path / 'alone.cache'}}}")
    scene = load_scene(SCENE, {}, alone)
    scene.integrator().prepare(scene)
    assert file.read_bytes() == (tmp_path / "alone.cache").read_bytes()


#: The command, in which Ctrl-C has its effect also where the tests run in the background.
COMMAND = """
import signal, sys
from mitsuba_irrcache.cli.main import main
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(sys.argv[1:]))
"""


def test_ctrl_c_ends_the_command_with_one_line(tmp_path):
    """It reaches all processes, of which workers leave it to the command."""
    arguments = ["farm", "cache", SCENE, "-i", INTEGRATOR, "-o", str(tmp_path / "light.cache")]
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *arguments, "--workers", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    lines_until(process, 1)
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate()[0]
    assert process.returncode == 130 and "Traceback" not in said, said
    last = said.splitlines()[-1]
    assert "interrupted; " in last and "jobs are finished and kept; --resume continues" in last


def test_a_folder_of_other_files_is_refused_and_stays(tmp_path, capsys):
    """The folder for waiting parts may exist for another purpose: it is not removed."""
    notes = tmp_path / "light.cache.parts" / "notes.txt"
    notes.parent.mkdir()
    notes.write_text("precious")
    command = ["farm", "cache", SCENE, "-o", str(tmp_path / "light.cache"), "-i"]
    assert main([*command, "irrcache{resolution=6,cache_spp=32}"]) != 0
    assert "holds no results" in capsys.readouterr().err
    assert notes.read_text() == "precious"


def test_frames_equal_images_that_are_rendered_one_by_one(tmp_path, capsys):
    integrator = "irrcache{solver=path,resolution=8,cache_spp=64}"
    frames = tmp_path / "frames"
    varied = ["--vary", "sigma_t=2,2,3", "-D", "size=16", "--spp", "2", "-i", integrator]
    process = farm("frames", SCENE, "-o", frames, *varied)
    said = process.communicate()[0]
    assert process.returncode == 0 and f"3 of 3 frames are in {frames}" in said, said
    for number, sigma_t in enumerate((2, 2, 3)):
        scene = load_scene(SCENE, {"sigma_t": str(sigma_t), "size": "16"}, integrator)
        found = read_image(frames / f"frame-{number:04d}.exr")
        np.testing.assert_array_equal(found, np.array(mi.render(scene, spp=2, seed=0)))
    # Nothing is left to be done: no cluster is started.
    assert main(["farm", "frames", SCENE, "-o", str(frames), *varied, "--resume"]) == 0
    assert capsys.readouterr().out == f"3 of 3 frames are in {frames}\n"


@pytest.fixture
def volume(tmp_path) -> Path:
    """Return a scene whose volume is larger than memory."""
    rng = np.random.default_rng(1)
    np.save(tmp_path / "density.npy", rng.random((72, 64, 80), dtype=np.float32))
    scene = tmp_path / "scene.xml"
    scene.write_text(VOLUME_IN_FILE)
    return scene


# `test_kills_of_workers_and_of_the_command_leave_no_trace` kills workers, too, and
# `tests/unit/farm/test_volume.py::test_workers_find_the_bits_of_one_machine` sweeps a volume.
@pytest.mark.slow
def test_a_volume_larger_than_memory_is_swept_by_workers_one_of_which_is_killed(volume, tmp_path):
    """The irradiance is that of one machine but for rounding, and frames and images read it."""
    scene, file = volume, tmp_path / "light.npy"
    process = farm("cache", scene, "-o", file)
    lines_until(process, 9)
    kill_worker(process)
    said = process.communicate()[0]
    assert process.returncode == 0 and f"wrote {file}" in said, said
    assert not Path(f"{file}.parts").exists()
    alone = load_scene(scene, {"light": str(tmp_path / "alone.npy")}, None)
    expected = np.array(mi.render(alone, spp=1, seed=0))
    np.testing.assert_allclose(np.load(file), np.load(tmp_path / "alone.npy"), rtol=1e-5)
    frames = tmp_path / "frames"
    process = farm("frames", scene, "-o", frames, "-D", f"light={file}", "--spp", "1")
    said = process.communicate()[0]
    assert process.returncode == 0, said
    found = read_image(frames / "frame-0000.exr")
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


# Caches of the solver `path` are continued above, and the bits of such volumes are compared in
# `tests/unit/farm/test_volume.py`, by workers of this process.
@pytest.mark.slow
def test_a_volume_larger_than_memory_is_continued_to_the_same_bits(volume, tmp_path):
    """Neither the command that is killed nor two workers leave a trace."""
    scene, file = volume, tmp_path / "light.npy"
    process = farm("cache", scene, "-o", file)
    lines_until(process, 9)
    kill_worker(process)
    lines_until(process, 9)
    process.kill()
    process.communicate()
    assert main(["farm", "cache", str(scene), "-o", str(file)]) == 1  # not without --resume
    process = farm("cache", scene, "-o", file, "--resume")
    lines_until(process, 20)
    kill_worker(process)
    said = process.communicate()[0]
    assert process.returncode == 0 and f"wrote {file}" in said, said
    assert not Path(f"{file}.parts").exists()
    process = farm("cache", scene, "-o", tmp_path / "undisturbed.npy")
    said = process.communicate()[0]
    assert process.returncode == 0, said
    assert file.read_bytes() == (tmp_path / "undisturbed.npy").read_bytes()
