"""Images of media whose extinction stays in a file are those of the same media in memory."""

from __future__ import annotations

import gc
import os
from contextlib import contextmanager
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.out_of_core import (
    irradiance_file,
    rendering,
    scattering,
    slab_march,
    slab_sweep,
)
from mitsuba_irrcache.out_of_core.brick_file import BrickFile
from mitsuba_irrcache.out_of_core.volume_files import VolumeFile
from mitsuba_irrcache.out_of_core.volume_settings import parse_memory
from tests.support.scenes import SUN, boundary, image, load, medium, placement, texture

SHAPE, PLACE = (45, 42, 48), placement()
INTEGRATOR = {"type": "irrcache", "solver": "sweep", "max_depth": 2, "cache_spp": 32}


@pytest.fixture
def density(rgb, tmp_path, monkeypatch):
    """A noisy volume; thin slabs, so that there are many of both kinds."""
    monkeypatch.setattr(slab_sweep, "MOST_SLICES", 6)
    monkeypatch.setattr(slab_march, "MOST_SLICES", 8)
    values = texture(SHAPE, 0.1, 1.0, 3)
    np.save(tmp_path / "density.npy", values)
    return values


def from_the_side() -> dict:
    """A sensor some of whose rays run upwards along z, and some downwards."""
    look = mi.ScalarTransform4f().look_at([5.0, 0.3, 0.2], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 24, "height": 24, "component_format": "float32"}
    return {"type": "perspective", "fov": 34.0, "to_world": look, "film": film}


def scene_of(tmp_path, interior: dict, **objects) -> mi.Scene:
    """A scene whose medium takes its extinction from the file."""
    files = {"sigma_t_file": str(tmp_path / "density.npy"), "max_memory": "1GB"}
    return load(INTEGRATOR | files | objects.pop("files", {}), boundary(interior, PLACE), **objects)


def test_an_image_is_the_same_to_the_last_bit_under_a_sun(density, tmp_path):
    albedo = texture(SHAPE, 0.3, 1.0, 4)
    np.save(tmp_path / "albedo.npy", albedo)
    objects = {"emitter": SUN, "sensor": from_the_side()}
    whole = load(INTEGRATOR, boundary(medium(density, albedo, PLACE), PLACE), **objects)
    coarse = medium(density[:2, :2, :2], 0.5, PLACE)
    files = {"albedo_file": str(tmp_path / "albedo.npy")}
    parts = scene_of(tmp_path, coarse, files=files, **objects)
    np.testing.assert_array_equal(image(parts, spp=2), image(whole, spp=2))


def test_an_image_differs_by_rounding_alone_under_a_coloured_sky(density, tmp_path):
    whole = load(INTEGRATOR, boundary(medium(0.5 * density, 0.9, PLACE), PLACE))
    # A constant extinction in the scene is the factor of the values in the file.
    parts = scene_of(tmp_path, medium(0.5, 0.9, PLACE))
    np.testing.assert_allclose(image(parts, spp=2), image(whole, spp=2), rtol=1e-4)


def test_the_irradiance_is_written_to_a_file(density, tmp_path):
    whole = load(INTEGRATOR, boundary(medium(density, 0.9, PLACE), PLACE))
    whole.integrator().prepare(whole)
    file = tmp_path / "irradiance.npy"
    parts = scene_of(
        tmp_path, medium(density[:2, :2, :2], 0.9, PLACE), files={"irradiance_file": str(file)}
    )
    parts.integrator().prepare(parts)
    expected = np.array(whole.integrator().cache.irradiance)
    np.testing.assert_allclose(np.load(file), expected, rtol=1e-5)


@pytest.mark.parametrize("name", ["density.npy", "albedo.npy"])
@pytest.mark.parametrize("when", ["uncollided", "scattered"])
def test_no_irradiance_is_a_mixture_of_two_volumes(density, tmp_path, monkeypatch, name, when):
    """Where a file is written to while the irradiance is computed, nothing comes of it."""
    np.save(tmp_path / "albedo.npy", texture(SHAPE, 0.3, 1.0, 4))
    file = tmp_path / "irradiance.npy"
    files = {"albedo_file": str(tmp_path / "albedo.npy"), "irradiance_file": str(file)}
    scene = scene_of(
        tmp_path, medium(2.0, 0.9, PLACE), files=files | {"max_depth": -1}, emitter=SUN
    )
    compute = getattr(slab_sweep.SlabSweep, when)

    def and_change(*arguments):
        found = compute(*arguments)
        np.save(tmp_path / name, np.load(tmp_path / name)[::-1])
        return found

    with monkeypatch.context() as changing:
        changing.setattr(slab_sweep.SlabSweep, when, and_change)
        with pytest.raises(RuntimeError, match=f"{name}.* was changed while it was in use"):
            image(scene, spp=1)
    assert not file.exists()
    expected = image(scene_of(tmp_path, medium(2.0, 0.9, PLACE), files=files | {
        "max_depth": -1, "irradiance_file": "",
    }, emitter=SUN), spp=1)  # fmt: skip
    np.testing.assert_array_equal(image(scene, spp=1), expected)


def test_no_image_is_a_mixture_of_two_volumes(density, tmp_path, monkeypatch):
    scene = scene_of(tmp_path, medium(2.0, 0.9, PLACE), sensor=from_the_side())
    scene.integrator().prepare(scene)
    enter = slab_march._SlabLookups.enter

    def and_change(lookups, slab) -> None:
        enter(lookups, slab)
        np.save(tmp_path / "density.npy", density[::-1])

    with monkeypatch.context() as changing:
        changing.setattr(slab_march._SlabLookups, "enter", and_change)
        with pytest.raises(RuntimeError, match=r"density\.npy.* was changed while it was in use"):
            image(scene, spp=1)
    again = scene_of(tmp_path, medium(2.0, 0.9, PLACE), sensor=from_the_side())
    np.testing.assert_array_equal(image(scene, spp=1), image(again, spp=1))


@pytest.mark.parametrize("kind", [".npy", "_4x3x2_uint8.raw", ".zarr"])
@pytest.mark.parametrize("change", ["written", "replaced", "removed"])
def test_a_changed_file_is_not_read_on(tmp_path, kind, change):
    path, dtype = tmp_path / f"volume{kind}", np.uint8 if kind.endswith("raw") else np.float32

    def write(where: Path) -> None:
        if kind == ".zarr":
            zarr = pytest.importorskip("zarr")
            zarr.open(str(where), mode="w", shape=(2, 3, 4), chunks=(1, 3, 4), dtype="f4")[:] = 1
        elif kind == ".npy":
            np.save(where, np.ones((2, 3, 4), dtype))
        else:
            np.ones((2, 3, 4), dtype).tofile(where)

    write(path)
    file = VolumeFile(path)
    values = file.read(0, 2)
    assert values.flags.owndata and (values == 1).all()  # what is read later, is not read here
    file.require_unchanged()
    if change == "written":
        write(path)
    else:
        path.rename(tmp_path / "before")
        if change == "replaced":
            write(path)
    with pytest.raises(IrrcacheError, match="was changed while it was in use; when it is complete"):
        file.require_unchanged()
    with pytest.raises(IrrcacheError, match=r"was changed|cannot be|no complete"):
        file._next_check = 0.0
        file.read(0, 2)


@pytest.mark.parametrize("name", ["density.npy", "other.npy", "notes.npy"])
def test_files_that_are_no_irradiance_are_not_replaced(density, tmp_path, name):
    """The volume itself, another array, or a file of another kind."""
    file = tmp_path / name
    if name == "notes.npy":
        file.write_text("precious")
    elif name == "other.npy":
        np.save(file, np.arange(5))
    before = file.read_bytes()
    scene = scene_of(tmp_path, medium(1.0, 0.9, PLACE), files={"irradiance_file": str(file)})
    with pytest.raises(RuntimeError, match="is not replaced"):
        image(scene, spp=1)
    assert file.read_bytes() == before


@pytest.mark.parametrize("sky", [[0.5, 0.5, 0.5], [0.2, 0.5, 0.9]])
def test_an_irradiance_file_of_the_same_inputs_is_read(density, tmp_path, monkeypatch, sky):
    file = tmp_path / "irradiance.npy"

    def rendered(scale: float = 2.0) -> np.ndarray:
        emitter = {"type": "constant", "radiance": {"type": "rgb", "value": sky}}
        files = {"irradiance_file": str(file)}
        interior = medium(scale, 0.9, PLACE)
        return image(scene_of(tmp_path, interior, files=files, emitter=emitter), spp=2)

    computed, written = rendered(), file.stat()
    np.testing.assert_array_equal(rendered(), computed)
    assert file.stat().st_mtime_ns == written.st_mtime_ns
    # Another medium, a file that somebody has written to, and another volume: written later, or of
    # the same size and time, as one of an archive may be.
    assert np.abs(rendered(3.0) - computed).max() > 0.01
    np.testing.assert_array_equal(rendered(), computed)
    np.save(file, np.load(file) * 2)
    np.testing.assert_array_equal(rendered(), computed)
    volume = tmp_path / "density.npy"
    past = volume.stat().st_mtime_ns
    np.save(volume, density[::-1])
    later = rendered()
    assert np.abs(later - computed).max() > 0.01
    np.save(volume, density)
    os.utime(volume, ns=(past, past))
    np.testing.assert_array_equal(rendered(), computed)
    np.save(volume, density[::-1])
    os.utime(volume, ns=(past, past))
    np.testing.assert_array_equal(rendered(), later)


def test_a_reader_shows_its_own_irradiance_after_the_file_was_replaced(density, tmp_path):
    file = tmp_path / "irradiance.npy"

    def scene(scale: float) -> mi.Scene:
        files = {"irradiance_file": str(file)}
        return scene_of(tmp_path, medium(scale, 0.9, PLACE), files=files)

    expected, reader = image(scene(2.0), spp=1), scene(2.0)
    np.testing.assert_array_equal(image(reader, spp=1), expected)
    assert np.abs(image(scene(3.0), spp=1) - expected).max() > 0.01  # replaces the file
    np.testing.assert_array_equal(image(reader, spp=1), expected)


def test_a_file_that_is_overwritten_while_it_is_read_is_named(tmp_path):
    path = tmp_path / "light.npy"
    working = BrickFile.without_name(tmp_path / "working", (4, 3, 2), np.float32)
    irradiance_file.write(path, working, np.ones(3), "mine")
    found = irradiance_file.recorded(path, "mine")
    assert (found.read((0, 0, 0), (4, 3, 2)) == 0).all()
    with path.open("r+b") as file:
        file.seek(-4, os.SEEK_END)
        file.write(b"1234")
    os.utime(path, ns=(0, 0))
    with pytest.raises(IrrcacheError, match=rf'irradiance_file "{path}" was changed'):
        found.read((0, 0, 0), (4, 3, 2))


def test_a_missing_folder_is_named_before_anything_is_computed(density, tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "MappedField", lambda *_: pytest.fail("the volume is read"))
    file = tmp_path / "missing" / "light.npy"
    scene = scene_of(tmp_path, medium(1.0, 0.9, PLACE), files={"irradiance_file": str(file)})
    with pytest.raises(RuntimeError, match=rf'irradiance_file "{file}": the folder .* not exist'):
        image(scene, spp=1)


def test_a_record_is_that_of_the_file_that_was_written_with_it(tmp_path, monkeypatch):
    """Another process, of other inputs, writes the same file in between."""

    def brick_file(value: float) -> BrickFile:
        file = BrickFile.without_name(tmp_path / "working", (40, 3, 2), np.float32)
        file.write((0, 0, 0), np.full((40, 3, 2), value, np.float32))
        return file

    path, colour, atomic_write = tmp_path / "light.npy", np.ones(3), irradiance_file.atomic_write

    @contextmanager
    def disturbed(file):
        with atomic_write(file) as opened:
            yield opened
        monkeypatch.setattr(irradiance_file, "atomic_write", atomic_write)
        irradiance_file.write(path, brick_file(2.0), colour, "theirs")
        Path(f"{path}.json").unlink()

    monkeypatch.setattr(irradiance_file, "atomic_write", disturbed)
    irradiance_file.write(path, brick_file(1.0), colour, "mine")
    assert np.load(path).shape == (40, 3, 2, 3) and (np.load(path) == 2).all()
    assert irradiance_file.recorded(path, "mine") is None
    irradiance_file.write(path, brick_file(1.0), colour, "mine")
    found = irradiance_file.recorded(path, "mine")
    assert (found.read((30, 1, 0), (40, 2, 2)) == 1).all() and found.channels == 1
    assert irradiance_file.recorded(path, "theirs") is None


def test_all_orders_of_a_white_furnace_are_white(density, tmp_path, monkeypatch):
    monkeypatch.setattr(scattering, "COARSE", 24)
    file = tmp_path / "irradiance.npy"
    files = {"irradiance_file": str(file), "max_depth": -1, "cache_spp": 32}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    scene = scene_of(tmp_path, medium(8.0, 1.0, PLACE), files=files, emitter=sky)
    scene.integrator().prepare(scene)
    error = np.abs(np.load(file) / (4 * np.pi) - 1)
    assert error.mean() < 0.004 and error.max() < 0.025


def test_all_orders_are_those_of_a_solution_in_memory(density, tmp_path, monkeypatch):
    monkeypatch.setattr(scattering, "COARSE", 24)
    albedo = texture(SHAPE, 0.5, 1.0, 4)
    np.save(tmp_path / "albedo.npy", albedo)
    orders = {"max_depth": -1, "cache_spp": 32}
    whole = load(INTEGRATOR | orders, boundary(medium(4 * density, albedo, PLACE), PLACE))
    files = {"albedo_file": str(tmp_path / "albedo.npy"), **orders}
    parts = scene_of(tmp_path, medium(4.0, 0.5, PLACE), files=files)
    expected, found = image(whole, spp=2), image(parts, spp=2)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.01 * expected.mean()


def test_a_run_that_is_stopped_says_that_there_is_no_image(density, tmp_path):
    scene = scene_of(tmp_path, medium(2.0, 0.9, PLACE), files={"timeout": 1e-6})
    with pytest.raises(RuntimeError, match="raise timeout"):
        image(scene, spp=1)


def test_an_edited_scene_is_rendered_anew(density, tmp_path):
    scene = scene_of(tmp_path, medium(2.0, 0.9, PLACE), emitter=SUN)
    before = image(scene, spp=1)
    np.testing.assert_array_equal(image(scene, spp=1), before)
    params = mi.traverse(scene)
    (key,) = [key for key in params.keys() if "irradiance" in key]
    params[key] = 2 * params[key]
    params.update()
    np.testing.assert_allclose(image(scene, spp=1), 2 * before, rtol=1e-4)


@pytest.mark.parametrize("kind", ["npy", "zarr"])
def test_an_overwritten_file_is_rendered_anew(density, tmp_path, kind):
    file = str(tmp_path / f"volume.{kind}")

    def write(values: np.ndarray) -> None:
        if kind == "npy":
            np.save(file, values)
            return
        zarr = pytest.importorskip("zarr")
        zarr.open(file, mode="a", shape=SHAPE, dtype="f4", chunks=(32, 32, 32))[:] = values

    write(density)
    scene = scene_of(tmp_path, medium(2.0, 0.9, PLACE), files={"sigma_t_file": file})
    before = image(scene, spp=1)
    write(density[::-1])
    after = image(scene, spp=1)
    np.testing.assert_array_equal(
        after,
        image(scene_of(tmp_path, medium(2.0, 0.9, PLACE), files={"sigma_t_file": file}), spp=1),
    )
    assert np.abs(after - before).max() > 0.01


@pytest.mark.parametrize(
    ("interior", "objects", "named"),
    [
        ({}, {"emitter": {"type": "point", "position": [0, 3, 0]}}, "PointLight"),
        ({"phase": {"type": "hg", "g": 0.3}}, {}, "isotropically"),
        ({}, {"wall": {"type": "rectangle"}}, "surfaces"),
        ({}, {"files": {"max_depth": 3}}, "max_depth"),
        ({}, {"files": {"aovs": "depth"}}, "aovs"),
        ({}, {"files": {"sigma_t_file": ""}}, "sigma_t_file"),
        ({}, {"files": {"sigma_t_file": "none.npy"}}, "none.npy"),
        ({}, {"files": {"max_memory": "much"}}, "much"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(density, tmp_path, interior, objects, named):
    with pytest.raises((IrrcacheError, RuntimeError), match=named):
        image(scene_of(tmp_path, medium(1.0, 0.9, PLACE) | interior, **objects), spp=1)


def test_a_grid_that_is_turned_in_its_box_is_refused(density, tmp_path):
    """Both have the same extent along the axes."""
    turned = np.array([[1, 0, -1, 0], [0, 1, 0, -0.5], [1, 0, 1, -1], [0, 0, 0, 1.0]])
    upright = np.diag([2.0, 1.0, 2.0, 1.0])
    upright[:3, 3] = -1, -0.5, -1
    coarse = np.ones((4, 4, 4), dtype=np.float32)
    files = {"sigma_t_file": str(tmp_path / "density.npy"), "max_memory": "1GB"}
    for grid, box in ((turned, upright), (upright, turned)):
        scene = load(INTEGRATOR | files, boundary(medium(coarse, 0.9, grid), box))
        with pytest.raises(RuntimeError, match="is not its box"):
            image(scene, spp=1)


def test_invalid_values_are_refused_with_their_place(density, tmp_path):
    density[30, 20, 10] = np.nan
    np.save(tmp_path / "density.npy", density)
    with pytest.raises(RuntimeError, match=r"\(30, 20, 10\): nan"):
        image(scene_of(tmp_path, medium(1.0, 0.9, PLACE)), spp=1)


def test_files_of_all_formats_hold_the_same_values(tmp_path):
    values = np.random.default_rng(5).integers(0, 1000, (7, 6, 5)).astype(np.uint16)
    np.save(tmp_path / "a.npy", values)
    values.tofile(tmp_path / "a_5x6x7_uint16.raw")
    paths = [tmp_path / "a.npy", tmp_path / "a_5x6x7_uint16.raw"]
    try:
        import zarr
    except ModuleNotFoundError:  # not for Python 3.10
        pass
    else:
        zarr.create_array(str(tmp_path / "a.zarr"), data=values, chunks=(4, 4, 4))
        paths.append(tmp_path / "a.zarr")
    for path in paths:
        file = VolumeFile(path)
        assert file.shape == values.shape
        np.testing.assert_array_equal(file.read(2, 5), values[2:5].astype(np.float32))


def test_damaged_files_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 4, 4)))
    (tmp_path / "b.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:200])
    np.save(tmp_path / "c.npy", np.zeros((4, 4)))
    (tmp_path / "d_4x4x4_uint8.raw").write_bytes(b"1234")
    (tmp_path / "e.raw").write_bytes(b"1234")
    for name in ("b.npy", "c.npy", "d_4x4x4_uint8.raw", "e.raw", "f.npy"):
        with pytest.raises(IrrcacheError, match=name):
            VolumeFile(tmp_path / name)


def test_sizes_of_memory():
    sizes = {"": 0, "8GB": 8 << 30, "500 MB": 500 << 20, "1.5GiB": 3 << 29, "1000000": 1000000}
    assert {text: parse_memory(text) for text in sizes} == sizes


def test_working_files_disappear_with_the_integrator(density, tmp_path):
    """They have no name, so that the system counts them until they are closed."""
    descriptors = Path("/proc/self/fd")
    if not descriptors.is_dir():
        pytest.skip("open files are listed in /proc only")

    def working_files() -> list[str]:
        names = [os.readlink(file) for file in descriptors.iterdir() if file.is_symlink()]
        return [name for name in names if name.startswith(str(tmp_path / ".irrcache-"))]

    scene = scene_of(tmp_path, medium(2.0, 0.9, PLACE))
    image(scene, spp=1)
    assert working_files()
    del scene
    gc.collect()
    assert not working_files()
    assert not list(tmp_path.glob(".irrcache-*"))


@pytest.mark.parametrize("codec", ["BloscCodec", "GzipCodec"])
@pytest.mark.parametrize("damage", ["metadata", "cut", "cut by one byte"])
def test_damaged_zarr_arrays_are_refused_by_name(tmp_path, codec, damage):
    zarr = pytest.importorskip("zarr")
    path = tmp_path / "volume.zarr"
    values = texture((8, 8, 8), 0.1, 1.0, 3)
    codec = getattr(zarr.codecs, codec)()
    zarr.create_array(str(path), data=values, chunks=(4, 8, 8), compressors=codec)
    file = path / "zarr.json" if damage == "metadata" else path / "c" / "1" / "0" / "0"
    content = file.read_bytes()
    file.write_bytes(content[:-1] if damage == "cut by one byte" else content[: len(content) // 2])
    with pytest.raises(IrrcacheError, match=r"volume\.zarr"):
        VolumeFile(path).read(0, 8)
