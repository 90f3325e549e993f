"""Where light comes from: sets of directions, and the emitters that are far away.

A set is of pairs of opposite directions, spread evenly and turned at random, so that every
direction alone is uniform. Its weights integrate spherical harmonics up to degree 3 exactly: inside
dense matter radiance has no others, whatever the turn. The sets of several passes together are as
even as one of so many directions: independent turns would leave three times the noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import spots_of
from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.core.sequences import kronecker_steps, lattice_points
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.angular_quadrature import (
    spread_together,
    strata,
)
from mitsuba_irrcache.transport.tracking import medium_transmittance


def environment_radiance(environment: mi.Emitter, directions: np.ndarray) -> np.ndarray:
    """Radiance (n, channels) that the environment sends along ``directions`` (n, 3)."""
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = mi.Vector3f(directions.T.astype(np.float32))
    return _values(environment.eval(interaction), len(directions))


def _values(spectrum: mi.Spectrum, count: int) -> np.ndarray:
    """A spectrum as an array (count, channels), float64."""
    channels = [np.broadcast_to(np.array(v, dtype=np.float64), count) for v in spectrum]
    return np.stack(channels, axis=1)


#: What the second coordinate of lattices of points advances by.
STEP = kronecker_steps(2)[0]
#: Pairs of directions of a pass for each line of light from a sun, and for each direction of an
#: environment's bright parts.
SUN_SHARE, BRIGHT_SHARE = 8, 2


class DistantIllumination:
    """The emitters of a scene, seen from the medium: an environment, suns that are infinitely far
    and narrow, and point-like lights nearby.
    """

    def __init__(self, scene: mi.Scene, glows: bool = False) -> None:
        """``glows``: there is light besides, whose colour is its own."""
        self._glows = glows
        self._environment = scene.environment()
        self._spots: tuple | None = None
        self._suns, self.near = [], []
        for emitter in scene.emitters():
            if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection):
                self._suns.append(_sun(emitter))
            elif mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
                self.near.append(emitter)

    def tables(
        self, passes: int, pairs: int, channels: int, rng: np.random.Generator, first: int = 0
    ) -> tuple[list[tuple], np.ndarray]:
        """Directions for a number of passes, and the light from far away along them; before these,
        if wanted, for a ``first`` pass of so many pairs.

        Returns arguments of `Tracks.table`, those of each pass, and the factors (channels) of what
        these give: where channels differ by a factor only, light has a single one.
        """
        tables = self.rows(1, first, rng) if first else []
        tables += self.rows(passes, pairs, rng)
        light = np.concatenate([table[1] for table in tables])
        brightest = light.max(axis=(0, 1))
        colour = brightest / brightest.max() if brightest.max() > 0 else np.ones(channels)
        apart = np.abs(light - light.max(axis=-1, keepdims=True) * colour)
        if not self.near and not self._glows and apart.max() <= 1e-6 * light.max():
            return [
                (d, light.max(axis=-1, keepdims=True), w, o) for d, light, w, o in tables
            ], colour
        return tables, np.ones(channels)

    def rows(self, passes: int, pairs: int, rng: np.random.Generator) -> list[tuple]:
        """Directions of passes, irradiance along both ways (n, 2, channels), weights, offsets: an
        even set, which light from voxels takes too, and those that only emitters need.
        """
        even = spread_together(passes, pairs, rng)
        varies = (
            self._environment is not None
            and self._environment.class_name() != "ConstantBackgroundEmitter"
        )
        if varies:
            found = self._with_bright(even, max(1, pairs // BRIGHT_SHARE), rng)
        else:
            found = [(*own, self._steady(*own)) for own in even]
        return [self._pass(pairs, *own, rng) for own in found]

    def _steady(self, directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Light of an even environment, or none, as of `rows`."""
        if self._environment is None:
            return np.zeros((len(directions), 2, dr.size_v(mi.Spectrum)))
        return self._both_ways(directions) * weights[:, None, None]

    def _pass(
        self,
        pairs: int,
        directions: np.ndarray,
        weights: np.ndarray,
        light: np.ndarray,
        rng: np.random.Generator,
    ) -> tuple:
        """A pass of `rows`, with those of suns."""
        colours, rows = dr.size_v(mi.Spectrum), [(directions, light, weights)]
        lines = self._lines(pairs)
        for direction, irradiance in self._suns:
            ways = np.stack([irradiance / lines, np.zeros(colours)])
            rows.append((np.tile(direction, (lines, 1)), np.tile(ways, (lines, 1, 1)), lines * [0]))
        joined = [np.concatenate(part) for part in zip(*rows, strict=True)]
        offsets = rng.random((len(joined[0]), 2))
        for k in range(len(self._suns)):
            # The last rows: lines of one direction lie evenly in the voxels.
            end = len(offsets) - k * lines
            offsets[end - lines : end] = (offsets[end - 1] + lattice_points(lines, STEP).T) % 1
        return *joined, offsets

    def sun_rows(self, pairs: int) -> int:
        """How many of the last rows of a pass are those of suns."""
        return len(self._suns) * self._lines(pairs)

    def _lines(self, pairs: int) -> int:
        return max(1, pairs // SUN_SHARE)

    def _with_bright(
        self, even: list[tuple], count: int, rng: np.random.Generator
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """To the ``even`` directions of each pass and their weights some by the luminance of an
        environment that varies, and the light along all. One may come from either, and as the
        opposite of one: what it stands for is one over the density of all ways to get it.
        """
        rows = []
        chosen = self._bright(len(even), count, rng)
        for (plain, weights), bright in zip(even, chosen, strict=True):
            directions = np.concatenate([plain, bright])
            uniform = len(plain) / (2 * np.pi)
            angle = 1 / (uniform + count * self._density(directions))
            angle[: len(plain)] *= weights * uniform
            light = self._both_ways(directions) * angle[:, None, None]
            rows.append((directions, np.concatenate([weights, np.zeros(count)]), light))
        self._make_whole(rows)
        return rows

    def _make_whole(self, rows: list[tuple]) -> None:
        """Lets as much light come from each bright spot, and from beside all, as there is: how many
        directions meet one is chance.
        """
        if self._spots is None:
            self._spots = spots_of(self._environment)
        spots, irradiance = self._spots
        numbers = []
        for directions, *_ in rows:
            towards = np.stack([-directions, directions], axis=1)
            number = np.zeros(towards.shape[:2], int)
            for k, spot in enumerate(spots, 1):
                number[(number == 0) & spot.covers(towards)] = k
            numbers.append(number)
        for k, exact in enumerate(irradiance):
            own = [light[n == k] for (*_, light), n in zip(rows, numbers, strict=True)]
            found = np.concatenate(own).sum(axis=0) / len(rows)
            known = (found > 0) & np.isfinite(exact)
            factor = np.where(known, exact / np.where(known, found, 1), 1)
            for (*_, light), number in zip(rows, numbers, strict=True):
                light[number == k] *= factor

    def _both_ways(self, directions: np.ndarray) -> np.ndarray:
        """Radiance (n, 2, channels) along directions and their opposites."""
        both = [environment_radiance(self._environment, s * directions) for s in (1, -1)]
        return np.stack(both, axis=1)

    def _bright(self, sets: int, count: int, rng: np.random.Generator) -> list[np.ndarray]:
        """Sets of directions (n, 3) of light from the environment, by its own density, all of them
        together evenly.
        """
        points = lattice_points(sets * count, STEP)
        members = strata(sets, points[1], STEP)
        samples = ((points + rng.random((2, 1))) % 1).astype(np.float32)
        record, _ = self._environment.sample_direction(
            dr.zeros(mi.Interaction3f, sets * count), mi.Point2f(samples)
        )
        directions = -np.array(record.d, dtype=np.float64).T
        return [directions[own] for own in members]

    def _density(self, directions: np.ndarray) -> np.ndarray:
        """Density (n) with which the environment draws directions or their opposites [1/sr]."""
        total = np.zeros(len(directions))
        for sign in (1, -1):
            record = dr.zeros(mi.DirectionSample3f, len(directions))
            record.d = mi.Vector3f((-sign * directions).T.astype(np.float32))
            at = dr.zeros(mi.Interaction3f, len(directions))
            total += np.array(self._environment.pdf_direction(at, record), dtype=np.float64)
        return total

    def near_light(
        self, medium: MediumGrid, position: mi.Point3f, lights: Sequence[DirectLight] = ()
    ) -> list[mi.Spectrum]:
        """Irradiance at ``position`` from each point-like light nearby; that of ``lights``, which
        are not marched again, as they know it.
        """
        means = {id(light.emitter): light.irradiance for light in lights}
        return [
            means[id(e)] if id(e) in means else _from_point(e, medium, position) for e in self.near
        ]


def _from_point(emitter: mi.Emitter, medium: MediumGrid, position: mi.Point3f) -> mi.Spectrum:
    """Irradiance from a point-like emitter, its light followed through the medium."""
    at = dr.zeros(mi.Interaction3f, dr.width(position))
    at.p = position
    record, light = emitter.sample_direction(at, mi.Point2f(0.5))
    lit = dr.max(light) > 0
    light = light * medium_transmittance(medium, mi.Ray3f(position, record.d), record.dist, lit)
    light = dr.select(lit, light, 0)
    dr.eval(light)
    return light


def _sun(emitter: mi.Emitter) -> tuple[np.ndarray, np.ndarray]:
    """Direction (3) and irradiance (channels) of a light that is infinitely far and narrow."""
    record, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, 1), mi.Point2f(0.5))
    direction = -np.array(record.d, dtype=np.float64).ravel()
    return direction / np.linalg.norm(direction), _values(weight, 1)[0]
