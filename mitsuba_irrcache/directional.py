"""Light by its direction, for media that do not scatter alike to all sides.

Beside the irradiance Phi a cache holds *moments* of the radiance then: its coefficients in
spherical harmonics from degree 1 on, and the irradiance from each *narrow* light (a sun, a lamp
nearby, a bright spot of the sky), whose direction is known and which spherical harmonics could not
tell. What is scattered into the direction of a ray is

    J = Phi / (4 pi) f,   Phi f = Phi + sum_lm 4 pi g_l Y_lm L_lm + sum_k (4 pi p_k - 1) E_k

where L_lm leaves out the light E_k of narrow lights. (Of lamps, which have a size, it does not, and
p_k is without the degrees that L_lm has: only what these lack is taken from one direction.) Phi is
what it is in isotropic media; the *factor* f is that of values interpolated alike, so that what is
noisy or dark weighs little.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .grid import Grid
from .layers import interleaved
from .phase import Phase

#: Half the angle that a lamp may take up to be narrow; larger ones are smooth enough.
WIDEST = float(np.deg2rad(35))
#: Half the angle within which light from something without a size is its own.
NARROWEST = 0.005
#: Half the angle of a bright spot of the sky; the share of the sky's light that makes it one
#: (even light would be 1/400); and how many there are at most.
SPOT, SPOT_SHARE, MOST_SPOTS = float(np.deg2rad(4)), 0.02, 4
#: Directions that are drawn to find these.
SPOT_SAMPLES = 1 << 16
#: Lamps that are told apart.
MOST_LAMPS = 8
#: Values in one load.
WIDTH = 4


class Source:
    """A narrow light: at ``place``, or, if ``far``, in the direction ``place``; ``size`` is its
    radius, or half its angle.
    """

    def __init__(self, place: np.ndarray, size: float, far: bool) -> None:
        self.far = far
        self._direction, self._cosine = np.array(place), np.cos(size)
        #: whether it is so narrow that nothing of its light has to be in the moments
        self.sharp = far or not size
        self.place = mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in place))
        self._size = dr.opaque(mi.Float, float(np.cos(size) if far else size))

    def seen_from(self, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
        """The direction to it, and the cosine of the angle within which light is its own: 2 where
        it is not narrow.
        """
        if self.far:
            return self.place, self._size
        way = self.place - mi.Vector3f(p)
        distance = dr.norm(way)
        sine = dr.maximum(self._size / distance, NARROWEST)
        cosine = dr.select(sine < float(np.sin(WIDEST)), dr.sqrt(1 - dr.square(sine)), 2)
        return way / distance, cosine

    def covers(self, directions: np.ndarray) -> np.ndarray:
        """Whether light from each of ``directions`` (..., 3) is its own; it is ``far``."""
        return directions @ self._direction >= self._cosine


class Directional:
    """What is to be known of the light's directions in a medium with the phase function
    ``phase``.
    """

    def __init__(self, phase: Phase, sources: list[Source]) -> None:
        self.phase, self.sources = phase, sources
        self.order = phase.order
        self._factors = [
            dr.opaque(mi.Float, float(4 * np.pi * phase.moments[degree]))
            for degree in range(1, self.order + 1)
            for _ in range(2 * degree + 1)
        ]

        self._degrees = [
            dr.opaque(mi.Float, float((2 * degree + 1) * phase.moments[degree]))
            for degree in range(1, self.order + 1)
        ]

    @property
    def count(self) -> int:
        """Moments per channel."""
        return len(self._factors) + len(self.sources)

    def moments(self, position: mi.Point3f, contributions: list[tuple]) -> list[mi.Spectrum]:
        """Of light that was found at ``position``: directions to where it comes from, with what
        comes from there uncollided and scattered, both as irradiance.
        """
        smooth = [mi.Spectrum(0)] * len(self._factors)
        narrow = [mi.Spectrum(0)] * len(self.sources)
        seen = [source.seen_from(position) for source in self.sources]
        for direction, uncollided, scattered in contributions:
            for k, (towards, cosine) in enumerate(seen):
                own = dr.dot(direction, towards) >= cosine
                narrow[k] = narrow[k] + dr.select(own, uncollided, 0)
                if self.sources[k].sharp:
                    uncollided = dr.select(own, 0, uncollided)
            basis = dr.sh_eval(direction, self.order)[1:]
            light = uncollided + scattered
            smooth = [m + y * light for m, y in zip(smooth, basis, strict=True)]
        return smooth + narrow

    def basis(self, direction: mi.Vector3f) -> list[mi.Float]:
        """What the smooth moments count for a ray along ``direction``."""
        values = dr.sh_eval(direction, self.order)[1:]
        return [factor * y for factor, y in zip(self._factors, values, strict=True)]

    def gains(self, p: mi.Point3f, direction: mi.Vector3f, active: mi.Bool) -> list[mi.Float]:
        """What the narrow lights count for a ray along ``direction`` at ``p``."""
        found = []
        for source in self.sources:
            towards, _ = source.seen_from(p)
            gain = self.phase.gain(p, direction, towards, active) - 1
            if not source.sharp:
                gain -= self._smooth(dr.dot(direction, towards))
            found.append(gain)
        return found

    def _smooth(self, cosine: mi.Float) -> mi.Float:
        """4 pi p - 1, as far as the moments tell."""
        before, legendre, result = mi.Float(1), cosine, mi.Float(0)
        for degree, moment in enumerate(self._degrees, 1):
            result += moment * legendre
            following = ((2 * degree + 1) * cosine * legendre - degree * before) / (degree + 1)
            before, legendre = legendre, following
        return result


class DirectionalField:
    """The factor f at all places. ``phi`` and ``moments`` are given per voxel; each list is one
    channel after the other.
    """

    def __init__(
        self, directional: Directional, grid: Grid, phi: list[mi.Float], moments: list[mi.Float]
    ) -> None:
        self.directional, self.grid, self.channels = directional, grid, len(phi)
        rows = []
        for c, irradiance in enumerate(phi):
            rows += [irradiance, *moments[c :: self.channels]]
        self._row = len(rows) // self.channels
        self._loads = -(-len(rows) // WIDTH)
        rows += [mi.Float(0)] * (self._loads * WIDTH - len(rows))
        self.data = interleaved(rows, grid.voxel_count)
        dr.eval(self.data)

    def factor(
        self, p: mi.Point3f, direction: mi.Vector3f, basis: list[mi.Float], active: mi.Bool
    ) -> mi.Float | mi.Color3f:
        """At ``p`` for a ray along ``direction``, for which ``basis`` is that of `Directional`."""
        directional = self.directional
        values = self._interpolated(self.grid.coordinates.point(p), active)
        weights = basis + directional.gains(p, direction, active)
        found = []
        for c in range(self.channels):
            phi, *moments = values[c * self._row : (c + 1) * self._row]
            extra = sum(w * m for w, m in zip(weights, moments, strict=True))
            ratio = dr.select(phi > 0, 1 + extra / dr.select(phi > 0, phi, 1), 1)
            # A sum of few moments can be negative, and noisy moments anything.
            found.append(dr.clip(ratio, 0, directional.phase.peak))
        return found[0] if self.channels == 1 else mi.Color3f(found)

    def _interpolated(self, u: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        """The values of a voxel, trilinear."""
        sums = [mi.Vector4f(0)] * self._loads
        for voxel, weight in self.grid.corners(u):
            for k in range(self._loads):
                values = dr.gather(mi.Vector4f, self.data, voxel * self._loads + k, active)
                sums[k] = dr.fma(weight, values, sums[k])
        return [value for packet in sums for value in packet]


def sources_of(scene: mi.Scene) -> list[Source]:
    """The narrow lights of a scene."""
    found, lamps = [], []
    for emitter in scene.emitters():
        flags = emitter.flags()
        if mi.has_flag(flags, mi.EmitterFlags.DeltaDirection):
            found.append(Source(_sampled(emitter).d.numpy().ravel(), NARROWEST, far=True))
        elif mi.has_flag(flags, mi.EmitterFlags.DeltaPosition):
            found.append(Source(_sampled(emitter).p.numpy().ravel(), 0.0, far=False))
        elif emitter.is_environment():
            found += _spots(emitter)
    for shape in scene.shapes():
        if shape.is_emitter():
            box = shape.bbox()
            radius = 0.5 * float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
            lamps.append(Source(np.array(box.center()).ravel(), radius, far=False))
    return found + lamps[:MOST_LAMPS]


def _sampled(emitter: mi.Emitter) -> mi.DirectionSample3f:
    record, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
    return record


def _spots(environment: mi.Emitter) -> list[Source]:
    """Bright spots of a sky: circles that a share of its light comes from."""
    rng = np.random.default_rng(3)
    samples = mi.Point2f(np.float32(rng.random((2, SPOT_SAMPLES))))
    record, light = environment.sample_direction(dr.zeros(mi.Interaction3f, SPOT_SAMPLES), samples)
    directions = np.array(record.d, dtype=np.float64)
    light = np.mean([np.broadcast_to(np.array(c), SPOT_SAMPLES) for c in light], axis=0)
    if not np.isfinite(light).all() or directions.shape != (3, SPOT_SAMPLES):
        return []
    total, found = light.sum(), []
    while len(found) < MOST_SPOTS:
        centre = _brightest(directions, light)
        own = centre @ directions >= np.cos(SPOT)
        if not light[own].sum() > SPOT_SHARE * total:
            break
        found.append(Source(centre, SPOT, far=True))
        light = np.where(own, 0, light)
    return found


def _brightest(directions: np.ndarray, light: np.ndarray) -> np.ndarray:
    """A direction about which much of the light is concentrated."""
    z = np.minimum((directions[2] + 1) * 18, 35).astype(int)
    turn = (np.arctan2(directions[1], directions[0]) / (2 * np.pi) % 1 * 72).astype(int) % 72
    cell = z * 72 + turn
    sums = np.bincount(cell, light)
    own = cell == sums.argmax()
    for _ in range(4):
        mean = directions[:, own] @ light[own]
        if not np.linalg.norm(mean) > 0:
            break
        centre = mean / np.linalg.norm(mean)
        own = centre @ directions >= np.cos(SPOT)
    else:
        return centre
    return np.array([0.0, 0.0, 1.0])
