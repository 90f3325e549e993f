"""What is chosen where nothing is told: voxels of the cache, and directions."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache import choices
from mitsuba_irrcache.boundary import Boundary
from mitsuba_irrcache.choices import choose_grid
from mitsuba_irrcache.grid import ConstantField, Grid, GridField
from mitsuba_irrcache.medium import MediumGrid
from mitsuba_irrcache.solvers import sweep

pytestmark = pytest.mark.usefixtures("rgb")


def medium(values: np.ndarray, edges=(1.0, 1.0, 1.0)) -> MediumGrid:
    """A medium of these extinctions (z, y, x) in a box of these edges (x, y, z)."""
    frame = np.diag([*edges, 1.0])
    field = GridField(Grid(values.shape, frame), mi.Float(values.astype(np.float32).ravel()), 1)
    unit = np.array([[2, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1.0]])
    boundary = Boundary("box", frame @ np.linalg.inv(unit))
    return MediumGrid(field, ConstantField(np.array([0.5])), boundary)


def chosen(values: np.ndarray, edges=(1.0, 1.0, 1.0), solver="sweep") -> tuple[int, ...]:
    return choose_grid(medium(values, edges), 0, solver)[0].shape


def test_thin_data_keep_their_voxels():
    assert chosen(np.full((4, 6, 8), 3.0)) == (4, 6, 8)  # 0.75 per voxel along z at most
    assert chosen(np.zeros((4, 6, 8))) == (4, 6, 8)


def test_dense_data_get_finer_voxels_where_it_counts():
    """Along each axis as far as its optical depth asks for, at most twice; ``path`` does not."""
    assert chosen(np.full((10, 10, 10), 12.0)) == (17, 17, 17)  # 1.2 per voxel
    assert chosen(np.full((10, 10, 10), 100.0)) == (20, 20, 20)
    assert chosen(np.full((10, 10, 10), 6.0), (1.0, 1.0, 2.0)) == (17, 10, 10)
    assert chosen(np.full((10, 10, 10), 100.0), solver="path") == (10, 10, 10)


def test_a_little_bone_in_much_air():
    """What counts is the matter where light collides, not the mean of the volume."""
    values = np.full((10, 10, 10), 0.01)
    values[4:6, 4:6, 4:6] = 12.0
    assert chosen(values) == (15, 15, 15)


def test_finer_voxels_have_a_limit(monkeypatch):
    monkeypatch.setattr(choices, "MOST_VOXELS", 2500)
    shape = chosen(np.full((10, 10, 10), 100.0))
    assert shape == (13, 13, 13)
    assert chosen(np.full((20, 20, 20), 100.0)) == (14, 14, 14)


@pytest.mark.parametrize(
    ("samples", "batch"),
    [(1, 32), (32, 32), (33, 64), (96, 96), (128, 128), (256, 256), (257, 160), (1000, 256)],
)
def test_size_of_batches(samples, batch):
    """All that is wanted, or equal parts of up to 256 directions."""
    assert sweep.batch_of(samples, sweep.BATCH) == batch


def test_directions_by_default(scenes):
    """128 in one batch, twice as many for single scattering; in two where an error is wanted; those
    asked for later count.
    """
    shape = scenes.boundary(scenes.medium(scenes.texture((4, 4, 4), 0.5, 3.0, 1), 0.9))
    for wanted, asked, expected in (
        ({}, 0, (128, 128)),
        ({"max_depth": 2}, 0, (256, 256)),
        ({"filter": "bilateral"}, 0, (128, 64)),
        ({}, 64, (64, 64)),
    ):
        scene = scenes.load(
            {"type": "irrcache", "max_depth": -1, "solver": "auto"} | wanted, shape, size=2
        )
        if asked:
            scene.integrator().cache_spp = asked
        scene.integrator().prepare(scene)
        cache = scene.integrator().cache
        assert (cache.samples, cache.batch) == expected
