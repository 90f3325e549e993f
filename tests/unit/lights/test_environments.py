"""How much detail the light of a scene has."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.core.detail import Detail
from mitsuba_irrcache.lights.environments import detail_of, is_smooth

pytestmark = pytest.mark.usefixtures("rgb")

CONSTANT = {"type": "constant", "radiance": 1.0}


def sky(of_height, channel: int | None = None) -> dict:
    """Return an environment map of radiances by height; only one channel has them if given."""
    height = np.cos((np.arange(32) + 0.5) / 32 * np.pi)
    values = np.ones((32, 64, 3), dtype=np.float32)
    values[..., slice(None) if channel is None else [channel]] = of_height(height)[:, None, None]
    return {"type": "envmap", "bitmap": mi.Bitmap(values)}


def detail(*emitters: dict) -> Detail:
    scene = mi.load_dict({"type": "scene"} | {f"e{k}": e for k, e in enumerate(emitters)})
    return detail_of(scene.emitters())


def gradient(height: np.ndarray) -> np.ndarray:
    return 1 + 0.9 * height


def lobe(height: np.ndarray) -> np.ndarray:
    return 0.1 + np.maximum(height, 0) ** 16


def test_kinds_of_light():
    sun = {"type": "directional", "direction": [0, -1, 0]}
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    assert detail() is detail(CONSTANT) is Detail.UNIFORM
    assert detail(sky(gradient)) is Detail.SMOOTH
    assert detail(sky(lobe)) is detail(sky(lobe, 2)) is Detail.SHARP
    assert detail(CONSTANT, sun) is detail(lamp) is detail(sky(gradient), lamp) is Detail.SHARP


@pytest.mark.parametrize("value", [np.nan, 1e6])
def test_a_single_texel_is_no_smooth_sky(value):
    pixels = np.ones((256, 512, 3), dtype=np.float32)
    pixels[100, 200] = value
    bitmap = mi.Bitmap(pixels)
    scene = mi.load_dict({"type": "scene", "sky": {"type": "envmap", "bitmap": bitmap}})
    assert not is_smooth(scene.environment())


@pytest.mark.parametrize("solver", ["sweep", "path"])
@pytest.mark.parametrize(("max_depth", "g", "on_ground"), [(2, 0, 0), (-1, 0.4, 0), (-1, 0, 1)])
@pytest.mark.filterwarnings("error")
def test_a_black_environment_is_dark(scenes, solver, max_depth, g, on_ground):
    """Mitsuba samples no direction of a black map: its directions and densities are not a number,
    also after they are multiplied by 0.
    """
    black = {"type": "envmap", "bitmap": mi.Bitmap(np.zeros((8, 16, 3), np.float32))}
    assert is_smooth(mi.load_dict(black))
    integrator = {"type": "irrcache", "solver": solver, "max_depth": max_depth, "cache_spp": 16}
    matter = scenes.medium(np.ones((4, 4, 4)), 0.9)
    matter |= {"phase": {"type": "hg", "g": g}} if g else {}
    floor = mi.ScalarTransform4f().translate([0, -1.5, 0]).rotate([1, 0, 0], -90).scale(4)
    objects = {"floor": {"type": "rectangle", "to_world": floor}} if on_ground else {}
    objects |= {"emitter": black, "sun": None}
    scene = scenes.load(integrator | {"resolution": 8}, scenes.boundary(matter), **objects)
    image = scenes.image(scene, spp=4)
    assert np.isfinite(image).all() and not image.any()
