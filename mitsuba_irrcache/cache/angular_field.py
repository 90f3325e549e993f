"""The factor of anisotropic scattering, looked up between voxels (see `angular`)."""

from __future__ import annotations

from copy import copy
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.core.sequences import random_stream
from mitsuba_irrcache.core.spectrum import interleaved
from mitsuba_irrcache.grids.grid import Grid, stencil

#: Number of values per gather (a packet).
WIDTH = 4


class SourceDepths(Protocol):
    """Optical depths of a forward peak between voxels and narrow sources, see `PeakDepths`."""

    channels: int
    extinctions: list[list[mi.Float]]

    def lengths(self, p: mi.Point3f) -> list[mi.Float]:
        """Return the length in the medium of the line from ``p`` to each source."""


class AngularField:
    """The factor f as a field.

    ``phi`` are the values of Phi at all voxels, one array per channel; ``moments`` those of the
    moments L_lm and E_k, all channels of each in turn.
    """

    def __init__(
        self,
        directional: AngularBasis,
        grid: Grid,
        phi: list[mi.Float],
        moments: list[mi.Float],
        depths: SourceDepths | None = None,
        extinctions: list[mi.Float] | None = None,
    ) -> None:
        """``depths`` are the optical depths of the forward peak to the sources, with their
        ``extinctions`` at all voxels, all channels of each source in turn. None: multiple
        scattering into the peak is not corrected.
        """
        self.directional, self.grid, self.channels = directional, grid, len(phi)
        self._depths, self._moments = depths, len(moments) // len(phi)
        sources = len(directional.sources) if depths is not None else 0
        rows = []
        for c, irradiance in enumerate(phi):
            own = moments[c :: self.channels]
            # The interpolated mean extinction is weighted by the irradiance of the source.
            weighted = [
                own[k - sources] * extinctions[depths.channels * k + min(c, depths.channels - 1)]
                for k in range(sources)
            ]
            rows += [irradiance, *own, *weighted]
        self._row = len(rows) // self.channels
        self._loads = -(-len(rows) // WIDTH)
        rows += [mi.Float(0)] * (self._loads * WIDTH - len(rows))
        self.data = interleaved(rows, grid.voxel_count)
        dr.eval(self.data)

    def in_basis(self, directional: AngularBasis) -> AngularField:
        """Return a field of the same moments for another phase function."""
        field = copy(self)
        field.directional = directional
        return field

    def factor(
        self,
        p: mi.Point3f,
        direction: mi.Vector3f,
        basis: list[mi.Float],
        active: mi.Bool,
        with_peak: bool = True,
        peak_depth: mi.Float | mi.Color3f | None = None,
    ) -> mi.Float | mi.Color3f:
        """Evaluate f at ``p`` for a ray along ``direction``.

        ``basis`` is the result of `AngularBasis.basis`; ``with_peak`` as in `AngularBasis.gains`.
        ``peak_depth`` is the optical depth of scattering into the forward peak between ``p`` and
        the camera; None: multiple scattering into the peak is not corrected.
        """
        directional = self.directional
        rows = self._interpolated(self.grid.coordinates.point(p), active)
        weights = basis + directional.gains(p, direction, active, with_peak)
        corrections = [[]] * self.channels
        if with_peak and peak_depth is not None:
            corrections = self._corrections(p, direction, rows, peak_depth)
        found = []
        for (phi, *values), correction in zip(rows, corrections, strict=True):
            moments = values[: self._moments]
            extra = sum(w * m for w, m in zip(weights, moments, strict=True))
            narrow = moments[len(basis) :]
            extra += sum(w * m for w, m in zip(correction, narrow, strict=False))
            # A truncated series may be negative, and noisy moments are unbounded.
            found.append(dr.clip(1 + _ratio(extra, phi), 0, directional.largest_ratio))
        return found[0] if self.channels == 1 else mi.Color3f(found)

    def factor_and_change(
        self,
        p: mi.Point3f,
        basis: list[mi.Float],
        active: mi.Bool,
        narrow: list[list[tuple[mi.Float, mi.Float, mi.Float]]],
    ) -> tuple[mi.Float | mi.Color3f, mi.Float | mi.Color3f]:
        """Evaluate f with other weights of the narrow sources, and f plus a change.

        ``narrow`` has, for each channel or for all of them, three weights of each source: one in
        the place of `AngularBasis.gains`, one to subtract without limits to f, and that of the
        change.
        """
        found = []
        rows = self._interpolated(self.grid.coordinates.point(p), active)
        channels = narrow * (self.channels // len(narrow))
        for (phi, *values), own in zip(rows, channels, strict=True):
            moments = values[: self._moments]
            gains, excluded, changes = zip(*own, strict=True) if own else ((), (), ())
            extra = sum(w * m for w, m in zip([*basis, *gains], moments, strict=True))
            sources = moments[len(basis) :]
            f = dr.clip(1 + _ratio(extra, phi), 0, self.directional.largest_ratio)
            f -= _ratio(sum(w * e for w, e in zip(excluded, sources, strict=True)), phi)
            change = _ratio(sum(w * e for w, e in zip(changes, sources, strict=True)), phi)
            found.append((f, f + change))
        if self.channels == 1:
            return found[0]
        values, changed = zip(*found, strict=True)
        return mi.Color3f(*values), mi.Color3f(*changed)

    def sampled_factor(
        self, p: mi.Point3f, direction: mi.Vector3f, basis: list[mi.Float], active: mi.Bool
    ) -> mi.Float | mi.Color3f:
        """Estimate f without the forward peak from the moments of a single voxel next to ``p``.

        The voxel is chosen with the weights of the interpolation, so that the mean over positions
        is that of the interpolated moments, with a fifth of the memory accesses. The result is not
        clipped, since the truncated series is right on average over directions.
        """
        # docs/primer, eq. (5.13)
        place = self.grid.coordinates.point(p)
        rows, voxel = self._interpolated(place, active), self._random_voxel(place)
        weights = basis + self.directional.gains(p, direction, active, with_peak=False)
        found = []
        for (phi, *_), (_, *values) in zip(rows, self._rows(self._at(voxel, active)), strict=True):
            moments = values[: self._moments]
            extra = sum(w * m for w, m in zip(weights, moments, strict=True))
            found.append(1 + _ratio(extra, phi))
        return found[0] if self.channels == 1 else mi.Color3f(found)

    def peak_factor(
        self,
        p: mi.Point3f,
        direction: mi.Vector3f,
        active: mi.Bool,
        peak_depth: mi.Float | mi.Color3f,
    ) -> mi.Float | mi.Color3f:
        """Evaluate the part of `factor` due to radiance of narrow sources that a truncated forward
        peak scatters.
        """
        directional, sources = self.directional, len(self.directional.sources)
        rows = self._interpolated(self.grid.coordinates.point(p), active)
        gains = [directional.gains(p, direction, active, with_peak) for with_peak in (True, False)]
        weights = [peaked - smooth for peaked, smooth in zip(*gains, strict=True)]
        found = []
        for row, correction in zip(
            rows, self._corrections(p, direction, rows, peak_depth), strict=True
        ):
            narrow = row[1 + self._moments - sources : 1 + self._moments]
            own = correction or [0.0] * sources
            extra = sum((w + c) * m for w, c, m in zip(weights, own, narrow, strict=True))
            limit = directional.largest_ratio
            found.append(dr.clip(_ratio(extra, row[0]), -limit, limit))
        return found[0] if self.channels == 1 else mi.Color3f(found)

    def _corrections(
        self,
        p: mi.Point3f,
        direction: mi.Vector3f,
        rows: list[list[mi.Float]],
        peak_depth: mi.Float | mi.Color3f,
    ) -> list[list[mi.Float]]:
        """Return, for each channel, the corrections of the gains of narrow sources."""
        if self._depths is None:
            return [[]] * self.channels
        depths = self._depths_to_camera(p, rows, peak_depth)
        found = [self.directional.corrections(p, direction, d) for d in depths]
        return found * (self.channels // len(found))

    def _depths_to_camera(
        self, p: mi.Point3f, rows: list[list[mi.Float]], peak_depth: mi.Float | mi.Color3f
    ) -> list[list[mi.Float]]:
        """Return the optical depths of the peak from each source via ``p`` to the camera.

        One list over the sources per channel, or a single one if all channels are equal.
        """
        sources, found = len(self.directional.sources), []
        before = [peak_depth] if isinstance(peak_depth, mi.Float) else list(peak_depth)
        groups = [[row] for row in rows] if len(before) > 1 and len(rows) > 1 else [rows]
        lengths = self._depths.lengths(p)
        for group, depth in zip(groups, before, strict=False):
            total = []
            for k, length in enumerate(lengths):
                irradiance = sum(row[1 + self._moments - sources + k] for row in group)
                weighted = sum(row[1 + self._moments + k] for row in group)
                mean = dr.select(irradiance > 0, weighted / irradiance, 0)
                total.append(dr.fma(mean, length, depth))
            found.append(total)
        return found

    def _interpolated(self, u: mi.Point3f, active: mi.Bool) -> list[list[mi.Float]]:
        """Interpolate the stored values trilinearly; return the rows of the channels."""
        sums = [mi.Vector4f(0)] * self._loads
        for voxel, weight in self.grid.corners(u):
            packets = self._at(voxel, active)
            sums = [dr.fma(weight, packet, s) for packet, s in zip(packets, sums, strict=True)]
        return self._rows(sums)

    def _at(self, voxel: mi.UInt32, active: mi.Bool) -> list[mi.Vector4f]:
        """Return the packets of values that are stored at voxels."""
        places = (voxel * self._loads + k for k in range(self._loads))
        return [dr.gather(mi.Vector4f, self.data, place, active) for place in places]

    def _rows(self, packets: list[mi.Vector4f]) -> list[list[mi.Float]]:
        values = [value for packet in packets for value in packet]
        return [values[c * self._row : (c + 1) * self._row] for c in range(self.channels)]

    def _random_voxel(self, u: mi.Point3f) -> mi.UInt32:
        """Choose one of the voxels around ``u`` with the weights of the interpolation, by a hash of
        the position.
        """
        x, y, z = (dr.reinterpret_array(mi.UInt32, c) for c in u)
        rng = random_stream(mi.sample_tea_32(x ^ (z * 0x9E3779B9), y))
        chosen = []
        for c, n in zip(u, self.grid.sides, strict=True):
            lower, weight, more = stencil(c, n)
            chosen.append(lower + dr.select(more & (rng.next_float32() < weight), 1, 0))
        return self.grid.index(*chosen)


def _ratio(value: mi.Float, phi: mi.Float) -> mi.Float:
    """Return ``value / phi``, 0 where there is no irradiance."""
    return dr.select(phi > 0, value / dr.select(phi > 0, phi, 1), 0)
