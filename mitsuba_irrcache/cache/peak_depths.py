"""Optical depths of scattering into a forward peak between the voxels and narrow sources.

They are the mean numbers of scattering events on which the aureole of a source depends (see
`media/aureole`). The optical depth between a position and a source is the mean extinction along the
line times its length in the medium. The length is known in closed form, so only the mean extinction
is interpolated between the voxels, as for direct light (`cache/direct_light`).
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.immutable import Immutable
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.narrow_sources import Source
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.transport.tracking import optical_depth


class PeakDepths(Immutable):
    """Mean extinctions of the truncated forward peak on the lines from voxels to narrow sources."""

    def __init__(
        self, medium: MediumGrid, grid: Grid, voxels: mi.UInt32, sources: Sequence[Source]
    ) -> None:
        """Compute them at the ``voxels`` (flat indices) of ``grid`` for each of the ``sources``.

        ``medium`` is scaled by delta-M.
        """
        self._medium, self.sources = medium, tuple(sources)
        p = grid.world.point(mi.Point3f(*grid.voxel_indices(voxels)) + 0.5)
        #: for each source and channel: the mean extinction [1/scene unit] at the voxels
        self.extinctions = [self._mean_extinction(source, p) for source in sources]

    @property
    def channels(self) -> int:
        return self._medium.channels

    def _mean_extinction(self, source: Source, p: mi.Point3f) -> list[mi.Float]:
        ray, near, far = self._line(source, p)
        depth = peak_depth(self._medium, ray, near, far, near < far)
        length = far - near
        scale = dr.select(length > 0, dr.rcp(length), 0)
        channels = [depth] if isinstance(depth, mi.Float) else list(depth)
        found = [mi.Float(scale * d) for d in channels]
        dr.eval(found)
        return found

    def lengths(self, p: mi.Point3f) -> list[mi.Float]:
        """Return the length in the medium of the line from ``p`` to each source."""
        found = []
        for source in self.sources:
            _, near, far = self._line(source, p)
            found.append(far - near)
        return found

    def _line(self, source: Source, p: mi.Point3f) -> tuple[mi.Ray3f, mi.Float, mi.Float]:
        """Return rays from ``p`` to a source, and the distances at which they enter and leave the
        medium, equal where they miss it.
        """
        towards, _ = source.seen_from(p)
        ray = mi.Ray3f(mi.Point3f(p), mi.Vector3f(towards))
        hit, near, far = self._medium.intersect(ray)
        near, far = dr.maximum(near, 0), dr.minimum(far, source.distance(p))
        return ray, near, dr.select(hit, dr.maximum(far, near), near)


def peak_depth(
    medium: MediumGrid, ray: mi.Ray3f, near: mi.Float, far: mi.Float, active: mi.Bool
) -> mi.Float | mi.Color3f:
    """Return the optical depth of scattering into the truncated forward peak of ``medium``, per
    channel, between the distances ``near`` and ``far`` along ``ray``.
    """
    full, scaled = (
        optical_depth(each, ray, near, far, active, dr.inf) for each in (medium.original, medium)
    )
    return dr.maximum(full - scaled, 0)
