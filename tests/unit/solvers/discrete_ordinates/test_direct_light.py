"""Direct illumination by area emitters that are sampled from each voxel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.discrete_ordinates.direct_light import (
    FEWEST_SAMPLES,
    MOST_RAYS,
    MOST_SAMPLES,
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


def test_the_number_of_points_follows_the_variance(scenes):
    """A distant sphere takes the fewest points; texels of different colours above the medium take
    more, and fewer at more positions.
    """
    texels = np.zeros((4, 4, 3), np.float32)
    texels[1, 2], texels[2, 0] = (40, 0, 0), (0, 1, 1)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    above = mi.ScalarTransform4f().translate([0, 1.4, 0]).rotate([1, 0, 0], 90)
    lamps = {
        "far": {"type": "sphere", "center": [0, 9, 0], "radius": 0.5},
        "near": {"type": "rectangle", "to_world": above},
    }
    lamps["far"]["emitter"] = {"type": "area", "radiance": 1.0}
    lamps["near"]["emitter"] = {"type": "area", "radiance": radiance}
    found = {}
    for name, lamp in lamps.items():
        integrator = {"type": "irrcache", "solver": "sweep"}
        shape = scenes.boundary(scenes.medium(0.5, 0.5))
        scene = scenes.load(integrator, shape, 2, emitter=None, sun=None, lamp=lamp)
        (medium,) = compile_scene(scene).visible
        for width in (16, 48):
            rng = np.random.default_rng(width)
            p = mi.Point3f(np.float32(rng.uniform(-1, 1, (3, width**3))))
            sampling = EmitterSampling(scene, medium, scene.emitters(), [], p)
            found[name, width] = sampling.points_per_voxel
    assert found["far", 16] == found["far", 48] == FEWEST_SAMPLES
    assert found["near", 16] == MOST_SAMPLES
    assert FEWEST_SAMPLES < found["near", 48] <= MOST_RAYS // 48**3
