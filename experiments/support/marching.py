"""Camera rays without jitter, to measure the quadratures alone."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.render.raymarch import Projection


def unjittered(projection: Projection, ray: mi.Ray3f) -> tuple[np.ndarray, np.ndarray]:
    """Return scattered radiance and transmittance, float64, (channel, ray), with whole first
    steps.
    """
    hit, near, far = projection.medium.intersect(ray)
    near = dr.maximum(near, 0)
    radiance, transmittance, *_ = projection.march(ray, near, far, mi.Spectrum(0), mi.Float(1), hit)
    return np.array(radiance, dtype=np.float64), np.array(transmittance, dtype=np.float64)


def pixel_rays(sensor: mi.Sensor) -> mi.Ray3f:
    """Return a ray through the centre of every pixel, row by row."""
    width, height = sensor.film().crop_size()
    index = dr.arange(mi.UInt32, int(width) * int(height))
    position = mi.Point2f(
        (mi.Float(index % int(width)) + 0.5) / int(width),
        (mi.Float(index // int(width)) + 0.5) / int(height),
    )
    return mi.Ray3f(sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))[0])
