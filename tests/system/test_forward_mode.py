"""Forward mode: against reverse mode, and in the interface of Dr.Jit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.gradients.cases import (
    CASES,
    SKY,
    SUN,
    SURROUNDED,
    Case,
    ground,
    lamp,
    room,
    second_medium,
)
from experiments.validation.gradients.differences import (
    compare,
    derivatives,
    directions,
    first_key,
    gradients,
    pixel_weights,
)
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients import surroundings_adjoint, surroundings_tangent
from tests.support.slow import with_slow

#: Largest relative difference between the derivatives of both modes: both discretise the same
#: operators, whose transposes agree within a few thousandths.
DIFFERENCE = 0.01
PERTURBATIONS = 3


def check(case: Case, difference: float = DIFFERENCE, perturbations: int = PERTURBATIONS) -> None:
    """The derivative along perturbations of each parameter is that by reverse mode (dot test)."""
    scene = case.load()
    weights = pixel_weights(scene)
    reverse = gradients(scene, case.parameters, weights)
    for name, gradient in reverse.items():
        params = mi.traverse(scene)
        value = np.array(params[first_key(params, name)], dtype=np.float64)
        steps = directions(case, name, value, perturbations)
        forward = derivatives(scene, name, weights, steps)
        expected = [(gradient.reshape(value.shape) * step).sum() for step in steps]
        assert np.linalg.norm(forward - expected) < difference * np.linalg.norm(expected), name


@pytest.mark.parametrize("name", ["sky, single", "sky", "point", "empty voxels", "gaussian filter"])
def test_both_modes_agree(mono, name):
    # The albedo of empty voxels matters only through the extinction interpolated into them.
    check(CASES[name], 0.02 if name == "empty voxels" else DIFFERENCE)


@pytest.mark.parametrize(
    ("name", "difference"),
    [
        ("dense up to the boundary, sun, single", 1e-4),
        ("dense up to the boundary, sun", DIFFERENCE),
    ],
)
def test_both_modes_agree_on_light_that_camera_rays_evaluate(mono, name, difference):
    """Both use the same lines to the sun."""
    check(CASES[name], difference)


@pytest.mark.parametrize(
    "name",
    [
        "coloured extinction",
        "intensity of a point in coloured extinction",
        "alpha",
        "emission",
        "radiance of sky and sun, single",
        "texels of an envmap",
    ],
)
def test_both_modes_agree_in_colour(rgb, name):
    check(CASES[name])


@pytest.mark.parametrize("name", with_slow(["hg 0.3, sun", "hg 0.65, sun"], "hg 0.3, sun"))
def test_both_modes_agree_with_anisotropic_scattering(mono, name):
    check(CASES[name], 0.02)


# Among surfaces: paths of both modes have random numbers of their own.


def white_room() -> dict:
    """The walls of `room`, which reflect most of what leaves the medium back into it."""
    walls = room()
    for number, wall in enumerate(walls.values()):
        wall["bsdf"]["reflectance"] = 0.9 + 0.01 * number
    return walls


COARSE = {"data": 6, "cache": 6, "depth": 0.15}
SMALL = {
    "ground, lamp": Case(
        **COARSE,
        emitters=dict,
        objects=lambda: ground() | lamp(),
        parameters=("sigma_t", "floor", "lamp"),
    ),
    "white room": Case(**COARSE | {"depth": 0.4}, objects=white_room, parameters=("albedo",)),
    "hg 0.6, lamp": Case(**COARSE, g=0.6, emitters=dict, objects=lamp, parameters=("lamp",)),
    "two media, hg 0.5, sun, single": Case(
        **COARSE,
        g=0.5,
        max_depth=2,
        emitters=lambda: {"sun": SUN},
        objects=lambda: second_medium(0.5, g=-0.4),
        parameters=("g", "other.interior_medium.sigma_t"),
    ),
    "hg 0.7, emission, ground, sky, alpha": Case(
        **COARSE,
        g=0.7,
        emissive=True,
        emitters=lambda: {"sky": SKY},
        objects=ground,
        pixels="rgba",
        parameters=("albedo", "emission"),  # by `sigma_t`, terms 40 times as large nearly cancel
    ),
}


@pytest.fixture
def fewer_paths(monkeypatch):
    for module, count in ((surroundings_adjoint, 1 << 16), (surroundings_tangent, 1 << 15)):
        monkeypatch.setattr(module, "RAYS", count)
        monkeypatch.setattr(module, "EXCHANGED", count // 4)


@pytest.mark.parametrize("name", with_slow(list(SMALL), "hg 0.7, emission, ground, sky, alpha"))
def test_both_modes_agree_among_surfaces_of_small_scenes(mono, fewer_paths, name):
    check(SMALL[name], 0.03, perturbations=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "ground, sky",
        "lamp over a ground, single",
        "two media, sky",
        "hg 0.5, lamp over a ground",
        "hg 0.54, ground, sky",
        "hg 0.85, ground, sun",
        "emission, hg 0.5, sun, single",
        "room, sky",
    ],
)
def test_both_modes_agree_among_surfaces(mono, name):
    check(SURROUNDED[name], 0.03)


def textured() -> mi.Scene:
    """A medium over a ground, under a lamp, both with textures."""
    rng = np.random.default_rng(1)

    def texture(low: float, high: float) -> dict:
        pixels = mi.Bitmap(np.float32(rng.uniform(low, high, (4, 4, 3))))
        return {"type": "bitmap", "bitmap": pixels, "raw": True}

    objects = ground() | lamp()
    objects["floor"]["bsdf"] = {"type": "diffuse", "reflectance": texture(0.3, 0.9)}
    objects["lamp"]["emitter"] = {"type": "area", "radiance": texture(1, 3)}
    return Case(data=6, cache=6, emitters=dict, objects=lambda: objects).load()


# Textures of lamps are evaluated like those of surfaces, and upstream variables are in
# `test_derivatives_of_upstream_variables_reach_the_image`.
@pytest.mark.parametrize(
    ("part", "is_leaf"),
    [
        ("floor", True),
        pytest.param("floor", False, marks=pytest.mark.slow),
        pytest.param("lamp", True, marks=pytest.mark.slow),
        pytest.param("lamp", False, marks=pytest.mark.slow),
    ],
)
def test_textures_of_surfaces_and_lamps_change_once(rgb, fewer_paths, part, is_leaf):
    """Each evaluation of a texture added the change of the texture once more, 40 times in all."""
    scene = textured()
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.startswith(part) and k.endswith(".data")]
    data, found = mi.TensorXf(dr.detach(params[key])), []
    weights = np.random.default_rng(3).uniform(0.5, 1.5, (32, 32, 3)).astype(np.float32)
    for forward in (True, False, True):
        factor = mi.Float(1.0)
        dr.enable_grad(factor)
        leaf = mi.TensorXf(data)
        if is_leaf:
            dr.enable_grad(leaf)
        params[key] = leaf if is_leaf else data * factor
        params.update()
        image = mi.render(scene, params, spp=16, seed=1)
        if forward and is_leaf:
            dr.set_grad(leaf, data)
            change = dr.forward_to(image)
        elif forward:
            dr.forward(factor)
            change = dr.grad(image)
        if forward:
            found.append((np.array(change, dtype=np.float64) * weights).sum())
            continue
        dr.backward(dr.sum(image * mi.TensorXf(weights)))
        gradient = np.array(dr.grad(leaf if is_leaf else factor), dtype=np.float64)
        found.append((gradient * np.array(data)).sum() if is_leaf else gradient.sum())
    assert found[0] == pytest.approx(found[2], rel=1e-5)
    assert found[0] == pytest.approx(found[1], rel=0.02)


# The radiance of the lamp is a colour as that of the floor.
@pytest.mark.parametrize("name", with_slow(["sigma_t", "floor", "lamp"], "lamp"))
def test_other_uses_of_a_parameter_do_not_matter(rgb, fewer_paths, name):
    """Dr.Jit raised an internal error where something else depended on the colour of a surface. A
    later ``dr.backward`` lacked the derivatives through the irradiance if forward mode had reached
    one of two images (-7 %). No update of the parameters separates the images here.
    """
    case = Case(**COARSE, emitters=dict, objects=lambda: ground() | lamp())
    scene = (Case(**COARSE) if name == "sigma_t" else case).load()
    params = mi.traverse(scene)
    key, found = first_key(params, name), []
    variable = type(params[key])(dr.detach(params[key]))
    dr.enable_grad(variable)
    params[key] = variable
    params.update()
    for forward in (True, False, True):
        dr.set_grad(variable, 0)
        _product = variable * 3
        image = mi.render(scene, params, spp=16, seed=1)
        _other = mi.render(scene, params, spp=16, seed=2)
        if forward:
            dr.set_grad(variable, 1)
            found.append(np.array(dr.forward_to(image), dtype=np.float64).sum())
            continue
        dr.backward(dr.sum(image))
        found.append(np.array(dr.grad(variable), dtype=np.float64).sum())
    assert found[0] == pytest.approx(found[2], rel=1e-5)
    assert found[0] == pytest.approx(found[1], rel=0.02)


def test_views_among_surfaces_share_the_solve(rgb, fewer_paths, monkeypatch):
    tangent, calls = surroundings_tangent.SurroundingsTangent, []
    solve = tangent._transported
    monkeypatch.setattr(tangent, "_transported", lambda *args: calls.append(args) or solve(*args))
    scene = Case(data=6, cache=6, objects=ground).load()
    params, factor, _ = attached(scene)
    images = [mi.render(scene, params, spp=4, seed=seed) for seed in (1, 2)]
    dr.forward(factor)
    assert len(calls) == 1
    assert all(np.array(dr.grad(image)).any() for image in images)


def test_forward_mode_is_the_difference_of_images(mono):
    case = CASES["sky"]
    scene = case.load()
    weights, params = pixel_weights(scene), mi.traverse(scene)
    value = np.array(params[first_key(params, "sigma_t")], dtype=np.float64)
    (step,) = directions(case, "sigma_t", value, 1)
    (found,) = derivatives(scene, "sigma_t", weights, [step])
    result = compare(scene, case, "sigma_t", weights, np.zeros(value.shape), 1)
    assert found == pytest.approx(result.differences[0], rel=0.02)


# Interface


def attached(scene: mi.Scene) -> tuple[mi.SceneParameters, mi.Float, mi.TensorXf]:
    """Parameters whose extinction is multiplied by a factor that carries gradients."""
    params = mi.traverse(scene)
    key = first_key(params, "sigma_t")
    data, factor = mi.TensorXf(dr.detach(params[key])), mi.Float(1)
    dr.enable_grad(factor)
    params[key] = data * factor
    params.update()
    return params, factor, data


def test_derivatives_of_upstream_variables_reach_the_image(rgb):
    """By ``dr.forward_from``, and by ``render_forward`` itself: a derivative per pixel."""
    scene = Case(data=8, cache=8).load()
    params, factor, data = attached(scene)
    image = mi.render(scene, params, spp=64, seed=1)
    dr.forward(factor)
    found = np.array(dr.grad(image))
    assert found.shape == image.shape
    images = []
    for scale in (0.97, 1.03):
        params[first_key(params, "sigma_t")] = data * scale
        params.update()
        images.append(np.array(mi.render(scene, spp=64, seed=1)))
    expected = (images[1] - images[0]) / 0.06
    assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected)


def test_several_views_share_the_solve(rgb, monkeypatch):
    from mitsuba_irrcache.gradients.tangent_transport import FluenceTangent

    calls, solve = [], FluenceTangent.for_camera
    monkeypatch.setattr(
        FluenceTangent, "for_camera", lambda *args: calls.append(args) or solve(*args)
    )
    scene = Case(data=8, cache=8).load()
    params, factor, _ = attached(scene)
    images = [mi.render(scene, params, spp=4, seed=seed) for seed in (1, 2)]
    dr.forward(factor)
    assert len(calls) == 1
    assert all(np.array(dr.grad(image)).any() for image in images)


def test_forward_and_reverse_mode_do_not_disturb_each_other(rgb):
    scene = Case(data=8, cache=8).load()
    params, factor, _ = attached(scene)
    key, found = first_key(params, "sigma_t"), []
    for mode in (dr.backward, dr.forward_to, dr.backward):
        dr.clear_grad(factor)
        params[key] = dr.detach(params[key]) * factor
        params.update()
        loss = dr.mean(mi.render(scene, params, spp=16, seed=1))
        if mode is dr.forward_to:
            dr.set_grad(factor, 1.0)
            found.append(float(np.array(dr.forward_to(loss)).item()))
        else:
            mode(loss)
            found.append(float(dr.grad(factor)[0]))
    assert found[0] == found[2]
    assert found[1] == pytest.approx(found[0], rel=0.01)


def test_without_gradients_the_derivative_is_zero(rgb):
    scene = Case(data=8, cache=8).load()
    found = scene.integrator().render_forward(scene, mi.traverse(scene), spp=1)
    assert found.shape == (32, 32, 3)
    assert not np.array(found).any()


def test_what_reverse_mode_refuses_forward_mode_refuses(rgb):
    scene = Case(data=8, cache=8).load()
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith("x_fov")]
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(IrrcacheError, match="x_fov"):
        dr.forward_to(mi.render(scene, params, spp=1))


def test_lights_without_radiance_are_refused_by_name(rgb):
    light = {"type": "point", "position": [0.0, 3.0, 0.0], "intensity": 0.0}
    scene = Case(data=8, cache=8, emitters=lambda: {"lamp": light}).load()
    params = mi.traverse(scene)
    dr.enable_grad(params["lamp.intensity.value"])
    params.update()
    with pytest.raises(IrrcacheError, match=r"lamp\.intensity\.value.*positive"):
        dr.forward_to(mi.render(scene, params, spp=1))


def test_what_has_no_change_by_channel_is_refused(rgb):
    """Textures of emitters, and colours that change from 0 in coloured extinction."""
    red = {"type": "rgb", "value": [1.0, 0.0, 0.0]}
    point = {"type": "point", "position": [0.0, 3.0, 0.0], "intensity": red}
    look = mi.ScalarTransform4f().look_at([0, 3, 0], [0, 0, 0], [1, 0, 0])
    pixels = mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32))
    texture = {"type": "bitmap", "bitmap": pixels, "raw": True}
    projector = {"type": "projector", "to_world": look, "irradiance": texture}
    for emitter, key, message in (
        (point, "lamp.intensity.value", "in coloured extinction needs positive values"),
        (projector, "lamp.irradiance.data", "from a texture"),
    ):
        coloured = (0.5, 0.8, 1.0)
        case = Case(data=8, cache=8, extinction=coloured, emitters=lambda e=emitter: {"lamp": e})
        scene = case.load()
        params = mi.traverse(scene)
        change = mi.Float(0.0)
        dr.enable_grad(change)
        params[key] = params[key] + type(params[key])(change)
        params.update()
        _image = mi.render(scene, params, spp=1)
        with pytest.raises(IrrcacheError, match=message):
            dr.forward_from(change)
