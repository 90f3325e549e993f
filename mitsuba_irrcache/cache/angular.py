"""Angular moments of the radiance, for media with anisotropic scattering.

In addition to the irradiance Phi, the cache of such a medium stores *moments* of the radiance: its
spherical-harmonic coefficients L_lm for l >= 1, and the irradiance E_k from each *narrow* source (a
sun, a nearby lamp, a bright spot of the environment), whose direction is known and which spherical
harmonics of low order cannot represent. The radiance scattered towards the camera is

    J = Phi / (4 pi) f,   Phi f = Phi + sum_lm 4 pi g_l Y_lm L_lm + sum_k (4 pi p_k - 1) E_k

where g_l are the Legendre moments of the phase function, p_k is its value for scattering from
source k towards the camera, and L_lm excludes E_k. (For nearby lamps, L_lm includes E_k, and p_k
contains only the degrees above the order of L_lm, blurred by the emitter's extent.) Emitters whose
irradiance camera rays evaluate in closed form (`cache/direct_light`, `cache/area_light`) contribute
to neither Phi nor L_lm nor E_k here. Phi is interpolated as in isotropic media. The *factor* f is a
ratio of values interpolated in the same way, so that voxels with little irradiance have little
weight.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
from itertools import count, islice

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.lights.narrow_sources import Source
from mitsuba_irrcache.media.phase import Phase

#: Largest image error [%] times the square root of the number of directions, for media with a
#: forward peak in environments with bright spots; measured with g = 0.85, 16^3 data voxels, and
#: three spots that have 96 % of the irradiance.
NOISE_OF_SPOTS = 140.0
#: Legendre series are truncated behind the last coefficient larger than this.
NEGLIGIBLE_TERM = 1e-3
#: Maximum order of the moments of direct light, and magnitude below which moments of the phase
#: function are neglected for it. With 0.07, as for scattered radiance, errors next to an area
#: emitter are up to 7 % (g = 0.58); with 0.01 they are 0.5 %.
MAX_DIRECT_ORDER, MAX_DIRECT_TAIL = 8, 0.01


class Scattering(Enum):
    """What is scattered into a ray: all radiance; all but what a truncated forward peak scatters of
    narrow sources; or that alone.
    """

    ALL = "all"
    WITHOUT_PEAK = "without the forward peak"
    PEAK = "by the forward peak"


class AngularBasis:
    """Angular representation of the radiance in a medium with the phase function ``phase``."""

    # docs/primer, eq. (1.6)

    def __init__(
        self,
        phase: Phase,
        sources: Sequence[Source],
        others: Sequence[Source] = (),
        order: int | None = None,
    ) -> None:
        """``others`` are narrow sources that are neither part of the moments nor of E_k, because
        camera rays evaluate their irradiance in closed form. ``order`` of the spherical harmonics
        is `Phase.order` by default.
        """
        self.phase, self.sources, self.others = phase, sources, others
        self.order = phase.order if order is None else order
        #: largest ratio of the radiance scattered in a direction to its mean
        self.largest_ratio = dr.opaque(mi.Float, phase.peak)
        self._factors = [
            dr.opaque(mi.Float, float(4 * np.pi * phase.moments[degree]))
            for degree in range(1, self.order + 1)
            for _ in range(2 * degree + 1)
        ]

        self._degrees = [
            dr.opaque(mi.Float, float((2 * degree + 1) * phase.moments[degree]))
            for degree in range(1, self.order + 1)
        ]
        # Coefficients of the phase function, and the part that the moments do not represent.
        terms = 2 * np.arange(len(phase.all_moments)) + 1
        own = phase.all_moments * terms / (1 - phase.forward)
        rest = own - phase.moments * terms * (np.arange(len(own)) <= self.order)
        last = int(np.flatnonzero(np.abs(own) > NEGLIGIBLE_TERM)[-1]) + 1
        self._terms = [
            tuple(dr.opaque(mi.Float, float(v)) for v in pair)
            for pair in zip(own[:last], rest[:last], strict=True)
        ]

    @property
    def count(self) -> int:
        """Number of moments per channel."""
        return len(self._factors) + len(self.sources)

    def moments(self, position: mi.Point3f, contributions: list[tuple]) -> list[mi.Spectrum]:
        """Compute the moments of radiance samples at ``position``.

        ``contributions`` are tuples of the direction towards the origin of the radiance, and the
        uncollided and scattered parts of its irradiance. Returns L_lm for l >= 1, ordered by l and
        m, followed by E_k of the sources.
        """
        smooth = [mi.Spectrum(0)] * len(self._factors)
        narrow = [mi.Spectrum(0)] * len(self.sources)
        directions_and_cosines = [source.seen_from(position) for source in self.sources]
        for direction, uncollided, scattered in contributions:
            for k, (towards, cosine) in enumerate(directions_and_cosines):
                own = dr.dot(direction, towards) >= cosine
                narrow[k] = narrow[k] + dr.select(own, uncollided, 0)
                if self.sources[k].sharp:
                    uncollided = dr.select(own, 0, uncollided)
            basis = dr.sh_eval(direction, self.order)[1:]
            irradiance = uncollided + scattered
            smooth = [m + y * irradiance for m, y in zip(smooth, basis, strict=True)]
        return smooth + narrow

    def hits_source(
        self, origin: mi.Point3f, direction: mi.Vector3f, far: mi.Bool, near: mi.Bool
    ) -> mi.Bool:
        """Return whether rays hit a narrow source.

        ``far`` is the mask of rays that leave the scene, ``near`` of those that hit an emitter.
        """
        found = mi.Bool(False)
        for source in (*self.sources, *self.others):
            towards, cosine = source.seen_from(origin)
            found |= (far if source.far else near) & (dr.dot(direction, towards) >= cosine)
        return found

    def split_by_source(self, directions: np.ndarray, radiance: np.ndarray) -> list[np.ndarray]:
        """Separate the radiance of narrow distant sources.

        ``radiance`` (n, 2, channels) is incident along ``directions`` (n, 3) and their opposites.
        Returns arrays of this shape: the radiance that comes from none of the sources, followed by
        the radiance of each source (0 for sources that are not distant).
        """
        towards, parts = np.stack([-directions, directions], axis=1), []
        for source in self.sources:
            own = radiance * source.covers(towards)[..., None]
            radiance = radiance - own
            parts.append(own)
        return [radiance, *parts]

    def basis(self, direction: mi.Vector3f) -> list[mi.Float]:
        """Return the weights 4 pi g_l Y_lm of the moments L_lm for a ray along ``direction``."""
        values = dr.sh_eval(direction, self.order)[1:]
        return [factor * y for factor, y in zip(self._factors, values, strict=True)]

    def gain(
        self, p: mi.Point3f, direction: mi.Vector3f, towards: mi.Vector3f, with_peak: bool = True
    ) -> mi.Float:
        """Return the weight, relative to isotropic scattering, of radiance from the direction
        ``towards`` that is scattered at ``p`` into ``direction``: 4 pi times the phase function.

        Without ``with_peak`` scattering into a forward peak is excluded.
        """
        if with_peak or not self.phase.forward:
            return self.phase.gain(p, direction, towards)
        return 1 + self._smooth(dr.dot(direction, towards))

    def has_residual(self, with_peak: bool = True) -> bool:
        """Return whether moments up to `order` do not represent the phase function completely."""
        if self.phase.forward:
            return with_peak
        return self.phase.tail(self.order) > NEGLIGIBLE_TERM

    def residual_gain(
        self, p: mi.Point3f, direction: mi.Vector3f, towards: mi.Vector3f
    ) -> mi.Float:
        """Return the part of `gain` that moments up to `order` do not represent."""
        smooth = self._smooth(dr.dot(direction, towards))
        return self.phase.gain(p, direction, towards) - 1 - smooth

    def gains(
        self, p: mi.Point3f, direction: mi.Vector3f, active: mi.Bool, with_peak: bool = True
    ) -> list[mi.Float]:
        """Return the weights of the narrow sources for a ray along ``direction`` at ``p``.

        Without ``with_peak`` scattering into a forward peak is excluded.
        """
        found = []
        for source in self.sources:
            towards, _ = source.seen_from(p)
            cosine = dr.dot(direction, towards)
            if not with_peak and self.phase.forward:
                found.append(self._smooth(cosine) if source.sharp else mi.Float(0))
                continue
            gain = self.phase.gain(p, direction, towards, active)
            if source.wide:
                gain = self._blurred(gain, cosine, source.variance(p), source.sharp)
            found.append(gain - 1 if source.sharp else gain)
        return found

    def corrections(
        self, p: mi.Point3f, direction: mi.Vector3f, depths: list[mi.Float]
    ) -> list[mi.Float]:
        """Return the corrections of `gains` for multiple scattering into the forward peak.

        ``depths`` are, for each source, the mean number of such events between source and camera.
        """
        found = []
        for source, depth in zip(self.sources, depths, strict=True):
            towards, _ = source.seen_from(p)
            variance = source.variance(p) if source.wide else None
            cosine = dr.dot(direction, towards)
            found.append(self.phase.aureole.correction(cosine, depth, variance))
        return found

    def _blurred(
        self, gain: mi.Float, cosine: mi.Float, variance: mi.Float, whole: bool
    ) -> mi.Float:
        """Return 4 pi p averaged over a source, given the ``gain`` 4 pi p of its centre.

        ``variance`` is the mean square angle of the source's points from its centre, which
        attenuates degree l by exp(-l (l + 1) variance / 4). The part represented by the moments is
        excluded unless ``whole``.
        """
        result, series = mi.Float(0), blurred_polynomials(cosine, variance)
        for (own, rest), (legendre, attenuation) in zip(self._terms, series, strict=False):
            result += (own if whole else rest) * attenuation * legendre
            gain = gain - own * legendre
        _, attenuation = next(series)
        return dr.fma(gain, attenuation, result)

    def _smooth(self, cosine: mi.Float) -> mi.Float:
        """Evaluate the part of 4 pi p - 1 that the moments represent."""
        polynomials = islice(_legendre(cosine), 1, None)
        return sum(m * p for m, p in zip(self._degrees, polynomials, strict=False))


def blurred_polynomials(
    cosine: mi.Float, variance: mi.Float
) -> Iterator[tuple[mi.Float, mi.Float]]:
    """Generate the Legendre polynomials from degree 0 on, and the factor exp(-l (l + 1) v / 4) by
    which a source with the mean square angle v, the ``variance``, attenuates degree l.
    """
    attenuation, ratio, blur = mi.Float(1), mi.Float(1), dr.exp(-0.5 * variance)
    for polynomial in _legendre(cosine):
        yield polynomial, attenuation
        ratio = ratio * blur
        attenuation = attenuation * ratio


def _legendre(cosine: mi.Float) -> Iterator[mi.Float]:
    """Generate the Legendre polynomials from degree 0 on."""
    before, here = mi.Float(0), mi.Float(1)
    for degree in count():
        yield here
        before, here = here, ((2 * degree + 1) * cosine * here - degree * before) / (degree + 1)


def empty_sums(directional: AngularBasis | None) -> list[mi.Spectrum]:
    """Return zero sums, to which `with_radiance` adds."""
    moments = 0 if directional is None else directional.count
    return [mi.Spectrum(0) for _ in range(1 + moments)]


def with_radiance(
    sums: list[mi.Spectrum],
    position: mi.Point3f,
    towards: mi.Vector3f,
    uncollided: mi.Spectrum,
    scattered: mi.Spectrum,
    directional: AngularBasis | None,
) -> list[mi.Spectrum]:
    """Return ``sums`` plus the irradiance at ``position`` from direction ``towards``.

    ``sums`` are an irradiance and, for anisotropic media, the moments of `AngularBasis.moments`.
    ``uncollided`` and ``scattered`` are the parts of the irradiance to be added.
    """
    found = [uncollided + scattered]
    if directional is not None:
        found += directional.moments(position, [(towards, uncollided, scattered)])
    return [a + b for a, b in zip(sums, found, strict=True)]


def warn_of_noise(basis: AngularBasis, samples: int, name: str) -> None:
    """Log a warning if bright spots of an environment illuminate a medium with a forward peak.

    Radiance scattered out of the forward direction is then a small difference of large values, and
    noisy with ``samples`` directions.
    """
    if not basis.phase.forward or not any(source.is_spot for source in basis.sources):
        return
    mi.Log(
        mi.LogLevel.Warn,
        f"irrcache: {name} has a sharp forward peak, and the environment has bright spots: with "
        f"{samples} directions, radiance scattered sideways and backward has an error of up to "
        f"about {NOISE_OF_SPOTS / np.sqrt(samples):.0f} %. Raise cache_spp, or replace the spots "
        'of the environment map by "directional" emitters.',
    )


def warn_of_sharp_shadows(forward: float, name: str, reason: str) -> None:
    """Log a warning that scattering into the forward peak counts as unscattered on surfaces.

    ``forward`` is the share of the peak in the phase function, ``reason`` says why the irradiance
    of surfaces is not corrected for it. The irradiance is right on average over a surface, but not
    in shadows: under a cloud with g = 0.85 and a sun, blocks of pixels of the ground are up to 7 %
    of the image's mean too bright.
    """
    mi.Log(
        mi.LogLevel.Warn,
        f"irrcache: {name} scatters {forward:.0%} into a forward peak, which counts as unscattered "
        f"on the way from emitters to surfaces (delta-M), because {reason}: its shadows on "
        "surfaces are too bright in their middle, by several per cent. Use volpath where they "
        "matter.",
    )


def order_of_direct_light(phase: Phase) -> int:
    """Return the order of the moments for the radiance of emitters with extent.

    It is higher than for scattered radiance, which varies less with direction.
    """
    if phase.forward:
        return phase.order
    orders = range(phase.order, MAX_DIRECT_ORDER)
    return next((n for n in orders if phase.tail(n) <= MAX_DIRECT_TAIL), MAX_DIRECT_ORDER)
