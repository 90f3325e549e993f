"""Shares of voxels in media whose boundaries have any shape."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.scene.media_shares import media_in, media_shares, why_shared
from tests.support.surfaces import ball, bound, fog, ref
from tests.support.torus import torus

pytestmark = pytest.mark.usefixtures("rgb")


def compiled(objects: dict) -> tuple[mi.Scene, tuple]:
    """Return a scene and its media."""
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}} | objects)
    return scene, compile_scene(scene).media.grids


def hole(center, radius: float, **more) -> dict:
    """Return a ball in the medium "fog", with another interior or none."""
    return ball(center, radius, bsdf={"type": "null"}, exterior=ref("fog"), **more)


def nested() -> dict:
    """Return a ball in a ball."""
    return {
        "fog": fog(),
        "core": fog((4.0, 4.0, 4.0)),
        "outer": bound("sphere", ref("fog"), (0.1, 0, 0)),
        "inner": hole((0.2, 0.1, -0.2), 0.5, interior=ref("core")),
    }


def test_volumes_of_nested_balls(scenes):
    """The shares sum up to the volumes, also in a rotated grid with unequal voxels."""
    scene, media = compiled(nested())
    grid = Grid((19, 24, 13), scenes.placement((3.4, 3.0, 2.8), turn=35, center=(0.1, 0, 0)))
    shares = np.array([np.array(share) for share in media_shares(scene, media, grid)])
    found = shares.mean(axis=1) * 3.4 * 3.0 * 2.8
    outer, inner = (4 / 3 * np.pi * radius**3 for radius in (1, 0.5))
    np.testing.assert_allclose(found, [outer - inner, inner], rtol=2e-3)
    assert shares.min() >= 0 and shares.sum(axis=0).max() <= 1 + 1e-5


def test_each_voxel_of_a_ring(scenes):
    """The share of a mesh with a hole in each voxel is that of points which lie within it."""
    n, points = 12, 12
    scene, media = compiled({"ring": torus(fog(), 0.6, 0.3)})
    (share,) = media_shares(scene, media, Grid((n, n, n), scenes.placement()))
    share = np.array(share).reshape(n, n, n)
    z, y, x = (np.indices((n * points,) * 3) + 0.5) / (n * points) * 2 - 1
    inside = (np.hypot(x, z) - 0.6) ** 2 + y**2 < 0.3**2
    expected = inside.reshape(n, points, n, points, n, points).mean(axis=(1, 3, 5))
    assert share[n // 2, n // 2, n // 2] == 0 and share.max() == 1
    assert np.abs(share - expected).max() < 0.06  # triangles, and 8 x 8 rays per column
    assert np.abs(share - expected).mean() < 3e-3


def test_faces_of_a_grid_and_of_a_medium_may_coincide(scenes):
    """A cube fills exactly the voxels of its own box, also those at its faces."""
    media = {"fog": fog(), "other": fog((2.0, 2.0, 2.0))}
    left = bound(interior=ref("fog"), center=(-1, 0, 0))
    right = bound(interior=ref("other"), center=(1.2, 0, 0))
    scene, media = compiled(media | {"left": left, "right": right})
    grid = Grid((4, 5, 6), scenes.placement(center=(-1, 0, 0)))
    for medium, share in zip(media, media_shares(scene, media, grid), strict=True):
        filled = 1.0 if medium.name == "fog" else 0.0
        np.testing.assert_allclose(np.array(share), filled, atol=1e-5)


def test_why_voxels_are_shared(scenes):
    """Meshes, nested media and holes are named; a box alone is not shared."""
    grid = Grid((8, 8, 8), scenes.placement())
    whole = np.zeros(3, int), grid.resolution
    box = {"fog": fog(), "box": bound(interior=ref("fog"))}
    cases = {
        "other shapes than one box or sphere": {"ring": torus(fog(), 0.6, 0.3)},
        "reaches into": nested(),
        "is a hole in": box | {"hole": hole((0, 0, 0), 0.3)},
    }
    for reason, objects in cases.items():
        scene, (medium, *_) = compiled(objects)
        assert reason in why_shared(scene, medium, grid, whole)
    scene, (medium,) = compiled(box | {"post": ball((0, 0, 9))})
    assert why_shared(scene, medium, grid, whole) is None


def test_media_in_a_box():
    """The inner medium lies in the box of the outer one, and not the other way round."""
    _, (outer, inner) = compiled(nested())
    assert media_in(outer, Grid((4, 4, 4), outer.frame)) == [outer.others[0]]
    assert media_in(inner, Grid((4, 4, 4), inner.frame)) == []
