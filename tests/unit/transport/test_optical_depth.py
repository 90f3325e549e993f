"""The optical depth along rays is exact for any voxels, contrast and direction."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.boundary import Boundary
from mitsuba_irrcache.grids.fields import ConstantField, GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.tracking import OPAQUE, optical_depth

pytestmark = pytest.mark.usefixtures("rgb")

UNIT_TO_CUBE = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
RAYS, STEPS = 99, 2000


def medium(shape: tuple[int, int, int], channels: int, contrast: float) -> MediumGrid:
    """Return random extinction on a sheared, rotated grid, zero in every third voxel."""
    rng = np.random.default_rng(sum(shape) + channels)
    values = contrast ** -rng.random((*shape, channels)).astype(np.float32) * 3
    values[rng.random(shape) < 1 / 3] = 0
    to_world = np.eye(4)
    to_world[:3, :3] = rng.normal(size=(3, 3))
    to_world[:3, 3] = 0.3, -2, 1
    field = GridField(Grid(shape, to_world), mi.Float(values.ravel()), channels)
    return MediumGrid(
        field, ConstantField(np.array([0.5])), Boundary("box", to_world @ UNIT_TO_CUBE)
    )


def segments(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return segment ends (3, n) in the unit cube.

    A third are parallel to an axis, in planes through centres or between voxels, and a third are
    short.
    """
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 3, RAYS))
    third = RAYS // 3
    on_planes = rng.integers(0, 2 * grid.resolution[:, None] + 1, (3, third))
    a[:, :third] = b[:, :third] = on_planes / (2 * grid.resolution[:, None])
    axis = rng.integers(0, 3, third)
    a[axis, np.arange(third)], b[axis, np.arange(third)] = rng.random((2, third))
    b[:, -third:] = a[:, -third:] + 1e-3 * (b[:, -third:] - a[:, -third:])
    return a, b


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("contrast", [10.0, 1e8])
@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 4, 4), (1, 1, 9), (5, 1, 3), (23, 17, 20)])
def test_optical_depth_agrees_with_many_small_steps(shape, contrast, channels):
    """The midpoint rule with 2000 steps agrees; its error is about 1e-5 of the largest value
    here.
    """
    found = medium(shape, channels, contrast)
    grid = found.sigma_t.grid
    a, b = (grid.to_world[:3, :3] @ p + grid.to_world[:3, 3:] for p in segments(grid))
    length = np.linalg.norm(b - a, axis=0)
    ray = mi.Ray3f(mi.Point3f(a), mi.Vector3f((b - a) / length))
    far = mi.Float(length)
    depth = np.array(optical_depth(found, ray, mi.Float(0), far, mi.Bool(True)))
    t = (np.arange(STEPS) + 0.5)[:, None] / STEPS
    points = (a[..., None, :] + (b - a)[..., None, :] * t).reshape(3, -1)
    values = np.array(found.sigma_t.at_world(mi.Point3f(points)), dtype=np.float64)
    expected = values.reshape(*depth.shape[:-1], STEPS, RAYS).mean(axis=-2) * length
    np.testing.assert_allclose(depth, expected, rtol=5e-5, atol=5e-5 * expected.max())


def test_parts_add_up_and_opaque_media_end_the_march():
    found = medium((6, 5, 4), 1, 1e4)
    rng = np.random.default_rng(2)
    origin = mi.Point3f(found.sigma_t.grid.to_world[:3, 3:] - 5 * rng.random((3, 64)))
    target = found.sigma_t.grid.world.point(mi.Point3f(rng.random((3, 64)) * [[4], [5], [6]]))
    ray = mi.Ray3f(origin, dr.normalize(target - origin))
    hit, near, far = found.intersect(ray)
    middle = 0.3 * near + 0.7 * far
    parts = [
        np.array(optical_depth(found, ray, a, b, hit)) for a, b in ((near, middle), (middle, far))
    ]
    whole = np.array(optical_depth(found, ray, near, far, hit))
    assert whole.max() > 0
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-4, atol=1e-5)
    dense = medium((6, 5, 4), 1, 1e4)
    dense.sigma_t.scale = dr.opaque(mi.Float, 1e4)
    dense = dense.replaced(sigma_t=dense.sigma_t)  # with the macrocells of what it is now
    assert np.array(optical_depth(dense, ray, near, far, hit))[whole > 0.1].min() > OPAQUE
