"""The kind of an emitter is decided in one place, for every emitter plugin of Mitsuba but
``timed_sunsky``, on which ``volpath`` fails.
"""

from __future__ import annotations

import ast
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_irrcache
from mitsuba_irrcache.lights.emitters import EmitterKind, EmittersByKind, kind_of

pytestmark = pytest.mark.usefixtures("rgb")

PACKAGE = Path(mitsuba_irrcache.__file__).parent
IMAGE = np.ones((4, 8, 3), np.float32)
KINDS = {
    "constant": EmitterKind.CONSTANT_ENVIRONMENT,
    "envmap": EmitterKind.ENVIRONMENT_MAP,
    "sunsky": EmitterKind.ENVIRONMENT_MAP,
    "directional": EmitterKind.SUN,
    "point": EmitterKind.POINT,
    "spot": EmitterKind.SPOT,
    "projector": EmitterKind.PROJECTOR,
    "area": EmitterKind.AREA,
    "directionalarea": EmitterKind.DIRECTIONAL_AREA,
}


def emitter_of(plugin: str) -> mi.Emitter:
    described = {"type": plugin}
    if plugin == "envmap":
        described["bitmap"] = mi.Bitmap(IMAGE)
    if plugin == "projector":
        described["irradiance"] = {"type": "bitmap", "bitmap": mi.Bitmap(IMAGE)}
    if KINDS[plugin] in (EmitterKind.AREA, EmitterKind.DIRECTIONAL_AREA):
        return mi.load_dict({"type": "rectangle", "emitter": described}).emitter()
    return mi.load_dict(described)


@pytest.mark.parametrize("plugin", KINDS)
def test_kinds_of_mitsubas_emitters(plugin):
    assert kind_of(emitter_of(plugin)) is KINDS[plugin]


def test_emitters_by_kind():
    emitters = [emitter_of(plugin) for plugin in ("point", "constant", "spot")]
    found = EmittersByKind(emitters)
    assert len(found) == 3
    assert found.of(EmitterKind.SPOT, EmitterKind.POINT) == [emitters[0], emitters[2]]
    assert [kind for _, kind in found] == [KINDS[p] for p in ("point", "constant", "spot")]
    assert not EmittersByKind([])


def test_no_other_module_looks_at_the_flags_of_emitters():
    found = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and node.attr == "EmitterFlags"
    }
    assert found == {"lights/emitters.py"}
