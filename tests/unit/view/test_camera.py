"""Rays of orbiting cameras equal those of Mitsuba's sensors."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.view.camera import Camera, Placement, camera_of, sensors_of

pytestmark = pytest.mark.usefixtures("rgb")


def sensor(fov_axis: str = "x", up=(0, 0, 1), size=(48, 32)) -> mi.Sensor:
    look = mi.ScalarTransform4f().look_at([3.0, -4.0, 2.0], [0.5, 0.2, -0.1], list(up))
    film = {"type": "hdrfilm", "width": size[0], "height": size[1]}
    return mi.load_dict(
        {"type": "perspective", "fov": 40.0, "fov_axis": fov_axis, "to_world": look, "film": film}
    )


@pytest.mark.parametrize("fov_axis", ["x", "y", "diagonal", "smaller"])
@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0.3, 0.2, 1)])
def test_rays_are_mitsubas(fov_axis, up):
    """Ray directions agree in the whole image, for every field-of-view axis."""
    other = sensor(fov_axis, up)
    mine = camera_of(other, np.zeros(3))
    u = mi.Point2f([0.02, 0.5, 0.9], [0.1, 0.5, 0.95])
    expected, _ = other.sample_ray(0, 0, u, mi.Point2f(0.5))
    found = mine.rays(u, 48 / 32)
    assert dr.all(dr.norm(expected.d - found.d) < 2e-6)
    # Mitsuba's rays begin at the near plane.
    assert dr.all(dr.norm(dr.cross(expected.o - found.o, found.d)) < 1e-4)


def test_orbit_centre_is_on_the_optical_axis():
    camera = camera_of(sensor(), np.array([0.5, 0.2, -0.1]))
    np.testing.assert_allclose(camera.target, [0.5, 0.2, -0.1], atol=1e-5)
    assert camera.up == (0, 0, 1)


def test_a_camera_that_looks_straight_down_has_axes():
    axes = Camera((0, 0, 5), (0, 0, 0), (0, 0, 1), 30).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[2], [0, 0, -1])


def test_placement_is_inverted():
    place = Placement(np.array([1.0, 2, 3]), 40.0)
    point = np.array([5.0, -6, 7])
    np.testing.assert_allclose(place.to_scene(place.to_browser(point)), point)
    np.testing.assert_allclose(np.linalg.norm(place.to_browser([41.0, 2, 3])), 1)


def test_the_scenes_sensors_by_name(scenes):
    """The scene's sensors that an orbiting camera can represent are listed by name."""
    film = {"type": "hdrfilm", "width": 1, "height": 1}
    meter = {"type": "distant", "film": film}
    second = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0}
    scene = scenes.load({"type": "path"}, None, second=second, meter=meter)
    assert list(sensors_of(scene)) == ["sensor", "second"]
