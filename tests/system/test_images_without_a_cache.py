"""`auto` renders an image by Mitsuba's integrators where that is estimated to be faster."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.imaging.stock_estimate import cheaper_stock_image, relative_variance
from tests.support.surfaces import fog, ref

pytestmark = pytest.mark.usefixtures("rgb")

GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
SKY = {"type": "constant", "radiance": 1.0}


def tumbler() -> dict:
    """Return milk in a closed cylinder of glass, which has to be solved by paths."""
    inside = {"bsdf": GLASS, "interior": ref("milk")}
    wall = {"type": "cylinder", "p0": [0, -0.8, 0], "p1": [0, 0.8, 0], "radius": 0.6}
    look = mi.ScalarTransform4f().look_at
    ends = {
        f"end{i}": {
            "type": "disk",
            "to_world": look([0, y, 0], [0, 2 * y, 0], [0, 0, 1]).scale(0.6),
        }
        | inside
        for i, y in enumerate((-0.8, 0.8))
    }
    milk = fog((4, 4, 4), (0.99,) * 3) | {"id": "milk"}
    return {"milk": milk, "wall": wall | inside, "emitter": SKY, "sun": None} | ends


def loaded(scenes, objects: dict, size: int = 16, **properties) -> mi.Scene:
    integrator = {"type": "irrcache"} | properties
    return scenes.load(integrator, None, size, default_solver="auto", **objects)


def test_a_small_image_of_milk_in_a_tumbler(scenes):
    """The image is that of volpath, with the samples that an error of 1 % needs; the sampler keeps
    its own number. The same call gives the same image, but for the order in which GPUs add
    samples.
    """
    scene = loaded(scenes, tumbler())
    integrator = scene.integrator()
    assert not integrator.uses_cache(scene, spp=4)
    image = scenes.image(scene, spp=4)
    assert integrator.cache.samples == 0
    assert scene.sensors()[0].sampler().sample_count() == 4
    stock = scenes.load({"type": "volpath", "rr_depth": 50}, None, 16, **tumbler())
    error = np.sqrt(np.square(image - scenes.image(stock, spp=1024)).mean()) / image.mean()
    assert 0.002 < error < 0.012
    again = scenes.image(loaded(scenes, tumbler()), spp=4)
    np.testing.assert_allclose(again, image, rtol=0 if mi.variant().startswith("llvm") else 1e-6)


def test_extinction_of_zero_in_one_channel(scenes):
    """Mitsuba's integrators render such milk too dark by a third in a channel that scatters: the
    image is that of a cache, and equals those of grey media, channel by channel.
    """
    extinction, albedo = (0.0, 1.0, 3.0), (0.9, 0.3, 0.8)
    objects = tumbler() | {"milk": fog(extinction, albedo) | {"id": "milk"}}
    scene = loaded(scenes, objects)
    assert scene.integrator().uses_cache(scene)
    image = scenes.image(loaded(scenes, objects, resolution=20), spp=64)
    for channel in range(3):
        grey = fog((extinction[channel],) * 3, (albedo[channel],) * 3) | {"id": "milk"}
        stock = {"type": "volpath", "rr_depth": 50}
        expected = scenes.image(scenes.load(stock, None, 16, **tumbler() | {"milk": grey}), spp=256)
        assert image[..., channel].mean() == pytest.approx(expected.mean(), rel=0.02)


def test_scenes_without_a_cache_name_channels_without_collisions(scenes, monkeypatch):
    """Without a cache the image is that of Mitsuba, with a warning that names the medium."""
    inside = fog((0.0, 1.0, 3.0), (0.9,) * 3) | {"id": "milk"}
    ball = {"type": "sphere", "bsdf": GLASS, "interior": inside}
    scene = scenes.load({"type": "irrcache", "solver": "path", "max_depth": 4}, None, 4, ball=ball)
    messages = []
    monkeypatch.setattr(mi, "Log", lambda level, text: messages.append((level, text)))
    mi.render(scene, spp=1)
    warnings = [text for level, text in messages if level == mi.LogLevel.Warn]
    assert any('extinction of medium "milk" is 0 in some' in text for text in warnings)


def test_after_several_images_a_cache_is_faster(scenes):
    scene = loaded(scenes, tumbler())
    integrator = scene.integrator()
    assert not integrator.uses_cache(scene)
    parts, volpath = integrator.cached_media(scene), mi.load_dict({"type": "volpath"})
    cost = sum(part.cost for part in parts)
    view = scene, scene.sensors()[0], 4, parts, volpath
    one = cheaper_stock_image(*view, 0.0)
    assert one.paths < 0.7 * cost
    assert cheaper_stock_image(*view, cost - one.paths) is None


@pytest.mark.parametrize(
    "properties",
    [
        {"solver": "path"},
        {"resolution": 8},
        {"cache_spp": 16},
        {"cache_seed": 1},
        {"aovs": "noise"},
        {"filter": "bilateral"},
        {"step": 1.0},
        {"emission": 0.5},
        {"tolerance": 0.01},
    ],
    ids=lambda properties: next(iter(properties)),
)
def test_what_requests_a_cache(scenes, properties):
    scene = loaded(scenes, tumbler(), **properties)
    assert scene.integrator().uses_cache(scene)


def test_caches_that_exist_are_used(scenes, monkeypatch):
    scene = loaded(scenes, tumbler(), size=4)
    integrator = scene.integrator()
    assert not integrator.uses_cache(scene)
    integrator.cached_media(scene)[0].cache.note_samples(0, 8)
    assert integrator.uses_cache(scene)


def test_isolated_and_large_images_have_no_pilot(scenes, monkeypatch):
    """A pilot image would cost more than what a choice could save."""
    pilot = "mitsuba_irrcache.imaging.stock_estimate._pilot"
    monkeypatch.setattr(pilot, lambda *_: pytest.fail("a pilot image was rendered"))
    thin = scenes.load(
        {"type": "irrcache"}, scenes.boundary(scenes.medium(0.01, 0.9)), 4, default_solver="auto"
    )
    assert thin.integrator().uses_cache(thin)
    large = loaded(scenes, tumbler(), size=2048)
    assert large.integrator().uses_cache(large, spp=4)


def test_the_variance_is_estimated_from_above():
    rng = np.random.default_rng(1)
    samples = 1 + 0.1 * rng.standard_normal((3, 4096, 4))
    assert 0.01 / 3 < relative_variance(samples.mean(axis=0, keepdims=True), 0.0) < 0.0040
    assert 0.0095 < relative_variance(samples, 0.0) < 0.011
    assert relative_variance(samples, 100.0) > 1
    assert relative_variance(np.zeros((3, 64, 4)), 0.0) == np.inf
    assert relative_variance(np.full((3, 64, 4), np.nan), 0.0) == np.inf
