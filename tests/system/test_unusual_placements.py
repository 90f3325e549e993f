"""Unusual placements of boundaries and emitters against ``volpath``, and the errors for others."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.pipeline.defaults import choose_stock

pytestmark = pytest.mark.usefixtures("rgb")

ONCE = {"max_depth": 2}
SHEAR = np.eye(4) + 0.5 * np.eye(4)[:, [0]] @ np.eye(4)[[1]]


def difference(scenes, shape: dict, solver: str = "sweep", **objects) -> float:
    """Return the relative difference of the mean radiance from volpath's; single scattering."""
    ours = {"type": "irrcache", "solver": solver, "resolution": 20, "cache_spp": 256} | ONCE
    mine = scenes.image(
        scenes.load(ours, shape, 16, **objects, default_solver="path"), spp=64
    ).mean()
    theirs = scenes.load({"type": "volpath"} | ONCE, shape, 16, **objects)
    return mine / scenes.image(theirs, spp=2048).mean() - 1


def dark(place: np.ndarray, scenes, **more) -> dict:
    """Return an absorbing sphere: the share of the sky that it covers depends on its size."""
    shape = scenes.boundary(scenes.medium(1.5, 0.3))
    place = mi.ScalarTransform4f(place)
    return shape | {"type": "sphere", "to_world": place} | more


SPHERES = {
    "uneven": np.diag([0.6, 1.4, 1.0, 1.0]),
    "flat": np.diag([1.0, 1.0, 0.1, 1.0]),
    "sheared": SHEAR,
    "turned and uneven": np.array([[0, -1, 0, 0], [0.7, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]]),
}


@pytest.mark.parametrize("place", SPHERES.values(), ids=SPHERES)
def test_spheres_are_round_for_every_placement(scenes, place):
    """Spheres with any accepted placement are rendered as spheres.

    As ellipsoids they would cover more or less of the sky, by 2 to 30 %.
    """
    assert abs(difference(scenes, dark(place, scenes))) < 0.004


MIRRORS = {"x": (-1, 1, 1), "y": (1, -1, 1), "all": (-1, -1, -1)}


@pytest.mark.parametrize("mirror", MIRRORS.values(), ids=MIRRORS)
def test_mirrored_environments(scenes, mirror):
    """Mirrored environment maps have their bright texel in the right direction."""
    texels = np.random.default_rng(1).uniform(0.2, 1.0, (5, 7, 3)).astype(np.float32)
    texels[1, 2] = 20.0
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 40).scale(list(mirror))
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels), "to_world": turned}
    shape = scenes.boundary(scenes.medium(1.0, 0.8))
    assert abs(difference(scenes, shape, emitter=sky)) < 0.01


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (3, 5)])
def test_small_environments(scenes, size):
    texels = np.random.default_rng(2).uniform(0.2, 1.0, (*size, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels)}
    shape = scenes.boundary(scenes.medium(1.0, 0.8))
    assert abs(difference(scenes, shape, emitter=sky)) < 0.006


WRONG = {
    "scale": np.diag([2.0, 2, 2, 1]),
    "uneven scale": np.diag([1.0, 2, 0.5, 1]),
    "shear": SHEAR,
}


@pytest.mark.parametrize("kind", ["envmap", "directional", "sunsky"])
@pytest.mark.parametrize("place", WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("solver", ["sweep", "path"])
def test_scaled_emitters_far_away_are_refused(scenes, kind, place, solver):
    emitter = {"type": kind, "to_world": mi.ScalarTransform4f(place)}
    if kind == "envmap":
        emitter["bitmap"] = mi.Bitmap(np.ones((4, 4, 3), np.float32))
    shape = scenes.boundary(scenes.medium(1.0, 0.8))
    scene = scenes.load({"type": "irrcache", "solver": solver}, shape, 4, far=emitter, emitter=None)
    with pytest.raises(RuntimeError, match=r'emitter "far".*to_world.*scale and shear'):
        mi.render(scene, spp=1)


@pytest.mark.parametrize("place", [np.diag([0.2, 0.5, 1, 1]), SHEAR], ids=["uneven", "sheared"])
def test_emissive_cylinders_are_round(scenes, place):
    """Emissive cylinders that are not round are refused.

    Mitsuba's emitter sampling of them gives two thirds of the radiance that rays find.
    """
    lamp = {"type": "cylinder", "to_world": mi.ScalarTransform4f().translate([0, 3, 0])}
    lamp["emitter"] = {"type": "area", "radiance": 2.0}
    shape = scenes.boundary(scenes.medium(1.0, 0.8))
    settings = {"type": "irrcache", "solver": "auto", "resolution": 8, "cache_spp": 32}
    mi.render(scenes.load(settings, shape, 4, lamp=lamp, default_solver="path"), spp=1)
    lamp["to_world"] = lamp["to_world"] @ mi.ScalarTransform4f(place)
    with pytest.raises(RuntimeError, match=r'shape "lamp".*not round.*same scale'):
        mi.render(scenes.load(settings, shape, 4, lamp=lamp, default_solver="path"), spp=1)


def box_without_a_face() -> mi.Mesh:
    """Return a box that lacks a face but has all eight corners."""
    params = mi.traverse(mi.load_dict({"type": "cube"}))
    vertices, faces = (np.array(params[k]) for k in ("vertex_positions", "faces"))
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict({"type": "null"})
    properties["interior"] = mi.load_dict({"type": "homogeneous"})
    mesh = mi.Mesh("box", len(vertices) // 3, len(faces) // 3 - 2, props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = vertices, faces[:-6]
    params.update()
    return mesh


def rectangle(scenes) -> dict:
    return scenes.boundary(scenes.medium(1.0, 0.8), kind="rectangle")


ALONE = {"box without a face": lambda scenes: box_without_a_face(), "rectangle": rectangle}


@pytest.mark.parametrize("build", ALONE.values(), ids=ALONE)
def test_open_boundaries_are_refused(scenes, build):
    scene = scenes.load({"type": "irrcache", "solver": "auto"}, build(scenes), 4)
    with pytest.raises(RuntimeError, match="not closed"):
        mi.render(scene, spp=1)


def test_null_shape_at_the_centre_is_not_part_of_the_boundary(scenes):
    """A null sphere in the middle of a cube does not change which boundaries are accepted.

    The cube is accepted, and refused if it is mirrored.
    """
    ball = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "null"}}
    shape = scenes.boundary(scenes.medium(1.0, 0.8))
    settings = {"type": "irrcache", "solver": "auto", "resolution": 8, "cache_spp": 32}
    scenes.image(scenes.load(settings, shape, 4, ball=ball, default_solver="path"), spp=1)
    shape["to_world"] = mi.ScalarTransform4f(np.diag([-1.0, 1, 1, 1]))
    with pytest.raises(RuntimeError, match=r"normals.*inwards"):
        mi.render(scenes.load(settings, shape, 4, ball=ball, default_solver="path"), spp=1)


@pytest.mark.parametrize("depth", [2, -1])
def test_medium_with_a_hole(scenes, depth):
    """A medium with a hole is not solved as if it had none: the mean would be 0.3 to 1 % too small.

    The hole is a null shape that has the medium only as its exterior.
    """
    fog = {"type": "ref", "id": "fog"}
    hole = {"type": "sphere", "radius": 0.7, "bsdf": {"type": "null"}, "exterior": fog}
    box = scenes.boundary(scenes.medium(1.5, 0.8)) | {"interior": fog}
    images = []
    for name, spp in (("irrcache", 64), ("volpath", 1024)):
        settings = {"type": name, "max_depth": depth, "rr_depth": 50}
        if name == "irrcache":
            settings |= {"solver": "auto", "resolution": 32, "cache_spp": 128}
        described = scenes.description(
            settings, None, 16, box=box, hole=hole, default_solver="path"
        )
        scene = mi.load_dict({"type": "scene", "fog": scenes.medium(1.5, 0.8)} | described)
        images.append(scenes.image(scene, spp=spp).mean())
        if name == "irrcache":
            assert scene.integrator().caches
            (part,) = scene.integrator()._builder.parts
            assert part.solver.name == "sweep" and '"hole"' in part.shared
    assert images[0] / images[1] == pytest.approx(1, abs=0.002)


def test_unbounded_media_are_refused(scenes):
    """A grid medium that is only the exterior of a shape is refused.

    volpath shows no radiance that leaves such a medium.
    """
    smoke = scenes.medium(scenes.texture((4, 4, 4), 0.5, 1.0, 1), 0.8, scenes.placement())
    fog = {"type": "ref", "id": "smoke"}
    hole = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "null"}, "exterior": fog}
    described = scenes.description({"type": "irrcache", "solver": "auto"}, None, 4, hole=hole)
    described = {"type": "scene", "smoke": smoke} | described
    message = r'"smoke" is the exterior.*the interior of none.*null BSDF'
    with pytest.raises(RuntimeError, match=message):
        mi.render(mi.load_dict(described), spp=1)


@pytest.mark.parametrize("wrapper", [None, "aov", "moment"])
def test_messages_contain_the_cause(scenes, wrapper):
    """The message of mi.render's exception is the cause itself."""
    shape = scenes.boundary(scenes.medium(1.0, 0.8)) | {"flip_normals": True}
    integrator = {"type": "irrcache"}
    if wrapper:
        more = {"aovs": "d:depth"} if wrapper == "aov" else {}
        integrator = {"type": wrapper, "inner": integrator} | more
    scene = scenes.load(integrator, shape, 4, default_solver="path")
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene, spp=1)
    assert re.search("normals of shape.*inwards.*flip_normals", str(caught.value), re.DOTALL)
    assert "see above" not in str(caught.value)


def test_exterior_media_of_walls_need_a_shape_to_fill(scenes):
    """An opaque shape's exterior medium that fills no shape is refused with the remedy."""
    walls, fog = {"fog": {"type": "homogeneous"}}, {"type": "ref", "id": "fog"}
    for name, turn in (("floor", -90), ("ceiling", 90)):
        place = mi.ScalarTransform4f().rotate([1, 0, 0], turn).translate([0, 0, -2])
        walls[name] = {"type": "rectangle", "to_world": place, "exterior": fog}
    scene = scenes.load({"type": "irrcache", "solver": "auto"}, None, 4, **walls)
    with pytest.raises(RuntimeError, match=r'"fog".*exterior of shape ".*null BSDF.*interior'):
        mi.render(scene, spp=1)


def glass(extinction: list[float]) -> dict:
    fog = {"type": "homogeneous", "sigma_t": {"type": "rgb", "value": extinction}}
    return {"type": "sphere", "bsdf": {"type": "dielectric"}, "interior": fog}


@pytest.mark.parametrize(
    ("red", "expected"),
    [(1.0, "volpath"), (0.7, "volpath"), (0.4, "volpathmis"), (0.0, "volpathmis")],
)
def test_the_stock_integrator_by_extinction(scenes, red, expected):
    scene = scenes.load(
        {"type": "irrcache", "solver": "path"}, None, 4, ball=glass([red, 0.9, 1.0])
    )
    assert choose_stock(scene)[0] == expected


def sensor(origin, **more) -> dict:
    look = mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    return {"type": "perspective", "to_world": look, "film": film} | more


OUTSIDE = {
    "a homogeneous medium alone": lambda scenes: (scenes.medium(1.0, 0.8), {}),
    "a grid alone": lambda scenes: (
        scenes.medium(scenes.texture((4, 4, 4), 0.5, 1.0, 1), 0.8, scenes.placement()), {}),
    "beside a ball": lambda scenes: (
        scenes.medium(1.0, 0.8), {"ball": {"type": "sphere", "center": [2, 0, 0], "radius": 0.5}}),
}  # fmt: skip


@pytest.mark.parametrize("build", OUTSIDE.values(), ids=OUTSIDE)
def test_sensors_that_are_not_in_their_medium_are_refused(scenes, build):
    """A sensor with a medium that does not contain it is refused.

    This includes a sensor that was moved out since; inside and on a face it is accepted.
    """
    medium, more = build(scenes)
    fog = {"type": "ref", "id": "fog"}
    shape = scenes.boundary(medium) | {"interior": fog}
    settings = {"type": "irrcache", "solver": "auto", "resolution": 8, "cache_spp": 32}
    inside, outside = (sensor((0.1, 0.2, z), medium=fog) for z in (-0.7, -5.0))
    told = r'sensor "sensor" has the medium "fog".*not located in it.*Remove'

    def load(where: dict) -> mi.Scene:
        described = scenes.description(settings, None, 4, **more, default_solver="path")
        described = {"type": "scene", "fog": medium} | described | {"box": shape, "sensor": where}
        return mi.load_dict(described)

    with pytest.raises(RuntimeError, match=told):
        mi.render(load(outside), spp=1)
    mi.render(load(sensor((0.1, 0.2, -1.0), medium=fog)), spp=1)
    scene = load(inside)
    mi.render(scene, spp=1)
    params = mi.traverse(scene.sensors()[0])
    params["to_world"] = mi.Transform4f(outside["to_world"].matrix)
    params.update()
    with pytest.raises(RuntimeError, match=told):
        mi.render(scene, spp=1)


STOCK = {
    "nothing": (None, "volpath"),
    "chromatic": ([0.1, 0.4, 1.0], "volpathmis"),
}


@pytest.mark.parametrize(("extinction", "expected"), STOCK.values(), ids=STOCK)
def test_cheapest_stock_integrator_replaces_the_cache(scenes, tmp_path, extinction, expected):
    """If no cache is useful, the image is bit by bit that of the cheapest stock integrator.

    The log says so once per scene.
    """
    ball = {} if extinction is None else {"ball": glass(extinction)}
    depth = {"max_depth": 4, "rr_depth": 5}
    ours = scenes.load({"type": "irrcache", "solver": "path"} | depth, None, 8, **ball)
    stock = scenes.load({"type": expected} | depth, None, 8, **ball, default_solver="path")
    assert choose_stock(ours)[0] == expected
    log = tmp_path / "log.txt"
    logger = mi.logger()
    appender = (
        mi.FileAppender(str(log)) if hasattr(mi, "FileAppender") else mi.StreamAppender(str(log))
    )
    logger.add_appender(appender)
    mi.set_log_level(mi.LogLevel.Info)
    try:
        first = scenes.image(ours, spp=4, seed=5)
        scenes.image(ours, spp=4, seed=6)
    finally:
        mi.set_log_level(mi.LogLevel.Error)
        logger.remove_appender(appender)
    np.testing.assert_array_equal(first, scenes.image(stock, spp=4, seed=5))
    assert log.read_text().count("no cache is used") == 1
