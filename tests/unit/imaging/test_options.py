"""Properties as read: what they imply for caches and camera rays."""

from __future__ import annotations

import mitsuba as mi
import pytest

from mitsuba_irrcache.core.properties import RecordedProperties
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.imaging.options import Options

pytestmark = pytest.mark.usefixtures("rgb")


def options(**properties) -> Options:
    props = mi.Properties("irrcache")
    for name, value in properties.items():
        props[name] = value
    return Options.of(RecordedProperties(props))


@pytest.mark.parametrize(
    ("properties", "layered", "with_error"),
    [
        ({}, False, False),
        ({"filter": "fixed"}, True, False),
        ({"filter": "bilateral"}, True, True),
        ({"aovs": "colour,depth"}, True, False),
        ({"aovs": "x:noise"}, True, True),
        ({"aovs": "bias"}, True, True),
    ],
)
def test_errors_and_layers_are_computed_on_demand(properties, layered, with_error):
    found = options(**properties)
    assert (found.rays.layered, found.rays.with_error) == (layered, with_error)
    assert found.settings.with_error == with_error


def test_a_tolerance_takes_the_step_that_is_set():
    assert options().tolerance is None and options().tolerance_search() is None
    chosen = options(tolerance=0.01).tolerance
    assert (chosen.error, chosen.unit, chosen.step) == (0.01, "image", None)
    given = options(tolerance=0.01, tolerance_of="volume", step=0.5).tolerance
    assert (given.error, given.unit, given.step) == (0.01, "volume", 0.5)


def test_a_tolerance_excludes_a_cache_file():
    with pytest.raises(IrrcacheError, match="cannot be combined with cache_file"):
        options(tolerance=0.01, cache_file="cache.npz")


def test_misspelt_properties_are_refused():
    with pytest.raises(IrrcacheError, match="max_depht"):
        options(max_depht=2)
