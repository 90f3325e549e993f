"""Light that ends between voxels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.boundary import Boundary
from mitsuba_irrcache.edges import Edges
from mitsuba_irrcache.grid import ConstantField, Grid, RootField
from mitsuba_irrcache.medium import MediumGrid
from mitsuba_irrcache.scene import bake_media
from mitsuba_irrcache.shadows import Shadows

pytestmark = pytest.mark.usefixtures("rgb")

SIDE = 20


def shadows(sigma_t: float = 0.005, edges: Edges | None = None) -> Shadows:
    """In a homogeneous medium of so much optical depth per voxel."""
    grid = Grid((SIDE,) * 3, np.diag([SIDE, SIDE, SIDE, 1.0]))
    fields = (ConstantField(np.array([v])) for v in (sigma_t, 1.0))
    medium = MediumGrid(*fields, Boundary("box", grid.to_world))
    return Shadows(medium, grid, edges)


def corrected(rule: Shadows, phi: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """Roots, all voxels being active; ``phi`` is (z, y, x, channel)."""
    roots = mi.Float(np.sqrt(phi).ravel().astype(np.float32))
    active = dr.arange(mi.UInt32, SIDE**3)
    variance = dr.full(mi.Float, noise, dr.width(roots))
    return np.array(rule.corrected(roots, variance, active, phi.shape[-1])).reshape(phi.shape)


def mean_lookup(rule: Shadows, roots: np.ndarray) -> float:
    """Of one channel, far from the border: of 6^3 points between voxels."""
    field = RootField(rule.grid, mi.Float(roots.ravel()), 1)
    points = 1.5 + (np.arange(6 * (SIDE - 3)) + 0.5) / 6
    u = np.stack(np.meshgrid(points, points, points)).reshape(3, -1)
    return float(np.array(field.at(mi.Point3f(np.float32(u))), dtype=np.float64).mean())


def ball(radius: float) -> np.ndarray:
    """Light that ends at its surface, (z, y, x, 1)."""
    z, y, x = np.indices((SIDE,) * 3) + 0.5 - SIDE / 2 + np.reshape([0.1, 0.3, 0.2], (3, 1, 1, 1))
    return (np.sqrt(x**2 + y**2 + z**2) < radius).astype(float)[..., None]


@pytest.mark.parametrize("radius", [1.5, 5.5])
@pytest.mark.parametrize("dim", [0.0, 0.2])
def test_what_ends_keeps_its_light(radius, dim):
    """As much as is in the voxels, to a tenth of what interpolated roots lose: 3 to 40 % of what is
    in the ball.
    """
    phi, rule = dim + ball(radius) * (1 - dim), shadows()
    lit = (SIDE - 3) ** 3
    total, left = phi.sum() - dim * SIDE**3, dim * lit
    kept = mean_lookup(rule, corrected(rule, phi)) * lit - left
    plain = mean_lookup(rule, np.sqrt(phi)) * lit - left
    assert plain < 0.97 * total
    assert abs(kept - total) < 0.1 * (total - plain)


def test_light_that_matter_swallows_is_left_alone():
    """One mean free path per voxel: light falls off as fast as matter lets it."""
    phi = np.exp(-np.arange(SIDE, dtype=float))[:, None, None, None] * np.ones((1, SIDE, SIDE, 1))
    assert np.abs(corrected(shadows(1.0), phi) / np.sqrt(phi) - 1).max() < 0.005
    assert np.abs(corrected(shadows(0.01), phi) / np.sqrt(phi) - 1).max() > 0.02


def test_noise_is_no_shadow():
    """Even light with a noise of 20 %: where that is known, lookups are what they were, to 0.2 %.
    Else they have all its light, to 0.3 %, of which interpolated roots lose 0.7 %.
    """
    phi, rule = np.random.default_rng(1).gamma(25.0, 1 / 25, (SIDE, SIDE, SIDE, 1)), shadows()
    plain, exact = mean_lookup(rule, np.sqrt(phi)), phi[1:-1, 1:-1, 1:-1, 0]
    for _ in range(3):  # of what is linear between the voxels
        exact = np.moveaxis(0.5 * (exact[1:] + exact[:-1]), 0, -1)
    mean = exact.mean()
    assert mean_lookup(rule, corrected(rule, phi, 0.04)) == pytest.approx(plain, rel=0.002)
    assert plain < 0.994 * mean
    assert mean_lookup(rule, corrected(rule, phi)) == pytest.approx(mean, rel=0.003)


def test_channels_are_apart():
    one = ball(4.0)
    other = np.roll(one, 3, axis=0) * 0.5
    both = corrected(shadows(), np.concatenate([one, other, one], axis=-1))
    for c, alone in enumerate((one, other, one)):
        np.testing.assert_allclose(both[..., c : c + 1], corrected(shadows(), alone), rtol=1e-5)


def test_next_to_surfaces_nothing_is_interpolated():
    """A wall between bright and dark voxels: they keep their values."""
    place = mi.ScalarTransform4f().translate([0, 0, 9.9]).scale(100)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "to_world": place}})
    layers = np.where(np.arange(SIDE) < 10, 1.0, 0.1)
    phi = layers[:, None, None, None] * np.ones((1, SIDE, SIDE, 1))
    rule = shadows()
    walled = corrected(shadows(edges=Edges(scene, rule.grid)), phi)
    np.testing.assert_allclose(walled, np.sqrt(phi), rtol=1e-6)
    assert corrected(rule, phi).max() > 1.05


def test_no_shadows_no_work(scenes):
    """Only where something casts shadows, or a light is a beam."""
    cube = scenes.boundary(scenes.medium(1.0, 0.9))
    point = {"type": "point", "position": [0, 2, 0], "intensity": 1.0}
    spot = {"type": "spot", "intensity": 1.0}
    ball = {"type": "sphere", "center": [0, 5, 0]}
    for extra, wanted in (
        ({}, False), ({"emitter": point}, False), ({"emitter": spot}, True), ({"ball": ball}, True),
    ):  # fmt: skip
        scene = mi.load_dict(scenes.description(cube, None, 4) | extra)
        (medium,) = bake_media(scene)
        grid = Grid((4, 4, 4), np.eye(4))
        assert (Shadows.of(scene, medium, grid) is not None) == wanted, extra
