"""Reverse mode in scenes with surfaces, area emitters and several media.

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

from mitsuba_irrcache.core.sequences import hashed_seed, kronecker_words, unit_floats
from mitsuba_irrcache.gradients.coupled_medium import AdjointFluence, Importance
from mitsuba_irrcache.gradients.film import FilmAdjoint
from mitsuba_irrcache.gradients.path_derivatives import PathAdjoint
from mitsuba_irrcache.gradients.paths import Start
from mitsuba_irrcache.gradients.replay import CameraSplats
from mitsuba_irrcache.gradients.scattering import Components
from mitsuba_irrcache.gradients.surroundings import (
    CAMERA,
    DERIVATIVES,
    EXCHANGE,
    LANES,
    MOST_EXCHANGES,
    TOLERANCE,
    Surroundings,
    warn_of_exchanges,
)

#: Maximum number of paths from voxels for derivatives through the irradiance from the surroundings,
#: and for each exchange with the surroundings.
RAYS, EXCHANGED = 1 << 20, 1 << 18
#: Number of paths from voxels for each camera sample, so that they add a tenth to its noise, at
#: least `FEWEST` in all, half as many for an exchange.
PATHS_PER_SAMPLE, FEWEST = 2, 1 << 16


class SurroundingsAdjoint(Surroundings):
    """Derivatives of objectives of images of a scene with respect to its media, through paths.

    The arguments are those of `Surroundings`. Derivatives with respect to emitters and BSDFs are
    added to the gradients of their parameters.
    """

    paths = PathAdjoint
    _samples = 0  # camera samples of all views so far

    # Views

    def view(self, film: FilmAdjoint) -> tuple[list[CameraSplats], list[list[Components]]]:
        """Return the sums of derivatives at a fixed fluence, and the components of the adjoint
        fluence of camera rays for each medium and channel.
        """
        self._views += 1
        self._samples += film.samples
        splats = None
        sees = self._scene.environment() is not None and not self._hides
        for number, each in enumerate(film.passes()):
            count = dr.width(each.ray.d)
            alpha = None if sees or each.alpha is None else -each.alpha
            rng = self._random(CAMERA, number, count, self._views)
            paths = self._new_paths(from_camera=True)
            camera = mi.Ray3f(each.ray), each.radiance, alpha, None, rng
            paths.trace(Start(*camera, medium=film.medium))
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

    def transported(self, camera: list[list[Components]]) -> list[CameraSplats]:
        """Return the sums of derivatives through the fluence, given the components of the adjoint
        fluence of camera rays for each medium and channel.
        """
        # docs/primer, eq. (8.19)
        splats = None
        for number, importance in enumerate(self._importances(self._solved(camera))):
            for first, rays in self._launches(DERIVATIVES):
                start = self._from_voxels(number, importance, DERIVATIVES, first, rays)
                if start is None:
                    continue
                paths = self._new_paths()
                paths.trace(start)
                if splats is None:
                    splats = self._splats(paths, self._count(DERIVATIVES))
                paths.add(splats)
                dr.eval()
        return splats or [m.splats(1e-30, 1, False, True) for m in self.media]

    def _importances(self, adjoint: list[AdjointFluence]) -> list[Importance]:
        return [m.importance(own) for m, own in zip(self.media, adjoint, strict=True)]

    def _count(self, use: int) -> int:
        """Return the number of paths from the voxels of all media for a ``use``.

        It is a power of two: kernels, which depend on it, are reused.
        """
        count = max(PATHS_PER_SAMPLE * self._samples, FEWEST)
        count = min(1 << int(np.ceil(np.log2(count))), RAYS)
        return count if use == DERIVATIVES else min(count // 2, EXCHANGED)

    def _total(self, use: int) -> int:
        """Return the number of paths from the voxels of each medium."""
        return max(self._count(use) // len(self.media), 1)

    def _launches(self, use: int) -> list[tuple[int, int]]:
        """Return the first path and the number of paths of each launch for a medium."""
        total = self._total(use)
        return [(first, min(LANES, total - first)) for first in range(0, total, LANES)]

    def _solved(self, camera: list[list[Components]]) -> list[AdjointFluence]:
        """Return the adjoint fluence of all media with all exchanges between them and surfaces."""
        # docs/primer, eq. (8.20)
        total = [m.scattered(own) for m, own in zip(self.media, camera, strict=True)]
        if self.media[0].single:
            return total
        change = self._importances(total)
        scale = _norm(change)
        for number in range(MOST_EXCHANGES):
            returned = self._exchanged(change, number)
            entering = [m.entering(own) for m, own in zip(self.media, returned, strict=True)]
            if _norm(self._importances(entering)) <= TOLERANCE * scale:
                return total
            further = [m.scattered(own) for m, own in zip(self.media, returned, strict=True)]
            total = [a + b for a, b in zip(total, further, strict=True)]
            dr.eval([[own.camera, own.travelled] for own in total])
            change = self._importances(further)
        warn_of_exchanges()
        return total

    def _exchanged(self, importances: list[Importance], exchange: int) -> list[list[Components]]:
        """Return the components of the adjoint fluence that collides after it has left its medium,
        for each medium and channel.
        """
        splats = None
        for number, importance in enumerate(importances):
            for first, rays in self._launches(EXCHANGE):
                use = EXCHANGE | exchange << 4
                start = self._from_voxels(number, importance, use, first, rays)
                if start is None:
                    continue
                paths = self._new_paths(derivatives=False)
                paths.trace(start)
                if splats is None:
                    splats = self._splats(paths, self._count(EXCHANGE), True, False)
                paths.add(splats, without_first=number)
        if splats is None:
            splats = [m.splats(1e-30, 1, True, False) for m in self.media]
        return [m.mean(own.collisions) for m, own in zip(self.media, splats, strict=True)]

    def _from_voxels(
        self, number: int, importance: Importance, use: int, first: int, rays: int
    ) -> Start | None:
        """Return paths from voxels of a medium, sampled in proportion to what radiance is worth
        there; None if it is worth nothing.
        """
        grid, magnitude = self.media[number].grid, importance.magnitude
        total = float(dr.sum(magnitude)[0])
        if not 0 < total < np.inf:
            return None
        rng = self._random(use, (first // LANES << 4) + number, rays)
        count = self._total(use)
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
        dr.eval(voxel, origin, direction, share, rng)
        ray, solid_angle = mi.Ray3f(origin, direction), 4 * dr.pi

        def of_emitters(towards: mi.Vector3f) -> mi.Spectrum:
            return importance.of_emitters(voxel, origin, towards) * share

        scattered = importance.of(voxel, direction) * (share * solid_angle)
        emitted = of_emitters(direction) * solid_angle
        dr.eval(scattered, emitted)
        return Start(ray, scattered, None, of_emitters, rng, emitted)


def _norm(importances: list[Importance]) -> float:
    """Return the sum of the magnitudes of what radiance is worth in all voxels."""
    sums = [dr.sum(importance.magnitude) for importance in importances]
    dr.eval(sums)
    return sum(float(each[0]) for each in sums)
