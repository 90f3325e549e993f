"""Derivatives in scenes with surfaces, area emitters and several media, with all orders.

Two operators couple a medium with itself. Radiance that stays in its box is scattered by discrete
ordinates, whose adjoint is `AdjointTransport`. Radiance that leaves it, and returns from surfaces
or is scattered in another medium, is sampled by paths from its voxels (`PathAdjoint`). When the
adjoint fluence of all media is known, paths from the voxels also have the derivatives of the
radiance that arrives there.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.border import BorderProfile
from mitsuba_irrcache.cache.lookups import root_field
from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.core.sequences import (
    hashed_seed,
    kronecker_words,
    random_stream,
    unit_floats,
)
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.gradients.film import FilmAdjoint
from mitsuba_irrcache.gradients.medium import EMPTY, MARGIN, PAIRS, field_of, splat_of
from mitsuba_irrcache.gradients.parameters import ALBEDO, SIGMA_T
from mitsuba_irrcache.gradients.paths import MarchedMedia, PathAdjoint, Start
from mitsuba_irrcache.gradients.replay import CameraReplay, CameraSplats
from mitsuba_irrcache.gradients.resampling import VoxelQuadrature, volume_of
from mitsuba_irrcache.gradients.splatting import VoxelSums
from mitsuba_irrcache.gradients.transport import AdjointTransport, TransportSettings
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.pipeline.cached_medium import CachedMedium

#: Maximum number of paths of a launch; number of paths from voxels for derivatives through the
#: irradiance from the surroundings; number for each exchange with the surroundings; number of
#: directions by which the fluence of voxels without a cached value is estimated.
LANES, RAYS, EXCHANGED, DIRECTIONS = 1 << 17, 1 << 20, 1 << 18, 64
#: Largest change of the adjoint fluence by a further exchange, relative to the whole; and number of
#: exchanges, at most.
TOLERANCE, MOST_EXCHANGES = 3e-3, 32
#: Uses of random numbers: camera rays, exchanges, derivatives, fluence of voxels without a cache.
CAMERA, EXCHANGE, DERIVATIVES, UNCACHED = range(4)


class KnownFluence:
    """The fluence of a medium on the grid of its cache, see `FluenceAlongRays`."""

    falloff, angular = None, None

    def __init__(self, grid: Grid, values: list[mi.Float], border: BorderProfile | None) -> None:
        roots = [dr.sqrt(dr.maximum(v, 0)) for v in values]
        flat, known = interleaved(roots, grid.voxel_count), dr.full(mi.Bool, True, grid.voxel_count)
        self.irradiance = root_field(grid, flat, known, len(values), border)
        self.direct_lights = []


class CoupledMedium:
    """A medium with its fluence, and the adjoint of transport within its box."""

    def __init__(
        self, scene: mi.Scene, part: CachedMedium, wanted: dict[str, int], step: float, seed: int
    ) -> None:
        self.medium, self.wanted, self.step = part.medium, wanted, step
        self.cache, self.grid = part.cache, part.cache.grid
        settings = TransportSettings(
            (part.settings.seed, seed),
            PAIRS,
            single=False,
            has_dense_boundary=self.cache.interpolation.border is not None,
        )
        self.transport = AdjointTransport(scene, part.medium, self.grid, (), settings)
        found = VoxelQuadrature(part.medium, self.grid).extinction()
        self.channels = self.transport.channels
        self.extinction = list(found)[: self.channels]
        dr.eval(self.extinction)
        self.values = self._cached()
        self._update()

    def _cached(self) -> list[mi.Float]:
        cache, voxels = self.cache, dr.arange(mi.UInt32, self.grid.voxel_count)
        return [
            dr.gather(mi.Float, cache.irradiance.array, voxels * cache.channels + c)
            for c in range(self.channels)
        ]

    @property
    def unknown(self) -> mi.UInt32:
        """The voxels without a cached fluence."""
        known = dr.opaque(mi.Bool, False, self.grid.voxel_count)
        if self.cache.active_count and self.cache.samples:
            dr.scatter(known, mi.Bool(True), self.cache.active)
        return dr.compress(~known)

    def complete(self, voxels: mi.UInt32, values: list[mi.Float]) -> None:
        """Set the fluence of ``voxels``, by channel."""
        for own, value in zip(self.values, values, strict=True):
            dr.scatter(own, value, voxels)
        dr.eval(self.values)
        self._update()

    def _update(self) -> None:
        fluence = KnownFluence(self.grid, self.values, self.cache.border)
        self.march = CameraReplay(self.medium, fluence, None, self.step)

    def scattered(self, source: list[mi.Float]) -> list[mi.Float]:
        """Return the adjoint fluence of collisions with all scattering within the box, by channel;
        ``source`` is that which comes from elsewhere.
        """
        totals, *_ = self.transport.adjoint([[values] for values in source])
        return [parts[0][0] for parts in totals]

    def worth(self, fluence: list[mi.Float]) -> list[mi.Float]:
        """Return the derivatives with respect to the irradiance of each voxel, by channel."""
        share = dr.opaque(mi.Float, volume_of(self.grid) / (4 * np.pi))
        triples = zip(self.extinction, self.transport.albedo, fluence, strict=False)
        found = [share * s * a * phi for s, a, phi in triples]
        dr.eval(found)
        return found

    def mean(self, sums: VoxelSums) -> list[mi.Float]:
        """Return the adjoint fluence of the collisions that are summed in ``sums``."""
        # docs/primer, eq. (8.4)
        least = dr.opaque(mi.Float, EMPTY / float(self.grid.voxel_size.min()))
        volume = dr.opaque(mi.Float, 1 / volume_of(self.grid))
        found = [
            dr.select(s > least, total * volume / dr.maximum(s, least), 0)
            for total, s in zip(sums.values(), self.extinction, strict=True)
        ]
        dr.eval(found)
        return found

    def splats(
        self, largest: float, count: float, collisions: bool, derivatives: bool
    ) -> CameraSplats:
        """Return sums, 0 at first, for the ``count`` paths with this ``largest`` weighted radiance.

        ``collisions`` and ``derivatives`` select the sums.
        """
        sums = None
        if collisions:
            sums = VoxelSums(self.grid, self.channels, largest * count * MARGIN)
        found = {SIGMA_T: None, ALBEDO: None}
        if derivatives:
            length = float(np.linalg.norm(self.grid.side_lengths))
            mean = self.march.irradiance.maximum / (4 * np.pi)
            bounds = {SIGMA_T: largest * (1 + mean) * length, ALBEDO: largest * mean}
            found |= {
                role: splat_of(field_of(self.medium, role), own, bounds[role] * count * MARGIN)
                for role, own in self.wanted.items()
            }
        return CameraSplats(found[SIGMA_T], found[ALBEDO], sums)


class Surroundings:
    """Derivatives of objectives of images of a scene with respect to its media, through paths.

    Args:
        scene: the scene.
        media: the media that have a cache: all of the scene.
        hide_emitters: the integrator's property.
        kinds: whether derivatives with respect to emitters, and to BSDFs, are added to the
            gradients of their parameters.
        seed: of random numbers.
    """

    def __init__(
        self,
        scene: mi.Scene,
        media: list[CoupledMedium],
        hide_emitters: bool,
        kinds: tuple[bool, bool],
        seed: int,
    ) -> None:
        self._scene, self.media, self._hides = scene, media, hide_emitters
        self._kinds, self._seed = kinds, seed
        for number, medium in enumerate(media):
            self._complete(number, medium)

    def _paths(self, derivatives: bool = True) -> PathAdjoint:
        marched = MarchedMedia([medium.march for medium in self.media])
        kinds = self._kinds if derivatives else (False, False)
        return PathAdjoint(self._scene, marched, *kinds, self._hides)

    def _random(self, use: int, number: int, count: int) -> mi.PCG32:
        lanes = dr.arange(mi.UInt32, count)
        word = hashed_seed((self._seed & 0xFFFFFFFF, use << 16 | number))[0]
        return random_stream(mi.sample_tea_32(lanes, word))

    def _complete(self, number: int, medium: CoupledMedium) -> None:
        """Estimate the fluence of voxels for which there is no cached one."""
        unknown = medium.unknown
        per_launch = max(1, LANES // DIRECTIONS)
        found: list[list] = [[] for _ in range(medium.channels)]
        for first in range(0, dr.width(unknown), per_launch):
            count = min(per_launch, dr.width(unknown) - first)
            place = dr.arange(mi.UInt32, count * DIRECTIONS)
            voxel = dr.gather(mi.UInt32, unknown, place // DIRECTIONS + first)
            rng = self._random(UNCACHED + number, first, count * DIRECTIONS)
            shift = [rng.next_uint32(), rng.next_uint32()]
            shift = [dr.gather(mi.UInt32, s, place // DIRECTIONS) for s in shift]
            u, v = unit_floats(kronecker_words(place % DIRECTIONS, shift))
            direction = mi.warp.square_to_uniform_sphere(mi.Point2f(u, v))
            ray = mi.Ray3f(medium.grid.centers(voxel), direction)
            one = mi.Spectrum(dr.ones(mi.Float, count * DIRECTIONS))
            start = Start(ray, one * (4 * dr.pi), None, one, rng)
            radiance = self._paths(derivatives=False).trace(start)
            for own, values in zip(found, radiance, strict=False):
                own.append(dr.block_sum(values, DIRECTIONS) * (1 / DIRECTIONS))
                dr.eval(own)
        if dr.width(unknown):
            medium.complete(unknown, [concatenated(own) for own in found])

    # Views

    def view(self, film: FilmAdjoint) -> tuple[list[CameraSplats], list[list[mi.Float]]]:
        """Return the sums of derivatives at a fixed fluence, and the adjoint fluence of camera rays
        for each medium and channel.
        """
        splats = None
        sees = self._scene.environment() is not None and not self._hides
        for number, each in enumerate(film.passes()):
            count = dr.width(each.ray.d)
            alpha = None if sees or each.alpha is None else -each.alpha
            rng = self._random(CAMERA, number, count)
            paths = self._paths()
            paths.trace(Start(mi.Ray3f(each.ray), each.radiance, alpha, None, rng))
            if splats is None:
                splats = self._splats(paths, film.samples, collisions=True)
            paths.add(splats)
            dr.eval()
        return splats, [
            medium.mean(own.collisions) for medium, own in zip(self.media, splats, strict=True)
        ]

    def _splats(
        self, paths: PathAdjoint, count: float, collisions: bool = False, derivatives: bool = True
    ) -> list[CameraSplats]:
        largest = max(paths.largest(), 1e-30)
        return [m.splats(largest, count, collisions, derivatives) for m in self.media]

    # Transport

    def transported(self, camera: list[list[mi.Float]]) -> list[CameraSplats]:
        """Return the sums of derivatives through the fluence, given the adjoint fluence of camera
        rays for each medium and channel.
        """
        # docs/primer, eq. (8.19)
        worth = [
            medium.worth(own) for medium, own in zip(self.media, self._solved(camera), strict=True)
        ]
        splats = None
        for number, values in enumerate(worth):
            for first, rays in self._launches(RAYS, len(self.media)):
                start = self._from_voxels(number, values, DERIVATIVES, first, rays)
                if start is None:
                    continue
                paths = self._paths()
                paths.trace(start)
                if splats is None:
                    splats = self._splats(paths, RAYS)
                paths.add(splats)
                dr.eval()
        return splats or [m.splats(1e-30, 1, False, True) for m in self.media]

    def _launches(self, rays: int, parts: int) -> list[tuple[int, int]]:
        total = max(rays // parts, 1)
        return [(first, min(LANES, total - first)) for first in range(0, total, LANES)]

    def _solved(self, camera: list[list[mi.Float]]) -> list[list[mi.Float]]:
        """Return the adjoint fluence of all media with all exchanges between them and surfaces."""
        # docs/primer, eq. (8.20)
        change = [m.scattered(own) for m, own in zip(self.media, camera, strict=True)]
        total, scale = change, _norm(self.media, change)
        for number in range(MOST_EXCHANGES):
            returned = self._exchanged(change, number)
            if _norm(self.media, returned) <= TOLERANCE * scale:
                return total
            change = [m.scattered(own) for m, own in zip(self.media, returned, strict=True)]
            total = [
                [a + b for a, b in zip(old, new, strict=True)]
                for old, new in zip(total, change, strict=True)
            ]
            dr.eval(total)
        mi.Log(
            mi.LogLevel.Warn,
            "irrcache: derivatives through the exchange of radiance between media and surfaces "
            f"have not converged after {MOST_EXCHANGES} exchanges.",
        )
        return total

    def _exchanged(self, fluence: list[list[mi.Float]], exchange: int) -> list[list[mi.Float]]:
        """Return the adjoint fluence that collides after it has left its medium."""
        splats = None
        for number, (medium, own) in enumerate(zip(self.media, fluence, strict=True)):
            values = medium.worth(own)
            for first, rays in self._launches(EXCHANGED, len(self.media)):
                use = EXCHANGE | exchange << 4
                start = self._from_voxels(number, values, use, first, rays)
                if start is None:
                    continue
                paths = self._paths(derivatives=False)
                paths.trace(start)
                if splats is None:
                    splats = self._splats(paths, EXCHANGED, True, False)
                paths.add(splats, without_first=number)
        if splats is None:
            return [[0 * values for values in own] for own in fluence]
        return [m.mean(own.collisions) for m, own in zip(self.media, splats, strict=True)]

    def _from_voxels(
        self, number: int, worth: list[mi.Float], use: int, first: int, rays: int
    ) -> Start | None:
        """Return paths from voxels of a medium, sampled in proportion to what irradiance is worth
        there; None if it is worth nothing.
        """
        grid = self.media[number].grid
        magnitude = sum(dr.abs(values) for values in worth)
        total = float(dr.sum(magnitude)[0])
        if not 0 < total < np.inf:
            return None
        dr.eval(magnitude)
        rng = self._random(use, (first // LANES << 4) + number, rays)
        count = self._total(use, len(self.media))
        place = dr.arange(mi.UInt32, rays) + first
        u = (mi.Float(place) + rng.next_float32()) / count
        voxel, chance = mi.DiscreteDistribution(magnitude).sample_pmf(dr.minimum(u, 0.9999999))
        shift = hashed_seed((self._seed & 0xFFFFFFFF, use))
        s, t = unit_floats(kronecker_words(place, shift))
        within = mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
        origin = grid.world.point(mi.Point3f(*grid.voxel_indices(voxel)) + within)
        direction = mi.warp.square_to_uniform_sphere(mi.Point2f(s, t))
        # Rounding of the cumulative sum can select a voxel of no worth: 0 / 0.
        share = dr.select(chance > 0, dr.rcp(chance * count), 0)
        values = [dr.gather(mi.Float, own, voxel) * share for own in worth]
        irradiance = mi.Spectrum(*values)
        dr.eval(origin, direction, irradiance, rng)
        ray = mi.Ray3f(origin, direction)
        return Start(ray, irradiance * (4 * dr.pi), None, irradiance, rng)

    def _total(self, use: int, parts: int) -> int:
        return max((RAYS if use == DERIVATIVES else EXCHANGED) // parts, 1)


def _norm(media: list[CoupledMedium], fluence: list[list[mi.Float]]) -> float:
    """Return the sum of the magnitudes of what irradiance is worth in all voxels."""
    sums = [
        dr.sum(dr.abs(values))
        for medium, own in zip(media, fluence, strict=True)
        for values in medium.worth(own)
    ]
    dr.eval(sums)
    return sum(float(each[0]) for each in sums)
