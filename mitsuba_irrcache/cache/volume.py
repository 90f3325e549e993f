"""The irradiance cache: a camera-independent field with its statistics, kept, merged, saved and
loaded.
"""

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
from mitsuba_irrcache.cache.conservative import conserving
from mitsuba_irrcache.cache.direct_light import DirectLight
from mitsuba_irrcache.cache.interpolation import PLAIN, Interpolation
from mitsuba_irrcache.cache.statistics import concatenated, root_correction, total, totals_of_pairs
from mitsuba_irrcache.cache.storage import (
    ARRAYS,
    FORMAT,
    LARGEST_BATCH,
    WITH_MOMENTS,
    check_digest,
    digest_of_arrays,
    digest_of_description,
    read_arrays,
    samples_by_seed,
    unreadable,
)
from mitsuba_irrcache.errors import CacheFileError, IrrcacheError
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.grids.occupancy import marked
from mitsuba_irrcache.grids.root_field import RootField
from mitsuba_irrcache.io.files import atomic_write
from mitsuba_irrcache.lights.falloff import InverseSquareFactor
from mitsuba_irrcache.scene.fingerprint import differing
from mitsuba_irrcache.scene.voxel_classes import VoxelClasses

#: Samples of a voxel come in batches of this many, spread evenly over directions. They are not
#: independent of each other, the batches are: means and errors are statistics of batch means.
BATCH = 8


LAYERS = ("uncollided", "scattered")


def _consistent(method: Callable) -> Callable:
    """Lets a method of a cache see its sums and its number of samples as they belong together."""

    @wraps(method)
    def call(self: IrradianceCache, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            return method(self, *args, **kwargs)

    return call


class IrradianceCache:
    """Irradiance (fluence rate) Phi = int_S2 L dw [W m^-2, or the scene's unit of radiance times
    sr] on a grid.

    It has two layers: ``uncollided`` (light straight from the emitters) and ``scattered`` (all
    later orders, up to what ``max_depth`` admits: orders 0 .. max_depth - 2). Only ``active``
    voxels, those that a lookup inside the medium can read, have values; the others are zero.
    ``fingerprint`` maps each ingredient of the light (medium, boundary, emitters, settings) to a
    digest.
    """

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
        """``moments`` of the radiance are kept for each channel, where a medium is not isotropic;
        see `angular`. ``correlated``: whether all voxels share their samples, and so their
        errors. Such batches are few: sums are kept in float32 then, else in float64.
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
        # Sums of batch means for each layer and channel, and for each channel the sum of squared
        # deviations of the batches' irradiance, both layers, from its mean. None stands for 0.
        self._totals: list = [None] * (len(LAYERS) * channels)
        self._spreads: list = [None] * channels
        # Sums of batch means for each moment and channel, in float32.
        self._moments: list = [None] * (moments * channels)

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

    # ------------------------------------------------------------------ statistics

    @property
    def samples(self) -> int:
        """Samples per active voxel."""
        return sum(self.streams.values())

    @property
    @_consistent
    def irradiance(self) -> mi.TensorXf:
        """Phi, both layers, (z, y, x, channel)."""
        return self._tensor([a + b for a, b in zip(self._means(0), self._means(1), strict=True)])

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
        """Standard error of ``irradiance``, (z, y, x, channel); NaN before there are two batches of
        samples.
        """
        variances = [self._variance(c) for c in range(self.channels)]
        return self._tensor(
            [
                dr.full(mi.Float, dr.nan, self.active_count) if v is None else mi.Float(dr.sqrt(v))
                for v in variances
            ]
        )

    @_consistent
    def mean_and_error(self) -> tuple[mi.Float, mi.Float]:
        """Irradiance and its standard error at the active voxels, means over the channels (which
        share their samples: their errors add). The error is 0 before there are two batches.
        """
        means = [a + b for a, b in zip(self._means(0), self._means(1), strict=True)]
        variances = [self._variance(c) for c in range(self.channels)]
        errors = [mi.Float(0 if v is None else dr.sqrt(v)) for v in variances]
        return sum(means) / self.channels, sum(errors) / self.channels

    @property
    @_consistent
    def relative_error(self) -> float:
        """Root mean square of the voxels' standard errors, in units of the mean irradiance; NaN
        before there are two batches of samples. It falls as the root of the samples.
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
        """Whether all light is a number in single precision."""
        pairs = zip(self._means(0), self._means(1), strict=True)
        finite = [dr.all(dr.isfinite(a + b)) for a, b in pairs]
        dr.eval(finite)
        return all(f[0] for f in finite)

    def _variance(self, channel: int):
        """Squared standard error of the irradiance, None before there are two batches."""
        if self.samples < 2 * self.batch:
            return None
        n, spread = self._batch_count, self._spreads[channel]
        return self._zeros if spread is None else spread / (n * (n - 1))

    @_consistent
    def field(self) -> RootField:
        """Phi for lookups, without `direct_lights`, and over the `falloff` if there is one: one
        channel where all channels agree to the last bit. Its maximum is that of Phi, or more.
        """
        means = [a + b for a, b in zip(self._means(0), self._means(1), strict=True)]
        brightest = [dr.max(m)[0] for m in means] if self.direct_lights else []
        brightest += [light.maximum for light in self.direct_lights]
        for light in self.direct_lights:
            means = [dr.maximum(m - e, 0) for m, e in zip(means, light.irradiance, strict=False)]
        roots, variance = [dr.sqrt(m) for m in means], None
        if not self.correlated:  # neighbours that err alike do no harm to interpolation
            noise = [self._relative_variance(m, c) for c, m in enumerate(means)]
            roots = [r * root_correction(v) for r, v in zip(roots, noise, strict=True)]
        if all(dr.all(r == roots[0])[0] for r in roots[1:]):
            roots = roots[:1]
        channels = len(roots)
        if self.falloff is not None:
            smooth = dr.rsqrt(self.falloff.of_voxels(self.active))
            roots = [r * smooth for r in roots]
        values = self._tensor(roots).array
        if self.correlated:
            values = conserving(self.grid, values, marked(self.grid, self.active), channels)
        else:  # it would enlarge the noise by more than it is worth
            variance = self._tensor(noise[:channels]).array
        if self.voxel_classes is not None:
            values = self.voxel_classes.filled(values, channels)
        field = RootField(self.grid, values, channels, variance)
        if self.falloff is not None:
            field.maximum *= self.falloff.maximum(self.active)
        field.maximum = max(field.maximum, *brightest, 0.0)
        return field

    @_consistent
    def directional_field(self, channels: int) -> AngularField | None:
        """The moments for lookups, where there are any."""
        if not self.moments:
            return None
        n = mi.Float(self._batch_count)
        phi = [a + b for a, b in zip(self._means(0), self._means(1), strict=True)]
        means = [mi.Float(0) if m is None else m / n for m in self._moments]
        scattered = []
        for values in (phi, means):
            chosen = [v for i, v in enumerate(values) if i % self.channels < channels]
            scattered.append([self._tensor([v]).array for v in chosen])
        return AngularField(self.directional, self.grid, *scattered)

    def _relative_variance(self, mean: mi.Float, channel: int) -> mi.Float:
        """Variance of the voxels over their squared mean, at most 1; 0 where it is not known."""
        variance = self._variance(channel)
        if variance is None:
            return dr.zeros(mi.Float, dr.width(mean))
        # Not the quotient of squares: these vanish for light of 1e-19 and less.
        error = mi.Float(dr.sqrt(variance)) / dr.select(mean > 0, mean, 1)
        return dr.minimum(dr.square(error), 1)

    def _means(self, layer: int) -> list[mi.Float]:
        n, first = self._batch_count, layer * self.channels
        totals = self._totals[first : first + self.channels]
        return [mi.Float(self._zeros if t is None else t / n) for t in totals]

    @property
    def _zeros(self):
        """No light at the active voxels."""
        return dr.zeros(self.real, max(self.active_count, 1))

    @property
    def _batch_count(self):
        """Batches per voxel, at least 1; opaque, since it changes from pass to pass."""
        return dr.opaque(self.real, max(self.samples // self.batch, 1))

    def _tensor(self, values: list[mi.Float]) -> mi.TensorXf:
        count = len(values)
        flat = dr.zeros(mi.Float, self.grid.voxel_count * count)
        if self.active_count:
            for c, value in enumerate(values):
                dr.scatter(flat, value, self.active * count + c)
        return mi.TensorXf(flat, (*self.grid.shape, count))

    # ------------------------------------------------------------------ growing

    @_consistent
    def add(self, seed: int, samples: int, blocks: list[tuple]) -> None:
        """Adds ``samples`` per voxel of the stream ``seed``.

        For each block of voxels: the sums of batch means for each layer and channel, and for each
        channel the squared deviations of the batches' irradiance from their mean. None stands for 0
        in all blocks. Then the sums of batch means for each moment and channel, if there are any.
        """
        totals, spreads, *moments = (
            [concatenated(part) for part in zip(*parts, strict=True)]
            for parts in zip(*blocks, strict=True)
        )
        merged = self._merged(totals, spreads, samples // self.batch)
        moments = totals_of_pairs(self._moments, *moments) if moments else self._moments
        dr.eval(merged, moments)
        # An interrupt comes before or after this line, never between the two.
        self._totals, self._spreads, self._moments, self.streams = (
            *merged,
            moments,
            self._streams_with(seed, samples),
        )

    def _merged(self, totals: list, spreads: list, count: int) -> tuple[list, list]:
        """Sums and spreads with those of ``count`` more batches (Chan et al.)."""
        known = self.samples // self.batch
        result = []
        for c, spread in enumerate(spreads):
            old, new = (total(t[c :: self.channels]) for t in (self._totals, totals))
            if known and (old is not None or new is not None):
                n, more = (dr.opaque(self.real, k) for k in (known, count))
                apart = (0 if old is None else old / n) - (0 if new is None else new / more)
                spread = total([spread, dr.square(apart) * (n * more / (n + more))])
            result.append(total([self._spreads[c], spread]))
        return totals_of_pairs(self._totals, totals), result

    @_consistent
    def note_samples(self, seed: int, samples: int) -> None:
        """Counts samples whose contribution is already in (or exactly zero)."""
        self.streams = self._streams_with(seed, samples)

    def _streams_with(self, seed: int, samples: int) -> dict[int, int]:
        return self.streams | {seed: self.streams.get(seed, 0) + samples}

    def merge(self, other: IrradianceCache) -> None:
        """Adds the samples of ``other``, made with other seeds, perhaps elsewhere.

        Raises IrrcacheError if the two do not describe the same light, or share a seed.
        """
        for name in differing(self.fingerprint, other.fingerprint):
            raise IrrcacheError(
                f"IrradianceCache.merge: the caches belong to different scenes: {name} differs."
            )
        alike = ("max_depth", "channels", "batch", "correlated", "moments")
        if self.grid.shape != other.grid.shape or any(
            getattr(self, name) != getattr(other, name) for name in alike
        ):
            raise IrrcacheError(
                f"IrradianceCache.merge: shape {self.grid.shape} with max_depth {self.max_depth} "
                "does not fit "
                f"shape {other.grid.shape} with max_depth {other.max_depth}."
            )
        common = sorted(self.streams.keys() & other.streams.keys())
        if common:
            raise IrrcacheError(
                f"IrradianceCache.merge: both caches were made with cache_seed {common[0]}, so "
                "their samples are the "
                "same, not independent; make one of them with another cache_seed."
            )
        with other._lock:  # one after the other: two caches may be merged into each other
            totals, spreads, moments = other._totals, other._spreads, other._moments
            streams = other.streams
        with self._lock:
            count = sum(streams.values()) // other.batch
            self._totals, self._spreads = self._merged(totals, spreads, count)
            self._moments = totals_of_pairs(self._moments, moments)
            self.streams = self.streams | streams

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
        except Exception as error:  # whatever a damaged file makes of itself
            raise unreadable(path, error) from error

    @staticmethod
    def description_of(path: str | Path) -> tuple[dict[str, str], int]:
        """Fingerprint of a file and its samples per voxel, without its arrays; raises as `load`."""
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
            raise ValueError("it holds values that are not finite")
        if min(values.min(initial=0) for values in (totals, spreads)) < 0:
            raise ValueError("it holds light that is negative")
        streams, batch = samples_by_seed(description), int(description["batch"])
        smallest, largest = (1, LARGEST_BATCH) if correlated else (BATCH, BATCH)
        if not smallest <= batch <= largest or any(n % batch for n in streams.values()):
            raise ValueError(f"samples {streams} in batches of {batch}")
        batches = sum(streams.values()) // batch
        if (batches < 1 and totals.any()) or (batches < 2 and spreads.any()):
            raise ValueError(f"more light than {batches} batches of samples can have")
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
        """Writes ``irradiance`` as a Mitsuba ``.vol`` file (float32, bounding box of the grid; a
        rotation is lost).
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
