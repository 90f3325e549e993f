"""Gradients of images: against finite differences of the image, within an optimisation, and what
is refused.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.gradients.cases import (
    CASES,
    LAMP,
    POINT,
    SKY,
    SUN,
    Case,
    sky_with_sun,
    spot,
)
from experiments.validation.gradients.differences import (
    compare,
    first_key,
    gradients,
    pixel_weights,
)
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients import backward
from mitsuba_irrcache.lights.emitters import EmitterKind
from mitsuba_irrcache.solvers.discrete_ordinates import multigrid
from tests.support.slow import with_slow

#: Largest relative error of directional derivatives along smooth perturbations, and the least
#: cosine; the first also where voxels are empty.
ERROR, COSINE, EMPTY_ERROR = 0.03, 0.999, 0.05
GREY = ("sky, single", "sky", "sun, single", "sun", "point", "spot, single", "voxel depth 0.8")
#: Perturbations of each parameter.
BLOBS = 2
COLOURED = (
    "coloured extinction",
    "envmap with a bright spot",
    "homogeneous, coloured",
    "data of no common multiple",
    "sphere",
    "emission",
)


def check(case: Case, error: float = ERROR) -> None:
    scene = case.load()
    weights = pixel_weights(scene)
    found = gradients(scene, case.parameters, weights)
    for name, gradient in found.items():
        result = compare(scene, case, name, weights, gradient, BLOBS)
        assert result.error < error, name
        assert result.cosine > COSINE, name


@pytest.mark.parametrize("name", GREY)
def test_gradients_are_those_of_the_image(mono, name):
    # Lines to a sun or point are exact: tracks in their place would have an error of 1 %.
    check(CASES[name], 0.005 if name == "sun, single" else ERROR)


# The homogeneous medium has coloured extinction, too.
@pytest.mark.parametrize("name", with_slow(COLOURED, "coloured extinction"))
def test_gradients_in_colour_are_those_of_the_image(rgb, name):
    check(CASES[name])


@pytest.mark.parametrize("name", ["empty voxels", "no matter", "no matter, sun"])
def test_empty_voxels_have_gradients(mono, monkeypatch, name):
    # Differences due to the albedo next to empty voxels are smaller than the solver's error.
    monkeypatch.setattr(multigrid, "COARSEST_TOLERANCE", 1e-6)
    check(CASES[name], EMPTY_ERROR)


# `test_gradients_among_surfaces.py::test_gradients_are_those_of_the_image` has emission with single
# scattering, too, and `test_gradients_in_colour_are_those_of_the_image` isotropic scattering.
@pytest.mark.slow
def test_emission_has_gradients_with_single_scattering(rgb):
    check(CASES["emission, single"])


# The map is also among the gradients in colour, the sharper phase function in empty voxels. Where
# a sun is behind a forward peak, several scattering events counted as single ones (10 to 50 %).
@pytest.mark.parametrize(
    "name",
    with_slow(
        [
            "hg 0.3, sun, single",
            "hg 0.6, envmap",
            "hg 0.3, point",
            "hg 0.8, sun behind",
            "hg 0.8, sun behind, by g",
        ],
        "hg 0.6, envmap",
    ),
)
def test_gradients_of_anisotropic_media_are_those_of_the_image(mono, name):
    check(CASES[name])


def test_empty_voxels_of_anisotropic_media_have_gradients(mono):
    check(CASES["hg 0.85, empty voxels"], EMPTY_ERROR)


EMITTERS = {
    "sky": (lambda: {"sky": SKY, "sun": SUN}, "sky.radiance.value"),
    "sun": (lambda: {"sky": SKY, "sun": SUN}, "sun.irradiance.value"),
    "point": (lambda: {"point": POINT}, "point.intensity.value"),
    "texels": (lambda: {"sky": sky_with_sun()}, "sky.data"),
}


@pytest.mark.parametrize("name", EMITTERS)
@pytest.mark.parametrize("max_depth", [2, -1])
def test_images_are_linear_in_the_radiance_of_emitters(rgb, name, max_depth):
    emitters, key = EMITTERS[name]
    scene = Case(emitters=emitters, max_depth=max_depth).load()
    weights, params = pixel_weights(scene), mi.traverse(scene)
    value, kind = np.array(params[key]), type(params[key])
    found = key.rpartition(".")[0]
    gradient = gradients(scene, (found,), weights)[found]

    def objective(changed: np.ndarray) -> float:
        params[key] = kind(changed.astype(np.float32))
        params.update()
        return float((np.array(mi.render(scene, spp=64), dtype=np.float64) * weights).sum())

    step = 0.2 * value
    expected = (objective(value + step) - objective(value - step)) / 2
    assert (gradient * step).sum() == pytest.approx(expected, rel=0.02)


def dark_sky_with_sun() -> dict:
    """An environment map that is black except for a bright spot."""
    values = np.zeros((16, 32, 3), dtype=np.float32)
    values[4, 7] = 60.0
    return {"type": "envmap", "bitmap": mi.Bitmap(values)}


BLACK = {
    "sky": (lambda: {"sun": SUN, "sky": SKY | {"radiance": 0.0}}, "sky.radiance.value"),
    "sun": (lambda: {"sky": SKY, "sun": SUN | {"irradiance": 0.0}}, "sun.irradiance.value"),
    "point": (lambda: {"sky": SKY, "point": POINT | {"intensity": 0.0}}, "point.intensity.value"),
    "one channel of a point": (
        lambda: {"point": POINT | {"intensity": {"type": "rgb", "value": [9.0, 0.0, 0.0]}}},
        "point.intensity.value",
    ),
    "spot": (lambda: {"sky": SKY, "spot": spot() | {"intensity": 0.0}}, "spot.intensity.value"),
    "texels": (lambda: {"sky": dark_sky_with_sun()}, "sky.data"),
}


@pytest.mark.parametrize("name", BLACK)
def test_emitters_without_radiance_have_gradients(rgb, name):
    """Their radiance may grow: it was divided by itself, so that these gradients were 0."""
    emitters, key = BLACK[name]
    case = Case(data=8, cache=8, emitters=emitters)
    assert_linear(case.load(hide_emitters=True), key, added=10.0)


def test_dim_texels_beside_a_bright_spot_have_gradients(mono):
    """The irradiance of all directions but the bright ones is normalised, by up to 2.9 here."""
    values = np.full((16, 32, 3), 1e-3, dtype=np.float32)
    values[3:6, 6:9] = 8.0
    sky = {"type": "envmap", "bitmap": mi.Bitmap(values)}
    for seed in range(3):
        scene = Case(data=8, cache=8, emitters=lambda: {"sky": sky}).load(
            hide_emitters=True, cache_seed=seed
        )
        assert_linear(scene, "sky.data", added=1.0, tolerance=0.08, lowest=5)


def assert_linear(
    scene: mi.Scene, key: str, added: float, tolerance: float = 0.03, lowest: int = 0
) -> None:
    """Assert that the gradient by a radiance is the change of the image with ``added`` radiance, of
    the ``lowest`` rows of a map only, if any.
    """
    weights, name = pixel_weights(scene), key.rpartition(".")[0]
    gradient = gradients(scene, (name,), weights)[name]
    before = (np.array(mi.render(scene, spp=64, seed=3), dtype=np.float64) * weights).sum()
    params = mi.traverse(scene)
    value = np.array(params[key], dtype=np.float64)
    step = np.full(value.shape, added)
    if lowest:
        step[:-lowest] = 0
    params[key] = type(params[key])((value + step).astype(np.float32))
    params.update()
    after = (np.array(mi.render(scene, spp=64, seed=3), dtype=np.float64) * weights).sum()
    assert (gradient * step).sum() == pytest.approx(after - before, rel=tolerance)


@pytest.mark.parametrize("max_depth", [2, -1])
@pytest.mark.parametrize("kind", ["sun", "point"])
def test_positions_and_directions_of_lights_have_gradients(rgb, kind, max_depth):
    """A sun that turns, and a point that moves, by an upstream variable each."""
    emitters = {"sun": lambda: {"sun": SUN}, "point": lambda: {"point": POINT}}[kind]
    scene = Case(emitters=emitters, max_depth=max_depth).load()
    weights, params = pixel_weights(scene), mi.traverse(scene)
    start = np.array([1.0, 0.3, 0.2]) if kind == "sun" else np.array(POINT["position"])

    def place(amount: mi.Float) -> None:
        if kind == "sun":
            turned = mi.Transform4f().rotate([0.48, 0.64, 0.6], 40 * amount)
            look = mi.Transform4f().look_at([0, 0, 0], [0.4, -1.0, 0.55], [0, 0, 1])
            params["sun.to_world"] = turned @ look
        else:
            way = mi.Point3f(1.0, -0.5, 0.7) * amount
            params["point.position"] = mi.Point3f(*(float(x) for x in start)) + way
        params.update()

    amount = mi.Float(0)
    dr.enable_grad(amount)
    place(amount)
    image = mi.render(scene, params, spp=64, seed=3)
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32))))

    def objective(value: float) -> float:
        place(mi.Float(value))
        return float((np.array(mi.render(scene, spp=64, seed=7), dtype=np.float64) * weights).sum())

    # Tracks of a sun that turns start elsewhere, so that small differences are noise.
    step = 0.2 if kind == "sun" else 0.05
    expected = (objective(step) - objective(-step)) / (2 * step)
    assert dr.grad(amount)[0] == pytest.approx(expected, rel=0.03)


# Interface


def small(g=None, **properties) -> tuple[mi.Scene, mi.SceneParameters, str]:
    scene = Case(data=8, cache=8, g=g).load(**properties)
    params = mi.traverse(scene)
    return scene, params, first_key(params, "sigma_t")


def gradient_of(scene, params, key, **options) -> np.ndarray:
    params[key] = mi.TensorXf(dr.detach(params[key]))
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(dr.square(mi.render(scene, params, **{"spp": 4} | options) - 0.3)))
    return np.array(dr.grad(params[key]))


@pytest.mark.parametrize("g", [None, 0.6])
def test_the_same_seed_gives_the_same_bits(rgb, g):
    scene, params, key = small(g)
    first, again, other = (gradient_of(scene, params, key, seed=s) for s in (1, 1, 2))
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


def test_upstream_variables_receive_gradients(rgb):
    """A common factor of the extinction, as Mitsuba's ``scale``, which is no array."""
    scene, params, key = small()
    data = mi.TensorXf(dr.detach(params[key]))
    by_data = gradient_of(scene, params, key, seed=1)
    scale = mi.Float(1)
    dr.enable_grad(scale)
    params[key] = data * scale
    params.update()
    dr.backward(dr.mean(dr.square(mi.render(scene, params, spp=4, seed=1) - 0.3)))
    expected = (by_data * np.array(data)).sum()
    assert dr.grad(scale)[0] == pytest.approx(expected, rel=1e-4)


def test_scale_of_the_medium_multiplies_gradients(rgb):
    """Three times the extinction by ``scale`` or by the data."""
    scene, params, key = small()
    params[key] = params[key] * 3
    params.update()
    by_data = gradient_of(scene, params, key, seed=1)
    params[key] = dr.detach(params[key]) / 3
    params[key.replace("sigma_t.data", "scale")] = 3.0
    params.update()
    by_scale = gradient_of(scene, params, key, seed=1)
    np.testing.assert_allclose(by_scale, 3 * by_data, rtol=1e-2, atol=1e-3 * by_scale.max())


def test_views_add_up(rgb):
    """Two sensors, one after the other, in one loss."""
    scene, params, key = small()
    near = mi.ScalarTransform4f().look_at([3.0, -1.0, 2.0], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    other = mi.load_dict({"type": "perspective", "fov": 40.0, "to_world": near, "film": film})
    one, two = (gradient_of(scene, params, key, seed=1, sensor=s) for s in (0, other))
    params[key] = mi.TensorXf(dr.detach(params[key]))
    dr.enable_grad(params[key])
    params.update()
    images = [mi.render(scene, params, spp=4, seed=1, sensor=s) for s in (0, other)]
    dr.backward(sum(dr.mean(dr.square(image - 0.3)) for image in images))
    both = np.array(dr.grad(params[key]))
    np.testing.assert_allclose(both, one + two, rtol=1e-4, atol=1e-6 * np.abs(both).max())


@pytest.fixture
def adjoint_solves(monkeypatch) -> list:
    """A list that grows with every adjoint solve."""
    from mitsuba_irrcache.gradients.transport import AdjointTransport

    calls, adjoint = [], AdjointTransport.adjoint
    monkeypatch.setattr(
        AdjointTransport, "adjoint", lambda *args: calls.append(args) or adjoint(*args)
    )
    return calls


def loss_of(image: mi.TensorXf):
    return dr.mean(dr.square(image - 0.3))


def attached(params: mi.SceneParameters, key: str) -> None:
    params[key] = mi.TensorXf(dr.detach(params[key]))
    dr.enable_grad(params[key])
    params.update()


def test_images_of_one_state_share_the_adjoint_solve(rgb, adjoint_solves):
    scene, params, key = small()
    attached(params, key)
    images = [mi.render(scene, params, spp=4, seed=seed) for seed in (1, 2)]
    dr.backward(sum(map(loss_of, images)))
    assert len(adjoint_solves) == 1
    # The next image is of another state, also if no value has changed.
    attached(params, key)
    dr.backward(loss_of(mi.render(scene, params, spp=4)))
    assert len(adjoint_solves) == 2


def test_images_of_one_state_may_be_differentiated_one_after_the_other(rgb, adjoint_solves):
    """The first traversal of Dr.Jit's graph forgets the edges that they share."""
    scene, params, key = small()
    one, two = (gradient_of(scene, params, key, seed=seed) for seed in (1, 2))
    attached(params, key)
    images = [mi.render(scene, params, spp=4, seed=seed) for seed in (1, 2)]
    for image, expected in zip(images, (one, one + two), strict=True):
        dr.backward(loss_of(image))
        found = np.array(dr.grad(params[key]))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(found).max())
    # And so may a third, made only then.
    dr.backward(loss_of(mi.render(scene, params, spp=4, seed=1)))
    found = np.array(dr.grad(params[key]))
    np.testing.assert_allclose(found, 2 * one + two, rtol=1e-4, atol=1e-6 * np.abs(found).max())
    assert len(adjoint_solves) == 2 + 3


def test_an_image_without_weight_does_not_hide_others(rgb):
    scene, params, key = small()
    expected = gradient_of(scene, params, key, seed=1)
    attached(params, key)
    images = [mi.render(scene, params, spp=4, seed=seed) for seed in (2, 1)]
    dr.backward(dr.sum(images[0] * mi.TensorXf(np.zeros(images[0].shape, np.float32))))
    dr.backward(loss_of(images[1]))
    assert np.array(dr.grad(params[key])).tobytes() == expected.tobytes()


def edited_data(scene: mi.Scene, params: mi.SceneParameters, key: str) -> None:
    params[key] = mi.TensorXf(0.5 * dr.detach(params[key]))
    dr.enable_grad(params[key])


def moved_camera(scene: mi.Scene, params: mi.SceneParameters, key: str) -> None:
    turned = mi.Transform4f().rotate([0, 1, 0], 30)
    params["sensor.to_world"] = turned @ params["sensor.to_world"]


def smaller_film(scene: mi.Scene, params: mi.SceneParameters, key: str) -> None:
    params["sensor.film.size"] = [8, 8]


def brighter_light(scene: mi.Scene, params: mi.SceneParameters, key: str) -> None:
    name = next(k for k in params.keys() if k.endswith(("radiance.value", "irradiance.value")))
    params[name] = 2 * params[name]


@pytest.mark.parametrize("forward", [False, True])
@pytest.mark.parametrize("edit", [edited_data, moved_camera, smaller_film, brighter_light])
def test_a_scene_edited_before_its_image_is_differentiated_is_refused(rgb, edit, forward):
    """The derivatives would be those of another image, as they are with Mitsuba's integrators."""
    scene, params, key = small()
    attached(params, key)
    variable = params[key]
    image = mi.render(scene, params, spp=4, seed=1)
    edit(scene, params, key)
    params.update()
    with pytest.raises(IrrcacheError, match="has changed since the image was rendered"):
        if forward:
            dr.set_grad(variable, 1)
            dr.forward_to(image)
        else:
            dr.backward(loss_of(image))


def test_other_images_and_edits_that_are_undone_do_not_matter(rgb):
    """Images of other scenes by the same integrator, and with other values, may lie between an
    image and its gradients.
    """
    scene, params, key = small()
    expected = gradient_of(scene, params, key, seed=1)
    attached(params, key)
    image, variable = mi.render(scene, params, spp=4, seed=1), mi.TensorXf(params[key])
    other = small()[0]
    mi.render(other, integrator=scene.integrator(), spp=1)
    params[key] = mi.TensorXf(0.5 * dr.detach(variable))
    params.update()
    mi.render(scene, spp=1)
    params[key] = variable
    params.update()
    dr.backward(loss_of(image))
    found = np.array(dr.grad(variable))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_derivatives_where_a_sun_enters_a_dense_face_at_grazing_incidence(rgb, scenes):
    """The irradiance varies by a factor of 1.6 within the outermost voxels: if it is summed in
    their middles, the derivative by the extinction is 1.1 % of the radiance too small.
    """
    shape = scenes.boundary(scenes.medium(1.5, 0.9))
    sun = {"type": "directional", "direction": [0.4, -1.0, 0.3], "irradiance": 2.0}
    integrator = {"type": "irrcache", "solver": "sweep", "resolution": 24}
    scene = scenes.load(integrator, shape, 12, emitter=sun)
    params = mi.traverse(scene)
    key = first_key(params, "sigma_t")
    start = type(params[key])(params[key])

    def radiance(factor: float) -> float:
        params[key] = start * factor
        params.update()
        return np.array(mi.render(scene, spp=64), dtype=np.float64).mean()

    difference = (radiance(1.02) - radiance(0.98)) / 0.04
    factor = mi.Float(1)
    dr.enable_grad(factor)
    params[key] = start * factor
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, spp=64), axis=None))
    assert abs(dr.grad(factor)[0] - difference) < 0.003 * radiance(1.0)


@pytest.mark.parametrize(
    ("data", "parameter", "expected"),
    [("dense at its boundary", "sigma_t", True), ("dense at its boundary", "albedo", False),
     ("empty at its boundary", "sigma_t", False)],
)  # fmt: skip
def test_inaccurate_derivatives_at_dense_boundaries_are_warned_of(
    rgb, scenes, logged, data, parameter, expected
):
    values = np.zeros((8, 8, 8), np.float32)
    inside = slice(None) if data == "dense at its boundary" else slice(2, 6)
    values[inside, inside, inside] = 1.5
    to_world = scenes.placement()
    shape = scenes.boundary(scenes.medium(values, 0.9, to_world), to_world)
    integrator = {"type": "irrcache", "solver": "sweep", "resolution": 8}
    scene = scenes.load(integrator, shape, 4, emitter=scenes.sun)
    params = mi.traverse(scene)
    key = first_key(params, parameter)
    value = params[key]
    dr.enable_grad(value)
    params[key] = value
    params.update()
    for _ in range(2):
        dr.backward(loss_of(mi.render(scene, params, spp=4)))
    warnings = [text for text in logged if "derivatives by its extinction" in text]
    assert len(warnings) == expected


def test_images_with_gradients_do_not_keep_the_scene(rgb):
    scene, params, key = small()
    attached(params, key)
    image = mi.render(scene, params, spp=1)
    shared = scene.integrator()._shared
    assert shared() is not None
    del image
    assert shared() is None


def test_a_batch_sensor_is_all_of_its_views(rgb):
    """They share one adjoint solve; its ordinates and samples are others."""
    scene, params, key = small()
    film = {"type": "hdrfilm", "height": 16, "rfilter": {"type": "box"}}
    views = []
    for origin in ([5.0, 1.0, 0.0], [0.0, 1.0, 5.0]):
        look = mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])
        views.append({"type": "perspective", "fov": 32.0, "to_world": look})
    both = {"type": "batch", "a": views[0], "b": views[1], "film": film | {"width": 32}}
    sensors = [mi.load_dict(view | {"film": film | {"width": 16}}) for view in views]
    one, two = (gradient_of(scene, params, key, spp=64, sensor=s) for s in sensors)
    found = gradient_of(scene, params, key, spp=64, sensor=mi.load_dict(both))
    expected = 0.5 * (one + two)  # the loss is a mean over pixels
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize("max_depth", [2, -1])
def test_adam_finds_a_density(mono, max_depth):
    """An optimisation that starts without matter."""
    case = Case(data=8, cache=8, max_depth=max_depth)
    scene = case.load()
    target = mi.TensorXf(mi.render(scene, spp=16))
    params = mi.traverse(scene)
    key = first_key(params, "sigma_t")
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer["density"] = dr.zeros(mi.TensorXf, params[key].shape)
    losses = []
    for step in range(12):
        optimizer["density"] = dr.clip(optimizer["density"], 0, 5)
        params[key] = optimizer["density"]
        params.update()
        loss = dr.mean(dr.square(mi.render(scene, params, spp=8, seed=step) - target))
        dr.backward(loss)
        optimizer.step()
        losses.append(float(np.array(loss).item()))
    assert losses[-1] < 0.2 * losses[0]


def test_the_grid_is_kept_while_parameters_carry_gradients(rgb):
    """With ``resolution`` 0 a denser medium gets a finer cache, but not within an optimisation."""
    scene, params, key = small(resolution=0)
    data, shapes = dr.full(mi.TensorXf, 0.5, params[key].shape), []
    for scale, attached in ((1.0, False), (10.0, True), (10.0, False)):
        params[key] = data * scale
        if attached:
            dr.enable_grad(params[key])
        params.update()
        mi.render(scene, params, spp=1)
        shapes.append(scene.integrator().cache.grid.shape)
    assert shapes[0] == shapes[1] != shapes[2]
    params[key] = data
    dr.enable_grad(params[key])
    params.update()
    mi.render(scene, params, spp=1)
    assert scene.integrator().cache.grid.shape == shapes[2]
    # The same values without gradients.
    dr.disable_grad(params[key])
    params.set_dirty(key)
    params.update()
    mi.render(scene, params, spp=1)
    assert scene.integrator().cache.grid.shape == shapes[0]


def test_parameters_without_gradients_cost_nothing(rgb, kernels):
    scene, params, _ = small()
    image = mi.render(scene, params, spp=1)
    integrator = scene.integrator()
    assert (
        kernels(
            lambda: integrator.render_backward(scene, params, dr.ones(mi.TensorXf, image.shape))
        )
        == []
    )


def test_an_objective_that_does_not_depend_on_the_image(rgb):
    scene, params, key = small()
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, spp=1)
    dr.backward(dr.sum(image * mi.TensorXf(np.zeros(image.shape, np.float32))))
    assert not np.array(dr.grad(params[key])).any()


def test_only_what_is_wanted_is_computed(rgb, monkeypatch):
    """The radiance of a sun needs no derivatives by the extinction."""
    from mitsuba_irrcache.gradients import resampling

    scene = Case(data=8, cache=8, emitters=lambda: {"sun": SUN}).load()
    params, calls = mi.traverse(scene), []
    add = resampling.VoxelQuadrature.add
    monkeypatch.setattr(
        resampling.VoxelQuadrature, "add", lambda *args: calls.append(args) or add(*args)
    )
    gradient_of_colour(scene, params, "sun.irradiance.value")
    assert not calls
    gradient_of(scene, params, first_key(params, "sigma_t"))
    assert len(calls) == 1


def gradient_of_colour(scene, params, key) -> None:
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, spp=1)))
    params[key] = dr.detach(params[key])
    params.update()


# What is refused


def refused(scene: mi.Scene, suffix: str) -> str:
    """The message of the error for the gradient of a parameter whose key ends like this."""
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith(suffix)]
    dr.enable_grad(params[key])
    params.update()
    with pytest.raises(IrrcacheError) as error:
        dr.backward(dr.mean(mi.render(scene, params, spp=1)))
    assert f'"{key}"' in str(error.value) and "prbvolpath" in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("suffix", "reason"),
    [
        ("vertex_positions", "it belongs to a Cube"),
        ("sensor.x_fov", "it belongs to a PerspectiveCamera"),
        ("spot.to_world", '"to_world" is not the radiance of the SpotLight'),
    ],
)
def test_other_parameters_are_refused_by_name(rgb, suffix, reason):
    scene = Case(data=8, cache=8, emitters=lambda: {"spot": spot()}).load()
    assert reason in refused(scene, suffix)


@pytest.mark.parametrize(("g", "name"), [(0.3, "sun.to_world"), (0.3, "point.position")])
def test_placements_are_refused_in_anisotropic_media(rgb, g, name):
    scene = Case(data=8, cache=8, g=g, emitters=lambda: {"sun": SUN, "point": POINT}).load()
    assert "is not the radiance of" in refused(scene, name)


def test_a_mean_cosine_of_zero_is_refused(rgb):
    scene = Case(data=8, cache=8, g=0.0).load()
    assert "it is 0" in refused(scene, "phase_function.g")


def test_positions_of_lights_in_the_medium_are_refused(rgb):
    scene = Case(data=8, cache=8, emitters=lambda: {"lamp": LAMP}).load()
    assert "the light is in the medium" in refused(scene, "lamp.position")


@pytest.mark.parametrize(
    ("properties", "reason"),
    [
        ({"solver": "path", "cache_spp": 8}, 'the solver is "path"'),
        ({"max_depth": 4}, "max_depth is 4"),
        ({"filter": "bilateral"}, "filtered or has aovs"),
        ({"aovs": "z:depth"}, "filtered or has aovs"),
    ],
)
def test_settings_without_gradients_are_refused(rgb, properties, reason):
    assert reason in refused(Case(data=8, cache=8).load(**properties), "sigma_t.data")


def test_scenes_without_gradients_are_refused(rgb, scenes):
    place = scenes.placement()
    density = scenes.texture((6, 6, 6, 1), 0.0, 1.0, 1)
    ours = {"type": "irrcache", "solver": "sweep", "resolution": 6}
    parts = {"a": {"type": "hg", "g": 0.3}, "b": {"type": "isotropic"}}
    phase = {"type": "blendphase", "weight": 0.5} | parts
    shape = scenes.boundary(scenes.medium(density, 0.8, place, phase=phase), place)
    assert "it belongs to a HGPhaseFunction" in refused(scenes.load(ours, shape, 8), ".g")
    shape = scenes.boundary(scenes.medium(500.0, 0.8, place), place)
    opaque = scenes.load(ours | {"resolution": 0}, shape, 8)
    assert "has no cache" in refused(opaque, "sigma_t.value.value")


@pytest.mark.parametrize(
    ("height", "angle", "reason"),
    [(0.4, 40.0, "is in the medium"), (3.0, 2.0, "is narrower than 4 voxels")],
)
def test_spots_whose_beams_are_narrow_are_refused(rgb, height, angle, reason):
    """Derivatives by the intensity of such spots were up to four times too large."""
    look = mi.ScalarTransform4f().look_at([0.1, height, 0], [0.1, -1, 0], [1, 0, 0])
    lamp = {"type": "spot", "to_world": look, "cutoff_angle": angle}
    scene = Case(data=8, cache=8, emitters=lambda: {"lamp": lamp}).load()
    message = f'the beam of the emitter "lamp" (SpotLight) {reason}'
    assert message in refused(scene, "sigma_t.data")


def test_narrow_projectors_are_refused(rgb):
    """The derivative by the radiance of one that illuminates a part of a voxel was 0."""
    look = mi.ScalarTransform4f().look_at([0.1, 5, 0], [0.1, 0, 0], [0, 0, 1])
    for fov, is_narrow in ((1.0, True), (40.0, False)):
        lamp = {"type": "projector", "to_world": look, "fov": fov, "irradiance": 1.0}
        scene = Case(data=8, cache=8, emitters=lambda e=lamp: {"lamp": e}).load()
        if is_narrow:
            assert 'the emitter "lamp" (Projector) is narrower' in refused(scene, "sigma_t.data")
        else:
            found = gradients(scene, ("sigma_t",), pixel_weights(scene), spp=1)
            assert np.abs(found["sigma_t"]).max() > 0


def test_narrow_beams_beside_the_medium_are_not_refused(rgb):
    look = mi.ScalarTransform4f().look_at([4, 3, 0], [4, 0, 0], [1, 0, 0])
    lamp = {"type": "spot", "to_world": look, "cutoff_angle": 2.0}
    scene = Case(data=8, cache=8, emitters=lambda: {"sky": SKY, "lamp": lamp}).load()
    found = gradients(scene, ("sigma_t",), pixel_weights(scene), spp=1)
    assert np.abs(found["sigma_t"]).max() > 0


def test_a_texture_of_two_emitters_is_refused(rgb):
    """The derivative was that of one of them."""
    texture = {"type": "uniform", "id": "both", "value": 20.0}
    reference = {"type": "ref", "id": "both"}
    lamps = {
        name: {"type": "point", "position": [x, 4.0, 1.0], "intensity": reference}
        for name, x in (("a", -1.0), ("b", 1.0))
    }
    scene = Case(data=8, cache=8, emitters=lambda: {"both": texture} | lamps).load()
    assert "several emitters depend on it" in refused(scene, "both.value")


@pytest.mark.parametrize("backwards", [True, False])
def test_images_of_other_colour_spaces_are_refused(rgb, backwards):
    """Gradients of images in XYZ were those of RGB."""
    scene = Case(data=8, cache=8, pixels="xyz").load()
    params = mi.traverse(scene)
    (key,) = [k for k in params.keys() if k.endswith("sigma_t.data")]
    scale = mi.Float(1)
    dr.enable_grad(scale)
    params[key] = params[key] * scale
    params.update()
    image = mi.render(scene, params, spp=1)
    with pytest.raises(IrrcacheError, match='pixel_format "xyz"'):
        dr.backward(dr.mean(image)) if backwards else dr.forward(scale)


def test_points_in_sharply_scattering_matter_are_refused(rgb):
    scene = Case(data=8, cache=8, g=0.6, emitters=lambda: {"lamp": LAMP}).load()
    assert 'emitter "lamp" is in medium' in refused(scene, "sigma_t.data")


def test_emitters_without_derivatives_are_refused_by_name(rgb, monkeypatch):
    """A kind that is added to the solvers has no gradients until they include it."""
    monkeypatch.setattr(backward, "EMITTERS", backward.EMITTERS - {EmitterKind.POINT})
    scene = Case(data=8, cache=8, emitters=lambda: {"lamp": LAMP}).load()
    assert 'emitter "lamp" (PointLight)' in refused(scene, "sigma_t.data")


def test_emission_of_zero_is_refused(rgb):
    scene = Case(data=8, cache=8, emissive=True).load()
    params = mi.traverse(scene)
    key = first_key(params, "emission")
    params[key] = dr.zeros(mi.TensorXf, params[key].shape)
    params.update()
    assert "the emission is 0 everywhere" in refused(scene, "emission.data")


# Numbers


@pytest.mark.parametrize("depth", [1e-12, 1e-4, 50.0, 1e6])
@pytest.mark.parametrize("albedo", [0.0, 1.0])
def test_gradients_are_finite(mono, depth, albedo):
    case = Case(data=6, cache=6, depth=depth, albedo=(albedo / 1.1,))
    scene = case.load()
    found = gradients(scene, ("sigma_t", "albedo"), pixel_weights(scene), spp=4)
    assert all(np.isfinite(g).all() for g in found.values())
    assert np.abs(found["sigma_t"]).max() > 0


def test_kernels_do_not_depend_on_the_mean_cosine(mono):
    """Each step of a fit compiled about 15 kernels anew, which took most of its time."""
    scene = Case(data=6, cache=6, g=0.7, emitters=lambda: {"sun": SUN}, directions=64).load()
    params = mi.traverse(scene)
    key, used = first_key(params, "g"), []
    for g in (0.7, 0.705, 0.71):
        value = dr.opaque(mi.Float, g)
        dr.enable_grad(value)
        params[key] = value
        params.update()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.backward(dr.mean(mi.render(scene, params, spp=4)))
            history = dr.kernel_history((dr.KernelType.JIT,))
        # The bounds of sums are constants of some tiny kernels.
        used.append({kernel["hash"] for kernel in history if kernel["operation_count"] > 30})
    assert len(used[0]) > 50
    assert not used[2] - used[1]
