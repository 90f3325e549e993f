"""Files with several values per voxel: imported as colours as requested, otherwise refused with the
remedy.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.images import write_pixels
from mitsuba_irrcache.io.mitsuba_vol import read_vol, write_vol
from mitsuba_irrcache.io.scene_files import load_scene
from mitsuba_irrcache.view.appearance import Appearance
from mitsuba_irrcache.volumes import importer
from tests.support.volume_files import VTK_FILES

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE = (6, 8, 10)


def colours(channels: int = 3, seed: int = 0) -> np.ndarray:
    shape = (*SHAPE, channels)
    return np.random.default_rng(seed).uniform(0.1, 0.9, shape).astype(np.float32)


def imported(source: Path, *options: object, output: str = "out") -> Path:
    parser = argparse.ArgumentParser()
    importer.add_arguments(parser)
    target = source.parent / output
    given = [str(option) for option in options]
    assert importer.run(parser.parse_args([str(source), "-o", str(target), *given])) == 0
    return target


def saved(tmp_path: Path, values: np.ndarray) -> Path:
    np.save(tmp_path / "a.npy", values)
    return tmp_path / "a.npy"


def rendered(folder: Path, **parameters: object) -> np.ndarray:
    size = {"width": 16, "height": 16, "spp": 64}
    scene = mi.load_file(str(folder / "scene.xml"), **(size | parameters))
    return np.array(mi.render(scene, seed=1))


def luminance(rgb: np.ndarray) -> np.ndarray:
    return rgb @ np.float32([0.2126, 0.7152, 0.0722])


def test_albedo_of_a_density_in_the_fourth_channel(tmp_path):
    values = colours(4)
    folder = imported(saved(tmp_path, values), "--colour", "albedo", "--density", 3)
    np.testing.assert_allclose(read_vol(folder / "albedo.vol")[0], values[..., :3], rtol=1e-6)
    sigma_t = read_vol(folder / "sigma_t.vol")[0][..., 0]
    np.testing.assert_allclose(sigma_t, 3 * values[..., 3], rtol=1e-6)
    assert np.isfinite(rendered(folder)).all()


def test_albedo_of_a_density_that_is_the_luminance(tmp_path):
    values = colours()
    folder = imported(saved(tmp_path, values), "--colour", "albedo", "--density")
    np.testing.assert_allclose(read_vol(folder / "albedo.vol")[0], values, rtol=1e-6)
    sigma_t = read_vol(folder / "sigma_t.vol")[0][..., 0]
    np.testing.assert_allclose(sigma_t, luminance(values), rtol=1e-5)


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_integers_are_fractions_and_bytes_are_srgb(tmp_path, kind):
    top = np.iinfo(kind).max
    values = np.random.default_rng(1).integers(0, top + 1, (*SHAPE, 3)).astype(kind)
    folder = imported(saved(tmp_path, values), "--colour", "albedo", "--density", 0.01)
    expected = values / np.float64(top)
    if kind == "uint8":  # as Mitsuba reads images
        bitmap = mi.Bitmap(values.reshape(-1, SHAPE[2], 3), mi.Bitmap.PixelFormat.RGB)
        bitmap.set_srgb_gamma(True)
        linear = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
        expected = np.array(linear).reshape(values.shape)
    albedo = read_vol(folder / "albedo.vol")[0]
    np.testing.assert_allclose(albedo, expected, rtol=1e-4, atol=1e-6)


def test_extinction_in_rgb_is_that_of_three_grey_volumes(tmp_path):
    """The channels of an image in RGB are images of grey media with the extinctions of channels."""
    values = colours() * np.float32([0.2, 1.0, 4.0])
    options = ("--density", 0.5, "--albedo", "0.7", "--flip", "x", "--crop", "1:9,:,:")
    folder = imported(saved(tmp_path, values), "--colour", "extinction", *options)
    sigma_t = read_vol(folder / "sigma_t.vol")[0]
    np.testing.assert_allclose(sigma_t, 0.5 * values[:, :, ::-1][:, :, 1:9], rtol=1e-6)
    image = rendered(folder, integrator="irrcache", hide_emitters="true")
    for channel in range(3):
        grey = imported(tmp_path / "a.npy", "--channel", channel, *options, output=f"grey{channel}")
        # The camera frames the same voxels, none of which is empty.
        expected = rendered(grey, integrator="irrcache", hide_emitters="true")[..., channel]
        np.testing.assert_allclose(image[..., channel].mean(), expected.mean(), rtol=0.01)


def test_emission_is_rendered_by_irrcache(tmp_path):
    values = colours() * np.float32([3, 2, 1])
    folder = imported(
        saved(tmp_path, values), "--colour", "emission", "--density", 0.01, "--longest", 5
    )
    emission = read_vol(folder / "emission.vol")[0]
    assert emission.shape == (3, 4, 5, 3)
    np.testing.assert_allclose(emission.mean(axis=(0, 1, 2)), values.mean(axis=(0, 1, 2)), rtol=0.1)
    dark = rendered(folder, radiance=0, emission=0)
    once, twice = (rendered(folder, radiance=0, emission=scale) for scale in (1, 2))
    assert dark.max() < 1e-6 and once.max() > 1
    np.testing.assert_allclose(twice, 2 * once, rtol=0.02, atol=1e-3)


def test_emission_of_an_earlier_import_is_removed(tmp_path):
    source = saved(tmp_path, colours())
    imported(source, "--colour", "emission", "--density")
    folder = imported(source, "--colour", "albedo", "--density", "--overwrite")
    assert not (folder / "emission.vol").exists()


def test_every_reader_of_channels(tmp_path):
    """Vectors of VTK, Mitsuba's and ITK's images, TIFF and HDF5 have the same colours."""
    import SimpleITK

    values = colours()
    write_vol(tmp_path / "a.vol", values)
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(values, isVector=True), tmp_path / "a.nrrd")
    files = ["a.vol", "a.nrrd"]
    try:
        import tifffile

        tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb")
        files.append("a.tif")
    except ImportError:
        pass
    for number, file in enumerate(files):
        options = ("--colour", "albedo", "--density")
        folder = imported(tmp_path / file, *options, output=f"out{number}")
        np.testing.assert_allclose(read_vol(folder / "albedo.vol")[0], values, rtol=1e-6)
    (tmp_path / "a.vtk").write_bytes((VTK_FILES / "binary.vtk").read_bytes())
    options = ("--field", "vectors", "--colour", "extinction", "--density")
    folder = imported(tmp_path / "a.vtk", *options, output="vtk")
    ramp = np.arange(160).reshape(4, 5, 8)
    expected = np.stack([ramp, 2 * ramp, 3 * ramp], axis=-1)
    np.testing.assert_array_equal(read_vol(folder / "sigma_t.vol")[0], expected)


@pytest.mark.parametrize(
    ("channels", "options", "message"),
    [
        (3, "--density", "3 channels; .*--channel N.*--colour albedo, emission or extinction"),
        (4, "--density", "4 channels; .*--colour albedo or emission$"),
        (2, "--density", "2 channels; choose one with --channel N, from 0 to 1$"),
        (2, "--density --colour albedo", r"has 2 channel\(s\), but --colour albedo needs red"),
        (1, "--density --colour albedo", r"has 1 channel\(s\)"),
        (5, "--density --colour albedo", "more than 4 channel"),
        (4, "--density --colour extinction", r"has 4 channel\(s\), but --colour extinction"),
        (3, "--preset ct-bone --colour extinction", "needs --density"),
        (3, "--density --albedo 0.5 --colour albedo", "leave one of them out"),
        (3, "--density --channel 1 --colour albedo", "--channel exclude each other"),
        (3, "--density --isolate 1 --colour extinction", "does not support --isolate"),
    ],
)
def test_refusals_name_the_remedy(tmp_path, channels, options, message):
    source = saved(tmp_path, colours(channels))
    with pytest.raises(IrrcacheError, match=message):
        imported(source, *options.split())
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


def test_colours_out_of_range_are_refused(tmp_path):
    source = saved(tmp_path, 3 * colours())
    with pytest.raises(IrrcacheError, match=r"as albedo they must be between 0 and 1. Divide them"):
        imported(source, "--density", "--colour", "albedo")
    source = saved(tmp_path, -colours())
    with pytest.raises(IrrcacheError, match=r"densities are negative|at least 0"):
        imported(source, "--density", "--colour", "emission")


def test_channel_of_a_file_without_channels(tmp_path):
    source = saved(tmp_path, colours(1)[..., 0])
    with pytest.raises(IrrcacheError, match=r"has 1 channel\(s\), but --channel is 2"):
        imported(source, "--density", "--channel", 2)
    imported(source, "--density", "--channel", 0)


def test_colours_of_a_phantom_are_refused(tmp_path):
    with pytest.raises(IrrcacheError, match="phantom:cloud: --colour albedo needs a file with 3"):
        parser = argparse.ArgumentParser()
        importer.add_arguments(parser)
        options = ["--density", "--colour", "albedo", "-o", str(tmp_path / "out")]
        importer.run(parser.parse_args(["phantom:cloud", *options]))


def slices(folder: Path, values: np.ndarray) -> Path:
    folder.mkdir()
    for number, part in enumerate(values, 8):  # file names in which 10 would come before 8
        # OpenImageIO would divide the colours by alpha.
        mi.Bitmap(np.ascontiguousarray(part)).write(str(folder / f"s{number}.png"))
    return folder


def test_pictures_of_slices_in_colour(tmp_path):
    values = np.random.default_rng(3).integers(1, 256, (*SHAPE, 4)).astype(np.uint8)
    folder = slices(tmp_path / "slices", values)
    (folder / ".thumbnails").write_text("of a file manager")
    target = imported(folder, "--colour", "albedo", "--density", 0.1, "--spacing", "1,1,3")
    sigma_t = read_vol(target / "sigma_t.vol")[0][..., 0]
    np.testing.assert_allclose(sigma_t, 0.1 * values[..., 3], rtol=1e-6)
    np.save(tmp_path / "same.npy", values)
    same = imported(tmp_path / "same.npy", "--colour", "albedo", "--density", 0.1, output="same")
    albedo, expected = (read_vol(f / "albedo.vol")[0] for f in (target, same))
    np.testing.assert_array_equal(albedo, expected)


def test_grey_pictures_of_slices(tmp_path):
    values = np.random.default_rng(3).integers(1, 256, (*SHAPE, 1)).astype(np.uint8)
    target = imported(slices(tmp_path / "slices", values), "--density", 0.1)
    np.testing.assert_allclose(read_vol(target / "sigma_t.vol")[0], 0.1 * values, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "s9.png").rename(f / "s29.png"), r"between s8\.png and s10\.png"),
        (lambda f: write_pixels(f / "s9.png", np.ones((3, 3, 3), np.uint8)), r"s9\.png has shape"),
        (lambda f: [p.unlink() for p in f.glob("s[91]*")], "is one slice"),
    ],
)
def test_incomplete_pictures_are_refused(tmp_path, change, message):
    folder = slices(tmp_path / "slices", np.ones((*SHAPE, 3), np.uint8))
    change(folder)
    with pytest.raises(IrrcacheError, match=message):
        imported(folder, "--density", "--channel", 0)
    with pytest.raises(IrrcacheError, match=r"s8\.png is one slice; give a folder"):
        imported(folder / "s8.png", "--density", output="../out")


@pytest.mark.parametrize("use", ["albedo", "emission", "extinction"])
def test_what_the_viewer_reads_is_what_is_imported(tmp_path, use):
    """Extinction, albedo and emission, with steps of processing."""
    channels = 3 if use == "extinction" else 4
    source = saved(tmp_path, colours(channels))
    options = ["--colour", use, "--density", "2", "--flip", "x", "--crop", "1:9,:,:"]
    folder = imported(source, *options)
    parser = argparse.ArgumentParser()
    importer.add_input(parser)
    importer.add_options(parser)
    volume, mapping, found = importer.read(parser.parse_args([str(source), *options]))
    grids = Appearance(volume, mapping, colours=found).grids(mapping)
    assert (folder / "emission.vol").exists() == ("emission.vol" in grids)
    for name, values in grids.items():
        read = read_vol(folder / name)[0]
        values = values.reshape(*values.shape[:3], -1)
        expected = np.broadcast_to(read, values.shape)  # grey albedo has one channel
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-6)


def test_another_integrator_inherits_the_emission(tmp_path):
    """It belongs to the scene; volpath has none."""
    folder = imported(saved(tmp_path, colours()), "--colour", "emission", "--density", 0.01)
    parameters = {"width": "8", "height": "8", "spp": "4", "radiance": "0"}
    images = [
        np.array(mi.render(load_scene(folder / "scene.xml", parameters, name), seed=1)).mean()
        for name in (None, "irrcache{step=0.9}", "irrcache{emission_scale=3}", "volpath")
    ]
    assert images[0] > 0.1
    np.testing.assert_allclose(images[1:], [images[0], 3 * images[0], 0], rtol=0.02)
