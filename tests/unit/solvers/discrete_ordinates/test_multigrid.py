"""The multigrid solution for all orders of scattering, with several channels per track."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates import multigrid, tracks
from mitsuba_irrcache.solvers.discrete_ordinates.anderson import AndersonAcceleration, accelerated
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import hemisphere_ordinates
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import BoundarySource
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE, VOXELS, PAIRS = (9, 8, 10), 720, 6


@pytest.fixture(params=["together", "apart"], autouse=True)
def mode(request, monkeypatch):
    """Launch all directions at once, or one by one; three levels."""
    monkeypatch.setattr(multigrid, "COARSEST", 4)
    if request.param == "apart":
        monkeypatch.setattr(tracks, "SMALL_GRID", 0)


@pytest.fixture
def random():
    return np.random.default_rng(5)


def level(random, evenly: bool):
    """Return a function that makes a level of the given channels, and their albedos."""
    sigma_t = mi.Float(random.uniform(0, 20, VOXELS).tolist())
    albedos = random.uniform(0.5, 1, (3, VOXELS))
    grid = Grid(SHAPE, np.eye(4))
    tracks = Tracks(grid, sigma_t, np.zeros(3, int), grid.resolution)

    def of(*channels: int) -> MultigridLevel:
        return MultigridLevel(sigma_t, flat(albedos[list(channels)]), tracks, evenly)

    return of


def rows(random) -> tuple:
    """Return directions without incoming radiance, weights and offsets."""
    directions, weights = hemisphere_ordinates(PAIRS, random)
    return directions, np.zeros((PAIRS, 2)), weights, random.random((PAIRS, 2))


def flat(values: np.ndarray) -> mi.Float:
    """Concatenate channels (n, voxels)."""
    return mi.Float(values.T.ravel().tolist())


def stacked(values: mi.Float) -> np.ndarray:
    return np.array(values).reshape(VOXELS, -1).T


def test_channels_of_a_sweep_do_not_mix(random):
    """Channels that share a sweep do not mix, also with incoming radiance."""
    of, of_rows = level(random, False), rows(random)
    phi = random.uniform(0, 3, (3, VOXELS))
    phi[1] *= 1e-3
    light = random.uniform(0, 1, (3, 2 * PAIRS))
    # One boundary cell with two values per pair; its tracks are all inside.
    places = np.tile([1e-4, 0.5, 0.5, 0, 0], (PAIRS, 1))
    cells = np.column_stack([2 * np.arange(PAIRS), np.ones(PAIRS, int), np.ones(PAIRS, int)])

    def scattered(channels: list[int]) -> list[np.ndarray]:
        some = of(*channels)
        table = some.tracks.table(*of_rows)
        values = mi.Float(light[channels].ravel().tolist())
        table.boundary_source = Arriving(places, cells, values, len(channels))
        return [stacked(values) for values in some.sweep(flat(phi[channels]), table)]

    together, alone = scattered([0, 1, 2]), [scattered([c]) for c in range(3)]
    for kind in range(2):
        expected = np.concatenate([one[kind] for one in alone])
        np.testing.assert_allclose(together[kind], expected, rtol=1e-5)
        assert (np.abs(expected[0] / expected[1] - 1) > 0.1).any()


class Arriving(BoundarySource):
    """Incoming radiance that does not depend on phi."""

    def update(self, phi: mi.Float) -> None:
        """Ignore phi."""


@pytest.mark.parametrize("evenly", [False, True])
def test_channels_solved_together_equal_separate_solutions(random, evenly):
    """Three channels solved together equal separate solutions within the tolerance of each.

    One channel is nearly dark, and one is zero.
    """
    of, of_rows = level(random, evenly), rows(random)
    b = random.uniform(0, 3, (3, VOXELS))
    b[1] *= 1e-4
    b[2] = 0
    together = stacked(of(0, 1, 2).solve(flat(b), of_rows))
    for c in range(3):
        alone = stacked(of(c).solve(flat(b[[c]]), of_rows))[0]
        assert np.abs(together[c] - alone).sum() <= 2 * multigrid.TOLERANCE * alone.sum()
        assert alone.sum() >= 1.2 * b[c].sum()


def test_unscattered_radiance_is_carried_in_all_channels(random):
    """Unscattered radiance is carried in all channels as in each alone, including sharpening."""
    of, (directions, dark, _, offsets) = level(random, False), rows(random)
    light = random.uniform(0, 1, (3, 2 * PAIRS))
    places = np.tile([1e-4, 0.5, 0.5, 0, 0], (PAIRS, 1))
    cells = np.column_stack([2 * np.arange(PAIRS), np.ones(PAIRS, int), np.ones(PAIRS, int)])

    def carried(channels: list[int]) -> np.ndarray:
        values = mi.Float(light[channels].ravel().tolist())
        entering = BoundarySource(places, cells, values, len(channels))
        carry = of(0).tracks.uncollided
        return np.array(carry(directions, dark, offsets, lambda _: entering)).reshape(-1, VOXELS)

    together = carried([0, 1, 2])
    np.testing.assert_allclose(
        together, np.concatenate([carried([c]) for c in range(3)]), rtol=1e-5
    )
    assert together.shape == (3, VOXELS)
    assert together.min() > 0


@pytest.mark.parametrize("evenly", [False, True])
def test_solution_needs_occupied_voxels_only(random, evenly):
    """In a mostly empty grid, the solution on occupied voxels equals that on the whole grid.

    All orders of scattering agree within the tolerance of each.
    """
    matter = np.zeros(SHAPE)
    matter[1:4, 2:5, 3:9] = random.uniform(0, 30, (3, 3, 6))
    around = np.zeros(SHAPE, bool)
    around[0:5, 1:6, 2:10] = True
    index = np.flatnonzero(around)
    grid, of_rows = Grid(SHAPE, np.eye(4)), rows(random)
    sigma_t, b = matter.ravel(), random.uniform(0, 3, (VOXELS, 2))
    albedo = random.uniform(0.5, 1, (VOXELS, 2))
    found = []
    for wanted in (np.arange(VOXELS), index):
        all_matter = mi.Float(sigma_t.tolist())
        tracks = Tracks(
            grid, all_matter, np.zeros(3, int), grid.resolution,
            active=mi.UInt32(wanted.tolist()), sparse=len(wanted) < VOXELS,
        )  # fmt: skip
        fields = (mi.Float(f[wanted].ravel().tolist()) for f in (sigma_t, albedo))
        some = MultigridLevel(*fields, tracks, evenly)
        phi = some.solve(mi.Float(b[wanted].ravel().tolist()), of_rows)
        received = some.sweep(phi, tracks.table(*of_rows))[0]
        found.append([np.array(v).reshape(-1, 2) for v in (phi, received)])
    for whole, part in zip(*found, strict=True):
        whole = whole[index]
        dense = sigma_t[index] > 0
        difference = np.abs(whole - part)[dense].sum(axis=0)
        assert (difference < 2 * multigrid.TOLERANCE * whole[dense].sum(axis=0)).all()
    assert found[1][0].mean() > b.mean()


def test_anderson_acceleration_removes_a_slow_error():
    """Anderson acceleration removes a slowly decaying error.

    Two channels whose errors decay by 0.9 and by 0.3 per step are solved by the third step.
    """
    solution, phi = mi.Float([3.0, 5.0] * 4), mi.Float([0.0, 1.0] * 4)
    rates, mixing = mi.Float([0.9, 0.3] * 4), AndersonAcceleration(by_channel)
    for _ in range(2):
        phi = mixing.next(phi, solution + rates * (phi - solution))
    np.testing.assert_allclose(phi, solution, rtol=1e-5)


def by_channel(integrand: Callable, *fields: mi.Float) -> np.ndarray:
    return np.array(integrand(*fields)).reshape(-1, 2).sum(axis=0)


def test_anderson_acceleration_of_several_steps():
    """With as many earlier steps as there are unknowns, a linear iteration is solved exactly, for
    each channel by itself; also from a single step, and where a residual is repeated.
    """
    random = np.random.default_rng(3)
    matrices = 0.3 * random.normal(size=(2, 3, 3))
    solution = random.uniform(1, 2, (2, 3))
    phi, images, residuals = np.zeros((2, 3)), [], []
    for _ in range(4):
        image = solution + np.einsum("cij,cj->ci", matrices, phi - solution)
        images, residuals = [*images, image], [*residuals, image - phi]
        phi = accelerated(np.array(images), np.array(residuals))
        assert np.isfinite(phi).all()
    np.testing.assert_allclose(phi, solution, rtol=1e-6)
    np.testing.assert_array_equal(accelerated(np.array([image]), np.array([image - phi])), image)
    twice = accelerated(np.array([image, image]), np.array([image - phi] * 2))
    np.testing.assert_array_equal(twice, image)
