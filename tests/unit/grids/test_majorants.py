"""Macrocells: bounds that hold everywhere, and a traversal that visits every cell."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.majorants import Macrocells

pytestmark = pytest.mark.usefixtures("rgb")

UNIT = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])


def cells_of(shape, channels, seed, sparse=False):
    rng = np.random.default_rng(seed)
    values = rng.exponential(1.0, (*shape, channels)).astype(np.float32)
    if sparse:
        values *= rng.random(shape)[..., None] < 0.02
    field = GridField(Grid(shape, np.eye(4)), mi.Float(values.ravel()), channels, scale=2.0)
    return field, Macrocells.build(field, Boundary("box", UNIT))


@given(
    st.tuples(*[st.integers(1, 13)] * 3),
    st.sampled_from([1, 3]),
    st.booleans(),
    st.integers(0, 2**31),
)
@settings(max_examples=40, deadline=None)
def test_bounds_hold_everywhere(shape, channels, sparse, seed):
    """Majorants bound the extinction at random points, on cell walls and outside, per channel."""
    field, cells = cells_of(shape, channels, seed, sparse)
    rng = np.random.default_rng(seed + 1)
    p = rng.uniform(-0.5, 1.5, (3, 2000))
    p[:, :500] = np.round(p[:, :500] * 8) / 8
    point = mi.Point3f(np.float32(p))
    walk = cells.walk(mi.Ray3f(point, mi.Vector3f(1, 0, 0)))
    cell = walk.cell(dr.zeros(mi.Float, 2000))
    values = np.atleast_2d(np.array(field.at_world(point)))
    assert (values <= np.array(walk.majorant(cell, True))).all()
    assert (values >= np.array(walk.minorant(cell, True))).all()


def test_bounds_are_tight():
    """The majorant is the largest voxel within interpolation reach: 5 x 5 x 5 voxels."""
    field, cells = cells_of((5, 5, 5), 1, 3)
    values = 2 * np.array(field.data).reshape(5, 5, 5)
    assert cells.shape == (2, 2, 2)
    majorant = np.array(cells.majorant).reshape(2, 2, 2)
    assert majorant[0, 0, 0] == pytest.approx(values.max(), rel=1e-5)
    assert majorant[1, 1, 1] == pytest.approx(values[3:, 3:, 3:].max(), rel=1e-5)


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_traversal_visits_the_cell_of_every_point(seed):
    """Each point of a ray lies in the cell that the traversal visits between its entry and exit."""
    _, cells = cells_of((9, 13, 11), 1, 5)
    rng = np.random.default_rng(seed)
    count = 256
    origin, direction = rng.uniform(-1, 2, (3, count)), rng.normal(size=(3, count))
    direction[rng.random((3, count)) < 0.2] = 0
    direction[:, (direction == 0).all(axis=0)] = [[1], [0], [0]]
    direction /= np.linalg.norm(direction, axis=0)
    walk = cells.walk(mi.Ray3f(mi.Point3f(np.float32(origin)), mi.Vector3f(np.float32(direction))))
    t = mi.Float(np.zeros(count, np.float32))
    cell = walk.cell(t)
    limits = np.array([[3], [4], [3]]) - 1
    for _ in range(3 + 4 + 3):
        wall, following = walk.exit(cell, t)
        end = np.minimum(np.array(wall), 10.0)
        middle = 0.5 * (np.array(t) + end)
        u = np.array(walk.origin) + np.array(walk.direction) * middle
        expected = np.clip(u, 0, limits + 1)
        inside = (np.array(cell) - 1e-4 <= expected) & (expected <= np.array(cell) + 1 + 1e-4)
        assert inside.all()
        assert (end >= np.array(t) - 1e-5).all()
        moves = np.array(wall) < 10.0
        t = mi.Float(np.where(moves, np.array(wall), 10.0).astype(np.float32))
        cell = dr.select(mi.Bool(moves), following, cell)
    assert (np.array(t) == 10.0).all()
