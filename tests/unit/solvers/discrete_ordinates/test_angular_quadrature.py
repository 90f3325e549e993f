"""Angular quadrature: direction sets integrate low orders exactly and are unbiased."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import (
    hemisphere_ordinates,
    joint_ordinates,
)
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.mark.parametrize("count", [8, 16, 33])
def test_moments(count):
    """Weights are positive and integrate 1 and all products of two coordinates exactly.

    Over the hemisphere of pairs the integrals are 2 pi, 2 pi / 3 and 0. Equal weights would miss
    the latter by up to 20 %, and the fluence in dense media would depend on the rotation.
    """
    rng = np.random.default_rng(1)
    for _ in range(20):
        d, w = hemisphere_ordinates(count, rng)
        np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-12)
        assert w.min() > 0 and w.sum() == pytest.approx(2 * np.pi, rel=1e-12)
        np.testing.assert_allclose((d.T * w) @ d, 2 * np.pi / 3 * np.eye(3), atol=1e-12)


def test_every_direction_is_uniform():
    """Each of 8 directions is uniform over 3000 random rotations.

    Means, second and fourth moments agree to 4.5 standard errors. A rotation that favours an axis,
    as a QR factor without random signs does, would bias all batches alike.
    """
    rng = np.random.default_rng(2)
    d = np.array([hemisphere_ordinates(8, rng)[0] for _ in range(3000)])
    for values, mean in ((d, 0), (d**2, 1 / 3), (d * np.roll(d, 1, axis=2), 0), (d**4, 1 / 5)):
        error = values.std(axis=0) / np.sqrt(len(d))
        assert (np.abs(values.mean(axis=0) - mean) < 4.5 * error).all()
    # The set is rotated as a whole, so the angles within it are constant.
    between = (d[:, 0] * d[:, 5]).sum(axis=1)
    np.testing.assert_allclose(between, between[0], atol=1e-12)


@pytest.mark.parametrize("degree", [4, 6, 8])
def test_spirals_about_an_axis(degree):
    """Legendre polynomials of the cosine to the axis are integrated with less than half the error
    of random rotations, although the axis varies.
    """
    rng, errors = np.random.default_rng(7), {"about": [], "random": []}
    polynomial = np.polynomial.legendre.Legendre.basis(degree)
    for _ in range(100):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        for name, given in (("about", axis), ("random", None)):
            total, nearest = 0.0, 0.0
            for d, w in joint_ordinates(4, 32, rng, given):
                assert w.min() > 0
                np.testing.assert_allclose((d.T * w) @ d, 2 * np.pi / 3 * np.eye(3), atol=1e-12)
                total += w @ polynomial(d @ axis)
                nearest = max(nearest, (d @ axis).max())
            errors[name].append(total)
            assert given is None or 1 > nearest > np.cos(1.5 * np.sqrt(2 / 128))
    about, apart = (np.sqrt(np.mean(np.square(v))) for v in errors.values())
    assert about < 0.5 * apart, (about, apart)


@pytest.mark.parametrize(("sets", "count"), [(2, 8), (4, 8), (16, 8), (4, 32)])
def test_sets_of_several_passes_are_stratified(sets, count):
    """Sets of several passes together have a smaller quadrature error than independent sets.

    Each set has exact low moments; together they integrate (d . e)^6 and (d . e)^8 over directions
    d, for 50 unit vectors e, with less than two thirds of the root mean square error.
    """
    rng, errors = np.random.default_rng(5), {"together": [], "apart": []}
    for _ in range(20):
        together = joint_ordinates(sets, count, rng)
        for d, w in together:
            assert len(d) == count and w.min() > 0
            np.testing.assert_allclose((d.T * w) @ d, 2 * np.pi / 3 * np.eye(3), atol=1e-12)
        assert len(np.unique(np.concatenate([d for d, _ in together]), axis=0)) == sets * count
        e = rng.normal(size=(3, 50))
        e /= np.linalg.norm(e, axis=0)
        for name, found in (
            ("together", together), ("apart", [hemisphere_ordinates(count, rng) for _ in
            range(sets)]),
        ):  # fmt: skip
            for power in (6, 8):
                integral = sum(w @ (d @ e) ** power for d, w in found) / sets
                errors[name].append(integral - 2 * np.pi / (power + 1))
    together, apart = (np.sqrt(np.mean(np.square(v))) for v in errors.values())
    assert together < 0.67 * apart, together / apart


def lights(scenes, batches: int, **emitters) -> list[list[tuple]]:
    """Return the ordinates of passes of 8 pairs, under these emitters."""
    sky = DistantIllumination(
        scenes.load({"type": "irrcache", "solver": "path"}, None, size=2, **emitters)
    )
    rows, colour = sky.factored_ordinates(batches, 8, 3, np.random.default_rng(3))
    np.testing.assert_array_equal(colour, 1)
    return rows


def test_constant_environment_and_sun_have_no_noise(scenes):
    """A constant environment and a sun are integrated exactly in every pass.

    The weights sum to 4 pi; the sun's irradiance is in one direction.
    """
    sun = {"type": "directional", "direction": [1, -2, 2], "irradiance": 3.0}
    for directions, light, weights, offsets in lights(
        scenes, 4, emitter={"type": "constant"}, sun=sun
    ):
        assert len(directions) == 9 and offsets.shape == (9, 2)
        assert light[:8].sum() == pytest.approx(4 * np.pi, rel=1e-6)
        np.testing.assert_allclose(directions[8], [1 / 3, -2 / 3, 2 / 3], atol=1e-6)
        np.testing.assert_allclose(light[8, :, 0], [3, 0], rtol=1e-6)
        assert weights[8] == 0


@pytest.mark.parametrize("bright", [0.0, 300.0])
def test_an_environment_is_sampled_without_bias(scenes, bright):
    """Irradiance and net flux of an environment with a small bright patch are unbiased.

    The means over 64 x 4 passes agree with sums over its directions: 4 standard errors, each below
    3 %. A density that counts one of the sampling strategies, or not that of the opposite
    direction, is off by a third.
    """
    image = np.full((16, 32, 3), 0.2, np.float32)
    image[3:8] = 0.7
    image[5, 9] += bright
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(image)}
    scene = scenes.load({"type": "irrcache", "solver": "path"}, None, size=2, emitter=emitter)
    rng, sky = np.random.default_rng(4), DistantIllumination(scene)
    found = []
    for _ in range(64):
        rows, _ = sky.factored_ordinates(4, 8, 3, rng)
        directions, light = (np.concatenate([row[i] for row in rows]) for i in range(2))
        net = ((light[:, 0] - light[:, 1]) * directions).sum(axis=0)
        found.append(np.array([light.sum(), *net]) / 4)
    # Midpoint sums in cos(theta) and phi.
    z, phi = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (512, 1024)), indexing="ij")
    z, phi = 2 * z.ravel() - 1, 2 * np.pi * phi.ravel()
    d = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z])
    interaction = mi.SurfaceInteraction3f()
    interaction.wi = mi.Vector3f(d.astype(np.float32))
    radiance = np.array(scene.environment().eval(interaction)[0], dtype=np.float64)
    expected = 4 * np.pi * np.array([radiance.mean(), *(radiance * d).mean(axis=1)])
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert error[0] < 0.03 * expected[0]
    assert (np.abs(np.mean(found, axis=0) - expected) < 4 * error + 1e-3 * expected[0]).all()
