"""Phase functions and their angular moments, and radiance by direction."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.narrow_sources import sources_of
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers.path.estimator import contributions
from mitsuba_irrcache.transport.path_tracer import PathTracer

pytestmark = pytest.mark.usefixtures("rgb")


def scene_of(scenes, phase: dict, **objects) -> mi.Scene:
    medium = scenes.medium(1.0, 0.9) | {"phase": phase}
    return scenes.load({"type": "volpath"}, scenes.boundary(medium), 8, **objects)


def hg(g: float) -> dict:
    return {"type": "hg", "g": g}


MOMENTS = {
    "hg": (hg(0.4), [1, 0.4, 0.16, 0.064], (3, 5)),
    "hg backwards": (hg(-0.25), [1, -0.25, 0.0625, -0.015625], (2, 3)),
    "rayleigh": ({"type": "rayleigh"}, [1, 0, 0.1, 0], (2, 2)),
    "blend": (
        {"type": "blendphase", "weight": 0.25, "a": hg(0.4), "b": {"type": "isotropic"}},
        [1, 0.3, 0.12, 0.048], (3, 4),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("phase", "moments", "orders"), MOMENTS.values(), ids=MOMENTS)
def test_moments(scenes, phase, moments, orders):
    """The order is higher under an uneven environment."""
    texels = np.ones((4, 8, 3), np.float32)
    texels[:2] = 0
    sky = {"emitter": {"type": "envmap", "bitmap": mi.Bitmap(texels)}}
    for emitters, order in zip(({}, sky), orders, strict=True):
        found = compile_scene(scene_of(scenes, phase, **emitters)).visible[0].phase
        np.testing.assert_allclose(found.moments[:4], moments, atol=2e-4)
        assert found.order == order


@pytest.mark.parametrize("phase", [{"type": "isotropic"}, hg(0.0)])
def test_isotropic_phase_functions_have_no_moments(scenes, phase):
    assert compile_scene(scene_of(scenes, phase)).visible[0].phase.is_isotropic


REFUSED = {
    "sharp": (hg(0.95), "HGPhaseFunction.*0.95.*0.58.*0.85.*volpath"),
    "sharp and backwards": (hg(-0.8), "HGPhaseFunction.*-0.80.*0.58.*volpath"),
    "oriented": (
        {"type": "sggx", "S": {"type": "gridvolume", "grid": "S"}}, "angle of scattering.*volpath",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("phase", "message"), REFUSED.values(), ids=REFUSED)
def test_unsupported_phase_functions_are_refused(scenes, phase, message):
    if "S" in phase:
        values = np.tile(np.float32([0.1, 0.1, 1, 0, 0, 0]), (2, 2, 2, 1))
        phase["S"] = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True}
    with pytest.raises(UnsupportedSceneError, match=message):
        compile_scene(scene_of(scenes, phase))


def lamp(size: float, place: tuple = (0.6, 2.2, 1.5)) -> dict:
    place = mi.ScalarTransform4f().look_at(list(place), [0, 0, 0], [0.1, 1, 0.2]).scale(size)
    emitter = {"type": "area", "radiance": 10.0}
    return {"type": "rectangle", "to_world": place, "emitter": emitter}


POINT = {"type": "point", "position": [1.5, 2.0, -1.0], "intensity": 20.0}
LIGHTS = {
    "sky and sun": ({}, 0.02),
    "point": ({"emitter": POINT, "sun": None}, 0.02),
    "small lamp": ({"emitter": 0.1, "sun": None}, 0.02),
    "large lamp": ({"emitter": 0.5, "sun": None}, 0.03),
    "lamp close by": ({"emitter": (0.4, (0.3, 1.3, -0.2)), "sun": None}, 0.03),
}


@pytest.mark.parametrize(("objects", "tolerance"), LIGHTS.values(), ids=LIGHTS)
@pytest.mark.parametrize("g", [0.5, -0.3])
def test_scattered_radiance_from_moments_and_from_directions(scenes, objects, tolerance, g):
    """Scattered radiance from moments agrees with the sum over directions.

    The sum weights the same samples by 4 pi p; the difference is relative to the mean.
    """
    if isinstance(objects.get("emitter"), float):
        objects = objects | {"emitter": lamp(objects["emitter"])}
    elif isinstance(objects.get("emitter"), tuple):
        objects = objects | {"emitter": lamp(*objects["emitter"])}
    scene = scene_of(scenes, hg(g), **objects)
    media, count = compile_scene(scene).media, 1 << 16
    medium = media.grids[0]
    directional = AngularBasis(medium.phase, *sources_of(scene))
    rng, p = mi.PCG32(count), mi.Point3f(0.2, 0.5, -0.3)
    spread = [rng.next_float32() for _ in range(4)]
    limits = [dr.opaque(mi.UInt32, n) for n in (3, 100)]
    found = contributions(PathTracer(scene, media, *limits), p, medium.pointer, spread, rng)
    dr.eval(found)

    def mean(value) -> float:
        return float(np.mean(np.array(mi.Spectrum(value)[1])))

    phi = mean(sum(u + s for _, u, s in found))
    moments = [mean(m) for m in directional.moments(p, found)]
    for way in ((0, 1, 0), (0.6, 0, 0.8), (-0.4, 0.8, -0.44721), (0, -1, 0)):
        way = dr.normalize(mi.Vector3f(*way))
        phase = medium.phase
        exact = mean(sum((u + s) * phase.gain(p, way, d) for d, u, s in found)) / phi
        weights = directional.basis(way) + directional.gains(p, way, mi.Bool(True))
        extra = sum(float(w[0]) * m for w, m in zip(weights, moments, strict=True)) / phi
        assert 1 + extra == pytest.approx(exact, abs=tolerance * phase.peak / 2)


@pytest.fixture
def field_and_view(scenes) -> tuple:
    """Random moments behind a sun and a forward peak, positions between voxels, and a direction."""
    sun = {"type": "directional", "direction": [0.2, -1.0, 0.3]}
    scene, rng = scene_of(scenes, hg(0.85), sun=sun), np.random.default_rng(1)
    phase = compile_scene(scene).visible[0].phase
    basis = AngularBasis(phase if phase.forward else phase.without_peak(), sources_of(scene)[0])
    moments = [mi.Float(0.01 * rng.random(27, dtype=np.float32)) for _ in range(basis.count)]
    phi = mi.Float(1 + rng.random(27, dtype=np.float32))
    field = AngularField(basis, Grid((3, 3, 3), np.eye(4)), [phi], moments)
    near = np.float32([[0.4], [0.55], [0.61]] + 1e-3 * rng.random((3, 100_000)))
    direction = dr.normalize(mi.Vector3f(0.3, 0.9, -0.2))
    return field, mi.Point3f(near), direction


def test_moments_of_one_voxel_are_right_on_average(field_and_view):
    field, p, direction = field_and_view
    view = direction, field.directional.basis(direction)
    exact = np.array(field.factor(p, *view, mi.Bool(True), with_peak=False))
    assert 0.5 < exact.min()  # not clipped
    sampled = np.array(field.sampled_factor(p, *view, mi.Bool(True)))
    assert 3e-3 < sampled.std() < 0.1
    assert abs(sampled.mean() - exact.mean()) < 4 * sampled.std() / np.sqrt(len(sampled))


def test_forward_peak_alone_is_the_difference_that_it_makes(field_and_view):
    field, p, direction = field_and_view
    view, everywhere = (direction, field.directional.basis(direction)), mi.Bool(True)
    smooth = np.array(field.factor(p, *view, everywhere, with_peak=False))
    both = np.array(field.factor(p, *view, everywhere, with_peak=True, peak_depth=mi.Float(0.3)))
    assert np.abs(both - smooth).min() > 1e-3
    alone = np.array(field.peak_factor(p, direction, everywhere, mi.Float(0.3)))
    np.testing.assert_allclose(alone, both - smooth, atol=1e-6)
