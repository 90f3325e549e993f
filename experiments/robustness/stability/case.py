"""The description of a test case: a scene, and the properties that must hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from experiments.robustness.stability import properties as p
from experiments.robustness.stability.worlds import (
    RESOLUTION,
    SAMPLES,
    Matter,
    blob,
    scene,
    texture,
)
from mitsuba_irrcache.render.quadrature import QUADRATURES

SOLVERS = ("sweep", "path")
#: Cache settings; Russian roulette starts late, since its weights are unbounded in furnaces.
SETTINGS = {"resolution": RESOLUTION, "cache_spp": 64, "rr_depth": 200}


@dataclass(frozen=True)
class Case:
    """One scene of a hazard.

    Attributes:
        build: makes the scene with an integrator of these properties.
        properties: what must hold, in addition to finite and nonnegative values.
        settings: of the integrator, where they differ from `SETTINGS`.
        solvers, quadratures: those that it runs with.
        rays: rays to evaluate instead of rendering through the camera.
        refused: a part of the message with which the scene must be refused.
    """

    hazard: str
    name: str
    build: Callable[[dict], mi.Scene]
    properties: tuple = ()
    settings: dict = field(default_factory=dict)
    solvers: tuple[str, ...] = SOLVERS
    quadratures: tuple[str, ...] = QUADRATURES
    rays: Callable[[], mi.Ray3f] | None = None
    refused: str = ""

    def observe(self, settings: dict) -> p.Found:
        """Render this case with an integrator of these properties."""
        return p.observe(self.build(settings), settings, SAMPLES, self.rays)

    def judge(self, settings: dict) -> list[p.Verdict]:
        """Return every property with its error and the largest one admitted."""
        settings = SETTINGS | self.settings | settings
        if self.refused:
            said = p.refusal(lambda: self.observe(settings))
            return [(f"refused ({said or 'rendered'})", float(self.refused not in said), 0.0)]
        found = self.observe(settings)
        return [check(found) for check in (p.finite, p.not_negative, *self.properties)]


def case(
    hazard: str,
    name: str,
    *properties,
    matter=None,
    light=None,
    camera=None,
    world=None,
    beside=None,
    **options,
) -> Case:
    """Return a case whose scene `worlds.scene` makes of these arguments."""
    return Case(
        hazard,
        name,
        lambda settings: scene(settings, matter, light, camera, world, beside),
        properties,
        **options,
    )


CLOUD = Matter(blob(8, 3.0), 0.9)
FURNACE = Matter(texture((5, 6, 7), 0.0, 3.0), 1.0, (2.0, 1.6, 1.2), turn=20)


def same_as(matter: Matter, **changes) -> Callable[[dict], p.Found]:
    """Return a function that renders another description of the same problem.

    ``changes`` are of the settings; the image is rendered once for all cases.
    """
    known: dict[tuple, p.Found] = {}

    def observed(settings: dict) -> p.Found:
        settings = settings | changes
        key = (mi.variant(), *sorted(settings.items()))
        if key not in known:
            known[key] = p.observe(scene(settings, matter), settings, SAMPLES)
        return known[key]

    return observed


def clear() -> None:
    """Free the memory that Dr.Jit caches between cases."""
    dr.flush_malloc_cache()
