"""The imported folder is complete or absent, placed as the data, and rendered by stock Mitsuba."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import SimpleITK

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.mitsuba_vol import read_vol, write_vol
from mitsuba_irrcache.volumes import importer
from mitsuba_irrcache.volumes.data import VolumeData
from mitsuba_irrcache.volumes.scene import SceneSettings, camera, write_scene
from mitsuba_irrcache.volumes.transfer import DensityMapping

FILES = {"scene.xml", "sigma_t.vol", "albedo.vol", "transfer_function.json"}
TURN = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, -1.0]])


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def blob(shape=(6, 8, 10)) -> VolumeData:
    """Return a ball, smaller than the grid, in a rotated and mirrored grid of anisotropic
    voxels.
    """
    z, y, x = np.indices(shape)
    distance = np.sqrt((x - 5) ** 2 + (y - 4) ** 2 + (1.5 * (z - 3)) ** 2)
    values = np.where(distance < 3.5, 100.0, 0.0).astype(np.float32)
    return VolumeData(values, (1.0, 1.5, 2.0), (100.0, -40.0, 7.0), TURN)


def write(target: Path, volume: VolumeData | None = None, albedo=(0.9,) * 3, **options) -> int:
    volume = volume or blob()
    mapping = DensityMapping(0.01, albedo)
    return write_scene(target, volume, mapping, *mapping.apply(volume.values), **options)


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    importer.add_arguments(parser)
    return parser.parse_args([str(argument) for argument in arguments])


# The scene


def test_stock_mitsuba_renders_the_scene(tmp_path):
    written = write(tmp_path / "out")
    assert set(os.listdir(tmp_path / "out")) == FILES
    assert written == sum(path.stat().st_size for path in (tmp_path / "out").iterdir())
    scene = mi.load_file(str(tmp_path / "out" / "scene.xml"), width=16, height=16)
    image = np.array(mi.render(scene, spp=32, seed=1))
    assert image.shape == (16, 16, 3) and np.isfinite(image).all()
    # The ball attenuates the middle of the image, and hardly the corners.
    assert image[7:9, 7:9].mean() < 0.9
    np.testing.assert_allclose(image[[0, 0, -1, -1], [0, -1, 0, -1]], 1.0, atol=0.05)


def test_mirrored_grid_renders_the_same_image(tmp_path):
    """Slices in reverse order with a mirrored axis are the same volume.

    Stock Mitsuba takes the outside of a mirrored cube for the medium.
    """
    plain = blob()
    last = plain.index_to_world @ (0, 0, plain.size[2] - 1, 1)
    flipped = replace(
        plain,
        values=plain.values[::-1],
        direction=plain.direction * (1, 1, -1),
        origin=tuple(last[:3]),
    )
    images = []
    for name, volume in {"plain": plain, "flipped": flipped}.items():
        write(tmp_path / name, volume)
        scene = mi.load_file(str(tmp_path / name / "scene.xml"), width=16, height=16)
        images.append(np.array(mi.render(scene, spp=64, seed=1)))
    assert np.abs(images[0] - images[1]).mean() < 0.01


def test_extinction_lies_where_the_voxels_are(tmp_path):
    volume = blob()
    write(tmp_path / "out", volume, albedo=(0.1, 0.5, 0.9))
    scene = mi.load_file(str(tmp_path / "out" / "scene.xml"), scale=3.0)
    shape = scene.shapes()[0]
    medium = shape.interior_medium()
    for index in [(5, 4, 3), (0, 0, 0), (9, 7, 5), (3, 4, 3)]:
        x, y, z = index
        interaction = mi.MediumInteraction3f()
        interaction.p = mi.Point3f((volume.index_to_world @ (*index, 1.0))[:3].tolist())
        sigma_s, _, sigma_t = medium.get_scattering_coefficients(interaction, True)
        expected = 3.0 * 0.01 * volume.values[z, y, x]
        np.testing.assert_allclose(np.array(sigma_t).ravel(), expected, atol=1e-4)
        np.testing.assert_allclose(
            np.array(sigma_s).ravel(), expected * np.array([0.1, 0.5, 0.9]), atol=1e-4
        )
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    corners = (corners @ volume.to_world.T)[:, :3]
    np.testing.assert_allclose(np.array(shape.bbox().min).ravel(), corners.min(0), rtol=1e-4)
    np.testing.assert_allclose(np.array(shape.bbox().max).ravel(), corners.max(0), rtol=1e-4)


def test_settings_are_parameters(tmp_path):
    write(tmp_path / "out", settings=SceneSettings(max_depth=5, width=40, height=30))
    path = str(tmp_path / "out" / "scene.xml")
    scene = mi.load_file(path)
    assert tuple(scene.sensors()[0].film().size()) == (40, 30)
    assert "max_depth = 5" in str(scene.integrator())
    replaced = mi.load_file(path, integrator="prbvolpath", max_depth=3, spp=7, width=20)
    assert "PRBVolpath" in type(replaced.integrator()).__name__
    assert replaced.sensors()[0].sampler().sample_count() == 7


@pytest.mark.parametrize("up", ["z", "y"])
def test_camera_frames_the_occupied_voxels(up):
    """All nonempty voxels are inside the field of view, and some are near its edge."""
    volume = blob()
    origin, target, up_vector = camera(volume, volume.values, up)
    z, y, x = np.nonzero(volume.values)
    world = np.stack([x, y, z, np.ones_like(x)], axis=1) @ volume.index_to_world.T
    forward = (target - origin) / np.linalg.norm(target - origin)
    right = np.cross(forward, up_vector)
    right /= np.linalg.norm(right)
    offset = world[:, :3] - origin
    screen = offset @ np.stack([right, np.cross(right, forward)], axis=1)
    reach = np.abs(screen / (offset @ forward)[:, None]).max() / np.tan(np.radians(15))
    assert 0.8 < reach < 1.0


def test_patient_is_seen_from_the_front():
    """LPS: the camera lies at -y, the head is up, the patient's left is on the right."""
    volume = VolumeData(np.ones((5, 5, 5)))
    origin, target, up = camera(volume, volume.values)
    assert origin[1] < target[1] and up[2] == 1
    assert np.cross(target - origin, up)[0] > 0


def test_rendered_picture_is_not_mirrored(tmp_path):
    """An opaque cube at the patient's left (+x) and head (+z) darkens the upper right."""
    values = np.zeros((9, 9, 9), dtype=np.float32)
    values[0, 0, 0] = values[8, 8, 8] = values[0, 8, 0] = values[8, 0, 0] = 1e-3
    values[6:9, 3:6, 6:9] = 500.0
    write(tmp_path / "out", VolumeData(values), albedo=(0.0,) * 3)
    scene = mi.load_file(str(tmp_path / "out" / "scene.xml"), width=16, height=16)
    image = np.array(mi.render(scene, spp=16)).mean(axis=2)
    quarters = [
        image[r, c].mean() for r in (slice(8), slice(8, 16)) for c in (slice(8), slice(8, 16))
    ]
    assert np.argmin(quarters) == 1


@pytest.mark.parametrize(("albedo", "channels"), [((0.7,) * 3, 1), ((0.7, 0.6, 0.7), 3)])
def test_grey_albedo_has_one_channel(tmp_path, albedo, channels):
    write(tmp_path / "out", albedo=albedo)
    assert read_vol(tmp_path / "out" / "albedo.vol")[0].shape == (6, 8, 10, channels)


# Atomic creation


def test_earlier_result_is_replaced_only_with_overwrite(tmp_path):
    write(tmp_path / "out")
    before = (tmp_path / "out" / "sigma_t.vol").read_bytes()
    with pytest.raises(IrrcacheError, match="not empty"):
        write(tmp_path / "out", blob((5, 6, 7)))
    assert (tmp_path / "out" / "sigma_t.vol").read_bytes() == before
    write(tmp_path / "out", blob((7, 8, 9)), overwrite=True)
    assert read_vol(tmp_path / "out" / "sigma_t.vol")[0].shape == (7, 8, 9, 1)
    assert os.listdir(tmp_path) == ["out"]


def test_unrelated_files_are_never_replaced(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    with pytest.raises(IrrcacheError, match=r"thesis.tex"):
        write(tmp_path / "out", overwrite=True)
    write(tmp_path / "out" / "scene.xml", overwrite=True)
    assert set(os.listdir(tmp_path / "out")) == FILES | {"thesis.tex"}


def test_scene_file_in_a_folder_with_other_files(tmp_path):
    (tmp_path / "ct.nrrd").write_text("data")
    write(tmp_path / "bone.xml")
    assert set(os.listdir(tmp_path)) == FILES - {"scene.xml"} | {"bone.xml", "ct.nrrd"}
    with pytest.raises(IrrcacheError, match=r"has .*albedo.vol.* already"):
        write(tmp_path / "chest.xml")


@pytest.mark.parametrize("target", ["out", "scene.xml"])
@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
def test_interrupted_import_leaves_nothing_behind(tmp_path, monkeypatch, target, failure):
    def fail(*_):
        raise failure

    monkeypatch.setattr("mitsuba_irrcache.volumes.scene.scene_xml", fail)
    with pytest.raises(failure):
        write(tmp_path / target)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("target", ["out", "scene.xml"])
def test_failed_overwrite_keeps_the_earlier_result(tmp_path, monkeypatch, target):
    write(tmp_path / target)
    folder = tmp_path if target.endswith("xml") else tmp_path / target
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    real, calls = os.rename, []

    def fail_once(source, destination):
        calls.append(source)
        if len(calls) == 2:
            raise OSError("disk gone")
        real(source, destination)

    monkeypatch.setattr(os, "rename", fail_once)
    with pytest.raises(OSError, match="disk gone"):
        write(tmp_path / target, blob((7, 8, 9)), overwrite=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_empty_medium_is_refused(tmp_path):
    with pytest.raises(IrrcacheError, match="empty"):
        write(tmp_path / "out", VolumeData(np.zeros((3, 3, 3))))
    assert os.listdir(tmp_path) == []


def test_missing_parent_folder_is_named(tmp_path):
    for target in ("no/out", "no/scene.xml"):
        with pytest.raises(IrrcacheError, match="no does not exist"):
            write(tmp_path / target)


# The command


def test_import_of_an_image(tmp_path, capsys):
    image = SimpleITK.GetImageFromArray(np.linspace(-1000, 1500, 480).reshape(6, 8, 10))
    image.SetSpacing((1.0, 1.0, 2.0))
    SimpleITK.WriteImage(image, str(tmp_path / "ct.nrrd"))
    assert (
        importer.run(parse(tmp_path / "ct.nrrd", "--preset", "ct-bone", "-o", tmp_path / "o")) == 0
    )
    sigma_t, _ = read_vol(tmp_path / "o" / "sigma_t.vol")
    assert sigma_t.shape == (6, 8, 10, 1) and sigma_t[0].max() == 0 and sigma_t[-1].min() > 0
    output = capsys.readouterr().out
    assert "10 x 8 x 6 voxels" in output and "optical depth" in output


def test_import_of_raw_slices_with_every_step(tmp_path):
    for number in range(1, 11):
        values = np.full((8, 12), 100 * number, dtype=">u2")
        (tmp_path / f"head.{number}").write_bytes(b"hd" + values.tobytes())
    arguments = "--raw-shape 12,8,10 --raw-type uint16 --raw-endian big --raw-spacing 1,1,2"
    arguments += " --raw-offset 2 --flip z --crop :,2:8,0:5 --rescale 0.001,0 --clip 0:0.8"
    arguments += " --density 2 --albedo 0.5 --longest 6 --supersample 2 --max-depth -1"
    slices = sorted(str(path) for path in tmp_path.glob("head.*"))
    importer.run(parse(*slices, *arguments.split(), "-o", tmp_path / "out"))
    sigma_t, _ = read_vol(tmp_path / "out" / "sigma_t.vol")
    # 12 x 6 x 10 mm with voxels of 2 mm; flipped, the values fall from 1.0 (clipped) to 0.6.
    assert sigma_t.shape == (5, 3, 6, 1)
    means = sigma_t.mean(axis=(1, 2, 3))
    np.testing.assert_allclose(means[[0, -1]], [1.6, 1.225], atol=0.03)
    albedo, _ = read_vol(tmp_path / "out" / "albedo.vol")
    np.testing.assert_allclose(albedo, 0.5, rtol=1e-6)
    mi.load_file(str(tmp_path / "out" / "scene.xml"))


def test_import_of_a_density(tmp_path):
    write_vol(tmp_path / "cloud.vol", np.random.default_rng(0).uniform(0, 1, (4, 5, 6)))
    importer.run(parse(tmp_path / "cloud.vol", "--density", "30", "-o", tmp_path / "out"))
    density, _ = read_vol(tmp_path / "cloud.vol")
    sigma_t, _ = read_vol(tmp_path / "out" / "sigma_t.vol")
    np.testing.assert_allclose(sigma_t, 30 * density, rtol=1e-6)


def test_import_of_the_phantom(tmp_path):
    pytest.importorskip("mitsuba_irrcache.volumes.phantom")
    importer.run(parse("phantom:thorax:32,20,28", "--preset", "ct-chest", "-o", tmp_path / "out"))
    assert read_vol(tmp_path / "out" / "sigma_t.vol")[0].shape == (28, 20, 32, 1)


def test_import_of_the_cloud(tmp_path):
    pytest.importorskip("mitsuba_irrcache.volumes.phantom")
    arguments = ["--density", "12", "--albedo", "0.99", "-o", tmp_path / "out"]
    importer.run(parse("phantom:cloud:48,40,32", *arguments))
    sigma_t = read_vol(tmp_path / "out" / "sigma_t.vol")[0]
    assert sigma_t.shape == (32, 40, 48, 1) and 11 < sigma_t.max() <= 12
    scene = mi.load_file(str(tmp_path / "out" / "scene.xml"), width=16, height=16)
    image = np.array(mi.render(scene, spp=32, seed=1))
    # The cloud is in the middle; the corners show the sky.
    assert image[7:9, 7:9].mean() < 0.7
    np.testing.assert_allclose(image[[0, 0, -1, -1], [0, -1, 0, -1]], 1.0, atol=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["phantom:skull", "--preset", "ct-bone"], "'skull'.* phantom:thorax and phantom:cloud"),
        (["phantom:thorax:9", "--preset", "ct-bone"], "phantom size '9'"),
        (["phantom:cloud:9,9,9", "--density"], "at least 32"),
        (["missing.nrrd", "--preset", "ct-bone"], "does not exist"),
        (["a.vol", "--preset", "ct"], "no preset 'ct'"),
        (["a.vol", "--transfer-function", "no.json"], "no.json does not exist"),
        (["a.vol", "--preset", "ct-bone", "--albedo", "1"], "--albedo needs --density"),
        (["a.vol", "--density", "--albedo", "1.5"], "albedo"),
        (["a.vol", "--density", "--crop", "0:9,:,:"], "crop 0:9 along x"),
        (["a.vol", "--density", "--rescale", "2"], "SLOPE,INTERCEPT"),
        (["a.vol", "--density", "--longest", "0"], "longest"),
        (["a.vol", "--density", "--supersample", "0"], "supersample"),
    ],
)
def test_bad_requests_leave_nothing_behind(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    write_vol("a.vol", np.ones((3, 3, 3)))
    with pytest.raises(IrrcacheError, match=message):
        importer.run(parse(*arguments, "-o", "out"))
    assert os.listdir(tmp_path) == ["a.vol"]


def test_values_that_are_not_hounsfield_units_cause_a_warning(tmp_path, capsys):
    write_vol(tmp_path / "a.vol", np.linspace(0, 3000, 27).reshape(3, 3, 3))
    importer.run(parse(tmp_path / "a.vol", "--preset", "ct-bone", "-o", tmp_path / "out"))
    assert "--rescale 1,-1000" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["--density", "--preset", "ct-bone"],
        [],
        ["--density", "--crop", "1:2"],
        ["--density", "--clip", "3"],
        ["--density", "--flip", "w"],
        ["--density", "--raw-shape", "1,2"],
        ["--density", "--longest", "3", "--voxel-size", "1"],
        ["--density", "--isolate", "nan"],
    ],
)
def test_malformed_arguments_print_the_usage(arguments, capsys):
    with pytest.raises(SystemExit):
        parse("a.vol", "-o", "out", *arguments)
    assert "usage" in capsys.readouterr().err
