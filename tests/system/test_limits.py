"""Images converge to the exact ones: coarse grids of high contrast, each emitter and phase function,
both solvers. The references are those of experiments/limits: quadrature of single scattering, and
paths of all orders, without any code of irrcache.
"""

from __future__ import annotations

from functools import lru_cache

import mitsuba as mi
import numpy as np
import pytest

from experiments.limits.cases import Case
from experiments.limits.reference import orders, single

pytestmark = pytest.mark.usefixtures("mono")

SPP = 64
#: Point-like lights, and phase functions: their light has hardly any noise with ``sweep``.
POINTS = "point outside", "point beside", "point inside", "spot wide", "spot narrow"
PHASES = "isotropic", "hg 0.3", "hg 0.6", "hg -0.4", "rayleigh"
#: Resolution, samples per voxel, and the largest relative error of the mean: 0.1 % where so many
#: voxels leave no more, and where the noise of the directions is small enough.
SWEEP = {
    Case("directional"): (128, 256, 0.001),
    Case("directional", "hg 0.6"): (80, 32, 0.003),
    Case("constant"): (96, 512, 0.003),
    Case("constant", "rayleigh"): (64, 512, 0.003),
    Case("rectangle far"): (64, 512, 0.003),
    Case("rectangle near"): (64, 512, 0.003),
    Case("sphere near"): (64, 512, 0.003),
    Case("disk near"): (64, 512, 0.003),
    Case("point outside", grid="3x5x2"): (64, 32, 0.001),
    Case("point outside", grid="1x1x6"): (64, 32, 0.001),
}
PATH = {
    Case("constant"): (64, 64, 0.003),
    Case("point inside"): (64, 64, 0.002),
    Case("point outside"): (64, 64, 0.003),
    Case("rectangle near"): (64, 64, 0.003),
}
#: Of all orders, by ``sweep``.
ORDERS = {
    Case("constant", max_depth=-1): (64, 128, 0.003),
    Case("point outside", "hg 0.6", max_depth=-1): (48, 128, 0.003),
}


@lru_cache
def exact(case: Case) -> float:
    """The mean of the image of single scattering."""
    return single(case, 4, 1 if case.has_direction else 32, 64).mean()


def error(case: Case, expected: float, **integrator) -> float:
    """The relative error of the mean of the image."""
    image = mi.render(case.scene(**integrator), spp=SPP)
    return float(np.mean(np.array(image)[..., 0], dtype=np.float64) / expected - 1)


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("emitter", POINTS)
def test_sweep_of_point_like_lights(emitter, phase):
    """Errors fall with the square of the resolution: what those of two leave in the limit, and at
    the finer one.
    """
    case = Case(emitter, phase)
    settings = {"solver": "sweep", "cache_spp": 32}
    coarse, fine = (error(case, exact(case), resolution=n, **settings) for n in (32, 64))
    assert abs(fine + (fine - coarse) / 3) < 0.001
    assert abs(fine) < 0.0015


@pytest.mark.parametrize("case", SWEEP, ids=lambda case: case.name)
def test_sweep(case):
    resolution, samples, bound = SWEEP[case]
    settings = {"solver": "sweep", "resolution": resolution, "cache_spp": samples}
    assert abs(error(case, exact(case), **settings)) < bound


@pytest.mark.parametrize("case", PATH, ids=lambda case: case.name)
def test_path(case):
    resolution, samples, bound = PATH[case]
    settings = {"solver": "path", "resolution": resolution, "cache_spp": samples}
    assert abs(error(case, exact(case), **settings)) < bound


@pytest.mark.parametrize("case", ORDERS, ids=lambda case: case.name)
def test_all_orders(case):
    resolution, samples, bound = ORDERS[case]
    expected, noise = orders(case, 1 << 21)
    assert noise < bound / 3 * expected, "too noisy to say"
    settings = {"solver": "sweep", "resolution": resolution, "cache_spp": samples}
    assert abs(error(case, expected, **settings)) < bound


def test_the_references_agree():
    """Quadrature, and paths that end after their first collision but for the control variate."""
    case = Case("directional", "hg 0.6", max_depth=2)
    expected, noise = orders(case, 1 << 16)
    assert expected == pytest.approx(exact(case), rel=1e-3)
    assert noise < 1e-3 * expected
