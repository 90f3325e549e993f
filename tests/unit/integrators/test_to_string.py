"""to_string of the integrator, the record in reports and images, is complete."""

from __future__ import annotations

import re

import mitsuba as mi
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

#: A value of each property that differs from its default.
GIVEN = {
    "max_depth": 7,
    "rr_depth": 11,
    "hide_emitters": True,
    "solver": "path",
    "resolution": 23,
    "cache_spp": 48,
    "cache_seed": 9,
    "quadrature": "trapezoid",
    "step": 0.123456789,
    "filter": "bilateral",
    "aovs": "far:depth, noise:noise",
    "emission": 0.375,
    "emission_scale": 2.5,
    "cache_file": "light.npz",
    "timeout": 33.25,
    "sigma_t_file": "density.npy",
    "albedo_file": "albedo.npy",
    "max_memory": "8GB",
    "work_folder": "scratch",
    "irradiance_file": "fluence.npy",
}
#: The same for those that cannot be combined with others.
ALONE = {"tolerance": 0.0125, "tolerance_of": "volume"}


def printed(integrator: mi.Integrator) -> dict[str, str]:
    lines = str(integrator).splitlines()
    assert lines[0] == "IrradianceCachingIntegrator[" and lines[-1] == "]"
    return dict(re.fullmatch(r"  (\w+) = (.*?),?", line).groups() for line in lines[1:-1])


def documented(integrator: mi.Integrator) -> set[str]:
    """Return the properties in the plugin's documentation."""
    return set(re.findall(r"^\s+\* - (\w+)$", type(integrator).__doc__, re.MULTILINE))


def test_every_documented_property_is_printed():
    """Every documented property is printed, and no other property is read."""
    integrator = mi.load_dict({"type": "irrcache"})
    assert documented(integrator) == set(GIVEN | ALONE)
    assert set(printed(integrator)) == set(GIVEN | ALONE)


@pytest.mark.parametrize("given", [GIVEN, ALONE])
def test_values_are_printed_as_given(given):
    found = printed(mi.load_dict({"type": "irrcache", **given}))
    for key, value in given.items():
        if isinstance(value, float):
            assert float(found[key]) == pytest.approx(value, rel=1e-6)
        else:
            assert found[key] == (str(value).lower() if isinstance(value, bool) else str(value))


@pytest.mark.parametrize("name", GIVEN | ALONE)
def test_each_property_changes_the_record(name):
    """Each property changes the printed record."""
    plain = str(mi.load_dict({"type": "irrcache"}))
    assert str(mi.load_dict({"type": "irrcache", name: (GIVEN | ALONE)[name]})) != plain


def test_volumes_and_later_changes_are_printed():
    """An emission volume is printed in Mitsuba's format, and so is a number of samples raised
    later.
    """
    volume = {"type": "constvolume", "value": 0.625}
    integrator = mi.load_dict({"type": "irrcache", "emission": volume})
    assert "0.625" in str(integrator)
    integrator.cache_spp = 77
    assert "cache_spp = 77" in str(integrator)
