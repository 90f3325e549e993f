"""Weights with which a medium scatters the irradiance of narrow sources into camera rays.

Without a truncated forward peak they are the phase function. delta-M (`media/delta_m`) divides the
phase function into a peak of share f, which counts as unscattered, and the rest,
(p - f delta) / (1 - f). Two terms are then added to p / (1 - f):

- The correction for several scattering events into the peak, as in images (`media/aureole`). It
  depends on the optical depth D of the peak between source and camera, to which all positions on
  the path contribute. For small angles, all paths from a source to a camera ray have the same D. At
  all positions together the peak then scatters radiance in proportion to w(D) D, whose derivative
  with respect to the depth is d(w D)/dD, wherever the depth changes. So this takes the place of
  w(D) in derivatives with respect to the scattering coefficient.
- Paths between surfaces attenuate all radiance by the scaled extinction. What the peak scatters of
  sources that they can hit, lamps and bright spots of environments, is then excluded: f / (1 - f)
  times the radiance that is incident from exactly the direction of the ray. For wide lamps the
  difference is that of the moments alone, because their radiance varies little over the angles of
  the peak. Images attenuate these sources by the extinction of the scene instead.
"""

from __future__ import annotations

from copy import copy
from itertools import islice
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis, blurred_polynomials
from mitsuba_irrcache.cache.peak_depths import PeakDepths
from mitsuba_irrcache.core.fast_math import absorptance
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.grids.fields import GridField
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.lights.narrow_sources import MAX_POINT_RADIUS, Source
from mitsuba_irrcache.media.medium import MediumGrid
from mitsuba_irrcache.media.phase import Phase

#: Mean square angle [rad^2] above which the distribution of directions is a Legendre series up to
#: the order of the basis. Its next term is below 2 % there.
WIDE = 0.8


class SourceWeight(NamedTuple):
    """The weight of the irradiance of a source.

    Attributes:
        gain: as `AngularBasis.gains`, with the correction for several scattering events.
        excluded: the part of it that counts as unscattered.
        change: what is added to their difference for derivatives with respect to the scattering
            coefficient.
    """

    gain: mi.Float
    excluded: mi.Float
    change: mi.Float


class SourceDepths:
    """Optical depths of the truncated forward peak of ``medium`` between positions and sources."""

    def __init__(self, medium: MediumGrid, grid: Grid, sources: list[Source]) -> None:
        voxels = dr.arange(mi.UInt32, grid.voxel_count)
        self._depths = PeakDepths(medium, grid, voxels, sources)
        self._fields = [
            GridField(grid, interleaved(channels, grid.voxel_count), len(channels))
            for channels in self._depths.extinctions
        ]

    def at(self, p: mi.Point3f) -> list[mi.Float | mi.Color3f]:
        """Return the depth between world positions and each source."""
        lengths = self._depths.lengths(p)
        return [
            field.at_world(p) * length for field, length in zip(self._fields, lengths, strict=True)
        ]


class SourceWeights:
    """The weights of the sources of ``basis``.

    Args:
        basis: the phase function and the narrow sources.
        depths: optical depths of the peak; None without one.
        visible: whether camera rays attenuate sources that they hit by the scaled extinction.
        factor: factor of the optical depths.
    """

    def __init__(
        self,
        basis: AngularBasis,
        depths: SourceDepths | None,
        visible: bool = False,
        factor: float = 1.0,
    ) -> None:
        self._basis, self._depths, self._visible = basis, depths, visible
        #: f / (1 - f), and factor of the optical depths
        self._share = dr.opaque(mi.Float, basis.phase.peak_ratio)
        self._factor = dr.opaque(mi.Float, factor)
        # Tables are not left to their first use, in a symbolic loop.
        self._changes = None if depths is None else basis.phase.aureole_of_changes

    def scattered_by(self, phase: Phase) -> SourceWeights:
        """Return the weights for another phase function in a medium of the same extinction and
        albedo after delta-M scaling.
        """
        own = self._basis
        basis = AngularBasis(phase, own.sources, order=own.order)
        factor = phase.peak_ratio / own.phase.peak_ratio if phase.forward else 1.0
        return SourceWeights(basis, self._depths, self._visible, factor)

    def without_visible(self) -> SourceWeights:
        """Return the weights for rays that do not see the sources."""
        weights = copy(self)
        weights._visible = False
        return weights

    def at(
        self,
        p: mi.Point3f,
        direction: mi.Vector3f,
        active: mi.Bool,
        peak_depth: mi.Float | mi.Color3f,
    ) -> list[list[SourceWeight]]:
        """Return the weights at ``p`` for rays along ``direction``: for each channel, or for all of
        them, one for each source.

        ``peak_depth`` is the optical depth of the peak between ``p`` and the camera.
        """
        gains, none = self._basis.gains(p, direction, active), mi.Float(0)
        if self._depths is None:
            return [[SourceWeight(gain, none, none) for gain in gains]]
        found = []
        for source, gain, own in zip(self._basis.sources, gains, self._depths.at(p), strict=True):
            depth = (own + peak_depth) * self._factor
            cosine = dr.dot(direction, source.seen_from(p)[0])
            variance = source.variance(p) if source.wide else None
            density = none
            if self._visible and _can_be_hit(source):
                known = mi.Float(MAX_POINT_RADIUS**2) if variance is None else variance
                density = self._share * _density(cosine, known, self._basis.order)
            channels = [depth] if isinstance(depth, mi.Float) else list(depth)
            found.append([self._weight(gain, cosine, d, variance, density) for d in channels])
        if not found:
            return [[]]
        return [list(channel) for channel in zip(*found, strict=True)]

    def _weight(
        self,
        gain: mi.Float,
        cosine: mi.Float,
        depth: mi.Float,
        variance: mi.Float | None,
        density: mi.Float,
    ) -> SourceWeight:
        # docs/primer, eqs. (8.24) and (8.25)
        phase, thin = self._basis.phase, depth < 1e-4
        several = phase.aureole.correction(cosine, depth, variance)
        change = self._changes.correction(cosine, depth, variance) - several
        scattered = absorptance(depth)
        mean = dr.select(thin, 1 - 0.5 * depth, scattered / dr.select(thin, 1, depth))
        return SourceWeight(
            gain + several, density * mean, change - density * (1 - scattered - mean)
        )


def _can_be_hit(source: Source) -> bool:
    """Return whether rays can hit a source: no sun or point."""
    return source.is_spot or not source.sharp


def _density(cosine: mi.Float, variance: mi.Float, order: int) -> mi.Float:
    """Return 4 pi times the distribution of the directions to a source around its centre, whose
    Legendre moments are exp(-l (l + 1) variance / 4).
    """
    angle = dr.safe_acos(cosine)
    narrow = dr.maximum(variance, 1e-6)
    # The heat kernel on the sphere, for short times.
    ratio = dr.sqrt(angle / dr.maximum(dr.sin(angle), 1e-3 * dr.maximum(angle, 1e-3)))
    closed = 4 / narrow * ratio * dr.exp(narrow / 16 - dr.square(angle) / narrow)
    series = sum(
        (2 * degree + 1) * attenuation * polynomial
        for degree, (polynomial, attenuation) in enumerate(
            islice(blurred_polynomials(cosine, variance), order + 1)
        )
    )
    return dr.select(variance < WIDE, closed, series)
