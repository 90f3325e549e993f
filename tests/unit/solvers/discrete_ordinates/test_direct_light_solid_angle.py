"""Classification of small emitters by their solid angle as seen from a medium."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.solvers.discrete_ordinates import direct_light

pytestmark = pytest.mark.usefixtures("rgb")


def seen(lamp: dict, scale: float) -> tuple[float, list, list]:
    """Return an emitter's solid angle from a small box at the origin, and whether it is small or
    large.

    All lengths are multiplied by ``scale``.
    """
    place = lamp.pop("to_world")
    to_world = mi.ScalarTransform4f().scale(scale) @ place
    shape = lamp | {"to_world": to_world, "emitter": {"type": "area"}}
    scene = mi.load_dict({"type": "scene", "lamp": shape})
    frame = np.diag([0.02 * scale] * 3 + [1.0])
    frame[:3, 3] = -0.01 * scale
    grid = Grid((4, 4, 4), frame)
    box = np.zeros(3, int), grid.resolution
    (emitter,) = scene.emitters()
    return direct_light._solid_angle(emitter, grid, *box), *direct_light.split_by_solid_angle(
        scene, grid, *box
    )


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("distance", [0.7, 1.5, 4.0])
def test_solid_angle_of_a_disc(distance, scale):
    """The solid angle of a disk of radius 1 is 2 pi (1 - cos), whatever the unit of length."""
    place = mi.ScalarTransform4f().translate([0, 0, distance])
    angle, small, large = seen({"type": "disk", "to_world": place}, scale)
    expected = 2 * np.pi * (1 - distance / np.hypot(distance, 1))
    assert angle == pytest.approx(expected, rel=0.05)
    assert (len(small), len(large)) == (
        (1, 0) if expected < direct_light.LARGE_SOLID_ANGLE else (0, 1)
    )
