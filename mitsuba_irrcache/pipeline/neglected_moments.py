"""Error of single scattering due to the moments of the phase function that a cache neglects.

Moments up to the order of the cache represent the radiance of an uneven environment. What the phase
function has beyond them matters where little of that radiance is scattered towards the camera, for
instance light from behind the camera, with a black sky behind the medium.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.lights.emitters import suns
from mitsuba_irrcache.lights.environments import even_radiance, is_uneven
from mitsuba_irrcache.lights.narrow_sources import spots_of
from mitsuba_irrcache.media.peak_blur import BLUR_RADIUS
from mitsuba_irrcache.media.phase import TAIL, Phase
from mitsuba_irrcache.scene.consistency import camera_rays

#: Numbers of directions of the environment, and of camera rays.
DIRECTIONS, RAYS = 1 << 12, 64
#: Ratio of the error of an image with all orders of scattering to that of single scattering, about:
#: 0.4 to 0.6 in cubes of optical depth 4 and an albedo of 0.8.
OF_ALL_ORDERS = 0.5


def error_of_neglected_moments(scene: mi.Scene, phase: Phase, max_depth: int) -> float:
    """Return the root mean square error of images of all sensors over their mean radiance, about.

    It is that of the radiance that an isolated medium with this ``phase`` function scatters into
    camera rays once, as if the medium were thin; 0 if all neglected moments are small.
    """
    if not phase.forward and phase.tail(phase.order) <= TAIL:
        return 0.0
    environment = scene.environment()
    if not is_uneven(environment):
        return 0.0
    towards, irradiance, spots = _smooth_part(environment)
    for sun in suns(scene):
        record, weight = sun.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
        spots.append((np.array(record.d, dtype=np.float64).ravel(), _grey(weight)[0]))
    degrees = np.arange(len(phase.all_moments))
    # The truncated peak is part of the rays behind the medium.
    factors = (2 * degrees + 1) * (phase.all_moments - phase.forward) / (1 - phase.forward)
    neglected, largest_cosine = np.where(degrees > phase.order, factors, 0), 1.0
    if phase.forward:
        # Camera rays evaluate the environment within the angle of the blur, see `media/peak_blur`.
        peak = np.where(degrees > phase.order, phase.all_moments, phase.forward)
        neglected = (2 * degrees + 1) * peak / (1 - phase.forward)
        largest_cosine = np.cos(BLUR_RADIUS)
    largest = 0.0
    for sensor in scene.sensors():
        ray, _ = camera_rays(sensor, RAYS)
        rays = np.array(ray.d, dtype=np.float64).T.reshape(-1, 3)
        cosines = rays @ towards.T
        total = np.polynomial.legendre.legval(cosines, factors) @ irradiance
        missing = np.polynomial.legendre.legval(cosines, neglected)
        missing = np.where(cosines <= largest_cosine, missing, 0) @ irradiance
        for direction, own in spots:
            value = np.polynomial.legendre.legval(rays @ direction, factors)
            total += np.maximum(value, 0) * own
        mean = total.mean()
        if mean > 0:
            largest = max(largest, float(np.sqrt(np.square(missing).mean()) / mean))
    return largest * (1.0 if max_depth == 2 else OF_ALL_ORDERS)


def _smooth_part(environment: mi.Emitter) -> tuple[np.ndarray, np.ndarray, list]:
    """Return directions (n, 3) towards an environment without its bright spots, the irradiance that
    each of them represents, and direction and irradiance of each spot.
    """
    directions, radiance = even_radiance(environment, DIRECTIONS)
    towards = -directions
    values = _grey(mi.Spectrum(*(mi.Float(c) for c in radiance.T)))
    found, shares = spots_of(environment)
    spots = []
    for source, share in zip(found, shares[1:-1], strict=True):
        values[source.covers(towards)] = 0
        spots.append(
            (
                np.array(source.place, dtype=np.float64).ravel(),
                _grey(mi.Spectrum(*map(float, share)))[0],
            )
        )
    return towards, values * (4 * np.pi / DIRECTIONS), spots


def _grey(spectrum: mi.Spectrum) -> np.ndarray:
    """Return the luminance of a spectrum (n)."""
    return np.array(luminance(spectrum), dtype=np.float64).ravel()
