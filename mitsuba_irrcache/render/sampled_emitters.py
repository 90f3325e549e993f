"""The emitters that are sampled at the vertices of paths between surfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.sequences import kronecker
from mitsuba_irrcache.core.spectrum import luminance
from mitsuba_irrcache.lights.emitters import EmitterKind, EmittersByKind
from mitsuba_irrcache.transport.path import with_valid_direction

#: Luminance over its mean from which on a direction of an environment counts as a peak, which
#: casts shadows; samples of such an environment at each vertex.
PEAK, ENVIRONMENT_SAMPLES = 8.0, 8
#: Samples of emitters at each vertex, at most: if there are more emitters, each stands for several.
MOST_EMITTERS = 16


class SampledEmitters:
    """Emitters that are sampled at the vertices of paths: all but smooth environments.

    Of an environment with a peak, such as a sun in a sky map, only the excess over the luminance
    ``threshold`` is sampled; the remaining radiance is gathered along all directions. Each
    emitter has one sample, an environment with a peak `ENVIRONMENT_SAMPLES`; of more than
    `MOST_EMITTERS`, each sample stands for several.
    """

    def __init__(self, emitters: EmittersByKind) -> None:
        slots = [(emitter, 0.0, 1.0) for emitter, kind in emitters if not kind.is_environment]
        threshold = dr.inf
        for environment in emitters.of(EmitterKind.ENVIRONMENT_MAP):
            threshold = peak_threshold(environment)
            if threshold < dr.inf:
                share = 1 / ENVIRONMENT_SAMPLES
                slots += [(environment, k * share, share) for k in range(ENVIRONMENT_SAMPLES)]
        self.threshold = dr.opaque(mi.Float, threshold)
        environments = [emitter for emitter, kind in emitters if kind.is_environment]
        self._environment = mi.EmitterPtr(environments[0] if environments else None)
        dr.make_opaque(self._environment)
        #: whether rays can meet what is sampled
        self.have_extent = threshold < dr.inf or any(
            not (kind.is_environment or kind.has_one_direction or kind.is_point_like)
            for _, kind in emitters
        )
        #: samples at each vertex, and how many emitters one of them stands for
        self.count = dr.opaque(mi.UInt32, min(len(slots), MOST_EMITTERS))
        self.stride = dr.opaque(mi.Float, max(len(slots) / MOST_EMITTERS, 1))
        self._last = dr.opaque(mi.UInt32, max(len(slots) - 1, 0))
        self._emitters = dr.zeros(mi.EmitterPtr, max(len(slots), 1))
        for i, (emitter, *_) in enumerate(slots):
            dr.scatter(self._emitters, mi.EmitterPtr(emitter), mi.UInt32(i))
        self._first = mi.Float([first for _, first, _ in slots] or [0.0])
        self._share = mi.Float([share for *_, share in slots] or [1.0])
        dr.eval(self._emitters, self._first, self._share)

    def excess(self, emitter: mi.EmitterPtr, radiance: mi.Spectrum) -> mi.Float:
        """Return the share of the ``radiance`` of an emitter that is sampled."""
        peak = dr.maximum(1 - self.threshold / dr.maximum(luminance(radiance), 1e-30), 0)
        return dr.select(emitter == self._environment, peak, 1)

    def sample(
        self, number: mi.Float, vertex: mi.Interaction3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Sample a direction; return it with its radiance, without what is gathered, over its
        density.

        ``number`` is that of a sample, plus a random fraction, by which one emitter is chosen of
        those that it stands for.
        """
        number = dr.minimum(mi.UInt32(number * self.stride), self._last)
        emitter = dr.gather(mi.EmitterPtr, self._emitters, number, active)
        share = dr.gather(mi.Float, self._share, number, active) * self.stride
        first = dr.gather(mi.Float, self._first, number, active)
        u = mi.Point2f(u.x, first + u.y * dr.gather(mi.Float, self._share, number, active))
        record, value = emitter.sample_direction(vertex, u, active)
        record = with_valid_direction(record)
        return record, value * share * self.excess(emitter, value * record.pdf)


class EmitterSample:
    """Position in [0, 1)^2 on the first sampled emitter at a vertex, shifted by a golden-ratio
    sequence for further ones: backwards for the second one of an antithetic pair (``sign`` -1).
    """

    def __init__(self, u: mi.Point2f, sign: mi.Float | float = 1.0) -> None:
        self.u, self.sign = u, mi.Float(sign)

    def of(self, number: mi.UInt32) -> mi.Point2f:
        """Return the position on the emitter with this number."""
        u = self.u + self.sign * mi.Point2f(kronecker(number, 2))
        return u - dr.floor(u)


def peak_threshold(environment: mi.Emitter) -> float:
    """Return the luminance above which an environment is sampled; infinite without peaks."""
    u = np.random.default_rng(1).random((2, 1 << 14), dtype=np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, u.shape[1])
    si.wi = -mi.warp.square_to_uniform_sphere(mi.Point2f(u))
    mean = float(dr.mean(luminance(environment.eval(si)))[0])
    record, _ = environment.sample_direction(si, mi.Point2f(u))
    si.wi = -record.d
    highest = float(dr.max(luminance(environment.eval(si)))[0])
    return PEAK * mean if highest > PEAK * mean else dr.inf
