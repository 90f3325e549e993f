"""Every parameter of a scene that can carry gradients either has them, or is refused by name."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from experiments.validation.gradients.cases import (
    POINT,
    SKY,
    SUN,
    Case,
    ground,
    lamp,
    sky_with_sun,
    spot,
)
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.gradients.parameters import enabled, roles_of
from mitsuba_irrcache.gradients.traced import roles_among
from mitsuba_irrcache.scene.compile import media_of


def textured_ground() -> dict:
    """A ground with a texture, a luminous square, a metal ball and a coated one."""
    bitmap = mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32))
    metal = {"type": "roughconductor", "alpha": 0.2}
    balls = {
        "metal": {"type": "sphere", "center": [3, 0, 0], "radius": 0.4, "bsdf": metal},
        "coated": {"type": "sphere", "center": [-3, 0, 0], "bsdf": {"type": "plastic"}},
    }
    return ground({"type": "bitmap", "bitmap": bitmap, "raw": True}) | lamp() | balls


ISOLATED = Case(
    data=6,
    cache=6,
    emitters=lambda: {"sky": sky_with_sun(), "sun": SUN, "point": POINT, "spot": spot()},
)
ANISOTROPIC = Case(data=6, cache=6, g=0.3, emitters=lambda: {"sky": SKY, "sun": SUN, "p": POINT})
AMONG_SURFACES = Case(
    data=6,
    cache=6,
    emitters=lambda: {"sky": SKY, "sun": SUN, "point": POINT},
    objects=textured_ground,
)
#: Ends of the keys of parameters that have gradients; other tests compare these with differences.
RADIANCE = ("irradiance.value", "radiance.value", "intensity.value")
SUPPORTED = {
    "isolated": (*RADIANCE, "sky.data", "sigma_t.data", "albedo.data", "n.to_world", "t.position"),
    "anisotropic": (*RADIANCE, "sigma_t.data", "albedo.data", "phase_function.g"),
    "among surfaces": (*RADIANCE, "sigma_t.data", "albedo.data", "reflectance.data"),
}
CASES = {
    "isolated": ISOLATED,
    "anisotropic": ANISOTROPIC,
    "among surfaces": AMONG_SURFACES,
}


def attach(params: mi.SceneParameters, key: str) -> bool:
    """Enable gradients of a parameter; return whether it can carry them."""
    value = params[key]
    array = value if dr.is_array_v(value) else getattr(value, "matrix", None)
    if array is None or not (dr.is_diff_v(array) and dr.is_float_v(array)):
        return False
    leaf = type(array)(dr.detach(array))
    dr.enable_grad(leaf)
    params[key] = leaf if array is value else type(value)(leaf)
    return True


@pytest.mark.parametrize("name", CASES)
def test_parameters_have_gradients_or_are_refused_by_name(rgb, name):
    scene = CASES[name].load()
    media, found, refused = list(media_of(scene)), [], []
    for key in sorted(mi.traverse(scene).keys()):
        params = mi.traverse(scene)
        if not attach(params, key):
            continue
        assert key in enabled(params)
        try:
            if name == "among surfaces":
                roles_among(params, [key], media, scene)
            else:
                roles_of(params, [key], *media, scene)
            found.append(key)
        except IrrcacheError as error:
            assert f'"{key}"' in str(error) and "prbvolpath" in str(error)
            refused.append(key)
    assert all(key.endswith(SUPPORTED[name]) for key in found), found
    assert not any(key.endswith(SUPPORTED[name]) for key in refused), refused
    assert len(found) >= 5 and len(refused) >= 6
