"""Media among surfaces and other media, and the paths that couple them."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.core.sequences import (
    hashed_seed,
    kronecker_words,
    random_stream,
    unit_floats,
)
from mitsuba_irrcache.gradients.coupled_medium import CoupledMedium
from mitsuba_irrcache.gradients.path_derivatives import PathDerivatives
from mitsuba_irrcache.gradients.paths import MarchedMedia, Start

#: Maximum number of paths of a launch; number of directions by which the fluence of voxels without
#: a cached value is estimated.
LANES, DIRECTIONS = 1 << 17, 64
#: Largest change by a further exchange of radiance, relative to the whole; and number of exchanges,
#: at most.
TOLERANCE, MOST_EXCHANGES = 3e-3, 32
#: Uses of random numbers: camera rays, exchanges, derivatives, fluence of voxels without a cache.
CAMERA, EXCHANGE, DERIVATIVES, UNCACHED = range(4)


class Surroundings:
    """Media among surfaces and other media, and paths between them.

    Args:
        scene: the scene.
        media: the media that have a cache: all of the scene.
        hide_emitters: the integrator's property.
        kinds: whether there are derivatives with respect to emitters, and to BSDFs.
        seed: of random numbers.
    """

    #: paths with derivatives in the mode of the subclass
    paths: type[PathDerivatives]

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
        self._views = 0  # so far
        for number, medium in enumerate(media):
            self._complete(number, medium)

    def _new_paths(self, derivatives: bool = True, from_camera: bool = False) -> PathDerivatives:
        marched = MarchedMedia([medium.march for medium in self.media])
        kinds = self._kinds if derivatives else (False, False)
        events = int(from_camera) if self.media[0].single else None
        return self.paths(self._scene, marched, *kinds, self._hides, events)

    def _random(self, use: int, number: int, count: int, view: int = 0) -> mi.PCG32:
        lanes = dr.arange(mi.UInt32, count)
        word = hashed_seed((self._seed & 0xFFFFFFFF, use << 16 | number))[0]
        word = mi.sample_tea_32(word, dr.opaque(mi.UInt32, view))[0]
        return random_stream(mi.sample_tea_32(lanes, word))

    def _starts(
        self, medium: CoupledMedium, voxels: mi.UInt32, directions: int, use: int, centred: bool
    ) -> Iterator[tuple[mi.UInt32, Start]]:
        """Yield voxels, and paths from each of them in this number of ``directions``.

        The mean of what the paths of a voxel contribute is the irradiance in it. ``use`` determines
        random numbers; ``centred`` paths start at the centres of the voxels.
        """
        per_launch, grid = max(1, LANES // directions), medium.grid
        for first in range(0, dr.width(voxels), per_launch):
            count = min(per_launch, dr.width(voxels) - first)
            place = dr.arange(mi.UInt32, count * directions)
            own = dr.gather(mi.UInt32, voxels, dr.arange(mi.UInt32, count) + first)
            voxel = dr.gather(mi.UInt32, own, place // directions)
            rng = self._random(use, first, count * directions)
            shift = [rng.next_uint32(), rng.next_uint32()]
            shift = [dr.gather(mi.UInt32, s, place // directions) for s in shift]
            u, v = unit_floats(kronecker_words(place % directions, shift))
            direction = mi.warp.square_to_uniform_sphere(mi.Point2f(u, v))
            origin = grid.centers(voxel)
            if not centred:
                within = mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
                origin = grid.world.point(mi.Point3f(*grid.voxel_indices(voxel)) + within)
            one = mi.Spectrum(dr.ones(mi.Float, count * directions))
            dr.eval(own, origin, direction, rng)
            ray = mi.Ray3f(origin, direction)
            yield own, Start(ray, one * (4 * dr.pi), None, lambda _, one=one: one, rng)

    def _complete(self, number: int, medium: CoupledMedium) -> None:
        """Estimate the fluence of voxels for which there is no cached one."""
        unknown, found = medium.unknown, []
        for _, start in self._starts(medium, unknown, DIRECTIONS, UNCACHED + number, centred=True):
            paths = self._new_paths(derivatives=False)
            paths.trace(start)
            sums = means(medium.moments(start.ray.o, paths.contributions()), DIRECTIONS)
            found.append(sums)
        if dr.width(unknown):
            components = list(zip(*found, strict=True))
            values = [
                [concatenated([part[channel] for part in parts]) for parts in components]
                for channel in range(medium.channels)
            ]
            medium.complete(unknown, values)


def means(components: list[mi.Spectrum], count: int) -> list[mi.Spectrum]:
    """Return the means over each ``count`` consecutive values of ``components``."""
    found = [
        mi.Spectrum(*(dr.block_sum(v, count) * (1 / count) for v in component))
        for component in components
    ]
    dr.eval(found)
    return found


def warn_of_exchanges() -> None:
    """Log a warning that the exchanges have not converged."""
    mi.Log(
        mi.LogLevel.Warn,
        "irrcache: derivatives through the exchange of radiance between media and surfaces "
        f"have not converged after {MOST_EXCHANGES} exchanges.",
    )
