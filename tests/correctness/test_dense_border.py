"""Radiance of dense media under a uniform environment, against the half-space in closed form."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.cache import border

pytestmark = pytest.mark.usefixtures("mono")


def half_space_h(albedo: float, mu: float) -> float:
    """Return Chandrasekhar's H function, by iteration of its integral equation."""
    x, w = np.polynomial.legendre.leggauss(200)
    x, w = 0.5 * (x + 1), 0.5 * w
    h = np.ones_like(x)
    for _ in range(500):
        integral = (w * x * h / (x[:, None] + x)).sum(axis=1)
        h = 1 / (np.sqrt(1 - albedo) + 0.5 * albedo * integral)
    return float(1 / (np.sqrt(1 - albedo) + 0.5 * albedo * (w * x * h / (mu + x)).sum()))


def radiance(albedo: float, max_depth: int, mu: float) -> float:
    """Return the radiance that a half-space emits at the cosine ``mu``, in units of the sky's."""
    if max_depth == 2:
        return 0.5 * albedo * (1 - mu * np.log(1 + 1 / mu))
    return 1 - np.sqrt(1 - albedo) * half_space_h(albedo, mu)


def image(depth: float, albedo: float, max_depth: int, mu: float, voxels: int = 48):
    """Return the mean radiance of the middle of a face of a cube whose voxels have this depth."""
    values = np.full((2, 2, 2, 1), 0.5 * depth * voxels, np.float32)
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "to_world": place, "raw": True}
    medium = {"type": "heterogeneous", "sigma_t": volume, "albedo": albedo}
    origin = [4 * float(np.sqrt(1 - mu * mu)), 0, -1 - 4 * mu]
    camera = mi.ScalarTransform4f().look_at(origin, [0, 0, -1], [0, 1, 0]).scale(0.4)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    return np.mean(
        mi.render(
            mi.load_dict({
                "type": "scene",
                "integrator": {
                    "type": "irrcache", "solver": "sweep", "resolution": voxels,
                    "max_depth": max_depth, "hide_emitters": True,
                },
                "sensor": {"type": "orthographic", "to_world": camera, "film": film},
                "sky": {"type": "constant", "radiance": 1.0},
                "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
            }),
            spp=256,
        )
    )  # fmt: skip


@pytest.mark.parametrize("mu", [1.0, 0.5])
@pytest.mark.parametrize(
    ("albedo", "max_depth", "depth", "bound"),
    [
        (0.8, 2, 0.5, 0.03),
        (0.8, 2, 1.0, 0.07),
        (0.8, 2, 2.0, 0.11),
        (0.5, -1, 0.5, 0.043),
        (0.8, -1, 0.5, 0.036),
        (0.8, -1, 1.0, 0.063),
        (0.95, -1, 1.0, 0.031),
        (0.8, -1, 2.0, 0.15),
    ],
)
def test_half_space(mu, albedo, max_depth, depth, bound):
    """The face of an opaque cube agrees with a half-space.

    When the outermost values were extrapolated by their ratio, and the mean over a voxel was
    taken as the value at its centre, single scattering was 7, 39 and 107 % too bright with optical
    depths of 0.5, 1 and 2 per voxel, all orders with an albedo of 0.8 by 2, 9 and 29 %.
    """
    expected = radiance(albedo, max_depth, mu)
    found = image(depth, albedo, max_depth, mu)
    assert found == pytest.approx(expected, rel=bound)


def test_tables():
    """The tables agree with published values of E_2 and E_3, and with the equation of the decay."""
    e2, e3 = border._exponential_integrals(1.0)
    assert e2 == pytest.approx(0.148496, rel=1e-4)  # Abramowitz and Stegun, table 5.4
    assert e3 == pytest.approx(0.109692, rel=1e-4)
    decay, root = border._decay_table().astype(float), np.linspace(0, 1, border.ALBEDOS)
    clear = (root > 0) & (decay < 0.999)  # closer to 1, single precision does not suffice
    albedo, k = 1 - root[clear] ** 2, decay[clear]
    np.testing.assert_allclose(albedo * np.arctanh(k) / k, 1, rtol=1e-4)
    assert clear.sum() > 60
