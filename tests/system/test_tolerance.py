"""Images with a tolerance: their error, its estimate, and what is chosen."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenImageIO
import pytest

from experiments.validation.limits.cases import Case
from experiments.validation.limits.reference import single
from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.core.cancellation import StopCondition
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.progressive import render_progressive
from tests.support.scene_xml import FOG_IN_A_BOX
from tests.support.surfaces import bound, fog, ground

TOLERANCE = 0.02


def true_error(case: Case, scene: mi.Scene) -> float:
    """Return the RMSE of an image of single scattering, in units of its mean."""
    exact = single(case, 3, 32)
    image = np.array(mi.render(scene), dtype=np.float64)[..., 0]
    return float(np.sqrt(np.square(image - exact).mean()) / exact.mean())


@pytest.mark.parametrize("name", ["constant", "directional", "point outside"])
def test_the_error_is_below_the_tolerance(mono, name):
    """The estimate is at most twice the truth, and not much smaller."""
    case = Case(name)
    scene = case.scene(tolerance=TOLERANCE)
    error = true_error(case, scene)
    certificate = scene.integrator().certificate
    assert certificate.is_met
    assert error <= TOLERANCE
    assert error / 1.5 < certificate.error < 2 * error
    settings = certificate.settings
    assert scene.integrator().cache.samples == settings["cache_spp"]
    assert max(scene.integrator().cache.grid.shape) == settings["resolution"]


def test_a_smaller_tolerance_has_a_finer_cache(mono):
    coarse, fine = (Case("directional").scene(tolerance=t) for t in (0.05, 0.005))
    for scene in coarse, fine:
        mi.render(scene)
    first, second = (scene.integrator().certificate.settings for scene in (coarse, fine))
    assert second["resolution"] > first["resolution"]
    assert second["spp"] > first["spp"]


def test_what_is_set_is_not_chosen(mono):
    given = {"resolution": 20, "cache_spp": 64, "step": 0.5}
    scene = Case("constant").scene(tolerance=1e-4, **given)
    mi.render(scene, spp=4)
    certificate = scene.integrator().certificate
    assert certificate.settings == given | {"spp": 4}
    assert not certificate.is_met
    assert all(part > 0 for part in certificate.parts.values())


def test_a_moved_camera_has_the_same_cache_and_an_edit_a_new_one(mono):
    scene = Case("directional").scene(tolerance=TOLERANCE)
    mi.render(scene)
    integrator, sensor = scene.integrator(), mi.traverse(scene.sensors()[0])
    cache, before = integrator.cache, integrator.certificate
    sensor["to_world"] = sensor["to_world"] @ mi.ScalarTransform4f().rotate([0, 1, 0], 3)
    sensor.update()
    mi.render(scene)
    assert integrator.cache is cache
    assert integrator.certificate is not before
    params = mi.traverse(scene)
    params["body.interior_medium.albedo.value.value"] = 0.4
    params.update()
    edited = np.array(mi.render(scene))
    assert integrator.cache is not cache
    other = Case("directional").scene(tolerance=TOLERANCE)
    sensor, others = mi.traverse(other.sensors()[0]), mi.traverse(other)
    sensor["to_world"] = sensor["to_world"] @ mi.ScalarTransform4f().rotate([0, 1, 0], 3)
    sensor.update()
    others["body.interior_medium.albedo.value.value"] = 0.4
    others.update()
    np.testing.assert_array_equal(edited, np.array(mi.render(other)))
    for albedo in 0.5, 0.6:
        before = integrator.certificate
        params["body.interior_medium.albedo.value.value"] = albedo
        params.update()
        mi.render(scene)
        assert integrator.certificate is not before


def test_an_estimate_that_is_stopped_is_no_certificate(mono):
    scene = Case("directional").scene(tolerance=TOLERANCE, timeout=1e-4)
    assert np.isfinite(np.array(mi.render(scene))).all()
    assert scene.integrator().certificate is None


def stopping_after(integrator, count: int) -> list[int]:
    """Cancel renderings of an integrator at call ``count`` of ``progress``; return its calls."""
    calls = []

    def progress(stage: str, done: int, total: int) -> None:
        calls.append(done)
        if len(calls) == count:
            integrator.cancel()

    integrator.progress = progress
    return calls


def test_a_search_that_is_stopped_leaves_its_finest_cache(mono):
    """It is rendered as it is; no other cache is begun, and the next rendering goes on."""
    complete = Case("directional").scene(tolerance=TOLERANCE)
    calls = stopping_after(complete.integrator(), 0)
    expected = np.array(mi.render(complete))
    resolution = complete.integrator().certificate.settings["resolution"]
    scene = Case("directional").scene(tolerance=TOLERANCE)
    integrator = scene.integrator()
    stopping_after(integrator, len(calls) - 1)
    image = np.array(mi.render(scene))
    assert not integrator.certificate.is_met
    assert "the time did not suffice for resolution" in str(integrator.certificate)
    assert 16 <= max(integrator.cache.grid.shape) < resolution
    assert integrator.cache.samples > 0
    assert image.mean() == pytest.approx(expected.mean(), rel=0.1)
    integrator.progress = None
    np.testing.assert_array_equal(np.array(mi.render(scene)), expected)


def test_the_timeout_holds_for_search_and_image_together(mono, monkeypatch):
    """The image has what the search left of the timeout."""
    begun = []
    begin = StopCondition.begin
    monkeypatch.setattr(
        StopCondition,
        "begin",
        lambda self, timeout=0.0: begun.append(timeout) or begin(self, timeout),
    )
    scene = Case("constant").scene(tolerance=0.05, timeout=1e6)
    mi.render(scene, spp=4)
    assert begun == [1e6]


def test_scenes_without_a_cache_have_no_estimate(mono):
    scene = Case("constant", max_depth=1).scene(tolerance=TOLERANCE)
    mi.render(scene)
    certificate = scene.integrator().certificate
    assert certificate.parts == {}
    assert not certificate.is_met and np.isnan(certificate.error)
    assert "nothing is scattered" in str(certificate)


def test_several_media_over_a_ground(rgb, scenes):
    integrator = {"type": "irrcache", "tolerance": 0.05, "max_depth": 2}
    objects = {"smoke": bound(interior=fog()), "other": bound(interior=fog(), center=(2.5, 0, 0))}
    scene = scenes.load(integrator, None, 12, floor=ground(), **objects, default_solver="auto")
    image = scenes.image(scene)
    assert np.isfinite(image).all()
    assert "surfaces" in str(scene.integrator().certificate)


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"tolerance": 2.0}, "tolerance is 2.0; it must be between 0"),
        ({"tolerance": 0.1, "cache_file": "a.npz"}, "cannot be combined with cache_file"),
        ({"tolerance": 0.1, "tolerance_of": "image "}, "tolerance_of is .*one of: image, volume"),
    ],
)
def test_wrong_properties_are_refused(mono, properties, message):
    with pytest.raises(RuntimeError, match=message):
        Case("constant").scene(**properties)


def test_what_needs_a_fixed_resolution_refuses_a_tolerance(rgb):
    scene = Case("constant").scene(tolerance=TOLERANCE)
    with pytest.raises(IrrcacheError, match="progressive run has targets of its own"):
        next(render_progressive(scene))
    wrapper = mi.load_dict(
        {"type": "aov", "aovs": "d:depth", "n": {"type": "irrcache", "tolerance": TOLERANCE}}
    )
    with pytest.raises(RuntimeError, match="another integrator calls this one"):
        mi.render(scene, integrator=wrapper)
    params = mi.traverse(scene)
    key = "body.interior_medium.sigma_t.data"
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(IrrcacheError, match="would jump with the resolution"):
        dr.backward(dr.mean(mi.render(scene, params)))


def test_a_view_without_radiance_is_refused(mono):
    scene = Case("constant").scene(tolerance=TOLERANCE)
    params = mi.traverse(scene)
    params["emitter.radiance.value"] = 0.0
    params.update()
    with pytest.raises(RuntimeError, match="has no radiance in the view"):
        mi.render(scene)


def test_command(rgb, scenes, tmp_path, capsys):
    """The command prints the estimate and writes it to the file."""
    mi.VolumeGrid(scenes.texture((4, 5, 6, 1), 0, 2, 1)).write(str(tmp_path / "density.vol"))
    source = tmp_path / "scene.xml"
    source.write_text(
        f"""<scene version="3.0.0"> <default name="density" value="density.vol"/>
        <integrator type="volpath"> <integer name="max_depth" value="2"/> </integrator>
        <sensor type="perspective"> <transform name="to_world">
        <lookat origin="0, 0, -5" target="0, 0, 0" up="0, 1, 0"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="12"/> <integer name="height" value="8"/>
        </film> </sensor> {FOG_IN_A_BOX} <emitter type="constant"/> </scene>"""
    )
    assert main(["render", str(source), "--tolerance", "5%"]) == 0
    assert "tolerance 5 %" in capsys.readouterr().out
    header = OpenImageIO.ImageInput.open(str(tmp_path / "scene.exr")).spec()
    assert "% of the mean radiance" in header.getattribute("irrcache:error")
    text = source.read_text().replace(
        '"volpath">', '"irrcache"> <integer name="cache_spp" value="64"/>'
    )
    source.write_text(text)
    assert main(["render", str(source), "--tolerance", "5%", "-v"]) == 0
    assert "tolerance 5 %" in capsys.readouterr().out
    assert main(["render", str(source), "--tolerance", "5%", "--budget", "3"]) == 1
    assert "leave --budget and --error away" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["render", str(source), "--tolerance", "0"])
    assert "above 0 and at most 100%" in capsys.readouterr().err
