"""A marked voxel of an imported file is seen where its file places it.

``irrcache import`` writes a scene of a volume that is zero but for one voxel beside the middle.
Mitsuba renders it through two cameras that know nothing of the grid; the centre of what they see,
traced back along their rays, is the world position of that voxel.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cli.main import main
from tests.support.volume_files import MARKED, WRITTEN, marker

PIXELS = 48


def seen_centre(scene: mi.Scene, target: np.ndarray, towards: np.ndarray, radius: float):
    """Return origin and direction of the ray through the centre of what a parallel camera sees."""
    up = [0, 1, 0] if abs(towards[2]) > 0.9 else [0, 0, 1]
    view = mi.ScalarTransform4f().look_at(
        origin=(target + 4 * radius * towards).tolist(), target=target.tolist(), up=up
    )
    sensor = mi.load_dict(
        {
            "type": "orthographic",
            "to_world": view @ mi.ScalarTransform4f().scale([radius, radius, 1.0]),
            "far_clip": 10 * radius,
            "sampler": {"type": "independent"},
            "film": {
                "type": "hdrfilm",
                "width": PIXELS,
                "height": PIXELS,
                "rfilter": {"type": "box"},
            },
        }
    )
    image = np.array(mi.render(scene, sensor=sensor, spp=128, seed=3))[..., :3].sum(axis=2)
    rows, columns = (np.arange(PIXELS) + 0.5) / PIXELS, (np.arange(PIXELS) + 0.5) / PIXELS
    u, v = (image.sum(0) @ columns) / image.sum(), (image.sum(1) @ rows) / image.sum()
    ray, _ = sensor.sample_ray(0.0, 0.5, [float(u), float(v)], [0.5, 0.5])
    return np.array(ray.o).ravel(), np.array(ray.d).ravel()


@pytest.mark.parametrize("name", WRITTEN)
def test_marked_voxel_is_seen_where_the_file_places_it(rgb, tmp_path, name):
    written = WRITTEN[name]
    path = written.make(tmp_path, marker())
    out = tmp_path / "scene"
    arguments = ["import", str(path), "--density", "2", *written.options, "-o", str(out)]
    assert main(arguments) == 0
    scene = mi.load_file(str(out / "scene.xml"), hide_emitters="true")
    z, y, x = marker().shape
    matrix = written.index_to_world
    if written.options[:1] == ("--spacing",):
        matrix = np.diag([*map(float, written.options[1].split(",")), 1.0])
    expected = (matrix @ (*MARKED, 1.0))[:3]
    middle = (matrix @ ((x - 1) / 2, (y - 1) / 2, (z - 1) / 2, 1.0))[:3]
    radius = 0.6 * float(np.linalg.norm(matrix[:3, :3] @ (x, y, z)))
    assert np.linalg.norm(expected - middle) > 0.2 * radius  # a wrong order of axes would be seen
    for towards in (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])):
        origin, direction = seen_centre(scene, middle, towards, radius)
        offset = expected - origin
        distance = np.linalg.norm(offset - direction * (offset @ direction))
        assert distance < 0.25 * min(written.spacing)
