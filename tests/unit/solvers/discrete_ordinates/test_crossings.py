"""Crossings of tracks with surfaces among the voxels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates.crossings import SurfaceCrossings, SurfaceVoxels
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

pytestmark = pytest.mark.usefixtures("rgb")

N = 12


def grid() -> Grid:
    place = np.diag([2.0, 2.0, 2.0, 1.0])
    place[:3, 3] = -1
    return Grid((N, N, N), place)


def of(shape: dict) -> tuple[mi.Scene, SurfaceVoxels]:
    scene = mi.load_dict({"type": "scene", "shape": shape})
    box = np.zeros(3, int), np.full(3, N)
    return scene, SurfaceVoxels(scene, grid(), *box)


def sphere(radius: float, **more) -> dict:
    return {"type": "sphere", "radius": radius, "center": [0.05, -0.02, 0.01]} | more


def test_cut_voxels_are_those_that_the_sphere_passes():
    """All voxels with corners on both sides, and none that the sphere does not touch."""
    _, surfaces = of(sphere(0.6))
    cut = np.array(surfaces.is_cut).reshape(N, N, N)
    corners = np.arange(N + 1) / N * 2 - 1
    z, y, x = np.meshgrid(corners, corners, corners, indexing="ij")
    inside = (x - 0.05) ** 2 + (y + 0.02) ** 2 + (z - 0.01) ** 2 < 0.36
    eight = [
        inside[i : i + N, j : j + N, k : k + N] for i in (0, 1) for j in (0, 1) for k in (0, 1)
    ]
    count = np.sum(eight, axis=0)
    assert cut[(count > 1) & (count < 7)].all()
    # A sphere may pass a side of a voxel whose corners are all outside.
    assert cut[(count == 8)].sum() == 0
    assert cut.sum() < 1.3 * ((count > 0) & (count < 8)).sum()


def test_null_surfaces_are_no_surfaces():
    _, surfaces = of(sphere(0.6, bsdf={"type": "null"}))
    assert surfaces.count == 0 and not np.array(surfaces.is_cut).any()


def test_crossings_lie_on_the_sphere():
    """First and last crossing of a segment lie on the sphere, and the way is the length of a
    chord: each track crosses the sphere twice or not at all.
    """
    scene, surfaces = of(sphere(0.6))
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tracks = Tracks(grid(), dr.zeros(mi.Float, N**3), np.zeros(3, int), np.full(3, N))
    geometry = tracks.table(directions, np.zeros((6, 2)), np.ones(6), rng.random((6, 2))).geometry
    crossings = SurfaceCrossings(surfaces, tracks.lower, geometry)
    way, leaves, ray = crossings.rays()
    si = scene.ray_intersect(ray)
    leaves, valid = np.array(leaves), np.array(si.is_valid())
    assert leaves.sum() > 500
    assert valid[leaves].all()
    # Rays run against the direction of travel of their way.
    number, back = np.array(way) // 2, np.array(way) % 2
    along = np.where(geometry.forward, 1, -1)[:, None] * directions
    expected = -along[number] * np.where(back, -1, 1)[:, None]
    np.testing.assert_allclose(np.array(ray.d).T, expected, atol=1e-5)
    # Nearer than the diagonal of two voxels.
    assert np.array(si.t)[leaves].max() < 4 / N * np.sqrt(3)


def test_the_nearest_voxel_is_on_the_same_side():
    """Positions next to the sphere get voxels whose centres are on their side."""
    _, surfaces = of(sphere(0.6))
    rng = np.random.default_rng(2)
    d = rng.normal(size=(500, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    centre = np.array([0.05, -0.02, 0.01])
    for radius, outside in ((0.61, True), (0.59, False)):
        p = mi.Point3f(np.float32(centre + radius * d).T)
        voxel, _ = surfaces.nearest(p, mi.Bool(True))
        found = np.array(grid().centers(voxel)).T
        distance = np.linalg.norm(found - centre, axis=1)
        assert ((distance > 0.6) == outside).mean() > 0.995
        assert np.linalg.norm(found - np.array(p).T, axis=1).max() < 2 * 2 / N * np.sqrt(3)
