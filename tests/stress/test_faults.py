"""Behaviour of cache files, properties and commands under failures and invalid input.

``make stress`` runs many more killed processes and damaged files.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from experiments.robustness.faults import commands, formats, properties, run
from experiments.robustness.stability.worlds import Camera, Matter, scene
from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.io.files import ABANDONED, atomic_write

pytestmark = pytest.mark.usefixtures("rgb")

SETTINGS = {"solver": "path", "resolution": 4, "cache_spp": 8, "max_depth": 2}


def filled(file: Path, samples: int, sigma_t: float = 1.0) -> mi.Scene:
    """Return a scene whose cache of this many samples is in the file."""
    settings = SETTINGS | {"cache_file": str(file), "cache_spp": samples}
    built = scene(settings, Matter(sigma_t))
    built.integrator().prepare(built)
    return built


WRITER = """
import sys
package = type(sys)("mitsuba_irrcache")  # without Mitsuba, which takes a second
package.__path__ = ["mitsuba_irrcache"]
sys.modules["mitsuba_irrcache"] = package
from mitsuba_irrcache.io.files import atomic_write
content = [bytes([n]) * (1 << 22) for n in range(8)]
for n in range(10**6):
    with atomic_write(sys.argv[1]) as file:
        for start in range(0, 1 << 22, 1 << 20):
            file.write(content[n % 8][start : start + (1 << 20)])
    print(n, flush=True)
"""


def test_killed_while_writing(tmp_path):
    """A file of 4 MB is whole whenever its writer is killed, here at 6 moments.

    The next writer removes the temporary file once that is old enough.
    """
    file, rng = tmp_path / "light.cache", np.random.default_rng(3)
    for _ in range(6):
        command = [sys.executable, "-c", WRITER, str(file)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=Path(__file__).parents[2])
        process.stdout.readline()
        time.sleep(rng.uniform(0.02, 0.08))
        process.send_signal(signal.SIGKILL)
        process.wait()
        content = np.fromfile(file, np.uint8)
        assert content.size == 1 << 22 and (content == content[0]).all()
    assert any(tmp_path.glob(".light.cache.*.tmp"))  # some were killed while writing


def test_temporary_files_of_killed_processes_are_removed(tmp_path):
    old, new = tmp_path / ".a.bin.x.tmp", tmp_path / ".a.bin.y.tmp"
    for path in (old, new, tmp_path / ".b.bin.x.tmp"):
        path.write_bytes(b"half")
    past = time.time() - ABANDONED - 1
    os.utime(old, (past, past))
    with atomic_write(tmp_path / "a.bin") as file:
        file.write(b"whole")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {".a.bin.y.tmp", ".b.bin.x.tmp", "a.bin"}


CROWDED = """
import os, resource, sys
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from experiments.robustness.stability.worlds import Camera, Matter, scene
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
settings = {"solver": "path", "resolution": 4, "cache_spp": 8, "max_depth": 2}
built = scene(settings | {"cache_file": sys.argv[1] + "/light.cache"}, Matter())
print(mi.render(built, spp=1).array[0] > 0, os.listdir(sys.argv[1]))
os.chmod(sys.argv[1], 0o555)
os.setuid(65534)
built = scene(settings | {"cache_file": sys.argv[1] + "/light.cache"}, Matter(0.5))
try:
    built.integrator().prepare(built)
except Exception as error:
    print(error, built.integrator().cache)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of this kind")
def test_a_full_disk_and_a_folder_that_is_read_only():
    """With a full disk the image is rendered with a warning, and no partial file remains.

    A read-only folder raises an error before any work. (Dropping privileges needs root.)
    """
    with tempfile.TemporaryDirectory() as folder:  # other users cannot access pytest's folders
        os.chmod(folder, 0o755)
        command = [sys.executable, "-c", CROWDED, folder]
        said = subprocess.run(
            command, capture_output=True, text=True, cwd=Path(__file__).parents[2], timeout=100
        )
    assert "True []" in said.stdout, said
    assert "cache was not saved" in said.stdout + said.stderr
    if "PermissionError" not in said.stderr:
        assert "nothing can be written" in said.stdout and said.stdout.strip().endswith("None")


RENDERED = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from experiments.robustness.stability.worlds import Matter, scene
settings = {"solver": "path", "resolution": 4, "cache_spp": 8, "max_depth": 2}
print(sum(mi.render(scene(settings, Matter()), spp=1).array))
"""


@pytest.mark.slow
def test_a_corrupted_kernel_cache(tmp_path):
    """Truncated or modified files in Dr.Jit's kernel cache are recompiled; the image is the
    same.
    """
    rng, pictures = np.random.default_rng(1), []
    folder = {"HOME": str(tmp_path), "DRJIT_CACHE_DIR": str(tmp_path)}
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", RENDERED], env=os.environ | folder,
            cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        # Mitsuba's log resets colours after a warning.
        pictures.append(done.stdout.split()[-1].removeprefix("\x1b[0m"))
        files = sorted(tmp_path.rglob("*.bin"))
        assert len(files) > 10
        for number, file in enumerate(files):
            content = np.fromfile(file, np.uint8)
            content[rng.integers(0, content.size, 20)] ^= 255
            (content[: content.size // 2] if number % 2 else content).tofile(file)
    assert pictures[0] == pictures[1] and float(pictures[0]) > 0


def test_a_file_that_another_process_has_filled_further(tmp_path):
    """A process with fewer samples does not overwrite the cache file of one with more."""
    file = tmp_path / "light.cache"
    slow = filled(file, 8)
    filled(file, 64)
    slow.integrator().cache_spp = 16
    slow.integrator().prepare(slow)
    assert slow.integrator().cache.samples == 16
    assert IrradianceCache.load(file).samples == 64


def test_a_file_that_another_scene_has_taken_meanwhile(tmp_path):
    """A cache file that another scene has created meanwhile is not overwritten."""
    file = tmp_path / "light.cache"
    settings = SETTINGS | {"cache_file": str(file)}
    slow = scene(settings, Matter(2.0))
    slow.integrator().progress = lambda *_: file.exists() or filled(file, 8)
    slow.integrator().prepare(slow)
    assert slow.integrator().cache.samples == 8
    again = filled(file, 8)  # of the first scene; it would be refused otherwise
    assert again.integrator().cache.samples == 8


def rewritten(file: Path, **changes) -> None:
    """Change an entry of a cache file."""
    arrays = dict(np.load(file))
    description = json.loads(arrays["description"].tobytes()) | changes
    arrays["description"] = np.frombuffer(json.dumps(description).encode(), np.uint8)
    with file.open("wb") as stream:
        np.savez(stream, **arrays)


@pytest.mark.parametrize(
    "lie",
    [
        {"shape": [4000, 4000, 4000]},
        {"to_world": (2 * np.eye(4)).tolist()},
        {"batch": 0},
        {"batch": 7},
        {"streams": {"0": -8}},
        {"streams": [8]},
        {"max_depth": 3},
    ],
    ids=str,
)
def test_inconsistent_cache_files_are_refused(tmp_path, lie):
    """Cache files with the scene's fingerprint but one inconsistent entry are refused."""
    file = tmp_path / "light.cache"
    filled(file, 8)
    rewritten(file, **lie)
    with pytest.raises((IrrcacheError, RuntimeError), match=r"light\.cache"):
        filled(file, 8)


@pytest.mark.parametrize(
    ("value", "said"), [(-1e-3, "negative"), (1e300, "not finite"), (np.nan, "not finite")]
)
def test_invalid_irradiance_is_refused(tmp_path, value, said):
    """Irradiance that is negative, or beyond single precision, is refused."""
    file = tmp_path / "light.cache"
    filled(file, 8)
    arrays = dict(np.load(file))
    arrays["spreads"][0, 3] = value
    with file.open("wb") as stream:
        np.savez(stream, **arrays)
    with pytest.raises(CacheFileError, match=said):
        IrradianceCache.load(file)


def test_damaged_volumes():
    """20 damaged volume files are read or refused, in a process of its own.

    ``make stress`` tries all formats.
    """
    (nrrd,) = (f for f in formats.FORMATS if f.name == "a.nrrd")
    tally = run.fuzz(nrrd, 20)
    assert tally.tried == 20 and not tally.failed, tally


def test_damaged_caches(tmp_path):
    """60 damaged caches are refused by name, or read with finite values."""
    (cache_format,) = (f for f in formats.FORMATS if f.name == "light.cache")
    file = tmp_path / "light.cache"
    cache_format.make(file)
    content, refused = file.read_bytes(), 0
    for index in range(60):
        file.write_bytes(cache_format.mutate(content, np.random.default_rng((2, index))))
        try:
            cache_format.read(file)
        except CacheFileError:
            refused += 1
    assert 30 < refused <= 60


def tried(case: Path, run_case, mutate, count: int) -> int:
    """Run this many mutants of a case in this process; return how many are refused by name."""
    content, refused = case.read_bytes(), 0
    for index in range(count):
        case.write_bytes(mutate(content, np.random.default_rng((3, index))))
        try:
            run_case(case)
        except IrrcacheError:
            refused += 1
    return refused


def test_random_properties(tmp_path, monkeypatch):
    """50 scenes with random properties are rendered, or refused by a message that names the
    fault.

    A cache file of any name stays in the folder of its case.
    """
    here, case = tmp_path / "here", tmp_path / "properties.json"
    here.mkdir()
    monkeypatch.chdir(here)
    properties.write_valid(case)
    refused = tried(case, properties.render_case, properties.mutated_properties, 50)
    assert 25 < refused < 49
    case.write_text(json.dumps({"how": "xml", "properties": properties.VALID}))
    properties.render_case(case)
    named = properties.VALID | {"cache_file": "False"}
    case.write_text(json.dumps({"how": "dict", "properties": named}))
    properties.render_case(case)
    assert not any(here.iterdir())


def test_random_command_lines(tmp_path):
    """30 random command lines succeed, or print an error and leave no files."""
    case = tmp_path / "command.json"
    commands.write_valid(case)
    commands.run_case(case)
    refused = tried(case, commands.run_case, commands.mutated_command, 30)
    assert 18 < refused < 30


@pytest.mark.parametrize(
    "arguments",
    [["render", "none.xml", "-o", "\udc80.exr"], ["import", "\udc80", "--density", "-o", "x"]],
    ids=["render", "import"],
)
def test_undecodable_arguments_are_refused_without_a_traceback(tmp_path, arguments):
    """Arguments that are no valid text are refused without a traceback.

    Runs in a process of its own, because the message has to be encoded.
    """
    command = [sys.executable, "-m", "mitsuba_irrcache", *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=60)
    assert done.returncode == 1 and b"Traceback" not in done.stderr
    assert done.stderr.startswith(b"irrcache: error: ") and not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hide_emitters", "false"),
        ("aovs", 1),
        ("cache_file", 3),
        ("cache_file", "."),
        ("timeout", float("nan")),
        ("timeout", "1"),
        ("step", True),
        ("emission_scale", [1.0, 2.0, 3.0]),
        ("filter", [1.0, 2.0, 3.0]),
        ("emission", 1e300),
    ],
)
def test_properties_of_another_type_are_refused(name, value):
    """Properties of a wrong type are refused instead of converted.

    Python would convert most of them: "false" is true, and 3 is a file descriptor. Properties that
    Mitsuba reads itself are refused by Mitsuba's messages.
    """
    said = rf'(?s)irrcache: {name} is .*; it must be|"{name}" has the wrong type'
    with pytest.raises((IrrcacheError, RuntimeError), match=said):
        built = scene(SETTINGS | {name: value}, Matter())
        built.integrator().prepare(built)


@pytest.mark.parametrize("solver", ["sweep", "path"])
@pytest.mark.parametrize("depth", [2, -1])
def test_radiance_beyond_single_precision_is_refused(solver, depth):
    """Radiance beyond single precision is refused by name, every time."""
    sky = {"type": "constant", "radiance": 1e38}
    built = scene(SETTINGS | {"solver": solver, "max_depth": depth}, Matter(2.0), sky)
    for _ in range(2):
        with pytest.raises(IrrcacheError, match="not finite in single precision; lower the radia"):
            built.integrator().prepare(built)


def test_any_max_depth_terminates():
    """2^31 - 1 orders by `sweep` end as soon as the next order is negligible.

    The mean equals that of all orders within the tolerance of the iteration.
    """

    def light(depth: int) -> np.ndarray:
        built = scene(SETTINGS | {"solver": "sweep", "max_depth": depth}, Matter(3.0))
        built.integrator().prepare(built)
        return np.array(built.integrator().cache.irradiance)

    found, expected = light(2**31 - 1), light(-1)
    assert abs(found.mean() / expected.mean() - 1) < 2e-3
    assert light(12).mean() < 0.997 * found.mean()


def test_memory_is_checked_before_allocation(tmp_path):
    """A cache beyond the memory limit is refused before allocation, with its bytes and the
    remedy.
    """
    too_large = scene({"solver": "sweep", "resolution": 5000}, Matter())
    with pytest.raises(IrrcacheError, match=r"needs \d+\.\d GiB.*are free; lower resolution"):
        too_large.integrator().prepare(too_large)


@pytest.mark.parametrize("matter", [Matter(), None], ids=["a medium", "none"])
@pytest.mark.parametrize(
    ("film", "spp", "said"),
    [
        (
            {"width": 10**6, "height": 10**5},
            1,
            r"1000000 x 100000 pixels needs \d+\.\d GiB.*lower",
        ),
        ({"width": 4, "height": 4}, 2**32, r"spp is 4294967296"),
        ({"width": 4, "height": 4}, -1, r"spp is -1; it must be"),
    ],
    ids=["pixels", "samples", "negative"],
)
def test_absurd_images_are_refused_before_anything_is_computed(matter, film, spp, said):
    built = scene(SETTINGS, matter, camera=Camera(film=film))
    with pytest.raises(IrrcacheError, match=said):
        built.integrator().render(built, spp=spp)
    assert built.integrator().cache is None


def test_absurd_numbers_of_samples_of_an_empty_scene_are_refused():
    """Numbers of samples that exceed one launch are refused for empty scenes.

    With a medium they are rendered in passes.
    """
    empty = scene(SETTINGS, None, camera=Camera(film={"width": 4096, "height": 4096}))
    with pytest.raises(IrrcacheError, match=r"needs \d+\.\d GiB.*lower width, height or spp"):
        empty.integrator().render(empty, spp=1 << 20)


def test_switching_the_variant_and_back():
    """After switching to another variant and back, a scene renders as before."""
    built = scene(SETTINGS, Matter())
    before = np.array(mi.render(built, spp=1))
    try:
        mi.set_variant("llvm_ad_mono")
        with pytest.raises(IrrcacheError, match=r"llvm_ad_rgb.*load the scene again"):
            built.integrator().prepare(built)
    finally:
        mi.set_variant("llvm_ad_rgb")
    np.testing.assert_array_equal(np.array(mi.render(built, spp=1)), before)
