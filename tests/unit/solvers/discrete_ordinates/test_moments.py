"""Angular moments of the radiance along tracks: one direction, furnace, operator norm."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.phase import Phase
from mitsuba_irrcache.solvers.discrete_ordinates import tracks
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import hemisphere_ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.moments import AnisotropicMultigridLevel, Moments
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

pytestmark = pytest.mark.usefixtures("rgb")

SIDES = (6, 9, 7)


@pytest.fixture(params=["together", "apart"], autouse=True)
def mode(request, monkeypatch):
    """Launch all pairs of directions at once, or one by one."""
    if request.param == "apart":
        monkeypatch.setattr(tracks, "SMALL_GRID", 0)
        monkeypatch.setattr(tracks, "MAX_COPIED_VOXELS", 1)


def moments_of(g: float, order: int) -> Moments:
    phase = Phase(None, g ** np.arange(32), 1.0)
    return Moments(AngularBasis(phase, []), order)


def values(flat: mi.Float, count: int) -> np.ndarray:
    return np.array(flat, dtype=np.float64).reshape(count, -1)


def matter(seed: int = 0, empty: float = 0.0) -> np.ndarray:
    """Return an extinction (z, y, x) with some empty voxels."""
    rng = np.random.default_rng(seed)
    sigma_t = rng.uniform(0.5, 8.0, SIDES)
    return np.float32(np.where(rng.random(SIDES) < empty, 0, sigma_t))


def lines(sigma_t: np.ndarray) -> Tracks:
    grid = Grid(sigma_t.shape, np.diag([1.4, 1.8, 1.2, 1]))
    return Tracks(grid, mi.Float(sigma_t.ravel().tolist()), np.zeros(3, int), grid.resolution)


def level(sigma_t: np.ndarray, albedo: float, moments: Moments | None) -> MultigridLevel:
    of_matter = lines(sigma_t)
    number = of_matter.active_count
    fields = (mi.Float(v.ravel().tolist()) for v in (sigma_t, np.full(number, albedo)))
    arguments = *fields, of_matter
    return (
        MultigridLevel(*arguments)
        if moments is None
        else AnisotropicMultigridLevel(*arguments, moments=moments)
    )


def rows(pairs: int, light: float = 0.0, seed: int = 1) -> tuple[np.ndarray, ...]:
    """Return ordinates along all of which the same radiance enters."""
    rng = np.random.default_rng(seed)
    directions, weights = hemisphere_ordinates(pairs, rng)
    entering = np.repeat(light * weights[:, None], 2, axis=1)
    return directions, entering, weights, rng.random((pairs, 2))


def test_moments_of_one_direction():
    """Moments of a single direction are its irradiance times the spherical harmonics."""
    moments, of_matter = moments_of(0.5, 4), lines(matter())
    way = np.array([[0.3, -0.5, 0.6]]) / np.sqrt(0.7)
    offsets = np.array([[0.2, 0.7]])
    for light, sign in (([1.0, 0.0], -1), ([0.0, 1.0], 1)):
        entering = way, np.array([light]), offsets
        found = values(moments.sweep_uncollided(of_matter, *entering), moments.count)
        irradiance = np.array(of_matter.uncollided(*entering))
        basis = np.ravel(
            [np.array(y) for y in moments.basis(mi.Vector3f((sign * way[0]).tolist()))]
        )
        np.testing.assert_allclose(found, basis[:, None] * irradiance, atol=2e-6)


def test_isotropic_scattering_equals_the_multigrid_level():
    """Without higher moments, scattering is that of `MultigridLevel`."""
    sigma_t, none = matter(empty=0.3), moments_of(0.0, 1)
    isotropic, directional = level(sigma_t, 0.8, None), level(sigma_t, 0.8, none)
    rng = np.random.default_rng(4)
    phi = rng.uniform(0, 1, sigma_t.size)
    table = rows(12, 1.0)
    expected = isotropic.sweep(mi.Float(phi.tolist()), isotropic.tracks.table(*table))
    several = np.concatenate([phi, rng.normal(size=3 * sigma_t.size)])
    found = directional.sweep(mi.Float(several.tolist()), directional.tracks.table(*table))
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_allclose(values(b, 4)[0], np.array(a), rtol=2e-5)


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("scale", [0.1, 5.0, 100.0])
def test_furnace(order, scale):
    """Without absorption a constant radiance is preserved: irradiance 4 pi, higher moments 0.

    This holds for the incoming radiance and for collisions.
    """
    moments = moments_of(0.5, order)
    white = level(matter() * np.float32(scale), 1.0, moments)
    phi = np.zeros((moments.count, white.grid.voxel_count))
    phi[0] = 4 * np.pi
    table = white.tracks.table(*rows(16, 1.0))
    for found in white.sweep(mi.Float(phi.ravel().tolist()), table):
        np.testing.assert_allclose(
            values(found, moments.count) / (4 * np.pi), phi / (4 * np.pi), atol=2e-3
        )


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_scattering_without_absorption_decays(order):
    """With albedo 1 and many empty voxels, repeatedly scattered radiance decays.

    Tracks without medium in a voxel in which others have some must not contribute to it.
    """
    moments = moments_of(0.58, order)
    white = level(matter(seed=2, empty=0.6), 1.0, moments)
    table = white.tracks.table(*rows(16))
    phi = np.random.default_rng(5).normal(size=(moments.count, white.grid.voxel_count))
    sizes = []
    for _ in range(40):
        phi = values(white.sweep(mi.Float(phi.ravel().tolist()), table)[1], moments.count)
        sizes.append(np.linalg.norm(phi))
    assert sizes[-1] / sizes[-2] < 0.97


def test_multigrid_solves_the_equation():
    """The multigrid solution satisfies phi = A phi + b."""
    rng = np.random.default_rng(7)
    grid = Grid((24, 24, 24), np.diag([1.0, 1, 1, 1]))
    sigma_t = mi.Float(rng.uniform(0, 40, grid.voxel_count).tolist())
    box = Tracks(grid, sigma_t, np.zeros(3, int), grid.resolution)
    moments = moments_of(0.5, 2)
    albedo = dr.full(mi.Float, 0.99, grid.voxel_count)
    white = AnisotropicMultigridLevel(sigma_t, albedo, box, moments=moments)
    table = rows(16, 1.0)
    _, b = white.sweep(None, box.table(*table))
    directions, _, weights, offsets = table
    dark = directions, np.zeros((16, 2)), weights, offsets
    phi = white.solve(b, dark)
    image = white.sweep(phi, box.table(*dark))[1] + b
    phi, image = np.array(phi), np.array(image)
    assert np.abs(image - phi).mean() < 2e-3 * np.abs(phi).mean()
    assert phi[: grid.voxel_count].mean() > 2 * np.array(b)[: grid.voxel_count].mean()
