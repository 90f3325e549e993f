"""Nodes on surfaces: keys, placement, interpolation, refinement."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.surface import (
    CLEARANCE,
    SPACING_PER_DISTANCE,
    SpacingBounds,
    SurfaceNodes,
)

pytestmark = pytest.mark.usefixtures("rgb")

LOWER, UPPER = np.array([-1.0, -1, -1]), np.array([1.0, 1, 1])
#: Planes n.x = c, with dominant axes of both signs.
PLANES = {
    "floor": ((0, 1, 0), -1.1),
    "ceiling": ((0, -1, 0), -1.5),
    "wall": ((-1, 0, 0), -1.4),
    "slope": ((0.3, 0.4, 0.866), -0.2),
    "steep": ((-0.6, 0.58, -0.55), 0.3),
}


def bounds(coarsest: float = 1e9, finest: float = 0.01) -> SpacingBounds:
    return SpacingBounds(*(dr.opaque(mi.Float, x) for x in (coarsest, finest)))


def points(normal: np.ndarray, offset: float, count: int = 200, seed: int = 1) -> np.ndarray:
    """Return random points (3, n) of a plane around the box."""
    u = np.random.default_rng(seed).uniform(-1.5, 1.5, (3, count))
    return u + normal[:, None] * (offset - normal @ u)


def cover(
    nodes: SurfaceNodes,
    plane: tuple,
    p: np.ndarray,
    distance: float,
    clearance: float,
    within: SpacingBounds | None = None,
):
    """Create all nodes for points of a plane; return normals and the number of rounds."""
    within = within or bounds()
    normal, offset = plane
    p = mi.Point3f(np.float32(p))
    normals = (mi.Normal3f(*(dr.full(mi.Float, float(x), dr.width(p)) for x in normal)),) * 2
    for rounds in range(20):
        *_, keys, missing = nodes.find(p, normals, within, mi.Bool(True))
        dr.eval(keys, missing)
        index = dr.compress(missing)
        if not dr.width(index):
            return p, normals, rounds
        new, _ = nodes.add_keys([dr.gather(mi.UInt64, key, index) for key in keys])
        ray, length = nodes.rays(new)
        n = mi.Normal3f(*(dr.opaque(mi.Float, float(x)) for x in normal))
        t = (offset - dr.dot(n, ray.o)) / dr.dot(n, ray.d)
        hit = (t >= 0) & (t <= length)
        count = dr.width(new)
        full = mi.Normal3f(*(dr.full(mi.Float, float(x), count) for x in normal))
        nodes.place(
            ray(t),
            (full, full),
            dr.select(hit, distance, 0),
            dr.full(mi.Float, clearance, count),
            dr.zeros(mi.UInt32, count),
        )
    raise AssertionError("nodes are missing for ever")


def unit(plane: tuple) -> tuple[np.ndarray, float]:
    normal = np.array(plane[0], float)
    return normal / np.linalg.norm(normal), plane[1]


@pytest.mark.parametrize("plane", PLANES.values(), ids=PLANES)
def test_interpolation_is_exact_for_linear_functions(plane):
    plane = unit(plane)
    nodes = SurfaceNodes(LOWER, UPPER)
    p, normals, _ = cover(nodes, plane, points(*plane), 1.0, 9.0)
    numbers, weights, uncertain, _, _ = nodes.find(p, normals, bounds(), mi.Bool(True))
    total = sum(weights)
    found = [
        sum(w * x for w, x in zip(weights, axis, strict=True))
        for axis in zip(*(nodes.positions(number)[0] for number in numbers), strict=True)
    ]
    np.testing.assert_allclose(np.array(total), 1, atol=1e-5)
    np.testing.assert_allclose(np.array(mi.Point3f(*found)), np.array(p), atol=1e-4)
    assert not dr.any(uncertain)[0]


@pytest.mark.parametrize("distance", [0.1, 0.4, 3.0])
def test_spacing_follows_the_distances_that_nodes_see(distance):
    plane = unit(PLANES["slope"])
    nodes = SurfaceNodes(LOWER, UPPER)
    p, normals, _ = cover(nodes, plane, points(*plane), distance, 9.0)
    numbers, weights, *_ = nodes.find(p, normals, bounds(), mi.Bool(True))
    farthest = max(
        float(dr.max(dr.select(w > 1e-5, dr.norm(nodes.positions(n)[0] - p), 0))[0])
        for n, w in zip(numbers, weights, strict=True)
    )
    # A cell is as long as twice its spacing where the surface is steep.
    coarsest = 0.25 * np.linalg.norm(UPPER - LOWER)
    allowed = min(distance * SPACING_PER_DISTANCE, coarsest)
    assert 0.3 * allowed < farthest < 2.5 * allowed


@pytest.mark.parametrize(
    ("coarsest", "finest", "distance", "expected"),
    [(0.2, 1e-3, 1e9, 0.2), (1e9, 0.1, 1e-6, 0.1), (0.05, 0.1, 1e-6, 0.05)],
)
def test_spacing_is_within_its_bounds(coarsest, finest, distance, expected):
    """What nodes see cannot make the spacing larger than one bound or smaller than the other."""
    plane, within = unit(PLANES["floor"]), bounds(coarsest, finest)
    nodes = SurfaceNodes(LOWER, UPPER)
    p, normals, _ = cover(nodes, plane, points(*plane), distance, 9.0, within)
    numbers, weights, *_ = nodes.find(p, normals, within, mi.Bool(True))
    places = [np.array(nodes.positions(n)[0]) for n in numbers]
    edge = np.linalg.norm(places[1] - places[0], axis=0)
    np.testing.assert_allclose(np.array(sum(weights)), 1, atol=1e-5)
    assert 0.49 * expected < edge.min() and edge.max() < 1.01 * expected


def test_close_surfaces_make_interpolation_uncertain():
    plane = unit(PLANES["floor"])
    for clearance, expected in ((1e-3, True), (9.0, False)):
        nodes = SurfaceNodes(LOWER, UPPER)
        p, normals, _ = cover(nodes, plane, points(*plane, count=20), 9.0, clearance)
        _, weights, uncertain, *_ = nodes.find(p, normals, bounds(), mi.Bool(True))
        assert (np.array(uncertain) == expected).all()
        assert (np.array(sum(weights)) > 0.99).all()
    assert CLEARANCE > 1  # nodes on either side of a wall are within a cell of it


def test_nodes_whose_normals_point_elsewhere_do_not_apply():
    """Lookups with another shading normal find nothing, however fine the levels are."""
    plane = unit(PLANES["floor"])
    nodes = SurfaceNodes(LOWER, UPPER)
    p, (geometric, _), _ = cover(nodes, plane, points(*plane, count=20), 9.0, 9.0)
    for tilt, expected in ((0.5, 1.0), (0.8, 0.0)):  # cosines of 0.88 and 0.7
        tilted = mi.Normal3f(float(np.sin(tilt)), float(np.cos(tilt)), dr.zeros(mi.Float, 20))
        normals = geometric, tilted
        _, weights, *_ = nodes.find(p, normals, bounds(finest=1.0), mi.Bool(True))
        np.testing.assert_allclose(np.array(sum(weights)), expected, atol=1e-5)


def test_nodes_do_not_depend_on_the_order_of_points():
    plane = unit(PLANES["slope"])
    p = points(*plane)
    together, apart = SurfaceNodes(LOWER, UPPER), SurfaceNodes(LOWER, UPPER)
    cover(together, plane, p, 0.5, 9.0)
    cover(apart, plane, p[:, 120:], 0.5, 9.0)
    cover(apart, plane, p[:, :120], 0.5, 9.0)
    assert together.count == apart.count
    order = [np.argsort(np.array(nodes.keys)) for nodes in (together, apart)]
    keys = [np.array(n.keys)[o] for n, o in zip((together, apart), order, strict=True)]
    np.testing.assert_array_equal(*keys)
    places = [
        np.array(n.positions(mi.UInt32(o))[0])[:, :]
        for n, o in zip((together, apart), order, strict=True)
    ]
    np.testing.assert_array_equal(*places)


def test_a_key_is_stored_once():
    nodes = SurfaceNodes(LOWER, UPPER)
    keys = mi.UInt64(np.random.default_rng(1).integers(0, 2**62, 5000) // 7 % 1000 * 2**40)
    unique = len(np.unique(np.array(keys)))
    assert dr.width(nodes.add_keys([keys])[0]) == unique == nodes.count
    assert dr.width(nodes.add_keys([keys])[0]) == 0
    assert nodes.count == unique
    found = nodes._number_of(keys, mi.Bool(True))
    np.testing.assert_array_equal(np.array(dr.gather(mi.UInt64, nodes.keys, found)), np.array(keys))
    other = nodes._number_of(keys + 1, mi.Bool(True))
    assert (np.array(other) == 0xFFFFFFFF).all()


def test_the_opposite_side_of_a_surface_has_other_nodes():
    plane = unit(PLANES["floor"])
    nodes = SurfaceNodes(LOWER, UPPER)
    p, normals, _ = cover(nodes, plane, points(*plane, count=30), 1.0, 9.0)
    below = tuple(-n for n in normals)
    _, weights, _, _, missing = nodes.find(p, below, bounds(), mi.Bool(True))
    assert dr.all(missing)[0]
    assert not dr.any(sum(weights) > 0)[0]
