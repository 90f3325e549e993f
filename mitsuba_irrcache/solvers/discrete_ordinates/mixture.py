"""Extinction and albedo of voxels: of one medium in its closed-form boundary, or of media whose
boundaries have any shape.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.scene.media_shares import media_shares
from mitsuba_irrcache.solvers.discrete_ordinates.resampling import (
    collision_albedo,
    extinction_grid,
    halved,
    mean_albedo,
    mean_extinction,
    track_extinction,
)


class SingleMedium:
    """A ``medium`` in its closed-form boundary."""

    def __init__(self, medium: MediumGrid) -> None:
        self._medium = medium

    def extinction_grid(self, grid: Grid, has_dense_boundary: bool) -> Grid:
        """Return the grid on which tracks read the extinction, see `resampling.extinction_grid`."""
        return extinction_grid(self._medium, grid, has_dense_boundary)

    def extinction(self, detail: Grid, grid: Grid) -> list[mi.Float]:
        """Return the channels of the extinction [1/scene unit] on the grid ``detail``, which is
        ``grid`` or the result of `extinction_grid` for it.
        """
        return track_extinction(self._medium, grid, detail)

    def albedo(self, grid: Grid, voxels: mi.UInt32) -> list[mi.Float]:
        """Return the channels of the albedo at these ``voxels`` of ``grid``, the mean over
        collisions in uniform radiance.
        """
        return collision_albedo(self._medium, grid, voxels)


class MediaMixture:
    """The ``media`` of a scene in a box of voxels. In a voxel that boundaries cut, each of them
    counts by the share of the volume that it fills. The methods are those of `SingleMedium`.
    """

    def __init__(self, scene: mi.Scene, media: Sequence[MediumGrid]) -> None:
        self._scene, self._media = scene, list(media)

    def extinction_grid(self, grid: Grid, has_dense_boundary: bool) -> Grid:
        return halved(grid) if has_dense_boundary else grid

    def extinction(self, detail: Grid, grid: Grid) -> list[mi.Float]:
        total = self._sum(self._extinctions(detail))
        dr.eval(total)
        return total

    def albedo(self, grid: Grid, voxels: mi.UInt32) -> list[mi.Float]:
        collided, scattered = [], []
        for medium, extinction in zip(self._media, self._extinctions(grid), strict=True):
            own = [dr.gather(mi.Float, channel, voxels) for channel in extinction]
            albedo = mean_albedo(medium, grid, voxels)
            both = max(len(own), len(albedo))
            own, albedo = ((each * both)[:both] for each in (own, albedo))
            collided.append(own)
            scattered.append([s * a for s, a in zip(own, albedo, strict=True)])
        result = [
            dr.select(total > 0, part / total, 0)
            for total, part in zip(self._sum(collided), self._sum(scattered), strict=True)
        ]
        dr.eval(result)
        return result

    def _extinctions(self, grid: Grid) -> list[list[mi.Float]]:
        """Return the part of each medium in the channels of the extinction."""
        shares = media_shares(self._scene, self._media, grid)
        return [
            [share * channel for channel in mean_extinction(medium, grid)]
            for medium, share in zip(self._media, shares, strict=True)
        ]

    @staticmethod
    def _sum(parts: list[list[mi.Float]]) -> list[mi.Float]:
        """Add the channels of all media, of which some may be grey."""
        count = max(len(part) for part in parts)
        return [sum(part[min(c, len(part) - 1)] for part in parts) for c in range(count)]
