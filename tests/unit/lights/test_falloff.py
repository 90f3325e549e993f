"""Inverse-square factors of nearby emitters, along rays and over voxels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import quad

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.falloff import LARGEST, MOST_DISTANCE, InverseSquareFactor

pytestmark = pytest.mark.usefixtures("rgb")

LAMP = np.array([0.53, 0.41, 0.62])


def grid_of(n: int = 8, size: float = 1.0) -> Grid:
    return Grid((n, n, n), np.diag([size, size, size, 1.0]))


def falloff(position=LAMP, n: int = 8, **more) -> InverseSquareFactor:
    light = {"type": "point", "position": np.array(position).tolist(), "intensity": 3.0} | more
    return InverseSquareFactor.of(mi.load_dict({"type": "scene", "light": light}), grid_of(n))


def value(found: InverseSquareFactor, p: np.ndarray) -> np.ndarray:
    return np.array(found.at(mi.Point3f(np.float32(p))))


def test_factor_depends_on_the_distance():
    """The factor is 1 + (16 h / r)^2, whatever the intensity."""
    p = np.random.default_rng(1).random((3, 50))
    squares = np.sum((p - LAMP[:, None]) ** 2, axis=0)
    np.testing.assert_allclose(
        value(falloff(), p), 1 + (MOST_DISTANCE / 8) ** 2 / squares, rtol=1e-3
    )


@pytest.mark.parametrize("aside", [0.0, 1e-3, 0.04, 0.3])
@pytest.mark.parametrize(("a", "b"), [(0.2, 0.9), (0.45, 0.46), (0.0, 1e-3), (0.52, 0.54)])
def test_means_along_a_ray(aside, a, b):
    """Means along a segment agree with adaptive quadrature, near, far and through the emitter."""
    found = falloff()
    origin = LAMP - [0.53, 0, 0] + [0, aside, 0]
    ray = mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(1, 0, 0))
    measured = found.means(found.along(ray), mi.Float(a), mi.Float(b))

    def w(t: float) -> float:
        squared = (t - 0.53) ** 2 + aside**2 + (1e-3 / 8) ** 2
        return 1 + (MOST_DISTANCE / 8) ** 2 / squared

    for k, mean in enumerate(measured):
        weighted = quad(
            lambda u, k=k: 2 * (u if k else 1 - u) * w(a + u * (b - a)),
            0, 1, points=[np.clip((0.53 - a) / (b - a), 0, 1)], limit=500,
        )[0]  # fmt: skip
        assert mean[0] == pytest.approx(weighted, rel=2e-3)


def test_means_over_voxels():
    """Means over voxels agree with a fine sum to 1.5 %, 0.5 % and 0.1 %.

    The bounds are for the emitter's own voxel, its neighbours, and farther ones.
    """
    position = np.array([4.5, 4.5, 4.5]) / 8
    found = falloff(position)
    fine = (np.arange(96) + 0.5) / 96
    offsets = np.stack(np.meshgrid(fine, fine, fine, indexing="ij"), axis=-1).reshape(-1, 3)
    for voxel, tolerance in (((4, 4, 4), 0.015), ((5, 4, 4), 5e-3), ((7, 4, 5), 1e-3)):
        index = mi.UInt32(voxel[0] + 8 * (voxel[1] + 8 * voxel[2]))
        mean = found.spread(index)[0] * found.of_voxels(index)[0]
        squares = np.sum(((np.array(voxel) + offsets) / 8 - position) ** 2, axis=1)
        expected = 1 + np.mean((MOST_DISTANCE / 8) ** 2 / squares)
        assert mean == pytest.approx(expected, rel=tolerance)


def test_only_near_and_small_emitters_have_a_factor():
    """Only near and small emitters get a factor; others vary smoothly between voxels."""
    assert falloff([0.5, 0.5, 1 + 0.9 * MOST_DISTANCE / 8]) is not None
    assert falloff([0.5, 0.5, 1 + 1.1 * MOST_DISTANCE / 8]) is None
    for size, near in ((0.5, True), (2.0, False)):
        place = mi.ScalarTransform4f().translate([0.5, 0.5, 1.2]).scale(size * LARGEST / 8)
        lamp = {"type": "disk", "to_world": place, "emitter": {"type": "area"}}
        found = InverseSquareFactor.of(mi.load_dict({"type": "scene", "lamp": lamp}), grid_of())
        assert (found is not None) == near
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}})
    assert InverseSquareFactor.of(scene, grid_of()) is None


def test_small_sphere_equals_a_point_at_a_distance():
    """A sphere's factor is that of a point from a distance of five radii on, within 8 %."""
    ball = {"type": "sphere", "center": LAMP.tolist(), "radius": 0.02, "emitter": {"type": "area"}}
    found = InverseSquareFactor.of(mi.load_dict({"type": "scene", "ball": ball}), grid_of())
    p = np.random.default_rng(2).random((3, 200))
    far = np.linalg.norm(p - LAMP[:, None], axis=0) > 0.1
    np.testing.assert_allclose(value(found, p)[far], value(falloff(), p)[far], rtol=0.12)


def test_emitter_in_the_middle_of_a_single_voxel():
    """The factor is finite everywhere, also at the emitter, in a grid of one voxel."""
    found = falloff([0.5, 0.5, 0.5], n=1)
    assert np.isfinite(value(found, np.full((3, 1), 0.5))).all()
    assert np.isfinite(np.array(found.spread(mi.UInt32(0)))).all()
    ray = mi.Ray3f(mi.Point3f(0, 0.5, 0.5), mi.Vector3f(1, 0, 0))
    means = found.means(found.along(ray), mi.Float(0), mi.Float(1))
    assert all(np.isfinite(np.array(m)).all() and dr.all(m > 1)[0] for m in means)
