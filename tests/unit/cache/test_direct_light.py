"""Direct light of emitters without extent."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_irrcache.cache import direct_light
from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import active_voxels
from mitsuba_irrcache.scene.compile import compile_scene

pytestmark = pytest.mark.usefixtures("rgb")


def test_parts_of_the_voxels_give_the_same_depths_and_can_be_interrupted(scenes, monkeypatch):
    """Optical depths are computed in parts of the voxels, between which ``pause`` is called."""
    extinction = scenes.texture((6, 5, 4, 3), 1, 9, 1)
    shape = scenes.boundary(scenes.medium(extinction, 0.9))
    point = {"type": "point", "position": [3, 4, 5]}
    scene = scenes.load({"type": "irrcache", "solver": "sweep"}, shape, emitter=point)
    (medium,) = compile_scene(scene).visible
    grid = Grid.near_cubic(medium.frame, 7)
    where = scene, scene.emitters()[0], medium, grid, active_voxels(medium, grid)
    whole = DirectLight(*where)
    monkeypatch.setattr(direct_light, "LARGEST_PART", 100)
    calls = []
    parts = DirectLight(*where, pause=lambda: calls.append(1))
    assert len(calls) == -(-grid.voxel_count // 100)
    np.testing.assert_allclose(np.array(parts.irradiance), np.array(whole.irradiance), rtol=1e-6)
    assert np.array(whole.irradiance).std() > 0

    def interrupt() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        DirectLight(*where, pause=interrupt)
