"""Determine the medium at a position by rays that intersect the shapes around it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.transport.path import MOST_CROSSINGS


def medium_at(scene: mi.Scene, position: np.ndarray) -> mi.MediumPtr:
    """Return the medium at a world position (3), found along a direction that is no axis."""
    return probe(scene, mi.Point3f(position), mi.Vector3f(0.48, 0.64, 0.6))


@symbolic
def probe(scene: mi.Scene, p: mi.Point3f, direction: mi.Vector3f):
    """Return the medium at ``p`` according to the first shape with a medium along ``direction``;
    null where there is no such shape.
    """
    ray, pointer = mi.Ray3f(p, direction), dr.zeros(mi.MediumPtr, dr.width(p))
    crossings, active = mi.UInt32(0), mi.Bool(True)
    while dr.hint(active, label="probe"):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        transition = active & si.is_medium_transition()
        pointer = dr.select(transition, si.target_medium(-direction), pointer)
        ray = si.spawn_ray(direction)
        crossings += 1
        active &= ~transition & (crossings < MOST_CROSSINGS)
    return pointer
