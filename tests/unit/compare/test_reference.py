"""A converged reference is never recomputed; a changed scene never reuses one."""

from __future__ import annotations

import argparse
from contextlib import ExitStack

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.compare.reference import CHUNK, Reference, reference, reference_path
from mitsuba_irrcache.compare.scene_files import scene_inputs
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.farm import runs

pytestmark = pytest.mark.usefixtures("rgb")

SCENE = """<scene version="3.0.0">
    <path value="data"/>
    <default name="albedo" value="0.8"/>
    <include filename="camera.xml"/>
    <shape type="cube">
        <bsdf type="null"/>
        <medium name="interior" type="heterogeneous">
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="density.vol"/>
            </volume>
            <float name="albedo" value="$albedo"/>
        </medium>
    </shape>
    <emitter type="constant"/>
</scene>
"""
CAMERA = """<scene version="3.0.0">
    <integrator type="volpath"> <integer name="max_depth" value="2"/> </integrator>
    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="0, 0, -5" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="24"/>
            <integer name="height" value="24"/>
            <rfilter type="box"/>
        </film>
    </sensor>
</scene>
"""


@pytest.fixture
def scene(tmp_path):
    """A scene that includes a file, and finds a volume in a folder that it names by <path>."""
    folder = tmp_path / "scene"
    (folder / "data").mkdir(parents=True)
    mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32)).write(str(folder / "data" / "density.vol"))
    (folder / "camera.xml").write_text(CAMERA)
    (folder / "scene.xml").write_text(SCENE)
    return folder / "scene.xml"


@pytest.fixture
def launches(monkeypatch):
    """Seeds of all renders while the test runs."""
    seeds: list[int] = []
    render = mi.render

    def counted(*args, **kwargs):
        seeds.append(kwargs["seed"])
        return render(*args, **kwargs)

    monkeypatch.setattr(mi, "render", counted)
    return seeds


def make(scene, spp=2, integrator="volpath", **parameters):
    return reference(scene, parameters, integrator, scene.parent.parent / "kept", spp)


def test_all_files_of_a_scene(scene):
    (scene.parent / "picture.exr").write_bytes(b"not named by the scene")
    names = {file.name for file in scene_inputs(scene, {})[0]}
    assert names == {"scene.xml", "camera.xml", "density.vol"}


def test_reference_is_reused(scene, launches):
    """Found again, also with a file more beside it, from another folder, or for fewer samples."""
    first = make(scene, 4)
    count = len(launches)
    (scene.parent / "out.exr").write_bytes(b"a render beside the scene")
    moved = scene.parent.rename(scene.parent.parent / "moved")
    (scene.parent.parent / "scene").symlink_to(moved)
    for again in (make(scene, 4), make(scene, 2)):
        np.testing.assert_array_equal(again.a, first.a)
        np.testing.assert_array_equal(again.b, first.b)
    assert len(launches) == count


@pytest.mark.parametrize("file", ["scene.xml", "camera.xml", "data/density.vol"])
def test_a_changed_file(scene, launches, file):
    make(scene)
    count = len(launches)
    path = scene.parent / file
    if path.suffix == ".vol":
        mi.VolumeGrid(np.full((2, 2, 2, 1), 1.01, np.float32)).write(str(path))
    else:
        path.write_text(path.read_text().replace("0.8", "0.7").replace('"2"', '"3"'))
    make(scene)
    assert len(launches) == 2 * count


@pytest.mark.parametrize("size", [0, 100, 1000])
def test_a_damaged_file_is_named(scene, size):
    folder = scene.parent.parent / "kept"
    make(scene)
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(IrrcacheError, match=rf'"{path}" is not a readable reference.*delete it'):
        make(scene)


def test_other_settings(scene, launches):
    """Parameters, integrator and variant are part of what a reference belongs to."""
    make(scene)
    make(scene, albedo="0.5")
    make(scene, integrator="volpath{rr_depth=9}")
    count = len(launches)
    assert count == 3 * 2
    make(scene, albedo="0.5")
    assert len(launches) == count


def test_continued(scene, launches):
    """More samples are added to what is there, with seeds never used before."""
    first = make(scene, CHUNK)
    more = make(scene, 2 * CHUNK)
    assert (first.spp, more.spp) == (CHUNK, 2 * CHUNK)
    assert len(launches) == 4 and len(set(launches)) == 4
    assert more.seconds > first.seconds
    added = 2 * more.a - first.a  # the mean of the samples that came second
    assert not np.allclose(added, first.a)


def test_halves_are_independent(scene):
    """Errors of a and b do not correlate: they are orthogonal to four standard errors."""
    found = make(scene, 16)
    truth = make(scene, 16 * CHUNK, integrator="volpath{rr_depth=1000}").mean
    errors = (found.a - truth) * (found.b - truth)
    assert abs(errors.mean()) < 4 * errors.std() / np.sqrt(errors[..., 0].size)
    squares = (found.a - truth) ** 2  # the same test fails if a and b were one image
    assert squares.mean() > 4 * squares.std() / np.sqrt(errors[..., 0].size)


def test_by_time(scene, launches):
    """A time that was spent already is not spent again."""
    folder = scene.parent.parent / "kept"
    first = reference(scene, {}, "volpath", folder, seconds=0.2)
    assert first.seconds >= 0.2
    count = len(launches)
    reference(scene, {}, "volpath", folder, seconds=0.2)
    assert len(launches) == count


def test_round_trip(tmp_path):
    a, b = np.random.default_rng(0).normal(size=(2, 3, 4, 3))
    Reference(a, b, 7, 1.5).save(tmp_path / "r.npz")
    read = Reference.load(tmp_path / "r.npz")
    np.testing.assert_array_equal(read.a, a)
    np.testing.assert_array_equal(read.b, b)
    assert (read.spp, read.seconds) == (7, 1.5)


def test_references_without_the_emission_of_media_are_refused(scene, tmp_path):
    """All errors would be those of the reference."""
    text = scene.read_text()
    (scene.parent / "camera.xml").write_text(
        CAMERA.replace(
            '<integrator type="volpath"> <integer name="max_depth" value="2"/>',
            '<integrator type="irrcache"> <rgb name="emission" value="1, 0.5, 0"/>'
            '<float name="emission_scale" value="$emission"/>',
        )
    )
    scene.write_text(text.replace("<path", '<default name="emission" value="1"/> <path', 1))
    with pytest.raises(IrrcacheError, match="would be without emission"):
        reference(scene, {}, "volpath", tmp_path / "references", spp=1)
    assert reference(scene, {"emission": "0"}, "volpath", tmp_path / "references", spp=1).spp >= 1
    # A file that another program has left is not returned either.
    folder = tmp_path / "references"
    empty = reference(scene, {"emission": "0"}, "volpath", folder, spp=1)
    empty.save(reference_path(scene, {}, "volpath", 0, folder))
    with pytest.raises(IrrcacheError, match="would be without emission"):
        reference(scene, {}, "volpath", folder, spp=1)
    farm = argparse.Namespace(reference="volpath", sensor=0, references=folder, reference_spp=4)
    with pytest.raises(IrrcacheError, match="would be without emission"):
        runs._reference(farm, scene, {}, None, {}, ExitStack())
