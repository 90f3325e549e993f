"""Grids: placement, round trips and lookups compared with Mitsuba's gridvolume."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.packed_fields import Lookups
from mitsuba_irrcache.grids.root_field import RootField

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
    """Transforming to the world and back is exact to float32 rounding of a voxel coordinate."""
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
    """Lookups equal gridvolume's inside the grid; outside Mitsuba gives zero and this grid
    clamps.
    """
    to_world = scenes.placement(**placement)
    values = scenes.texture((*shape, channels), 0, 2, 3)
    volume = mi.load_dict(scenes.volume(values, to_world, accel=False))
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
    """The longest side has the requested number of voxels, and voxels are nearly cubic.

    Edges differ by no more than the rounding of a count.
    """
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


# Packed fields


def fields_of(grid: Grid, kinds: list[str], seed: int = 5) -> list:
    """Return fields of one grid by letter.

    ``1`` and ``3`` have channels of any size, ``a`` three below 1, ``r`` and ``R`` are roots of one
    and three channels, and ``c`` is a constant.
    """
    rng = np.random.default_rng(seed)
    fields = []
    for kind in kinds:
        if kind == "c":
            fields.append(ConstantField(np.array([0.25])))
            continue
        channels = 3 if kind in "3aR" else 1
        values = rng.uniform(0, 1 if kind == "a" else 5, grid.voxel_count * channels)
        data = mi.Float(np.float32(values))
        root = kind in "rR"
        fields.append(
            RootField(grid, data, channels) if root else GridField(grid, data, channels, 0.7)
        )
    return fields


def looked_up(lookups: Lookups, p: mi.Point3f) -> list:
    """Return the values at the points, each on a ray of its own."""
    rays = mi.Ray3f(p - mi.Vector3f(1, 2, 3), mi.Vector3f(1, 2, 3))
    return lookups.along(rays).at(mi.Float(1), mi.Bool(True))


@pytest.mark.parametrize("shape", [(4, 3, 6), (1, 5, 2), (1, 1, 1)])
@pytest.mark.parametrize(
    ("kinds", "groups"),
    [("1", 1), ("3", 1), ("1r", 1), ("1rc", 1), ("1r1", 1), ("1R", 1), ("1ra", 1), ("1Ra", 1),
     ("3Ra", 2)],
)  # fmt: skip
def test_packed_fields_equal_the_originals(scenes, shape, kinds, groups):
    """Packed fields equal the originals to 16 bits (11 of them mantissa) in every layout."""
    grid = Grid(shape, scenes.placement(turn=30.0, edges=(1.0, 2.0, 3.0)))
    fields = fields_of(grid, list(kinds))
    lookups = Lookups(fields)
    assert len(lookups.groups) == groups
    u = np.random.default_rng(3).uniform(-0.4, 1.4, (3, 512)) * grid.resolution[:, None]
    p = grid.world.point(mi.Point3f(np.float32(u)))
    for found, field in zip(looked_up(lookups, p), fields, strict=True):
        assert type(found) is type(field.at_world(p))
        expected = np.array(field.at_world(p))
        step = 2.0**-11 * (2 if isinstance(field, RootField) else 1)
        np.testing.assert_allclose(np.array(found), expected, rtol=1.01 * step, atol=1e-5)


@pytest.mark.parametrize("value", [0.7, 1.0, 3e-5, 1e30, 1e-30])
def test_packed_fields_are_unbiased(value):
    """Rounding to 16 bits is unbiased.

    A thousand voxels determine their mean ten times better, whether they are equal or of many
    orders of magnitude.
    """
    grid = Grid((10, 10, 10), np.eye(4))
    p = grid.centers(dr.arange(mi.UInt32, 1000))
    for largest in (value, 11 * value, 1e6 * value):
        data = np.full(1000, value, np.float32)
        data[0] = largest
        (found,) = looked_up(Lookups([GridField(grid, mi.Float(data), 1)]), p)
        found = np.float64(found)
        assert found[0] == pytest.approx(largest, rel=2.0**-11)
        np.testing.assert_allclose(found[1:], value, rtol=2.0**-11)
        assert found[1:].mean() == pytest.approx(value, rel=2.0**-11 / 10)


def test_packed_fields_distinguish_zero_from_small():
    """Packed zeros are exact, and values rounded to zero are below 2^-30 of the maximum."""
    grid = Grid((1, 1, 6), np.eye(4))
    values = np.float32([0, 1, 2.0**-29, 2.0**-31, 0, 1e-38])
    p = grid.centers(dr.arange(mi.UInt32, 6))
    (found,) = looked_up(Lookups([GridField(grid, mi.Float(values), 1)]), p)
    np.testing.assert_allclose(found, [0, 1, 2.0**-29, 0, 0, 0], rtol=2.0**-11)
    empty = GridField(grid, dr.zeros(mi.Float, 6), 1)
    np.testing.assert_array_equal(looked_up(Lookups([empty]), p)[0], 0)


def test_packed_fields_are_precise_beside_opaque_voxels():
    """The precision does not degrade because of single opaque voxels."""
    grid = Grid((1, 1, 2), np.eye(4))
    field = GridField(grid, mi.Float([1e30, 1.0]), 1)
    p = grid.centers(dr.arange(mi.UInt32, 2))
    (found,) = looked_up(Lookups([field], [4096.0]), p)
    np.testing.assert_allclose(found, [4096, 1], rtol=2.0**-11)


def test_packed_fields_of_other_grids_are_separate():
    """Fields of different grids are not packed together."""
    fine, coarse = (Grid((n, n, n), np.eye(4)) for n in (6, 3))
    lookups = Lookups([*fields_of(fine, ["1"]), *fields_of(coarse, ["1"])])
    assert [group.packets.grid for group in lookups.groups] == [fine, coarse]


@pytest.mark.parametrize(
    ("kinds", "words"),
    [("1", 1), ("r", 1), ("1r", 2), ("3", 2), ("1r1", 2), ("1R", 4), ("1ra", 4), ("1Ra", 4)],
)
def test_copies_take_few_words_per_voxel(kinds, words):
    grid = Grid((4, 5, 6), np.eye(4))
    (group,) = Lookups(fields_of(grid, list(kinds))).groups
    assert dr.width(group.packets.data) == words * group.packets.grid.voxel_count
