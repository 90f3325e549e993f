"""Lookups in cells that surfaces cut, and the classification of voxels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.scene.cut_cells import CutCells
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses, extended, neighbourhood

pytestmark = pytest.mark.usefixtures("rgb")

NORMAL, DISTANCE = np.array([0.6, 0.64, 0.48]), 0.9


@pytest.fixture
def unit(rgb) -> Grid:
    return Grid((8, 8, 8), np.eye(4))


def wall() -> mi.Scene:
    """Return a plane through the unit cube, at ``DISTANCE`` along ``NORMAL``."""
    center = DISTANCE * NORMAL
    place = mi.ScalarTransform4f().look_at(list(center), list(center + NORMAL), [0, 0, 1])
    shape = {"type": "rectangle", "to_world": place.scale(3)}
    return mi.load_dict({"type": "scene", "wall": shape})


def points(count: int = 4096) -> tuple[mi.Point3f, np.ndarray]:
    """Return points in the unit cube and their distances from the wall."""
    p = np.random.default_rng(1).uniform(0.07, 0.93, (3, count)).astype(np.float32)
    return mi.Point3f(p), NORMAL @ p - DISTANCE


def test_lookups_do_not_cross_a_wall(unit):
    """Lookups beside a wall use values of their own side only.

    The field is 1 on one side and 4 on the other; without cut cells, lookups near the wall would
    mix them.
    """
    centers = np.array(unit.centers(dr.arange(mi.UInt32, unit.voxel_count)))
    roots = np.where(NORMAL @ centers > DISTANCE, 2.0, 1.0).astype(np.float32)
    field = RootField(unit, mi.Float(roots), 1)
    p, distance = points()
    plain = field.at_world(p)
    edges = CutCells(wall(), unit)
    sided = np.array(edges.corrected(field, p, plain, mi.Bool(True)))
    expected = np.where(distance > 0, 4.0, 1.0)
    far = np.abs(distance) > 1e-4
    inner = np.all((np.array(p) > 1 / 16) & (np.array(p) < 15 / 16), axis=0)
    np.testing.assert_allclose(sided[far & inner], expected[far & inner], rtol=1e-5)
    assert np.abs(np.array(plain) - expected)[inner].max() > 0.5


def test_uncut_cells_are_unchanged(unit):
    """Lookups in uncut cells do not change by a bit, in any channel."""
    rng = np.random.default_rng(2)
    roots = rng.uniform(0.5, 1.5, unit.voxel_count * 3).astype(np.float32)
    field = RootField(unit, mi.Float(roots), 3)
    p, distance = points()
    plain = field.at_world(p)
    sided = np.array(CutCells(wall(), unit).corrected(field, p, plain, mi.Bool(True)))
    far = np.abs(distance) > 3**0.5 / 8
    np.testing.assert_array_equal(sided[:, far], np.array(plain)[:, far])
    assert (sided != np.array(plain)).any()


def house(inner: float, thickness: float) -> mi.Scene:
    """Return a closed house around the origin: five solid boxes that overlap, on a floor."""
    scale, translate = mi.ScalarTransform4f().scale, mi.ScalarTransform4f().translate
    half = 0.5 * thickness
    shapes = {"floor": translate([0, 0, -inner]) @ scale(5)}
    for axis, sign in [(0, -1), (0, 1), (1, -1), (1, 1), (2, 1)]:
        middle = [0.0, 0.0, 0.0]
        middle[axis] = sign * (inner + half)
        size = [inner + half + 0.001 * axis] * 3
        size[axis] = half
        shapes[f"wall {axis} {sign}"] = translate(middle) @ scale(size)
    kinds = {name: "rectangle" if name == "floor" else "cube" for name in shapes}
    walls = {name: {"type": kinds[name], "to_world": place} for name, place in shapes.items()}
    return mi.load_dict({"type": "scene", **walls}, optimize=False)


@pytest.mark.parametrize("thickness", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("size", [0.2, 0.22, 0.25, 0.3, 0.32])
def test_lookups_in_a_closed_house_do_not_leak(rgb, size, thickness):
    """Lookups in a closed house read no voxel outside of it, wherever its edges and corners are
    relative to voxels. Some walls are thinner than a voxel, and some faces lie on voxel centres.
    """
    inner = 1.0
    count = round(3.4 / size)
    place = np.diag([count * size] * 3 + [1.0])
    place[:3, 3] = -inner - size * np.array([3.0, 2.5, 2.7])
    grid = Grid((count, count, count), place)
    centers = np.array(grid.centers(dr.arange(mi.UInt32, grid.voxel_count)))
    indoors = np.abs(centers).max(axis=0) < inner
    roots = np.where(indoors, 1.0, 7.0).astype(np.float32)
    solid = (np.abs(centers).max(axis=0) < inner + thickness) & ~indoors
    roots[solid & (centers[2] > -inner)] = 0
    field = RootField(grid, mi.Float(roots), 1)
    rng = np.random.default_rng(4)
    u = rng.uniform(-1, 1, (3, 40000))
    p = mi.Point3f(np.float32(np.sign(u) * np.abs(u) ** 0.3 * (inner - 1e-4)))
    found = CutCells(house(inner, thickness), grid).corrected(
        field, p, field.at_world(p), mi.Bool(True)
    )
    np.testing.assert_allclose(np.array(found), 1.0, rtol=1e-5)


def test_empty_space_has_no_edges(unit):
    ball = {"type": "sphere", "center": [3, 3, 3]}
    null = {"type": "sphere", "bsdf": {"type": "null"}}
    assert CutCells(mi.load_dict({"type": "scene", "a": ball, "b": null}), unit).count == 0


def test_means_over_valid_neighbours():
    """Means over valid neighbours are weighted by the squared distance."""
    rng = np.random.default_rng(3)
    values, valid = rng.uniform(0, 1, (4, 5, 6)).astype(np.float32), rng.random((4, 5, 6)) < 0.5
    grid = Grid((4, 5, 6), np.eye(4))
    total, weights = neighbourhood(grid, mi.Float(values.ravel()), mi.Bool(valid.ravel()))
    expected = np.zeros((2, 4, 5, 6))
    for z, y, x in np.ndindex(4, 5, 6):
        for k, j, i in np.ndindex(3, 3, 3):
            place = (z + k - 1, y + j - 1, x + i - 1)
            squared = (k - 1) ** 2 + (j - 1) ** 2 + (i - 1) ** 2
            if squared and all(0 <= a < n for a, n in zip(place, (4, 5, 6), strict=True)):
                expected[:, z, y, x] += valid[place] / squared * np.array([values[place], 1])
    np.testing.assert_allclose(np.array(total).reshape(4, 5, 6), expected[0], rtol=1e-5)
    np.testing.assert_allclose(np.array(weights).reshape(4, 5, 6), expected[1], rtol=1e-5)


def test_voxels_are_classified(scenes):
    """Voxels of a cube, in part another medium in a null sphere or an opaque ball, are
    classified.
    """
    fog = scenes.medium(0.5, 0.9) | {"id": "fog"}
    inner = {
        "type": "sphere", "center": [-0.5, 0, 0], "radius": 0.4, "bsdf": {"type": "null"},
        "interior": scenes.medium(1.0, 0.9), "exterior": {"type": "ref", "id": "fog"},
    }  # fmt: skip
    ball = {"type": "sphere", "center": [0.5, 0, 0], "radius": 0.4}
    outer = scenes.boundary({"type": "ref", "id": "fog"})
    scene = scenes.load({"type": "volpath"}, outer, fog=fog, inner=inner, ball=ball)
    description = compile_scene(scene)
    grids = {grid.name: grid for grid in description.visible}
    assert len(grids) == 2
    medium = grids["fog"]
    grid = Grid.near_cubic(medium.frame, 16)
    classes = VoxelClasses(scene, description.media, medium, grid)
    centers = np.array(grid.centers(dr.arange(mi.UInt32, grid.voxel_count)))
    in_sphere = np.linalg.norm(centers - [[-0.5], [0], [0]], axis=0) < 0.4
    in_ball = np.linalg.norm(centers - [[0.5], [0], [0]], axis=0) < 0.4
    order = [g.name for g in description.media.grids]
    expected = np.where(in_sphere, 2 - order.index("fog"), order.index("fog") + 1)
    np.testing.assert_array_equal(np.array(classes.medium_number), expected)
    np.testing.assert_array_equal(np.array(classes.enclosed), in_ball)
    deep = np.linalg.norm(centers - [[-0.5], [0], [0]], axis=0) < 0.4 - 2 * 3**0.5 * 0.125
    assert not np.array(classes.readable)[deep].any()
    assert np.array(classes.readable)[~in_sphere].all()


def test_values_are_extrapolated_linearly():
    """Two layers beyond valid voxels continue a linear field, apart from the ends of the grid."""
    n = 8
    grid = Grid((n, n, n), np.eye(4))
    z, y, x = np.indices((n, n, n))
    field = (20.0 + x + 0.5 * y - 0.25 * z).astype(np.float32)
    valid = x < 5
    values = mi.Float(np.where(valid, field, 0).ravel())
    found = extended(grid, values, mi.Bool(valid.ravel())).numpy().reshape(n, n, n)
    np.testing.assert_array_equal(found[valid], field[valid])
    np.testing.assert_allclose(found[3:5, 3:5, 5:7], field[3:5, 3:5, 5:7], rtol=1e-5)
    assert not found[..., 7].any()
