"""Boundary radiance of tracks: which track gets which value."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.discrete_ordinates import boundary_condition
from mitsuba_irrcache.solvers.discrete_ordinates.boundary_condition import (
    IncomingRadiance,
    SurfaceBoundary,
)
from mitsuba_irrcache.solvers.discrete_ordinates.track_table import BoundarySource
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks
from tests.support.incoming_radiance import sampled_rays, without_paths

pytestmark = pytest.mark.usefixtures("rgb")

DIRECTIONS = np.array([[0.2, 0.5, 1.0], [1.0, -0.7, 0.4], [-0.3, -1.0, 0.6], [0.0, 0.0, -1.0]])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1)[:, None]


def swept(tracks: Tracks, found: IncomingRadiance, values: mi.Float, i: int, offset) -> np.ndarray:
    """Return the radiance at voxels of tracks in direction ``i`` without extinction."""
    dark, rows = np.zeros((1, 2)), np.array([i])

    def entering(table):
        return BoundarySource(*found._cells_of(tracks, table, rows), values)

    volume = tracks.uncollided(DIRECTIONS[rows], dark, offset[rows], entering)
    return np.array(volume, dtype=np.float64).reshape(tracks.grid.shape)


@pytest.fixture
def alone(monkeypatch):
    """Return incoming radiance without surfaces."""
    without_paths(monkeypatch)


@pytest.mark.parametrize("way", [0, 1])
@pytest.mark.parametrize("cells", [1 << 14, 30], ids=["lines", "blocks"])
@pytest.mark.parametrize("coarse", [False, True])
def test_tracks_carry_the_radiance_of_their_entry(scenes, monkeypatch, alone, way, cells, coarse):
    """Radiance at a track's entry reaches all voxels on it.

    A quantity that is constant along tracks is given at the entry points and compared at the
    voxels: in a rotated, stretched grid, on a coarser grid, and, if several tracks share a boundary
    cell, within its size.
    """
    monkeypatch.setattr(boundary_condition, "PATH_CELLS", cells)
    place = scenes.placement((1.0, 3.0, 2.0), turn=35, mirror=True)
    grid = Grid((12, 10, 8), place)
    lower, upper = np.array([2, 2, 0]), np.array([8, 8, 10])
    fine = Tracks(grid, dr.zeros(mi.Float, grid.voxel_count), lower, upper)
    offsets = np.random.default_rng(3).random((len(DIRECTIONS), 2))
    found, (_, _, hit, ray, _) = sampled_rays(fine, DIRECTIONS, offsets)
    tracks, low, high = fine, lower, upper
    if coarse:
        half = Grid((6, 5, 4), place)
        low, high = lower // 2, upper // 2
        tracks = Tracks(half, dr.zeros(mi.Float, half.voxel_count), low, high)
    inside = np.s_[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    at = np.moveaxis(np.indices(tracks.grid.shape)[::-1], 0, -1) + 0.5
    world = tracks.grid.world.matrix
    centres = (at @ world[:3, :3].T + world[:3, 3])[inside]
    edge = np.linalg.norm(tracks.grid.voxel_size)
    for i, direction in enumerate(DIRECTIONS):
        across = np.cross(direction, [0.3, 0.8, -0.5])
        across /= np.linalg.norm(across)
        along = dr.dot(mi.Vector3f(*across.tolist()), mi.Vector3f(ray.o)) + 10
        is_way = (dr.arange(mi.UInt32, dr.width(along)) & 1) == way
        values = dr.select(hit & is_way, along, 0)
        dr.eval(values)
        brought = swept(tracks, found, values, i, offsets)[inside]
        share = 1 if cells > 30 else found._edge.max()
        error = np.abs(brought - (centres @ across + 10))
        assert error.max() < 0.9 * edge * share
        # Tracks pass on all sides of the centres.
        assert abs((brought - (centres @ across + 10)).mean()) < 0.5 * edge * share


def test_reflected_radiance_is_linear_in_phi(scenes):
    """Radiance reflected by surfaces is linear in phi.

    With white walls around a medium and no emitters, the incoming radiance is what left the medium:
    with phi = 4 pi everywhere it is at most 1, and 1 along tracks that intersect the medium again;
    the points are voxels of it.
    """
    wall = {"type": "sphere", "radius": 4.0, "flip_normals": True}
    wall["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    shape = scenes.boundary(scenes.medium(40.0, 1.0))
    scene = scenes.load({"type": "irrcache", "solver": "path"}, shape, 4, emitter=None, wall=wall)
    (medium,) = compile_scene(scene).visible
    grid = Grid((8, 8, 8), medium.frame)
    tracks = Tracks(grid, dr.full(mi.Float, 40.0, 512), np.zeros(3, int), grid.resolution)
    offsets = np.random.default_rng(1).random((len(DIRECTIONS), 2))
    rows = DIRECTIONS, np.zeros((len(DIRECTIONS), 2, 3)), np.ones(len(DIRECTIONS)), offsets
    found = IncomingRadiance(
        SurfaceBoundary(scene, medium, [], 1000), tracks, rows, True, (1, 2, 0)
    )
    returned, voxel = np.array(found.reflected[0]) * 4 * np.pi, np.array(found.voxel)
    assert np.array(found.emitted).max() == 0
    _, _, hit, _, _ = found.sample_rays(
        found._parameters(rows[0], [rows[1]], rows[2])[0], (1, 2, 0)
    )
    returned = returned[np.array(hit)]
    assert returned.mean() == pytest.approx(1, rel=0.02)
    places = np.stack(np.unravel_index(voxel[np.array(hit)], grid.shape), axis=1)
    assert ((places == 0) | (places == 7)).any(axis=1).mean() > 0.98  # of 5 mean free paths
