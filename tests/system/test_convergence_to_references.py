"""Images converge to exact references, for each kind of emitter and phase function and both
solvers.

The media are coarse grids of high contrast. The references are those of
experiments/validation/limits: quadrature of single scattering, and paths of all orders, which share
no code with irrcache.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from functools import lru_cache

import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.limits.cases import Case
from experiments.validation.limits.reference import orders, single

pytestmark = pytest.mark.usefixtures("mono")

SPP = 64
#: Delta lights, for which ``sweep`` has hardly any noise.
POINTS = [
    Case(emitter, phase)
    for phase in ("isotropic", "hg 0.58", "rayleigh")
    for emitter in ("point outside", "point beside", "point inside", "spot wide", "spot narrow")
]
POINTS += [Case("point outside", phase) for phase in ("hg 0.3", "hg -0.4")]
#: Resolution, samples per voxel, and the largest relative error of the mean: 0.1 % where the
#: discretisation and the noise of the directions are small enough.
SWEEP = {
    Case("directional"): (64, 32, 0.001),
    Case("directional", "rayleigh"): (64, 32, 0.001),
    Case("directional", "hg 0.58"): (64, 32, 0.001),
    Case("directional", "hg -0.4", "3x5x2"): (64, 32, 0.001),
    Case("constant"): (96, 512, 0.003),
    Case("constant", "rayleigh"): (64, 512, 0.003),
    Case("rectangle far"): (64, 32, 0.001),
    Case("rectangle near"): (64, 32, 0.001),
    Case("sphere near"): (64, 32, 0.001),
    Case("disk near"): (64, 32, 0.001),
    Case("disk near", "rayleigh"): (64, 32, 0.001),
    # Legendre moments of the phase function above order 8 (hg 0.58) or 5 (hg -0.4) are averaged
    # over a few points of the emitter.
    Case("rectangle near", "hg 0.58"): (64, 32, 0.002),
    Case("rectangle far", "hg 0.58"): (64, 32, 0.002),
    Case("sphere near", "hg -0.4"): (64, 32, 0.002),
    Case("point outside", grid="3x5x2"): (64, 32, 0.001),
    Case("point outside", grid="1x1x6"): (64, 32, 0.001),
}
#: Emitters wider than the medium: radiance enters through its sides, where transmittance is not
#: exponential, and the error at a resolution of 64 is 0.3 %. Rayleigh scattering has the same
#: irradiance as isotropic scattering, and moments.
WIDE = [Case("rectangle large", "rayleigh")]
PATH = {
    Case("constant"): (64, 64, 0.003),
    Case("point inside"): (64, 64, 0.002),
    Case("point outside"): (64, 64, 0.003),
    Case("directional", "hg 0.58"): (32, 32, 0.001),
    Case("rectangle near"): (64, 32, 0.001),
    Case("rectangle near", "hg 0.58"): (32, 32, 0.0025),
    Case("disk near"): (64, 32, 0.001),
}
#: All orders of scattering, solver ``sweep``.
ORDERS = {
    Case("constant", max_depth=-1): (64, 512, 0.003),
    Case("directional", max_depth=-1): (64, 512, 0.0015),
    Case("point outside", max_depth=-1): (64, 512, 0.0025),
}

#: Cases that `make stress` runs, which differ from others in one property.
SLOW = {
    Case("rectangle far"),
    Case("sphere near"),
    Case("disk near"),
    Case("disk near", "rayleigh"),
    Case("constant", "rayleigh"),
    Case("rectangle near", "hg 0.58"),
    Case("sphere near", "hg -0.4"),
    Case("directional", max_depth=-1),
    Case("point outside", max_depth=-1),
    *WIDE,
}
#: `test_area_lights` has the solver `path` with rectangles.
SLOW_PATH = {Case("disk near"), Case("rectangle near"), Case("rectangle near", "hg 0.58")}
SLOW_POINTS = {
    Case("spot wide", "hg 0.58"),
    Case("spot wide", "rayleigh"),
    Case("spot narrow"),
    Case("spot narrow", "rayleigh"),
}


def parameters(cases: Iterable[Case], slow: Container[Case] = SLOW) -> list:
    """Return test parameters, of which those that are ``slow`` are marked."""
    return [
        pytest.param(case, id=case.name, marks=[pytest.mark.slow] * (case in slow))
        for case in cases
    ]


@lru_cache
def exact(case: Case) -> float:
    """Return the mean of the image of single scattering."""
    return single(case, 4, 1 if case.has_direction else 32, 64).mean()


def error(case: Case, expected: float, **integrator) -> float:
    """Return the relative error of the mean of the image."""
    image = mi.render(case.scene(**integrator), spp=SPP)
    return float(np.mean(np.array(image)[..., 0], dtype=np.float64) / expected - 1)


def coarse_and_fine(case: Case) -> tuple[float, float]:
    """Return the errors of ``sweep`` at two resolutions."""
    settings = {"solver": "sweep", "cache_spp": 32}
    return tuple(error(case, exact(case), resolution=n, **settings) for n in (32, 64))


@pytest.mark.parametrize("case", parameters(POINTS, SLOW_POINTS))
def test_sweep_of_delta_lights(case):
    """With delta lights, the error of ``sweep`` decreases with the square of the voxel size.

    Both the extrapolation of two resolutions and the finer one are compared with the reference.
    """
    coarse, fine = coarse_and_fine(case)
    assert abs(fine + (fine - coarse) / 3) < 0.001
    assert abs(fine) < 0.0015


@pytest.mark.parametrize("case", parameters(WIDE))
def test_sweep_of_wide_emitters(case):
    """With emitters wider than the medium, a resolution of 64 is not within 0.1 %, 96 is."""
    settings = {"solver": "sweep", "cache_spp": 32}
    coarse, fine = (error(case, exact(case), resolution=n, **settings) for n in (64, 96))
    assert abs(coarse) < 0.004
    assert abs(fine) < 0.001


@pytest.mark.parametrize("case", parameters(SWEEP))
def test_sweep(case):
    resolution, samples, bound = SWEEP[case]
    settings = {"solver": "sweep", "resolution": resolution, "cache_spp": samples}
    assert abs(error(case, exact(case), **settings)) < bound


@pytest.mark.parametrize("case", parameters(PATH, SLOW_PATH))
def test_path(case):
    resolution, samples, bound = PATH[case]
    settings = {"solver": "path", "resolution": resolution, "cache_spp": samples}
    assert abs(error(case, exact(case), **settings)) < bound


@pytest.mark.parametrize("case", parameters(ORDERS))
def test_all_orders(case):
    resolution, samples, bound = ORDERS[case]
    expected, noise = orders(case, 1 << 21)
    assert noise < bound / 2 * expected, "too noisy to say"
    settings = {"solver": "sweep", "resolution": resolution, "cache_spp": samples}
    assert abs(error(case, expected, **settings)) < bound


@pytest.mark.parametrize(
    "case", [Case("directional", "hg 0.58"), Case("constant", "rayleigh", "3x5x2")]
)
def test_the_references_agree(case):
    """The two references agree: quadrature, and paths that end after their first collision."""
    expected, noise = orders(case, 1 << 20, with_control=False)
    assert noise < 2e-3 * expected, "too noisy to say"
    assert abs(expected - exact(case)) < 3 * noise
