"""What workers refuse, and references and studies of jobs that are run here one by one."""

from __future__ import annotations

import argparse
import hashlib
import importlib
import re
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenImageIO as oiio  # noqa: N813 (the name its documentation uses)
import pytest
from mitsuba_irrcache.scenes import scene_path

from mitsuba_irrcache.compare import reference as stored
from mitsuba_irrcache.compare.command import common_job
from mitsuba_irrcache.compare.results import Measurement, Snapshot
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm import jobs, references, studies, work
from mitsuba_irrcache.farm.jobs import Environment, Job, scene_arguments
from mitsuba_irrcache.farm.references import ReferenceRun
from mitsuba_irrcache.farm.results import Outcome
from mitsuba_irrcache.farm.studies import SceneStudy, arguments_by_scene
from mitsuba_irrcache.farm.work import KINDS, UnfitWorkerError, set_up
from mitsuba_irrcache.io.images import read_image, write_image
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium

pytestmark = pytest.mark.usefixtures("rgb")

SMALL = {"size": "8", "max_depth": "3"}
#: A tumbler, of which Mitsuba's integrators render one image faster than with a cache.
TUMBLER = """<scene version="3.0.0">
    <integrator type="irrcache"/>
    <sensor type="perspective">
        <float name="fov" value="35"/>
        <transform name="to_world">
            <lookat origin="0, -5, 1.5" target="0, 0, 0.5" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/> <integer name="height" value="8"/>
        </film>
    </sensor>
    <emitter type="constant"/>
    <medium type="homogeneous" id="milk"> <float name="albedo" value="0.9"/> </medium>
    <shape type="cylinder">
        <float name="radius" value="0.8"/>
        <point name="p0" value="0, 0, 0"/> <point name="p1" value="0, 0, 1.2"/>
        <bsdf type="dielectric"/> <ref id="milk" name="interior"/>
    </shape>
    <shape type="disk">
        <transform name="to_world"> <scale value="0.8"/> <rotate x="1" angle="180"/> </transform>
        <bsdf type="dielectric"/> <ref id="milk" name="interior"/>
    </shape>
    <shape type="disk">
        <transform name="to_world"> <scale value="0.8"/> <translate z="1.2"/> </transform>
        <bsdf type="dielectric"/> <ref id="milk" name="interior"/>
    </shape>
</scene>
"""


@pytest.fixture(autouse=True)
def _nothing_is_kept(monkeypatch):
    """Free what jobs leave for the next ones: kernels of later tests would differ with it."""
    for name in ("_SCENES", "_CACHES"):
        monkeypatch.setattr(work, name, work._Kept())


@pytest.fixture
def environment():
    """Return the environment of jobs of this process."""
    return Environment.here("llvm_ad_rgb", [], 0)


@pytest.fixture
def scene(tmp_path):
    """Return a copy of a scene."""
    path = tmp_path / "cloud.xml"
    path.write_text(Path(scene_path("cloud")).read_text())
    return path


def outcome(job: Job, folder: Path) -> Outcome:
    """Run a job as a worker does, in a new ``folder``."""
    folder.mkdir()
    digests = KINDS[job.kind](job.arguments, folder) or {}
    files = [path for path in folder.rglob("*") if path.is_file()]
    contents = {str(path.relative_to(folder)): path.read_bytes() for path in files}
    return Outcome("here", files=contents, digests=digests)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"software": (("mitsuba_irrcache", "0.0.1"),)}, "it has mitsuba_irrcache .*, not 0.0.1"),
        ({"variant": "cuda_no_such"}, "cuda_no_such cannot be used"),
        (
            {"modules": ("no_such_module",)},
            r'^--import no_such_module: there is no module "no_such_module"; .*PYTHONPATH$',
        ),
    ],
    ids=str,
)
def test_a_worker_of_another_kind_says_why(environment, change, said):
    set_up(environment)
    with pytest.raises(UnfitWorkerError, match=said):
        set_up(replace(environment, **change))


@pytest.mark.parametrize("is_package", [False, True])
def test_edits_of_an_imported_module_are_seen(tmp_path, monkeypatch, is_package):
    """Jobs have other digests, and a worker that has imported it before is of another kind."""
    monkeypatch.syspath_prepend(tmp_path)
    name = f"edited_plugin_{is_package}"
    file = tmp_path / f"{name}.py"
    if is_package:
        file = tmp_path / name / "level.py"
        file.parent.mkdir()
        (file.parent / "__init__.py").write_text("from . import level\n")

    def imported(content: str) -> Environment:
        """As in a new process."""
        file.write_text(content)
        jobs.source_digest.cache_clear()
        importlib.import_module(name)
        return Environment.here("llvm_ad_rgb", [name], 0)

    try:
        first, again, second = map(imported, ("LEVEL = 1\n", "LEVEL = 1\n", "LEVEL = 2\n"))
        digests = [Job("a", "frame", {}, each).digest for each in (first, again, second)]
        assert digests[0] == digests[1] != digests[2]
        imported("LEVEL = 1\n")
        file.write_text("LEVEL = 2\n")
        set_up(first)
        with pytest.raises(UnfitWorkerError, match=f'another version of the module "{name}"'):
            set_up(second)
    finally:
        jobs.source_digest.cache_clear()


def test_a_worker_reads_exr_files_whatever_its_threads(environment, tmp_path):
    """With a single thread of Dr.Jit, Mitsuba would never finish."""
    threads = dr.thread_count()
    try:
        set_up(replace(environment, threads=1))
        assert dr.thread_count() > 1
        image = mi.Bitmap(np.ones((64, 64, 3), np.float32))
        image.write(str(tmp_path / "image.exr"))
        np.testing.assert_array_equal(np.array(mi.Bitmap(str(tmp_path / "image.exr"))), 1)
    finally:
        dr.set_thread_count(threads)


def frame_job(
    scene: Path, integrator: str | None, environment: Environment, parameters: dict
) -> Job:
    """Return a job of one frame."""
    arguments = {"scene": scene_arguments(scene, parameters, integrator)}
    arguments |= {"sensor": 0, "seed": 0, "spp": 1, "file": "frame.exr"}
    return Job("frame", "frame", arguments, environment)


def test_frames_share_a_cache_file_in_the_folder_of_the_command(
    scene, environment, tmp_path, monkeypatch
):
    """Workers run in other folders, and the file is there from the second frame on."""
    integrator = "irrcache{solver=path,resolution=4,cache_spp=16,cache_file=light.cache}"
    monkeypatch.chdir(tmp_path)
    job = frame_job(scene, integrator, environment, SMALL)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    first = outcome(job, tmp_path / "first")
    assert (tmp_path / "light.cache").exists() and not any(Path.cwd().iterdir())
    second = outcome(job, tmp_path / "second")
    assert second.files["frame.png"] == first.files["frame.png"]
    monkeypatch.chdir(tmp_path)
    assert frame_job(scene, integrator, environment, SMALL).digest == job.digest


def test_cache_files_of_all_media_and_of_nested_integrators_are_found(scene, tmp_path):
    """Each by the name that the scene gives, wherever the folder of the command is."""
    own = '<integrator type="$integrator">\n        <integer name="max_depth" value="$max_depth"/>'
    assert own in scene.read_text()
    named = f'<integrator type="aov">{own} <string name="cache_file" value="a/light.cache"/>'
    text = scene.read_text().replace(own, named).replace("</integrator>", "</integrator>" * 2, 1)
    scene.write_text(text)
    arguments = scene_arguments(scene, SMALL, None) | {"folder": str(tmp_path / "command")}
    assert jobs.caches_of(arguments) == {}
    (tmp_path / "command" / "a").mkdir(parents=True)
    for name in ("light.cache", "light.fog.cache", "light2.cache", "light.png"):
        (tmp_path / "command" / "a" / name).write_text(name)
    expected = {
        f"a/{name}": hashlib.sha256(name.encode()).hexdigest()
        for name in ("light.cache", "light.fog.cache")
    }
    assert jobs.caches_of(arguments) == expected


def test_frames_that_need_no_cache_are_rendered_without_one(environment, tmp_path):
    """As `irrcache render` does, and with the same image."""
    path = tmp_path / "tumbler.xml"
    path.write_text(TUMBLER)
    scene = load_scene(path)
    assert not scene.integrator().uses_cache(scene, spp=1)
    found = outcome(frame_job(path, None, environment, {}), tmp_path / "found")
    (tmp_path / "found.exr").write_bytes(found.files["frame.exr"])
    expected = np.array(mi.render(scene, spp=1, seed=0))
    assert scene.integrator().cache.samples == 0
    # Mitsuba's film adds in no fixed order.
    np.testing.assert_allclose(read_image(tmp_path / "found.exr"), expected, rtol=1e-5)


@pytest.mark.parametrize("is_edited", [False, True])
def test_frames_under_an_environment_map(scene, environment, tmp_path, monkeypatch, is_edited):
    """Also where the integrator replaces its caches after their fingerprints were computed."""
    sky = scene.with_name("sky.exr")
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(sky))
    named = f'<emitter type="envmap"><string name="filename" value="{sky}"/>'
    text = scene.read_text().replace('<emitter type="constant">', named)
    assert named in text
    scene.write_text(re.sub('<rgb name="radiance".*?/>', "", text))
    integrator = "irrcache{solver=path,resolution=4,cache_spp=16}"
    job = frame_job(scene, integrator, environment, SMALL)
    expected = np.array(mi.render(load_scene(scene, SMALL, integrator), spp=1, seed=0))
    if is_edited:
        fingerprint = CachedMedium.fingerprint

        def and_edit(medium, scene):
            params = mi.traverse(scene)
            (key,) = (key for key in params.keys() if key.endswith(".irradiance.value"))
            params[key] = params[key] * 2
            params.update()
            return fingerprint(medium, scene)

        monkeypatch.setattr(CachedMedium, "fingerprint", and_edit)
    for name in ("first", "second"):
        found = outcome(job, tmp_path / name)
        (tmp_path / "found.exr").write_bytes(found.files["frame.exr"])
        if not is_edited:
            np.testing.assert_array_equal(read_image(tmp_path / "found.exr"), expected)


@pytest.mark.parametrize("pixels", ["rgb", "rgba", "luminance"])
@pytest.mark.parametrize("nested", [1, 2])
def test_frames_have_the_channels_of_integrators_in_others(
    scene, environment, tmp_path, pixels, nested
):
    """Mitsuba's ``aov`` names more channels than its image has."""
    own = '<integrator type="$integrator">\n        <integer name="max_depth" value="$max_depth"/>'
    aov = '<integrator type="aov"> <string name="aovs" value="dd:depth,nn:sh_normal"/>'
    text = scene.read_text()
    begin = text.index(own)
    end = text.index("</integrator>") + len("</integrator>")
    inner = text[begin:end] + "".join(['<integrator type="direct"/>'] * (nested - 1))
    text = f"{text[:begin]}{aov}{inner}</integrator>{text[end:]}"
    film = '<film type="hdrfilm">'
    assert film in text
    text = text.replace(film, f'{film} <string name="pixel_format" value="{pixels}"/>')
    scene.write_text(text)
    job = frame_job(scene, None, environment, SMALL | {"integrator": "volpath"})
    found = outcome(job, tmp_path / "found")
    (tmp_path / "found.exr").write_bytes(found.files["frame.exr"])
    shown = {"rgb": "RGB", "rgba": "RGBA", "luminance": "Y"}[pixels]
    channels = oiio.ImageBuf(str(tmp_path / "found.exr")).spec().channelnames
    assert "".join(sorted(channels[: len(shown)])) == "".join(sorted(shown))
    assert {name.rpartition(".")[2] for name in channels[-4:]} == {"T", "X", "Y", "Z"}
    assert len(channels) == nested * len(shown) + 4


def test_a_worker_that_sees_other_files_says_so(scene, tmp_path):
    arguments = {"scene": scene_arguments(scene, SMALL, "volpath"), "sensor": 0, "first": 0}
    arguments |= {"spp": 1, "file": "part.npz"}
    scene.write_text(scene.read_text().replace("albedo", "albedo "))
    with pytest.raises(UnfitWorkerError, match=r"the files of .*cloud.xml.* differ"):
        KINDS["reference_part"](arguments, tmp_path)
    scene.unlink()
    with pytest.raises(UnfitWorkerError, match=r"it has no file .*cloud.xml"):
        KINDS["reference_part"](arguments, tmp_path)


def test_a_reference_of_jobs_is_the_one_of_one_process(scene, environment, tmp_path, monkeypatch):
    """Its launches arrive in reverse order, with an interruption between."""
    for module in (stored, references):
        monkeypatch.setattr(module, "CHUNK", 2)
    arguments = scene_arguments(scene, SMALL, "volpath")
    path = tmp_path / "references" / "cloud.npz"
    run = ReferenceRun(arguments, 0, path, 8, environment)
    jobs = run.missing
    for number, job in enumerate((jobs[0], jobs[3])):
        run.store(job, outcome(job, tmp_path / f"before-{number}"))
    assert not run.finish() and stored.Reference.load(path).spp == 2
    run = ReferenceRun(arguments, 0, path, 8, environment)
    assert [job.name for job in run.missing] == [jobs[1].name, jobs[2].name]
    for number, job in enumerate(reversed(run.missing)):
        run.store(job, outcome(job, tmp_path / f"after-{number}"))
    assert run.finish() and not path.with_name("cloud.npz.parts").exists()
    found = stored.Reference.load(path)
    alone = stored.reference(scene, SMALL, "volpath", tmp_path, spp=8)
    assert found.spp == alone.spp == 8
    # Mitsuba's film adds in no fixed order.
    np.testing.assert_allclose([found.a, found.b], [alone.a, alone.b], rtol=1e-5, atol=1e-6)
    assert np.abs(found.a - found.b).max() > 1e-3


def measured(job, integrator, name, budgets, folder) -> None:
    """Stand in for `measure_integrator`, which starts several processes."""
    write_image(folder / "images" / f"{name}.exr", np.full((8, 8, 3), 0.3, np.float32), {})
    snapshot = Snapshot(budgets[0], {"image": 0.1}, 4, f"images/{name}.exr")
    Measurement(integrator, name, [snapshot]).save(folder / "measurements" / f"{name}.json")


def test_a_study_reports_what_workers_measured(scene, environment, tmp_path, monkeypatch):
    written: list[tuple] = []
    monkeypatch.setattr(work, "measure_integrator", measured)
    monkeypatch.setattr(studies, "write_report", lambda *arguments: written.append(arguments))
    args = argparse.Namespace(
        scenes=[str(scene)], output=str(tmp_path), integrator=["volpath"], reference="volpath",
        mode="llvm_ad_rgb", define=[f"{k}={v}" for k, v in SMALL.items()], modules=[], sensor=0,
        exposure=0.0,
    )  # fmt: skip
    (own,) = arguments_by_scene(args)
    study = SceneStudy(own, common_job(own), [0.1], environment)
    (job,) = study.begin(resume=False)
    study.store(job, outcome(job, tmp_path / "scratch"))
    truth = stored.Reference(np.zeros((8, 8, 3)), np.zeros((8, 8, 3)), 8, 1.0)
    assert study.report(truth) == tmp_path / "cloud" / "report.html"
    ((_, folder, (measurement,), reference, budgets, checked),) = written
    assert folder == tmp_path / "cloud" and reference is truth and budgets == [0.1]
    assert measurement.integrator == "volpath" and checked["size"] == [8, 8]
    np.testing.assert_allclose(measurement.snapshots[0].read(folder), 0.3)
    again = SceneStudy(own, common_job(own), [0.1], environment)
    assert again.begin(resume=True) == []
    measurement.error = "out of memory"
    measurement.save(folder / "measurements" / f"{measurement.name}.json")
    assert [each.name for each in again.begin(resume=True)] == [job.name]


def test_reports_of_a_study_need_folders_of_their_own(tmp_path):
    args = argparse.Namespace(scenes=["a/scene.xml", "b/a.xml"], output=str(tmp_path))
    with pytest.raises(IrrcacheError, match='2 scenes are called "a"'):
        arguments_by_scene(args)


def test_the_digest_of_a_scene_is_that_of_its_contents(scene):
    before = scene_arguments(scene, SMALL, None)
    assert before == scene_arguments(scene, SMALL, None) and mi.variant() == before["variant"]
    scene.write_text(scene.read_text().replace('value="0.95"', 'value="0.94"'))
    assert before["contents"] != scene_arguments(scene, SMALL, None)["contents"]
