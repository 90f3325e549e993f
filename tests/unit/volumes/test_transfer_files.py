"""Transfer functions of 3D Slicer and VPT map values as these programs do."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.transfer_files import load

OPACITY = "8 -1000 0 150 0 280 0.2 950 0.6"
COLOUR = "12 -1000 0.3 0.3 1 460 1 0 0 950 1 0.3 0.3"
#: The layout of Slicer's documentation, with functions of ours.
VP = f"1\n1\n0.9\n0.1\n0.2\n10\n{OPACITY}\n4 0 1 255 1\n{COLOUR}\n"
MRML = f"""<?xml version="1.0" encoding="utf-8"?>
<MRML>
  <VolumeProperty name="First" scalarOpacity="{OPACITY}" gradientOpacity="4 0 1 9 1" shade="1"
    colorTransfer="{COLOUR}"/>
  <VolumeProperty name="Second" scalarOpacity="6 0 0 10 1 20 1" gradientOpacity="4 0 0 9 1"
    colorTransfer="8 0 1 1 1 20 0 0 0"/>
</MRML>"""


def bump(x, y, width, height, r, g, b, a):
    return {
        "position": {"x": x, "y": y},
        "size": {"x": width, "y": height},
        "color": {"r": r, "g": g, "b": b, "a": a},
    }


def expect_first(function) -> None:
    values = np.array([-2000.0, 150, 215, 280, 615, 950, 3000])
    expected = [0, 0, 0.1, 0.2, 0.4, 0.6, 0.6]
    np.testing.assert_allclose(function.sigma_t(values), -np.log1p(-np.array(expected)), rtol=1e-6)
    np.testing.assert_allclose(function.albedo(np.array([460.0]))[0], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(function.albedo(np.array([705.0]))[0], [1, 0.15, 0.15], atol=1e-6)
    assert function.unit == "HU"


def test_volume_property_of_slicer(tmp_path):
    (tmp_path / "a.vp").write_text(VP)
    expect_first(load(tmp_path / "a.vp"))


def test_presets_of_slicer_are_chosen_by_name(tmp_path):
    path = tmp_path / "presets.xml"
    path.write_text(MRML)
    expect_first(load(f"{path}:First"))
    second = load(f"{path}:Second")
    assert second.opacities.max() == pytest.approx(0.99) and second.unit == ""
    assert "gradient opacity is left out" in second.description
    with pytest.raises(IrrcacheError, match=r"2 volume properties, First, Second.*xml:NAME"):
        load(path)
    with pytest.raises(IrrcacheError, match=r"'Frist'.*did you mean \"First\""):
        load(f"{path}:Frist")


def test_steps_of_slicer_stay_steps(tmp_path):
    (tmp_path / "a.vp").write_text(VP.replace(OPACITY, "8 0 0 5 0 5 0.5 10 0.5"))
    function = load(tmp_path / "a.vp")
    np.testing.assert_allclose(function.sigma_t(np.array([4.9, 5.1])), [0, np.log(2)], atol=1e-5)


def test_bumps_of_vpt(tmp_path):
    """A bump is a Gaussian, at gradient 0; later ones are composited over earlier ones."""
    bumps = [bump(0.25, 0, 0.1, 0.2, 1, 0, 0, 0.8), bump(0.75, 0.3, 0.1, 0.3, 0, 1, 0, 0.5)]
    (tmp_path / "a.json").write_text(json.dumps(bumps))
    function = load(tmp_path / "a.json")
    assert function.percentiles == (0, 100)
    fitted = function.fitted_to(np.linspace(0, 200, 1001).reshape(7, 11, 13))
    values = np.array([50.0, 70.0, 150.0])
    expected = np.array([0.8, 0.8 * np.exp(-1), 0.5 * np.exp(-1)])
    np.testing.assert_allclose(1 - np.exp(-fitted.sigma_t(values)), expected, rtol=2e-3)
    np.testing.assert_allclose(
        fitted.albedo(values), [[1, 0, 0], [np.exp(-1), 0, 0], [0, np.exp(-1), 0]], atol=2e-3
    )
    both = [bump(0.5, 0, 1, 1, 1, 0, 0, 0.8), bump(0.5, 0, 1, 1, 0, 1, 0, 0.5)]
    (tmp_path / "b.json").write_text(json.dumps(both))
    over = load(tmp_path / "b.json").map(np.array([0.5]))
    np.testing.assert_allclose(1 - np.exp(-over[0]), 0.5 + 0.8 * 0.5, rtol=1e-5)
    np.testing.assert_allclose(over[1][0], [0.5, 1, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.vp", "1\n1\n", "2 lines"),
        ("a.vp", VP.replace("8 -1000 0 150", "8 -1000 0"), "7 numbers after the count 8"),
        ("a.vp", VP.replace("8 -1000", "8 abc"), "count and numbers"),
        ("a.vp", VP.replace("150 0 280", "300 0 280"), "sort the points"),
        ("a.xml", "<MRML></MRML>", "no volume property"),
        ("a.xml", "<MRML><VolumeProperty/></MRML>", "no scalarOpacity"),
        ("a.xml", MRML[:200], "transfer function"),
        ("a.json", "[]", "no bumps"),
        ("a.json", '[{"position": 3}]', "bump 0 is"),
        ("a.json", json.dumps([bump(0, 0, 0, 1, 1, 1, 1, 1)]), "sizes above 0"),
        ("a.json", "[1, 2", "transfer function"),
    ],
)
def test_damaged_functions_are_refused(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(IrrcacheError, match=message) as error:
        load(tmp_path / name)
    assert name in str(error.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(IrrcacheError, match=r"none\.xml:CT-Bone does not exist"):
        load(f"{tmp_path}/none.xml:CT-Bone")


def test_slicer_preset_on_the_command_line(tmp_path):
    (tmp_path / "presets.xml").write_text(MRML)
    out = tmp_path / "out"
    function = f"{tmp_path}/presets.xml:First"
    arguments = ["phantom:thorax:24,20,24", "--transfer-function", function, "-o", str(out)]
    assert main(["import", *arguments]) == 0
    assert "3D Slicer: First" in (out / "transfer_function.json").read_text()
