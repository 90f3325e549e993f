"""Irradiance from distant emitters (suns and environments), and additional ordinates for them.

Suns have separate ordinates. An environment map with angular detail is sampled in proportion to its
luminance, in addition to the uniformly distributed (*even*) ordinates (balance heuristic, Veach and
Guibas 1995). Without detail the even ordinates alone have a smaller error, because their weights
integrate smooth functions well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.core.sequences import kronecker_steps, lattice_points
from mitsuba_irrcache.errors import UnsupportedSceneError
from mitsuba_irrcache.lights.emitters import EmitterKind, illuminating, kind_of
from mitsuba_irrcache.lights.environments import (
    environment_radiance,
    even_radiance,
    exceeds_even_ordinates,
    is_smooth,
    is_uneven,
    monomials,
    powers,
)
from mitsuba_irrcache.lights.narrow_sources import is_bright, spots_of
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import (
    Ordinates,
    joint_ordinates,
    strata,
)
from mitsuba_irrcache.transport.tracking import medium_transmittance

#: Maximum degree of the moments of environments that are matched, the smallest factor by which the
#: irradiance along an ordinate is multiplied for that, and the error of a moment, over the
#: irradiance, above which the degree is lower.
MATCHED_DEGREE, SMALLEST_FACTOR, INEXACT = 3, 0.25, 1e-4
#: Share of the irradiance of an environment that surfaces must not occlude for its moments to be
#: matched.
LEAST_VISIBLE = 0.2
#: Numbers of further even ordinates, per ordinate of a pass, along which only radiance of the
#: environment enters, and variations above which they are used. The variation is the standard
#: deviation, between positions in the medium, of the environment's irradiance per direction, over
#: its mean irradiance. Where surfaces occlude the environment from some of the voxels that an
#: ordinate passes, few ordinates give slabs of voxels too much or too little irradiance.
#: Where scattering is anisotropic, the least number is used in any environment that is not uniform
#: or is partly occluded: with a ground and a sky, radiance scattered backwards by g = 0.85 had a
#: noise of 7.5 % in parts of the image without them, and has one of 1 %.
ANISOTROPIC_FURTHER = (0.4, 15), (0.1, 7), (0.0, 3)
#: The same for isotropic scattering, which has less noise, and more of it from the radiance between
#: voxels: around a ball or below an arch, 15 times as many ordinates have the noise of 3 times as
#: many, in three times the time. A room with a small window (variation 4.9) has half the noise.
#: There are none where little is occluded: radiance of surfaces does not enter along them, so that
#: under a uniform sky above white ground dense voxels would have an error of 2.5 instead of 0.5 %.
ISOTROPIC_FURTHER = (3.5, 15), (0.6, 3)
#: Number of directions that are sampled to find moments.
SAMPLES = 1 << 14
#: Step of the second coordinate of lattices of points.
STEP = kronecker_steps(2)[0]
#: Number of pairs of ordinates of a pass per set of tracks of a sun.
PAIRS_PER_SUN_TRACKS = 8
#: Number of directions sampled from an environment map, per pair of ordinates of a pass: few where
#: each of them is expensive, if the map has bright regions; many for isolated media, if the map has
#: angular detail. Their number is smaller for single scattering, whose default number of ordinates
#: is twice as large, and for anisotropic scattering, where each of them costs more time. Under a
#: bright window a dense ball has a noise of 2.7 % with few samples, and of 1 % with many, in twice
#: the time (experiments/validation/maps).
FEW_SAMPLES, SEVERAL_SAMPLES, MANY_SAMPLES = 0.5, 2.0, 4.0


def samples_in_isolated_media(max_depth: int, is_isotropic: bool) -> tuple[float, bool]:
    """Return the number of directions per pair of ordinates that are sampled for isolated media,
    and whether only maps with bright regions are sampled: in other maps, moments are less noisy
    with even ordinates alone.
    """
    samples = SEVERAL_SAMPLES if max_depth == 2 or not is_isotropic else MANY_SAMPLES
    return samples, not is_isotropic


class DistantIllumination:
    """Distant emitters of a scene: an environment, and suns (infinitely distant, one direction).

    Point-like emitters are listed in ``point_lights``; they and area emitters are sampled by other
    modules. Raises UnsupportedSceneError for an emitter of any other kind, which would be ignored.
    """

    def __init__(
        self,
        scene: mi.Scene,
        has_other_sources: bool = False,
        samples: float = FEW_SAMPLES,
        only_bright: bool = True,
        is_isotropic: bool = True,
    ) -> None:
        """``has_other_sources`` states that the medium emits, possibly with another colour.
        ``samples`` is the number of directions that are sampled from an environment map, per pair
        of ordinates; with ``only_bright``, maps without bright regions are not sampled.
        ``is_isotropic`` states that the medium scatters isotropically.
        """
        self._is_isotropic = is_isotropic
        self._has_other_sources = has_other_sources
        self._environment = scene.environment()
        self._samples_per_pair = samples if self._is_sampled(only_bright) else 0.0
        self._bright_regions: tuple | None = None
        self._exact_moments: np.ndarray | None = None
        #: see `ANISOTROPIC_FURTHER`
        self._further = 0
        self._suns, self.point_lights = [], []
        for emitter in illuminating(scene):
            kind = kind_of(emitter)
            if kind is EmitterKind.SUN:
                self._suns.append(_sun(emitter))
            elif kind.is_point_like:
                self.point_lights.append(emitter)
            elif not kind.is_environment and kind is not EmitterKind.AREA:
                raise UnsupportedSceneError(
                    f'irrcache: emitter "{emitter.id()}" ({emitter.class_name()}) is of a kind '
                    f'({kind.value}) that the solver "sweep" does not support; set solver to '
                    '"path" or "auto".'
                )

    def factored_ordinates(
        self, passes: int, pairs: int, channels: int, rng: np.random.Generator, first: int = 0
    ) -> tuple[list[Ordinates], np.ndarray]:
        """Return the ordinates of all passes, and factors (channels) of their results.

        If ``first`` is not 0, there is an additional first pass with ``first`` pairs. If the
        channels of the incoming irradiance differ by a factor only, ``incoming`` has a single
        channel; otherwise all factors are 1.
        """
        sets = self.ordinates(1, first, rng) if first else []
        sets += self.ordinates(passes, pairs, rng)
        incoming = np.concatenate([each.incoming for each in sets])
        brightest = incoming.max(axis=(0, 1))
        colour = brightest / brightest.max() if brightest.max() > 0 else np.ones(channels)
        difference = np.abs(incoming - incoming.max(axis=-1, keepdims=True) * colour)
        has_others = self.point_lights or self._has_other_sources
        if not has_others and difference.max() <= 1e-6 * incoming.max():
            single = [each.incoming.max(axis=-1, keepdims=True) for each in sets]
            factored = zip(sets, single, strict=True)
            return [each._replace(incoming=grey) for each, grey in factored], colour
        return sets, np.ones(channels)

    def ordinates(
        self,
        passes: int,
        pairs: int,
        rng: np.random.Generator,
        visible_share: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> list[Ordinates]:
        """Return the ordinates of each pass: an even set, along which voxels emit and scatter, too,
        followed by the ordinates that only emitters use.

        ``visible_share`` returns, for each direction (n, 3) towards the environment, the share of
        the medium from which the environment is visible there; None: all of it.
        """
        exact = None
        if self._environment is not None:
            exact = self._moments(visible_share)
        even = self._even(passes, pairs, rng)
        if self._samples_per_pair:
            found = self._with_samples(even, max(1, int(pairs * self._samples_per_pair)), rng)
        else:
            found = [
                (directions, weights, self._even_irradiance(directions, solid_angles))
                for directions, weights, solid_angles in even
            ]
        if exact is not None:
            self._match_moments(found, exact, visible_share)
        return [self._with_suns(pairs, *own, rng) for own in found]

    def _even(
        self, passes: int, pairs: int, rng: np.random.Generator
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return the directions of the even ordinates of each pass, their weights for the radiance
        of voxels, which is 0 for the further ones, and those for the environment.
        """
        sets = [(*own, own[1]) for own in joint_ordinates(passes, pairs, rng, self.axis)]
        if not self._further:
            return sets
        share, more = 1 / (1 + self._further), []
        further = joint_ordinates(passes, self._further * pairs, rng)
        for (directions, weights, _), (others, angles) in zip(sets, further, strict=True):
            parts = (
                (directions, others),
                (weights, np.zeros(len(others))),
                (share * weights, (1 - share) * angles),
            )
            more.append(tuple(np.concatenate(part) for part in parts))
        return more

    @property
    def axis(self) -> np.ndarray | None:
        """Direction (3) of the brightest sun, around which ordinates of a medium that scatters
        anisotropically are arranged; None without suns.
        """
        if self._is_isotropic or not self._suns:
            return None
        direction, _ = max(self._suns, key=lambda sun: sun[1].sum())
        return direction

    @property
    def sun_count(self) -> int:
        """Number of suns."""
        return len(self._suns)

    def sun_pairs(self, pairs: int) -> int:
        """Return how many pairs of ordinates of a pass, the last ones, belong to suns."""
        return len(self._suns) * self._tracks_per_sun(pairs)

    def point_irradiance(
        self, medium: MediumGrid, position: mi.Point3f, known: Sequence[DirectLight] = ()
    ) -> list[mi.Spectrum]:
        """Return the irradiance at ``position`` from each point-like emitter, taken from ``known``
        if the emitter is among these direct lights.
        """
        values = {id(light.emitter): light.irradiance for light in known}
        return [
            values[id(e)] if id(e) in values else _from_point(e, medium, position)
            for e in self.point_lights
        ]

    def _is_sampled(self, only_bright: bool) -> bool:
        """Return whether directions are sampled from the environment."""
        environment = self._environment
        if not is_uneven(environment):
            return False
        return not is_smooth(environment) if only_bright else exceeds_even_ordinates(environment)

    def _even_irradiance(self, directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the irradiance (n, 2, channels) of an environment along even ordinates, 0 without
        an environment.
        """
        if self._environment is None:
            return np.zeros((len(directions), 2, dr.size_v(mi.Spectrum)))
        return self._both_ways(directions) * weights[:, None, None]

    def _with_suns(
        self,
        pairs: int,
        directions: np.ndarray,
        weights: np.ndarray,
        incoming: np.ndarray,
        rng: np.random.Generator,
    ) -> Ordinates:
        """Append several sets of tracks in the direction of each sun to these ordinates."""
        colours, parts = dr.size_v(mi.Spectrum), [(directions, incoming, weights)]
        count = self._tracks_per_sun(pairs)
        for direction, irradiance in self._suns:
            ways = np.stack([irradiance / count, np.zeros(colours)])
            parts.append(
                (np.tile(direction, (count, 1)), np.tile(ways, (count, 1, 1)), count * [0])
            )
        joined = [np.concatenate(part) for part in zip(*parts, strict=True)]
        offsets = rng.random((len(joined[0]), 2))
        for k in range(len(self._suns)):
            # The last ordinates: tracks of one direction are evenly spread over the voxels.
            end = len(offsets) - k * count
            offsets[end - count : end] = (offsets[end - 1] + lattice_points(count, STEP).T) % 1
        return Ordinates(*joined, offsets)

    def _tracks_per_sun(self, pairs: int) -> int:
        return max(1, pairs // PAIRS_PER_SUN_TRACKS)

    def _with_samples(
        self, even: list[tuple], count: int, rng: np.random.Generator
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Add ``count`` directions sampled from the environment to the ``even`` ordinates of each
        pass; return directions, weights, and the irradiance along all of them.

        A direction may result from either strategy, and as the opposite of a sampled one: the solid
        angle that it represents is one over the sum of all densities (balance heuristic).
        """
        # docs/primer, eq. (4.2)
        sets = []
        chosen = self._samples(len(even), count, rng)
        for (plain, weights, solid_angles), sampled in zip(even, chosen, strict=True):
            directions, none = np.concatenate([plain, sampled]), np.zeros(count)
            weights = np.concatenate([weights, none])
            angle = self._represented(directions, np.concatenate([solid_angles, none]))
            incoming = self._both_ways(directions) * angle[:, None, None]
            sets.append((directions, weights, incoming))
        self._normalise_regions(sets)
        return sets

    def _represented(self, directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the solid angles (n) that even ordinates and sampled ones, whose weight is 0,
        represent.
        """
        is_even = weights != 0
        count, sampled = int(is_even.sum()), int((~is_even).sum())
        if not sampled:
            return weights
        uniform = count / (2 * np.pi)
        angle = 1 / (uniform + sampled * self._densities(directions).sum(axis=1))
        return np.where(is_even, angle * weights * uniform, angle)

    def solid_angles(self, ordinates: Ordinates) -> np.ndarray:
        """Return the solid angles (n, 2, channels) by which the radiance of the environment along
        ``ordinates`` (without those of suns) and their opposites is multiplied.

        In bright regions they follow from the irradiance, which is normalised there. Elsewhere they
        do not depend on the radiance, which may be 0; the factors of `_match_moments` do.
        """
        directions, incoming, weights, _ = ordinates
        angle = np.broadcast_to(
            self._represented(directions, weights)[:, None, None], incoming.shape
        )
        if not (weights == 0).any():
            return angle
        radiance = self._both_ways(directions)
        known = radiance > 0
        scaled = np.where(known, incoming / np.where(known, radiance, 1), 0)
        scaled = np.where(known, scaled, scaled.max(axis=-1, keepdims=True))
        is_normalised = self._numbers_of_regions(directions)[..., None] > 0
        return np.where(is_normalised & (scaled > 0), scaled, angle)

    def _numbers_of_regions(self, directions: np.ndarray) -> np.ndarray:
        """Return the number of the bright region of each of ``directions`` and their opposites
        (n, 2): from 1 on those of spots, then that of all other bright directions, 0 elsewhere.
        """
        regions, _ = self._regions()
        towards = np.stack([-directions, directions], axis=1)
        number = np.zeros(towards.shape[:2], int)
        for k, region in enumerate(regions, 1):
            number[(number == 0) & region.covers(towards)] = k
        number[(number == 0) & is_bright(self._densities(directions))] = 1 + len(regions)
        return number

    def _regions(self) -> tuple:
        if self._bright_regions is None:
            self._bright_regions = spots_of(self._environment)
        return self._bright_regions

    def _normalise_regions(self, sets: list[tuple]) -> None:
        """Scale the sampled irradiance of each bright region, and of all else, to its exact value.

        The number of directions that hit a region is random. Bright directions outside of the spots
        are scaled separately from dark ones, which would otherwise compensate for a random excess
        or lack of bright ones. If no direction outside of the spots is bright, that irradiance is
        assigned to the spots, which are most likely close to it.
        """
        regions, irradiance = self._regions()
        numbers = [self._numbers_of_regions(directions) for directions, *_ in sets]
        if not any((number == 1 + len(regions)).any() for number in numbers):
            first = 1 if regions else 0
            remaining, others = irradiance[-1], irradiance[first:-1]
            total = others.sum(axis=0)
            irradiance = irradiance[:-1].copy()
            irradiance[first:] *= 1 + remaining / np.where(total > 0, total, np.inf)
        for k, exact in enumerate(irradiance):
            own = [incoming[n == k] for (*_, incoming), n in zip(sets, numbers, strict=True)]
            found = np.concatenate(own).sum(axis=0) / len(sets)
            known = (found > 0) & np.isfinite(exact)
            factor = np.where(known, exact / np.where(known, found, 1), 1)
            for (*_, incoming), number in zip(sets, numbers, strict=True):
                incoming[number == k] *= factor

    def _match_moments(
        self, sets: list[tuple], exact: np.ndarray, visible_share: Callable | None
    ) -> None:
        """Scale the irradiance along the ordinates outside of bright regions such that all of them
        together have the ``exact`` moments of the environment there, as far as it is visible.

        Few ordinates miss parts of an uneven environment. That matters most where little of it is
        scattered towards the camera: with g = 0.5 and a sky that is black below, single scattering
        of light from behind the camera had a noise of 4 % with 64 directions, now 0.5 %.
        """
        # docs/primer, below eq. (4.2)
        masks, towards = [], []
        for directions, *_ in sets:
            both = np.stack([-directions, directions], axis=1)
            number = self._numbers_of_regions(directions) if self._samples_per_pair else 0
            masks.append(np.broadcast_to(number == 0, both.shape[:2]))
            towards.append(both[masks[-1]])
        towards = np.concatenate(towards)
        irradiance = np.concatenate(
            [incoming[mask] for (*_, incoming), mask in zip(sets, masks, strict=True)]
        )
        irradiance = irradiance / len(sets)
        if visible_share is not None:
            irradiance = irradiance * visible_share(towards)[:, None]
        factors = _matching_factors(monomials(towards, MATCHED_DEGREE), irradiance, exact)
        for (*_, incoming), mask in zip(sets, masks, strict=True):
            own, factors = np.split(factors, [mask.sum()])
            incoming[mask] *= own

    def _moments(self, visible_share: Callable | None) -> np.ndarray | None:
        """Return the integrals (m, channels) of the radiance of the environment outside of bright
        regions, as far as it is visible, times the m `monomials` of the direction that it comes
        from; None if ordinates are not to be scaled: they integrate uniform radiance exactly, and
        what is visible through small openings differs from place to place. Finds the number of
        further ordinates, too.
        """
        if self._exact_moments is None:
            if self._samples_per_pair:
                towards, values = self._sampled_radiance()
            else:
                directions, radiance = even_radiance(self._environment)
                towards, values = -directions, 4 * np.pi * radiance
            share, total = np.ones(len(towards)), values.sum()
            if visible_share is not None:
                share = visible_share(towards)
                variation = _variation(share, values.mean(axis=1))
                values = values * share[:, None]
            is_needed = is_uneven(self._environment) or share.min() < 1
            if visible_share is not None and is_needed:
                self._further = _further_ordinates(variation, self._is_isotropic)
            if is_needed and values.sum() > LEAST_VISIBLE * total:
                moments = monomials(towards, MATCHED_DEGREE).T @ values / len(towards)
            else:
                moments = np.zeros((0, 0))
            self._exact_moments = moments
        return self._exact_moments if self._exact_moments.size else None

    def _sampled_radiance(self) -> tuple[np.ndarray, np.ndarray]:
        """Sample the environment; return directions (n, 3) towards it, and their radiance over the
        density (n, channels), 0 in bright regions.
        """
        points = mi.Point2f(np.float32(lattice_points(SAMPLES, STEP)))
        record, weight = self._environment.sample_direction(
            dr.zeros(mi.Interaction3f, SAMPLES), points
        )
        towards = np.array(record.d, dtype=np.float64).T
        regions, _ = self._regions()
        counted = ~is_bright(np.array(record.pdf))
        for region in regions:
            counted &= ~region.covers(towards)
        return towards, _values(weight, SAMPLES) * counted[:, None]

    def _both_ways(self, directions: np.ndarray) -> np.ndarray:
        """Return the radiance (n, 2, channels) along ``directions`` and their opposites."""
        both = [environment_radiance(self._environment, s * directions) for s in (1, -1)]
        return np.stack(both, axis=1)

    def _samples(self, sets: int, count: int, rng: np.random.Generator) -> list[np.ndarray]:
        """Sample sets of directions (n, 3) from the environment; the union of the sets is
        stratified, too.
        """
        points = lattice_points(sets * count, STEP)
        members = strata(sets, points[1], STEP)
        samples = ((points + rng.random((2, 1))) % 1).astype(np.float32)
        record, _ = self._environment.sample_direction(
            dr.zeros(mi.Interaction3f, sets * count), mi.Point2f(samples)
        )
        directions = -np.array(record.d, dtype=np.float64).T
        return [directions[own] for own in members]

    def _densities(self, directions: np.ndarray) -> np.ndarray:
        """Return the densities (n, 2) [1/sr] with which the environment samples ``directions`` and
        their opposites.
        """
        found = []
        for sign in (1, -1):
            record = dr.zeros(mi.DirectionSample3f, len(directions))
            record.d = mi.Vector3f((-sign * directions).T.astype(np.float32))
            at = dr.zeros(mi.Interaction3f, len(directions))
            density = np.array(self._environment.pdf_direction(at, record), dtype=np.float64)
            found.append(np.broadcast_to(density, len(directions)))
        return np.stack(found, axis=1)


def _variation(share: np.ndarray, values: np.ndarray) -> float:
    """Return the variation at `ANISOTROPIC_FURTHER`, given the ``share`` (n) of the medium
    from which radiance of the environment is visible in each direction, and its ``values`` (n).
    """
    visible = (values * share).sum()
    deviation = (values * np.sqrt(share * (1 - share))).sum()
    return float(deviation / visible) if visible > 0 else 0.0


def _further_ordinates(variation: float, is_isotropic: bool) -> int:
    """Return the number of further ordinates, see `ANISOTROPIC_FURTHER`."""
    levels = ISOTROPIC_FURTHER if is_isotropic else ANISOTROPIC_FURTHER
    return next((count for above, count in levels if variation >= above), 0)


def _matching_factors(
    polynomials: np.ndarray, irradiance: np.ndarray, exact: np.ndarray
) -> np.ndarray:
    """Return factors (n, channels) of the ``irradiance`` (n, channels) with which its sums times
    the ``polynomials`` (n, m) are ``exact`` (m, channels).

    They are 1 plus a polynomial. Its degree grows as long as no factor becomes too small: the last
    step is then made in part, so that sums of lower degree are exact, and others nearly so.
    """
    factors = np.ones_like(irradiance)
    for c, own in enumerate(irradiance.T):
        used = own > 0
        for degree in range(MATCHED_DEGREE + 1):
            count = sum(sum(power) <= degree for power in powers(MATCHED_DEGREE))
            basis = polynomials[:, :count]
            weighted = basis * own[:, None]
            missing = exact[:count, c] - weighted.sum(axis=0)
            if not np.isfinite(missing).all():  # a map without radiance, or with texels of NaN
                break
            change, *_ = np.linalg.lstsq(basis.T @ weighted, missing, rcond=1e-6)
            found = 1 + basis @ change
            left = missing - weighted.T @ (found - 1)
            # Few ordinates have not all of the moments.
            if np.abs(left).max() > INEXACT * abs(exact[0, c]):
                break
            before, after = factors[used, c], found[used]
            falling = after < SMALLEST_FACTOR
            steps = (before - SMALLEST_FACTOR)[falling] / (before - after)[falling]
            step = steps.min(initial=1.0)
            # A polynomial may have any value where none of the positions sees the environment.
            factors[used, c] += step * (after - before)
            if step < 1:
                break
    return factors


def _values(spectrum: mi.Spectrum, count: int) -> np.ndarray:
    """Return a spectrum as a float64 array (count, channels)."""
    channels = [np.broadcast_to(np.array(v, dtype=np.float64), count) for v in spectrum]
    return np.stack(channels, axis=1)


def _from_point(emitter: mi.Emitter, medium: MediumGrid, position: mi.Point3f) -> mi.Spectrum:
    """Return the irradiance from a point-like emitter, attenuated by the medium."""
    at = dr.zeros(mi.Interaction3f, dr.width(position))
    at.p = position
    record, irradiance = emitter.sample_direction(at, mi.Point2f(0.5))
    visible = dr.max(irradiance) > 0
    ray = mi.Ray3f(position, record.d)
    irradiance = irradiance * medium_transmittance(medium, ray, record.dist, visible)
    irradiance = dr.select(visible, irradiance, 0)
    dr.eval(irradiance)
    return irradiance


def _sun(emitter: mi.Emitter) -> tuple[np.ndarray, np.ndarray]:
    """Return direction of propagation (3) and irradiance (channels) of a sun."""
    record, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
    direction = -np.array(record.d, dtype=np.float64).ravel()
    return direction / np.linalg.norm(direction), _values(weight, 1)[0]
