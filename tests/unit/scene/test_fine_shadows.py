"""Detection of shadows that the voxels of a cache do not resolve."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.emitters import EmittersByKind
from mitsuba_irrcache.scene.fine_shadows import share_of_edges, warn_of_fine_shadows

pytestmark = pytest.mark.usefixtures("mono")

CUBE = np.diag([2.0, 2.0, 2.0, 1.0]) + np.array([[0, 0, 0, -1]] * 3 + [[0, 0, 0, 0]])


def blinds(period: float) -> dict:
    """Return slats above [-1, 1]^3, whose gaps are as wide as they are."""
    place = mi.ScalarTransform4f
    return {
        f"slat{k}": {
            "type": "rectangle",
            "to_world": place().translate([-2 + k * period, 1.2, 0]).rotate([1, 0, 0], 90)
            .scale([period / 4, 3, 1]),
        }
        for k in range(round(4 / period))
    }  # fmt: skip


def scene(shapes: dict, emitter: dict) -> mi.Scene:
    return mi.load_dict({"type": "scene", "emitter": emitter} | shapes, optimize=False)


DOWN = {"type": "directional", "direction": [0, -1, 0]}


@pytest.mark.parametrize("period", [0.4, 1.0])
def test_the_share_is_that_of_parallel_edges(period):
    """An edge lies between two positions with a mean horizontal distance of half a voxel; half of
    the positions are illuminated.
    """
    voxels = 32
    loaded, grid = scene(blinds(period), DOWN), Grid((voxels,) * 3, CUBE)
    crossed = 2 / voxels * 0.5 / (period / 2)  # probability of an edge between two positions
    expected = crossed / (0.5 + crossed / 2)
    assert share_of_edges(loaded, grid, loaded.emitters()[0]) == pytest.approx(expected, rel=0.1)


def test_boundaries_and_lack_of_light_have_no_edges():
    boundary = {"box": {"type": "cube", "bsdf": {"type": "null"}}}
    roof = {"roof": blinds(4.0)["slat0"] | {
        "to_world": mi.ScalarTransform4f().translate([0, 1.2, 0]).rotate([1, 0, 0], 90).scale(9)
    }}  # fmt: skip
    for shapes in (boundary, roof):
        loaded = scene(shapes, DOWN)
        assert share_of_edges(loaded, Grid((8,) * 3, CUBE), loaded.emitters()[0]) == 0


def lamp(size: float) -> dict:
    place = mi.ScalarTransform4f().translate([0, 4, 0]).rotate([1, 0, 0], 90).scale(size)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}


POINT = {"type": "point", "position": [0, 40, 0]}


@pytest.mark.parametrize(
    ("emitter", "period", "warned"),
    [
        (lambda: DOWN, 0.2, True),
        (lambda: DOWN, 1.3, False),
        (lambda: POINT, 0.2, True),
        (lambda: POINT, 1.3, False),
        (lambda: lamp(0.02), 0.2, True),
        (lambda: lamp(2), 0.2, False),
    ],
)
def test_fine_shadows_are_noted(logged, emitter, period, warned):
    """Beams between slats were wrong by 20 % in blocks of pixels, without a message. Those of wide
    lamps are not sharp.
    """
    loaded = scene(blinds(period), emitter())
    emitters = EmittersByKind(loaded.emitters())
    warn_of_fine_shadows(loaded, Grid((32,) * 3, CUBE), emitters, 'medium "fog"')
    assert len(logged) == warned
    if warned:
        assert 'medium "fog"' in logged[0] and "Raise resolution (now 32)" in logged[0]
