"""Quadrature rules of the ray marching: weights of a segment's ends."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.fast_math import absorbed, absorptance, decay, greatest

QUADRATURES = ("riemann", "trapezoid", "exponential")


#: Points and weights of three-point quadrature over [0, 1].
GAUSS_LEGENDRE = (
    (0.5 - 0.3872983346, 5 / 18),
    (0.5, 8 / 18),
    (0.5 + 0.3872983346, 5 / 18),
)


def curved(before, a, b, ratio: mi.Float) -> tuple:
    """Values at both ends of a segment, scaled so that their mean is that of the parabola which
    also passes through the sample ``before``.

    ``ratio`` is the segment's length over that of the one before. What straight lines miss of a
    kink or a curve, they miss to the same side in every ray; here it cancels on average.
    """
    # docs/primer, eq. (5.5)
    # The sag of the parabola, over a mean of 1.
    bend = ratio * dr.fma(ratio, before - a, b - a)
    sag = bend / (3 * (1 + ratio) * (a + b))
    scale = dr.select(a + b > 0, greatest(1 - sag, 0), 1)
    return a * scale, b * scale


def segment(quadrature: str, sigma: tuple, length: mi.Float) -> tuple:
    """Weights of the sources albedo Phi / (4 pi) at both ends of a segment, and its transmittance.

    ``sigma`` is the extinction at both ends. ``riemann`` (the paper's rule, order 1) takes all from
    the start; ``trapezoid`` (order 2) takes extinction and sigma_s Phi / (4 pi) as linear in
    distance, but no more than the segment absorbs: of opaque ones it would make as many times more
    as they are thick; ``exponential`` takes extinction and source as linear in distance (``curved``
    ends make it of order 3 where both are smooth) and the transmittance as exact, so that opaque
    and long segments stay right.
    """
    # docs/primer, eqs. (5.2), (5.3)
    sigma_a, sigma_b = sigma
    if quadrature == "riemann":
        absorbed = absorptance(sigma_a * length)
        return (absorbed, dr.zeros(type(absorbed))), decay(sigma_a * length)
    tau_a, tau_b = sigma_a * length, sigma_b * length
    passed = decay(0.5 * (tau_a + tau_b))
    if quadrature == "trapezoid":
        near, far = 0.5 * tau_a, 0.5 * passed * tau_b
        total, absorbed = near + far, absorptance(0.5 * (tau_a + tau_b))
        share = dr.select(total > absorbed, absorbed / total, 1)
        return (near * share, far * share), passed
    return exponential_weights(tau_a, tau_b, passed), passed


def exponential_weights(tau_a, tau_b, passed) -> tuple:
    """Weights of the sources at both ends: int_0^1 (1 - u | u) sigma(u) e^-tau(u) du.

    ``tau_a``, ``tau_b`` are the extinctions at the ends times the segment's length, ``passed`` is
    its transmittance, sigma(u) is linear between them and tau(u) = tau_a u + (tau_b - tau_a) u^2 /
    2. By parts near = int 1 - e^-tau(u) du, here with three Gauss-Legendre points: right to 2e-3 up
    to optical depths of 5, and within [0, 1] for all. A source linear in *optical depth* would be
    simpler, but weights the empty end of a segment that enters a surface far too much.
    """
    # docs/primer, eq. (5.4)
    near = 0.0
    for u, weight in GAUSS_LEGENDRE:
        depth = dr.fma(tau_a, u * (1 - 0.5 * u), tau_b * (0.5 * u * u))
        near = dr.fma(absorptance(depth), weight, near)
    return near, greatest(absorbed(0.5 * (tau_a + tau_b), passed) - near, 0.0)


def emission_weights(quadrature: str, sigma: tuple, length: mi.Float) -> tuple:
    """Weights of the emission at both ends of a segment, int_0^1 (1 - u | u) e^-tau(u) du times its
    ``length``; ``sigma`` is the extinction at both ends.

    ``exponential`` takes both as linear. With s such that ds is in proportion to e^-m u du, m the
    optical depth, what is left to integrate is e^-(tau(u) - m u), 1 where extinction is constant:
    exact there, whatever the depth, and 4 % off at worst where it rises from 0 to 20. ``riemann``
    and ``trapezoid`` are what they are for scattered light.
    """
    sigma_a, sigma_b = sigma
    mean = 0.5 * (sigma_a + sigma_b) * length
    zero = dr.zeros(type(mean))
    if quadrature == "riemann":
        return zero + length, zero
    if quadrature == "trapezoid":
        return zero + 0.5 * length, 0.5 * length * dr.exp(-mean)
    absorbed, thin = absorptance(mean), mean < 1e-3
    bend = 0.5 * (sigma_a - sigma_b) * length
    near, far = zero, zero
    for s, weight in GAUSS_LEGENDRE:
        u = dr.select(thin, s, -dr.log(1 - s * absorbed) / dr.select(thin, 1, mean))
        part = weight * dr.exp(-bend * u * (1 - u))
        near, far = near + part * (1 - u), far + part * u
    scale = length * dr.select(thin, 1 - 0.5 * mean, absorbed / dr.select(thin, 1, mean))
    return scale * near, scale * far
