"""Grids: placement, round trips and lookups against Mitsuba's own gridvolume."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grid import Grid, GridField

pytestmark = pytest.mark.usefixtures("rgb")

PLACEMENTS = [
    {},
    {"turn": 70.0, "edges": (1.0, 2.0, 5.0)},
    {"mirror": True, "turn": -20.0, "center": (3.0, -4.0, 5.0)},
    {"edges": (1e-6, 2e-6, 1e-6)},
    {"edges": (1e6, 1e6, 3e6), "turn": 45.0},
]


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_round_trip(scenes, placement):
    """World and back, to float32 rounding of a voxel coordinate."""
    grid = Grid((5, 7, 9), scenes.placement(**placement))
    u = np.float32(np.random.default_rng(1).uniform(-2, 11, (3, 256)))
    back = np.array(grid.coordinates.point(grid.world.point(mi.Point3f(u))))
    np.testing.assert_allclose(back, u, atol=5e-5)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_centers(scenes, placement):
    to_world = scenes.placement(**placement)
    grid = Grid((2, 3, 4), to_world)
    index = np.arange(24)
    z, y, x = np.unravel_index(index, (2, 3, 4))
    local = (np.stack([x, y, z]) + 0.5) / np.array([[4], [3], [2]])
    expected = to_world[:3, :3] @ local + to_world[:3, 3:]
    measured = np.array(grid.centers(mi.UInt32(index)))
    np.testing.assert_allclose(measured, expected, atol=3e-6 * np.abs(expected).max())


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("placement", PLACEMENTS[:3])
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 2), (4, 3, 6)])
def test_lookup_is_gridvolumes(scenes, placement, channels, shape):
    """Inside the grid; outside of it Mitsuba gives zero, and this grid clamps."""
    to_world = scenes.placement(**placement)
    values = scenes.texture((*shape, channels), 0, 2, 3)
    volume = mi.load_dict(scenes.volume(values, to_world))
    grid = Grid(shape, to_world)
    field = GridField(grid, mi.Float(values.ravel()), channels, scale=1.5)
    u = np.random.default_rng(2).uniform(0.01, 0.99, (3, 512)) * grid.resolution[:, None]
    p = grid.world.point(mi.Point3f(np.float32(u)))
    interaction = mi.Interaction3f()
    interaction.p = p
    expected = np.broadcast_to(volume.eval(interaction), (3, 512))
    measured = np.broadcast_to(np.array(field.at_world(p)), (3, 512))
    np.testing.assert_allclose(measured, 1.5 * expected, atol=2e-4)
    assert field.maximum == pytest.approx(1.5 * values.max())


def test_lookup_clamps_outside(scenes):
    values = scenes.texture((3, 4, 5), 0, 1, 4)
    field = GridField(Grid((3, 4, 5), np.eye(4)), mi.Float(values.ravel()), 1)
    outside = mi.Point3f([-9.0, 14.0, 1e30], [0.5, 3.5, 1e30], [0.5, -1e30, 1e30])
    expected = [values[0, 0, 0], values[0, 3, 4], values[2, 3, 4]]
    np.testing.assert_array_equal(np.array(field.at(outside)), np.float32(expected))


@given(st.tuples(*[st.floats(0.01, 100)] * 3), st.integers(1, 200))
@settings(max_examples=50, deadline=None)
def test_near_cubic(edges, resolution):
    """The longest side has the voxels asked for; no edge differs from it by more than rounding a
    count can cause.
    """
    mi.set_variant("llvm_ad_rgb")
    grid = Grid.near_cubic(np.diag([*edges, 1.0]), resolution)
    counts = grid.resolution
    assert counts.max() == resolution
    ideal = resolution * np.array(edges) / max(edges)
    assert (np.abs(counts - ideal) <= np.maximum(0.5, 1 - ideal) + 1e-9).all()


@pytest.mark.parametrize(
    ("shape", "to_world"),
    [
        ((0, 1, 1), np.eye(4)),
        ((1, 1, 1), np.zeros((4, 4))),
        ((1, 1, 1), np.full((4, 4), np.nan)),
        ((1, 1, 1), np.eye(3)),
    ],
)
def test_impossible_grids_are_refused(shape, to_world):
    with pytest.raises(IrrcacheError, match="Grid"):
        Grid(shape, to_world)


def test_data_of_another_size_are_refused():
    with pytest.raises(IrrcacheError, match="7 values do not fill"):
        GridField(Grid((2, 2, 2), np.eye(4)), mi.Float([0.0] * 7), 1)
