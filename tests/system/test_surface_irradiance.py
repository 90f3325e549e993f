"""Irradiance cached on surfaces, in images.

`test_surfaces` compares with volpath; here the reference is this integrator without nodes, whose
paths are unbiased with respect to the same caches of the media.
"""

from __future__ import annotations

import gc
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.render import camera, film, surface_irradiance
from tests.support.surfaces import ball, bound, colour, diffuse, fog, ground, lamp, placed

pytestmark = pytest.mark.usefixtures("rgb")

SIZE = 24


@pytest.fixture(autouse=True)
def _in_small_images(monkeypatch):
    """Cache irradiance on surfaces in images of few samples, too."""
    monkeypatch.setattr(camera, "FEWEST_SAMPLES", 0)


def scene_of(scenes, objects: dict, **settings) -> mi.Scene:
    integrator = {"type": "irrcache", "max_depth": -1, "resolution": 12, "cache_spp": 32}
    objects = {"emitter": None, "sun": None} | objects
    return scenes.load(integrator | settings, None, SIZE, **objects, default_solver="auto")


def nodes_of(scene: mi.Scene):
    """Return the nodes on the surfaces that were rendered last, None without any."""
    surfaces = scene.integrator()._source.latest._surfaces
    return None if surfaces is None else surfaces.nodes


def box(center, scale, bsdf) -> dict:
    return {"type": "cube", "to_world": placed(center, scale), "bsdf": bsdf}


def wall(center, towards, bsdf=None) -> dict:
    place = placed(center, (2.0, 2.0, 1), towards)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or diffuse(0.7, 0.7, 0.7)}


def room() -> dict:
    """Return walls that extend beyond the corners of a room, in which a lamp hangs."""
    return {
        "smoke": bound(interior=fog((0.8, 0.8, 0.8)), scale=(0.9, 0.9, 0.9)),
        "floor": wall((0, -1.5, 0), (0, 0, 0.001)), "ceiling": wall((0, 1.5, 0), (0, 0, 0.001)),
        "left": wall((-1.5, 0, 0), (0, 0, 0), diffuse(0.6, 0.1, 0.1)),
        "right": wall((1.5, 0, 0), (0, 0, 0), diffuse(0.1, 0.5, 0.1)),
        "back": wall((0, 0, 1.5), (0, 0, 0)), "lamp": lamp((0, 1.2, 0), (0, -1, 0.001), 0.4),
    }  # fmt: skip


def still_life() -> dict:
    """Return objects of many BSDFs that stand on a floor, with a mesh-like cube in a corner."""
    checker = {"type": "checkerboard", "color0": colour(0.1, 0.2, 0.6), "color1": colour(1, 1, 1)}
    checker["to_uv"] = mi.ScalarTransform4f().scale([9, 9, 1])
    half = {
        "type": "mask",
        "opacity": 0.5,
        "nested": {"type": "twosided", "n": diffuse(0.7, 0.5, 0)},
    }
    return {
        "smoke": bound(interior=fog((0.8, 1.2, 1.6)), center=(0, 0.2, 0), scale=(0.6, 0.6, 0.6)),
        "floor": ground(bsdf={"type": "diffuse", "reflectance": checker}),
        "mirror": ball((1.1, -0.7, -0.3), 0.35, bsdf={"type": "conductor"}),
        "glass": ball((-1.1, -0.7, -0.3), 0.35, bsdf={"type": "dielectric"}),
        "metal": ball((0.4, -0.85, -1.0), 0.2, bsdf={"type": "roughconductor", "alpha": 0.2}),
        "plastic": box((-0.4, -0.95, -1.0), (0.15, 0.15, 0.15), {"type": "plastic"}),
        "sheet": box((0, -0.8, -0.8), (0.3, 0.2, 0.001), half),
        "emitter": {"type": "constant", "radiance": colour(0.5, 0.7, 1.0)},
        "sun": {"type": "directional", "direction": [0.4, -1.0, 0.55], "irradiance": 2.0},
    }  # fmt: skip


def sun_in_a_map() -> dict:
    """Return a ground and a sheet under an environment map with a bright spot."""
    sky = np.full((16, 32, 3), 0.5, np.float32)
    sky[4, 10] = 500.0
    return {
        "smoke": bound(interior=fog(), center=(0, 0.2, 0), scale=(0.6, 0.6, 0.6)),
        "floor": ground(), "sheet": box((0.9, -0.6, 0), (0.02, 0.4, 0.4), diffuse(0.8, 0.2, 0.2)),
        "emitter": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
    }  # fmt: skip


def within() -> dict:
    """Return a ground that cuts the medium, and a black and a coloured object in it."""
    return {
        "smoke": bound(interior=fog((1.5, 1.5, 1.5))), "floor": ground(-0.5),
        "ball": ball((0.3, 0, 0), 0.3, bsdf=diffuse(0.9, 0.3, 0.2)),
        "black": box((-0.4, -0.2, -0.3), (0.1, 0.3, 0.1), diffuse(0, 0, 0)),
        "spot": {
            "type": "spot", "to_world": placed((-2, 2, -2), (1, 1, 1), (0, 0, 0)),
            "intensity": 20.0, "cutoff_angle": 30.0,
        },
        "emitter": {"type": "constant", "radiance": 0.3},
    }  # fmt: skip


def many_lights() -> dict:
    """Return a ground with more lights than are sampled at each vertex."""
    u = np.random.default_rng(1).random((40, 3)) * [4, 1, 4] + [-2, 0.2, -2]
    lights = {
        f"light{i}": {"type": "point", "position": list(map(float, p)), "intensity": 0.1 + 0.02 * i}
        for i, p in enumerate(u)
    }
    return lights | {"smoke": bound(interior=fog(), scale=(0.5, 0.5, 0.5)), "floor": ground()}


def filtered_lamps() -> dict:
    """Return a floor under a large lamp behind a half transparent sheet that emits, too, and one
    without a BSDF.
    """
    half = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "n": diffuse(0.2, 0, 0)}}
    return {
        "smoke": bound(interior=fog(), center=(0, 0.2, 0.8), scale=(0.5, 0.3, 0.3)),
        "floor": ground(-0.9),
        "behind": lamp((-1.3, 1.3, 0), (-1.3, 0, 0.001), 1.2, (2, 2, 2)),
        "sheet": wall((-1.3, 0.9, 0), (-1.3, 0, 0.001), half) | {
            "to_world": placed((-1.3, 0.9, 0), (1.3, 1.3, 1), (-1.3, 0, 0.001)),
            "emitter": {"type": "area", "radiance": 0.05},
        },
        "null": lamp((1.3, 1.1, 0), (1.3, 0, 0.001), 1.2, (1, 2, 3)) | {"bsdf": {"type": "null"}},
    }  # fmt: skip


def contact(one_sided: bool) -> dict:
    """Return balls that stand on a floor above which the camera looks below them: their lower sides
    and the back of the floor face the same way, close to each other.
    """
    bsdf = diffuse(0.7, 0.7, 0.7)
    floor = ground(bsdf=bsdf if one_sided else {"type": "twosided", "bsdf": bsdf})
    balls = {f"ball{n}": ball((x, -0.6, -3.4), 0.5) for n, x in enumerate((-0.4, 0.7))}
    look = mi.ScalarTransform4f().look_at([0.1, -1.07, -4.6], [0.1, -1.0, -3.4], [0, 1, 0])
    film_of = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "to_world": look, "fov": 50.0, "film": film_of}
    emitter = {"type": "constant", "radiance": colour(0.6, 0.8, 1)}
    smoke = bound(interior=fog())
    return {"smoke": smoke, "floor": floor, "emitter": emitter, "sensor": sensor} | balls


SCENES = {
    "filtered lamps": (filtered_lamps, {"without": 8}),
    "many lights": (many_lights, {}),
    "room": (room, {"without": 40}),
    "still life": (still_life, {}),
    "sun in a map": (sun_in_a_map, {}),
    "within the medium": (within, {}),
    "contact": (partial(contact, one_sided=True), {}),
    "contact, two-sided": (partial(contact, one_sided=False), {}),
}


#: The closed room takes most of a minute; `test_surfaces_among_voxels` has closed rooms with nodes.
#: The still life has the objects of the others, beside a medium instead of in it.
SLOW = "room", "still life", "contact, two-sided"


@pytest.mark.parametrize(
    ("build", "options"),
    [
        pytest.param(*case, id=name, marks=[pytest.mark.slow] * (name in SLOW))
        for name, case in SCENES.items()
    ],
)
def test_nodes_do_not_bias_the_image(scenes, build, options):
    """Blocks of 6 x 6 pixels agree with those of paths that end in media only."""
    scene = scene_of(scenes, build())
    with_nodes = np.mean([scenes.image(scene, spp=64, seed=s) for s in (1, 2)], axis=0)
    assert nodes_of(scene).count > 100
    rays, surfaces = scene.integrator()._source.latest, scene.integrator()._source.latest._surfaces
    rays._surfaces, rays._emitters, emitters = None, None, rays._emitters
    without = options.get("without", 16)
    halves = [
        np.mean([scenes.image(scene, spp=64, seed=10 + 2 * s + h) for s in range(without // 2)], 0)
        for h in range(2)
    ]
    rays._surfaces, rays._emitters = surfaces, emitters
    a, b, image = (
        x.reshape(4, 6, 4, 6, -1).mean(axis=(1, 3))[..., :3] for x in (*halves, with_nodes)
    )
    mean = 0.5 * (a + b).mean()
    noise = np.sqrt(((a - b) ** 2).mean() / 4) / mean
    error = (image - 0.5 * (a + b)) / mean
    assert noise < 0.015
    assert np.abs(error).max() < 0.01 + 6 * noise
    assert abs(error.mean()) < 0.002 + 3 * noise / np.sqrt(error.size)


def test_a_white_scene_is_white(scenes):
    """Everything that conserves energy under a constant environment has its radiance."""
    white = diffuse(1, 1, 1)
    objects = {
        "cloud": bound(interior=fog(albedo=(1, 1, 1)), center=(0, 0.1, 0), scale=(0.7, 0.7, 0.7)),
        "floor": ground(-0.9, white), "ball": ball((1.1, -0.5, 0), 0.4, bsdf=white),
        "box": box((-1.1, -0.6, -0.4), (0.3, 0.3, 0.3), white),
        "emitter": {"type": "constant", "radiance": 1.0},
    }  # fmt: skip
    image = scenes.image(scene_of(scenes, objects, cache_spp=256), spp=32)[..., :3]
    assert abs(image.mean() - 1) < 0.003
    blocks = image.reshape(4, 6, 4, 6, 3).mean(axis=(1, 3))
    assert np.abs(blocks - 1).max() < 0.01


def test_a_ground_under_sun_and_sky_has_hardly_any_noise(scenes):
    objects = {
        "cloud": bound(interior=fog(), scale=(0.7, 0.7, 0.7)), "floor": ground(),
        "emitter": {"type": "constant", "radiance": 0.5},
        "sun": {"type": "directional", "direction": [0.3, -1.0, 0.2], "irradiance": 2.0},
    }  # fmt: skip
    scene = scene_of(scenes, objects)
    a, b = (scenes.image(scene, spp=4, seed=s)[SIZE // 2 :] for s in (1, 2))
    # The edge of the ground and of the shadow are those of the pixels.
    assert np.median(np.abs(a - b)) < 2e-3 * a.mean()


def test_the_same_seed_gives_the_same_bits(scenes):
    first = scenes.image(scene_of(scenes, within()), spp=4)
    gc.collect()
    np.testing.assert_array_equal(scenes.image(scene_of(scenes, within()), spp=4), first)


def test_nodes_are_reused_by_another_camera(scenes):
    scene = scene_of(scenes, within())
    image = scenes.image(scene, spp=2)
    nodes, count = nodes_of(scene), nodes_of(scene).count
    np.testing.assert_array_equal(scenes.image(scene, spp=2), image)
    assert nodes_of(scene) is nodes
    assert nodes.count == count
    params = mi.traverse(scene.sensors()[0])
    matrix = np.array(params["to_world"].matrix).reshape(4, 4)
    matrix[0, 3] += 0.3
    params["to_world"] = mi.ScalarTransform4f(matrix)
    params.update()
    scenes.image(scene, spp=2)
    assert nodes_of(scene) is nodes
    assert count < nodes.count < 1.6 * count


def test_nodes_are_kept_while_the_cache_is_refined(scenes):
    scene = scene_of(scenes, within(), cache_spp=8)
    scenes.image(scene, spp=2)
    nodes = nodes_of(scene)
    scene.integrator().cache_spp = 32
    refined = scenes.image(scene, spp=2)
    assert nodes_of(scene) is nodes
    del scene  # kernels differ where there are two
    fresh = scenes.image(scene_of(scenes, within(), cache_spp=32), spp=2)
    np.testing.assert_allclose(refined, fresh, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("sigma_t", [3.0, np.full((2, 2, 2), 3.0)], ids=["constant", "grid"])
def test_shadow_of_a_medium_without_a_cache(scenes, sigma_t):
    """The ground around a medium that does not scatter, and has no cache, is that around the same
    medium on a fine grid.

    Without the voxels of a cache, irradiance was interpolated over the size of the medium.
    """

    def rendered(sigma_t) -> np.ndarray:
        smoke = scenes.boundary(scenes.medium(sigma_t, 0.0, scenes.placement()))
        objects = {"smoke": smoke, "floor": ground(-1.02), "emitter": {"type": "constant"}}
        return scenes.image(scene_of(scenes, objects), spp=64)[..., :3]

    found, expected = (
        x.reshape(6, 4, 6, 4, 3).mean(axis=(1, 3))
        for x in (rendered(sigma_t), rendered(np.full((32, 32, 32), 3.0)))
    )
    assert np.abs(found - expected).max() < 0.02 * expected.mean()


def test_nodes_have_the_medium_of_their_own_place(scenes):
    """Nodes on a floor that fog covers in part have the fog as their medium exactly where they lie
    in it, whatever the medium in front of the points for which they are created.
    """
    floor = {"floor": ground(-0.5, diffuse(0.8, 0.8, 0.8))}
    fog_box = {"box": bound(interior=fog((3.0, 3.0, 3.0), (0.2, 0.2, 0.2)))}
    scene = scene_of(scenes, fog_box | floor | {"emitter": scenes.sky}, solver="sweep")
    scenes.image(scene, spp=4)
    nodes = nodes_of(scene)
    number = dr.arange(mi.UInt32, nodes.count)
    p, *_, distance = nodes.positions(number)
    p, medium = np.array(p), np.array(nodes.medium_number(number))
    known = np.array(distance) > 0
    inside = np.abs(p).max(axis=0) < 1
    apart = np.abs(np.abs(p[[0, 2]]).max(axis=0) - 1) > 1e-3
    assert inside[known].any() and not inside[known].all()
    np.testing.assert_array_equal((medium == 1)[known & apart], inside[known & apart])


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize(
    ("center", "size"), [((0, 9, 0), 3.0), ((40, 70, 30), 9.0), ((0, 900, 0), 200.0)]
)
def test_objects_seen_by_the_camera_occlude_the_sky_however_far_the_medium(
    scenes, projection, center, size
):
    """The irradiance of a floor below a black ball has a closed form. The spacing of nodes must
    follow from the view: with one that follows from the medium, their rays miss the ball.
    """
    radius, height, albedo = 0.05, 0.07, 0.6
    objects = {
        "medium": bound(interior=fog((1e-7,) * 3), center=center, scale=(size,) * 3),
        "floor": ground(height=0, bsdf=diffuse(*[albedo] * 3)),
        "ball": ball((0, height, 0), radius, bsdf=diffuse(0, 0, 0)),
        "emitter": {"type": "constant", "radiance": 1.0},
    }
    scene = scene_of(scenes, objects, solver="sweep")
    look = mi.ScalarTransform4f().look_at([0, 0.8, 0], [0, 0, 0], [0, 0, 1])
    size_on_film = {"fov": 40.0} if projection == "perspective" else {}
    if projection == "orthographic":
        look = look @ mi.ScalarTransform4f().scale([0.3, 0.3, 1])
    film_of = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": projection, "to_world": look, "film": film_of} | size_on_film)
    image = np.array(mi.render(scene, sensor=sensor, spp=64), dtype=float).mean(axis=-1)
    half = 0.8 * np.tan(np.radians(20)) if size_on_film else 0.3
    x = (np.arange(SIZE) + 0.5) / SIZE * 2 * half - half
    from_axis = np.hypot(*np.meshgrid(x, x))
    form_factor = radius**2 * height / (from_axis**2 + height**2) ** 1.5
    on_floor = from_axis > 1.5 * radius  # beside the ball, seen from above
    expected = albedo * (1 - form_factor)
    np.testing.assert_allclose(image[on_floor], expected[on_floor], rtol=0.02)
    assert np.ptp(expected[on_floor]) > 0.05  # against 0.6


def test_edits_of_a_surface_are_seen(scenes):
    scene = scene_of(scenes, within())
    scenes.image(scene, spp=2)
    params = mi.traverse(scene)
    key = "ball.bsdf.reflectance.value"
    params[key] = mi.Color3f(0.1, 0.9, 0.1)
    params.update()
    edited = scenes.image(scene, spp=2)
    del scene, params  # kernels differ where there are two
    objects = within()
    objects["ball"]["bsdf"] = diffuse(0.1, 0.9, 0.1)
    np.testing.assert_allclose(
        edited, scenes.image(scene_of(scenes, objects), spp=2), rtol=1e-4, atol=1e-5
    )


def test_limited_depths_and_unknown_media_are_path_traced(scenes):
    scene = scene_of(scenes, within(), max_depth=3)
    scenes.image(scene, spp=1)
    assert nodes_of(scene) is None
    del scene
    sharp = fog((2, 2, 2)) | {"phase": {"type": "hg", "g": 0.9}}
    glass = ball((-1.5, 0.5, 0), 0.4, bsdf={"type": "dielectric"}, interior=sharp)
    scene = scene_of(scenes, within() | {"jar": glass})
    scenes.image(scene, spp=1)
    assert nodes_of(scene) is None


def test_an_image_of_few_samples_is_path_traced(scenes, monkeypatch):
    monkeypatch.setattr(camera, "FEWEST_SAMPLES", 8 * SIZE**2)
    scene = scene_of(scenes, within())
    few = scenes.image(scene, spp=4)
    assert nodes_of(scene) is None
    scenes.image(scene, spp=8)
    assert nodes_of(scene).count > 0
    np.testing.assert_array_equal(scenes.image(scene, spp=4), few)


# `tests/unit/pipeline/test_scenes_are_freed.py` checks that nothing holds objects of a scene.
@pytest.mark.slow
def test_another_scene_may_follow_with_volpath(scenes):
    """Nothing keeps emitters of a scene that is gone: Dr.Jit would call them without shapes."""
    scenes.image(scene_of(scenes, room()), spp=1)
    scene = scenes.load(
        {"type": "volpath"}, None, SIZE, **({"emitter": None, "sun": None} | room())
    )
    assert np.isfinite(scenes.image(scene, spp=1)).all()


def test_mono(mono, scenes):
    objects = {"floor": ground(), "smoke": bound(interior=fog()), "emitter": {"type": "constant"}}
    image = scenes.image(scene_of(scenes, objects), spp=4)
    assert np.isfinite(image).all()
    assert 0.2 < image.mean() < 1.1


def test_edges_of_lamps_get_more_samples(scenes, kernels, monkeypatch):
    """New samples in the pixels of largest variance reduce noise, and leave the mean as it is.

    However many these pixels are, no kernel is compiled for them.
    """
    objects = {
        "smoke": bound(interior=fog((0.3, 0.3, 0.3)), scale=(0.6, 0.6, 0.6)),
        "lamp": lamp((0.8, 0.6, 0.5), (0, 0, -3), 0.3, (50, 40, 30)),
        "floor": ground(), "emitter": {"type": "constant", "radiance": 0.2},
    }  # fmt: skip
    scene = scene_of(scenes, objects)
    refined, launched = [], []
    for seed in range(12):
        image = partial(scenes.image, scene, spp=8, seed=seed)
        launched.append({k["hash"] for k in kernels(lambda i=image: refined.append(i()[..., 0]))})
    assert set.union(*launched) == launched[0]
    refined = np.array(refined)
    with monkeypatch.context() as patch:
        patch.setattr(film, "OUTLIER", 1e9)
        plain = np.array([scenes.image(scene, spp=8, seed=s)[..., 0] for s in range(12)])
    noise, plain_noise = (np.sqrt(x.var(axis=0, ddof=1).mean()) for x in (refined, plain))
    assert noise < 0.7 * plain_noise
    many = scenes.image(scene, spp=1024)[..., 0].mean()
    assert abs(refined.mean() - many) < 4 * plain_noise / np.sqrt(12 * SIZE**2)


def test_passes_of_an_image_have_independent_new_samples(scenes, monkeypatch):
    objects = {
        "smoke": bound(interior=fog((0.3, 0.3, 0.3)), scale=(0.6, 0.6, 0.6)),
        "lamp": lamp((0.8, 0.6, 0.5), (0, 0, -3), 0.3, (50, 40, 30)),
        "floor": ground(), "emitter": {"type": "constant", "radiance": 0.2},
    }  # fmt: skip
    scene, streams, refined = scene_of(scenes, objects), [], film._refined

    def recorded(*args):
        sampler_seed, position_seed = args[2]
        streams.append((sampler_seed, int(position_seed[0])))
        return refined(*args)

    monkeypatch.setattr(film, "_refined", recorded)
    monkeypatch.setattr(film, "LANES", 8 * SIZE**2)
    scenes.image(scene, spp=32)
    assert len(streams) == len(set(streams)) == 4


def below_a_window() -> dict:
    """Return a floor with smoke in a large black room, lit by the sky through a window above."""
    black = diffuse(0, 0, 0)
    sides = [(6, 0, 0), (-6, 0, 0), (0, 0, 6), (0, 0, -6), (0, -6, 0)]
    walls = {f"wall{n}": wall(p, (0, 0, 0.01), black) for n, p in enumerate(sides)}
    for own in walls.values():
        own["to_world"] = own["to_world"].scale((3.5, 3.5, 1))
    frame = [(-3.3, 0, 3, 7), (3.3, 0, 3, 7), (0, -3.3, 0.3, 3), (0, 3.3, 0.3, 3)]
    for n, (x, z, width, depth) in enumerate(frame):
        place = mi.ScalarTransform4f().translate((x, 6, z)).rotate((1, 0, 0), 90)
        place = place.scale((width, depth, 1))
        walls[f"frame{n}"] = {"type": "rectangle", "to_world": place, "bsdf": black}
    sky = {"type": "constant", "radiance": 1.0}
    smoke = bound(interior=fog((0.1, 0.1, 0.1)), scale=(0.9, 0.9, 0.9))
    return walls | {"smoke": smoke, "floor": ground(), "emitter": sky}


def test_noise_of_the_nodes_is_estimated_and_falls_with_cache_spp(scenes, monkeypatch):
    """Rooms with small windows had noise of several percent, which no property reduced."""
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append(text))
    monkeypatch.setattr(surface_irradiance, "MOST_MORE", 1)
    noise = []
    for factor, seeds in ((1, 6), (16, 3)):
        means, estimates = [], []
        for seed in range(seeds):
            coarse = {"resolution": 4, "cache_spp": 0, "cache_seed": seed}
            scene = scene_of(scenes, below_a_window(), **coarse)
            integrator = scene.integrator()
            integrator.prepare(scene)
            integrator.cache_spp = factor * integrator._builder.parts[0].target(0)
            scenes.image(scene, spp=1)
            surfaces = integrator._source.latest._surfaces
            (_, end, rays), *_ = surfaces._groups
            assert surfaces._exchange[0].rays == factor * rays
            means.append(np.array(surfaces.paths.irradiance[0])[:end].mean())
            estimates.append(surfaces._standard_error(0, end))
            del scene, integrator, surfaces
        noise.append((np.std(means, ddof=1) / np.mean(means), np.median(estimates)))
    (before, estimated), (_, after) = noise
    assert 0.4 < estimated / before < 2.5
    assert estimated > 0.01
    assert 2.5 < estimated / after < 7
    assert sum("irradiance on surfaces has noise" in text for text in messages) >= 4


def test_noisy_nodes_get_more_rays_within_a_budget(scenes, monkeypatch):
    used = []
    for budget in (1 << 23, 1 << 20):
        monkeypatch.setattr(surface_irradiance, "MOST_RAYS", budget)
        scene = scene_of(scenes, below_a_window(), resolution=4, cache_spp=0)
        scenes.image(scene, spp=1)
        surfaces = scene.integrator()._source.latest._surfaces
        rays = [part.rays * dr.width(part.own[0]) for part in surfaces._exchange]
        usual = sum((end - first) * n for first, end, n in surfaces._groups)
        used.append((sum(rays) // usual, surfaces._standard_error(*surfaces._groups[0][:2])))
        assert sum(rays) <= max(budget, usual)
        del scene, surfaces
    (more, small), (fewer, large) = used
    assert more > 1 and fewer == 1
    assert small < large
