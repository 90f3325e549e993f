"""Gradients in scenes with surfaces, area emitters and several media."""

from __future__ import annotations

import re
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.gradients.cases import (
    BEHIND,
    POINT,
    SKY,
    SUN,
    SURROUNDED,
    Case,
    distant,
    ground,
    lamp,
    panel,
    second_medium,
)
from experiments.validation.gradients.differences import (
    compare,
    first_key,
    gradients,
    pixel_weights,
)
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients import paths, surroundings, surroundings_adjoint, traced
from mitsuba_irrcache.gradients.surroundings_adjoint import SurroundingsAdjoint
from tests.support.slow import with_slow

#: Largest relative error of directional derivatives, and the least cosine. The differences
#: themselves have a noise of 1 to 2 % (standard deviation over seeds of the cache).
ERROR, COSINE = 0.05, 0.998
PERTURBATIONS = 2


@pytest.fixture
def fewer_paths(monkeypatch):
    monkeypatch.setattr(surroundings_adjoint, "RAYS", 1 << 18)
    monkeypatch.setattr(surroundings_adjoint, "EXCHANGED", 1 << 16)


def with_gradient_of_albedo() -> tuple[mi.Scene, mi.SceneParameters]:
    """Return a scene with a ground, and the albedo of its medium, which carries gradients."""
    scene = replace(SURROUNDED["ground, sky"], data=8, cache=8, directions=64).load()
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("albedo.data"))
    params.keep([key])
    dr.enable_grad(params[key])
    params.update()
    return scene, params


@pytest.mark.parametrize(
    ("spp", "views", "expected"), [(4, 1, 1 << 16), (64, 1, 1 << 17), (64, 2, 1 << 18)]
)
def test_paths_from_voxels_are_as_many_as_camera_samples_need(
    mono, monkeypatch, spp, views, expected
):
    """They cost most of a gradient, and the noise of the camera samples exceeds theirs."""
    scene, params = with_gradient_of_albedo()
    counts = []
    start = SurroundingsAdjoint._from_voxels

    def counted(self, number, importance, use, first, rays):
        counts.append((use == surroundings.DERIVATIVES) * rays)
        return start(self, number, importance, use, first, rays)

    monkeypatch.setattr(SurroundingsAdjoint, "_from_voxels", counted)
    image = sum(mi.render(scene, params, spp=spp, seed=seed) for seed in range(views))
    dr.backward(dr.mean(image))
    assert sum(counts) == expected


def test_images_in_one_loss_have_paths_of_their_own(mono, monkeypatch):
    """Paths of all images had the same random numbers, so that more images did not reduce the noise
    of a gradient.
    """
    scene, params = with_gradient_of_albedo()
    drawn = []
    trace = paths.TracedPaths.trace

    def recorded(self, start):
        if start.adjoint_of_irradiance is None:
            drawn.append(np.array(mi.PCG32(start.rng).next_uint32()))
        return trace(self, start)

    monkeypatch.setattr(paths.TracedPaths, "trace", recorded)
    # Images of several sensors usually have the same seed.
    dr.backward(dr.mean(sum(mi.render(scene, params, spp=1, seed=seed) for seed in (0, 0, 1))))
    assert len(drawn) == 3
    for k in range(3):
        assert np.mean(drawn[k] == drawn[k - 1]) < 1e-3


#: What differs in quick cases. On coarse grids and with few samples, errors are about as small.
QUICK = {"data": 8, "cache": 8, "samples": 64, "directions": 128}
QUICK_CASES = {
    "two media, sky": {"data": 12, "cache": 12, "samples": 64},
    "emission, hg 0.5, sun, single": QUICK | {"depth": 0.2},
    "hg 0.65, two media, sun": QUICK | {"directions": 256},
}


# Other quick tests cover the slow cases: the test in colour has a floor and a sun, that of panes a
# window, and `test_a_distant_object_changes_nothing` a distant object.
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        pytest.param("ground, sky", ("sigma_t", "floor"), marks=pytest.mark.slow),
        pytest.param("lamp", ("albedo", "lamp"), marks=pytest.mark.slow),
        ("two media, sky", ("sigma_t", "other.interior_medium.sigma_t")),
        pytest.param("distant object, empty voxels", ("sigma_t",), marks=pytest.mark.slow),
        pytest.param("ground, sun through a window", ("sigma_t",), marks=pytest.mark.slow),
        pytest.param("lamp over a ground, single", ("sigma_t", "lamp"), marks=pytest.mark.slow),
        pytest.param("hg 0.5, ground, sun", ("sigma_t", "albedo"), marks=pytest.mark.slow),
        pytest.param("hg 0.5, lamp over a ground", ("albedo", "lamp"), marks=pytest.mark.slow),
        pytest.param("hg 0.5, two media, sun", ("sigma_t", "albedo"), marks=pytest.mark.slow),
        pytest.param("hg 0.5, distant object, empty voxels", ("sigma_t",), marks=pytest.mark.slow),
        pytest.param("hg 0.85, ground, sun", ("sigma_t", "albedo"), marks=pytest.mark.slow),
        ("emission, hg 0.5, sun, single", ("sigma_t", "emission")),
        pytest.param("emission alone", ("sigma_t", "albedo", "emission"), marks=pytest.mark.slow),
        pytest.param("emission, ground, sky", ("sigma_t", "emission"), marks=pytest.mark.slow),
        pytest.param("hg 0.54, ground, sky", ("g",), marks=pytest.mark.slow),
        pytest.param("hg -0.45, room, sky", ("g",), marks=pytest.mark.slow),
        pytest.param("hg 0.54, ground, sun, single", ("g",), marks=pytest.mark.slow),
        ("hg 0.65, two media, sun", ("g",)),
    ],
)
def test_gradients_are_those_of_the_image(mono, name, parameters):
    case = replace(SURROUNDED[name], **QUICK_CASES.get(name, {}))
    scene = case.load()
    weights = pixel_weights(scene)
    found = gradients(scene, parameters, weights)
    for parameter, gradient in found.items():
        result = compare(scene, case, parameter, weights, gradient, PERTURBATIONS)
        assert result.error < ERROR, parameter
        assert result.cosine > COSINE, parameter


# The quick cases have single scattering, or an anisotropic phase function.
@pytest.mark.parametrize(
    ("max_depth", "g"),
    with_slow({"single": (2, None), "both": (2, 0.5), "peak": (-1, 0.85)}, "both"),
)
def test_gradients_are_those_of_the_radiance_along_paths(mono, monkeypatch, max_depth, g):
    """The objective by the paths of the gradient themselves has little noise: the same random
    numbers, and no interpolation on surfaces. Adjoint fluence of rays along which nothing may be
    scattered any more made an error of 7 %.
    """
    found, trace = [], paths.TracedPaths.trace

    def recorded(self, start):
        radiance = trace(self, start)
        if start.adjoint_of_irradiance is None:  # a camera ray
            found.append(np.array(radiance, dtype=np.float64).sum())
        return radiance

    monkeypatch.setattr(paths.TracedPaths, "trace", recorded)
    case = Case(data=8, cache=8, g=g, max_depth=max_depth, objects=ground, directions=256)
    scene = case.load()
    weights, params = pixel_weights(scene), mi.traverse(scene)
    key = first_key(params, "sigma_t")
    value = np.array(params[key], dtype=np.float64)
    gradient = gradients(scene, ("sigma_t",), weights)["sigma_t"]
    change = 0.1 * value * (1 + np.sin(np.arange(8)))[:, None]
    objectives = []
    for sign in (1, -1):
        params[key] = mi.TensorXf((value + sign * change).astype(np.float32))
        params.update()
        found.clear()
        gradients(scene, ("sigma_t",), weights)
        objectives.append(sum(found))
        params = mi.traverse(scene)
    difference = 0.5 * (objectives[0] - objectives[1])
    assert (gradient * change).sum() == pytest.approx(difference, rel=0.03)


def pane(kind: str, share: float = 0.5) -> dict:
    """A pane in front of the camera, at a ``share`` of its distance."""
    camera = np.array([1.0, 1.5, -5.0])
    place = mi.ScalarTransform4f().look_at(share * camera, camera, [0, 1, 0]).scale(2)
    bsdfs = {
        "pane": {"type": "thindielectric"},
        "mask": {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}},
    }
    return {"pane": {"type": "rectangle", "to_world": place, "bsdf": bsdfs[kind]}}


def around(kind: str) -> dict:
    """Panes at five sides of the medium."""
    turn, found = mi.ScalarTransform4f().rotate, {}
    sides = (([1, 0, 0], 90), ([1, 0, 0], -90), ([0, 1, 0], 90), ([0, 1, 0], -90), ([0, 1, 0], 0))
    for number, (axis, angle) in enumerate(sides):
        place = turn(axis, angle).translate([0, 0, 1.4]).scale(1.4)
        found[f"side{number}"] = pane(kind)["pane"] | {"to_world": place}
    return found


@pytest.mark.parametrize(
    ("objects", "settings"),
    [
        (lambda: pane("pane"), {"max_depth": 2, "emitters": lambda: {"sun": SUN}}),
        (lambda: pane("mask") | ground(), {"max_depth": 2, "emitters": lambda: {"sun": SUN}}),
        (lambda: around("pane"), {"max_depth": 2}),
        (lambda: around("mask"), {"max_depth": 2, "g": 0.5}),
        pytest.param(lambda: around("pane"), {}, marks=pytest.mark.slow),
        (ground, {"origin": (0.2, 0.3, -0.4), "emitters": lambda: {"sun": SUN}}),
        (lambda: pane("pane"), {"g": 0.8, "emitters": lambda: {"sun": BEHIND}, "directions": 128}),
    ],
    ids=["pane", "mask", "panes", "masks", "panes, all orders", "camera in the medium", "peak"],
)
def test_images_are_linear_in_the_radiance_of_emitters(mono, fewer_paths, objects, settings):
    """The sum of radiance times gradient is the objective. Paths of single scattering ended at
    panes (ratios 0, .51, .28, .66), and no forward peak was seen through them (.33). The image
    lacks the medium around a sensor that does not name it; the gradient did not (1.27).
    """
    case = Case(data=8, cache=8, objects=objects, **({"directions": 256} | settings))
    scene = case.load(hide_emitters=True)
    weights = pixel_weights(scene)
    (name,) = case.emitters()
    gradient = gradients(scene, (name,), weights)[name]
    params = mi.traverse(scene)
    value = np.array(params[first_key(params, name)], dtype=np.float64)
    objective = (np.array(mi.render(scene, spp=128, seed=5), dtype=np.float64) * weights).sum()
    tolerance = 0.08 if case.g == 0.8 else 0.03  # the directions of sharp phase functions are noisy
    assert (gradient * value).sum() == pytest.approx(objective, rel=tolerance)


#: A position of the camera below the medium.
LOW = 1.0, -0.5, -5.0


def spot_behind() -> dict:
    """An environment with a bright spot behind the medium, as seen from `LOW`."""
    rows, columns = np.meshgrid(np.arange(64), np.arange(128), indexing="ij")
    polar, turn = (rows + 0.5) * np.pi / 64, (columns + 0.5) * np.pi / 64
    around = np.sin(turn) * np.sin(polar), np.cos(polar), -np.cos(turn) * np.sin(polar)
    camera = np.array(LOW) / np.linalg.norm(LOW)
    cosine = -sum(a * b for a, b in zip(around, camera, strict=True))
    values = np.where(cosine > np.cos(np.deg2rad(5)), 50.0, 0.2)
    bitmap = mi.Bitmap(np.repeat(values[..., None], 3, axis=-1).astype(np.float32))
    return {"sky": {"type": "envmap", "bitmap": bitmap}}


@pytest.mark.parametrize(
    ("where", "hidden"),
    [
        ({"emitters": dict, "objects": lambda: panel(0.6)}, False),
        ({"emitters": dict, "objects": lambda: panel(0.6)}, True),
        ({"emitters": spot_behind, "objects": ground, "origin": LOW}, False),
    ],
    ids=["lamp", "hidden lamp", "bright spot"],
)
def test_sources_behind_a_forward_peak_count_once(mono, fewer_paths, where, hidden):
    """Rays saw them with the transmittance of the medium without its peak, and scattered what the
    peak scatters of their radiance, too: ratios of 1.15, and up to 1.8 for derivatives by g.
    """
    case = Case(data=8, cache=8, g=0.7, directions=128, **where)
    scene = case.load(hide_emitters=hidden)
    weights = pixel_weights(scene)
    name = next(iter(case.emitters() or case.objects()))
    gradient = gradients(scene, (name,), weights)[name]
    params = mi.traverse(scene)
    value = np.array(params[first_key(params, name)], dtype=np.float64)
    objective = (np.array(mi.render(scene, spp=128, seed=5), dtype=np.float64) * weights).sum()
    assert (gradient * value).sum() == pytest.approx(objective, rel=0.04)


def test_derivatives_with_respect_to_g_beside_wide_lamps(mono, fewer_paths):
    """They were .5 to 1.8 times those of the image: what a forward peak scatters of a lamp's
    radiance was part of its transmittance and of scattering into camera rays.
    """
    where = {"emitters": dict, "objects": lambda: panel(8.0)}
    case = Case(data=8, cache=8, g=0.7, homogeneous=True, depth=0.25, directions=128, **where)
    scene = case.load()
    weights, params = pixel_weights(scene), mi.traverse(scene)
    gradient = gradients(scene, ("g",), weights)["g"]
    key = first_key(params, "g")
    objectives = []
    for g in (0.72, 0.68):
        params[key] = mi.Float(g)
        params.update()
        image = np.array(mi.render(scene, spp=256, seed=5), dtype=np.float64)
        objectives.append((image * weights).sum())
    difference = (objectives[0] - objectives[1]) / 0.04
    assert gradient.item() == pytest.approx(difference, rel=0.1)


def test_hidden_lamps_do_not_hide_the_medium(mono):
    """Camera rays pass hidden emitters; gradients were those of what is in front of them."""
    camera = np.array([1.0, 1.5, -5.0])
    place = mi.ScalarTransform4f().look_at(0.9 * camera, 0 * camera, [0, 1, 0]).scale(0.3)
    lamp = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 1e-4}}
    found = []
    for objects in (dict, lambda: {"front": lamp}):
        scene = Case(data=8, cache=8, objects=objects).load(hide_emitters=True)
        found.append(gradients(scene, ("sigma_t",), pixel_weights(scene))["sigma_t"])
    smooth = np.array(Case(data=8).sigma_t(), dtype=np.float64)
    alone, hidden = ((each * smooth).sum() for each in found)
    assert hidden == pytest.approx(alone, rel=0.05)


@pytest.mark.parametrize(
    "opacity",
    [None, pytest.param(0.4, marks=pytest.mark.slow)],
    ids=["thindielectric", "mask"],
)
def test_emitters_stay_hidden_behind_panes(mono, opacity):
    """Images depend linearly on the sky's radiance, and do not show a hidden sky behind a pane, but
    gradients counted it: they were 8 to 20 times too large.
    """
    camera = np.array([1.0, 1.5, -5.0])
    place = mi.ScalarTransform4f().look_at(0.5 * camera, camera, [0, 1, 0]).scale(2)
    bsdf = {"type": "thindielectric"}
    if opacity:
        bsdf = {"type": "mask", "opacity": opacity, "nested": {"type": "diffuse"}}
    pane = {"type": "rectangle", "to_world": place, "bsdf": bsdf}
    scene = Case(objects=lambda: {"pane": pane}).load(hide_emitters=True)
    weights = pixel_weights(scene)
    found = gradients(scene, ("sky",), weights)["sky"]
    image = np.array(mi.render(scene, spp=256, seed=3), dtype=np.float64)
    value = float(np.array(mi.traverse(scene)["sky.radiance.value"]).ravel()[0])
    assert found.sum() * value == pytest.approx((image * weights).sum(), rel=0.03)


def test_gradients_in_colour_are_those_of_the_image(rgb):
    """By the reflectance of the ground, and by the irradiance of the sun."""
    # Derivatives by what images depend on almost linearly have little noise.
    case = replace(SURROUNDED["ground, sky and sun, in colour"], **QUICK)
    scene = case.load()
    weights = pixel_weights(scene)
    names = ("floor", "sun")
    for parameter, gradient in gradients(scene, names, weights).items():
        result = compare(scene, case, parameter, weights, gradient)
        assert result.error < ERROR, parameter


def test_a_distant_object_changes_nothing(mono):
    """Paths from the voxels have the derivatives that ordinates have without surfaces."""
    names, found = ("sigma_t", "albedo"), []
    for objects in (dict, distant):
        scene = Case(objects=objects).load()
        found.append(gradients(scene, names, pixel_weights(scene)))
    smooth = np.array(Case().sigma_t(), dtype=np.float64)
    for name in names:
        isolated, traced = ((each[name] * smooth).sum() for each in found)
        assert traced == pytest.approx(isolated, rel=0.02)


# Interface


def attached(case: Case, name: str = "sigma_t") -> tuple[mi.Scene, mi.SceneParameters, str]:
    scene = case.load()
    params = mi.traverse(scene)
    key = first_key(params, name)
    params[key] = type(params[key])(dr.detach(params[key]))
    dr.enable_grad(params[key])
    params.update()
    return scene, params, key


def gradient_of(case: Case, seed: int, **options) -> np.ndarray:
    scene, params, key = attached(case)
    dr.backward(dr.mean(dr.square(mi.render(scene, params, spp=4, seed=seed, **options) - 0.3)))
    return np.array(dr.grad(params[key]))


SMALL = Case(data=6, cache=6, objects=ground)


def test_the_same_seed_gives_the_same_bits(mono, fewer_paths):
    first, again, other = (gradient_of(SMALL, seed) for seed in (1, 1, 2))
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


def test_views_share_the_adjoint_solve(mono, fewer_paths, monkeypatch):
    calls, solved = [], SurroundingsAdjoint._solved
    monkeypatch.setattr(
        SurroundingsAdjoint, "_solved", lambda *args: calls.append(args) or solved(*args)
    )
    scene, params, _ = attached(SMALL)
    images = [mi.render(scene, params, spp=4, seed=seed) for seed in (1, 2)]
    dr.backward(sum(dr.mean(image) for image in images))
    assert len(calls) == 1


def test_numbers_are_finite_with_black_matter_and_white_walls(mono, fewer_paths):
    for albedo, reflectance in ((0.0, 1.0), (0.9, 1.0)):
        case = Case(data=6, cache=6, albedo=(albedo,), objects=lambda r=reflectance: ground(r))
        scene = case.load()
        found = gradients(scene, ("sigma_t", "albedo", "floor"), pixel_weights(scene), spp=4)
        assert all(np.isfinite(values).all() for values in found.values())
        assert all(np.abs(values).max() > 0 for values in found.values())


# What is refused


def refused(case: Case, suffix: str, **properties) -> str:
    scene = case.load(**properties)
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if re.search(f"{suffix}$", k)]
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(IrrcacheError) as error:
        dr.backward(dr.mean(mi.render(scene, params, spp=1)))
    assert f'"{key}"' in str(error.value) and "prbvolpath" in str(error.value)
    return str(error.value)


INSIDE = {"ball": {"type": "sphere", "radius": 0.3}}


@pytest.mark.parametrize(
    ("case", "suffix", "properties", "reason"),
    [
        (SMALL, "sigma_t.data", {"max_depth": 3, "solver": "auto"}, "max_depth is 3"),
        (SMALL, "sigma_t.data", {"solver": "path", "cache_spp": 8}, 'the solver is "path"'),
        (SMALL, "floor.to_world", {}, "it belongs to a"),
        (Case(data=6, cache=6, objects=lambda: INSIDE), "sigma_t.data", {}, "surface reaches into"),
        (
            Case(data=6, cache=6, objects=lambda: ground(0.0)),
            "floor.bsdf.reflectance.value",
            {},
            "it is 0 somewhere",
        ),
    ],
)
def test_what_has_no_gradients_is_refused_by_name(mono, case, suffix, properties, reason):
    assert reason in refused(case, suffix, **properties)


def dark(name: str) -> tuple[dict, dict, str]:
    """An emitter without radiance: emitters, shapes, and the key of the radiance."""
    if name == "lamp":
        shape = lamp()["lamp"] | {"emitter": {"type": "area", "radiance": 0.0}}
        return {"sky": SKY}, {"lamp": shape}, "lamp.emitter.radiance.value"
    emitters = {
        "point": ({"sky": SKY, "point": POINT | {"intensity": 0.0}}, "point.intensity.value"),
        "sun": ({"sky": SKY, "sun": SUN | {"irradiance": 0.0}}, "sun.irradiance.value"),
        "sky": ({"sun": SUN, "sky": SKY | {"radiance": 0.0}}, "sky.radiance.value"),
    }
    own, key = emitters[name]
    return own, ground(), key


# A point is sampled like the sun.
@pytest.mark.parametrize("name", with_slow(["lamp", "point", "sun", "sky"], "point"))
def test_emitters_without_radiance_have_gradients(mono, fewer_paths, name):
    """Samples of emitters without radiance were discarded, so that these gradients were 0."""
    emitters, shapes, key = dark(name)
    case = Case(data=6, cache=6, emitters=lambda: emitters, objects=lambda: shapes, directions=256)
    scene = case.load(hide_emitters=True)
    weights = pixel_weights(scene)
    gradient = gradients(scene, (name,), weights)[name]
    image = np.array(mi.render(scene, spp=64, seed=3), dtype=np.float64)
    params = mi.traverse(scene)
    params[key] = type(params[key])(5.0)
    params.update()
    changed = np.array(mi.render(scene, spp=64, seed=3), dtype=np.float64)
    difference = ((changed - image) * weights).sum()
    assert 5 * gradient.sum() == pytest.approx(difference, rel=0.04)


@pytest.mark.parametrize("kind", ["mask", "conductor"])
def test_textures_of_specular_surfaces_are_refused(rgb, kind):
    texture = {
        "type": "bitmap",
        "id": "shared",
        "bitmap": mi.Bitmap(np.full((4, 4, 3), 0.5, np.float32)),
        "raw": True,
    }
    shared = {"type": "ref", "id": "shared"}
    other = {"type": "conductor", "specular_reflectance": shared}
    if kind == "mask":
        other = {"type": "mask", "opacity": shared, "nested": {"type": "diffuse"}}
    place = mi.ScalarTransform4f().translate([0, 0, 4]).scale(0.5)
    shapes = ground(shared) | {"wall": {"type": "rectangle", "to_world": place, "bsdf": other}}
    case = replace(SMALL, objects=lambda: {"shared": texture} | shapes)
    kinds = {"mask": "MaskBSDF", "conductor": "SmoothConductor"}
    assert f"a {kinds[kind]} depends on it" in refused(case, r"object_\d+\.data")


def test_many_lamps_around_anisotropic_media_are_refused(mono, monkeypatch):
    monkeypatch.setattr(traced, "MAX_LAMPS", 0)
    case = replace(SMALL, emitters=dict, objects=lamp, g=0.3)
    assert "1 area emitters" in refused(case, "sigma_t.data")


def test_emission_of_several_media_is_refused(mono):
    """The integrator's volume of emission belongs to all media."""
    case = Case(data=6, cache=6, emissive=True, objects=lambda: second_medium(0.5))
    assert "several media depend on it" in refused(case, "emission.data")


def test_emission_of_zero_is_refused(mono):
    scene = Case(data=6, cache=6, emissive=True, objects=ground).load()
    params = mi.traverse(scene)
    key = first_key(params, "emission")
    params[key] = mi.TensorXf(np.zeros_like(np.array(params[key])))
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(IrrcacheError, match="the emission is 0 everywhere"):
        dr.backward(dr.mean(mi.render(scene, params, spp=1)))


def test_a_mean_cosine_of_zero_is_refused(mono):
    case = Case(data=6, cache=6, g=0.0, objects=ground)
    assert "it is 0, where scattering is isotropic" in refused(case, "phase_function.g")


def test_media_that_lie_within_each_other_are_refused(mono):
    inner = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "null"}, "interior": inner}
    scene = Case(data=6, cache=6, objects=lambda: {"inner": ball}).load(solver="auto")
    params = mi.traverse(scene)
    key = first_key(params, "sigma_t")
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises((IrrcacheError, RuntimeError), match="irrcache"):
        dr.backward(dr.mean(mi.render(scene, params, spp=1)))
