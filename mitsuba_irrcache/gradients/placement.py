"""Derivatives with respect to the positions of point lights and the directions of suns.

Where scattering is isotropic, images depend on them through the irradiance in the voxels alone. Its
change is a central difference: a light that moves by a small step irradiates a position as the
light that has not moved irradiates one a step before it, but for the medium on the way.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.gradients.resampling import volume_of
from mitsuba_irrcache.gradients.transport import AdjointTransport, Derivatives
from mitsuba_irrcache.lights.emitters import EmitterKind, kind_of
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.tracking import medium_transmittance

#: Step of positions, in edges of a voxel, and of directions [radians].
STEP, ANGLE = 0.25, 0.01


def by_position(
    emitter: mi.Emitter, medium: MediumGrid, transport: AdjointTransport, found: Derivatives
) -> np.ndarray:
    """Return the derivatives (3) with respect to the position of a point-like light."""
    light = next(i for i, e in enumerate(transport.lights.emitters) if e == emitter)
    step = STEP * float(transport.grid.voxel_size.min())

    def irradiance(shift: np.ndarray) -> mi.Spectrum:
        at = dr.zeros(mi.Interaction3f, transport.grid.voxel_count)
        at.p = transport.lights.positions - mi.Vector3f(
            *(dr.opaque(mi.Float, float(s)) for s in shift)
        )
        record, value = emitter.sample_direction(at, mi.Point2f(0.5))
        ray = mi.Ray3f(transport.lights.positions, record.d)
        lit = dr.max(value) > 0
        through = mi.Spectrum(medium_transmittance(medium, ray, record.dist, lit))
        return dr.select(lit, value * through, 0)

    worth = transport.lights.derivative(light, found.direct)
    return _differences(irradiance, step, worth) * volume_of(transport.grid)


def by_direction(
    emitter: mi.Emitter, medium: MediumGrid, transport: AdjointTransport, found: Derivatives
) -> np.ndarray:
    """Return the derivatives (3) with respect to the direction of propagation of a sun."""
    record, value = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
    towards = np.array(record.d, dtype=np.float64).ravel()

    def irradiance(change: np.ndarray) -> mi.Spectrum:
        own = towards - change
        own /= np.linalg.norm(own)
        direction = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in own))
        ray = mi.Ray3f(transport.lights.positions, direction)
        through = medium_transmittance(medium, ray, mi.Float(dr.inf), mi.Bool(True))
        return value * mi.Spectrum(through)

    worth = mi.Spectrum(*(direct[0][0] for direct in found.direct))
    return _differences(irradiance, ANGLE, worth) * volume_of(transport.grid)


def _differences(
    irradiance: Callable[[np.ndarray], mi.Spectrum], step: float, worth: mi.Spectrum
) -> np.ndarray:
    """Return the differences of ``worth`` times ``irradiance``, summed over all voxels, along the
    three axes.
    """
    result = []
    for axis in np.eye(3):
        change = irradiance(step * axis) - irradiance(-step * axis)
        total = np.array(dr.sum(worth * change), dtype=np.float64).sum()
        result.append(total / (2 * step))
    return np.array(result)


def placement_derivative(
    emitter: mi.Emitter, medium: MediumGrid, transport: AdjointTransport, found: Derivatives
) -> np.ndarray:
    """Return the derivatives with respect to the position (3) of a point light, or to ``to_world``
    (4, 4) of a sun, whose third column is the direction.
    """
    if kind_of(emitter) is not EmitterKind.SUN:
        return by_position(emitter, medium, transport, found)
    result = np.zeros((4, 4))
    result[:3, 2] = by_direction(emitter, medium, transport, found)
    return result
