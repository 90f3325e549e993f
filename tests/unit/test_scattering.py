"""All orders of scattering: light of several channels that goes the same ways."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grid import Grid
from mitsuba_irrcache.solvers import lattice, scattering
from mitsuba_irrcache.solvers.directions import spread
from mitsuba_irrcache.solvers.lattice import Lattice
from mitsuba_irrcache.solvers.scattering import Level
from mitsuba_irrcache.solvers.table import Entering

pytestmark = pytest.mark.usefixtures("rgb")

SHAPE, VOXELS, PAIRS = (9, 8, 10), 720, 6


@pytest.fixture(params=["together", "apart"], autouse=True)
def mode(request, monkeypatch):
    """One launch for all directions, or one for each; three levels."""
    monkeypatch.setattr(scattering, "COARSEST", 4)
    if request.param == "apart":
        monkeypatch.setattr(lattice, "SMALL", 0)


@pytest.fixture
def random():
    return np.random.default_rng(5)


def level(random, evenly: bool):
    """A function that makes a level of the channels that it is given, and their albedos."""
    sigma_t = mi.Float(random.uniform(0, 20, VOXELS).tolist())
    albedos = random.uniform(0.5, 1, (3, VOXELS))
    grid = Grid(SHAPE, np.eye(4))
    lines = Lattice(grid, sigma_t, np.zeros(3, int), grid.resolution)

    def of(*channels: int) -> Level:
        albedo = mi.Float(albedos[list(channels)].ravel().tolist())
        return Level(grid, sigma_t, albedo, lines, evenly)

    return of


def rows(random) -> tuple:
    """Directions, weights and offsets."""
    directions, weights = spread(PAIRS, random)
    return directions, weights, random.random((PAIRS, 2))


def stacked(values: mi.Float) -> np.ndarray:
    return np.array(values).reshape(-1, VOXELS)


def test_channels_that_are_swept_together_do_not_mix(random):
    """Each is what it is alone, with light that arrives along the lines besides."""
    of, (directions, weights, offsets) = level(random, False), rows(random)
    phi = random.uniform(0, 3, (3, VOXELS))
    phi[1] *= 1e-3
    light = random.uniform(0, 1, (3, 2 * PAIRS))
    # One cell with two values for each pair: its lines are all within.
    places = np.tile([1e-4, 0.5, 0.5, 0, 0], (PAIRS, 1))
    cells = np.column_stack([2 * np.arange(PAIRS), np.ones(PAIRS, int), np.ones(PAIRS, int)])

    def scattered(channels: list[int]) -> list[np.ndarray]:
        some = of(*channels)
        table = some.lattice.table(directions, np.zeros((PAIRS, 2)), weights, offsets)
        values = mi.Float(light[channels].ravel().tolist())
        table.entering = Arriving(places, cells, values, len(channels))
        return [
            stacked(values)
            for values in some.scatter(mi.Float(phi[channels].ravel().tolist()), table)
        ]

    together, alone = scattered([0, 1, 2]), [scattered([c]) for c in range(3)]
    for kind in range(2):
        expected = np.concatenate([one[kind] for one in alone])
        np.testing.assert_allclose(together[kind], expected, rtol=1e-5)
        assert (np.abs(expected[0] / expected[1] - 1) > 0.1).any()


class Arriving(Entering):
    """Light that does not depend on phi."""

    def receive(self, phi: mi.Float) -> None:
        """Nothing."""


@pytest.mark.parametrize("evenly", [False, True])
def test_channels_are_solved_together_as_alone(random, evenly):
    """Three, of which one is nearly dark and one has no light at all: within what is left of the
    error of each.
    """
    of, of_rows = level(random, evenly), rows(random)
    b = random.uniform(0, 3, (3, VOXELS))
    b[1] *= 1e-4
    b[2] = 0
    together = stacked(of(0, 1, 2).solve(mi.Float(b.ravel().tolist()), *of_rows))
    for c in range(3):
        alone = stacked(of(c).solve(mi.Float(b[c].tolist()), *of_rows))[0]
        assert np.abs(together[c] - alone).sum() <= 2 * scattering.TOLERANCE * alone.sum()
        assert alone.sum() >= 1.2 * b[c].sum()


def test_light_without_voxels_sending_is_carried_in_all_channels(random):
    """Straight along the lines, sharpened: each channel as alone."""
    of, (directions, _, offsets) = level(random, False), rows(random)
    light = random.uniform(0, 1, (3, 2 * PAIRS))
    places = np.tile([1e-4, 0.5, 0.5, 0, 0], (PAIRS, 1))
    cells = np.column_stack([2 * np.arange(PAIRS), np.ones(PAIRS, int), np.ones(PAIRS, int)])

    def carried(channels: list[int]) -> np.ndarray:
        values = mi.Float(light[channels].ravel().tolist())
        entering = Entering(places, cells, values, len(channels))
        dark = np.zeros((PAIRS, 2))
        return stacked(of(0).lattice.carry(directions, dark, offsets, lambda _: entering))

    together = carried([0, 1, 2])
    np.testing.assert_allclose(
        together, np.concatenate([carried([c]) for c in range(3)]), rtol=1e-5
    )
    assert together.shape == (3, VOXELS)
    assert together.min() > 0
