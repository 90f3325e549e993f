"""Error estimates of lookups: noise as random probes, bias from half the resolution.

The caches are filled by hand, so that every voxel's value and standard error are known; expected
values are computed in NumPy.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.uncertainty import PROBES, UncertaintyField, uncertainty_of
from mitsuba_irrcache.cache.volume import BATCH, IrradianceCache
from mitsuba_irrcache.grids.grid import Grid

pytestmark = pytest.mark.usefixtures("rgb")

UNIT = np.eye(4)


def cache_of(batches: np.ndarray, shape, to_world=UNIT, active=None) -> IrradianceCache:
    """Return a cache whose batches have these means, (batch, active voxel[, 3])."""
    batches = np.asarray(batches, dtype=np.float64)
    if batches.ndim == 2:
        batches = np.repeat(batches[..., None], 3, axis=2)
    index = np.arange(np.prod(shape)) if active is None else active
    cache = IrradianceCache(Grid(shape, to_world), mi.UInt32(np.uint32(index)), 3, -1)
    double = dr.float64_array_t(mi.Float)
    totals = [double(batches[..., c].sum(axis=0)) for c in range(3)]
    spreads = [double(batches[..., c].var(axis=0) * len(batches)) for c in range(3)]
    nothing = [None] * 3  # scattered layer
    cache.add(0, BATCH * len(batches), [((*totals, *nothing), spreads)])
    return cache


def with_error(phi: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return two batches with exactly this mean and standard error of the mean."""
    return np.array([phi - error, phi + error])


def errors_at(cache: IrradianceCache, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return luminance, relative probes (k, n) and relative bias (n) at world points (n, 3)."""
    p = mi.Point3f(np.float32(points.T))
    phi = cache.field().at_world(p)
    *probes, bias = (np.float64(e) for e in uncertainty_of(cache).at_world(p, phi, mi.Bool(True)))
    light = np.float64(phi) if isinstance(phi, mi.Float) else np.float64(mi.luminance(phi))
    return light, np.array(probes) * light, bias * light


def trilinear(points: np.ndarray, shape, to_world) -> tuple[np.ndarray, np.ndarray]:
    """Return flat indices and weights (n, 8) of the voxels around world points (n, 3)."""
    counts = np.array(shape)[::-1]
    inverse = np.linalg.inv(to_world)
    local = points @ inverse[:3, :3].T + inverse[:3, 3]
    u = np.clip(local * counts - 0.5, 0, counts - 1)
    low = np.minimum(u.astype(int), counts - 2)
    share = u - low
    index, weight = [], []
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (low + corner).T
        index.append((z * counts[1] + y) * counts[0] + x)
        weight.append(np.prod(np.where(corner, share, 1 - share), axis=1))
    return np.array(index).T, np.array(weight).T


def inside(to_world: np.ndarray, count: int, margin: float = 0.0, seed: int = 1) -> np.ndarray:
    """Return random world points (n, 3) in a grid, ``margin`` of its edges away from its faces."""
    local = np.random.default_rng(seed).uniform(margin, 1 - margin, (count, 3))
    return local @ to_world[:3, :3].T + to_world[:3, 3]


# Noise


def white(n: int) -> np.ndarray:
    return np.ones((n, 3))


def varied(n: int) -> np.ndarray:
    """Return a grey field whose neighbours differ by up to a factor of 10."""
    return np.exp(np.random.default_rng(2).uniform(-1.15, 1.15, (n, 1))) * np.ones(3)


def saturated(n: int) -> np.ndarray:
    """Return an almost purely red field: the root of the mean is far from the mean of the roots."""
    return varied(n) * [1.0, 0.02, 0.02]


@pytest.mark.parametrize("light", [white, varied, saturated])
def test_probes_have_the_variance_of_interpolated_noise(scenes, light):
    """Probes have the variance of interpolated independent voxel errors.

    The mean square of the probes at random points is compared with sum_i w_i^2 e_i^2, to first
    order in the errors e_i of the voxels and through roots, computed in NumPy; away from the
    outermost half voxel.

    The ratio is known to 1.4 % (8000 voxels, 4 signs each); a sum of |w_i e_i| is wrong by a factor
    of 3, weights not squared by 3, a wrong root of coloured radiance by 2.
    """
    shape, to_world = (20, 16, 25), scenes.placement((2.0, 1.0, 1.5), turn=25)
    n = int(np.prod(shape))
    phi = light(n)
    relative = np.random.default_rng(3).uniform(0.01, 0.1, (n, 1))
    cache = cache_of(with_error(phi, phi * relative), shape, to_world)
    # The margin is half a voxel, beyond which values are extrapolated.
    points = inside(to_world, 20000, margin=0.04)
    brightness, probes, _ = errors_at(cache, points)
    index, weight = trilinear(points, shape, to_world)
    root = np.sqrt(phi[:, 0])
    shares = weight * (root * relative[:, 0])[index]
    deviation = np.sqrt((shares**2).sum(axis=1)) / (weight * root[index]).sum(axis=1)
    expected = np.mean((deviation * brightness) ** 2)
    assert np.mean(probes**2) == pytest.approx(expected, rel=0.06)


def test_probes_have_the_variance_of_lookups_at_the_border():
    """In the outermost half voxel, probes have the standard deviation of lookups in 96 caches.

    All caches have the same field with 5 % of noise. Values there are extrapolated, which increases
    their noise (here by 1.6 in all). The ratio of deviations is known to 2 %; errors clamped where
    the field is extrapolated are 1.3 to 1.5 times too small.
    """
    n, rng = 10, np.random.default_rng(6)
    phi = at_centers(lambda p: np.exp(-3 * p[:, 0]), n)
    points = inside(UNIT, 6000)
    points = points[(np.abs(points - 0.5) > 0.45).any(axis=1)]
    p = mi.Point3f(np.float32(points.T))
    lookups, probes = [], []
    for _ in range(96):
        draws = phi * (1 + 0.05 * np.sqrt(2) * rng.normal(size=(2, n**3)))
        lookups.append(np.float64(cache_of(draws, (n, n, n)).field().at_world(p)))
    probes = errors_at(cache_of(with_error(phi, 0.05 * phi), (n, n, n)), points)[1]
    scatter = np.sqrt(np.var(lookups, axis=0, ddof=1).mean())
    assert np.sqrt(np.mean(probes**2)) == pytest.approx(scatter, rel=0.15)


def signs(cache: IrradianceCache) -> np.ndarray:
    """Return the probes at the voxel centres in units of the standard error, (probe, z, y, x)."""
    index = mi.UInt32(np.arange(cache.grid.voxel_count, dtype=np.uint32))
    centers = np.array(cache.grid.centers(index)).T
    _, probes, _ = errors_at(cache, centers)
    error = np.float64(np.array(cache.standard_error)[..., 0]).ravel()
    return (probes / error).reshape(PROBES, *cache.grid.shape)


@pytest.fixture
def plain() -> IrradianceCache:
    """Return a cache of 16^3 voxels with some noise in each."""
    error = np.random.default_rng(4).uniform(0.005, 0.02, 16**3)
    return cache_of(with_error(np.ones(16**3), error), (16, 16, 16))


def test_a_probe_at_a_voxel_is_its_standard_error(plain):
    """The probe at a voxel centre is the standard error up to its sign.

    The bits that store the signs must not remain in the value (they are worth 2^-19).
    """
    np.testing.assert_allclose(np.abs(signs(plain)), 1, rtol=1e-4)


def test_probe_signs_are_balanced_and_independent(plain):
    """Signs are balanced, and independent between probes and between neighbours.

    Correlations of 24 kinds are each within 4.5 standard deviations of 0 (chance of a false alarm
    2e-4 in all). Probes that are all equal, or each other's negatives, are at 64 deviations.
    """
    sign = np.sign(signs(plain))
    means = [s.mean() for s in sign]
    means += [(sign[i] * sign[j]).mean() for i in range(PROBES) for j in range(i)]
    means.append(np.prod(sign, axis=0).mean())
    means += [(s * np.roll(s, 1, axis)).mean() for s in sign for axis in range(3)]
    means.append((sign[0] * np.roll(sign[1], 1, 2)).mean())
    assert np.abs(means).max() < 4.5 / np.sqrt(sign[0].size)


def test_probes_of_a_cache_are_constant(plain):
    """The probes of a cache are the same each time.

    Otherwise noise images would flicker, and the strength of the filter would vary between frames.
    """
    np.testing.assert_array_equal(signs(plain), signs(plain))


# Bias


def at_centers(function, n: int) -> np.ndarray:
    c = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    return function(np.stack([x, y, z], axis=-1).reshape(-1, 3))


def squared_distance(p: np.ndarray) -> np.ndarray:
    return ((p - 0.5) ** 2).sum(axis=1)


FIELDS = {
    "quadratic": lambda p: 1 + 4 * squared_distance(p),
    "Gaussian": lambda p: np.exp(-8 * squared_distance(p)),
    "exponential": lambda p: np.exp(-6 * p[:, 0]),
    "along one axis": lambda p: 2 + np.cos(6 * p[:, 1]),
}


def bias_of(function, n: int, noise: float = 0.0, seed: int = 0) -> tuple[float, float, float]:
    """Return predicted and true mean error of lookups away from the border, and the mean value."""
    rng = np.random.default_rng(seed)
    phi = at_centers(function, n)
    draws = np.clip(rng.normal(size=(2, n**3)), -3, 3)
    cache = cache_of(phi * (1 + noise * draws), (n, n, n))
    points = inside(UNIT, 50000, margin=0.2)
    light, _, bias = errors_at(cache, points)
    truth = function(points)
    return bias.mean(), (light - truth).mean(), truth.mean()


@pytest.mark.parametrize("function", FIELDS.values(), ids=FIELDS)
def test_bias_of_a_smooth_field(function):
    """The mean error of lookups in a smooth field is predicted within 10 % with 24 voxels an
    edge.

    An error of sign, of the ratio of the resolutions (4 instead of 6), or averages of Phi instead
    of its roots (25 % on the exponential) fail.
    """
    predicted, true, mean = bias_of(function, 24)
    assert abs(true) > 1e-4 * mean
    assert predicted == pytest.approx(true, rel=0.1)


def test_no_bias_of_a_constant():
    """A constant field has no bias, at the border neither."""
    cache = cache_of(np.full((2, 5 * 6 * 7), 0.7), (5, 6, 7))
    _, _, bias = errors_at(cache, inside(UNIT, 1000))
    assert np.abs(bias).max() < 1e-6


def test_noise_is_not_mistaken_for_bias():
    """Noise is not mistaken for bias.

    With a standard error of 20 % per voxel, products of one noise with itself would be taken for a
    bias of some 0.4 %, unless numerator and denominator are balanced. Known to 0.03 %.
    """
    n = 24
    biases = [bias_of(lambda p: np.ones(len(p)), n, 0.2 * np.sqrt(2), seed)[0] for seed in range(4)]
    assert np.std(biases, ddof=1) / 2 < 3e-4
    assert abs(np.mean(biases)) < 1.5e-3


# Inactive and dark voxels


def test_inactive_voxels_do_not_leak():
    """Inactive voxels, whose value is zero, do not affect the bias of their neighbours.

    A comparison with the zeros would give a bias of more than 10 %.
    """
    shape = (7, 8, 9)
    z, y, x = np.indices(shape)
    lit = ((z - 3) ** 2 + (y - 4) ** 2 + (x - 4) ** 2 < 8).ravel()
    active = np.flatnonzero(lit)
    batches = with_error(np.full(len(active), 0.8), np.full(len(active), 0.01))
    cache = cache_of(batches, shape, active=active)
    index = mi.UInt32(np.arange(lit.size, dtype=np.uint32))
    light, probes, bias = errors_at(cache, np.array(cache.grid.centers(index)).T)
    assert max(np.abs(e[..., ~lit]).max() for e in (light, probes, bias)) < 1e-5
    np.testing.assert_allclose(np.abs(probes[:, lit]), 0.01, rtol=1e-4)
    assert np.abs(bias[lit]).max() < 1e-6


@pytest.mark.parametrize("shape", [(6, 6, 6), (1, 1, 5), (1, 1, 1), (3, 1, 2)])
def test_dark_voxels_give_no_nan(shape):
    """Phi = 0 in some or all active voxels, and beyond the grid's faces, gives no NaN."""
    n = int(np.prod(shape))
    rng = np.random.default_rng(5)
    levels = [0.0, 0.0, 1e-35, 1e-20, 1.0, 1e6]
    p = mi.Point3f(np.float32(inside(UNIT, 500, margin=-0.2).T))
    phi = mi.Float(np.float32(rng.choice(levels, 500)))
    for values in (rng.choice(levels, n), np.zeros(n), np.full(n, 1e-38)):
        field = uncertainty_of(cache_of(with_error(values, 0.5 * values), shape))
        for light in (phi, mi.Color3f(phi, 0, 0)):
            for relative in field.at_world(p, light, mi.Bool(True)):
                assert np.isfinite(np.array(relative * light)).all()


def test_masked_lanes_read_nothing():
    """Masked lanes of a lookup read nothing, as in a ray march, where their position is
    arbitrary.
    """
    cache = cache_of(np.ones((2, 8)), (2, 2, 2))
    field: UncertaintyField = uncertainty_of(cache)
    far = mi.Point3f([0.5, 1e30, np.nan], 0.5, 0.5)
    active = mi.Bool([True, False, False])
    errors = field.at_world(far, mi.Float([1.0, 0.0, 0.0]), active)
    assert len(errors) == field.count == PROBES + 1
    assert all(np.isfinite(np.array(e)[0]) for e in errors)
