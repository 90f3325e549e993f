"""Nothing holds a scene with its caches after its last use.

A scene holds its integrator, so what the integrator holds must not hold the scene: garbage
collection does not see references within Mitsuba. Besides memory, kernels that call the methods of
objects differ with the numbers of those that exist, so each further scene would be compiled anew.
"""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import pytest

from tests.support.surfaces import ball, bound, fog, ground

pytestmark = pytest.mark.usefixtures("rgb")

CASES = {
    "alone": {"solver": "sweep"},
    "sweep": {"solver": "sweep"},
    "sweep, anisotropic": {"solver": "sweep"},
    "path": {"solver": "path", "max_depth": 3},
}


def next_number() -> int:
    """Return the number that Dr.Jit gives to the next shape."""
    shape = mi.ShapePtr(mi.load_dict({"type": "sphere"}))
    return int(dr.reinterpret_array(mi.UInt32, shape)[0])


@pytest.mark.parametrize("case", CASES)
def test_a_scene_is_freed_with_its_last_reference(scenes, case):
    objects = {} if case == "alone" else {"ground": ground(), "ball": ball((0.3, 1.5, 0))}
    phase = {"phase": {"type": "hg", "g": 0.4}} if "anisotropic" in case else {}
    before = next_number()
    smoke = {"smoke": bound(interior=fog() | phase)}
    settings = {"type": "irrcache", "resolution": 4, "cache_spp": 16} | CASES[case]
    scene = scenes.load(settings, None, 4, **smoke, **objects)
    assert next_number() > before
    scene.integrator().prepare(scene)
    scene.integrator().cache_spp = 32  # by the same solver, which is kept
    scenes.image(scene, spp=1)
    del scene
    gc.collect()
    assert next_number() == before
