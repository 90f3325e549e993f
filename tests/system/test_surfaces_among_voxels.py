"""The solver ``sweep`` with surfaces among the voxels of the medium (primer, section 4.8)."""

from __future__ import annotations

import itertools

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.solvers.discrete_ordinates import boundary_condition
from tests.support.slow import with_slow
from tests.support.surfaces import ball, blocks, bound, diffuse, fog, images, lamp, placed, ref

pytestmark = pytest.mark.usefixtures("rgb")

VOXELS = 24


def rendered(scenes, objects: dict, spp: int = 1, **settings) -> tuple[np.ndarray, object]:
    """Return the image and the cache of the first medium."""
    integrator = {"type": "irrcache", "solver": "sweep", "resolution": VOXELS} | settings
    scene = scenes.load(integrator, None, **objects)
    return scenes.image(scene, spp=spp), scene.integrator().cache


def luminous(reflectance: float) -> dict:
    """Return properties of a surface whose radiance is 1 if its surroundings have radiance 1."""
    emitter = {"type": "area", "radiance": 1 - reflectance}
    return {"bsdf": diffuse(*[reflectance] * 3), "emitter": emitter}


def furnace(size: float, reflectance: float) -> dict:
    """Return a closed room of half-edge 1 in a box of fog of half-edge ``size``, seen from within:
    nothing absorbs.
    """
    inside = mi.ScalarTransform4f().look_at([0.9, 0.2, 0.9], [-0.5, -0.2, -0.5], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 50, "to_world": inside, "film": film}
    return {
        "fog": fog((0.5,) * 3, (1.0,) * 3),
        "sensor": camera | {"medium": ref("fog")},
        "box": bound("cube", ref("fog"), scale=[size] * 3),
        "room": {"type": "cube", "flip_normals": True} | luminous(reflectance),
        "emitter": ball((0.1, -0.3, 0.05)) | luminous(reflectance),
    }


# Walls within a voxel, next to the sides of the box, and on sides of voxels.
@pytest.mark.parametrize(
    "size", [1.2, *(pytest.param(size, marks=pytest.mark.slow) for size in (1.0001, 4 / 3))]
)
def test_a_furnace_has_radiance_one(scenes, size):
    """The radiance is 1 in the room, and 0 outside: no radiance passes through the walls."""
    image, cache = rendered(scenes, furnace(size, 0.5), spp=16)
    values = np.array(cache.irradiance)[..., 0] / (4 * np.pi)
    x = ((np.arange(VOXELS) + 0.5) / VOXELS * 2 - 1) * size
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    room = np.maximum(np.maximum(abs(x), abs(y)), abs(z)) < 1
    body = np.sqrt((x - 0.1) ** 2 + (y + 0.3) ** 2 + (z - 0.05) ** 2) < 0.4
    assert values[room & ~body].mean() == pytest.approx(1, abs=0.005)
    assert values[room & ~body].std() < 0.03
    # Lookups in the edges of the room, which two walls cut, know one of them only.
    assert image.mean() == pytest.approx(1, abs=0.01)
    assert values[~room].max(initial=0) < 1e-3
    assert values[body].mean() < 0.02


# Voxels in a sphere are classified like those in a cube, whose walls lie in voxels, too.
@pytest.mark.parametrize(
    ("kind", "shaded"),
    [("cube", False), pytest.param("sphere", False, marks=pytest.mark.slow), ("cube", True)],
)
def test_walls_may_have_normals_outwards(scenes, kind, shaded):
    """Voxels in a room from which only backs of walls are visible counted as the inside of an
    object, and scattered nothing: images lost 9 to 65 % of their mean without a message. So did
    those in a room with a lamp in a translucent shade, around which voxels are illuminated.
    """
    means = []
    for normals in ({}, {"flip_normals": True}):
        two_sided = {"type": "twosided", "bsdf": diffuse(0.7, 0.7, 0.7)}
        walls = {"type": kind, "to_world": mi.ScalarTransform4f().scale(1.02), "bsdf": two_sided}
        objects = {
            "box": bound(kind, fog((0.8,) * 3)),
            "walls": walls | normals,
            "lamp": lamp((0, 0.5, 0), (0, 0, 0.001), 0.2),
            "ball": ball((0.3, -0.4, 0.1)) | {"bsdf": two_sided},
            "emitter": None,
            "sun": None,
        }
        if shaded:
            thin = {"type": "principledthin", "diff_trans": 1.5, "roughness": 0.8}
            objects["shade"] = ball((0, 0.5, 0), 0.35) | {"bsdf": thin}
        _, cache = rendered(scenes, objects, cache_spp=64)
        enclosed = np.array(cache.voxel_classes.enclosed).sum() / VOXELS**3 * 8
        assert enclosed == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.2)  # the ball
        means.append(np.array(cache.irradiance).mean())
    assert means[0] == pytest.approx(means[1], rel=0.01 if shaded else 0.005)


def test_luminous_walls_have_little_noise(scenes):
    """Where paths end at cached irradiance, emitters close by are found by two strategies: with
    samples of the emitters alone the standard deviation is 7 %, and the median 2 % too small.
    """
    image, _ = rendered(scenes, furnace(1.2, 0.5), spp=64, cache_spp=16)
    assert image.std() < 0.025
    assert np.median(image) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("height", [0.13, 0.0, -0.41])
def test_shadow_of_a_sheet(scenes, height):
    """Below a black sheet that cuts the whole medium there is no radiance of the sun; above it the
    irradiance is that of Beer's law.
    """
    objects = {
        "fog": bound("cube", fog((1.5,) * 3, (0.5,) * 3)),
        "sheet": {
            "type": "rectangle",
            "to_world": placed((0, height, 0), (3, 3, 1), (0, height + 1, 1e-6)),
            "bsdf": {"type": "twosided", "bsdf": diffuse(0, 0, 0)},
        },
        "emitter": {"type": "directional", "direction": [0, -1, 0], "irradiance": 2.0},
    }
    _, cache = rendered(scenes, objects, max_depth=2)
    values = np.array(cache.uncollided)[..., 0].mean(axis=(0, 2))
    y = (np.arange(VOXELS) + 0.5) / VOXELS * 2 - 1
    above = y > height + 1e-6
    expected = 2 * np.exp(-1.5 * (1 - y[above]))
    # A voxel that the sheet cuts has the mean over its upper part.
    edge = np.exp(1.5 / VOXELS) - 1
    np.testing.assert_allclose(values[above], expected, rtol=0.01 + edge / 2)
    np.testing.assert_allclose(values[above][2:], expected[2:], rtol=0.005)
    assert np.abs(values[~above]).max() == 0


NAMES = "coloured ball", "rod", "two-sided sheet", "ground that cuts", "luminous ball", "mirror"
SLOW = "rod", "luminous ball", "two-sided sheet", "coloured ball"


def sheet(bsdf: dict) -> dict:
    place = placed((0, 0.1, 0), (0.6, 0.6, 1), (0.3, 1, 0.2))
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def object_named(name: str) -> dict:
    """Return one of the objects `NAMES`, or one that transmits."""
    two_sided = {"type": "twosided", "bsdf": diffuse(0.7, 0.7, 0.7)}
    found = {
        "coloured ball": {"object": ball((0.2, 0.1, 0), bsdf=diffuse(0.8, 0.3, 0.2))},
        "rod": {
            "object": {
                "type": "cylinder",
                "p0": [-0.7, -0.5, 0.1],
                "p1": [0.7, 0.6, -0.2],
                "radius": 0.08,
                "bsdf": diffuse(0, 0, 0),
            }
        },
        "two-sided sheet": {"object": sheet(two_sided)},
        "mask": {"object": sheet({"type": "mask", "opacity": 0.5, "nested": two_sided})},
        "thin dielectric": {"object": sheet({"type": "thindielectric"})},
        "ground that cuts": {
            "object": {
                "type": "rectangle",
                "to_world": placed((0, -0.55, 0), (5, 5, 1), (0, 1, 0.001)),
                "bsdf": diffuse(0.6, 0.5, 0.4),
            }
        },
        "luminous ball": {
            "object": ball((-0.2, 0.2, 0.1), 0.3, bsdf=diffuse(0.5, 0.5, 0.5))
            | {"emitter": {"type": "area", "radiance": 3.0}}
        },
        "mirror": {"object": ball((0.2, 0, 0.1), 0.35, bsdf={"type": "conductor"})},
    }
    return found[name]


@pytest.mark.parametrize(
    ("name", "depth"),
    # The sheet has single scattering, the coloured ball is in an image below, a luminous one in
    # `test_a_furnace_has_radiance_one`; the mask transmits like the thin dielectric.
    [
        *(pytest.param(name, -1, marks=[pytest.mark.slow] * (name in SLOW)) for name in NAMES),
        ("two-sided sheet", 2),
        pytest.param("luminous ball", 2, marks=pytest.mark.slow),
        ("mask", -1),
        pytest.param("thin dielectric", -1, marks=pytest.mark.slow),
    ],
)
def test_voxels_equal_those_of_the_solver_path(scenes, name, depth):
    """The irradiance of both solvers agrees: in the mean within 1.5 %, in blocks of voxels within
    3 % of the mean or four standard errors. Above a plane, whose horizon is the same for all
    voxels, 256 ordinates have an error of 1 % in common.
    """
    objects = object_named(name) | {"fog": bound("cube", fog((1.2,) * 3)), "emitter": scenes.sky}
    options = {"max_depth": depth, "resolution": 16}
    # Ground has 16 times as many ordinates.
    directions = 64 if name == "ground that cuts" else 256
    _, sweep = rendered(scenes, objects, **options, cache_spp=directions)
    _, path = rendered(scenes, objects, **options, cache_spp=256, solver="path")
    assert sweep.correlated and not path.correlated
    found, expected = (np.array(c.irradiance, dtype=np.float64) for c in (sweep, path))
    visible = ~np.array(path.voxel_classes.enclosed).reshape(found.shape[:3])
    assert found[visible].mean() == pytest.approx(expected[visible].mean(), rel=0.015)
    both = [
        np.where(visible[..., None], values, 0).reshape(4, 4, 4, 4, 4, 4, 3).mean(axis=(1, 3, 5))
        for values in (found, expected)
    ]
    noise = np.array(path.standard_error).max() / 8
    assert np.abs(both[0] - both[1]).max() < 0.03 * expected.mean() + 4 * noise


@pytest.mark.parametrize(("place", "radius"), [(0.25, 0.02), (0.0, 0.015)])
def test_thin_objects_between_the_rays_of_a_lattice_are_found(scenes, place, radius):
    """A fence of wires at the distance of voxels and longer than the medium: each at a quarter of a
    voxel between corners and centres of faces, or on faces, between finer rays.
    """
    wires = {}
    for number in range(8):
        y, z = -1 + (number + place) / 4, place / 4
        ends = {"p0": [-1.5, y, z], "p1": [1.5, y, z], "radius": radius}
        wires[f"wire{number}"] = {"type": "cylinder", "bsdf": diffuse(0, 0, 0)} | ends
    objects = wires | {"fog": bound("cube", fog((1.5,) * 3)), "emitter": scenes.sky}
    _, cache = rendered(scenes, objects, resolution=8)
    _, empty = rendered(scenes, {k: v for k, v in objects.items() if k not in wires}, resolution=8)
    ratio = np.array(cache.irradiance).mean() / np.array(empty.irradiance).mean()
    assert ratio < 1 - 1.5 * radius


def one_sided(kind: str, folder, bsdf: dict) -> dict:
    """Return objects: a rod or a ball of radius 0.3 that rays hit from outside only."""
    if kind == "ellipsoids":
        rotation, size = [[0.0, 0, 0, 1]], [[0.1] * 3]  # the surface is at three times the size
        arrays = {"centers": [[0.0] * 3], "scales": size, "quaternions": rotation}
        tensors = {name: mi.TensorXf(np.float32(values)) for name, values in arrays.items()}
        return {"object": {"type": kind, "bsdf": bsdf} | tensors}
    points = folder / "curve.txt"
    points.write_text("\n".join(f"0 {y:.2f} 0 0.3" for y in np.linspace(-2, 2, 9)))
    curve = {"type": "linearcurve" if kind == "linearcurve" else "bsplinecurve"}
    curve |= {"filename": str(points), "bsdf": bsdf}
    if kind != "instance":
        return {"object": curve}
    group = {"type": "shapegroup", "curve": curve}
    return {"group": group, "object": {"type": kind, "shapes": ref("group")}}


@pytest.mark.parametrize(
    "kind", with_slow(("bsplinecurve", "instance", "ellipsoids", "linearcurve"), "linearcurve")
)
def test_shapes_that_rays_hit_from_outside_only(scenes, tmp_path, kind):
    """The irradiance around them is that around the same shape with two sides: no radiance passes
    through them.
    """
    bsdf, found = diffuse(0.3, 0.3, 0.3), []
    rod = {"type": "cylinder", "p0": [0, -2, 0], "p1": [0, 2, 0], "radius": 0.3, "bsdf": bsdf}
    other = ball((0, 0, 0), 0.3, bsdf=bsdf) if kind == "ellipsoids" else rod
    for objects in (one_sided(kind, tmp_path, bsdf), {"object": other}):
        objects = objects | {"fog": bound("cube", fog((1.5,) * 3)), "emitter": scenes.sky}
        _, cache = rendered(scenes, objects, resolution=16)
        found.append(np.array(cache.irradiance)[..., 0])
    x = (np.arange(16) + 0.5) / 8 - 1
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    distance = np.sqrt(x**2 + z**2 + (y**2 if kind == "ellipsoids" else 0))
    outside = distance > 0.3
    difference = (found[0] - found[1])[outside] / found[1][outside].mean()
    assert np.abs(difference).max() < 0.05
    assert np.sqrt(np.square(difference).mean()) < 0.01


def test_no_radiance_leaks_out_of_curved_shells(scenes):
    """A ball that emits inwards only is black from outside: between surface and tangent planes, the
    image had the irradiance of the interior.
    """
    shell = ball((0, 0, 0), 0.3, flip_normals=True) | luminous(0.5)
    image, cache = rendered(scenes, {"fog": bound("cube", fog((1.0,) * 3)), "emitter": shell}, 16)
    assert np.array(cache.irradiance).max() > 1
    assert image.mean() < 1e-6


def test_images_equal_those_of_volpath(scenes):
    """With a camera in the fog, several objects and a sun."""
    objects = {
        "fog": fog((0.8,) * 3, (0.9, 0.85, 0.8)),
        "box": bound("cube", ref("fog")),
        "ball": ball((0.3, -0.2, 0.2), 0.35, bsdf=diffuse(0.2, 0.6, 0.3)),
        "wall": {
            "type": "cube", "to_world": placed((-0.5, -0.5, 0), (0.05, 0.5, 0.6)),
            "bsdf": diffuse(0.7, 0.7, 0.7),
        },
    }  # fmt: skip
    found = images(scenes, objects, {"solver": "sweep"}, {"max_depth": -1}, (64, 512))
    means = [np.mean([blocks(i) for i in pair], axis=0) for pair in (found[:2], found[2:])]
    noise = np.abs(blocks(found[2]) - blocks(found[3])).mean()
    assert np.abs(means[0] - means[1]).max() < 0.015 * means[1].mean() + 4.5 * noise


def test_the_same_seed_gives_the_same_bits(scenes):
    objects = object_named("coloured ball") | {"fog": bound("cube", fog())}
    first, again = (rendered(scenes, objects, resolution=16) for _ in range(2))
    assert np.array_equal(np.array(first[1].irradiance), np.array(again[1].irradiance))


def test_objects_that_few_tracks_meet(scenes):
    """Some ordinates have no track that meets a lamp much smaller than a voxel. The irradiance of
    the fog is that of a lamp of the same power that all meet.
    """
    found = []
    for radius in (0.003, 0.02):
        emitter = {"type": "area", "radiance": 0.02 / radius**2}
        small = ball((0.05, 0.02, 0.03), radius, emitter=emitter)
        objects = {"box": bound(interior=fog((0.6,) * 3)), "lamp": small, "sun": None}
        _, cache = rendered(scenes, objects | {"emitter": None}, resolution=12)
        found.append(np.array(cache.irradiance).mean())
    assert found[0] == pytest.approx(found[1], rel=0.05)


def test_edited_objects_are_solved_for_anew(scenes):
    """An object that is moved, or painted, gives the image of a fresh scene."""
    objects = object_named("coloured ball") | {"fog": bound("cube", fog())}
    integrator = {"type": "irrcache", "solver": "sweep", "resolution": 16}
    scene = scenes.load(integrator, None, **objects)
    scenes.image(scene, spp=4)
    params = mi.traverse(scene)
    params["object.bsdf.reflectance.value"] = mi.Color3f(0.1, 0.7, 0.9)
    params["object.to_world"] = mi.ScalarTransform4f().translate([-0.3, 0, 0.1]).scale(0.3)
    params.update()
    found = scenes.image(scene, spp=4)
    del scene, params  # kernels differ where there are two
    edited = ball((-0.3, 0, 0.1), 0.3, bsdf=diffuse(0.1, 0.7, 0.9))
    fresh = scenes.load(integrator, None, **(objects | {"object": edited}))
    np.testing.assert_allclose(found, scenes.image(fresh, spp=4), rtol=2e-3, atol=1e-4)


# Both sides of the lamp are compared whatever its direction.
@pytest.mark.parametrize("towards", with_slow([1, -1], -1))
def test_lamps_may_lie_anywhere_in_a_voxel(scenes, towards):
    """The irradiance a few voxels from a black lamp does not depend on how it divides a voxel.

    When such a voxel had the mean irradiance of both sides, and its part on the other side that of
    the next voxel, it was 2 to 3 % too dark in front of the lamp, and 30 % too bright behind it.
    """
    within = {"interior": ref("fog"), "exterior": ref("fog")}
    objects = {
        "fog": fog(albedo=(1, 1, 1)),
        "box": bound("cube", ref("fog")),
        "emitter": lamp((0, 0.03, 0), (0, 0.03 + towards, 0.001), radiance=(1, 1, 1))
        | {"bsdf": diffuse(0, 0, 0)} | within,
    }  # fmt: skip
    # The lamp is at 0.7 of one of 13 voxels, at 0.4 of one of 26.
    sides = []
    for voxels in (13, 26):
        integrator = {"type": "irrcache", "solver": "sweep", "resolution": voxels}
        scene = scenes.load(integrator | {"cache_spp": 128}, None, **objects)
        scene.integrator().prepare(scene)
        scattered = np.array(scene.integrator().cache.scattered)[..., 0].mean(axis=(0, 2))
        layers = scattered.reshape(13, -1).mean(axis=1)[::towards]
        sides.append((layers[9:].mean(), layers[:4].mean()))
    (front, behind), (fine_front, fine_behind) = sides
    assert front == pytest.approx(fine_front, rel=0.015)
    assert behind == pytest.approx(fine_behind, rel=0.1)


@pytest.mark.parametrize("solver", with_slow(["sweep", "path"], "path"))
def test_values_are_not_extrapolated_across_surfaces(scenes, solver):
    """A tilted block reaches through faces of the medium, and leaves wedges thinner than a voxel.

    The irradiance there was extrapolated by its ratio to voxels within or behind the block, to 14
    times the largest value in the medium, and a part of the image was 15 % too bright.
    """
    turned = mi.ScalarTransform4f().translate([0.5, 0.7, 0.2]).rotate([0, 0, 1], 15)
    turned = turned.rotate([1, 0, 0], 15).scale([0.45, 0.3, 0.45])
    objects = {
        "fog": fog((2.4,) * 3, (0.5,) * 3),
        "box": bound("cube", ref("fog")),
        "block": {"type": "cube", "to_world": turned, "bsdf": diffuse(0, 0, 0)},
        "emitter": {"type": "directional", "direction": [-0.88, -1, -0.14], "irradiance": 3.0},
    }
    _, cache = rendered(scenes, objects, solver=solver, resolution=32)
    largest = np.array(cache.irradiance).max()
    assert cache.field().maximum < 4 * largest


# A wall thinner than a voxel has all that a thicker one has.
@pytest.mark.parametrize("thickness", with_slow([0.004, 0.1], 0.1))
def test_no_light_enters_a_closed_room(scenes, monkeypatch, thickness):
    """One medium fills two rooms that a wall separates: the one without a lamp is dark.

    Tracks on both sides of the wall would share a path from the face of the medium if few paths
    were traced, as on fine grids.
    """
    monkeypatch.setattr(boundary_condition, "PATH_CELLS", 64)
    white = diffuse(0.7, 0.7, 0.7)
    objects = {
        "fog": bound(interior=fog((0.5,) * 3), scale=(0.99, 0.99, 0.99)),
        "room": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": white}},
        "wall": {
            "type": "cube", "bsdf": white, "to_world": placed(scale=(0.5 * thickness, 1.1, 1.1))
        },
        "lamp": lamp((-0.98, 0.1, 0.0), (1, 0, 0)),
    }  # fmt: skip
    settings = {"type": "irrcache", "solver": "sweep", "resolution": 24, "cache_spp": 64}
    scene = mi.load_dict({"type": "scene", "integrator": settings, **objects}, optimize=False)
    scene.integrator().prepare(scene)
    cache = scene.integrator().cache
    x = (np.arange(24) + 0.5) / 24 * 1.98 - 0.99
    irradiance = np.array(cache.irradiance)[..., 0]
    lit, dark = irradiance[..., x < -0.1], irradiance[..., x > 0.1]
    assert lit.min() > 0.1
    assert dark.max() < 1e-4 * lit.mean()


# Fine grids take minutes; coarse ones have all kinds of voxels at edges, too: walls on sides of
# voxels (12), within voxels (13, 14), of one shape and of several. With 14, the iteration ended
# while the room, 700 times darker than the fog outside, was 1 to 2 % from its solution.
@pytest.mark.parametrize(
    ("walls", "resolution"),
    [
        ("one shape", 14),
        ("six rectangles", 13),
        pytest.param("one shape", 12, marks=pytest.mark.slow),
        pytest.param("one shape", 16, marks=pytest.mark.slow),
        pytest.param("one shape", 13, marks=pytest.mark.slow),
        pytest.param("one shape", 24, marks=pytest.mark.slow),
        pytest.param("one shape", 31, marks=pytest.mark.slow),
        pytest.param("six rectangles", 32, marks=pytest.mark.slow),
    ],
)
def test_no_light_enters_a_room_within_a_medium(scenes, walls, resolution):
    """The irradiance in a closed room does not depend on the sky outside: at its edges, where two
    surfaces hide the nearest voxels, and in the gap between its lamp and ceiling, which contains no
    centre of a voxel. The walls may lie anywhere in voxels.
    """
    white = {"type": "twosided", "bsdf": diffuse(0.7, 0.7, 0.7)}
    room = {"room": {"type": "cube", "bsdf": white}}
    if walls == "six rectangles":
        room = {}
        for axis, sign in itertools.product(range(3), (-1, 1)):
            center, up = np.eye(3)[axis] * sign, np.eye(3)[axis - 1]
            place = mi.ScalarTransform4f().look_at(center, [0, 0, 0], up).scale([1.001, 1.001, 1])
            room[f"{axis}{sign}"] = {"type": "rectangle", "bsdf": white, "to_world": place}
    objects = {
        "fog": bound(interior=fog((0.5,) * 3), scale=(1.2, 1.2, 1.2)),
        "lamp": lamp((0, 0.98, 0), (0, 0, 0), 0.3, (0.05, 0.05, 0.05)),
    }
    settings = {"type": "irrcache", "solver": "sweep", "resolution": resolution, "cache_spp": 64}
    objects |= {"integrator": settings} | room
    inside = np.abs((np.arange(resolution) + 0.5) / resolution * 2.4 - 1.2) < 0.99
    found = []
    for radiance in (1.0, 2.0):
        sky = {"type": "constant", "radiance": radiance}
        scene = mi.load_dict({"type": "scene", "sky": sky, **objects}, optimize=False)
        scene.integrator().prepare(scene)
        found.append(np.array(scene.integrator().cache.irradiance)[..., 0])
    change = found[1] - found[0]
    assert found[0][np.ix_(inside, inside, inside)].mean() > 0.01
    assert np.abs(change[np.ix_(inside, inside, inside)]).max() < 1e-5 * change[0].mean()
