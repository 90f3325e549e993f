"""Emitters whose radiance truncated forward peaks scatter into camera rays (see `media/delta_m`).

These are the narrow sources, and the area emitters whose irradiance camera rays evaluate
(`cache/area_light`). Their radiance along a ray that hits them is attenuated by the original
extinction: what the peak scatters of it is part of the in-scattered radiance.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.area_light import AreaLight
from mitsuba_irrcache.lights.narrow_sources import SourceTable
from mitsuba_irrcache.render.raymarch import Projection
from mitsuba_irrcache.transport.path import emitter_behind


class PeakSources:
    """The sources of ``basis``, and area emitters with the direct ``lights``."""

    def __init__(self, basis: AngularBasis, lights: Sequence[AreaLight]) -> None:
        self.basis = basis
        #: all narrow sources
        self.narrow = SourceTable((*basis.sources, *basis.others))
        self._lights = lights

    @classmethod
    def of(cls, projections: Sequence[Projection]) -> PeakSources | None:
        """Find the emitters; return None if no medium has a truncated forward peak."""
        peaked = [p for p in projections if p.truncates_peak]
        if not peaked:
            return None
        lights = [along_rays.light for p in peaked for along_rays in p.direct_lights]
        area_lights = [x for x in lights if isinstance(x, AreaLight) and not x.is_wide]
        return cls(peaked[0].directional.directional, area_lights)

    def include(
        self,
        emitter: mi.EmitterPtr,
        origin: mi.Point3f,
        direction: mi.Vector3f,
        far: mi.Bool,
        near: mi.Bool,
    ) -> mi.Bool:
        """Return whether rays hit any of the sources; ``emitter`` is the one that they hit.

        ``far`` and ``near`` are as in `AngularBasis.hits_source`.
        """
        found = self.basis.hits_source(origin, direction, far, near)
        for light in self._lights:
            own = mi.EmitterPtr(light.emitter)
            dr.make_opaque(own)
            found |= near & (emitter == own)
        return found

    def hit_by(
        self,
        scene: mi.Scene,
        origin: mi.Point3f,
        ray: mi.Ray3f,
        far: mi.Bool,
        near: mi.Bool,
    ) -> mi.Bool:
        """Return whether ``ray``, on a line with ``origin``, hits any, possibly behind null
        surfaces; ``far`` and ``near`` as in `AngularBasis.hits_source`.
        """
        emitter = dr.zeros(mi.EmitterPtr)
        if self._lights:
            emitter = emitter_behind(scene, ray, near)
        return self.include(emitter, origin, ray.d, far, near)
