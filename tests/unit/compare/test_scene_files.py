"""The digest of a scene changes with all that is read for its image, and with nothing else."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.compare.scene_files import scene_digest

zarr = pytest.importorskip("zarr", reason="zarr is not installed")
pytestmark = pytest.mark.usefixtures("rgb")

SCENE = """<scene version="3.0.0">
    <default name="light" value=""/>
    <default name="volume" value="volume.zarr"/>
    <path value="data"/>
    <integrator type="irrcache">
        <string name="sigma_t_file" value="$volume"/>
        <string name="cache_file" value="light.cache"/>
        <string name="irradiance_file" value="$light"/>
        <string name="work_folder" value="working"/>
    </integrator>
    <include filename="light.xml"/>
    <shape type="rectangle">
        <bsdf type="diffuse">
            <texture type="bitmap" name="reflectance">
                <string name="filename" value="texture.exr"/>
            </texture>
        </bsdf>
    </shape>
    <shape type="ply">
        <string name="filename" value="mesh.ply"/>
        <bsdf type="diffuse"> <spectrum name="reflectance" filename="paint.spd"/> </bsdf>
    </shape>
</scene>
"""
LIGHT = '<scene version="3.0.0"><emitter type="constant"/><!--{}--></scene>'


def write(file: Path, number: int) -> None:
    """Write a file of its type, whose contents differ by ``number``."""
    if file.suffix == ".zarr":
        array = zarr.create_array(
            store=file, shape=(4, 4, 4), chunks=(2, 4, 4), dtype="f4", overwrite=True
        )
        array[:] = np.arange(64).reshape(4, 4, 4) + number * np.eye(4)
    elif file.suffix == ".npy":
        np.save(file, np.full((2, 2, 2), number, np.float32))
    elif file.suffix == ".spd":
        file.write_text(f"400 0.{number}\n700 0.5\n")
    else:
        file.write_text(LIGHT.format(number) if file.suffix == ".xml" else f"file {number}")


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Return a scene whose files are beside it, in its <path>, and in the working folder."""
    for name in ("scene/data", "scene/working", "here"):
        (tmp_path / name).mkdir(parents=True)
    folder = tmp_path / "scene"
    (folder / "scene.xml").write_text(SCENE)
    for name in ("light.xml", "mesh.ply", "data/texture.exr", "data/paint.spd", "data/volume.zarr"):
        write(folder / name, 1)
    write(tmp_path / "here" / "density.npy", 1)
    monkeypatch.chdir(tmp_path / "here")
    return folder / "scene.xml"


#: Integrators that replace the scene's own, and the file that each one reads.
OWN, VOLUME = None, "irrcache{sigma_t_file=density.npy,cache_file=light.cache}"


@pytest.mark.parametrize(
    ("integrator", "file"),
    [
        (OWN, "light.xml"),
        (OWN, "mesh.ply"),
        (OWN, "data/texture.exr"),
        (OWN, "data/paint.spd"),
        (OWN, "data/volume.zarr"),
        (VOLUME, "../here/density.npy"),
        (VOLUME, "data/paint.spd"),
    ],
)
def test_what_is_read_is_part_of_the_digest(scene, integrator, file):
    before = scene_digest(scene, {}, integrator)
    write(scene.parent / file, 2)
    after = scene_digest(scene, {}, integrator)
    assert before != after
    write(scene.parent / file, 2)
    assert scene_digest(scene, {}, integrator) == after


@pytest.mark.parametrize(
    ("integrator", "file"),
    [
        (OWN, "light.cache"),
        (OWN, "../here/light.cache"),
        (OWN, "light.npy"),
        (OWN, "working/part.npy"),
        (OWN, "data/beside.txt"),
        (VOLUME, "../here/light.cache"),
        (VOLUME, "data/volume.zarr"),  # of the integrator that is replaced
    ],
)
def test_what_is_written_and_not_read_is_not_part_of_it(scene, integrator, file):
    parameters = {"light": "light.npy"}
    before = scene_digest(scene, parameters, integrator)
    write(scene.parent / file, 2)
    assert scene_digest(scene, parameters, integrator) == before


def test_files_in_the_working_folder_of_the_command_are_found_from_any_other(
    scene, tmp_path, monkeypatch
):
    before = scene_digest(scene, {}, VOLUME, tmp_path / "here")
    monkeypatch.chdir(tmp_path)
    assert scene_digest(scene, {}, VOLUME, tmp_path / "here") == before
    write(tmp_path / "here" / "density.npy", 2)
    assert scene_digest(scene, {}, VOLUME, tmp_path / "here") != before


def test_folders_of_a_scene_are_not_searched_for_the_next_one(scene):
    before = str(mi.file_resolver())
    scene_digest(scene, {})
    assert str(mi.file_resolver()) == before
