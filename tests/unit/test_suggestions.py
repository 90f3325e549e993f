"""Misspelt names are answered with the name that was probably meant."""

from __future__ import annotations

import re

import mitsuba as mi
import pytest

from mitsuba_irrcache.cli.main import main
from mitsuba_irrcache.errors import suggestion
from mitsuba_irrcache.volumes.transfer import load_preset, parse_transfer_function

pytestmark = pytest.mark.usefixtures("rgb")

SCENE = """<scene version="3.0.0"><default name="radiance" value="1"/>
<integrator type="{integrator}"><integer name="{name}" value="2"/></integrator>
<sensor type="perspective"/>
<emitter type="constant"><rgb name="radiance" value="$radiance"/></emitter></scene>"""


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ("Solvr", ' (did you mean "solver"?)'),
        ("blur", ""),
        ("RESOLUTION", "resolution"),
        ("solver", ""),
    ],
)
def test_most_similar_name(wanted, expected):
    assert expected in suggestion(wanted, ["solver", "resolution"])
    assert bool(expected) == bool(suggestion(wanted, ["solver", "resolution"]))


@pytest.mark.parametrize(
    ("name", "meant"), [("max_dept", "max_depth"), ("cache_ssp", "cache_spp"), ("aov", "aovs")]
)
def test_misspelt_property_of_the_plugin(name, meant):
    with pytest.raises(RuntimeError, match=f'no property "{name}" .did you mean "{meant}"'):
        mi.load_dict({"type": "irrcache", name: 2})


def test_unknown_property_without_a_similar_one_is_left_to_mitsuba():
    with pytest.raises(RuntimeError, match="unreferenced property"):
        mi.load_dict({"type": "irrcache", "blur": 2})


def test_misspelt_choice():
    with pytest.raises(RuntimeError, match=r'one of: auto, path, sweep .did you mean "sweep"'):
        mi.load_dict({"type": "irrcache", "solver": "swep"})


@pytest.mark.parametrize(
    ("integrator", "name", "options", "meant"),
    [
        ("irrcahe", "max_depth", [], "irrcache"),
        ("volpath", "max_depth", ["-i", "volpahtmis"], "volpathmis"),
        ("volpath", "max_depth", ["-i", "irrcache{resolutoin=8}"], "resolution"),
        ("volpath", "max_depth", ["-i", "volpath{rr_dept=8}"], "rr_depth"),
        ("volpath", "max_depth", ["-D", "radianse=2"], "radiance"),
        ("irrcache", "cache_sp", [], "cache_spp"),
    ],
)
def test_misspelt_names_of_a_scene(tmp_path, capsys, integrator, name, options, meant):
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format(integrator=integrator, name=name))
    assert main(["render", str(scene), *options]) == 1
    assert f'did you mean "{meant}"?' in capsys.readouterr().err


def test_a_name_that_has_no_meaning_here_is_not_suggested(tmp_path, capsys):
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format(integrator="direct", name="max_depth"))
    assert main(["render", str(scene)]) == 1
    said = capsys.readouterr().err
    assert '"max_depth"' in said and "did you mean" not in said


def test_property_given_as_a_parameter_of_the_scene(tmp_path, capsys):
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format(integrator="volpath", name="max_depth"))
    assert main(["render", str(scene), "-D", "max_depth=3"]) == 1
    said = capsys.readouterr().err
    assert "parameters that its file declares, here: $radiance." in said
    assert "give -i 'irrcache{max_depth=3}'" in said


def test_misspelt_preset_and_key():
    with pytest.raises(ValueError, match=r"'ct-bones' .did you mean \"ct-bone\""):
        load_preset("ct-bones")
    with pytest.raises(ValueError, match=r'"opacitty" .did you mean "opacity"'):
        parse_transfer_function('{"format": "", "version": 1, "opacitty": [], "colour": []}')


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("rendr scene.xml", "'rendr'.*did you mean \"render\""),
        ("render scene.xml --sppp 3", 'argument --sppp .did you mean "--spp"'),
        ("render scene.xml -m llvm_rgb", "'llvm_rgb'.*did you mean \"llvm_ad_rgb\""),
        # Where a required option is misspelt, that is the error and not its absence.
        ("import a.npy --densty 3 -o out", 'argument --densty .did you mean "--density"'),
        ("import a.npy --density --asymetry=0.5 -o out", 'did you mean "--asymmetry"'),
        ("farm frmes scene.xml", "'frmes'.*did you mean \"frames\""),
        ("farm frames scene.xml -o out --worker 2 --thread 1 --schedulr a", "--scheduler"),
    ],
)
def test_misspelt_arguments_of_the_command(arguments, message, capsys):
    with pytest.raises(SystemExit) as status:
        main(arguments.split())
    assert status.value.code == 2
    assert re.search(message, capsys.readouterr().err)
