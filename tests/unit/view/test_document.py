"""The scene document: the edited XML is what is rendered and saved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.io.scene_files import scene_of_text, scene_text
from mitsuba_irrcache.view.camera import Camera
from mitsuba_irrcache.view.document import Document, Lighting, sensor_of

pytestmark = pytest.mark.usefixtures("rgb")

SCENE = """<scene version="3.0.0">
    <default name="strength" value="2"/>
    <integrator type="volpath"> <integer name="max_depth" value="3"/> </integrator>
    <sensor type="perspective" id="front">
        <transform name="to_world">
            <lookat origin="0.3, -5, 1" target="0, 0, 0" up="0, 0, 1"/>
        </transform>
    </sensor>
    <emitter type="constant"> <rgb name="radiance" value="0.1, 0.2, $strength"/> </emitter>
    <emitter type="directional">
        <vector name="direction" x="1" y="2" z="-3"/>
        <rgb name="irradiance" value="3, 2, 1"/>
    </emitter>
    <medium type="heterogeneous" id="fog">
        <volume name="sigma_t" type="gridvolume">
            <string name="filename" value="density.vol"/>
            <transform name="to_world">
                <matrix value="1.9 0.1 0 -1 0 2.0 0.3 -1 0.2 0 1.8 -1 0 0 0 1"/>
            </transform>
        </volume>
        <float name="albedo" value="0.8"/> <float name="scale" value="1.5"/>
    </medium>
    <shape type="cube"> <bsdf type="null"/> <ref name="interior" id="fog"/> </shape>
</scene>
"""


@pytest.fixture
def path(tmp_path, scenes) -> Path:
    mi.VolumeGrid(scenes.texture((4, 5, 6, 1), 0, 2, 1)).write(str(tmp_path / "density.vol"))
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def values(scene: mi.Scene) -> dict[str, np.ndarray]:
    """Return all numbers of a scene, in the order of their objects."""
    params = mi.traverse(scene)
    plain = {k: getattr(v, "matrix", v) for k, v in params}
    return {
        k.split(".", 1)[-1]: np.array(v) for k, v in plain.items() if isinstance(v, str) is False
    }


@pytest.mark.parametrize("folder", ["", "data"])
def test_document_equals_its_scene(path, folder):
    """A document equals its scene in every number, with transforms bit by bit and parameters
    resolved. Files may be in a folder that the scene names by <path>.
    """
    if folder:
        (path.parent / folder / "rgb").mkdir(parents=True)
        (path.parent / "density.vol").rename(path.parent / folder / "density.vol")
        head = '<scene version="3.0.0">'
        path.write_text(SCENE.replace(head, f'{head} <path value="{folder}"/>'))
    before = str(mi.file_resolver())
    expected = values(mi.load_file(str(path), strength=5))
    found = values(scene_of_text(scene_text(path, {"strength": "5"}), path.parent))
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_array_equal(found[key], value, err_msg=key)
    assert str(mi.file_resolver()) == before


def test_scene_edits(path):
    """Density, depth and illumination are relative to the scene, and can be restored."""
    document = Document.load(path, {}, "irrcache")
    assert document.settings.max_depth == 3
    assert document.lighting.sun == pytest.approx(2)
    before = document.state()
    document.set_density(2)
    document.set_max_depth(-1)
    document.set_lighting(Lighting(environment=3, sun=4, azimuth=90, elevation=0))
    params = mi.traverse(document.scene())
    numbers = {k: params[k] for k in params.keys()}
    sun = next(e for e in document.scene().emitters() if "Directional" in e.class_name())
    place = np.array(mi.traverse(sun)["to_world"].matrix).reshape(4, 4)
    np.testing.assert_allclose(place[:3, 2], [0, -1, 0], atol=1e-6)
    (scale,) = (v for k, v in numbers.items() if k.endswith(".scale") and "fog" in k)
    assert float(scale) == pytest.approx(3)
    (radiance,) = (v for k, v in numbers.items() if k.endswith(".radiance.value"))
    np.testing.assert_allclose(np.array(radiance).ravel(), [0.3, 0.6, 6], rtol=1e-6)
    (irradiance,) = (v for k, v in numbers.items() if k.endswith(".irradiance.value"))
    np.testing.assert_allclose(np.array(irradiance).ravel(), [6, 4, 2], rtol=1e-6)
    assert document.settings.max_depth == -1
    document.restore(before)
    assert document.density == 1 and document.settings.max_depth == 3


def test_sun_is_added_and_removed(path):
    document = Document.load(path, {}, "irrcache")
    count = len(document.scene().emitters())
    document.set_lighting(Lighting(sun=0))
    assert len(document.scene().emitters()) == count - 1
    document.set_lighting(Lighting(sun=1))
    assert len(document.scene().emitters()) == count


SUNS = {
    "direction": '<vector name="direction" x="1" y="2" z="-3"/>',
    "transform": '<transform name="to_world"> <lookat origin="0, 0, 0" target="1, 2, -3"'
    ' up="0, 0, 1"/> </transform>',
}


@pytest.mark.parametrize("given", SUNS)
@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, -1, 0), (0.3, 0.2, 1)])
def test_angles_of_the_sun_are_preserved(path, given, up):
    """The angles of the scene's sun are right for every up axis and definition of its direction.

    A larger elevation moves the sun towards the upward axis.
    """
    path.write_text(SCENE.replace(SUNS["direction"], SUNS[given]))
    document = Document.load(path, {}, "irrcache")
    document.orient(up)

    def direction() -> np.ndarray:
        sun = next(e for e in document.scene().emitters() if "Directional" in e.class_name())
        return np.array(mi.traverse(sun)["to_world"].matrix).reshape(4, 4)[:3, 2]

    before = direction()
    document.set_lighting(replace(document.lighting, sun=5))
    np.testing.assert_allclose(direction(), before, atol=1e-6)
    document.set_lighting(replace(document.lighting, elevation=90))
    np.testing.assert_allclose(direction(), -np.array(up) / np.linalg.norm(up), atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.set_density(0),
        lambda d: d.set_density(float("nan")),
        lambda d: d.set_max_depth(-2),
        lambda d: d.set_lighting(Lighting(sun=-1)),
        lambda d: d.set_lighting(Lighting(environment=float("nan"))),
    ],
)
def test_impossible_values_are_refused(path, change):
    with pytest.raises(IrrcacheError):
        change(Document.load(path, {}, "irrcache"))


def test_saved_scenes_load_from_another_folder(path, tmp_path_factory):
    """Saved scenes load from another folder, with the camera and all files.

    Existing files are referred to; the others are written beside the scene.
    """
    document = Document.load(path, {}, "irrcache")
    document.set_density(2)
    folder = tmp_path_factory.mktemp("elsewhere")
    camera = Camera((1, -4, 2), (0, 0, 0), (0, 0, 1), 25)
    saved = folder / "view.xml"
    properties = {"cache_spp": ("integer", "64")}
    sensor = sensor_of(camera, (30, 20))
    assert document.save(saved, sensor, True, properties, "seen") == [saved]
    scene = mi.load_file(str(saved))
    assert scene.integrator().cache_spp == 64
    (only,) = scene.sensors()
    assert tuple(only.film().size()) == (30, 20) and only.get_medium() is not None
    volume = np.full((3, 3, 3), 0.5, np.float32)
    document.set_volumes({"density.vol": volume})
    files = document.save(saved, sensor_of(camera, (30, 20)), False, {}, "seen")
    assert sorted(f.name for f in files) == ["view.density.vol", "view.xml"]
    params = mi.traverse(mi.load_file(str(saved)))
    (data,) = (params[k] for k in params.keys() if k.endswith("sigma_t.data"))
    np.testing.assert_array_equal(np.array(data)[..., 0], volume)


def test_emitters_are_hidden_and_shown(path):
    """The environment lights the medium all the same, and a saved scene says so."""
    document = Document.load(path, {}, "irrcache")
    assert not document.march.hide_emitters
    document.set_hide_emitters(True)
    assert document.march.hide_emitters
    assert "hide_emitters = true" in str(document.scene().integrator())
    document.set_hide_emitters(False)
    assert not document.march.hide_emitters
