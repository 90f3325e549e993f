"""The irradiance cache: camera-independent, refined by adding samples, merged, saved, looked up.

Sums over samples, means and errors are in `statistics`, the fields for lookups in `lookups`, the
file format in `storage`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis
from mitsuba_irrcache.cache.angular_field import AngularField
from mitsuba_irrcache.cache.border import BorderProfile
from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.cache.display import as_html, as_text
from mitsuba_irrcache.cache.interpolation import PLAIN, Interpolation
from mitsuba_irrcache.cache.lookups import border_of, irradiance_field, moment_field, on_grid
from mitsuba_irrcache.cache.statistics import BATCH, BatchSums
from mitsuba_irrcache.cache.storage import StoredCache, read_cache, read_description, write_cache
from mitsuba_irrcache.core.locks import ComputationLock
from mitsuba_irrcache.errors import IrrcacheError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.scene.fingerprint import differing
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses


def _consistent(method: Callable) -> Callable:
    """Decorate a method such that it holds the lock of the cache: its sums and numbers of samples
    are consistent while other threads add samples.
    """

    @wraps(method)
    def call(self: IrradianceCache, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            return method(self, *args, **kwargs)

    return call


class IrradianceCache:
    """Irradiance (fluence rate) Phi = int_S2 L dw on a grid.

    The unit is W m^-2, or the scene's unit of radiance times sr. It is the sum of ``uncollided``
    (order 0, directly from emitters) and ``scattered`` (orders 1 to max_depth - 2). Only the
    ``active`` voxels, those that a lookup inside the medium can read, have values; the others are
    zero. ``fingerprint`` maps each input (medium, boundary, emitters, settings) to a digest.
    """

    # docs/primer, eq. (1.4)

    def __init__(
        self,
        grid: Grid,
        active: mi.UInt32,
        channels: int,
        max_depth: int,
        fingerprint: dict[str, str] | None = None,
        batch: int = BATCH,
        correlated: bool = False,
        moments: int = 0,
        interpolation: Interpolation = PLAIN,
    ) -> None:
        """Create an empty cache.

        ``moments`` is the number of angular moments per channel (see `angular`), 0 for isotropic
        scattering. ``correlated`` states that all voxels share their samples, and hence their
        errors.
        """
        self._lock = ComputationLock()
        self.grid = grid
        self.batch = batch  #: samples per batch
        self.active = active
        self.active_count = dr.width(active)
        self.channels = channels
        self.max_depth = max_depth
        self.fingerprint = fingerprint or {}
        self.moments = moments
        self.interpolation = interpolation
        self.correlated = correlated
        self._sums = BatchSums(self.active_count, channels, batch, moments, correlated)

    @_consistent
    def __repr__(self) -> str:
        return as_text(self)

    @_consistent
    def _repr_html_(self) -> str:
        return as_html(self)

    @property
    def directional(self) -> AngularBasis | None:
        """See `Interpolation`."""
        return self.interpolation.directional

    @property
    def falloff(self) -> InverseSquareFactor | None:
        """See `Interpolation`."""
        return self.interpolation.falloff

    @property
    def direct_lights(self) -> tuple[DirectLight, ...]:
        """See `Interpolation`."""
        return self.interpolation.direct_lights

    @property
    def voxel_classes(self) -> VoxelClasses | None:
        """See `Interpolation`."""
        return self.interpolation.voxel_classes

    @property
    @_consistent
    def border(self) -> BorderProfile | None:
        """See `Interpolation`; None if values of neighbouring voxels have different noise."""
        return border_of(self._sums, self.interpolation)

    def empty_copy(self, batch: int = 0) -> IrradianceCache:
        """Return a cache of the same voxels and settings without samples.

        ``batch`` is its number of samples per batch; 0: as in this cache.
        """
        return IrradianceCache(
            self.grid,
            self.active,
            self.channels,
            self.max_depth,
            dict(self.fingerprint),
            batch or self.batch,
            self.correlated,
            self.moments,
            self.interpolation,
        )

    # ------------------------------------------------------------------ statistics

    @property
    def real(self) -> type:
        """Type of the sums; see `BatchSums`."""
        return self._sums.real

    @property
    def streams(self) -> dict[int, int]:
        """Samples taken per voxel from each random stream."""
        return self._sums.streams

    @property
    def samples(self) -> int:
        """Samples per active voxel."""
        return self._sums.samples

    @property
    @_consistent
    def irradiance(self) -> mi.TensorXf:
        """Phi, all orders, (z, y, x, channel)."""
        return self._tensor(self._sums.irradiance())

    @property
    @_consistent
    def uncollided(self) -> mi.TensorXf:
        """Phi of scattering order 0, (z, y, x, channel)."""
        return self._tensor(self._sums.means(0))

    @property
    @_consistent
    def scattered(self) -> mi.TensorXf:
        """Phi of the scattering orders 1 and above, (z, y, x, channel)."""
        return self._tensor(self._sums.means(1))

    @property
    @_consistent
    def standard_error(self) -> mi.TensorXf:
        """Standard error of ``irradiance``, (z, y, x, channel); NaN with fewer than two batches."""
        variances = [self._sums.variance(c) for c in range(self.channels)]
        return self._tensor(
            [
                dr.full(mi.Float, dr.nan, self.active_count) if v is None else mi.Float(dr.sqrt(v))
                for v in variances
            ]
        )

    @_consistent
    def mean_and_error(self) -> tuple[mi.Float, mi.Float]:
        """Return the irradiance and its standard error at the active voxels, averaged over the
        channels.

        Channels share their samples, so their errors add. The error is 0 with fewer than two
        batches.
        """
        means = self._sums.irradiance()
        variances = [self._sums.variance(c) for c in range(self.channels)]
        errors = [mi.Float(0 if v is None else dr.sqrt(v)) for v in variances]
        return sum(means) / self.channels, sum(errors) / self.channels

    @property
    @_consistent
    def relative_error(self) -> float:
        """Root mean square of the voxels' standard errors, divided by the mean irradiance.

        NaN with fewer than two batches. It is inversely proportional to the square root of the
        number of samples.
        """
        if self.samples < 2 * self.batch:
            return float("nan")
        double = dr.float64_array_t(mi.Float)
        mean, error = (double(values) for values in self.mean_and_error())
        scale = dr.mean(mean)[0]
        return float(dr.sqrt(dr.mean(dr.square(error)))[0] / scale) if scale > 0 else 0.0

    @property
    @_consistent
    def relative_variance(self) -> float:
        """Mean relative variance of the voxels that is independent of their neighbours, weighted by
        their irradiance; 0 if unknown.

        Square roots are interpolated, and too small on average for large variances. Each voxel
        contributes at most 1. It is that of the noisiest channel.
        """
        return self._mean_relative_variance(mi.Float(1))

    @_consistent
    def relative_variance_seen_from(self, position: Sequence[float], sigma_t: float) -> float:
        """Mean of the variances of `relative_variance`, weighted by the radiance that a sensor at a
        world ``position`` within the medium, of the mean extinction ``sigma_t``, receives from the
        voxels.
        """
        away = self.grid.centers(self.active) - mi.Point3f(*map(float, position))
        distance = dr.maximum(dr.norm(away), 0.5 * float(self.grid.voxel_size.max()))
        return self._mean_relative_variance(dr.exp(-sigma_t * distance) / dr.square(distance))

    def _mean_relative_variance(self, weights: mi.Float) -> float:
        """Average relative variances with these weights times the irradiance."""
        found = []
        for channel, mean in enumerate(self._sums.irradiance()):
            variance = self._sums.relative_variance(mean, channel)
            found.append((dr.sum(weights * mean * variance), dr.sum(weights * mean)))
        dr.eval(found)
        return max(float(sum_[0]) / max(float(total[0]), 1e-30) for sum_, total in found)

    @property
    def has_own_errors(self) -> bool:
        """Whether errors differ between neighbouring voxels."""
        return self._sums.has_own_errors

    @property
    @_consistent
    def is_finite(self) -> bool:
        """Whether all values are finite in single precision."""
        finite = [dr.all(dr.isfinite(values)) for values in self._sums.irradiance()]
        dr.eval(finite)
        return all(f[0] for f in finite)

    def _tensor(self, values: list[mi.Float]) -> mi.TensorXf:
        return on_grid(self.grid, self.active, values)

    # ------------------------------------------------------------------ lookups

    @_consistent
    def field(self) -> RootField:
        """Create the field for lookups of Phi.

        It excludes `direct_lights` and is divided by the `falloff`, if any. It has one channel if
        all channels are identical. Its ``maximum`` is an upper bound of Phi.
        """
        return irradiance_field(self.grid, self.active, self._sums, self.interpolation)

    @_consistent
    def directional_field(self, channels: int) -> AngularField | None:
        """Create the field for lookups of the angular moments; None for isotropic scattering.

        As `field`, it excludes `direct_lights`.
        """
        if not self.moments:
            return None
        return moment_field(self.grid, self.active, self._sums, self.interpolation, channels)

    @_consistent
    def moment_means(self) -> list[mi.Float]:
        """Return the angular moments at the active voxels, all channels of each in turn."""
        return self._sums.moment_means()

    # ------------------------------------------------------------------ growing

    @_consistent
    def add(
        self,
        seed: int,
        samples: int,
        blocks: list[tuple],
        own_spreads: list[mi.Float | None] | None = None,
    ) -> None:
        """Add ``samples`` per voxel of the stream ``seed``.

        ``blocks`` cover the active voxels in turn. Each is a tuple of lists of arrays: the sums of
        batch means for each order group and channel; for each channel, the sum of squared
        deviations of the batches' irradiance from its mean; and, for anisotropic scattering, the
        sums of batch means for each moment and channel. None, in all blocks, represents 0.
        ``own_spreads`` is that of `BatchSums`; None stands for 0.
        """
        # One assignment: an interrupt cannot leave inconsistent sums.
        self._sums = self._sums.with_blocks(seed, samples, blocks, own_spreads)

    @_consistent
    def note_samples(self, seed: int, samples: int) -> None:
        """Count samples whose contribution has been added already or is exactly zero."""
        self._sums = self._sums.with_count(seed, samples)

    def merge(self, other: IrradianceCache) -> None:
        """Add the samples of ``other``, computed with other seeds.

        Raises IrrcacheError if the caches belong to different scenes or share a seed.
        """
        self._require_alike(other, "merge")
        common = sorted(self.streams.keys() & other.streams.keys())
        if common:
            raise IrrcacheError(
                f"IrradianceCache.merge: both caches were computed with cache_seed {common[0]}, so "
                "their samples are identical, not independent; compute one of them with "
                "another cache_seed."
            )
        self._take(other)

    def append(self, part: IrradianceCache, first: int) -> None:
        """Add the samples of ``part``, which holds consecutive batches of one random stream.

        ``first`` is the index of its first batch in that stream. Appending parts in the order of
        their batches gives bit by bit the cache that `Solver.refine` computes in one process.
        Raises IrrcacheError if the part belongs to another scene, or does not begin with the batch
        that follows those of this cache, so that no batch is counted twice.
        """
        self._require_alike(part, "append")
        (seed,) = part.streams
        present = self.streams.get(seed, 0) // self.batch
        if present != first:
            raise IrrcacheError(
                f"IrradianceCache.append: the part begins with batch {first} of cache_seed {seed}, "
                f"but the cache has {present} batches of it; append the parts in their order."
            )
        self._take(part)

    def _require_alike(self, other: IrradianceCache, method: str) -> None:
        """Raise IrrcacheError unless ``other`` is known to belong to the same scene, and has the
        same voxels and settings.
        """
        if not (self.fingerprint and other.fingerprint):
            raise IrrcacheError(
                f"IrradianceCache.{method}: it is not recorded to which scene the "
                f"{'other ' if self.fingerprint else ''}cache belongs; compute it with the "
                "property cache_file."
            )
        for name in differing(self.fingerprint, other.fingerprint):
            raise IrrcacheError(
                f"IrradianceCache.{method}: the caches belong to different scenes: {name} differs."
            )
        attributes = ("max_depth", "channels", "batch", "correlated", "moments")
        mine = {"shape": self.grid.shape} | {name: getattr(self, name) for name in attributes}
        its = {"shape": other.grid.shape} | {name: getattr(other, name) for name in attributes}
        if mine != its:
            differences = ", ".join(
                f"{name} {mine[name]} does not fit {name} {its[name]}"
                for name in mine
                if mine[name] != its[name]
            )
            raise IrrcacheError(f"IrradianceCache.{method}: {differences}.")
        if other.grid.shared(self.grid) is not self.grid:
            raise IrrcacheError(
                f"IrradianceCache.{method}: the grids of the caches are at different places; "
                "compute both with the same scene."
            )
        if not np.array_equal(np.array(self.active), np.array(other.active)):
            raise IrrcacheError(
                f"IrradianceCache.{method}: the caches have values in different voxels, "
                f"{self.active_count} and {other.active_count}; compute both with the same scene."
            )

    def _take(self, other: IrradianceCache) -> None:
        """Add all samples of ``other``."""
        with other._lock:  # never hold both locks: two threads may merge two caches into each other
            sums = other._sums
        with self._lock:
            self._sums = self._sums.with_sums(sums)

    # ------------------------------------------------------------------ files

    @_consistent
    def save(self, path: str | Path, fingerprint: dict[str, str] | None = None) -> None:
        """Write the cache with all its statistics, atomically: no partial file remains after a
        failure.

        ``fingerprint`` is stored in place of ``self.fingerprint`` if it is given.
        """
        fingerprint = self.fingerprint if fingerprint is None else fingerprint
        stored = StoredCache(self.grid, self.active, self.max_depth, fingerprint, self._sums)
        write_cache(path, stored)

    @classmethod
    def load(cls, path: str | Path, interpolation: Interpolation = PLAIN) -> IrradianceCache:
        """Read a cache that ``save`` wrote; its ``interpolation`` is not part of the file.

        Raises CacheFileError, naming the file, for anything else.
        """
        stored = read_cache(path)
        sums = stored.sums
        cache = cls(
            stored.grid,
            stored.active,
            sums.channels,
            stored.max_depth,
            stored.fingerprint,
            sums.batch,
            sums.is_correlated,
            sums.moment_count,
            interpolation,
        )
        cache._sums = sums
        return cache

    @staticmethod
    def description_of(path: str | Path) -> tuple[dict[str, str], int]:
        """Return the fingerprint of a file and its samples per voxel, without reading the arrays.

        Raises the same errors as `load`.
        """
        return read_description(path)

    def export_vol(self, path: str | Path) -> None:
        """Write ``irradiance`` as a Mitsuba ``.vol`` file (float32, bounding box of the grid).

        A rotation of the grid is lost.
        """
        from mitsuba_irrcache.io.mitsuba_vol import write_vol

        corners = (
            self.grid.to_world
            @ np.array(
                [[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64
            ).T
        )
        write_vol(
            path, np.array(self.irradiance), (corners[:3].min(axis=1), corners[:3].max(axis=1))
        )
