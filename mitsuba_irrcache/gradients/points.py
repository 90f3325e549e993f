"""Derivatives through the extinction between point-like lights and the voxels they illuminate."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import minimum
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.gradients.splatting import ConstantSplat, GridSplat, summed_to_channels
from mitsuba_irrcache.gradients.tangent_fields import FieldReader
from mitsuba_irrcache.lights.emitters import are_distant
from mitsuba_irrcache.media.medium import MediumGrid


@symbolic
def add_paths_to_light(
    medium: MediumGrid,
    emitter: mi.Emitter,
    position: mi.Point3f,
    removed: mi.Spectrum,
    step: mi.Float,
    splat: GridSplat | ConstantSplat | FieldReader,
):
    """Add derivatives with respect to the extinction between positions and a point-like light.

    Returns ``splat``.

    Args:
        medium: the medium that the lines to the light cross.
        emitter: the light.
        position: ends of the lines, in world space.
        removed: derivative of the objective with respect to the optical depth of each line.
        step: step along the lines, in scene units.
        splat: sums to which the derivatives are added.
    """
    # docs/primer, eq. (8.9)
    at = dr.zeros(mi.Interaction3f, dr.width(position))
    at.p = position
    record, _ = emitter.sample_direction(at, mi.Point2f(0.5))
    ray = mi.Ray3f(position, record.d)
    hit, near, far = medium.intersect(ray)
    t = dr.maximum(near, 0)
    if not are_distant(emitter):
        far = dr.minimum(far, record.dist)
    active = hit & (t < far) & (dr.max(dr.abs(removed)) > 0)
    while dr.hint(active, label="line to a light"):
        end = minimum(t + step, far)
        change = removed * (end - t)
        splat.add(ray(0.5 * (t + end)), summed_to_channels(change, splat.channels), active)
        t = end
        active &= t < far
    return splat
