"""Media in front of a hidden environment, in closed form: white furnaces, and opacity."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

EXTREME = 1e8 ** (np.random.default_rng(1).random((4, 4, 4)) - 1)
WISPS = np.random.default_rng(2).random((6, 6, 6)) ** 2
PHASES = {"isotropic": {"type": "isotropic"}} | {
    f"hg {g}": {"type": "hg", "g": g} for g in (0.7, 0.85)
}


def medium(scenes, density: np.ndarray, depth: float, phase: str, albedo=1.0) -> dict:
    grid = (density / density.max() * depth / 2).astype(np.float32)
    return scenes.medium(grid, albedo, scenes.placement()) | {"phase": PHASES[phase]}


def image(scenes, objects: dict, **settings) -> tuple[np.ndarray, np.ndarray]:
    """Return radiance and alpha in front of a hidden white environment of radiance 1."""
    ours = {
        "type": "irrcache",
        "solver": "sweep",
        "max_depth": -1,
        "hide_emitters": True,
        "cache_spp": 64,
    }
    sky = {"type": "constant", "radiance": 1.0}
    described = scenes.description(ours | settings, None, 12, emitter=sky, **objects)
    film = described["sensor"]["film"] | {"pixel_format": "rgba"}
    described["sensor"] = described["sensor"] | {"film": film}
    found = np.array(mi.render(mi.load_dict(described), spp=64, seed=3), dtype=np.float64)
    return found[..., :3], found[..., 3]


@pytest.mark.parametrize(
    ("phase", "density", "depth"),
    [("hg 0.85", EXTREME, 10.0), ("hg 0.7", WISPS, 3.0), ("isotropic", EXTREME, 10.0)],
    ids=["hg 0.85, contrast 1e8", "hg 0.7, wisps", "isotropic, contrast 1e8"],
)
def test_white_furnace(scenes, phase, density, depth):
    """Where nothing is absorbed the radiance of a hidden white environment is the opacity.

    Radiance that a truncated forward peak scatters into a ray is not hidden: with g = 0.85 it is up
    to a half of all.
    """
    cloud = scenes.boundary(medium(scenes, density, depth, phase))
    radiance, alpha = image(scenes, {"cloud": cloud}, resolution=10)
    assert 0.1 < alpha.mean() < 0.9
    np.testing.assert_allclose(radiance, np.repeat(alpha[..., None], 3, axis=2), atol=4e-3)


def test_white_furnace_of_two_media(scenes):
    """The same where rays are traced through the scene's shapes."""
    other = scenes.boundary(
        scenes.medium(0.8, 1.0), scenes.placement((0.6, 0.6, 0.6), center=(0, 1.6, 0))
    )
    cloud = scenes.boundary(medium(scenes, WISPS, 3.0, "hg 0.85"))
    radiance, alpha = image(scenes, {"cloud": cloud, "other": other}, resolution=8)
    assert 0.1 < alpha.mean() < 0.9
    np.testing.assert_allclose(radiance.mean(axis=2), alpha, atol=8e-3)
    assert abs((radiance.mean(axis=2) - alpha).mean()) < 2e-3


@pytest.mark.parametrize("varies", [False, True], ids=["constant albedo", "grid of albedo"])
def test_opacity_does_not_depend_on_the_phase_function(scenes, varies):
    """Alpha is one minus the transmittance, however sharply the medium scatters."""
    albedo = np.random.default_rng(5).random((6, 6, 6)).astype(np.float32) if varies else 0.7
    opacity = [
        image(
            scenes,
            {"cloud": scenes.boundary(medium(scenes, WISPS, 3.0, phase, albedo))},
            resolution=6,
            step=0.2,
        )[1]
        for phase in ("isotropic", "hg 0.85")
    ]
    np.testing.assert_allclose(*opacity, atol=3e-3)
