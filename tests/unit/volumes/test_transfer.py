"""Transfer functions: their mapping, and refusal of invalid documents with the index."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.volumes.transfer import (
    DensityMapping,
    TransferFunction,
    load_preset,
    load_transfer_function,
    parse_transfer_function,
    preset_names,
)


def document(**changes) -> dict:
    return {
        "format": "irrcache transfer function",
        "version": 1,
        "length": 2.0,
        "opacity": [[0, 0.0], [100, 0.8]],
        "colour": [[0, [0, 0.2, 1]], [50, [1, 0.4, 0]]],
    } | changes


def parse(**changes) -> TransferFunction:
    return parse_transfer_function(json.dumps(document(**changes)))


def test_opacity_refers_to_the_stated_length():
    sigma_t = parse().sigma_t(np.array([-5.0, 0.0, 50.0, 100.0, 1e6]))
    lost = 1 - np.exp(-sigma_t * 2.0)
    np.testing.assert_allclose(lost, [0, 0, 0.4, 0.8, 0.8], atol=1e-6)


def test_colour_is_the_albedo():
    albedo = parse().albedo(np.array([-1.0, 25.0, 70.0]))
    np.testing.assert_allclose(albedo, [[0, 0.2, 1], [0.5, 0.3, 0.5], [1, 0.4, 0]], rtol=1e-6)


@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32", "int32"])
def test_slabs_and_tables_equal_the_function(dtype):
    values = np.random.default_rng(0).integers(0, 120, (5, 6, 7)).astype(dtype)
    function = parse()
    sigma_t, albedo = function.apply(values)
    assert sigma_t.dtype == albedo.dtype == np.float32
    np.testing.assert_array_equal(sigma_t, function.sigma_t(values.astype(float)))
    np.testing.assert_array_equal(albedo, function.albedo(values.astype(float)))


def test_values_too_far_apart_for_a_table():
    values = np.array([[[-(2**31), 50, 2**31 - 1]]], dtype=np.int32)
    np.testing.assert_array_equal(parse().apply(values)[0], parse().sigma_t(values))


@given(scale=st.floats(1e-3, 1e3), shift=st.floats(-1e3, 1e3), seed=st.integers(0, 2**16))
@settings(max_examples=25, deadline=None)
def test_percentile_functions_are_independent_of_units(scale, shift, seed):
    function = parse(
        value_range="percentile",
        percentiles=[2, 98],
        opacity=[[0, 0], [1, 0.8]],
        colour=[[0, [0, 0, 0]], [1, [1, 1, 1]]],
    )
    values = np.random.default_rng(seed).uniform(size=(9, 10, 11))
    original, rescaled = function.apply(values), function.apply(values * scale + shift)
    for expected, actual in zip(original, rescaled, strict=True):
        np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_percentiles_that_coincide_are_refused():
    function = parse(value_range="percentile", percentiles=[1, 99])
    with pytest.raises(IrrcacheError, match="are both 4"):
        function.apply(np.full((3, 3, 3), 4.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"opacity": [[0, 0], [5, 0.1], [5, 0.2]]}, '"opacity" point 2 has value 5.*sort'),
        ({"colour": [[9, [0, 0, 0]], [1, [0, 0, 0]]]}, '"colour" point 1 has value 1'),
        ({"opacity": [[0, 0.5]]}, '"opacity" has 1 point.*at least two'),
        ({"colour": []}, '"colour" has 0 point'),
        ({"opacity": [[0, 0], [1, 1]]}, '"opacity" point 1 is 1, an infinite extinction'),
        ({"opacity": [[0, -0.1], [1, 0.5]]}, '"opacity" point 0 is -0.1'),
        ({"opacity": [[0, 0], [1, 1.5]]}, '"opacity" point 1 is 1.5'),
        ({"opacity": [[0, 0], [1, "thick"]]}, "point 1 has 'thick'"),
        ({"opacity": [[0, 0], [1, True]]}, "point 1 has True"),
        ({"opacity": [[0, 0], [math.nan, 0.5]]}, "point 1 has value nan"),
        ({"opacity": [[0, 0], [1, math.nan]]}, "point 1 is nan"),
        ({"opacity": [[0, 0], 7]}, "point 1 is 7"),
        ({"opacity": {"0": 1}}, "list of points"),
        ({"colour": [[0, [0, 0, 0]], [1, [0, 0, 1.1]]]}, '"colour" point 1 is'),
        ({"colour": [[0, [0, 0, 0]], [1, [0, 0]]]}, '"colour" point 1 has.*3 numbers'),
        ({"color": []}, 'unknown key "color"'),
        ({"format": "something"}, "format 'something'"),
        ({"version": 2}, "version 2"),
        ({"length": 0}, '"length" is 0'),
        ({"value_range": "relative"}, '"value_range"'),
        ({"value_range": "percentile"}, '"percentiles" is None'),
        ({"value_range": "percentile", "percentiles": [99, 1]}, "lower one first"),
        ({"percentiles": [1, 99]}, "needs"),
    ],
)
def test_invalid_transfer_functions_are_refused(changes, message):
    with pytest.raises(IrrcacheError, match=message):
        parse(**changes)


def test_missing_key_is_named():
    incomplete = document()
    del incomplete["colour"]
    with pytest.raises(IrrcacheError, match='"colour" is missing'):
        parse_transfer_function(json.dumps(incomplete))


@pytest.mark.parametrize("text", ["", "[]", "{not json", "3"])
def test_other_json_values_are_refused(text):
    with pytest.raises(IrrcacheError, match=r"JSON|object"):
        parse_transfer_function(text)


def test_file_is_named_in_errors(tmp_path):
    with pytest.raises(IrrcacheError, match=r"bone.json does not exist"):
        load_transfer_function(tmp_path / "bone.json")
    (tmp_path / "bone.json").write_bytes(b"\xff\xfe")
    with pytest.raises(IrrcacheError, match=r"bone.json"):
        load_transfer_function(tmp_path / "bone.json")


@pytest.mark.parametrize("name", ["ct-bone", "ct-chest", "ct-soft-tissue", "mr-head"])
def test_presets_are_usable_and_survive_a_round_trip(name, tmp_path):
    assert name in preset_names()
    preset = load_preset(name)
    preset.save(tmp_path / "saved.json")
    loaded = load_transfer_function(tmp_path / "saved.json")
    values = np.linspace(-2000, 3000, 501)
    np.testing.assert_array_equal(loaded.sigma_t(values), preset.sigma_t(values))
    np.testing.assert_array_equal(loaded.albedo(values), preset.albedo(values))
    assert (loaded.unit, loaded.percentiles) == (preset.unit, preset.percentiles)
    # Air is empty, and the mean free path is above 1 mm: caches have voxels of 2 to 4 mm.
    assert preset.sigma_t(np.array([-1000.0]))[0] == 0
    assert preset.sigma_t(values).max() < 1.0


def test_bone_preset_shows_bone_only():
    air, lung, fat, muscle, bone = load_preset("ct-bone").sigma_t(
        np.array([-1000.0, -850.0, -100.0, 50.0, 800.0])
    )
    assert air == lung == fat == muscle == 0 and bone > 0.3


def test_unknown_preset_lists_the_presets():
    with pytest.raises(IrrcacheError, match="ct-bone, ct-chest"):
        load_preset("ct-bones")


def test_density_is_scaled():
    values = np.arange(8, dtype=np.uint8).reshape(2, 2, 2)
    sigma_t, albedo = DensityMapping(2.5, (0.1, 0.5, 1.0)).apply(values)
    np.testing.assert_allclose(sigma_t, values * 2.5)
    np.testing.assert_allclose(albedo, np.broadcast_to([0.1, 0.5, 1.0], (2, 2, 2, 3)))


def test_negative_density_is_refused():
    values = np.array([[[1.0, -0.5], [-2.0, 3.0]]])
    with pytest.raises(IrrcacheError, match=r"2 densities are negative, the least -2.*--clip"):
        DensityMapping().apply(values)


@pytest.mark.parametrize("arguments", [(-1.0,), (math.inf,), (1.0, (0.5, 0.5, 1.2))])
def test_invalid_density_mapping(arguments):
    with pytest.raises(IrrcacheError, match=r"scale|albedo"):
        DensityMapping(*arguments)
