"""Radiance of opaque homogeneous media in closed form, without a cache.

Near the boundary of a dense medium the irradiance changes within a fraction of a mean free path. If
the medium is hundreds of mean free paths across, no affordable grid resolves that layer, but its
radiance is known in closed form:

- Single scattering requires no grid: collisions along the camera ray and the transmittance to the
  boundary are analytic, for any size of the medium.
- Higher orders leave the medium close to where they entered it, as in a plane-parallel half-space.
  The radiance that a half-space reflects, per irradiance on a plane normal to the incident
  direction, is

      omega / (4 pi) mu0 / (mu + mu0) H(mu) H(mu0)

  with the albedo omega, the cosines mu0 and mu of incidence and emergence, and Chandrasekhar's H
  (*Radiative Transfer*, 1950, section 37, for isotropic scattering):

      H(mu) = 1 + omega / 2 mu H(mu) int_0^1 H(x) / (mu + x) dx.

  Each power of omega in the series of H(mu) H(mu0) is one order of scattering, starting with single
  scattering. The curvature and the edges of the boundary are neglected: the relative error is of
  the order of the mean free path over the size of the medium.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.fast_math import clipped
from mitsuba_irrcache.core.jit import symbolic
from mitsuba_irrcache.lights.emitters import (
    POINT_LIKE,
    EmitterKind,
    illuminating,
    kind_of,
    point_lights,
    position_of,
)
from mitsuba_irrcache.media.medium import MediumGrid

#: Error of the image [%] due to the half-space approximation, times the radius of a sphere, or the
#: shortest edge of a box, in mean free paths.
SPHERE_ERROR, BOX_ERROR = 25.0, 300.0
#: Supported kinds of emitters: their irradiance is about uniform over a mean free path.
EMITTERS = frozenset(
    (
        EmitterKind.CONSTANT_ENVIRONMENT,
        EmitterKind.ENVIRONMENT_MAP,
        EmitterKind.SUN,
        *POINT_LIKE,
    )
)
#: Number of direction samples of an environment, and of collision samples for each other emitter,
#: per camera sample.
ENVIRONMENT_SAMPLES, EMITTER_SAMPLES = 64, 8
#: Number of entries of the table of H(mu) H(mu0) along each axis, equidistant in sqrt(mu):
#: H has a logarithmic singularity at mu = 0.
TABLE = 64
#: Number of Gauss-Legendre nodes for the integral over x.
POINTS = 128
#: Maximum number of orders of scattering for which the series is summed.
MOST_ORDERS = 200
#: Additive constants of a three-dimensional Kronecker sequence (Roberts 2018).
SEQUENCE = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)


def series_error(medium: MediumGrid) -> float:
    """Estimate the error [%] of the half-space approximation of higher orders of scattering.

    It is infinite for media that this module does not support.
    """
    if not medium.homogeneous or medium.bbox is not None:
        return np.inf
    isotropic = medium.phase.is_isotropic
    if not medium.is_isolated or not isotropic or medium.emission is not None:
        return np.inf
    edges = np.linalg.norm(medium.frame[:3, :3], axis=0) * medium.sigma_t.minimum
    if not edges.min() > 0:
        return np.inf
    if medium.boundary.kind == "sphere":
        return SPHERE_ERROR / (0.5 * edges.min())
    return BOX_ERROR / edges.min()


def is_seen_from_outside(scene: mi.Scene, medium: MediumGrid) -> bool:
    """Return whether all sensors and point-like emitters of the scene are outside of ``medium``."""
    inside = [medium.boundary.contains(position_of(e)) for e in point_lights(scene)]
    return not any(inside) and all(s.get_medium() is None for s in scene.sensors())


def supports_emitters(scene: mi.Scene) -> bool:
    """Return whether all emitters of the scene are of the kinds ``EMITTERS``."""
    return all(kind_of(emitter) in EMITTERS for emitter in illuminating(scene))


class HalfSpace:
    """Scattered radiance of an opaque homogeneous ``medium`` seen from outside.

    The scene contains nothing else but distant and point-like emitters. ``max_depth`` is that of
    the integrator: 2 for single scattering, -1 for all orders.
    """

    # docs/primer, eq. (2.7)

    def __init__(self, scene: mi.Scene, medium: MediumGrid, max_depth: int) -> None:
        self.medium = medium
        self._environment = scene.environment()
        self._others = [e for e in illuminating(scene) if not kind_of(e).is_environment]
        albedo = np.broadcast_to(_channels(medium.albedo.value), (dr.size_v(mi.Spectrum),))
        self._albedo = mi.Spectrum([dr.opaque(mi.Float, float(a)) for a in albedo])
        orders = max_depth - 1 if max_depth >= 0 else 0
        self._multiple = orders != 1
        tables = [_higher_orders(float(a), orders) for a in albedo] if self._multiple else []
        self._tables = [mi.Float(table.astype(np.float32).ravel()) for table in tables]
        self._counts = [dr.opaque(mi.UInt32, n) for n in (ENVIRONMENT_SAMPLES, EMITTER_SAMPLES)]

    def radiance(
        self, ray: mi.Ray3f, near: mi.Float, far: mi.Float, sampler: mi.Sampler, active: mi.Bool
    ) -> mi.Spectrum:
        """Estimate the radiance scattered towards the origin of ``ray``, which intersects the
        medium from ``near`` to ``far``.
        """
        shift = mi.Vector3f([sampler.next_1d(active) for _ in range(3)])
        total = mi.Spectrum(0)
        if self._environment is not None:
            total += self._from(self._environment, ray, near, far, shift, self._counts[0], active)
        for emitter in self._others:
            total += self._from(emitter, ray, near, far, shift, self._counts[1], active)
        return total

    @symbolic
    def _from(
        self,
        emitter: mi.Emitter,
        ray: mi.Ray3f,
        near: mi.Float,
        far: mi.Float,
        shift: mi.Vector3f,
        count: mi.UInt32,
        active: mi.Bool,
    ):
        """Estimate the radiance due to one emitter: the mean of ``count`` samples."""
        active = mi.Bool(active) & (near < far)
        entry = ray(near)
        normal = self.medium.boundary.outward_normal(entry)
        mu = clipped(-dr.dot(normal, ray.d), 1e-6, 1.0)
        step = mi.Vector3f(*SEQUENCE)
        total, k = mi.Spectrum(0), mi.UInt32(0)
        while dr.hint(active & (k < count), label="half-space"):
            u = shift + mi.Float(k) * step
            u -= dr.floor(u)
            total += self._single(emitter, ray, near, far, u, active)
            vertex = dr.zeros(mi.Interaction3f)
            if dr.hint(self._multiple, mode="scalar"):
                vertex.p = entry
                record, light = emitter.sample_direction(vertex, mi.Point2f(u.y, u.z), active)
                mu0 = dr.dot(normal, record.d)
                enters = active & (mu0 > 0)
                mu0 = clipped(mu0, 1e-6, 1.0)
                factor = self._looked_up(mu, mu0, enters) * (mu0 / (mu + mu0))
                total += dr.select(enters, light * factor, 0)
            k += 1
        return dr.select(active, total * self._albedo * (dr.inv_four_pi / mi.Float(count)), 0)

    def _single(
        self,
        emitter: mi.Emitter,
        ray: mi.Ray3f,
        near: mi.Float,
        far: mi.Float,
        u: mi.Vector3f,
        active: mi.Bool,
    ) -> mi.Spectrum:
        """Sample single scattering: a collision with density proportional to T sigma_t for each
        channel of the extinction, and the exact transmittance to the emitter.
        """
        sigma_t, found = self.medium.sigma_t.value, []
        vertex = dr.zeros(mi.Interaction3f)
        for extinction in [sigma_t] if self.medium.sigma_t.channels == 1 else sigma_t:
            absorbed = 1 - dr.exp(-extinction * (far - near))
            vertex.p = ray(near - dr.log(1 - u.x * absorbed) / extinction)
            record, light = emitter.sample_direction(vertex, mi.Point2f(u.y, u.z), active)
            _, _, leave = self.medium.boundary.intersect(mi.Ray3f(vertex.p, record.d))
            within = dr.minimum(dr.maximum(leave, 0), record.dist)
            found.append(light * (absorbed * dr.exp(-extinction * within)))
        if len(found) == 1:
            return found[0]
        return mi.Spectrum([part[c] for c, part in enumerate(found)])

    def _looked_up(self, mu: mi.Float, mu0: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """Look up H(mu) H(mu0) - 1, interpolated bilinearly in the roots of the cosines."""
        x, y = (dr.sqrt(c) * (TABLE - 1) for c in (mu, mu0))
        i, j = (dr.minimum(mi.UInt32(v), TABLE - 2) for v in (x, y))
        wx, wy = x - mi.Float(i), y - mi.Float(j)
        values = []
        for table in self._tables:
            at = j * TABLE + i
            corners = (dr.gather(mi.Float, table, at + k, active) for k in (0, 1, TABLE, TABLE + 1))
            a, b, c, d = corners
            values.append(dr.lerp(dr.lerp(a, b, wx), dr.lerp(c, d, wx), wy))
        return mi.Spectrum(values)


def _channels(value: mi.Float | mi.Color3f) -> np.ndarray:
    return np.array(value, dtype=np.float64).ravel()


def _higher_orders(albedo: float, orders: int) -> np.ndarray:
    """Tabulate H(mu) H(mu0) - 1 up to this number of ``orders`` of scattering (0: all)."""
    mu = (np.arange(TABLE) / (TABLE - 1)) ** 2
    if not orders:
        h = chandrasekhar_h(albedo, mu)
        return np.outer(h, h) - 1
    terms = _series(mu, orders)
    total = np.zeros((TABLE, TABLE))
    for m in range(1, orders):
        total += albedo**m * sum(np.outer(terms[i], terms[m - i]) for i in range(m + 1))
    return total


def chandrasekhar_h(albedo: float, mu: np.ndarray) -> np.ndarray:
    """Compute H(mu) of an isotropically scattering half-space to 1e-9.

    Iterates 1 / H(mu) = sqrt(1 - omega) + omega / 2 int_0^1 x H(x) / (mu + x) dx, which converges
    also for the albedo 1 (Chandrasekhar 1950, section 38).
    """
    # docs/primer, eq. (2.8)
    x, weights = _quadrature()
    kernel = 0.5 * albedo * weights * x / (x[:, None] + x)
    h, floor = np.ones(POINTS), np.sqrt(max(1 - albedo, 0))
    for _ in range(10000):
        before, h = h, 1 / (floor + kernel @ h)
        # Successive iterates lie on both sides of the solution.
        h = np.sqrt(before * h)
        if np.abs(h / before - 1).max() < 1e-10:
            break
    return 1 / (floor + (0.5 * albedo * weights * x / (mu[:, None] + x)) @ h)


def _series(mu: np.ndarray, orders: int) -> list[np.ndarray]:
    """Compute the first ``orders`` coefficients of H(mu) as a power series in the albedo."""
    x, weights = _quadrature()
    places = np.concatenate([x, mu])
    kernel = 0.5 * weights * places[:, None] / np.maximum(places[:, None] + x, 1e-300)
    terms, integrals = [np.ones(len(places))], []
    for m in range(1, orders):
        integrals.append(kernel @ terms[-1][:POINTS])
        terms.append(sum(terms[i] * integrals[m - 1 - i] for i in range(m)))
    return [term[POINTS:] for term in terms]


def _quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Legendre nodes and weights on [0, 1], denser towards 0 by x = s^2."""
    s, weights = np.polynomial.legendre.leggauss(POINTS)
    s = 0.5 * (s + 1)
    return s**2, weights * s
