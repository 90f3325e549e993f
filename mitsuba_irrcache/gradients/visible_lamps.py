"""Lamps that are visible through a medium with a truncated forward peak.

delta-M (`media/delta_m`) divides the phase function into a peak of share f, which counts as
unscattered, and the rest, (p - f delta) / (1 - f). Derivatives attenuate lamps behind the medium by
the scaled extinction, which has no peak. The radiance of the lamps is therefore scattered into
camera rays by that rest: what p / (1 - f) scatters, minus f / (1 - f) times the radiance that
arrives from exactly the direction of the ray. For wide lamps this difference is that of the moments
alone, because the radiance of a lamp varies little over the angles of the peak.
"""

from __future__ import annotations

from itertools import islice

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis, legendre_polynomials

#: Mean square angle [rad^2] above which the distribution of directions is a Legendre series up to
#: the order of the basis. Its next term is below 2 % there.
WIDE = 0.8


def unscattered_weights(
    basis: AngularBasis, p: mi.Point3f, direction: mi.Vector3f
) -> list[mi.Float] | None:
    """Return, for each source of ``basis``, the weight with which the truncated peak scatters its
    irradiance at ``p`` into rays along ``direction``; None if no source is a lamp.

    It is 0 for sources without extent, which no ray hits.
    """
    # docs/primer, eq. (8.24)
    if not basis.phase.forward or all(source.sharp for source in basis.sources):
        return None
    ratio, found = basis.phase.forward / (1 - basis.phase.forward), []
    for source in basis.sources:
        if source.sharp:
            found.append(mi.Float(0))
            continue
        cosine = dr.dot(direction, source.seen_from(p)[0])
        found.append(dr.opaque(mi.Float, ratio) * _density(cosine, source.variance(p), basis.order))
    return found


def _density(cosine: mi.Float, variance: mi.Float, order: int) -> mi.Float:
    """Return 4 pi times the distribution of the directions to a source around its centre, whose
    Legendre moments are exp(-l (l + 1) variance / 4).
    """
    angle = dr.safe_acos(cosine)
    narrow = dr.maximum(variance, 1e-6)
    # The heat kernel on the sphere, for short times.
    ratio = dr.sqrt(angle / dr.maximum(dr.sin(angle), 1e-3 * dr.maximum(angle, 1e-3)))
    closed = 4 / narrow * ratio * dr.exp(narrow / 16 - dr.square(angle) / narrow)
    series, attenuation, factor = mi.Float(0), mi.Float(1), mi.Float(1)
    blur = dr.exp(-0.5 * variance)
    for degree, polynomial in enumerate(islice(legendre_polynomials(cosine), order + 1)):
        series += (2 * degree + 1) * attenuation * polynomial
        factor *= blur
        attenuation *= factor
    return dr.select(variance < WIDE, closed, series)
