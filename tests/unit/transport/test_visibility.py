"""Transmittance between two points in one medium; the medium behind the second is ignored."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.transport.path import visibility

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize("varies", [False, True])
def test_transmittance_between_two_places(scenes, varies):
    """The transmittance is e^-tau of the segment between the points.

    The medium continues behind both; for a grid the mean of estimates agrees to 4 standard errors.
    """
    count, place = 1 << 14, scenes.placement()
    density = 1.5 * np.ones((4, 4, 8), np.float32)
    density[..., 4:] = 0.5  # for x > 0, linear in between over a quarter
    shape = scenes.boundary(scenes.medium(density if varies else 1.1, 0.5, place), place)
    beside = {"type": "sphere", "center": [0, 4, 0]}
    scene = scenes.load({"type": "volpath"}, shape, 2, beside=beside)
    media = compile_scene(scene).media
    (medium,) = media.grids
    vertex = dr.zeros(mi.Interaction3f, count)
    vertex.p = mi.Point3f(-0.6, 0.1, 0.2)
    through, _ = visibility(
        scene, media, vertex, mi.Point3f(0.5, 0.1, 0.2),
        mi.MediumPtr(medium.pointer), mi.PCG32(count), mi.Bool(True),
    )  # fmt: skip
    found = np.array(through.x + dr.zeros(mi.Float, count), np.float64)
    depth = 0.6 * 1.5 + 0.5 * 0.5 if varies else 1.1 * 1.1
    error = found.std() / np.sqrt(count)
    assert error < 0.01
    assert abs(found.mean() - np.exp(-depth)) < 4 * error + 1e-3
