"""Media bounded by meshes, nested media and holes, by ``sweep``, against ``path`` and volpath."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError
from tests.support.slow import with_slow
from tests.support.surfaces import SIZE, ball, blocks, bound, check, fog, ground, lamp, ref
from tests.support.torus import torus

pytestmark = pytest.mark.usefixtures("rgb")

SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}}
NULL = {"type": "null"}


def ring(interior: dict | None = None) -> dict:
    return {"ring": torus(interior or fog((3.0, 3.0, 3.0), (0.95, 0.8, 0.6)), 0.6, 0.35)}


def nested(core: dict | None = None, **outer) -> dict:
    """Return a ball in fog; an empty one without ``core``."""
    inner = ball((0.2, 0.1, -0.1), 0.45, bsdf=NULL, exterior=ref("fog"))
    objects = {"fog": fog((0.8, 0.8, 0.8), (0.95, 0.95, 0.95))}
    if core is not None:
        objects, inner = objects | {"core": core}, inner | {"interior": ref("core")}
    return objects | {"outer": bound(interior=ref("fog")) | outer, "inner": inner}


def voxels(scenes) -> dict:
    """Return a medium of random voxels in the box of the ring."""
    data = scenes.texture((5, 7, 6), 0.5, 6, 3)
    to_world = np.diag([1.9, 0.7, 1.9, 1.0])
    to_world[:3, 3] = -0.95, -0.35, -0.95
    return scenes.medium(data, 0.9, to_world)


DENSE = fog((6.0, 6.0, 6.0), (0.95, 0.7, 0.4))
COLOURED = fog((0.5, 2.0, 6.0))
FORWARD = fog((3.0, 3.0, 3.0)) | {"phase": {"type": "hg", "g": 0.5}}
CASES = {
    "mesh": (ring, {}),
    "mesh, single scattering": (ring, {"max_depth": 2}),
    "mesh over the ground": (lambda: ring() | {"ground": ground()}, {}),
    "mesh in colour": (lambda: ring(COLOURED), {}),
    "mesh, hg": (lambda: ring(FORWARD), {}),
    "nested": (lambda: nested(DENSE), {}),
    "nested, single scattering": (lambda: nested(DENSE), {"max_depth": 2}),
    "hole": (nested, {}),
    "hole, single scattering": (nested, {"max_depth": 2}),
    "nested in colour": (lambda: nested(COLOURED), {}),
}


def render(objects: dict, solver: str, depth: int, seed: int, **settings) -> tuple:
    integrator = {"type": "irrcache", "max_depth": depth, "solver": solver, "cache_seed": seed}
    scene = mi.load_dict(description(objects) | {"integrator": integrator | settings})
    image = np.array(mi.render(scene, spp=128, seed=seed), dtype=np.float64)[..., :3]
    return image, scene.integrator()


def description(objects: dict) -> dict:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([1, 1.5, -5], [0, 0, 0], [0, 1, 0])
    camera = {"type": "perspective", "fov": 32, "to_world": place, "film": film}
    return {"type": "scene", "sensor": camera} | objects


def reference(objects: dict, kind: str, depth: int, seed: int, spp: int) -> np.ndarray:
    scene = mi.load_dict(description(objects))
    integrator = mi.load_dict({"type": kind, "max_depth": depth, "rr_depth": 1000})
    image = mi.render(scene, integrator=integrator, spp=spp, seed=seed)
    return np.array(image, dtype=np.float64)[..., :3]


#: Their shapes are also rendered in colour or with all orders, and single scattering in the ring.
SLOW = "nested", "mesh in colour", "nested, single scattering", "hole, single scattering"


@pytest.mark.parametrize("name", with_slow(list(CASES), *SLOW))
def test_images_are_those_of_volpath(name, scenes):
    """Images under a sky and a sun agree in all blocks, with an error of 2 % allowed."""
    make, settings = CASES[name]
    depth = settings.get("max_depth", -1)
    objects = make() | {"sky": SKY, "sun": scenes.sun}
    pairs = [render(objects, "auto", depth, seed, resolution=20) for seed in (1, 2)]
    assert all(c.correlated for _, i in pairs for c in i.caches.values())
    kind = "volpathmis" if "colour" in name else "volpath"
    theirs = [reference(objects, kind, depth, seed, 256) for seed in (3, 4)]
    check(*(image for image, _ in pairs), *theirs)


LIGHTS = {
    "lamp": lambda: {"lamp": lamp((0.3, 2.0, -1.0), (0, 0, 0))},
    "point": lambda: {"point": {"type": "point", "position": [0.0, 0.1, 0.05], "intensity": 3.0}},
}


@pytest.mark.parametrize("light", LIGHTS)
def test_emitters_near_a_mesh(light, scenes):
    """The uncollided irradiance in a mesh from a lamp, and from a point in its hole, is that of
    ``path``, voxel by voxel.
    """
    found = []
    for solver, spp in (("sweep", 256), ("path", 1024)):
        integrator = {"type": "irrcache", "max_depth": -1, "solver": solver, "cache_spp": spp}
        scene = mi.load_dict(
            description(ring(voxels(scenes)) | LIGHTS[light]())
            | {"integrator": integrator | {"resolution": 12}}
        )
        scene.integrator().prepare(scene)
        found.append(scene.integrator().cache)
    ours, theirs = (np.array(c.uncollided)[..., 0] for c in found)
    inside = (ours > 0) & (theirs > 0)
    assert inside.sum() > 200
    assert ours[inside].sum() == pytest.approx(theirs[inside].sum(), rel=0.01)
    difference = np.abs(ours - theirs)[inside].sum() / theirs[inside].sum()
    assert difference < (0.02 if light == "point" else 0.1)


@pytest.mark.parametrize("objects", ["mesh", "nested", "hole"])
def test_a_white_furnace_is_white(objects):
    """With albedo 1 and a uniform environment, radiance is 1 within the noise of the directions."""
    white = (1.0, 1.0, 1.0)
    objects = {
        "mesh": lambda: ring(fog((3.0, 3.0, 3.0), white)),
        "nested": lambda: nested(fog((6.0, 6.0, 6.0), white)),
        "hole": nested,
    }[objects]()
    if "fog" in objects:
        objects["fog"] = fog((0.8, 0.8, 0.8), white)
    world = {"world": {"type": "constant", "radiance": 1.0}}
    image, _ = render(objects | world, "sweep", -1, 1, resolution=12, cache_spp=256)
    assert image.mean() == pytest.approx(1, abs=2e-3)
    assert np.abs(blocks(image) - 1).max() < 0.01


def test_the_same_seed_gives_the_same_bits():
    """Two scenes have equal images: no sum depends on the order of threads."""
    first, second = (
        render(nested(DENSE) | {"sky": SKY}, "sweep", -1, 1, resolution=12)[0] for _ in "ab"
    )
    np.testing.assert_array_equal(first, second)


REFUSED = {
    "emissive": (ring, {"emission": 1.0}),
    "other shapes than one box or sphere.*refracts": (
        lambda: {"ring": glass_ring()}, {},
    ),
    "scatters anisotropically": (lambda: nested(FORWARD), {}),
    '"post".*reaches into': (lambda: nested() | {"post": ball((-0.5, 0, 0), 0.2)}, {}),
}  # fmt: skip


def glass_ring() -> mi.Mesh:
    """Return the ring with a boundary of glass."""
    mesh = torus(fog(), 0.6, 0.35)
    mesh.set_bsdf(mi.load_dict({"type": "dielectric"}))
    return mesh


@pytest.mark.parametrize("reason", REFUSED)
def test_what_sweep_refuses_there(reason):
    """A request for ``sweep`` is refused with the reason, and ``auto`` uses ``path``."""
    make, settings = REFUSED[reason]
    objects = make() | {"sky": SKY}
    with pytest.raises(Exception, match=f"(?s)sweep.*{reason}"):
        render(objects, "sweep", -1, 1, resolution=6, **settings)
    _, integrator = render(objects, "auto", -1, 1, resolution=6, cache_spp=16, **settings)
    assert not any(cache.correlated for cache in integrator.caches.values())


def test_gradients_are_refused():
    """Gradients in media that are nested or in a mesh are refused by name."""
    for objects, reason in ((ring(), "other shapes"), (nested(), "is a hole in")):
        scene = mi.load_dict(description(objects | {"sky": SKY}))
        params = mi.traverse(scene)
        key = next(k for k in params.keys() if k.endswith("albedo.value.value"))
        dr.enable_grad(params[key])
        params.update()
        integrator = mi.load_dict({"type": "irrcache", "max_depth": -1, "resolution": 6})
        with pytest.raises(IrrcacheError, match=reason):
            dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=4)))
