"""The irradiance cache: a camera-independent field with its statistics, kept, merged, saved and
loaded.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from threading import RLock
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .arithmetic import Divisor, unravelled
from .beams import Beam
from .conservation import conserving
from .directional import Directional, DirectionalField
from .errors import CacheFileError, IrrcacheError
from .files import atomic_write
from .fingerprint import differing
from .grid import Affine, Grid, RootField
from .lamps import Falloff
from .macrocells import Macrocells
from .survey import Survey
from .symbolic import symbolic

#: Samples of a voxel come in batches of this many, spread evenly over directions. They are not
#: independent of each other, the batches are: means and errors are statistics of batch means.
BATCH = 8

#: Share of active voxels below which they are told apart more closely, by cells of so many voxels
#: of the medium along an edge.
SPARSE, FINE = 0.3, 2

LAYERS = ("uncollided", "scattered")
FORMAT = "mitsuba_irrcache 6"
WITH_MOMENTS = "mitsuba_irrcache 7"  # of light by its direction
ARRAYS = ("active", "totals", "spreads")  # in a file, beside the description
#: What a file may say at most: samples of a stream, and of a batch.
MOST_SAMPLES, LARGEST_BATCH = 1 << 31, 1 << 16


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
    ) -> None:
        """``moments`` of the radiance are kept for each channel, where a medium is not isotropic;
        see `directional`. ``correlated``: whether all voxels share their samples, and so their
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
        #: what the moments are of
        self.directional: Directional | None = None
        #: how the light of lamps nearby falls off; None where there are none
        self.falloff: Falloff | None = None
        #: spot lights, whose irradiance camera rays look up apart; the layers hold its means
        self.beams: list[Beam] = []
        #: where voxels lie among surfaces; None where there are none
        self.survey: Survey | None = None
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

    def lie_like(self, other: IrradianceCache) -> None:
        """Takes over what is known of the place of ``other``, another cache of the same medium."""
        self.directional, self.survey = other.directional, other.survey
        self.falloff, self.beams = other.falloff, other.beams

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
        """Phi for lookups, without that of `beams`, and over the `falloff` if there is one: one
        channel where all channels agree to the last bit. Its maximum is that of Phi, or more.
        """
        means = [a + b for a, b in zip(self._means(0), self._means(1), strict=True)]
        brightest = [dr.max(m)[0] for m in means] if self.beams else []
        brightest += [beam.maximum for beam in self.beams]
        for beam in self.beams:
            means = [dr.maximum(m - e, 0) for m, e in zip(means, beam.irradiance, strict=False)]
        roots, variance = [dr.sqrt(m) for m in means], None
        if not self.correlated:  # neighbours that err alike do no harm to interpolation
            noise = [self._relative_variance(m, c) for c, m in enumerate(means)]
            roots = [r * _root_correction(v) for r, v in zip(roots, noise, strict=True)]
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
        if self.survey is not None:
            values = self.survey.filled(values, channels)
        field = RootField(self.grid, values, channels, variance)
        if self.falloff is not None:
            field.maximum *= self.falloff.maximum(self.active)
        field.maximum = max(field.maximum, *brightest, 0.0)
        return field

    @_consistent
    def directional_field(self, channels: int) -> DirectionalField | None:
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
        return DirectionalField(self.directional, self.grid, *scattered)

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
            [_joined(part) for part in zip(*parts, strict=True)]
            for parts in zip(*blocks, strict=True)
        )
        merged = self._merged(totals, spreads, samples // self.batch)
        moments = _sums(self._moments, *moments) if moments else self._moments
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
            old, new = (_sum(t[c :: self.channels]) for t in (self._totals, totals))
            if known and (old is not None or new is not None):
                n, more = (dr.opaque(self.real, k) for k in (known, count))
                apart = (0 if old is None else old / n) - (0 if new is None else new / more)
                spread = _sum([spread, dr.square(apart) * (n * more / (n + more))])
            result.append(_sum([self._spreads[c], spread]))
        return _sums(self._totals, totals), result

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
            self._moments = _sums(self._moments, moments)
            self.streams = self.streams | streams

    # ------------------------------------------------------------------ files

    @_consistent
    def save(self, path: str | Path) -> None:
        """Writes the cache with all its statistics; the file appears whole or not at all."""
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
            "fingerprint": self.fingerprint,
        }
        arrays = {
            "active": np.array(self.active),
            "totals": self._plain(self._totals),
            "spreads": self._plain(self._spreads),
            **({"moments": self._plain(self._moments, np.float32)} if self.moments else {}),
        }
        description["values"] = _digest_of_arrays(arrays)
        description["digest"] = _digest_of_description(description)
        encoded = np.frombuffer(json.dumps(description).encode(), dtype=np.uint8)
        with atomic_write(path) as file:
            np.savez(file, description=encoded, **arrays)

    def _plain(self, values: list, kind: type | None = None) -> np.ndarray:
        return np.array([np.array(self._zeros if v is None else v, kind) for v in values])

    @classmethod
    def load(cls, path: str | Path) -> IrradianceCache:
        """Reads a cache that ``save`` wrote. Raises CacheFileError, naming the file, for anything
        else.
        """
        path = Path(path)
        try:
            arrays = _read_arrays(path)
            description = json.loads(arrays["description"].tobytes())
            if description["format"] not in (FORMAT, WITH_MOMENTS):
                raise CacheFileError(
                    f'"{path}" has the format {description["format"]!r}, this version reads '
                    f"{FORMAT!r} and {WITH_MOMENTS!r}."
                )
            return cls._restore(description, arrays)
        except CacheFileError:
            raise
        except Exception as error:  # whatever a damaged file makes of itself
            raise _unreadable(path, error) from error

    @staticmethod
    def description_of(path: str | Path) -> tuple[dict[str, str], int]:
        """Fingerprint of a file and its samples per voxel, without its arrays; raises as `load`."""
        try:
            description = json.loads(_read_arrays(Path(path), ())["description"].tobytes())
            _check_digest(description)
            return dict(description["fingerprint"]), sum(_streams(description).values())
        except Exception as error:  # as in `load`
            raise _unreadable(path, error) from error

    @classmethod
    def _restore(cls, description: dict, arrays: dict[str, np.ndarray]) -> IrradianceCache:
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
        streams, batch = _streams(description), int(description["batch"])
        smallest, largest = (1, LARGEST_BATCH) if correlated else (BATCH, BATCH)
        if not smallest <= batch <= largest or any(n % batch for n in streams.values()):
            raise ValueError(f"samples {streams} in batches of {batch}")
        batches = sum(streams.values()) // batch
        if (batches < 1 and totals.any()) or (batches < 2 and spreads.any()):
            raise ValueError(f"more light than {batches} batches of samples can have")
        _check_digest(description)
        if _digest_of_arrays(arrays) != description["values"]:
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
        from .volumes.mitsuba_vol import write_vol

        corners = (
            self.grid.to_world
            @ np.array(
                [[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64
            ).T
        )
        write_vol(
            path, np.array(self.irradiance), (corners[:3].min(axis=1), corners[:3].max(axis=1))
        )


def _joined(pieces: tuple):
    """The values of all blocks, or None."""
    if pieces[0] is None:
        return None
    return dr.concat(list(pieces)) if len(pieces) > 1 else pieces[0]


def _sum(terms):
    """Of arrays, or None for 0."""
    known = [t for t in terms if t is not None]
    return sum(known[1:], known[0]) if known else None


def _sums(first: list, second: list) -> list:
    """Term by term."""
    return [_sum(pair) for pair in zip(first, second, strict=True)]


def marked(grid: Grid, voxels: mi.UInt32) -> mi.Bool:
    """Of all voxels of ``grid``, whether they are among ``voxels``."""
    marks = dr.zeros(mi.Bool, grid.voxel_count)
    if dr.width(voxels):
        dr.scatter(marks, mi.Bool(True), voxels)
    return marks


def _root_correction(variance: mi.Float) -> mi.Float:
    """Makes interpolated roots of noisy values right on average.

    With relative ``variance`` v of the voxels, E[(sum w_i sqrt(x_i))^2] = mu (1 - (1 - sum w_i^2) v
    / 4) to first order, and sum w_i^2 is (2/3)^3 on average over a cell. Without it 16 samples read
    some 1 % too little light.
    """
    return dr.rsqrt(1 - (1 - 8 / 27) / 4 * variance)


def _unreadable(path: str | Path, error: Exception) -> CacheFileError:
    return CacheFileError(
        f'"{path}" is not a readable irradiance cache ({error}); delete it or name another '
        "cache_file."
    )


def _streams(description: dict) -> dict[int, int]:
    """Samples by seed."""
    streams = {int(seed): int(n) for seed, n in description["streams"].items()}
    if any(seed < 0 or not 0 <= n <= MOST_SAMPLES for seed, n in streams.items()):
        raise ValueError(f"samples {streams}; a stream has 0 to {MOST_SAMPLES}")
    return streams


def _digest_of_arrays(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of the arrays of a file beside its description."""
    sha = hashlib.sha256()
    for name in sorted(arrays.keys() - {"description"}):
        values = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {values.dtype.str} {values.shape};".encode())
        sha.update(values.data)
    return sha.hexdigest()


def _digest_of_description(description: dict) -> str:
    """SHA-256 of all that a file says of itself."""
    said = {key: value for key, value in description.items() if key != "digest"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _check_digest(description: dict) -> None:
    if _digest_of_description(description) != description["digest"]:
        raise ValueError("its description is not the one that was saved")


def _read_arrays(path: Path, names: tuple[str, ...] = ARRAYS) -> dict[str, np.ndarray]:
    """The description and some arrays of an uncompressed npz: a file cannot claim more memory than
    it has bytes.
    """
    with zipfile.ZipFile(path) as archive:
        if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
            raise ValueError("it is compressed")
    with np.load(path, allow_pickle=False) as archive:
        if names:
            names = (*names, *({"moments"} & set(archive.files)))
        return {name: archive[name] for name in ("description", *names)}


def active_voxels(medium, grid: Grid) -> mi.UInt32:
    """Flat indices, ascending, of the voxels of ``grid`` that a lookup where ``sigma_t > 0`` can
    read.

    Every macrocell that is not empty marks the voxels whose trilinear support its box may overlap;
    where these are few, smaller cells mark still fewer.
    """
    cells = medium.macrocells
    occupied = dr.compress(cells.majorant > 0)
    if dr.width(occupied) == 0:
        return mi.UInt32()
    if cells.count == 1:
        return dr.arange(mi.UInt32, grid.voxel_count)
    marked = _mark(cells, occupied, grid)
    if dr.width(marked) < SPARSE * grid.voxel_count:
        cells = Macrocells.build(medium.sigma_t, medium.boundary, FINE)
        marked = _mark(cells, dr.compress(cells.majorant > 0), grid)
    return marked


def _supports(cells, occupied: mi.UInt32, grid: Grid) -> tuple[list[mi.Int32], list[mi.Int32]]:
    """First and last voxel along x, y, z whose trilinear support the box of each macrocell
    meets.
    """
    nz, ny, nx = cells.shape
    index = unravelled(occupied, [Divisor(nx), Divisor(ny)])
    to_voxels = grid.coordinates.matrix @ np.linalg.inv(cells.coordinates.matrix)
    # Border cells reach beyond their own grid, whose values are clamped: here as far as the cache.
    corners = np.array(list(np.ndindex(2, 2, 2))) * grid.resolution
    to_cells = np.linalg.inv(to_voxels)
    reach = corners @ to_cells[:3, :3].T + to_cells[:3, 3]
    start, end = np.minimum(0.0, reach.min(axis=0)), np.maximum((nx, ny, nz), reach.max(axis=0))
    middle, half = [], []
    for i, n, least, most in zip(index, (nx, ny, nz), start, end, strict=True):
        low = dr.select(i == 0, dr.opaque(mi.Float, float(least)), mi.Float(i))
        high = dr.select(i == n - 1, dr.opaque(mi.Float, float(most)), mi.Float(i) + 1)
        middle.append(0.5 * (low + high))
        half.append(0.5 * (high - low))
    center = Affine(to_voxels).point(mi.Point3f(middle))
    first, last = [], []
    for side, c, row in zip(grid.sides, center, np.abs(to_voxels[:3, :3]), strict=True):
        extent = sum(dr.opaque(mi.Float, float(m)) * h for m, h in zip(row, half, strict=True))
        limit = mi.Float(side - 1)
        # Voxel i is read from u in (i - 1/2, i + 3/2); border voxels also from beyond the grid.
        first.append(mi.Int32(dr.clip(dr.floor(c - extent - 0.5 - 1e-3), 0, limit)))
        last.append(mi.Int32(dr.clip(dr.floor(c + extent + 0.5 + 1e-3), 0, limit)))
    return first, last


@symbolic
def _mark(cells: Macrocells, occupied: mi.UInt32, grid: Grid) -> mi.UInt32:
    """The voxels that a lookup in the ``occupied`` cells can read."""
    (x0, y0, z0), (x1, y1, z1) = _supports(cells, occupied, grid)
    marks = dr.zeros(mi.UInt32, grid.voxel_count)
    x, y, z = mi.Int32(x0), mi.Int32(y0), mi.Int32(z0)
    active = mi.Bool(True)
    while dr.hint(active, label="active voxels"):
        dr.scatter(marks, mi.UInt32(1), grid.index(x, y, z), active)
        x += 1
        wrap_x = x > x1
        x = dr.select(wrap_x, x0, x)
        y = dr.select(wrap_x, y + 1, y)
        wrap_y = y > y1
        y = dr.select(wrap_y, y0, y)
        z = dr.select(wrap_y, z + 1, z)
        active &= z <= z1
    return dr.compress(marks > 0)
