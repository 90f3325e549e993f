"""Sums over batches of samples, the means and errors that follow from them, and the bias of square
roots of noisy means.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.core.immutable import Immutable

#: Samples per batch, unless voxels share their samples.
BATCH = 8
#: Groups of scattering orders whose irradiance is cached separately: order 0, and all others.
ORDER_GROUPS = ("uncollided", "scattered")


class BatchSums(Immutable):
    """Sums of the means of batches of samples at the active voxels.

    The samples of a batch are stratified and hence not independent, but batches are: means and
    errors are statistics of batch means. Methods that add samples return a new object, so that a
    reference to sums remains consistent while another thread adds samples.

    Attributes:
        voxels: number of active voxels.
        channels: number of channels of the irradiance.
        batch: samples per batch.
        moment_count: angular moments per channel, 0 for isotropic scattering.
        is_correlated: whether all voxels share their samples, and hence their errors.
        real: type of the sums: float32 if they are correlated, since there are few batches then,
            otherwise float64.
        streams: samples taken per voxel from each random stream.
        totals: sums of batch means for each order group and channel.
        spreads: for each channel, the sum of squared deviations of the batches' irradiance (of
            all orders) from its mean.
        moments: sums of batch means for each angular moment and channel, float32.
        own_spreads: if `is_correlated`, for each channel the sum of the variances of those parts of
            the batches' irradiance that are sampled for each voxel alone, float32.

    An array that is None stands for 0.
    """

    def __init__(
        self, voxels: int, channels: int, batch: int, moments: int, is_correlated: bool
    ) -> None:
        """Create sums of no samples; ``moments`` is the number of moments per channel."""
        self.voxels, self.channels, self.batch = voxels, channels, batch
        self.moment_count, self.is_correlated = moments, is_correlated
        self.real = mi.Float if is_correlated else dr.float64_array_t(mi.Float)
        self.streams: dict[int, int] = {}
        self.totals: list = [None] * (len(ORDER_GROUPS) * channels)
        self.spreads: list = [None] * channels
        self.moments: list = [None] * (moments * channels)
        self.own_spreads: list = [None] * channels

    def _with(self, **changes: Any) -> BatchSums:
        """Return a copy with other attributes."""
        changed = copy(self)
        changed.__dict__.update(changes)
        return changed

    # ------------------------------------------------------------------ estimates

    @property
    def samples(self) -> int:
        """Samples per active voxel."""
        return sum(self.streams.values())

    def means(self, group: int) -> list[mi.Float]:
        """Return the irradiance of one of the `ORDER_GROUPS` at the active voxels, per channel."""
        n, first = self._batch_count, group * self.channels
        totals = self.totals[first : first + self.channels]
        return [mi.Float(self.zeros if t is None else t / n) for t in totals]

    def irradiance(self) -> list[mi.Float]:
        """Return the irradiance of all orders at the active voxels, per channel."""
        return [a + b for a, b in zip(self.means(0), self.means(1), strict=True)]

    def moment_means(self) -> list[mi.Float]:
        """Return the angular moments at the active voxels, all channels of each in turn."""
        n = mi.Float(self._batch_count)
        return [mi.Float(0) if m is None else m / n for m in self.moments]

    def variance(self, channel: int):
        """Return the squared standard error of the irradiance; None with fewer than two batches."""
        if self.samples < 2 * self.batch:
            return None
        n, spread = self._batch_count, self.spreads[channel]
        return self.zeros if spread is None else spread / (n * (n - 1))

    @property
    def has_own_errors(self) -> bool:
        """Whether errors differ between neighbouring voxels."""
        return not self.is_correlated or any(spread is not None for spread in self.own_spreads)

    def relative_variance(self, mean: mi.Float, channel: int) -> mi.Float:
        """Return the variance of each voxel that is independent of its neighbours, over the squared
        ``mean``, at most 1; 0 if unknown.
        """
        if self.is_correlated:
            n, spread = self._batch_count, self.own_spreads[channel]
            variance = None if spread is None else spread / dr.square(n)
        else:
            variance = self.variance(channel)
        if variance is None:
            return dr.zeros(mi.Float, dr.width(mean))
        # Do not divide squares: they underflow for values below 1e-19.
        error = mi.Float(dr.sqrt(variance)) / dr.select(mean > 0, mean, 1)
        return dr.minimum(dr.square(error), 1)

    @property
    def zeros(self):
        """Zero at all active voxels."""
        return dr.zeros(self.real, max(self.voxels, 1))

    @property
    def _batch_count(self):
        """Number of batches per voxel, at least 1; opaque, because it changes from pass to pass."""
        return dr.opaque(self.real, max(self.samples // self.batch, 1))

    # ------------------------------------------------------------------ more samples

    def with_blocks(
        self, seed: int, samples: int, blocks: list[tuple], own_spreads: list | None = None
    ) -> BatchSums:
        """Return sums with ``samples`` more per voxel from the stream ``seed``, evaluated.

        See `IrradianceCache.add` for the ``blocks`` and ``own_spreads``.
        """
        totals, spreads, *moments = (
            [concatenated(part) for part in zip(*parts, strict=True)]
            for parts in zip(*blocks, strict=True)
        )
        merged = self._merged(totals, spreads, samples // self.batch)
        moments = totals_of_pairs(self.moments, *moments) if moments else self.moments
        own_spreads = own_spreads or [None] * self.channels
        return self._evaluated(merged, moments, own_spreads, {seed: samples})

    def with_sums(self, other: BatchSums) -> BatchSums:
        """Return sums with all samples of ``other`` added, evaluated."""
        merged = self._merged(other.totals, other.spreads, other.samples // other.batch)
        moments = totals_of_pairs(self.moments, other.moments)
        return self._evaluated(merged, moments, other.own_spreads, other.streams)

    def with_count(self, seed: int, samples: int) -> BatchSums:
        """Return sums that count samples whose contribution has been added already or is zero."""
        return self._with(streams=self._counted({seed: samples}))

    def empty(self) -> BatchSums:
        """Return sums of no samples at the same voxels."""
        return BatchSums(
            self.voxels, self.channels, self.batch, self.moment_count, self.is_correlated
        )

    def filled(
        self,
        streams: dict[int, int],
        totals: list,
        spreads: list,
        moments: list,
        own_spreads: list,
    ) -> BatchSums:
        """Return sums at the same voxels with these values."""
        return self._with(
            streams=streams,
            totals=totals,
            spreads=spreads,
            moments=moments,
            own_spreads=own_spreads,
        )

    def _evaluated(
        self,
        merged: tuple[list, list],
        moments: list,
        own_spreads: list,
        streams: dict,
    ) -> BatchSums:
        own_spreads = totals_of_pairs(self.own_spreads, own_spreads)
        dr.eval(merged, moments, own_spreads)
        return self.filled(self._counted(streams), *merged, moments, own_spreads)

    def _counted(self, streams: dict[int, int]) -> dict[int, int]:
        more = {seed: self.streams.get(seed, 0) + n for seed, n in streams.items()}
        return self.streams | more

    def _merged(self, totals: list, spreads: list, count: int) -> tuple[list, list]:
        """Return totals and spreads combined with those of ``count`` more batches (Chan et al.
        1979).
        """
        # docs/primer, eq. (3.5)
        known = self.samples // self.batch
        result = []
        for c, spread in enumerate(spreads):
            old, new = (total(t[c :: self.channels]) for t in (self.totals, totals))
            if known and (old is not None or new is not None):
                n, more = (dr.opaque(self.real, k) for k in (known, count))
                difference = (0 if old is None else old / n) - (0 if new is None else new / more)
                spread = total([spread, dr.square(difference) * (n * more / (n + more))])
            result.append(total([self.spreads[c], spread]))
        return totals_of_pairs(self.totals, totals), result


def concatenated(pieces: tuple):
    """Return the concatenated values of all blocks; None if they are None."""
    if pieces[0] is None:
        return None
    return dr.concat(list(pieces)) if len(pieces) > 1 else pieces[0]


def total(terms):
    """Return the sum of arrays, where None stands for 0."""
    known = [t for t in terms if t is not None]
    return sum(known[1:], known[0]) if known else None


def totals_of_pairs(first: list, second: list) -> list:
    """Return the sums of corresponding elements of two lists, where None stands for 0."""
    return [total(pair) for pair in zip(first, second, strict=True)]


def root_correction(variance: mi.Float) -> mi.Float:
    """Return the factor that removes the bias of interpolated square roots of noisy values.

    Valid for errors that are independent between voxels. With the mean mu and the relative
    ``variance`` v of the voxels x_i, and trilinear weights w_i,
    E[(sum w_i sqrt(x_i))^2] = mu (1 - (1 - sum w_i^2) v / 4) to first order, and the mean of
    sum w_i^2 over a cell is (2/3)^3. Without the correction, 16 samples yield an irradiance that is
    about 1 % too small.
    """
    # docs/primer, eq. (2.3)
    return dr.rsqrt(1 - (1 - 8 / 27) / 4 * variance)
