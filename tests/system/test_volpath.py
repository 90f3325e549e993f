"""Whole images against Mitsuba's ``volpath``, for each kind of scene that is supported.

Two images x, y from one cache and two independent volpath images a, b give the error without the
noise of camera samples, mean((x - a)(y - b)), and the bias, mean(x + y - a - b) / 2, with a
standard error from the pixels of the differences. The remainder is the noise of the cache and the
discretisation. All scenes have sizes of about 1 near the origin, where volpath itself is accurate.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from tests.support.slow import with_slow

pytestmark = pytest.mark.usefixtures("rgb")

SPP = 256
#: Allowed mean and root mean square error relative to the mean radiance, due to coarse voxels and
#: the noise of the cache.
BIAS, RMSE = 0.01, 0.02
DENSITY = (5, 6, 7)
SHARP = {"resolution": 64, "cache_spp": 8, "step": 0.2}


class Comparison:
    """Two irrcache images x, y and two volpath images a, b, relative to the mean of all
    channels.
    """

    def __init__(self, x: np.ndarray, y: np.ndarray, a: np.ndarray, b: np.ndarray) -> None:
        self.scale = 0.5 * (a + b).mean()
        noise = 0.5 * np.hypot((a - b).std(axis=(0, 1)), (x - y).std(axis=(0, 1)))
        self.error = noise / np.sqrt(a[..., 0].size) / self.scale
        self.bias = 0.5 * (x + y - a - b).mean(axis=(0, 1)) / self.scale
        self.rmse = np.sqrt(max(((x - a) * (y - b)).mean(), 0)) / self.scale

    def check(self, bias: float = BIAS, rmse: float = RMSE) -> None:
        """Assert that the bias per channel is within ``bias`` plus 4 standard errors, and the
        RMSE in ``rmse``.
        """
        assert self.scale > 0
        assert self.error.max() < 0.3 * bias, "the reference is too noisy to say"
        assert (np.abs(self.bias) < bias + 4 * self.error).all(), (self.bias, self.error)
        assert self.rmse < rmse


@pytest.fixture
def compare(scenes):
    """Return a function that renders a scene with both integrators."""

    def run(
        shape, max_depth=-1, irrcache=None, spp=SPP, hide=False, stock="volpath", **objects
    ) -> Comparison:
        depth = {"max_depth": max_depth, "rr_depth": 1000, "hide_emitters": hide}
        settings = {"resolution": 16, "cache_spp": 64} | (irrcache or {})
        mine = scenes.load(
            {"type": "irrcache", "solver": "path", **depth, **settings}, shape, **objects
        )
        stock = scenes.load({"type": stock, **depth}, shape, **objects, default_solver="path")
        images = [scenes.image(mine, spp=spp // 4, seed=seed) for seed in (1, 2)]
        images += [scenes.image(stock, spp=spp, seed=seed) for seed in (1, 2)]
        return Comparison(*images)

    return run


def cloud(scenes, to_world, shape=DENSITY, **properties) -> dict:
    """Return a grey heterogeneous medium with an optical depth of about 3."""
    sigma_t = scenes.texture(shape, 0.0, 3.0, 4)
    return scenes.medium(sigma_t, scenes.texture(shape, 0.5, 1.0, 5), to_world, **properties)


@pytest.mark.parametrize("max_depth", with_slow([0, 1, 2, 3, -1], 2))
def test_heterogeneous_cube(scenes, compare, max_depth):
    to_world = scenes.placement()
    shape = scenes.boundary(cloud(scenes, to_world), to_world)
    if max_depth == 0:
        scene = scenes.load({"type": "irrcache", "solver": "path", "max_depth": 0}, shape)
        assert not scenes.image(scene, spp=4).any()
    else:
        compare(shape, max_depth).check()


def test_prbvolpath_renders_the_same(scenes, compare):
    """prbvolpath, to which errors about gradients refer, renders the same image."""
    to_world = scenes.placement()
    compare(scenes.boundary(cloud(scenes, to_world), to_world), stock="prbvolpath").check()


PLACEMENTS = {
    "turned": {"turn": 35.0},
    "anisotropic": {"edges": (0.6, 1.2, 3.0)},
    "mirrored": {"mirror": True, "edges": (2.0, 1.5, 1.8)},
    "mirrored, turned, moved": {
        "mirror": True, "turn": -60.0, "edges": (1.6, 2.0, 1.2), "center": (0.3, -0.2, 0.4),
    },
}  # fmt: skip


@pytest.mark.parametrize("placement", with_slow(PLACEMENTS, "turned", "mirrored"))
def test_placement_of_the_grid(scenes, compare, placement):
    to_world = scenes.placement(**placement)
    compare(scenes.boundary(cloud(scenes, to_world), to_world)).check()


def test_voxels_of_one_to_five(scenes, compare):
    """A box with voxels five times longer in z agrees with volpath."""
    to_world = scenes.placement((2, 2, 2), turn=20)
    compare(scenes.boundary(cloud(scenes, to_world, (2, 10, 10)), to_world)).check()


def test_rgb_grids(scenes, compare):
    to_world = scenes.placement()
    sigma_t = scenes.texture((*DENSITY, 3), 0.0, 1.0, 6) ** 2 * [4.0, 3.0, 2.0]
    albedo = scenes.texture((*DENSITY, 3), 0.2, 1.0, 7)
    compare(scenes.boundary(scenes.medium(sigma_t, albedo, to_world, scale=1.3), to_world)).check()


@pytest.mark.parametrize("max_depth", with_slow([2, -1], 2))
def test_homogeneous_rgb(scenes, compare, max_depth):
    medium = scenes.medium((1.0, 1.2, 1.4), (0.9, 0.6, 0.95))
    compare(scenes.boundary(medium), max_depth).check()


# All orders in coloured extinction: `test_sweep.py`, as three grey ones.
@pytest.mark.parametrize("max_depth", with_slow([2, -1], -1))
def test_chromatic_extinction(scenes, compare, max_depth):
    """Extinction of 1 : 4 : 12 at default settings agrees with ``volpathmis`` (measured: 0.4 to
    0.6 %).

    volpath samples the mean of the channels, and has 250 times its variance in the thin channel.
    """
    medium = scenes.medium((0.5, 2.0, 6.0), (0.95, 0.9, 0.8))
    settings = {"resolution": 0, "cache_spp": 0, "solver": "auto"}
    compare(scenes.boundary(medium), max_depth, settings, 1024, stock="volpathmis").check(rmse=0.01)


def test_constant_albedo_in_a_heterogeneous_medium(scenes, compare):
    to_world = scenes.placement()
    medium = scenes.medium(scenes.texture(DENSITY, 0.0, 4.0, 8), (0.95, 0.8, 0.5), to_world)
    compare(scenes.boundary(medium, to_world)).check()


@pytest.mark.parametrize("kind", ["heterogeneous", "homogeneous"])
def test_sphere(scenes, compare, kind):
    to_world = scenes.placement((1.8, 1.8, 1.8))
    medium = cloud(scenes, to_world) if kind == "heterogeneous" else scenes.medium(1.5, 0.9)
    compare(scenes.boundary(medium, to_world, "sphere")).check()


@pytest.mark.parametrize(
    ("grid", "turn"),
    with_slow([(1.4, 30.0), (2.8, 30.0), (1.4, 0.0), (2.8, 0.0)], (1.4, 0.0), (2.8, 0.0)),
)
def test_grid_smaller_or_larger_than_its_boundary(scenes, compare, grid, turn):
    """The medium ends at the world bounding box of its grid; its values are clamped between the
    two.
    """
    medium = cloud(scenes, scenes.placement((grid, grid, grid), turn=turn))
    compare(scenes.boundary(medium, scenes.placement((2.0, 2.0, 2.0), turn=0.5 * turn))).check()


def test_empty_space_around_a_core(scenes, compare):
    """Most macrocells are empty: rays skip them, and voxels without a medium have no samples."""
    density = np.zeros((20, 24, 22), np.float32)
    density[8:12, 9:15, 7:13] = scenes.texture((4, 6, 6), 2.0, 8.0, 9)
    to_world = scenes.placement(turn=15)
    compare(scenes.boundary(scenes.medium(density, 0.9, to_world), to_world)).check()


EMITTERS = {
    "envmap": lambda: {"type": "envmap", "bitmap": mi.Bitmap(_bright_window())},
    "directional": lambda: {
        "type": "directional", "direction": [-0.6, -0.5, 0.7],
        "irradiance": {"type": "rgb", "value": [4, 3, 2]},
    },
    "point outside": lambda: {
        "type": "point", "position": [2, 2, -2.5], "intensity": {"type": "rgb", "value": [9, 8, 7]},
    },
    "spot": lambda: {
        "type": "spot", "intensity": 30.0, "cutoff_angle": 40.0,
        "to_world": mi.ScalarTransform4f().look_at([2, 3, -2], [0, 0, 0], [0, 0, 1]),
    },
}  # fmt: skip


def _bright_window() -> np.ndarray:
    sky = np.full((16, 32, 3), [0.2, 0.3, 0.4], np.float32)
    sky[3:7, 5:12] = [8.0, 6.0, 4.0]
    return sky


# Emitters of all kinds are compared with exact references in `test_convergence_to_references`,
# environment maps with volpath in `test_anisotropic_scattering`.
@pytest.mark.parametrize("emitter", with_slow(EMITTERS, *EMITTERS))
def test_emitters(scenes, compare, emitter):
    """Each kind of emitter agrees; sharp shadows require more voxels and shorter steps than a
    sky.
    """
    to_world = scenes.placement()
    density = scenes.texture(DENSITY, 0.6, 1.4, 4)
    shape = scenes.boundary(scenes.medium(density, 0.9, to_world), to_world)
    compare(shape, 2, SHARP, 4096, emitter=emitter()).check()


@pytest.mark.parametrize("hide", [False, True])
def test_camera_in_the_medium(scenes, compare, hide):
    """A camera in the medium agrees; it needs a low-noise cache, as few voxels have most of the
    weight.
    """
    to_world = scenes.placement((4.0, 4.0, 4.0))
    sensor = {
        "type": "perspective",
        "fov": 60.0,
        "to_world": mi.ScalarTransform4f().look_at([0.4, 0.2, -0.5], [0, 0, 1], [0, 1, 0]),
        "film": scenes.description({}, None)["sensor"]["film"],
        "medium": {"type": "ref", "id": "fog"},
    }
    fog = cloud(scenes, to_world, scale=0.3)
    shape = scenes.boundary({"type": "ref", "id": "fog"}, to_world)
    settings = {"cache_spp": 256, "step": 0.5}
    compare(shape, irrcache=settings, fog=fog, sensor=sensor, hide=hide).check()


def test_camera_within_the_boundary_but_not_in_the_medium(scenes):
    """A sensor without a medium inside the boundary renders only the sky, as with volpath."""
    fog = cloud(scenes, scenes.placement((1.0, 1.0, 1.0)))
    shape = scenes.boundary(fog, scenes.placement((4.0, 4.0, 4.0)))
    look = mi.ScalarTransform4f().look_at([0, 0.2, -1.5], [0, 0, 0], [0, 1, 0])
    sensor = scenes.description({}, None)["sensor"] | {"to_world": look, "fov": 60.0}
    images = []
    for name in ("irrcache", "volpath"):
        scene = scenes.load(
            {"type": name, "max_depth": 2}, shape, sensor=sensor, default_solver="path"
        )
        images.append(scenes.image(scene, spp=4))
    np.testing.assert_allclose(*images, rtol=1e-5)
    np.testing.assert_allclose(images[0], np.broadcast_to([0.6, 0.8, 1.0], images[0].shape), 1e-5)


def test_hidden_emitters_leave_alpha(scenes):
    """Alpha with hidden emitters is the opacity; volpath's is the mean of binary decisions."""
    to_world = scenes.placement()
    shape = scenes.boundary(cloud(scenes, to_world), to_world)
    film = scenes.description({}, None)["sensor"]["film"] | {"pixel_format": "rgba"}
    sensor = scenes.description({}, None)["sensor"] | {"film": film}
    depth = {"max_depth": 2, "rr_depth": 1000, "hide_emitters": True}
    mine = scenes.load(
        {"type": "irrcache", "solver": "path", **depth, "resolution": 16}, shape, sensor=sensor
    )
    stock = scenes.load({"type": "volpath", **depth}, shape, sensor=sensor)
    x, y = (scenes.image(mine, spp=64, seed=s)[..., 3:] for s in (1, 2))
    a, b = (scenes.image(stock, spp=1024, seed=s)[..., 3:] for s in (1, 2))
    Comparison(x, y, a, b).check(bias=0.003, rmse=0.01)


def test_crop_window(scenes):
    """A crop window equals the same part of the whole image, with a filter wider than a pixel."""
    to_world = scenes.placement(turn=10)
    shape = scenes.boundary(cloud(scenes, to_world), to_world)
    whole = scenes.description({}, None, size=24)["sensor"]
    whole["film"] = whole["film"] | {"rfilter": {"type": "gaussian"}}
    crop = {"crop_offset_x": 5, "crop_offset_y": 9, "crop_width": 12, "crop_height": 8}
    sensors = {"sensor": whole, "cropped": whole | {"film": whole["film"] | crop}}
    scene = scenes.load(
        {"type": "irrcache", "solver": "path", "max_depth": 2, "resolution": 16}, shape, **sensors
    )
    full = scenes.image(scene, spp=256)[9:17, 5:17]
    part = scenes.image(scene, spp=256, sensor=1, seed=3)
    assert part.shape == full.shape
    assert np.abs(part - full).mean() < 0.02 * full.mean()


def test_mono_variant(mono, scenes, compare):
    to_world = scenes.placement(turn=25)
    compare(scenes.boundary(cloud(scenes, to_world), to_world), 3).check()


def test_scene_without_a_medium_is_volpaths(scenes):
    """A scene without a medium is rendered by volpath itself, with identical values."""
    ball = {"type": "sphere", "bsdf": {"type": "diffuse"}}
    images = []
    for name in ("irrcache", "volpath"):
        scene = scenes.load(
            {"type": name, "max_depth": 4, "rr_depth": 5}, ball, default_solver="path"
        )
        images.append(scenes.image(scene, spp=4, seed=5))
    assert images[0].mean() > 0
    np.testing.assert_array_equal(*images)
