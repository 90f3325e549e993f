"""Light by its direction, for media that do not scatter alike to all sides.

Beside the irradiance Phi a cache holds *moments* of the radiance then: its coefficients in
spherical harmonics from degree 1 on, and the irradiance from each *narrow* light (a sun, a lamp
nearby, a bright spot of the sky), whose direction is known and which spherical harmonics could not
tell. What is scattered into the direction of a ray is

    J = Phi / (4 pi) f,   Phi f = Phi + sum_lm 4 pi g_l Y_lm L_lm + sum_k (4 pi p_k - 1) E_k

where L_lm leaves out the light E_k of narrow lights. (Of lamps, which have a size, it does not, and
p_k is without the degrees that L_lm has: only what these lack is told by one direction, blurred as
the lamp's size has it.) Phi is what it is in isotropic media; the *factor* f is that of values
interpolated alike, so that what is noisy or dark weighs little.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, islice

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.core.sequences import GOLDEN_STEP, lattice_points
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.phase import Phase

#: Sine of half the angle that a lamp may take up to be told apart: one has to be beside it.
WIDEST = 0.95
#: Half the angle within which light from something without a size is its own.
NARROWEST = 0.005
#: Half the angle of a bright spot of the sky, at least and at most; the share of the sky's light
#: that makes it one (even light would be 1/400); and how many there are at most.
SPOT, WIDEST_SPOT, SPOT_SHARE, MOST_SPOTS = float(np.deg2rad(4)), float(np.deg2rad(12)), 0.02, 4
#: Of what a spot has within its widest circle it has this share in its own.
WHOLE_SPOT = 0.97
#: Half the angle of spots that are as good as points.
POINT_LIKE = float(np.deg2rad(1))
#: Directions that are drawn to find these, and the step from one to the next.
SPOT_SAMPLES = 1 << 16
#: Lamps that are told apart, and points of each that tell how it lies.
MOST_LAMPS, POINTS = 8, 1024
#: Terms of a series of Legendre polynomials that are left out beyond the last one larger than this.
NO_TERM = 1e-3
#: A distance, or its square, that is not 0.
TINY = 1e-30
#: Values in one load.
WIDTH = 4


class Source:
    """A narrow light: at ``place``, or, if ``far``, in the direction ``place``; ``size`` is its
    radius, or half its angle. ``spread`` is the covariance (3, 3) of the points of a lamp, or a
    spot's mean square angle (None: as good as a point).
    """

    def __init__(
        self, place: np.ndarray, size: float, far: bool, spread: np.ndarray | float | None = None
    ) -> None:
        self.far = far
        #: whether it is so wide that it has to be told from a point
        self.wide = spread is not None
        self._direction, self._cosine = np.array(place), np.cos(size)
        #: whether it is so narrow that nothing of its light has to be in the moments
        self.sharp = far or not size
        self.place = mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in place))
        self._size = dr.opaque(mi.Float, float(np.cos(size) if far else size))
        if self.wide and far:
            self._variance = dr.opaque(mi.Float, float(spread))
        elif self.wide:
            rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in spread]
            self._covariance = [mi.Vector3f(*row) for row in rows]

    def seen_from(self, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
        """The direction to it, and the cosine of the angle within which light is its own: 2 where
        it is not narrow.
        """
        if self.far:
            return self.place, self._size
        way = self.place - mi.Vector3f(p)
        distance = dr.maximum(dr.norm(way), TINY)
        sine = dr.maximum(self._size / distance, NARROWEST)
        cosine = dr.select(sine < WIDEST, dr.sqrt(1 - dr.square(sine)), 2)
        return way / distance, cosine

    def variance(self, p: mi.Point3f) -> mi.Float:
        """The mean square of the angles from its middle to its points, as seen from ``p``."""
        if self.far:
            return self._variance
        way = self.place - mi.Vector3f(p)
        inverse = dr.rcp(dr.maximum(dr.squared_norm(way), TINY))
        along = sum(w * dr.dot(row, way) for w, row in zip(way, self._covariance, strict=True))
        total = sum(row[i] for i, row in enumerate(self._covariance))
        return dr.maximum(total - along * inverse, 0) * inverse

    def covers(self, directions: np.ndarray) -> np.ndarray:
        """Whether light from each of ``directions`` (..., 3) is its own, if it is ``far``."""
        return (directions @ self._direction >= self._cosine) & self.far


class AngularBasis:
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
        # Those of the phase function itself; and less what the moments tell.
        terms = 2 * np.arange(len(phase.all_moments)) + 1
        own = phase.all_moments * terms / (1 - phase.forward)
        rest = own - phase.moments * terms * (np.arange(len(own)) <= self.order)
        last = int(np.flatnonzero(np.abs(own) > NO_TERM)[-1]) + 1
        self._terms = [
            tuple(dr.opaque(mi.Float, float(v)) for v in pair)
            for pair in zip(own[:last], rest[:last], strict=True)
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

    def shines(
        self, origin: mi.Point3f, direction: mi.Vector3f, far: mi.Bool, near: mi.Bool
    ) -> mi.Bool:
        """Whether a narrow light is what is met along rays, those that meet something ``far`` away,
        or an emitter ``near``.
        """
        found = mi.Bool(False)
        for source in self.sources:
            towards, cosine = source.seen_from(origin)
            found |= (far if source.far else near) & (dr.dot(direction, towards) >= cosine)
        return found

    def apart(self, directions: np.ndarray, light: np.ndarray) -> list[np.ndarray]:
        """Of ``light`` (n, 2, channels) along ``directions`` (n, 3) and their opposites what is not
        of narrow lights far away, then that of each (0 for others).
        """
        towards, parts = np.stack([-directions, directions], axis=1), []
        for source in self.sources:
            own = light * source.covers(towards)[..., None]
            light = light - own
            parts.append(own)
        return [light, *parts]

    def basis(self, direction: mi.Vector3f) -> list[mi.Float]:
        """What the smooth moments count for a ray along ``direction``."""
        values = dr.sh_eval(direction, self.order)[1:]
        return [factor * y for factor, y in zip(self._factors, values, strict=True)]

    def gains(
        self, p: mi.Point3f, direction: mi.Vector3f, active: mi.Bool, with_peak: bool = True
    ) -> list[mi.Float]:
        """What the narrow lights count for a ray along ``direction`` at ``p``; without a forward
        peak, if wanted, light in which counts as not scattered.
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

    def _blurred(
        self, gain: mi.Float, cosine: mi.Float, variance: mi.Float, whole: bool
    ) -> mi.Float:
        """4 pi p of a light whose angles have this ``variance``, where its middle has ``gain``:
        being as wide takes exp(-l (l + 1) variance / 4) of degree l. Without what the moments tell,
        unless the ``whole`` of it is wanted.
        """
        result, left, ratio = mi.Float(0), mi.Float(1), mi.Float(1)
        blur = dr.exp(-0.5 * variance)
        for legendre, (own, rest) in zip(_legendre(cosine), self._terms, strict=False):
            result += (own if whole else rest) * left * legendre
            gain = gain - own * legendre
            ratio *= blur
            left *= ratio
        return dr.fma(gain, left, result)

    def _smooth(self, cosine: mi.Float) -> mi.Float:
        """4 pi p - 1, as far as the moments tell."""
        polynomials = islice(_legendre(cosine), 1, None)
        return sum(m * p for m, p in zip(self._degrees, polynomials, strict=False))


def _legendre(cosine: mi.Float) -> Iterator[mi.Float]:
    """Legendre's polynomials, from degree 0 on."""
    before, here = mi.Float(0), mi.Float(1)
    for degree in count():
        yield here
        before, here = here, ((2 * degree + 1) * cosine * here - degree * before) / (degree + 1)


def nothing(directional: AngularBasis | None) -> list[mi.Spectrum]:
    """Sums of light, as `added` has them, 0 so far."""
    moments = 0 if directional is None else directional.count
    return [mi.Spectrum(0) for _ in range(1 + moments)]


def added(
    sums: list[mi.Spectrum],
    position: mi.Point3f,
    towards: mi.Vector3f,
    uncollided: mi.Spectrum,
    scattered: mi.Spectrum,
    directional: AngularBasis | None,
) -> list[mi.Spectrum]:
    """``sums``, an irradiance and its `AngularBasis.moments` if it has any, with the light that
    comes to ``position`` from one direction.
    """
    found = [uncollided + scattered]
    if directional is not None:
        found += directional.moments(position, [(towards, uncollided, scattered)])
    return [a + b for a, b in zip(sums, found, strict=True)]


class AngularField:
    """The factor f at all places. ``phi`` and ``moments`` are given per voxel; each list is one
    channel after the other.
    """

    def __init__(
        self, directional: AngularBasis, grid: Grid, phi: list[mi.Float], moments: list[mi.Float]
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
        self,
        p: mi.Point3f,
        direction: mi.Vector3f,
        basis: list[mi.Float],
        active: mi.Bool,
        with_peak: bool = True,
    ) -> mi.Float | mi.Color3f:
        """At ``p`` for a ray along ``direction``, for which ``basis`` is that of `AngularBasis`;
        ``with_peak`` is as of its `gains`.
        """
        directional = self.directional
        values = self._interpolated(self.grid.coordinates.point(p), active)
        weights = basis + directional.gains(p, direction, active, with_peak)
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
            found += spots_of(emitter)[0]
    for shape in scene.shapes():
        if shape.is_emitter():
            lamps.append(_lamp(shape))
    return found + lamps[:MOST_LAMPS]


def _lamp(shape: mi.Shape) -> Source:
    box, rng = shape.bbox(), np.random.default_rng(POINTS)
    radius = 0.5 * float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
    points = shape.sample_position(0.0, mi.Point2f(np.float32(rng.random((2, POINTS))))).p
    covariance = np.cov(np.array(points, dtype=np.float64))
    return Source(np.array(box.center()).ravel(), radius, False, covariance)


def _sampled(emitter: mi.Emitter) -> mi.DirectionSample3f:
    record, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
    return record


def spots_of(environment: mi.Emitter) -> tuple[list[Source], np.ndarray]:
    """Bright spots of a sky: circles that a share of its light comes from. And the irradiance
    (1 + n, channels) that comes from beside all of them, and from each.
    """
    rng = np.random.default_rng(3)
    even = lattice_points(SPOT_SAMPLES, GOLDEN_STEP)
    samples = mi.Point2f(np.float32((even + rng.random((2, 1))) % 1))
    record, colours = environment.sample_direction(
        dr.zeros(mi.Interaction3f, SPOT_SAMPLES), samples
    )
    directions = np.array(record.d, dtype=np.float64)
    colours = np.stack([np.broadcast_to(np.array(c), SPOT_SAMPLES) for c in colours])
    light = colours.mean(axis=0)
    if not np.isfinite(light).all() or directions.shape != (3, SPOT_SAMPLES):
        return [], np.full((1, len(colours)), np.nan)
    total, found, numbers = light.sum(), [], np.zeros(SPOT_SAMPLES, int)
    while len(found) < MOST_SPOTS:
        centre = _brightest(directions, light)
        own = centre @ directions >= np.cos(SPOT)
        if not light[own].sum() > SPOT_SHARE * total:
            break
        size, variance = _extent(np.arccos(np.clip(centre @ directions, -1, 1)), light)
        found.append(Source(centre, size, True, variance if variance > POINT_LIKE**2 else None))
        own = (light > 0) & (centre @ directions >= np.cos(size))
        light, numbers[own] = np.where(own, 0, light), len(found)
    shares = [colours[:, numbers == k].sum(axis=1) for k in range(1 + len(found))]
    return found, np.array(shares, dtype=np.float64) / SPOT_SAMPLES


def _extent(angles: np.ndarray, light: np.ndarray) -> tuple[float, float]:
    """Half the angle of a spot, given the ``light`` at ``angles`` from its middle, and the mean
    square angle in it. What shines around it is not its own.
    """
    circle = 1 - np.cos(WIDEST_SPOT)
    around = (angles > WIDEST_SPOT) & (angles < 1.5 * WIDEST_SPOT)
    level = light[around].sum() / (np.cos(WIDEST_SPOT) - np.cos(1.5 * WIDEST_SPOT))
    order = np.argsort(angles)
    order = order[angles[order] <= WIDEST_SPOT]
    own = np.cumsum(light[order]) - level * (1 - np.cos(angles[order]))
    whole = own >= WHOLE_SPOT * (light[order].sum() - level * circle)
    size = max(SPOT, float(angles[order][whole.argmax()])) if whole.any() else SPOT
    within = angles <= size
    return size, float((light[within] * angles[within] ** 2).sum() / light[within].sum())


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
