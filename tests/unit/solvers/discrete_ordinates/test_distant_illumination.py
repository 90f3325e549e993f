"""Distribution of directions over an environment map."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination

pytestmark = pytest.mark.usefixtures("rgb")


def sky_of(scenes, pixels: np.ndarray) -> tuple[DistantIllumination, np.ndarray, np.ndarray]:
    """Return a grey environment (row, column), and directions (n, 3) with Mitsuba's radiance
    there.
    """
    bitmap = mi.Bitmap(np.repeat(np.float32(pixels)[..., None], 3, axis=2))
    emitter = {"type": "envmap", "bitmap": bitmap}
    scene = scenes.load({"type": "irrcache", "solver": "path"}, None, 2, emitter=emitter, sun=None)
    count = 1 << 14
    y, turn = 2 * (np.arange(count) + 0.5) / count - 1, 2.399963 * np.arange(count)
    around = np.sqrt(1 - y * y)
    directions = np.stack([around * np.cos(turn), y, around * np.sin(turn)], axis=1)
    seen = mi.SurfaceInteraction3f()
    seen.wi = mi.Vector3f(np.float32(-directions.T))
    return (
        DistantIllumination(scene),
        directions,
        np.array(scene.environment().eval(seen)[0], np.float64),
    )


def of_passes(sky: DistantIllumination, count: int, pairs: int, value) -> np.ndarray:
    """Return the integrals of radiance times ``value`` of its direction, of ``count`` single
    passes.
    """
    rng, found = np.random.default_rng(12), []
    for _ in range(count):
        directions, light, *_ = sky.ordinates(1, pairs, rng)[0]
        both = np.stack([-directions, directions], axis=1)
        found.append((light[..., 0, None] * value(both)).sum(axis=(0, 1)))
    return np.array(found)


def test_flux_from_a_bright_side_is_unbiased(scenes):
    """The flux from one side of an environment is unbiased.

    Half of it comes from a broad lobe above, the other half from all sides: the share from above,
    by two smooth weights, agrees within 4 standard errors, these below 1 %. Directions that can
    also be sampled as an opposite one, but are not divided by both densities, would count up to
    twice.
    """

    def value(towards: np.ndarray) -> np.ndarray:
        up = towards[..., 1]
        return np.stack([np.ones_like(up), up, up * up], axis=-1)

    height = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    lobe = 0.1 + np.maximum(height, 0) ** 6
    sky, directions, radiance = sky_of(scenes, np.tile(lobe[:, None], (1, 8)))
    expected = 4 * np.pi * (radiance[:, None] * value(directions)).mean(axis=0)
    found = of_passes(sky, 400, 16, value)
    error = found.std(axis=0) / np.sqrt(len(found))
    assert (error < 0.01 * expected[0]).all()
    assert (np.abs(found.mean(axis=0) - expected) < 4 * error + 2e-3 * expected[0]).all()


def test_uniform_part_of_an_environment_is_balanced(scenes):
    """The uniform part of an environment is balanced between opposite sides in each pass.

    Almost all importance sampled directions go to a small spot; the rest is balanced to 2.5 % in
    the root mean square, as the weights of the directions imply. Equal weights give 4 % and more.
    """
    pixels = np.ones((32, 64))
    pixels[15:17, 31:33] = 3e4
    sky, directions, radiance = sky_of(scenes, pixels)
    spot = directions[radiance > 1000].mean(axis=0)
    spot /= np.linalg.norm(spot)
    first, second = np.linalg.svd(spot[None])[2][1:]

    def value(towards: np.ndarray) -> np.ndarray:
        beside = np.abs(towards @ spot) < 0.95
        u, v = towards @ first, towards @ second
        return np.stack([p * beside for p in (u * u, v * v, u * v)], axis=-1)

    uu, vv, uv = of_passes(sky, 40, 16, value).T
    assert np.sqrt(np.mean(((uu - vv) / (uu + vv)) ** 2)) < 0.025
    assert np.sqrt(np.mean((2 * uv / (uu + vv)) ** 2)) < 0.025


def test_a_bright_texel_does_not_change_the_rest_of_an_environment(scenes):
    """What enters from all sides but those around a bright texel is right to 3 % in every pass.

    The interpolated texel reaches further than the spot that it makes. If what is left of it were
    normalised together with the rest, that would change by a half.
    """
    pixels = np.ones((32, 64))
    pixels[9, 20] = 3e4
    sky, directions, radiance = sky_of(scenes, pixels)
    spot = directions[radiance > 1000].mean(axis=0)

    def value(towards: np.ndarray) -> np.ndarray:
        return (towards @ (spot / np.linalg.norm(spot)) < np.cos(np.deg2rad(16)))[..., None] * 1.0

    expected = 4 * np.pi * (radiance * value(directions)[:, 0]).mean()
    found = of_passes(sky, 20, 16, value)[:, 0]
    assert np.abs(found / expected - 1).max() < 0.03


def test_smooth_environments_have_even_ordinates_only(scenes):
    """Every set of these has the exact flux of a sky whose radiance is linear in the height, in
    total and from above. Sampled directions would make both random.
    """

    def value(towards: np.ndarray) -> np.ndarray:
        up = towards[..., 1]
        return np.stack([np.ones_like(up), up], axis=-1)

    height = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    sky, directions, radiance = sky_of(scenes, np.repeat(1 + 0.8 * height[:, None], 128, axis=1))
    found = of_passes(sky, 8, 8, value)
    exact = 4 * np.pi * (radiance[:, None] * value(directions)).mean(axis=0)
    np.testing.assert_allclose(found, np.broadcast_to(exact, found.shape), rtol=2e-3)
    assert len(sky.ordinates(1, 8, np.random.default_rng(1))[0].directions) == 8
