"""Emitters of kinds that a solver does not know are refused by name, or sampled by ``path``."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_irrcache.errors import IrrcacheError, UnsupportedSceneError
from mitsuba_irrcache.lights import narrow_sources
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of
from mitsuba_irrcache.pipeline.defaults import choose_solver, needs_no_cache
from mitsuba_irrcache.scene.compile import compile_scene
from mitsuba_irrcache.solvers import half_space, sweep
from mitsuba_irrcache.solvers.discrete_ordinates.incident import DistantIllumination
from tests.support.emitters import register_beam

pytestmark = pytest.mark.usefixtures("rgb")

VOLPATH = {"type": "volpath"}


def under_a_beam(scenes, integrator: dict, density: float = 1.0, **properties) -> mi.Scene:
    beam = {"type": register_beam(mi.variant()), "id": "beam"}
    shape = scenes.boundary(scenes.medium(density, 0.8, **properties))
    return scenes.load(integrator, shape, 16, emitter=beam, default_solver="auto")


@pytest.mark.parametrize("phase", [{}, {"phase": {"type": "hg", "g": 0.58}}], ids=["", "hg"])
@pytest.mark.parametrize("max_depth", [2, -1])
def test_path_samples_a_beam_that_varies(scenes, max_depth, phase):
    """With anisotropic scattering, too, where its direction is known though its kind is not."""
    ours = {"type": "irrcache", "max_depth": max_depth, "resolution": 24, "cache_spp": 64}
    mine = scenes.image(under_a_beam(scenes, ours, **phase), spp=64)
    depth = {"max_depth": max_depth}
    reference = scenes.image(under_a_beam(scenes, VOLPATH | depth, **phase), spp=2048)
    for image in (mine, reference):
        halves = np.sort([image[:, :8].mean(), image[:, 8:].mean()])
        assert halves[1] > 1.5 * halves[0]
    for half in (slice(8), slice(8, None)):
        assert mine[:, half].mean() == pytest.approx(reference[:, half].mean(), rel=0.03)


def test_others_refuse_a_beam_that_varies(scenes):
    """It is not taken for a sun, of which one sample is enough."""
    scene = under_a_beam(scenes, VOLPATH, density=500.0)
    (medium,) = compile_scene(scene).visible
    assert kind_of(scene.emitters()[0]) is EmitterKind.UNKNOWN
    assert choose_solver(scene, medium, "auto")[0].name == "path"
    with pytest.raises(IrrcacheError, match='emitter "beam"'):
        choose_solver(scene, medium, "sweep")
    with pytest.raises(UnsupportedSceneError, match='emitter "beam"'):
        DistantIllumination(scene)
    assert needs_no_cache(scene, medium, -1, 0) is None
    sunlit = scenes.load(VOLPATH, scenes.boundary(scenes.medium(500.0, 0.8)))
    assert needs_no_cache(sunlit, compile_scene(sunlit).visible[0], -1, 0) is not None


def test_unknown_emitters_without_one_direction_are_refused_where_moments_are_needed(
    scenes, monkeypatch
):
    """Narrow emitters are no part of the moments, whose truncated series would be far off."""
    monkeypatch.setattr(narrow_sources, "emits_in_one_direction", lambda emitter: False)
    medium = scenes.medium(1.0, 0.8, phase={"type": "hg", "g": 0.5})
    beam = {"type": register_beam(mi.variant()), "id": "beam"}
    ours = {"type": "irrcache", "solver": "path", "resolution": 8}
    scene = scenes.load(ours, scenes.boundary(medium), 4, emitter=beam)
    with pytest.raises(UnsupportedSceneError, match=r'emitter "beam".*anisotropic'):
        scene.integrator().prepare(scene)


def test_new_kinds_are_refused_until_they_are_listed():
    """Kinds are listed by name: none is taken for supported because it is not excluded."""
    listed = {
        EmitterKind.CONSTANT_ENVIRONMENT,
        EmitterKind.ENVIRONMENT_MAP,
        EmitterKind.SUN,
        EmitterKind.POINT,
        EmitterKind.SPOT,
        EmitterKind.PROJECTOR,
    }
    assert half_space.EMITTERS == listed
    assert sweep.EMITTERS == listed | {EmitterKind.AREA}


def test_directional_area_is_refused_where_it_would_be_left_out(scenes):
    lamp = {"type": "rectangle", "emitter": {"type": "directionalarea", "id": "beamer"}}
    scene = scenes.load(VOLPATH, scenes.boundary(scenes.medium(1.0, 0.8)), lamp=lamp)
    with pytest.raises(UnsupportedSceneError, match=r'"beamer".*directional area'):
        DistantIllumination(scene)


def test_directional_area_emitters_are_warned_of(scenes, logged):
    lamp = {"type": "rectangle", "emitter": {"type": "directionalarea", "id": "beamer"}}
    settings = {"type": "irrcache", "solver": "auto", "resolution": 4, "cache_spp": 8}
    scene = scenes.load(settings, scenes.boundary(scenes.medium(1.0, 0.8)), 4, lamp=lamp)
    mi.render(scene, spp=1)
    assert any('"beamer"' in text and "illuminates nothing" in text for text in logged)
