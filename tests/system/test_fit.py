"""Volumes from images: by the library, and by ``irrcache fit``."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.gradients.cases import POINT, SKY, SUN, Case
from experiments.validation.gradients.differences import first_key
from mitsuba_irrcache.cli.fit import _image_files, _pixels
from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.fit import _roughness, fit
from mitsuba_irrcache.gradients.fit_state import Result, Settings, View
from mitsuba_irrcache.io.mitsuba_vol import read_vol, write_vol
from tests.support.scene_xml import FOG_IN_A_BOX
from tests.support.slow import with_slow

CASE = Case(data=8, cache=8, depth=0.5)
ORIGINS = ([5.0, 1.0, 0.0], [0.0, 2.0, 5.0], [-4.0, 1.0, -3.0], [1.0, -4.0, 3.0])


def sensors(size: int = 16, pixels: str = "rgb") -> list[mi.Sensor]:
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": pixels}
    film["rfilter"] = {"type": "box"}
    found = []
    for origin in ORIGINS:
        look = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])
        sensor = {"type": "perspective", "fov": 32.0, "to_world": look, "film": film}
        found.append(mi.load_dict(sensor))
    return found


def views(case: Case = CASE) -> list[View]:
    scene = case.load()
    return [View(s, np.array(mi.render(scene, sensor=s, spp=64))) for s in sensors()]


def started(case: Case = CASE, **start: float) -> mi.Scene:
    """The scene with constant grids of these values."""
    scene = case.load()
    params = mi.traverse(scene)
    for name, value in start.items():
        (key,) = [k for k in params.keys() if f".{name}.data" in k]
        params[key] = mi.TensorXf(np.full(params[key].shape, value, np.float32))
    params.update()
    return scene


# `test_the_command_fits_and_continues` has adam.
@pytest.mark.parametrize(
    ("method", "steps"), with_slow([("adam", 40), ("lbfgs", 12)], ("adam", 40))
)
def test_a_fit_explains_views_that_it_does_not_see(mono, method, steps):
    if method == "lbfgs":
        pytest.importorskip("scipy")
    seen, settings = views(), Settings(steps=steps, method=method, smoothness=0.0)
    calls, scene = [], started(sigma_t=0.2)
    result = fit(
        scene, seen[:3], ["sigma_t"], settings, seen[3:],
        report=lambda result: calls.append(result.step), every=1,
    )  # fmt: skip
    assert calls == [*range(1, steps + 1)]
    losses, errors = np.array(result.history)[:, 1:].T
    assert losses[-1] < 0.02 * losses[0]
    assert errors[-1] < 0.5 * errors[0]
    assert (result.values["sigma_t"] >= 0).all()
    # The scene has the values that are returned.
    found = mi.traverse(scene)[first_key(mi.traverse(scene), "sigma_t")]
    np.testing.assert_array_equal(np.array(found), result.values["sigma_t"])


def test_a_fit_by_another_integrator_that_has_gradients(mono):
    """The same optimiser, for comparisons."""
    seen, scene = views(), CASE.load(type="prbvolpath", max_depth=-1)
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if ".albedo.data" in k]
    params[key] = mi.TensorXf(np.full(params[key].shape, 0.3, np.float32))
    params.update()
    result = fit(scene, seen[:2], ["albedo"], Settings(steps=8, method="adam", spp=16))
    dense = CASE.sigma_t() > 0.5 * CASE.sigma_t().max()
    assert result.values["albedo"][dense].mean() > 0.6  # the truth is 0.85 to 0.93


# `test_gradients` finds a density from nothing, and the test before this one an albedo.
@pytest.mark.slow
def test_a_fit_may_start_without_matter_and_find_the_albedo_too(rgb):
    case = replace(CASE, albedo=(0.5, 0.7, 0.9), data=4)
    seen, scene = views(case), started(case, sigma_t=0.0, albedo=0.6)
    names = ["sigma_t", "albedo"]
    result = fit(scene, seen[:3], names, Settings(steps=30), seen[3:])
    assert result.history[-1][2] < 0.05
    albedo = result.values["albedo"]
    assert (albedo >= 0).all() and (albedo <= 1).all()
    centre = albedo[1:3, 1:3, 1:3].mean(axis=(0, 1, 2))
    assert centre[0] < centre[1] < centre[2]


# Gradients of such media are compared with differences in `test_gradients`.
@pytest.mark.slow
def test_a_fit_of_a_medium_that_scatters_forwards(mono):
    case = replace(CASE, data=6, g=0.7, emitters=lambda: {"sun": SUN})
    seen, settings = views(case), Settings(steps=10)
    scene = started(case, sigma_t=0.2)
    result = fit(scene, seen[:3], ["sigma_t"], settings, seen[3:], every=1)
    losses, errors = np.array(result.history)[:, 1:].T
    assert losses[-1] < 0.1 * losses[0]
    assert errors[-1] < 0.5 * errors[0]


# Parameters other than grids: a few numbers, with small images


def fitted(case: Case, key: str, truth: object, settings: Settings, **properties) -> np.ndarray:
    """Fit a parameter to small images of the scene with the ``truth``."""
    scene = case.load(**properties)
    params = mi.traverse(scene)
    start = type(params[key])(params[key])
    params[key] = type(params[key])(truth)
    params.update()
    seen = [View(s, np.array(mi.render(scene, sensor=s, spp=64))) for s in sensors(8)]
    params[key] = start
    params.update()
    return fit(scene, seen, [key], settings).values[key].ravel()


def test_a_position_is_found_across_0(mono):
    """The first step must not carry the light into the medium, either."""
    pytest.importorskip("scipy")
    point = {**POINT, "position": [0.3, 2.5, 0.2]}
    case = replace(CASE, data=6, cache=6, emitters=lambda: {"point": point})
    truth, settings = [-0.4, 2.2, -0.3], Settings(steps=9)
    found = fitted(case, "point.position", truth, settings, cache_spp=16)
    assert np.abs(found - truth).max() < 0.2


def test_backward_scattering_is_found(mono):
    """From isotropic scattering, of which irrcache has no gradient."""
    pytest.importorskip("scipy")
    case = replace(CASE, data=6, cache=6, g=0.0, emitters=lambda: {"sun": SUN})
    key, settings = "shape.interior_medium.phase_function.g", Settings(steps=2)
    found = fitted(case, key, -0.3, settings, cache_spp=16)
    assert found[0] == pytest.approx(-0.3, abs=0.1)


def test_reflectances_stay_below_1(mono):
    """Images that are brighter than any floor."""
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    case = replace(CASE, data=4, depth=0.1, objects=lambda: {"floor": floor})
    key, settings = "floor.bsdf.reflectance.value", Settings(steps=3)
    found = fitted(case, key, 1.5, settings, type="prbvolpath", max_depth=2)
    assert found[0] == 1


def test_a_fit_continues_where_it_stopped(mono, tmp_path):
    """The same bits as without a stop, with views in turn and the grid of the cache chosen once."""
    case = replace(CASE, data=6)
    seen, settings = views(case), Settings(steps=4, method="adam", views=2)

    def scene() -> mi.Scene:
        scene = case.load(type="irrcache", solver="sweep", resolution=0)
        values = mi.traverse(scene)
        (key,) = [k for k in values.keys() if ".sigma_t.data" in k]
        values[key] = mi.TensorXf(np.full(values[key].shape, 0.2, np.float32))
        values.update()
        return scene

    whole = fit(scene(), seen, ["sigma_t"], settings)
    file = tmp_path / "fit.npz"

    class StopError(Exception):
        pass

    def stop(result: Result) -> None:
        if result.step == 2:
            result.save(file, settings)
            raise StopError

    with pytest.raises(StopError):
        fit(scene(), seen, ["sigma_t"], settings, report=stop)
    rest = fit(scene(), seen, ["sigma_t"], settings, start=Result.load(file, settings))
    assert rest.values["sigma_t"].tobytes() == whole.values["sigma_t"].tobytes()
    assert [h[:2] for h in rest.history] == [h[:2] for h in whole.history]
    with pytest.raises(IrrcacheError, match=r"was made with \{'seed': 0\}"):
        Result.load(file, replace(settings, seed=1))


def test_smoothness_is_differentiated():
    rng = np.random.default_rng(1)
    values, step = rng.random((3, 4, 5, 2)), rng.random((3, 4, 5, 2))
    _, gradient = _roughness(values)
    above, below = (_roughness(values + s * 1e-4 * step)[0] for s in (1, -1))
    assert (gradient * step).sum() == pytest.approx((above - below) / 2e-4, rel=1e-6)
    assert _roughness(np.ones((3, 3, 3, 1)))[0] == 0


def test_smooth_volumes_are_preferred(mono):
    seen, found = views(), []
    for smoothness in (0.0, 0.01):
        settings = Settings(steps=5, smoothness=smoothness)
        values = fit(started(sigma_t=0.2), seen[:1], ["sigma_t"], settings).values
        found.append(_roughness(values["sigma_t"])[0])
    assert found[1] < 0.7 * found[0]


# Channels


@pytest.mark.parametrize(
    ("film", "image"),
    [("luminance", "rgb"), ("rgb", "luminance"), ("rgba", "luminance_alpha"), ("rgb", "rgba")],
)
def test_colours_are_compared_where_both_have_them(rgb, film, image):
    """And luminances otherwise: the images of the truth have no loss."""
    case = replace(CASE, data=4, cache=4, albedo=(0.5, 0.7, 0.9), emitters=lambda: {"sky": SKY})
    scene = case.load(cache_spp=16)

    def loss(factor: float) -> float:
        seen = []
        for own, other in zip(sensors(8, film), sensors(8, image), strict=True):
            pixels = np.array(mi.render(scene, sensor=other, spp=4, seed=0))
            seen.append(View(own, pixels * np.float32(factor)))
        settings = Settings(steps=1, method="adam", smoothness=0.0)
        return fit(case.load(cache_spp=16), seen[:1], ["sigma_t"], settings).history[0][1]

    assert loss(1.0) < 1e-4 * loss(1.5)


# What is refused


def test_wrong_arguments_are_named(mono):
    scene, (view, *_) = CASE.load(), views()
    image = np.array(view.image)

    def refused(*arguments, **settings) -> str:
        with pytest.raises(IrrcacheError) as error:
            fit(scene, *arguments, Settings(**settings))
        return str(error.value)

    assert '"density" must be a key' in refused([view], ["density"])
    assert "at least one view" in refused([], ["sigma_t"])
    small = View(view.sensor, image[:8])
    assert "an image has shape (8, 16, 1), but the film of its sensor is 16 x 16" in refused(
        [small], ["albedo"]
    )
    more = View(view.sensor, np.ones((16, 16, 5)), 'image "5.exr"')
    assert 'image "5.exr" has 5 channel(s), but the film of its sensor has 1' in refused(
        [more], ["sigma_t"]
    )
    bad = View(view.sensor, np.where(image > 0.5, np.nan, image))
    assert "NaN or infinite" in refused([bad], ["sigma_t"])
    assert "method is" in refused([view], ["sigma_t"], method="newton")
    assert "lbfgs takes all views" in refused([view], ["sigma_t"], views=1)
    assert "steps is 0" in refused([view], ["sigma_t"], steps=0)
    assert "rate must be above 0" in refused([view], ["sigma_t"], rate=0.0)
    scene = CASE.load(type="volpath")
    assert "integrator is VolumetricPathIntegrator" in refused([view], ["sigma_t"])


def test_films_of_other_colours_are_refused(rgb):
    view = View(sensors(8, "xyz")[0], np.ones((8, 8, 3)))
    with pytest.raises(IrrcacheError, match="pixel_format is xyz or xyza, but images are RGB"):
        fit(replace(CASE, data=4).load(), [view], ["sigma_t"])


def test_parameters_without_gradients_are_refused_by_name(rgb):
    scene, seen = CASE.load(max_depth=4), views()
    with pytest.raises(IrrcacheError, match=r"sigma_t\.data.*max_depth is 4"):
        fit(scene, seen, ["sigma_t"], Settings(steps=1))


# The command

XML = """<scene version="3.0.0">
    <default name="density" value="start.vol"/>
    <integrator type="volpath"/>
    {sensors}
    FOG
    <emitter type="constant"/>
</scene>
""".replace("FOG", FOG_IN_A_BOX)
SENSOR = """<sensor type="perspective">
    <transform name="to_world"> <lookat origin="{}, {}, {}" target="0,0,0" up="0,1,0"/> </transform>
    <film type="hdrfilm"> <integer name="width" value="12"/> <integer name="height" value="12"/>
        <rfilter type="box"/> </film>
</sensor>"""


@pytest.fixture
def folder(rgb, tmp_path, monkeypatch):
    """A scene file, a start, the truth, and images of it."""
    sensors = "\n".join(SENSOR.format(*origin) for origin in ORIGINS)
    (tmp_path / "scene.xml").write_text(XML.format(sensors=sensors))
    truth = Case(data=6, cache=6, depth=0.5).sigma_t()
    write_vol(tmp_path / "truth.vol", truth)
    write_vol(tmp_path / "start.vol", np.full_like(truth, 0.2))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "images").mkdir()
    for number in range(len(ORIGINS)):
        options = ["-D", "density=truth.vol", "--spp", "16", "-s", str(number)]
        assert main(["render", "scene.xml", "-o", f"images/{number}.exr", *options]) == 0
        (tmp_path / "images" / f"{number}.png").unlink()
    yield tmp_path
    mi.set_variant("llvm_ad_rgb")


def test_the_command_fits_and_continues(folder, capsys):
    common = ["fit", "scene.xml", "--images", "images", "-o", "out", "--held-out", "1"]
    common += ["--steps", "30", "--method", "adam"]
    assert main(common) == 0
    lines = capsys.readouterr().out.splitlines()
    errors = [float(line.split("held out")[1].strip(" %")) for line in lines if "held out" in line]
    assert len(errors) == 3 and errors[-1] < 0.7 * errors[0]
    values, _ = read_vol(folder / "out" / "sigma_t.vol")
    truth, _ = read_vol(folder / "truth.vol")
    assert values.shape == truth.shape
    assert np.corrcoef(values.ravel(), truth.ravel())[0, 1] > 0.8
    # A fit that is complete writes what it has.
    (folder / "out" / "sigma_t.vol").unlink()
    assert main([*common, "--resume"]) == 0
    np.testing.assert_array_equal(read_vol(folder / "out" / "sigma_t.vol")[0], values)
    # Another fit does not replace it unasked.
    capsys.readouterr()
    other = [*common, "--steps", "1"]
    assert main(other) == 1
    assert "already holds a fit (fit.npz); continue it with --resume" in capsys.readouterr().err
    np.testing.assert_array_equal(read_vol(folder / "out" / "sigma_t.vol")[0], values)
    assert main([*other, "--overwrite"]) == 0
    assert (read_vol(folder / "out" / "sigma_t.vol")[0] != values).any()


def test_images_of_a_folder_are_sorted_by_numbers(tmp_path):
    names = ["a.exr", "a2.png", "a2.exr", "a02b.exr", "a10.exr", "0.exr", "2.exr", "11.exr"]
    for name in (*names, "notes.txt"):
        (tmp_path / name).touch()
    expected = ["0.exr", "2.exr", "11.exr", "a.exr", "a2.exr", "a2.png", "a02b.exr", "a10.exr"]
    assert [path.name for path in _image_files([str(tmp_path)])] == expected


def test_grey_images_have_one_channel(rgb, tmp_path):
    for form, count in (("Y", 1), ("YA", 1), ("RGB", 3), ("RGBA", 3)):
        file = tmp_path / f"{form}.png"
        grey = mi.Bitmap(np.full((2, 2, 1), 0.5, np.float32))
        grey.convert(getattr(mi.Bitmap.PixelFormat, form), mi.Struct.Type.UInt8, True).write(
            str(file)
        )
        assert _pixels(file).shape == (2, 2, count)
        assert _pixels(file)[..., 0] == pytest.approx(0.5, abs=0.01)


def test_the_command_names_what_is_wrong(folder, capsys):
    def refused(*arguments: str) -> str:
        assert main(["fit", "scene.xml", "-o", "out", *arguments]) == 1
        return capsys.readouterr().err

    assert "3 image(s), but the scene has 4 sensor(s)" in refused(
        "--images", "images/0.exr", "images/1.exr", "images/2.exr"
    )
    assert 'there is no image "x.exr"' in refused("--images", "x.exr")
    (folder / "empty").mkdir()
    assert 'the folder "empty" has no images' in refused("--images", "empty")
    assert "leave at least one to fit" in refused("--images", "images", "--held-out", "4")
    assert "is no checkpoint of a fit" in refused("--images", "images", "--resume")
    assert "views is 5, but 4 image(s)" in refused(
        "--images", "images", "--method", "adam", "--views", "5"
    )
    mi.Bitmap(np.ones((8, 8, 3), np.float32)).write("images/3.exr")
    assert 'image "images/3.exr" has shape (8, 8, 3)' in refused("--images", "images")
    (folder / "images" / "3.exr").write_bytes(b"no image")
    assert 'cannot read the image "images/3.exr"' in refused("--images", "images")
    assert not list((folder / "out").iterdir())
