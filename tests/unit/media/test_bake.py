"""Baking a medium: exact coefficients and extent, and refusal of invalid media."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError, UnsupportedSceneError
from mitsuba_irrcache.media.bake_emission import bake_emission
from mitsuba_irrcache.scene.compile import compile_scene

pytestmark = pytest.mark.usefixtures("rgb")


def baked(scenes, medium, to_world=None, kind="cube"):
    return compile_scene(
        scenes.load({"type": "volpath"}, scenes.boundary(medium, to_world, kind))
    ).visible[0]


def mitsubas(medium: dict, p: mi.Point3f) -> tuple[np.ndarray, np.ndarray]:
    exact = {
        key: medium[key] | {"accel": False}
        for key in ("sigma_t", "albedo")
        if medium[key]["type"] == "gridvolume"
    }
    interaction = mi.MediumInteraction3f()
    interaction.p = p
    sigma_s, _, sigma_t = mi.load_dict(medium | exact).get_scattering_coefficients(
        interaction, True
    )
    return np.array(sigma_t), np.array(sigma_s)


@pytest.mark.parametrize(
    "placement", [{}, {"turn": 33.0, "edges": (0.7, 3.0, 1.1)}, {"mirror": True, "turn": 5.0}]
)
@pytest.mark.parametrize("channels", [1, 3])
def test_coefficients_are_mitsubas(scenes, placement, channels):
    """Baked sigma_t and sigma_s equal Mitsuba's, for scaled media and grids of different sizes.

    The placement of a rotated grid is known to 1e-6 of its size.
    """
    to_world = scenes.placement(**placement)
    sigma_t = scenes.texture((4, 5, 6, channels), 0, 3, 1)
    albedo = scenes.texture((3, 2, 7, channels), 0, 1, 2)
    medium = scenes.medium(sigma_t, albedo, to_world, scale=2.5)
    grid = baked(scenes, medium, to_world)
    assert (grid.channels, grid.homogeneous, grid.bbox) == (channels, False, None)
    u = np.random.default_rng(3).uniform(0.01, 0.99, (3, 1000))
    p = mi.Point3f(np.float32(to_world[:3, :3] @ u + to_world[:3, 3:]))
    expected_t, expected_s = mitsubas(medium, p)
    mine_t = np.broadcast_to(np.array(grid.sigma_t.at_world(p)), (3, 1000))
    mine_s = mine_t * np.broadcast_to(np.array(grid.albedo.at_world(p)), (3, 1000))
    np.testing.assert_allclose(mine_t, np.broadcast_to(expected_t, (3, 1000)), atol=5e-4)
    np.testing.assert_allclose(mine_s, np.broadcast_to(expected_s, (3, 1000)), atol=5e-4)


def test_data_are_not_copied(scenes):
    """The baked field shares the array of the medium, without a copy of a large volume."""
    medium = scenes.medium(scenes.texture((4, 5, 6), 0, 3, 1), 0.5, scenes.placement(), scale=2.0)
    scene = scenes.load({"type": "volpath"}, scenes.boundary(medium))
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith("sigma_t.data")]
    assert compile_scene(scene).visible[0].sigma_t.data.index == params[key].array.index


@pytest.mark.parametrize("values", [1.5, (0.5, 1.0, 2.0)])
def test_homogeneous(scenes, values):
    grid = baked(scenes, scenes.medium(values, 0.5, scale=3.0))
    assert grid.homogeneous and grid.channels == np.size(values)
    assert grid.sigma_t.maximum == pytest.approx(3 * np.max(values))
    assert grid.macrocells.count == 1


def test_extent_is_the_world_bounding_box_of_the_grid(scenes):
    """A grid smaller than the boundary limits the medium; a larger one does not."""
    inner = baked(scenes, scenes.medium(np.ones((2, 2, 2)), 0.5, scenes.placement((1.0, 1.2, 1.4))))
    np.testing.assert_allclose(np.abs(inner.bbox), [[0.5, 0.6, 0.7]] * 2, rtol=1e-6)
    ray = mi.Ray3f(mi.Point3f(-5, 0, 0), mi.Vector3f(1, 0, 0))
    _, near, far = inner.intersect(ray)
    assert near[0] == pytest.approx(4.5) and far[0] == pytest.approx(5.5)
    np.testing.assert_allclose(np.diag(inner.frame)[:3], [1.0, 1.2, 1.4], rtol=1e-6)
    outer = baked(scenes, scenes.medium(np.ones((2, 2, 2)), 0.5, scenes.placement((5.0, 5.0, 5.0))))
    assert outer.bbox is None


BAD = {
    "NaN": ({"sigma_t": np.nan}, r"sigma_t.*1 values.*\(z, y, x\) = \(1, 0, 1\): nan"),
    "infinity": ({"sigma_t": np.inf}, r"sigma_t.*not finite"),
    "negative": ({"sigma_t": -0.5}, r"sigma_t.*negative.*-0\.5"),
    "albedo above 1": ({"albedo": 1.5}, r"albedo.*1\.5.*Clip"),
    "albedo NaN": ({"albedo": np.nan}, r"albedo.*nan"),
    "negative scale": ({"scale": -1.0}, r"scale -1"),
}


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_impossible_values_are_refused(scenes, change, message):
    """Invalid values are refused with the parameter, the position and the value."""
    fields = {name: np.full((2, 3, 2), 0.5, np.float32) for name in ("sigma_t", "albedo")}
    for name in fields.keys() & change.keys():
        fields[name][1, 0, 1] = change[name]
    medium = scenes.medium(*fields.values(), scenes.placement(), scale=change.get("scale", 1.0))
    with pytest.raises(IrrcacheError, match=message):
        baked(scenes, medium)


def other_media(scenes) -> dict[str, dict]:
    grid = scenes.texture((5, 6, 7), 0, 1, 1)
    box = scenes.placement()
    return {
        "nearest": scenes.medium(grid, 0.5, box)
        | {"sigma_t": scenes.volume(grid, box, filter_type="nearest")},
        "repeat": scenes.medium(grid, 0.5, scenes.placement((1.0, 1.0, 1.0)))
        | {"albedo": scenes.volume(grid, scenes.placement((0.5, 0.5, 0.5)), wrap_mode="repeat")},
    }


@pytest.mark.parametrize(
    ("kind", "message"),
    [("nearest", "trilinear"), ("repeat", "clamp")],
)
def test_other_media_are_refused(scenes, kind, message):
    with pytest.raises(UnsupportedSceneError, match=message):
        baked(scenes, other_media(scenes)[kind])


@pytest.mark.parametrize("name", ["sigma_t", "albedo"])
def test_a_dense_voxel_does_not_hide_another_filter(scenes, name):
    """Volumes with the filter "nearest" are refused if one voxel is hundreds of times as dense as
    the others.

    When errors were compared with the largest extinction alone, an albedo was accepted, and blocks
    of pixels were off by 26 %.
    """
    box, dense = scenes.placement(), scenes.texture((40, 40, 40), 0, 1, 1)
    dense[0, 0, 0] = 400
    fields = {"sigma_t": dense, "albedo": scenes.texture((5, 6, 7), 0, 1, 2)}
    volumes = {key: scenes.volume(values, box) for key, values in fields.items()}
    volumes[name] = scenes.volume(fields[name], box, filter_type="nearest")
    medium = scenes.medium(dense, 0.5, box) | volumes
    with pytest.raises(UnsupportedSceneError, match=rf"{name} of medium .* trilinear"):
        baked(scenes, medium)
    baked(scenes, scenes.medium(*fields.values(), box))


@pytest.mark.parametrize("option", [{"filter_type": "nearest"}, {"wrap_mode": "repeat"}])
def test_other_interpolation_of_few_voxels_is_refused(scenes, option):
    """Random points miss a few voxels in many; images had the values of trilinear volumes."""
    box = scenes.placement()
    sparse = np.zeros((64, 64, 64), np.float32)
    sparse[0, 31, 31:33] = 20.0
    usual = scenes.medium(sparse, 0.5, box)
    baked(scenes, usual)
    with pytest.raises(UnsupportedSceneError, match="does not interpolate as expected"):
        baked(scenes, usual | {"sigma_t": scenes.volume(sparse, box, **option)})
    bake_emission(mi.load_dict(scenes.volume(sparse, box)), 1.0)
    with pytest.raises(UnsupportedSceneError, match="does not interpolate as expected"):
        bake_emission(mi.load_dict(scenes.volume(sparse, box, **option)), 1.0)


def test_mono_takes_the_luminance(mono, scenes):
    """In a mono variant the luminance of RGB data is used, as in Mitsuba."""
    sigma_t = scenes.texture((3, 3, 3, 3), 0, 2, 4)
    medium = scenes.medium(sigma_t, 0.5, scenes.placement())
    grid = baked(scenes, medium)
    p = mi.Point3f(np.float32(np.random.default_rng(1).uniform(-0.9, 0.9, (3, 100))))
    expected, _ = mitsubas(medium, p)
    assert grid.channels == 1
    np.testing.assert_allclose(np.array(grid.sigma_t.at_world(p)), expected.ravel(), atol=1e-4)
