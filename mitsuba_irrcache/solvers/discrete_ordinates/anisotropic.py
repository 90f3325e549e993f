"""The solver ``sweep`` for anisotropic phase functions: passes of `solver` for angular moments."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.volume import IrradianceCache
from mitsuba_irrcache.core.jit import concatenated
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.solvers.discrete_ordinates.layout import separate_channels
from mitsuba_irrcache.solvers.discrete_ordinates.moments import AnisotropicMultigridLevel, Moments
from mitsuba_irrcache.solvers.discrete_ordinates.multigrid import MultigridLevel
from mitsuba_irrcache.solvers.discrete_ordinates.ordinates import OrdinateSet
from mitsuba_irrcache.solvers.discrete_ordinates.solver import Sweep
from mitsuba_irrcache.solvers.discrete_ordinates.tracks import Tracks

#: Ordinates of a pass for moments up to order 4, and of higher order. They have to integrate
#: products of two moments: under a sun, half as many have twice the error for g = 0.5, and five
#: times the error for g = 0.85.
DIRECTIONS_OF_PASS, MORE_DIRECTIONS_OF_PASS = 32, 64


def directions_of(order: int) -> int:
    """Return the number of ordinates of a pass for moments up to ``order``."""
    return DIRECTIONS_OF_PASS if order <= 4 else MORE_DIRECTIONS_OF_PASS


def minimum_batch(order: int) -> int:
    """Return the minimum number of ordinates of a batch for moments up to ``order``: two passes."""
    return 2 * directions_of(order)


class AnisotropicSweep(Sweep):
    """`Sweep` for a cache with moments."""

    def __init__(
        self, scene: mi.Scene, medium: MediumGrid, cache: IrradianceCache, *rest: object
    ) -> None:
        self._moments, self._sources = Moments(cache.directional), cache.directional.sources
        self.directions = directions_of(self._moments.order)
        super().__init__(scene, medium, cache, *rest)
        if not cache.active_count:
            return
        # Point-like lights, in the order of `DistantIllumination.point_lights`, except known ones.
        points = [s for s in self._sources if s.sharp and not s.far]
        self._point_directions = [s.seen_from(self._sample_points)[0] for s in points]

    def _new_level(self, sigma_t: mi.Float, albedo: mi.Float, tracks: Tracks) -> MultigridLevel:
        all_axes = not self._medium.is_isolated
        return AnisotropicMultigridLevel(sigma_t, albedo, tracks, all_axes, moments=self._moments)

    def _solve(self, sets: list[OrdinateSet], channels: tuple[int, ...]) -> list[tuple]:
        """Solve as `Sweep._solve`.

        The moments of the uncollided radiance do not include narrow sources; their irradiance is
        returned after the moments.
        """
        several, count = self.cache.max_depth != 2, len(channels)
        used = sets[1:] if several else sets
        scale = dr.opaque(mi.Float, 1 / len(used))
        found = self._moments.uncollided(used, self._tracks_of(channels), count)
        smooth, *own = (None if values is None else values * scale for values in found)
        swept = sum((values for values in own if values is not None), smooth)
        scattered = self._swept(self._level(channels), sets, channels) - swept if several else None
        parts = [
            [None] * count if values is None else separate_channels(values, count)
            for values in (smooth, swept, scattered, *own)
        ]
        return [self._of_channel(c, *each) for c, *each in zip(channels, *parts, strict=True)]

    def _irradiance_of(self, values: mi.Float) -> mi.Float:
        return self._moments.moment(values, 0) if dr.width(values) > 1 else values

    @property
    def _noise_of_scattering(self) -> float:
        # The noise of few directions is about the same for all moments. Half of it corresponds to
        # the errors of images as that of the irradiance does for isotropic scattering.
        moments = self._moments.angular_basis.phase.moments
        return 0.5 * sum(float(moments[degree]) ** 2 for degree in self._moments.degrees)

    def _of_channel(
        self,
        channel: int,
        smooth: mi.Float,
        swept: mi.Float,
        scattered: mi.Float | None,
        *own: mi.Float | None,
    ) -> tuple:
        """Return the results of `_solve` for a channel from swept moments.

        ``smooth`` are the moments of the uncollided radiance without narrow sources, ``swept`` with
        them, ``scattered`` those of the scattered radiance, and ``own`` those of each narrow
        source.
        """
        moments = self._moments
        # Sampled voxel by voxel: irradiance of direct lights of the cache (``known``), which are
        # not part of the moments; irradiance of point-like emitters; moments of other sources.
        known, unknown = [], []
        for found in (*self._direct, *self._emission):
            (known if id(found[0]) in self._closed_form_lights else unknown).append(
                [m[channel] for m in found]
            )
        points = unknown[: len(self._point_directions)]
        others = unknown[len(self._point_directions) :]
        narrow = self._narrow_sources(own[: len(self._sources)], points, others)
        uncollided = moments.moment(swept, 0) + sum(values[0] for values in (*known, *unknown))
        if self._sun_irradiance:  # swept as the source of further orders only
            uncollided += self._from_suns(channel) - moments.moment(own[-1], 0)
        if scattered is not None:
            smooth = smooth + scattered
            scattered = dr.maximum(moments.moment(scattered, 0), 0)
        higher = [
            moments.moment(smooth, k) + sum(values[k] for values in others)
            for k in range(1, moments.count)
        ]
        dr.eval(uncollided, scattered, higher, narrow)
        return (uncollided, scattered, *higher, *narrow)

    def _narrow_sources(
        self, swept: Sequence[mi.Float | None], points: list, others: list
    ) -> list[mi.Float]:
        """Return the irradiance of each narrow source, the sum of three parts.

        They come from ``swept`` moments, from point-like emitters (``points``), and from the
        narrow part of the ``others``.
        """
        points, found = iter(points), []
        for number, (source, values) in enumerate(zip(self._sources, swept, strict=True)):
            irradiance = dr.zeros(mi.Float, self.cache.active_count)
            if values is not None:
                irradiance += self._moments.moment(values, 0)
            if source.sharp and not source.far:
                irradiance += next(points)[0]
            found.append(irradiance + sum(more[self._moments.count + number] for more in others))
        return found

    def _sampled(self, channel: int) -> list[mi.Float]:
        """Return the result of `Sweep._sampled`, with moments."""
        count, found = self._moments.count, []
        directions = iter(self._point_directions)
        for irradiance, *more in self._direct:
            light = self._closed_form_lights.get(id(irradiance))
            if light is not None:
                value = light.means[channel]
                means = light.angular_means()[: count - 1]
                higher = (value * mean[channel] for mean in means)
                found.append(concatenated([value, *higher]))
                continue
            value = irradiance[channel] * self._inverse_square_mean
            if not more:
                found.append(self._moments.from_direction(value, next(directions)))
            else:
                higher = (
                    moment[channel] * self._inverse_square_mean for moment in more[: count - 1]
                )
                found.append(concatenated([value, *higher]))
        for emission in self._emission:
            found.append(concatenated([moment[channel] for moment in emission[:count]]))
        return found
