"""Media without extinction in some channels, in which Mitsuba's integrators lose radiance.

``volpath`` and ``volpathmis`` sample the distance to a collision for one channel at random. In a
channel without extinction there is none, so that a part of the radiance that others scatter is lost
(seen in Mitsuba 3.9).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.bounds import bounds_of_shapes

#: Number of random positions in a scene at which the extinction is evaluated.
POSITIONS = 4096


def extinction_by_channel(scene: mi.Scene, medium: mi.Medium) -> np.ndarray:
    """Return the extinction of a medium in each channel, summed over random positions."""
    rng = mi.PCG32(POSITIONS)
    lower, upper = (mi.Point3f(*map(float, end)) for end in bounds_of_shapes(scene))
    at = dr.zeros(mi.MediumInteraction3f, POSITIONS)
    u = mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
    at.p = lower + u * (upper - lower)
    sigma_t = np.array(medium.get_scattering_coefficients(at, True)[2], dtype=np.float64)
    return sigma_t.reshape(dr.size_v(mi.Spectrum), -1).sum(axis=1)


def medium_with_clear_channel(scene: mi.Scene) -> str | None:
    """Return the name of a medium whose extinction is 0 in some channels only; None without any."""
    media = [sensor.get_medium() for sensor in scene.sensors()]
    for shape in scene.shapes():
        media += [shape.interior_medium(), shape.exterior_medium()]
    for medium in {each for each in media if each is not None}:
        sums = extinction_by_channel(scene, medium)
        if sums.max() > 0 and sums.min() == 0:
            return medium.id()
    return None


def warn_of_clear_channel(scene: mi.Scene, integrator: str) -> None:
    """Log a warning if an ``integrator`` of Mitsuba loses radiance in a medium of the scene."""
    name = medium_with_clear_channel(scene)
    if name is not None:
        mi.Log(
            mi.LogLevel.Warn,
            f'irrcache: the extinction of medium "{name}" is 0 in some channels only. '
            f'"{integrator}" renders such media too dark, because no collisions are sampled in '
            "those channels; set them to a thousandth of the others instead.",
        )
