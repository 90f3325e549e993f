"""Loading of scene files with parameters and with another integrator."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.scene_files import (
    check_sensor,
    integrator_of,
    key_of,
    load_scene,
    parse_integrator,
    scene_of_text,
    scene_text,
    unknown_properties,
)

pytestmark = pytest.mark.usefixtures("rgb")

SCENE = """<scene version="3.0.0">
    <default name="size" value="8"/>
    <integrator type="volpath">
        <integer name="max_depth" value="3"/> <integer name="rr_depth" value="7"/>
    </integrator>
    <sensor type="perspective">
        <film type="hdrfilm">
            <integer name="width" value="$size"/> <integer name="height" value="$size"/>
        </film>
    </sensor>
    <shape type="cube">
        <bsdf type="null"/>
        <medium name="interior" type="heterogeneous">
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="density.vol"/>
            </volume>
            <float name="albedo" value="0.5"/>
        </medium>
    </shape>
    <emitter type="constant"/>
</scene>
"""


@pytest.fixture
def file(tmp_path):
    """Return a scene file whose volume lies beside it, not in the working folder."""
    mi.VolumeGrid(np.ones((2, 2, 2, 1), np.float32)).write(str(tmp_path / "density.vol"))
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("volpath", ("volpath", {})),
        (" irrcache { step = 0.5 , cache_spp=8 } ", ("irrcache", {"step": 0.5, "cache_spp": 8})),
        ("irrcache{}", ("irrcache", {})),
        ("a{hide_emitters=true,b=false}", ("a", {"hide_emitters": True, "b": False})),
        (
            "a{quadrature=riemann,cache_file='x=y.npz'}",
            ("a", {"quadrature": "riemann", "cache_file": "x=y.npz"}),
        ),
        ("a{x=1e-3,y=-1}", ("a", {"x": 1e-3, "y": -1})),
    ],
)
def test_specification(text, expected):
    assert parse_integrator(text) == expected


@pytest.mark.parametrize(
    "text", ["", "irrcache{step", "irrcache{step}", "irrcache{=1}", "two words"]
)
def test_unreadable_specification_is_quoted(text):
    with pytest.raises(IrrcacheError, match="cannot read"):
        parse_integrator(text)


def test_scene_as_it_is(file):
    scene = load_scene(file, {"size": "5"})
    assert scene.integrator().class_name() == "VolumetricPathIntegrator"
    assert tuple(scene.sensors()[0].film().size()) == (5, 5)


def test_integrator_receives_shared_properties(file):
    text = str(load_scene(file, integrator="irrcache{step=0.5}").integrator())
    assert "max_depth = 3" in text and "rr_depth = 7" in text and "step = 0.5" in text
    assert "max_depth = 9" in str(load_scene(file, integrator="irrcache{max_depth=9}").integrator())


@pytest.mark.parametrize("integrator", ["direct", "depth", "aov{aovs=d:depth}", "volpath"])
def test_unknown_properties_are_not_passed_on(file, integrator):
    """Properties that a plugin lacks are not passed on, unless the user gives them, which is an
    error.

    ``direct`` has no max_depth and rr_depth.
    """
    load_scene(file, integrator=integrator)
    with pytest.raises(RuntimeError, match="foo"):
        load_scene(
            file,
            integrator=integrator.removesuffix("}")
            + ("," if "{" in integrator else "{")
            + "foo=1}",
        )


def test_depth_of_a_plugin_without_depth(file):
    with pytest.raises(RuntimeError, match="max_depth"):
        load_scene(file, integrator="direct{max_depth=2}")


@pytest.mark.parametrize(
    ("integrator", "expected"),
    [
        ("volpath{max_depth=2,filter=bilateral}", ["filter"]),
        ("irrcache{filter=bilateral,step=0.5}", []),
        ("irrcache{cache_spp=8,blur=1}", ["blur"]),
        ("irrcache{step=-1,blur=1}", []),  # refused: ambiguous
        ("nowhere{blur=1}", []),
    ],
)
def test_unknown_properties(integrator, expected):
    assert unknown_properties(integrator) == expected


def test_search_path_is_restored(file):
    before = str(mi.file_resolver())
    load_scene(file)
    assert str(mi.file_resolver()) == before


def test_spectra_beside_a_scene_are_found_and_its_folders_are_its_own(tmp_path, monkeypatch):
    """Mitsuba's parser reads spectra, and adds a scene's <path> to its search path."""
    before = str(mi.file_resolver())
    (tmp_path / "data").mkdir()
    paint = '<bsdf type="diffuse"><spectrum name="reflectance" filename="{}.spd"/></bsdf>'
    for name, folder in (("here", tmp_path), ("there", tmp_path / "data")):
        (folder / f"{name}.spd").write_text("400 0.5\n700 0.5\n")
    bsdfs = "".join(paint.format(name) for name in ("here", "there"))
    text = f'<scene version="3.0.0"><path value="data"/>{bsdfs}</scene>'
    (tmp_path / "scene.xml").write_text(text)
    load_scene(tmp_path / "scene.xml")
    assert integrator_of(tmp_path / "scene.xml") == "path"
    assert str(mi.file_resolver()) == before


@pytest.mark.parametrize("given", [None, "irrcache{cache_file=light.cache}"])
def test_what_an_integrator_writes_is_placed_in_a_folder(file, tmp_path, given):
    integrator = '<integrator type="irrcache"><string name="cache_file" value="light.cache"/>'
    text = file.read_text().replace('<integrator type="volpath">', integrator)
    file.write_text(text.replace('<integer name="rr_depth" value="7"/>', ""))
    scene = load_scene(file, integrator=given, folder=tmp_path / "elsewhere")
    assert f"cache_file = {tmp_path / 'elsewhere' / 'light.cache'}" in str(scene.integrator())
    assert "cache_file = light.cache" in str(load_scene(file, integrator=given).integrator())


def test_integrator_of(file):
    assert integrator_of(file) == "volpath"


def test_missing_file(tmp_path):
    with pytest.raises(IrrcacheError, match=r"no scene file .*absent\.xml"):
        load_scene(tmp_path / "absent.xml")


def test_integrator_is_added_to_a_scene_that_names_none(tmp_path):
    file = tmp_path / "bare.xml"
    file.write_text('<scene version="3.0.0"> <sensor type="perspective"/> </scene>')
    scene = load_scene(file, integrator="irrcache{max_depth=3}")
    assert "max_depth = 3" in str(scene.integrator())
    assert '<integrator type="irrcache"' in scene_text(file, integrator="irrcache{max_depth=3}")
    assert len(scene.sensors()) == 1


def test_properties_are_added_to_those_of_the_integrator(file):
    scene = load_scene(file, integrator="irrcache{step=0.5}", properties={"tolerance": 0.25})
    text = str(scene.integrator())
    assert "step = 0.5" in text and "tolerance = 0.25" in text and "max_depth = 3" in text


@pytest.mark.parametrize(("far", "shapes"), [("rectangle", 2), ("cube", 1)])
@pytest.mark.parametrize("from_text", [False, True])
def test_meshes_are_merged_unless_the_scene_loses_their_extent(tmp_path, far, shapes, from_text):
    """Mitsuba's own integrators ignore occluders beyond the bounds of the scene."""
    objects = "".join(
        f'<shape type="{kind}"><transform name="to_world"><translate x="{x}"/></transform>'
        '<ref id="grey"/></shape>'
        for kind, x in (("cube", 0), (far, 5))
    )
    text = f'<scene version="3.0.0"><bsdf type="diffuse" id="grey"/>{objects}</scene>'
    (tmp_path / "scene.xml").write_text(text)
    scene = scene_of_text(text, tmp_path) if from_text else load_scene(tmp_path / "scene.xml")
    box = scene.bbox()
    np.testing.assert_allclose([np.array(box.min), np.array(box.max)], [[-1] * 3, [6, 1, 1]])
    assert len(scene.shapes()) == shapes


def test_keys_are_abbreviated(file):
    """By their end, or by a component of the key of an array."""
    phase = '<phase type="hg"> <float name="g" value="0.3"/> </phase>'
    text = SCENE.replace("</medium>", f"{phase}</medium>")
    params = mi.traverse(scene_of_text(text, folder=file.parent))
    key = next(key for key in params.keys() if key.endswith("phase_function.g"))
    assert {key_of(params, name) for name in ("g", "phase_function.g", key)} == {key}
    key = next(key for key in params.keys() if key.endswith("sigma_t.data"))
    assert {key_of(params, name) for name in ("sigma_t", "sigma_t.data", key)} == {key}
    with pytest.raises(IrrcacheError, match=r'the end of exactly one.* found: ".*", "'):
        key_of(params, "value")
    with pytest.raises(IrrcacheError, match="found: none"):
        key_of(params, "function.g")


def test_scenes_without_a_sensor_are_refused():
    sensor = {"type": "perspective"}
    with pytest.raises(IrrcacheError, match="the scene has no sensor; add a <sensor>"):
        check_sensor(0, mi.load_dict({"type": "scene"}))
    scene = mi.load_dict({"type": "scene", "a": sensor, "b": sensor})
    check_sensor(1, scene)
    for number in (-1, 2):
        with pytest.raises(IrrcacheError, match=rf"--sensor is {number}, but the scene has 2"):
            check_sensor(number, scene)
