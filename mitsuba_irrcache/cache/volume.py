"""The irradiance cache: a camera-independent field with statistics, merging and files."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from threading import RLock
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.angular import AngularBasis, AngularField
from mitsuba_irrcache.cache.conservative import conserving, share_of_noise
from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.cache.display import as_html, as_text
from mitsuba_irrcache.cache.interpolation import PLAIN, Interpolation
from mitsuba_irrcache.cache.statistics import concatenated, root_correction, total, totals_of_pairs
from mitsuba_irrcache.cache.storage import (
    ARRAYS,
    FORMAT,
    MAX_BATCH,
    WITH_MOMENTS,
    check_digest,
    digest_of_arrays,
    digest_of_description,
    read_arrays,
    samples_by_seed,
    unreadable,
)
from mitsuba_irrcache.core.spectrum import scatter_channels
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import marked
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.scene.fingerprint import differing
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses

#: Samples per batch. The samples of a batch are stratified and hence not independent, but batches
#: are: means and errors are statistics of batch means.
BATCH = 8


LAYERS = ("uncollided", "scattered")


def _consistent(method: Callable) -> Callable:
    """Decorate a method such that it sees consistent sums and numbers of samples."""

    @wraps(method)
    def call(self: IrradianceCache, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            return method(self, *args, **kwargs)

    return call


class IrradianceCache:
    """Irradiance (fluence rate) Phi = int_S2 L dw on a grid.

    The unit is W m^-2, or the scene's unit of radiance times sr. There are two layers:
    ``uncollided`` (directly from emitters) and ``scattered`` (orders 1 to max_depth - 2). Only the
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
        errors. Sums are then float32, because there are few batches, otherwise float64.
        """
        self._lock = RLock()
        self.grid = grid
        self.batch = batch  #: samples per batch
        self.active = active
        self.active_count = dr.width(active)
        self.channels = channels
        self.max_depth = max_depth
        self.fingerprint = fingerprint or {}
        self.moments = moments
        self.interpolation = interpolation
        #: samples taken per voxel from each random stream
        self.streams: dict[int, int] = {}
        self.correlated = correlated
        self.real = mi.Float if correlated else dr.float64_array_t(mi.Float)
        # Sums of batch means for each layer and channel; for each channel the sum of squared
        # deviations of the batches' irradiance (both layers) from its mean. None stands for 0.
        self._totals: list = [None] * (len(LAYERS) * channels)
        self._spreads: list = [None] * channels
        # Sums of batch means for each moment and channel, in float32.
        self._moments: list = [None] * (moments * channels)

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

    def empty_copy(self, batch: int = 0) -> IrradianceCache:
        """Return a cache of the same voxels and settings without samples; ``batch``: those of a
        batch, if they differ.
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
    def samples(self) -> int:
        """Samples per active voxel."""
        return sum(self.streams.values())

    @property
    @_consistent
    def irradiance(self) -> mi.TensorXf:
        """Phi, both layers, (z, y, x, channel)."""
        return self._tensor(self._both_layers())

    @property
    @_consistent
    def uncollided(self) -> mi.TensorXf:
        """Phi of scattering order 0, (z, y, x, channel)."""
        return self._tensor(self._means(0))

    @property
    @_consistent
    def scattered(self) -> mi.TensorXf:
        """Phi of the scattering orders 1 and above, (z, y, x, channel)."""
        return self._tensor(self._means(1))

    @property
    @_consistent
    def standard_error(self) -> mi.TensorXf:
        """Standard error of ``irradiance``, (z, y, x, channel); NaN with fewer than two batches."""
        variances = [self._variance(c) for c in range(self.channels)]
        return self._tensor(
            [
                dr.full(mi.Float, dr.nan, self.active_count) if v is None else mi.Float(dr.sqrt(v))
                for v in variances
            ]
        )

    @_consistent
    def mean_and_error(self) -> tuple[mi.Float, mi.Float]:
        """Irradiance and its standard error at the active voxels, averaged over the channels.

        Channels share their samples, so their errors add. The error is 0 with fewer than two
        batches.
        """
        means = self._both_layers()
        variances = [self._variance(c) for c in range(self.channels)]
        errors = [mi.Float(0 if v is None else dr.sqrt(v)) for v in variances]
        return sum(means) / self.channels, sum(errors) / self.channels

    @property
    @_consistent
    def relative_error(self) -> float:
        """Root mean square of the voxels' standard errors over the mean irradiance.

        NaN with fewer than two batches. It is inversely proportional to the root of the number of
        samples.
        """
        if self.samples < 2 * self.batch:
            return float("nan")
        double = dr.float64_array_t(mi.Float)
        mean, error = (double(values) for values in self.mean_and_error())
        scale = dr.mean(mean)[0]
        return float(dr.sqrt(dr.mean(dr.square(error)))[0] / scale) if scale > 0 else 0.0

    @property
    @_consistent
    def is_finite(self) -> bool:
        """Whether all values are finite in single precision."""
        pairs = zip(self._means(0), self._means(1), strict=True)
        finite = [dr.all(dr.isfinite(a + b)) for a, b in pairs]
        dr.eval(finite)
        return all(f[0] for f in finite)

    def _variance(self, channel: int):
        """Squared standard error of the irradiance; None with fewer than two batches."""
        if self.samples < 2 * self.batch:
            return None
        n, spread = self._batch_count, self._spreads[channel]
        return self._zeros if spread is None else spread / (n * (n - 1))

    @_consistent
    def field(self) -> RootField:
        """Create the field for lookups of Phi.

        It excludes `direct_lights` and is divided by the `falloff`, if any. It has one channel if
        all channels are identical. Its ``maximum`` is an upper bound of Phi.
        """
        brightest = [dr.max(m)[0] for m in self._both_layers()] if self.direct_lights else []
        brightest += [light.maximum for light in self.direct_lights]
        means = self._interpolated_means()
        known, roots = marked(self.grid, self.active), [dr.sqrt(m) for m in means]
        variance = share = None
        if not self.correlated:  # errors shared by neighbours do not bias interpolation
            noise = [self._relative_variance(m, c) for c, m in enumerate(means)]
            share = share_of_noise(self.grid, self._tensor([sum(noise) / len(noise)]).array, known)
            rest = 1 - dr.gather(mi.Float, share, self.active)
            roots = [r * root_correction(v * rest) for r, v in zip(roots, noise, strict=True)]
        if all(dr.all(r == roots[0])[0] for r in roots[1:]):
            roots = roots[:1]
        channels = len(roots)
        if self.falloff is not None:
            smooth = dr.rsqrt(self.falloff.of_voxels(self.active))
            roots = [r * smooth for r in roots]
        values = self._tensor(roots).array
        if not self.correlated:
            variance = self._tensor(noise[:channels]).array
        separated = None if self.voxel_classes is None else self.voxel_classes.separated
        values = conserving(self.grid, values, known, channels, share, separated)
        if self.voxel_classes is not None:
            values = self.voxel_classes.filled(values, channels)
        field = RootField(self.grid, values, channels, variance)
        if self.falloff is not None:
            field.maximum *= self.falloff.maximum(self.active)
        field.maximum = max(field.maximum, *brightest, 0.0)
        return field

    @_consistent
    def directional_field(self, channels: int) -> AngularField | None:
        """Create the field for lookups of the angular moments; None for isotropic scattering.

        As `field`, it excludes `direct_lights`.
        """
        if not self.moments:
            return None
        scattered = []
        for values in (self._interpolated_means(), self.moment_means()):
            chosen = [v for i, v in enumerate(values) if i % self.channels < channels]
            if self.voxel_classes is not None and self.voxel_classes.inside is not None:
                inside = dr.gather(mi.Bool, self.voxel_classes.inside, self.active)
                chosen = [dr.select(inside, v, 0) for v in chosen]
            scattered.append([self._tensor([v]).array for v in chosen])
        return AngularField(self.directional, self.grid, *scattered)

    @_consistent
    def moment_means(self) -> list[mi.Float]:
        """Angular moments at the active voxels, all channels of each in turn."""
        n = mi.Float(self._batch_count)
        return [mi.Float(0) if m is None else m / n for m in self._moments]

    def _interpolated_means(self) -> list[mi.Float]:
        """Phi of the active voxels in each channel, without `direct_lights`."""
        means = self._both_layers()
        for light in self.direct_lights:
            means = [dr.maximum(m - e, 0) for m, e in zip(means, light.irradiance, strict=False)]
        return means

    def _relative_variance(self, mean: mi.Float, channel: int) -> mi.Float:
        """Variance of the voxels over their squared mean, at most 1; 0 if unknown."""
        variance = self._variance(channel)
        if variance is None:
            return dr.zeros(mi.Float, dr.width(mean))
        # Do not divide squares: they underflow for values below 1e-19.
        error = mi.Float(dr.sqrt(variance)) / dr.select(mean > 0, mean, 1)
        return dr.minimum(dr.square(error), 1)

    def _both_layers(self) -> list[mi.Float]:
        """Phi of the active voxels in each channel."""
        return [a + b for a, b in zip(self._means(0), self._means(1), strict=True)]

    def _means(self, layer: int) -> list[mi.Float]:
        n, first = self._batch_count, layer * self.channels
        totals = self._totals[first : first + self.channels]
        return [mi.Float(self._zeros if t is None else t / n) for t in totals]

    @property
    def _zeros(self):
        """Zero at all active voxels."""
        return dr.zeros(self.real, max(self.active_count, 1))

    @property
    def _batch_count(self):
        """Number of batches per voxel, at least 1; opaque, because it changes from pass to pass."""
        return dr.opaque(self.real, max(self.samples // self.batch, 1))

    def _tensor(self, values: list[mi.Float]) -> mi.TensorXf:
        flat = dr.zeros(mi.Float, self.grid.voxel_count * len(values))
        if self.active_count:
            scatter_channels(flat, values, self.active)
        return mi.TensorXf(flat, (*self.grid.shape, len(values)))

    # ------------------------------------------------------------------ growing

    @_consistent
    def add(self, seed: int, samples: int, blocks: list[tuple]) -> None:
        """Add ``samples`` per voxel of the stream ``seed``.

        Each block of voxels consists of the sums of batch means for each layer and channel, the
        squared deviations of the batches' irradiance from their mean for each channel (None, in all
        blocks, stands for 0), and, if any, the sums of batch means for each moment and channel.
        """
        totals, spreads, *moments = (
            [concatenated(part) for part in zip(*parts, strict=True)]
            for parts in zip(*blocks, strict=True)
        )
        merged = self._merged(totals, spreads, samples // self.batch)
        moments = totals_of_pairs(self._moments, *moments) if moments else self._moments
        dr.eval(merged, moments)
        # Assign in one statement, so that an interrupt cannot leave inconsistent sums.
        self._totals, self._spreads, self._moments, self.streams = (
            *merged,
            moments,
            self._streams_with(seed, samples),
        )

    def _merged(self, totals: list, spreads: list, count: int) -> tuple[list, list]:
        """Combine the sums with those of ``count`` more batches (Chan et al. 1979)."""
        # docs/primer, eq. (3.5)
        known = self.samples // self.batch
        result = []
        for c, spread in enumerate(spreads):
            old, new = (total(t[c :: self.channels]) for t in (self._totals, totals))
            if known and (old is not None or new is not None):
                n, more = (dr.opaque(self.real, k) for k in (known, count))
                difference = (0 if old is None else old / n) - (0 if new is None else new / more)
                spread = total([spread, dr.square(difference) * (n * more / (n + more))])
            result.append(total([self._spreads[c], spread]))
        return totals_of_pairs(self._totals, totals), result

    @_consistent
    def note_samples(self, seed: int, samples: int) -> None:
        """Count samples whose contribution has been added already or is exactly zero."""
        self.streams = self._streams_with(seed, samples)

    def _streams_with(self, seed: int, samples: int) -> dict[int, int]:
        return self.streams | {seed: self.streams.get(seed, 0) + samples}

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
        """Add a ``part`` of one random stream whose first batch has the number ``first`` there.

        Parts that `refine` of the solver would add one by one, appended in this order, give the
        same bits. Raises IrrcacheError if the part belongs to another scene, or does not continue
        the samples of this cache, so that no batch is counted twice.
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
        """Raise IrrcacheError if ``other`` belongs to another scene or has other settings."""
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

    def _take(self, other: IrradianceCache) -> None:
        """Add all samples of ``other``."""
        with other._lock:  # never hold both locks: two threads may merge two caches into each other
            totals, spreads, moments = other._totals, other._spreads, other._moments
            streams = other.streams
        with self._lock:
            count = sum(streams.values()) // other.batch
            merged = self._merged(totals, spreads, count)
            moments = totals_of_pairs(self._moments, moments)
            dr.eval(merged, moments)
            self._totals, self._spreads, self._moments, self.streams = (
                *merged,
                moments,
                self.streams | {s: self.streams.get(s, 0) + n for s, n in streams.items()},
            )

    # ------------------------------------------------------------------ files

    @_consistent
    def save(self, path: str | Path, fingerprint: dict[str, str] | None = None) -> None:
        """Writes the cache with all its statistics; the file appears whole or not at all.
        ``fingerprint`` takes the place of the cache's own.
        """
        description = {
            "format": WITH_MOMENTS if self.moments else FORMAT,
            "shape": self.grid.shape,
            "to_world": self.grid.to_world.tolist(),
            "channels": self.channels,
            "batch": self.batch,
            "correlated": self.correlated,
            **({"moments": self.moments} if self.moments else {}),
            "max_depth": self.max_depth,
            "streams": {str(seed): n for seed, n in self.streams.items()},
            "fingerprint": self.fingerprint if fingerprint is None else fingerprint,
        }
        arrays = {
            "active": np.array(self.active),
            "totals": self._plain(self._totals),
            "spreads": self._plain(self._spreads),
            **({"moments": self._plain(self._moments, np.float32)} if self.moments else {}),
        }
        description["values"] = digest_of_arrays(arrays)
        description["digest"] = digest_of_description(description)
        encoded = np.frombuffer(json.dumps(description).encode(), dtype=np.uint8)
        with atomic_write(path) as file:
            np.savez(file, description=encoded, **arrays)

    def _plain(self, values: list, kind: type | None = None) -> np.ndarray:
        return np.array([np.array(self._zeros if v is None else v, kind) for v in values])

    @classmethod
    def load(cls, path: str | Path, interpolation: Interpolation = PLAIN) -> IrradianceCache:
        """Reads a cache that ``save`` wrote; a file does not hold its ``interpolation``. Raises
        CacheFileError, naming the file, for anything else.
        """
        path = Path(path)
        try:
            arrays = read_arrays(path)
            description = json.loads(arrays["description"].tobytes())
            if description["format"] not in (FORMAT, WITH_MOMENTS):
                raise CacheFileError(
                    f'"{path}" has the format {description["format"]!r}, this version reads '
                    f"{FORMAT!r} and {WITH_MOMENTS!r}."
                )
            return cls._restore(description, arrays, interpolation)
        except CacheFileError:
            raise
        except Exception as error:  # a damaged file may cause any exception
            raise unreadable(path, error) from error

    @staticmethod
    def description_of(path: str | Path) -> tuple[dict[str, str], int]:
        """Return the fingerprint of a file and its samples per voxel, without reading the arrays.

        Raises the same errors as `load`.
        """
        try:
            description = json.loads(read_arrays(Path(path), ())["description"].tobytes())
            check_digest(description)
            return dict(description["fingerprint"]), sum(samples_by_seed(description).values())
        except Exception as error:  # as in `load`
            raise unreadable(path, error) from error

    @classmethod
    def _restore(
        cls, description: dict, arrays: dict[str, np.ndarray], interpolation: Interpolation
    ) -> IrradianceCache:
        grid = Grid(tuple(int(n) for n in description["shape"]), np.array(description["to_world"]))
        active, totals, spreads = (arrays[name] for name in ARRAYS)
        channels = int(description["channels"])
        if active.dtype != np.uint32 or active.ndim != 1 or active.size > grid.voxel_count:
            raise ValueError("its list of voxels does not fit its grid")
        if active.size and (
            int(active[-1]) >= grid.voxel_count or (np.diff(active.astype(np.int64)) <= 0).any()
        ):
            raise ValueError("its list of voxels is out of order")
        width = max(active.size, 1)
        expected = (len(LAYERS) * channels, width), (channels, width)
        if channels not in (1, 3) or (totals.shape, spreads.shape) != expected:
            raise ValueError(f"sums of shape {totals.shape} where {expected[0]} is expected")
        correlated = bool(description["correlated"])
        real = np.float32 if correlated else np.float64
        if totals.dtype != real or spreads.dtype != real:
            raise ValueError(f"sums of type {totals.dtype}")
        count = int(description.get("moments", 0))
        moments = arrays["moments"] if count else np.zeros((0, width), np.float32)
        if (moments.shape, moments.dtype) != ((count * channels, width), np.float32):
            raise ValueError(f"moments of shape {moments.shape} and type {moments.dtype}")
        largest = np.max([np.abs(v).max(initial=0) for v in (totals, spreads, moments)])
        if not largest < float(np.finfo(np.float32).max):  # NaN too
            raise ValueError("it contains values that are not finite")
        if min(values.min(initial=0) for values in (totals, spreads)) < 0:
            raise ValueError("it contains negative values")
        streams, batch = samples_by_seed(description), int(description["batch"])
        smallest, largest = (1, MAX_BATCH) if correlated else (BATCH, BATCH)
        if not smallest <= batch <= largest or any(n % batch for n in streams.values()):
            raise ValueError(f"samples {streams} in batches of {batch}")
        batches = sum(streams.values()) // batch
        if (batches < 1 and totals.any()) or (batches < 2 and spreads.any()):
            raise ValueError(f"non-zero sums, but only {batches} batches of samples")
        check_digest(description)
        if digest_of_arrays(arrays) != description["values"]:
            raise ValueError("its values are not those that were saved")
        cache = cls(
            grid,
            mi.UInt32(active),
            channels,
            int(description["max_depth"]),
            dict(description["fingerprint"]),
            batch,
            correlated,
            count,
            interpolation,
        )
        cache._moments = [mi.Float(t) if t.any() else None for t in moments]
        cache.streams = streams
        cache._totals = [cache.real(t) if t.any() else None for t in totals]
        cache._spreads = [cache.real(t) if t.any() else None for t in spreads]
        return cache

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
