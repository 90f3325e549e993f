"""Direct illumination by area emitters that are sampled from each voxel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.discrete_ordinates.direct_light import (
    EmitterSampling,
    is_area_emitter,
)

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize("count", [1, 2, 5, 20])
def test_sampled_emitters_add_up(scenes, count):
    """Many emitters sampled one at a time give the sum of all.

    Emissive spheres of different radiance, without extinction: 2 pi (1 - cos) times the radiance of
    each, on average over 4096 estimates, to 4 standard errors, these below 2 %.
    """
    rng, objects, expected = np.random.default_rng(5), {}, 0.0
    for i in range(count):
        place = rng.normal(size=3)
        place *= rng.uniform(2.5, 4) / np.linalg.norm(place)
        radius, radiance = rng.uniform(0.1, 0.3), float(np.exp(rng.uniform(-1.5, 1.5)))
        lamp = {"type": "sphere", "center": place.tolist(), "radius": radius}
        objects[f"lamp{i}"] = lamp | {"emitter": {"type": "area", "radiance": radiance}}
        cosine = np.sqrt(1 - radius**2 / (place @ place))
        expected += 2 * np.pi * (1 - cosine) * radiance
    shape = scenes.boundary(scenes.medium(0.0, 0.5))
    scene = scenes.load(
        {"type": "irrcache", "solver": "path"}, shape, 2, emitter=None, sun=None, **objects
    )
    (medium,) = compile_scene(scene).visible
    small = [e for e in scene.emitters() if is_area_emitter(e)]
    assert len(small) == count
    centre = mi.Point3f(dr.zeros(mi.Float, 4096), 0, 0)
    found = EmitterSampling(scene, medium, small, [], centre).from_area_emitters((1, 2))
    light = np.array(found[0][0], np.float64)
    error = light.std() / np.sqrt(len(light))
    assert error < 0.02 * expected
    assert abs(light.mean() - expected) < 4 * error + 1e-3 * expected
