"""Runs of ``irrcache farm``, whose jobs are run here one by one."""

from __future__ import annotations

import argparse
import re
import shutil
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_irrcache.scenes import scene_path

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.compare.results import Measurement, Snapshot
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm import runs, studies, volume, work
from mitsuba_irrcache.farm.cluster import Connection
from mitsuba_irrcache.farm.jobs import Environment
from mitsuba_irrcache.farm.references import waiting_launches
from mitsuba_irrcache.farm.results import Outcome, Results
from mitsuba_irrcache.farm.volume import NAMES
from mitsuba_irrcache.farm.work import KINDS
from mitsuba_irrcache.io.images import write_image
from mitsuba_irrcache.io.scene_files import load_scene
from tests.support.scenes import VOLUME_IN_FILE

pytestmark = pytest.mark.usefixtures("rgb")

#: Options by which nothing takes time.
SMALL = ["-D", "size=8", "-D", "max_depth=3"]


@pytest.fixture(autouse=True)
def _nothing_is_kept(monkeypatch):
    """Free what jobs leave for the next ones: kernels of later tests would differ with it."""
    for name in ("_SCENES", "_CACHES"):
        monkeypatch.setattr(work, name, work._Kept())


class Here:
    """Stand in for `Dispatch`: run jobs in this process."""

    def __init__(self, folder: Path, jobs, store) -> None:
        self.folder, self.jobs, self.store = folder, jobs, store

    def run(self) -> dict[str, str]:
        failed = {}
        for number, job in enumerate(self.jobs):
            scratch = self.folder / f"job-{number}"
            scratch.mkdir()
            try:
                digests = KINDS[job.kind](job.arguments, scratch) or {}
            except RuntimeError as error:
                failed[job.name] = str(error)
                continue
            files = [path for path in scratch.rglob("*") if path.is_file()]
            contents = {str(path.relative_to(scratch)): path.read_bytes() for path in files}
            self.store(job, Outcome("here", files=contents, digests=digests))
        return failed


@pytest.fixture
def here(tmp_path_factory, monkeypatch):
    """Run jobs in this process, each in a new folder."""
    monkeypatch.setattr(runs, "connected", lambda _: nullcontext(tmp_path_factory.mktemp("jobs")))
    monkeypatch.setattr(runs, "Dispatch", Here)


def copied(folder: Path) -> str:
    """Return a copy of a scene in a new folder."""
    folder.mkdir()
    (folder / "scene.xml").write_text(Path(scene_path("cloud")).read_text())
    return str(folder / "scene.xml")


def measured(job, integrator, name, budgets, folder) -> None:
    """Stand in for `measure_integrator`, which starts several processes."""
    assert job["working_folder"] == str(Path.cwd())
    write_image(folder / "images" / f"{name}.exr", np.full((8, 8, 3), 0.3, np.float32), {})
    snapshot = Snapshot(budgets[0], {"image": 0.1}, 4, f"images/{name}.exr")
    Measurement(integrator, name, [snapshot]).save(folder / "measurements" / f"{name}.json")


def test_scenes_of_the_same_contents_have_a_report_each(here, tmp_path, monkeypatch, capsys):
    reports: list[Path] = []
    monkeypatch.setattr(work, "measure_integrator", measured)
    monkeypatch.setattr(studies, "run_job", lambda *_: {})
    monkeypatch.setattr(studies, "write_report", lambda args, folder, *_: reports.append(folder))
    scenes = [copied(tmp_path / name) for name in ("a", "b")]
    options = ["-i", "volpath", "-o", str(tmp_path / "out"), "--reference-spp", "4", *SMALL]
    options += ["--references", str(tmp_path / "references")]
    assert main(["farm", "study", *scenes, *options]) == 0
    assert reports == [tmp_path / "out" / "a", tmp_path / "out" / "b"]
    (only,) = (tmp_path / "references").iterdir()
    # Nothing is left to be done, and a damaged file is made again.
    (tmp_path / "out" / "b" / "measurements" / "1-volpath.json").write_text("[]")
    assert main(["farm", "study", *scenes, *options, "--resume"]) == 0
    assert reports[2:] == reports[:2] and only.exists()


def test_a_reference_whose_jobs_all_fail(here, tmp_path, capsys, monkeypatch):
    """The status and the message say so, and no traceback."""

    def fails(*_):
        raise RuntimeError("this integrator cannot render")

    monkeypatch.setitem(KINDS, "reference_part", fails)
    options = ["--references", str(tmp_path / "references"), "--reference-spp", "4", *SMALL]
    assert main(["farm", "reference", copied(tmp_path / "a"), *options]) == 1
    said = capsys.readouterr()
    assert "this integrator cannot render" in said.err and "samples per pixel" not in said.out


CACHED = "irrcache{solver=path,resolution=4,cache_spp=16,cache_file=light.cache}"


@pytest.fixture
def frames(here, tmp_path, monkeypatch, capsys):
    """Return a function that renders frames, with these options, into a folder, and returns the
    status and the names of jobs that were run.
    """
    monkeypatch.chdir(tmp_path)
    scene, ran = copied(tmp_path / "scene"), []

    class Noting(Here):
        def run(self) -> dict[str, str]:
            ran.extend(job.name for job in self.jobs)
            return super().run()

    monkeypatch.setattr(runs, "Dispatch", Noting)

    def render(*options: str) -> tuple[int, list[str]]:
        ran.clear()
        command = ["farm", "frames", scene, "-o", "frames", "--spp", "1", *SMALL, *options]
        return main(command), list(ran)

    return render


def test_frames_follow_the_cache_file_that_they_read(frames, tmp_path):
    """One that is refined after they were rendered counts, what they write themselves does not."""
    options = ["--vary", "spp=1,2", "-i", CACHED]
    both = ["frame-0000", "frame-0001"]
    assert frames(*options) == (0, both)
    assert Path("light.cache").exists()
    assert frames(*options, "--resume") == (0, [])
    more = CACHED.replace("=16", "=64")
    refined = load_scene("scene/scene.xml", {"size": "8", "max_depth": "3"}, more)
    refined.integrator().prepare(refined)
    before = Path("frames/frame-0001.exr").read_bytes()
    assert frames(*options, "--resume") == (0, both)
    assert Path("frames/frame-0001.exr").read_bytes() != before
    assert frames(*options, "--resume") == (0, [])
    Path("light.cache").unlink()
    assert frames(*options, "--resume") == (0, [])


def test_no_image_of_other_inputs_stays_beside_those_of_a_run(frames, tmp_path, monkeypatch):
    """Where a frame fails, also if its record is damaged."""
    options = ["--vary", "sigma_t=2,3", "-i", "volpath"]
    assert frames(*options)[0] == 0
    Path("frames/.farm/frame-0001.json").write_text("")
    render = work.frame

    def second_fails(arguments, folder):
        if arguments["scene"]["parameters"]["sigma_t"] != "2":
            raise RuntimeError("this frame cannot be rendered")
        return render(arguments, folder)

    monkeypatch.setitem(KINDS, "frame", second_fails)
    changed = ["--vary", "sigma_t=2,4", "-i", "volpath", "--resume"]
    assert frames(*changed) == (1, ["frame-0001"])
    assert sorted(path.name for path in Path("frames").glob("frame*")) == [
        "frame-0000.exr", "frame-0000.png",
    ]  # fmt: skip


def test_images_that_are_none_of_the_frames_are_named(frames, capsys):
    """Images of a longer run, or of other sensors, are named until they are deleted."""
    assert frames("--vary", "sigma_t=1:4:4", "-i", "volpath")[0] == 0
    assert "no frames" not in capsys.readouterr().err
    Path("frames/frame-0009.exr").write_text("mine")
    fewer = ["--vary", "sigma_t=1:3:2", "-i", "volpath", "--resume"]
    for expected in (["frame-0001"], []):
        assert frames(*fewer) == (0, expected)
        said = capsys.readouterr().err
        assert (
            '"frames" also holds files of an earlier run that are no frames of this one, ' in said
        )
        assert ", frame-0002.exr, frame-0002.png, frame-0003.exr, frame-0003.png; delete" in said
    for file in [*Path("frames").glob("frame-000[23].*")]:
        file.unlink()
    assert frames(*fewer) == (0, []) and "no frames" not in capsys.readouterr().err
    Path("scene/scene.xml").write_text(
        re.sub(r"(<sensor.*</sensor>)", r"\1\1", Path("scene/scene.xml").read_text(), flags=re.S)
    )
    assert frames("-i", "volpath", "--sensors", "all", "--resume")[0] == 0
    assert "one, frame-0000.exr, " in capsys.readouterr().err
    assert frames("-i", "volpath", "--resume")[0] == 0
    assert "frame-0000-sensor-1.png" in capsys.readouterr().err


def test_a_run_without_all_its_frames_has_a_status(frames, monkeypatch, capsys):
    """As where another command, of other inputs, writes to the folder at the same time."""
    store = Results.store
    other = {"seed": 5}
    monkeypatch.setattr(
        Results,
        "store",
        lambda own, job, outcome: store(
            own, replace(job, arguments=job.arguments | other), outcome
        ),
    )
    assert frames("-i", "volpath")[0] == 1
    said = capsys.readouterr()
    assert "0 of 1 frames" in said.out and "another command may be using" in said.err


def test_a_parameter_with_one_value_and_one_per_frame_is_refused(frames, capsys):
    assert frames("-D", "sigma_t=3", "--vary", "sigma_t=1,2") == (1, [])
    assert '"sigma_t" has the value "3" by -D' in capsys.readouterr().err


def test_the_second_of_two_commands_for_one_volume_says_so(tmp_path, monkeypatch, capsys):
    """The first one has removed the working files when it was finished."""
    folder = tmp_path / "light.npy.parts"

    class Overtaken:
        def __init__(self, *_) -> None:
            shutil.rmtree(next(folder.glob(NAMES)))  # as halfway through the removal

        def run(self) -> None:
            raise IrrcacheError("some file does not exist")

    monkeypatch.setattr(runs, "connected", lambda _: nullcontext(Connection(None)))
    monkeypatch.setattr(volume, "Dispatch", Overtaken)
    np.save(tmp_path / "density.npy", np.ones((8, 8, 8), np.float32))
    (tmp_path / "scene.xml").write_text(VOLUME_IN_FILE)
    command = ["farm", "cache", str(tmp_path / "scene.xml"), "-o", str(tmp_path / "light.npy")]
    assert main(command) == 1
    said = capsys.readouterr().err
    assert "light.npy.parts" in said and "by another command" in said


@pytest.fixture
def volume_command(tmp_path, monkeypatch) -> list[str]:
    """Return a command that sweeps a small volume in this process."""

    class InTurn:
        def __init__(self, _, jobs, store) -> None:
            self.jobs, self.store = jobs, store

        def run(self) -> dict[str, str]:
            for job in self.jobs:
                self.store(job, Outcome("here", digests=KINDS[job.kind](job.arguments, None)))
            return {}

    monkeypatch.setattr(runs, "connected", lambda _: nullcontext(Connection(None)))
    monkeypatch.setattr(volume, "Dispatch", InTurn)
    np.save(tmp_path / "density.npy", np.ones((8, 8, 8), np.float32))
    (tmp_path / "scene.xml").write_text(VOLUME_IN_FILE)
    return ["farm", "cache", str(tmp_path / "scene.xml"), "-o", str(tmp_path / "light.npy")]


def test_files_of_others_beside_a_volume_stay(volume_command, tmp_path, capsys):
    """A folder of others is refused, and one that they write to during the run is not removed."""
    notes = tmp_path / "light.npy.parts" / "thesis.txt"
    notes.parent.mkdir()
    notes.write_text("precious")
    assert main([*volume_command, "--resume"]) == 1
    said = capsys.readouterr().err
    assert f'"{notes.parent}" is not empty and holds no results of irrcache farm' in said
    assert [*notes.parent.iterdir()] == [notes] and not (tmp_path / "light.npy").exists()
    notes.unlink()
    (notes.parent / "0123456789abcdef").mkdir()  # of an earlier run, of another scene
    run = volume.Dispatch.run

    def and_write(dispatch):
        notes.write_text("precious")
        return run(dispatch)

    volume.Dispatch.run = and_write
    assert main([*volume_command, "--resume"]) == 0
    assert [*notes.parent.iterdir()] == [notes] and (tmp_path / "light.npy").exists()


def of_kind(kind: str, folder: Path) -> list[str]:
    """Return a command without its options of the output, and these."""
    own = {
        "cache": ["-o", str(folder / "light.cache"), "-i", "irrcache{resolution=4,cache_spp=64}"],
        "frames": ["-o", str(folder / "frames"), "--spp", "1", "-i", "volpath"],
        "reference": ["--references", str(folder / "references"), "--reference-spp", "4"],
    }
    return ["farm", kind, copied(folder / "scene"), *own[kind], *SMALL, "--resume"]


@pytest.mark.parametrize("kind", ["cache", "frames", "reference"])
def test_a_second_command_for_the_same_output_says_so(here, tmp_path, monkeypatch, capsys, kind):
    """The first one is not disturbed."""
    command = of_kind(kind, tmp_path)
    second = []

    class Meanwhile(Here):
        def run(self) -> dict[str, str]:
            monkeypatch.setattr(runs, "Dispatch", Here)
            second.append(main(command))
            return super().run()

    monkeypatch.setattr(runs, "Dispatch", Meanwhile)
    assert main(command) == 0 and second == [1]
    said = capsys.readouterr()
    assert "another command is using" in said.err and "--resume" in said.err
    assert main(command) == 0  # nothing of either is in the way


def test_a_reference_that_is_complete_is_shared(here, tmp_path):
    """A command that only reads it keeps nobody from adding samples, nor does it disturb that."""
    scene, folder = copied(tmp_path / "scene"), str(tmp_path / "references")

    def reference(spp: int) -> int:
        options = ["--references", folder, "--reference-spp", str(spp), *SMALL]
        return main(["farm", "reference", scene, *options])

    assert reference(4) == 0
    (path,) = Path(folder).glob("*.npz")
    with ExitStack() as used:
        args = argparse.Namespace(
            reference="volpath", sensor=0, references=Path(folder), reference_spp=4
        )
        place = Path(scene), {"size": "8", "max_depth": "3"}
        own = runs._reference(args, *place, Environment.here("llvm_ad_rgb", [], 0), {}, used)
        assert not own.missing and own.path == path.resolve()
        assert reference(8) == 0
        with waiting_launches(own.path).alone(resume=True):
            assert own.finish() and Path(f"{own.path}.parts").exists()


def test_a_second_command_for_the_same_volume_says_so(volume_command, monkeypatch, capsys):
    second, run = [], volume.Dispatch.run

    def meanwhile(dispatch) -> dict[str, str]:
        monkeypatch.setattr(volume.Dispatch, "run", run)
        second.append(main([*volume_command, "--resume"]))
        return run(dispatch)

    monkeypatch.setattr(volume.Dispatch, "run", meanwhile)
    assert main(volume_command) == 0 and second == [1]
    assert "another command is using" in capsys.readouterr().err


def test_a_volume_that_is_changed_during_the_run_is_no_mixture(
    volume_command, tmp_path, monkeypatch, capsys
):
    """The run fails, and the next one, of the new volume, finds what an undisturbed one does."""
    density, run = tmp_path / "density.npy", volume.Dispatch.run

    def meanwhile(dispatch) -> dict[str, str]:
        np.save(density, np.full((8, 8, 8), 2, np.float32))
        return run(dispatch)

    with monkeypatch.context() as changing:
        changing.setattr(volume.Dispatch, "run", meanwhile)
        assert main(volume_command) == 1
    assert f'"{density}" was changed while it was in use' in capsys.readouterr().err
    light = tmp_path / "light.npy"
    assert not light.exists()
    assert main([*volume_command, "--resume"]) == 0
    found = light.read_bytes()
    light.unlink()
    assert main(volume_command) == 0 and light.read_bytes() == found


@pytest.mark.parametrize("solver", ["sweep", "path"])
def test_a_cache_is_continued_with_the_batches_of_its_file(here, tmp_path, solver):
    """More samples have larger batches by default; the file keeps those with which it began."""
    scene, mine = copied(tmp_path / "scene"), tmp_path / "mine.cache"
    integrator = f"irrcache{{solver={solver},resolution=4,cache_spp=%d}}"
    command = ["farm", "cache", scene, "-o", str(mine), "-D", "size=8", "--resume", "-i"]
    for samples in (64, 512):
        assert main([*command, integrator % samples]) == 0
        alone = integrator.replace("}", f",cache_file={tmp_path / 'alone.cache'}}}") % samples
        loaded = load_scene(scene, {"size": "8"}, alone)
        loaded.integrator().prepare(loaded)
        assert mine.read_bytes() == (tmp_path / "alone.cache").read_bytes()


def test_parts_without_records_are_no_obstacle(here, tmp_path):
    """A command that is killed while it removes them may leave some."""
    parts = tmp_path / "light.cache.parts"
    parts.mkdir()
    (parts / "batches-128-191.part").write_text("of an unknown job")
    assert main(of_kind("cache", tmp_path)) == 0
    assert not parts.exists() and (tmp_path / "light.cache").exists()


def test_a_command_that_fails_leaves_no_folder(here, tmp_path):
    frames = str(tmp_path / "frames")
    assert main(["farm", "frames", str(tmp_path / "nope.xml"), "-o", frames]) == 1
    assert not Path(frames).exists()


@pytest.mark.parametrize("name", ["no_such_module", "./mod.py"])
def test_a_module_that_is_missing_is_named_in_one_line(tmp_path, capsys, name):
    command = ["farm", "cache", copied(tmp_path / "a"), "-o", str(tmp_path / "light.cache")]
    assert main([*command, "--import", name]) == 1
    said = capsys.readouterr().err
    assert said.startswith("irrcache: error: --import ") and name in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("command", ["render", "farm cache", "fit"])
def test_a_variant_that_cannot_be_used_is_named_in_one_line(tmp_path, capsys, monkeypatch, command):
    """Mitsuba raises an ImportError where there is no GPU."""

    def fails(name: str) -> None:
        raise ImportError(f"{name}: the CUDA backend hasn't been initialized.")

    monkeypatch.setattr(mi, "set_variant", fails)
    scene, image = copied(tmp_path / "a"), str(tmp_path / "a.exr")
    write_image(image, np.zeros((8, 8, 3), np.float32), {})
    own = ["--images", image] if command == "fit" else []
    output = "folder" if command == "fit" else "light.cache" if "cache" in command else "b.exr"
    arguments = [*command.split(), scene, *own, "-o", str(tmp_path / output), "-m", "cuda_ad_rgb"]
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert 'error: -m is "cuda_ad_rgb", which cannot be used on this machine' in said
    assert "irrcache doctor" in said and said.count("\n") == 1


@pytest.mark.parametrize("resume", [[], ["--resume"]])
@pytest.mark.parametrize("name", ["scene.xml", "notes.txt"])
def test_nobody_is_told_to_delete_what_is_no_cache(here, tmp_path, capsys, name, resume):
    scene = Path(copied(tmp_path / "a"))
    file = scene.with_name(name)
    content = scene.read_text()
    file.write_text(content)
    assert main(["farm", "cache", str(scene), "-o", str(file), *resume]) == 1
    said = capsys.readouterr().err
    assert f'"{file}" is ' in said and "name another" in said and "delete it" not in said
    assert file.read_text() == content


def test_a_study_without_a_folder_says_so_and_leaves_none(tmp_path, capsys, monkeypatch):
    def fails(*_):
        raise IrrcacheError("there is no such integrator; name another.")

    monkeypatch.setattr(studies, "run_job", fails)
    scene = copied(tmp_path / "a")
    for output, said in (
        (tmp_path / "nope" / "x", f'cannot write "{tmp_path / "nope" / "x"}": "'),
        (scene, f'-o "{scene}" is a file; name a folder.'),
        (tmp_path / "x", "there is no such integrator"),
    ):
        assert main(["farm", "study", scene, "-i", "volpath", "-o", str(output)]) == 1
        assert said in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    options = ["--references", f"{scene}/x", "--reference-spp", "4"]
    assert main(["farm", "reference", scene, *options]) == 1
    assert "name another folder by --references" in capsys.readouterr().err
