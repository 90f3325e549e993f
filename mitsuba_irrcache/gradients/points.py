"""Point-like lights: what the medium on the way from a light removes of its irradiance."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import minimum
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, of_channels
from mitsuba_irrcache.media.medium import MediumGrid


@symbolic
def add_ways(
    medium: MediumGrid,
    emitter: mi.Emitter,
    position: mi.Point3f,
    removed: mi.Spectrum,
    step: mi.Float,
    splat: GridSplat | ConstantSplat,
):
    """Add to ``splat`` the derivative by the extinction on the way from each ``position`` to the
    light of an ``emitter``, where a unit of optical depth is worth ``removed``.
    """
    # docs/primer, eq. (8.9)
    at = dr.zeros(mi.Interaction3f, dr.width(position))
    at.p = position
    record, _ = emitter.sample_direction(at, mi.Point2f(0.5))
    ray = mi.Ray3f(position, record.d)
    hit, near, far = medium.intersect(ray)
    t, far = dr.maximum(near, 0), dr.minimum(far, record.dist)
    active = hit & (t < far) & (dr.max(dr.abs(removed)) > 0)
    while dr.hint(active, label="way to a light"):
        end = minimum(t + step, far)
        change = removed * (end - t)
        splat.add(ray(0.5 * (t + end)), of_channels(change, splat.channels), active)
        t = end
        active &= t < far
