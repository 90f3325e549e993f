"""Projection of the cache to the screen: ray marching of the radiative transfer equation (paper,
eq. 1).

    L = int T sigma_s Phi / (4 pi) dt + T L_background

One step is as long as the shortest voxel edge, of the medium's grids and the cache's, times
``step``; steps end on the medium's bounds, never beyond. The lattice of steps is shifted by a
random offset per ray, so that what is left of the discretisation is noise, not bands. Macrocells
without extinction are crossed in one go.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .grid import GridField
from .layers import Layers, luminance
from .medium import MediumGrid
from .uncertainty import UncertaintyField

QUADRATURES = ("riemann", "trapezoid", "exponential")

#: A ray ends early once nothing ahead, not even the brightest cache voxel or the background seen
#: through the transmittance left, can change its radiance by more than this fraction.
EARLY_STOP = 1e-4


class Projection:
    """Everything a camera ray needs: the medium, the cached irradiance, and the quadrature rule.

    With ``layered``, rays also gather what `Layers` holds beside the radiance; with an
    ``uncertainty``, the error of the cache too.
    """

    def __init__(
        self,
        medium: MediumGrid,
        irradiance: GridField | None,
        quadrature: str,
        step: float,
        layered: bool = False,
        uncertainty: UncertaintyField | None = None,
    ) -> None:
        self.medium = medium
        self.irradiance = irradiance
        self.quadrature = quadrature
        self.layered = layered
        self.uncertainty = uncertainty
        grids = [f.grid for f in (medium.sigma_t, medium.albedo, irradiance) if f and f.grid]
        # Where nothing varies, one step is exact.
        length = min((g.voxel_size.min() for g in grids), default=dr.inf) * step
        self.step = dr.opaque(mi.Float, float(length))
        brightest = irradiance.maximum * medium.albedo.maximum / (4 * dr.pi) if irradiance else 0.0
        self.brightest = dr.opaque(mi.Float, brightest)

    def source(self, p: mi.Point3f, active: mi.Bool) -> tuple:
        """Albedo Phi / (4 pi), in-scattered radiance per unit of optical depth; and what layers
        need to know of the point: the albedo, and the relative errors of Phi.
        """
        if self.irradiance is None:
            return mi.Float(0), [self.medium.albedo.at_world(p, active)] if self.layered else []
        albedo, phi = self.medium.albedo.at_world(p, active), self.irradiance.at_world(p, active)
        known = [albedo] if self.layered else []
        if self.uncertainty is not None:
            known += self.uncertainty.at_world(p, phi, active)
        return albedo * phi * dr.inv_four_pi, known

    @dr.syntax
    def march(
        self,
        ray: mi.Ray3f,
        near: mi.Float,
        far: mi.Float,
        background: mi.Spectrum,
        offset: mi.Float,
        active: mi.Bool,
    ):
        """Scattered radiance and transmittance between ``near`` and ``far``, as two
        ``mi.Spectrum``, and the sums that `layers` makes `Layers` of.

        ``offset`` in (0, 1] is the length of the first step in steps; ``background`` is the
        radiance behind the medium, which early termination has to know.
        """
        sigma_t, walk = self.medium.sigma_t, self.medium.macrocells.walk(ray)
        active = mi.Bool(active) & (near < far)
        k = mi.UInt32(0)
        t = mi.Float(near)
        p = ray(t)
        extinction = sigma_t.at_world(p, active)
        source, known = self.source(p, active)
        before, before_source, before_length = extinction, source, mi.Float(dr.inf)
        grey = sigma_t.channels == 1
        transmittance = mi.Float(1) if dr.hint(grey, mode="scalar") else mi.Color3f(1)
        radiance = mi.Spectrum(0)
        gathered = self._nothing()
        brightest = dr.maximum(self.brightest, dr.max(background))
        # A float counts steps exactly up to 2^24; longer lattices are coarser, not endless.
        limit = dr.minimum(dr.ceil((far - near) / self.step) + 1, 2**24)
        while dr.hint(active, label="ray march"):
            # In an empty macrocell, go on at the last lattice point but one inside it: the step
            # that enters matter needs to know the one before.
            cell = walk.cell(t)
            wall, _ = walk.exit(cell, t)
            beyond = dr.floor((dr.minimum(wall, far) - near) / self.step - offset)
            empty = walk.majorant(cell, active) == 0
            skip = empty & (beyond > mi.Float(k + 1))
            k = dr.select(skip, mi.UInt32(dr.minimum(beyond, limit)), k + 1)
            end = dr.minimum(dr.fma(mi.Float(k) - 1 + offset, self.step, near), far)
            end = dr.select(mi.Float(k) < limit, end, far)
            p = ray(end)
            next_extinction = sigma_t.at_world(p, active)
            next_source, next_known = self.source(p, active)
            length = end - t
            ratio = length / before_length
            ratio = dr.select(ratio < 2, ratio, 0)  # a short first step tells no curvature
            ends = (extinction, next_extinction), (source, next_source)
            if dr.hint(self.quadrature == "exponential", mode="scalar"):
                ends = (
                    curved(before, extinction, next_extinction, ratio),
                    curved(before_source, source, next_source, ratio),
                )
            weights, passed = segment(self.quadrature, ends[0], length)
            near_light, far_light = weights[0] * ends[1][0], weights[1] * ends[1][1]
            emitted = near_light + far_light
            radiance = dr.select(active, radiance + transmittance * emitted, radiance)
            if dr.hint(self.layered, mode="scalar"):
                gathered = _gather(
                    gathered,
                    active,
                    transmittance,
                    weights[0] * t + weights[1] * end,
                    weights,
                    (near_light, far_light),
                    (known, next_known),
                )
            transmittance = dr.select(active, transmittance * passed, transmittance)
            before, before_source, before_length = extinction, source, length
            extinction, source, t = next_extinction, next_source, end
            known = next_known
            left = mi.Spectrum(transmittance)
            matters = dr.max(left) * brightest > EARLY_STOP * dr.max(radiance)
            matters |= (brightest == 0) & (dr.max(left) > EARLY_STOP)  # opacity needs no light
            active &= (t < far) & matters
        return radiance, mi.Spectrum(transmittance), gathered

    @property
    def channel_count(self) -> int:
        """Values in `Layers`, 0 without them."""
        errors = self.uncertainty.count if self.uncertainty is not None else 1
        return 4 * dr.size_v(mi.Spectrum) + 1 + errors if self.layered else 0

    def _nothing(self) -> list:
        """What has been gathered at the start of a ray: colour, depth, errors."""
        if not self.layered:
            return []
        errors = self.uncertainty.count if self.uncertainty is not None else 0
        return [mi.Spectrum(0), mi.Float(0), *(mi.Float(0) for _ in range(errors))]

    def layers(
        self,
        scattered: mi.Spectrum,
        transmittance: mi.Spectrum,
        gathered: list,
        background: mi.Spectrum,
        weight: mi.Spectrum,
    ) -> Layers:
        """What `march` returned, with names; ``weight`` is the sensor's weight of the radiance."""
        colour, depth, *errors = gathered
        scale = luminance(weight)
        return Layers(
            scattered=scattered * weight,
            colour=colour,
            background=background * weight,
            transmittance=transmittance,
            depth=depth,
            probes=[scale * e for e in errors[:-1]],
            bias=scale * errors[-1] if errors else mi.Float(0),
        )


def _gather(
    gathered: list,
    active: mi.Bool,
    transmittance: mi.Float | mi.Color3f,
    distance: mi.Float | mi.Color3f,
    weights: tuple,
    light: tuple,
    known: tuple[list, list],
) -> list:
    """Adds a segment to colour, depth and errors: the sources' weights times the albedo, absorbed
    light times distance, and the radiance from both ends times its relative errors.
    """
    (near_albedo, *near_errors), (far_albedo, *far_errors) = known
    colour = mi.Spectrum(transmittance * (weights[0] * near_albedo + weights[1] * far_albedo))
    near, far = (luminance(mi.Spectrum(transmittance * end)) for end in light)
    errors = [near * a + far * b for a, b in zip(near_errors, far_errors, strict=True)]
    added = [colour, luminance(mi.Spectrum(transmittance * distance)), *errors]
    return [dr.select(active, old + new, old) for old, new in zip(gathered, added, strict=True)]


def curved(before, a, b, ratio: mi.Float) -> tuple:
    """Values at both ends of a segment, scaled so that their mean is that of the parabola which
    also passes through the sample ``before``.

    ``ratio`` is the segment's length over that of the one before. What straight lines miss of a
    kink or a curve, they miss to the same side in every ray; here it cancels on average.
    """
    sag = (ratio * ratio * before - ratio * (1 + ratio) * a + ratio * b) / (6 * (1 + ratio))
    scale = dr.maximum(1 - 2 * sag / (a + b), 0)
    scale = dr.select(a + b > 0, scale, 1)
    return a * scale, b * scale


def segment(quadrature: str, sigma: tuple, length: mi.Float) -> tuple:
    """Weights of the sources albedo Phi / (4 pi) at both ends of a segment, and its transmittance.

    ``sigma`` is the extinction at both ends. ``riemann`` (the paper's rule, order 1) takes all from
    the start; ``trapezoid`` (order 2) takes extinction and sigma_s Phi / (4 pi) as linear in
    distance; ``exponential`` takes extinction and source as linear in distance (``curved`` ends
    make it of order 3 where both are smooth) and the transmittance as exact, so that opaque and
    long segments stay right.
    """
    sigma_a, sigma_b = sigma
    if quadrature == "riemann":
        absorbed = absorptance(sigma_a * length)
        return (absorbed, dr.zeros(type(absorbed))), 1 - absorbed
    passed = dr.exp(-0.5 * (sigma_a + sigma_b) * length)
    if quadrature == "trapezoid":
        return (0.5 * length * sigma_a, 0.5 * length * (passed * sigma_b)), passed
    return exponential_weights(sigma_a * length, sigma_b * length), passed


def exponential_weights(tau_a, tau_b) -> tuple:
    """Weights of the sources at both ends: int_0^1 (1 - u | u) sigma(u) e^-tau(u) du.

    ``tau_a``, ``tau_b`` are the extinctions at the ends times the segment's length, sigma(u) is
    linear between them and tau(u) = tau_a u + (tau_b - tau_a) u^2 / 2. By parts near = int 1 -
    e^-tau(u) du, here with three Gauss-Legendre points: right to 2e-3 up to optical depths of 5,
    and within [0, 1] for all. A source linear in *optical depth* would be simpler, but weights the
    empty end of a segment that enters a surface far too much.
    """
    near = 0.0
    for u, weight in ((0.5 - 0.3872983346, 5 / 18), (0.5, 8 / 18), (0.5 + 0.3872983346, 5 / 18)):
        near = near + weight * absorptance(u * (tau_a * (1 - 0.5 * u) + tau_b * (0.5 * u)))
    return near, dr.maximum(absorptance(0.5 * (tau_a + tau_b)) - near, 0.0)


def absorptance(tau):
    """1 - e^-tau, by its series where the difference would cancel."""
    series = tau * (1 - tau * (1 / 2 - tau * (1 / 6 - tau * (1 / 24 - tau / 120))))
    return dr.select(tau < 0.1, series, 1 - dr.exp(-tau))
