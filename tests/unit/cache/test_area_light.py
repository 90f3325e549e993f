"""Optical depths between positions in a medium and an area emitter."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.limits.reference import Extinction
from experiments.validation.limits.reference import _light as light_at
from mitsuba_irrcache.cache.area_light import AreaLight, area_lights_of
from mitsuba_irrcache.cache.direct_light import DirectLightAlongRays
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import active_voxels
from mitsuba_irrcache.scene.compile import compile_scene
from tests.support.slow import with_slow

pytestmark = pytest.mark.usefixtures("rgb")

SIGMA_T, HALF_WIDTH, HEIGHT, VOXELS = 6.0, 1.5, 1.3, 24


def transmittance(p: np.ndarray) -> np.ndarray:
    """Integrate the mean transmittance between positions (n, 3) in the cube [-1, 1]^3 and the
    emitter, weighted by solid angle.
    """
    at = (np.arange(400) + 0.5) / 400 * 2 * HALF_WIDTH - HALF_WIDTH
    x, z = (c.ravel() for c in np.meshgrid(at, at))
    result = []
    for point in p:
        offset = np.stack([x, np.full(x.size, HEIGHT), z], -1) - point
        distance = np.linalg.norm(offset, axis=1)
        w = offset / distance[:, None]
        within = np.maximum((-1 - point) / w, (1 - point) / w).min(axis=1)
        weight = w[:, 1] / distance**2
        result.append((weight * np.exp(-SIGMA_T * within)).sum() / weight.sum())
    return np.array(result)


def mean_lookup(light: AreaLight, p: np.ndarray) -> np.ndarray:
    """Average transmittances with many shifts of the points on the emitter, at positions (3, n)."""
    count, n = 4096, p.shape[1]
    at = mi.Point3f(np.float32(np.repeat(p, count, axis=1)))
    shift = mi.Vector2f(np.float32(np.random.default_rng(2).random((2, n * count))))
    depth = light.depth_of(light.extinction.at_world(at), at, shift)
    return np.exp(-np.array(depth, dtype=float)).reshape(n, count).mean(axis=1)


def test_faces_that_an_emitter_irradiates_at_grazing_angles(scenes):
    """The transmittance is right next to all faces of a dense medium.

    When a mean extinction along single lines was extrapolated from the voxel centres, it was up
    to a third too large there. Lookups use a few random points, of which a mean is tested.
    """
    shape = scenes.boundary(scenes.medium(SIGMA_T, 0.9))
    place = mi.ScalarTransform4f().look_at([0, HEIGHT, 0], [0, 0, 0], [0, 0, 1]).scale(HALF_WIDTH)
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}
    scene = scenes.load({"type": "irrcache", "solver": "sweep"}, shape, emitter=lamp)
    (medium,) = compile_scene(scene).visible
    grid = Grid.near_cubic(medium.frame, VOXELS)
    (light,) = area_lights_of(scene, medium, grid, active_voxels(medium, grid), samples=1024)
    u = np.random.default_rng(1).uniform(-0.8, 0.8, (3, 8))
    for axis, side in ((0, 1), (0, -1), (2, 1), (1, 1)):
        for inwards in (0.0, 0.25, 0.5):  # in voxels
            p = u.copy()
            p[axis] = side * (1 - inwards * 2 / VOXELS)
            found = mean_lookup(light, p)
            error = found / transmittance(p.T) - 1
            assert np.abs(error).max() < 0.04, (axis, side, inwards)
            assert abs(error.mean()) < 0.015, (axis, side, inwards)


def test_coarse_data_of_high_contrast(scenes):
    """The light of a wide emitter that random matter scatters towards a camera is right to 1.5 %,
    with three voxels along each data voxel, against a quadrature that shares no code.

    Where the irradiance decided which lines have the smallest error, wherever matter is, this was
    6.5 % too dark.
    """
    values = np.concatenate([np.geomspace(1e-5, 1e-3, 256), np.linspace(0.4, 1, 256)])
    values = np.random.default_rng(3).permutation(values * 17).reshape(8, 8, 8)
    cube = mi.ScalarTransform4f().translate(-1).scale(2)
    volume = mi.VolumeGrid(np.float32(values[..., None]))
    sigma_t = {"type": "gridvolume", "grid": volume, "raw": True, "to_world": cube}
    shape = scenes.boundary({"type": "heterogeneous", "sigma_t": sigma_t, "albedo": 0.8})
    place = mi.ScalarTransform4f().look_at([0, HEIGHT, 0], [0, 0, 0], [0, 0, 1]).scale(HALF_WIDTH)
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}
    scene = scenes.load({"type": "irrcache", "solver": "sweep"}, shape, emitter=lamp)
    (medium,) = compile_scene(scene).visible
    grid = Grid.near_cubic(medium.frame, 24)
    (light,) = area_lights_of(scene, medium, grid, active_voxels(medium, grid), samples=1024)
    p = mi.Point3f(np.float32(np.random.default_rng(1).uniform(-1, 1, (3, 1 << 15))))
    extinction = Extinction(np.float32(values))
    found = DirectLightAlongRays(light).at(p, mi.Bool(True))[0]
    expected = 4 * dr.pi * light_at("isotropic", scene.emitters()[0], extinction, p, p, 64)
    towards = mi.Vector3f(0, 0, -1)
    weight = extinction.at(p) * extinction.transmittance(p, towards, mi.Float(10))
    ratio = dr.sum(weight * found)[0] / dr.sum(weight * expected)[0]
    assert ratio == pytest.approx(1, abs=0.015)


@pytest.mark.parametrize("turn", with_slow([0.0, 30.0], 0.0))
@pytest.mark.parametrize("half_width", [0.1, 0.23, 0.4])
def test_transmittance_next_to_a_luminous_box(scenes, half_width, turn):
    """Within a voxel of a box in a medium, where lookups use voxels whose centre is in the box, the
    mean transmittance is right.

    When optical depths of those were divided by their distance from the box, 0, single scattering
    was up to 20 % too dark there.
    """
    sigma_t, points = 3.0, 60
    look = mi.ScalarTransform4f().translate([0.13, -0.07, 0.2])
    place = look.rotate([0, 1, 0.3], turn).scale(half_width)
    lamp = {"type": "cube", "to_world": place, "emitter": {"type": "area"}}
    shape = scenes.boundary(scenes.medium(sigma_t, 0.9))
    scene = scenes.load({"type": "irrcache", "solver": "sweep"}, shape, emitter=lamp)
    (medium,) = compile_scene(scene).visible
    grid = Grid.near_cubic(medium.frame, VOXELS)
    (light,) = area_lights_of(scene, medium, grid, active_voxels(medium, grid), samples=1024)

    to_world = np.array(place.matrix)
    rng = np.random.default_rng(1)
    outside = rng.uniform(-1, 1, (3, points))
    axis, distance = rng.integers(3, size=points), rng.uniform(0.01, 1, points) * 2 / VOXELS
    outside[axis, np.arange(points)] = 1 + distance / half_width
    p = (to_world[:3, :3] @ outside + to_world[:3, 3:]).T

    at = (np.arange(200) + 0.5) / 100 - 1
    x, y = (c.ravel() for c in np.meshgrid(at, at))
    passed, total = np.zeros(points), np.zeros(points)
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.insert(np.stack([x, y]), axis, side, axis=0)
            face = (to_world[:3, :3] @ face + to_world[:3, 3:]).T
            normal = side * to_world[:3, axis] / half_width
            offset = face[None] - p[:, None]
            length = np.linalg.norm(offset, axis=2)
            weight = np.maximum(-offset @ normal, 0) / length**3
            total += weight.sum(axis=1)
            passed += (weight * np.exp(-sigma_t * length)).sum(axis=1)
    position = mi.Point3f(np.float32(p.T))
    found = np.exp(-np.array(light.depth_of(light.extinction.at_world(position), position)))
    error = found / (passed / total) - 1
    assert np.abs(error).max() < 0.25
    assert np.abs(error).mean() < 0.06
    assert abs(error.mean()) < 0.03
