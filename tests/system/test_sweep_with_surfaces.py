"""The solver ``sweep`` with surfaces and area emitters around the medium."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.pipeline.defaults import choose_solver
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.discrete_ordinates import solver as sweep
from tests.support.slow import with_slow

pytestmark = pytest.mark.usefixtures("rgb")

SIZE, BLOCK, VOXELS = 16, 4, 16
SKY = {"type": "constant", "radiance": 1.0}
DIM = {"type": "constant", "radiance": 0.1}


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    """Return settings with enough batches for a standard error, of few directions each."""
    monkeypatch.setattr(sweep, "LARGEST_BATCH", 64)


def grey(value: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}


def red() -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.2]}}


def square(center, towards, size: float, **more) -> dict:
    """Return a square that faces ``towards`` a point."""
    place = mi.ScalarTransform4f().look_at(list(center), list(towards), [0.1, 1, 0.2])
    return {"type": "rectangle", "to_world": place.scale([size, size, 1])} | more


def ground(bsdf: dict | None = None) -> dict:
    return square((0, -1.3, 0), (0, 0, 0.001), 5, bsdf=bsdf or red())


def room(bsdf: dict, overlap: float = 1.5) -> dict:
    """Return six walls, which overlap at their edges or meet exactly."""
    size, walls = 2.5, {}
    for i, axis in enumerate(np.vstack([np.eye(3), -np.eye(3)])):
        up = np.roll(np.abs(axis), 1)
        place = mi.ScalarTransform4f().look_at(list(axis * size), [0, 0, 0], list(up))
        place = place.scale([overlap * size] * 2 + [1])
        walls[f"wall{i}"] = {"type": "rectangle", "to_world": place, "bsdf": bsdf}
    return walls


def open_room(bsdf: dict) -> dict:
    """Return four walls that meet exactly.

    With overlapping walls, volpath and path find a radiance of 1.04 instead of 1, even without a
    medium.
    """
    walls = room(bsdf, 1.0)
    return {name: walls[name] for name in ("wall0", "wall2", "wall3", "wall4")}


def lamp(size: float = 0.5) -> dict:
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": [12.0, 10.0, 8.0]}}
    return square((0.3, 2.4, 0.2), (0.3, 0, 0.2), size, emitter=emitter)


def cloud(scenes, depth: float, albedo=0.97) -> dict:
    """Return a dense structured ball with empty borders; ``depth`` is the extinction at its
    core.
    """
    c = (np.arange(VOXELS) + 0.5) / VOXELS * 2 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    density = np.clip(1.1 - 1.4 * np.sqrt(x**2 + y**2 + z**2), 0, None)
    density *= 1 + 0.4 * np.sin(5 * x) * np.cos(4 * y + 1)
    density = (density * depth).astype(np.float32)
    to_world = scenes.placement()
    return scenes.boundary(scenes.medium(density, albedo, to_world), to_world)


def camera(scenes, origin) -> dict:
    look = mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 1, 0])
    return scenes.description({}, None, SIZE)["sensor"] | {"to_world": look, "fov": 70.0}


def scene_sky(scenes) -> dict:
    return {"shape": cloud(scenes, 8), "ground": ground(), "emitter": SKY}


def scene_sun(scenes) -> dict:
    return {"shape": cloud(scenes, 8), "ground": ground(), "emitter": DIM, "sun": scenes.sun}


def scene_occluder(scenes) -> dict:
    """Return a scene with a sphere between the sun and one half of the cloud."""
    ball = {"type": "sphere", "center": [-1.2, 2.6, -1.2], "radius": 0.8, "bsdf": grey(0.5)}
    return scene_sun(scenes) | {"shape": cloud(scenes, 4), "ball": ball}


def scene_room(scenes) -> dict:
    """Return a medium in a closed room under an area light."""
    inside = {"emitter": None, "sensor": camera(scenes, (1.5, 1.0, -2.3)), "lamp": lamp()}
    walls = room(grey(0.7))
    walls["wall0"] = walls["wall0"] | {"bsdf": red()}
    return {"shape": cloud(scenes, 4)} | walls | inside


SCENES = {
    "white sky": (scene_sky, -1, 256),
    "sun and occluder": (scene_occluder, -1, 1024),
    "the same, single scattering": (scene_occluder, 2, 2048),
    "room": (scene_room, -1, 256),
}


def load(scenes, objects: dict) -> mi.Scene:
    objects = dict(objects)
    shape = objects.pop("shape")
    return scenes.load({"type": "volpath"}, shape, SIZE, **objects)


def image(scene: mi.Scene, name: str, spp: int, seed: int, **settings) -> np.ndarray:
    """Render with a new integrator; the kernels of a scene are compiled once."""
    integrator = mi.load_dict({"type": name, "rr_depth": 10} | settings)
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed), np.float64)


def filled(scene: mi.Scene, solver: str = "sweep", **settings):
    """Return the integrator with its caches."""
    integrator = {"type": "irrcache", "solver": solver, "rr_depth": 10} | settings
    integrator = mi.load_dict(integrator)
    integrator.prepare(scene)
    return integrator


def blocks(image: np.ndarray) -> np.ndarray:
    n = SIZE // BLOCK
    return image.reshape(n, BLOCK, n, BLOCK, -1).mean(axis=(1, 3))


#: The closed room takes a minute. `test_small_and_large_emitters_agree_with_path` has it, too. All
#: orders in the scene of the occluder include the first one, and a sky.
SLOW = "room", "the same, single scattering", "white sky"


@pytest.mark.parametrize(
    ("build", "max_depth", "spp"),
    [
        pytest.param(*case, id=name, marks=[pytest.mark.slow] * (name in SLOW))
        for name, case in SCENES.items()
    ],
)
def test_volpath(scenes, build, max_depth, spp):
    """A cloud, its shadow, and the radiance that the ground reflects to it agree with volpath.

    The RMSE of block means of the image is within 1 % of the mean (noise is excluded by independent
    halves of both), and the mean of all within 0.5 %.
    """
    scene, depth = load(scenes, build(scenes)), {"max_depth": max_depth}
    sweep = {"solver": "sweep"} | depth
    ours = [image(scene, "irrcache", spp, s, cache_seed=s, **sweep) for s in (1, 2)]
    theirs = [image(scene, "volpath", spp, s, **depth) for s in (3, 4)]
    scale = np.mean(theirs)
    (x, y), (a, b) = ([blocks(i) for i in pair] for pair in (ours, theirs))
    noise = np.sqrt(((x - y) ** 2 + (a - b) ** 2).mean()) / 2 / scale
    assert noise < 0.01, "too noisy to say"
    assert max(((x - a) * (y - b)).mean(), 0) < (0.01 * scale) ** 2
    assert abs(np.mean(ours) / scale - 1) < 0.005 + noise


FURNACES = {
    "ground": (lambda bsdf: {"ground": ground(bsdf)}, 0.01),
    "open room": (open_room, 0.02),
}


@pytest.mark.parametrize(("around", "tolerance"), with_slow(FURNACES, "open room"))
def test_white_furnace(scenes, around, tolerance):
    """Without absorption under a sky of 1, image and cache are 1.

    The noise of 128 directions is some percent per voxel. Walls of the room are path traced; in
    this room volpath is 1.3 % too bright on average.
    """
    objects = {"shape": cloud(scenes, 8, 1.0), "emitter": SKY} | around(grey(1.0))
    scene = load(scenes, objects)
    integrator = filled(scene, cache_spp=128, rr_depth=200)
    picture = np.array(mi.render(scene, integrator=integrator, spp=256), np.float64)
    np.testing.assert_allclose(blocks(picture), 1, atol=tolerance)
    assert abs(picture.mean() - 1) < 0.01
    phi = np.array(integrator.cache.irradiance, dtype=np.float64) / (4 * np.pi)
    assert abs(phi.mean() - 1) < 0.01
    assert np.sqrt(((phi - 1) ** 2).mean()) < 0.03


# `test_surfaces_among_voxels` has luminous walls and balls that tracks hit.
@pytest.mark.parametrize("size", with_slow([0.4, 2.4], 2.4))
def test_small_and_large_emitters_agree_with_path(scenes, size):
    """Both layers of the cache agree with ``path`` for small and large area lights.

    Small ones are sampled from voxels, large ones are hit by tracks. Means over all voxels reveal
    radiance that is counted twice or left out.
    """
    scene, found = load(scenes, scene_room(scenes) | {"lamp": lamp(size)}), []
    for solver, spp in (("sweep", 192), ("path", 64)):
        cache = filled(scene, solver, cache_spp=spp, resolution=8).cache
        found.append([np.array(v).mean() for v in (cache.uncollided, cache.scattered)])
    np.testing.assert_allclose(*found, rtol=0.02)


def test_point_light_and_several_media(scenes):
    """A point light behind an occluder, seen through another medium, agrees with ``path`` per
    channel.
    """
    fog = scenes.medium([1.5, 1.0, 0.5], [0.9, 0.8, 0.7])
    objects = {
        "shape": cloud(scenes, 4),
        "other": scenes.boundary(fog, scenes.placement((1, 2, 2), center=(1.8, 0, 0))),
        "post": {"type": "sphere", "center": [0.2, 1.6, 0.4], "radius": 0.4, "bsdf": red()},
        "emitter": {"type": "point", "position": [3.2, 2.0, 0.5], "intensity": 30.0},
        "ground": ground(),
    }
    scene, found = load(scenes, objects), []
    for solver, spp in (("auto", 192), ("path", 64)):
        caches = filled(scene, solver, cache_spp=spp, resolution=8).caches
        assert all(c.correlated == (solver == "auto") for c in caches.values())
        found.append([np.array(c.irradiance).mean(axis=(0, 1, 2)) for c in caches.values()])
    np.testing.assert_allclose(*found, rtol=0.02)


def test_the_choice_of_solver(scenes):
    """``auto`` selects sweep unless objects or other media reach into a medium that scatters
    anisotropically, or objects into one that other media reach into, or max_depth is small.

    A request for ``sweep`` in these cases is refused with the reason.
    """
    ball = {"type": "sphere", "center": [0, 0, 0], "radius": 0.2, "bsdf": grey(0.5)}
    veil = square((0, 0, 0), (0, 0, 1), 3, bsdf=grey(0.5))
    shape = cloud(scenes, 8)
    phase = {"phase_function": {"type": "hg", "g": 0.4}}
    forward = shape | {"interior": shape["interior"] | phase}
    around = {"shape": shape | {"interior": mi.load_dict(shape["interior"])}}
    other = scenes.boundary(scenes.medium(1.0, 0.9), scenes.placement((1, 1, 1)))
    around["other"] = other | {"exterior": around["shape"]["interior"]}
    sharp = {"shape": shape | {"interior": mi.load_dict(forward["interior"])}}
    sharp["other"] = other | {"exterior": sharp["shape"]["interior"]}
    refused = {
        '"ball".*reaches into.*anisotropically': {"ball": ball, "shape": forward},
        '"veil".*reaches into.*anisotropically': {"veil": veil, "shape": forward},
        "medium.*reaches into.*scatters anisotropically": sharp,
        'medium.*reaches into.*"ball".*reaches into': around | {"ball": ball},
        "max_depth 4": {},
    }
    for reason, more in refused.items():
        depth = 4 if "depth" in reason else -1
        scene = load(scenes, scene_sky(scenes) | more)
        (medium, *_) = compile_scene(scene).visible
        assert choose_solver(scene, medium, "auto", depth)[0].name == "path"
        with pytest.raises(IrrcacheError, match=f"(?s)sweep.*{reason}.*path"):
            filled(scene, max_depth=depth)
    among = scene_sky(scenes) | {"ball": ball, "veil": veil}
    for objects in (scene_occluder(scenes), among, scene_sky(scenes) | around):
        scene = load(scenes, objects)
        for medium in compile_scene(scene).visible:
            assert choose_solver(scene, medium, "auto")[0].name == "sweep"


def test_standard_error_is_the_scatter(scenes):
    """The standard error agrees with the scatter over 8 seeds within 30 %.

    Batches are independent, including the paths between surfaces.
    """
    scene = load(scenes, scene_sky(scenes) | {"ground": ground(grey(0.5))})
    settings = {"cache_spp": 96, "resolution": 8}
    caches = [filled(scene, cache_seed=seed, **settings).cache for seed in range(8)]
    scatter = np.var([np.array(c.irradiance) for c in caches], axis=0, ddof=1).mean()
    error = np.mean([np.array(c.standard_error) ** 2 for c in caches])
    assert np.sqrt(error / scatter) == pytest.approx(1, rel=0.3)


def test_more_batches_compile_nothing(scenes, kernels):
    """More batches use the kernels of the first ones, with one accidental exception."""
    scene = load(scenes, scene_room(scenes))
    integrator = mi.load_dict({"type": "irrcache", "cache_spp": 128, "resolution": 12})
    known = {k["hash"] for k in kernels(lambda: integrator.prepare(scene))}
    integrator.cache_spp = 320
    found = {k["hash"] for k in kernels(lambda: integrator.prepare(scene))}
    assert found and len(found - known) <= 1
