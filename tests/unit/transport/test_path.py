"""Path tracing with surfaces and media, in cases with known results."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.path.estimator import contributions
from mitsuba_irrcache.transport.path import power_heuristic, visibility
from mitsuba_irrcache.transport.path_tracer import PathTracer

pytestmark = pytest.mark.usefixtures("rgb")

COUNT = 1 << 16
INFINITE = 0xFFFFFFFF


def irradiance(scene, position, max_depth=INFINITE, count=COUNT) -> tuple[np.ndarray, ...]:
    """Return the mean irradiance at a position in the first medium, and its standard error.

    It is separated into uncollided and scattered; the error is that of their sum.
    """
    description = compile_scene(scene)
    medium = description.visible[0]
    rng = mi.PCG32(count)
    spread = [rng.next_float32() for _ in range(4)]
    limits = [dr.opaque(mi.UInt32, depth) for depth in (max_depth, 1000)]
    tracer = PathTracer(scene, description.media, *limits)
    found = contributions(tracer, mi.Point3f(position), medium.pointer, spread, rng)
    layers = [np.array(sum(f[i] for f in found)) for i in (1, 2)]
    assert all(np.allclose(np.linalg.norm(np.array(f[0]), axis=0), 1, atol=1e-4) for f in found)
    error = (layers[0] + layers[1]).std(axis=1) / count**0.5
    return layers[0].mean(axis=1), layers[1].mean(axis=1), error


def room(scenes, extinction, albedo, radiance=1.0, reflectance=0.0, radius=1.5) -> mi.Scene:
    """Return a medium in a box in a closed room with emissive walls."""
    walls = {
        "type": "sphere", "radius": radius, "flip_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": reflectance},
        "emitter": {"type": "area", "radiance": radiance},
    }  # fmt: skip
    box = scenes.boundary(scenes.medium(extinction, albedo), scenes.placement((1.4, 1.2, 1.0)))
    return scenes.load({"type": "volpath"}, box, walls=walls, emitter=None, sun=None)


@pytest.mark.parametrize("extinction", [0.0, 3.0, (0.9, 0.4, 0.1)])
def test_furnace(scenes, extinction):
    """Without absorption the radiance is that of the walls everywhere, in all directions."""
    straight, scattered, error = irradiance(room(scenes, extinction, 1.0), (0.2, -0.1, 0.3))
    assert (np.abs(straight + scattered - 4 * np.pi) < 4 * error + 1e-3).all()
    assert ((scattered > 0.1) == (np.array(extinction) > 0)).all()


def test_reflections_form_a_geometric_series(scenes):
    """In a nearly empty medium, reflections between walls form a geometric series.

    max_depth truncates it; emission is order 0, of depth 1 at the voxel.
    """
    scene = room(scenes, 0.0, 1.0, reflectance=0.5)
    for max_depth, total in ((2, 1.0), (3, 1.5), (4, 1.75), (INFINITE, 2.0)):
        straight, scattered, error = irradiance(scene, (0.1, 0, 0), max_depth)
        assert (np.abs(straight - 4 * np.pi) < 4 * error + 1e-3).all()
        assert (np.abs(straight + scattered - 4 * np.pi * total) < 4 * error + 2e-3).all()


def test_disk_emitter_above(scenes):
    """A disk of solid angle 2 pi (1 - cos) is sampled correctly by both strategies."""
    place = mi.ScalarTransform4f().translate([0, 2, 0]).rotate([1, 0, 0], 90)
    disc = {"type": "disk", "to_world": place, "emitter": {"type": "area", "radiance": 3.0}}
    box = scenes.boundary(scenes.medium(0.0, 0.5))
    scene = scenes.load({"type": "volpath"}, box, disc=disc, emitter=None, sun=None)
    straight, scattered, error = irradiance(scene, (0, 0, 0), 2)
    assert (np.abs(straight - 3 * 2 * np.pi * (1 - 2 / 5**0.5)) < 4 * error + 1e-3).all()
    assert (scattered == 0).all() and (error < 0.1).all()


def test_visibility(scenes):
    """Transmittance to an emitter includes two media and a null surface of opacity 1/4.

    A wall blocks it.
    """
    to_world = scenes.placement((1, 1, 1), center=(0, 0, 0))
    objects = {
        "next": scenes.boundary(scenes.medium(0.8, 0.5), scenes.placement(center=(3, 0, 0))),
        "veil": {
            "type": "sphere", "center": [6, 0, 0],
            "bsdf": {"type": "mask", "opacity": 0.25, "nested": {"type": "diffuse"}},
        },
        "wall": {"type": "sphere", "center": [0, 5, 0]},
    }  # fmt: skip
    shape = scenes.boundary(scenes.medium((0.2, 0.4, 0.6), 0.5), to_world)
    scene = scenes.load({"type": "volpath"}, shape, **objects)
    media = compile_scene(scene).media
    medium = next(m for m in media.grids if m.sigma_t.channels == 3)
    vertex = dr.zeros(mi.Interaction3f, 2)
    target = mi.Point3f([9.0, 0.0], [0.0, 9.0], [0.0, 0.0])
    through, _ = visibility(
        scene, media, vertex, target, mi.MediumPtr(medium.pointer), mi.PCG32(2), mi.Bool(True)
    )
    expected = np.exp(-np.array([0.1, 0.2, 0.3]) - 1.6) * 0.75**2
    np.testing.assert_allclose(np.array(through)[:, 0], expected, rtol=1e-3)
    assert not np.array(through)[:, 1].any()


def test_power_heuristic():
    """The weights of two strategies sum to one; a density of 0 has the weight 0."""
    a, b = mi.Float([1.0, 2.0, 0.0, 3.0]), mi.Float([3.0, 2.0, 1.0, 0.0])
    both = power_heuristic(a, b) + power_heuristic(b, a)
    np.testing.assert_allclose(np.array(both), 1)
    np.testing.assert_allclose(np.array(power_heuristic(a, b)), [0.1, 0.5, 0, 1])
