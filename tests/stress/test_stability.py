"""A quick selection of the hazards in `experiments.robustness.stability`; ``make stress`` runs
all.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.robustness.stability import properties as p
from experiments.robustness.stability.case import SETTINGS, Case
from experiments.robustness.stability.hazards import cases
from experiments.robustness.stability.run import described, run_case
from experiments.robustness.stability.worlds import Camera, Matter, World, scene
from mitsuba_irrcache.render.quadrature import QUADRATURES

pytestmark = pytest.mark.usefixtures("rgb")

#: One or two cases of each hazard: those that failed once, and the most extreme ones.
CHOSEN = {
    "optical depth": ("1e+30, white", "1000, white"),
    "extinction": ("1e-45 and 1e-40",),
    "albedo": ("0", "0.9999999"),
    "world scale": ("1e-06", "1e+06"),
    "offset": ("100000", "1e+06", "1e+07"),
    "voxels": ("1:1:100",),
    "grid": ("1x1x1", "13x11x7, furnace"),
    "rays": ("in faces and edges, furnace", "denormal, transmittance"),
    "camera": ("on a corner (cube)", "1e6 away (sphere)"),
    "light": ("a point at a voxel's centre beside a ball", "a texel of 1e+06"),
    "film": ("1x1", "a crop of 0x0"),
    "empty": ("1e-38 everywhere",),
    "phase over the ground": ("g = 0, depth 10000",),
    "samples": ("2^25 in one voxel",),
}


def chosen() -> list[Case]:
    """Return the cases of `CHOSEN`."""
    return [case for case in cases() if case.name in CHOSEN.get(case.hazard, ())]


def test_selected_cases_exist(rgb):
    assert len(chosen()) == sum(map(len, CHOSEN.values()))


@pytest.mark.parametrize("hazard", CHOSEN)
def test_hazards(hazard):
    """Both solvers satisfy all of `experiments.robustness.stability.properties` within their
    bounds.
    """
    rows = []
    for case in (c for c in chosen() if c.hazard == hazard):
        rows += run_case(case, "llvm_ad_rgb", quadratures=("exponential",))
    assert rows
    assert not [described(row) for row in rows if not row["held"]]


def test_segments_conserve_energy():
    """The weights of the trapezoid rule do not exceed the opacity of a segment.

    They once were half the optical depth, so that an opaque wall was 20 times brighter than the
    sky.
    """
    wall = Matter(np.full((4, 4, 4), 80.0, np.float32), 1.0)
    settings = SETTINGS | {"solver": "sweep", "quadrature": "trapezoid"}
    found = p.observe(scene(settings, wall), settings, 4)
    name, error, admitted = p.no_brighter()(found)
    assert error <= admitted, name


EXTREME = [0.0, 1e-45, 1e-38, 1e-12, 1e-3, 0.1, 1.0, 10.0, 100.0]


@st.composite
def matters(draw) -> Matter:
    """Generate media of any voxels, edges and placement."""
    shape = tuple(draw(st.integers(1, 7)) for _ in range(3))
    values = draw(st.lists(st.sampled_from(EXTREME), min_size=1, max_size=8))
    sigma_t = np.resize(np.float32(values), shape)
    edges = tuple(draw(st.sampled_from([0.02, 0.5, 2.0, 3.0])) for _ in range(3))
    albedo = draw(st.sampled_from([0.0, 1e-30, 0.5, 1 - 1e-7, 1.0]))
    kind = draw(st.sampled_from(["cube", "sphere"]))
    turn = draw(st.sampled_from([0.0, 30.0, 45.0, 90.0]))
    return Matter(sigma_t, albedo, edges, kind, turn, draw(st.booleans()))


@settings(derandomize=True, max_examples=20, deadline=None, database=None)
@given(
    matter=matters(),
    scale=st.sampled_from([1e-6, 1e-2, 1.0, 1e3, 1e6]),
    origin=st.tuples(*[st.sampled_from([-3.0, -1.0, 0.0, 1e-40, 0.5, 1.0, 4.0])] * 3),
    quadrature=st.sampled_from(QUADRATURES),
)
def test_any_medium_under_a_white_sky(matter, scale, origin, quadrature):
    """Under a white sky, images are finite, nonnegative and at most 1, at any scale and from any
    side.
    """
    camera = Camera(origin, (0.3, 0.2, 0.1), 60.0)
    options = SETTINGS | {"solver": "sweep", "quadrature": quadrature, "resolution": 6}
    built = scene(options, matter, camera=camera, world=World(scale))
    found = p.observe(built, options, 2)
    for check in (p.finite, p.not_negative, p.no_brighter()):
        name, error, admitted = check(found)
        assert error <= admitted, name
