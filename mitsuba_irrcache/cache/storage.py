"""File format of caches: an uncompressed npz with a JSON description and SHA-256 digests."""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitsuba_irrcache.cache.statistics import BATCH, ORDER_GROUPS, BatchSums
from mitsuba_irrcache.errors import CacheFileError, reason
from mitsuba_irrcache.grids.grid import Grid
from mitsuba_irrcache.io.files import atomic_write

#: The number changes when files of earlier versions would be read wrongly: before 10, variances of
#: what is sampled for each voxel alone were those of the mean over the channels.
FORMAT = "mitsuba_irrcache 10"
WITH_MOMENTS = "mitsuba_irrcache 11"  # with angular moments of the radiance
ARRAYS = ("active", "totals", "spreads")  # arrays of a file in addition to the description


#: Upper limits for values read from a file: samples of a stream, and samples of a batch.
MAX_SAMPLES, MAX_BATCH = 1 << 31, 1 << 16


@dataclass(frozen=True)
class StoredCache:
    """Contents of a file; see `IrradianceCache`, and for the sums `BatchSums`."""

    grid: Grid
    active: mi.UInt32
    max_depth: int
    fingerprint: dict[str, str]
    sums: BatchSums


def write_cache(path: str | Path, stored: StoredCache) -> None:
    """Write a cache with all its statistics, atomically: a failure leaves no partial file."""
    sums, grid = stored.sums, stored.grid
    moments, own = sums.moment_count, any(v is not None for v in sums.own_spreads)
    description = {
        "format": WITH_MOMENTS if moments else FORMAT,
        "shape": grid.shape,
        "to_world": grid.to_world.tolist(),
        "channels": sums.channels,
        "batch": sums.batch,
        "correlated": sums.is_correlated,
        **({"moments": moments} if moments else {}),
        "max_depth": stored.max_depth,
        "streams": {str(seed): n for seed, n in sums.streams.items()},
        "fingerprint": stored.fingerprint,
    }

    def plain(values: list, kind: type | None = None) -> np.ndarray:
        return np.array([np.array(sums.zeros if v is None else v, kind) for v in values])

    arrays = {
        "active": np.array(stored.active),
        "totals": plain(sums.totals),
        "spreads": plain(sums.spreads),
        **({"moments": plain(sums.moments, np.float32)} if moments else {}),
        **({"own_spreads": plain(sums.own_spreads, np.float32)} if own else {}),
    }
    description["values"] = digest_of_arrays(arrays)
    description["digest"] = digest_of_description(description)
    encoded = np.frombuffer(json.dumps(description).encode(), dtype=np.uint8)
    with atomic_write(path) as file:
        np.savez(file, description=encoded, **arrays)


def read_cache(path: str | Path) -> StoredCache:
    """Read what `write_cache` wrote. Raises CacheFileError, naming the file, for anything else."""
    path = Path(path)
    try:
        arrays = read_arrays(path)
        description = json.loads(arrays["description"].tobytes())
        if description["format"] not in (FORMAT, WITH_MOMENTS):
            raise CacheFileError(
                f'"{path}" has the format {description["format"]!r}, this version reads '
                f"{FORMAT!r} and {WITH_MOMENTS!r}."
            )
        return _restored(description, arrays)
    except CacheFileError:
        raise
    except Exception as error:  # a damaged file may cause any exception
        raise unreadable(path, error) from error


def read_description(path: str | Path) -> tuple[dict[str, str], int]:
    """Return the fingerprint of a file and its samples per voxel, without reading the arrays.

    Raises the same errors as `read_cache`.
    """
    try:
        description = json.loads(read_arrays(Path(path), ())["description"].tobytes())
        check_digest(description)
        return dict(description["fingerprint"]), sum(samples_by_seed(description).values())
    except Exception as error:  # as in `read_cache`
        raise unreadable(path, error) from error


def _restored(description: dict, arrays: dict[str, np.ndarray]) -> StoredCache:
    """Check the contents of a file; raise any exception if they are not those of a cache."""
    grid = Grid(tuple(int(n) for n in description["shape"]), np.array(description["to_world"]))
    active, totals, spreads = (arrays[name] for name in ARRAYS)
    _check_active(active, grid.voxel_count)
    channels, correlated = int(description["channels"]), bool(description["correlated"])
    width, count = max(active.size, 1), int(description.get("moments", 0))
    moments = arrays["moments"] if count else np.zeros((0, width), np.float32)
    _check_sums(totals, spreads, (channels, width), np.float32 if correlated else np.float64)
    _check_moments(moments, (count * channels, width))
    own = arrays.get("own_spreads", np.zeros((channels, width), np.float32))
    if (own.shape, own.dtype) != ((channels, width), np.float32):
        raise ValueError(f"own_spreads of shape {own.shape} and type {own.dtype}")
    _check_values((totals, spreads, own), moments)
    streams, batch = samples_by_seed(description), int(description["batch"])
    smallest, largest = (1, MAX_BATCH) if correlated else (BATCH, BATCH)
    if not smallest <= batch <= largest or any(n % batch for n in streams.values()):
        raise ValueError(f"samples {streams} in batches of {batch}")
    batches = sum(streams.values()) // batch
    any_sums = totals.any() or own.any()
    if (batches < 1 and any_sums) or (batches < 2 and spreads.any()):
        raise ValueError(f"non-zero sums, but only {batches} batches of samples")
    check_digest(description)
    if digest_of_arrays(arrays) != description["values"]:
        raise ValueError("its values are not those that were saved")
    sums = BatchSums(active.size, channels, batch, count, correlated)
    real = sums.real
    kinds = (totals, real), (spreads, real), (moments, mi.Float), (own, mi.Float)
    sums = sums.filled(streams, *(_known(values, kind) for values, kind in kinds))
    max_depth, fingerprint = int(description["max_depth"]), dict(description["fingerprint"])
    return StoredCache(grid, mi.UInt32(active), max_depth, fingerprint, sums)


def _known(values: np.ndarray, kind: type) -> list:
    """Return rows as Dr.Jit arrays, None for rows of zeros."""
    return [kind(row) if row.any() else None for row in values]


def _check_active(active: np.ndarray, voxels: int) -> None:
    if active.dtype != np.uint32 or active.ndim != 1 or active.size > voxels:
        raise ValueError("its list of voxels does not fit its grid")
    if active.size and (int(active[-1]) >= voxels or (np.diff(active.astype(np.int64)) <= 0).any()):
        raise ValueError("its list of voxels is out of order")


def _check_sums(
    totals: np.ndarray, spreads: np.ndarray, shape: tuple[int, int], real: type
) -> None:
    channels, width = shape
    expected = (len(ORDER_GROUPS) * channels, width), shape
    if channels not in (1, 3) or (totals.shape, spreads.shape) != expected:
        raise ValueError(f"sums of shape {totals.shape} where {expected[0]} is expected")
    if totals.dtype != real or spreads.dtype != real:
        raise ValueError(f"sums of type {totals.dtype}")


def _check_moments(moments: np.ndarray, shape: tuple[int, int]) -> None:
    if (moments.shape, moments.dtype) != (shape, np.float32):
        raise ValueError(f"moments of shape {moments.shape} and type {moments.dtype}")


def _check_values(sums: tuple[np.ndarray, ...], moments: np.ndarray) -> None:
    largest = np.max([np.abs(v).max(initial=0) for v in (*sums, moments)])
    if not largest < float(np.finfo(np.float32).max):  # NaN too
        raise ValueError("it contains values that are not finite")
    if min(values.min(initial=0) for values in sums) < 0:
        raise ValueError("it contains negative values")


def unreadable(path: str | Path, error: Exception) -> CacheFileError:
    """Return the error for a file that is damaged, or no cache, which nobody is told to delete."""
    try:
        with open(path, "rb") as file:
            may_be_one = file.read(2) in (b"PK", b"")  # an archive of arrays, or cut to nothing
    except OSError:
        may_be_one = False
    remedy = "delete it if it is a damaged one, or name" if may_be_one else "name"
    return CacheFileError(
        f'"{path}" is not a readable irradiance cache ({reason(error)}); {remedy} another '
        "cache_file."
    )


def samples_by_seed(description: dict) -> dict[int, int]:
    """Read and validate the number of samples of each seed."""
    streams = {int(seed): int(n) for seed, n in description["streams"].items()}
    if any(seed < 0 or not 0 <= n <= MAX_SAMPLES for seed, n in streams.items()):
        raise ValueError(f"samples {streams}; a stream has 0 to {MAX_SAMPLES}")
    return streams


def digest_of_arrays(arrays: dict[str, np.ndarray]) -> str:
    """Return the SHA-256 of all arrays of a file except its description."""
    sha = hashlib.sha256()
    for name in sorted(arrays.keys() - {"description"}):
        values = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {values.dtype.str} {values.shape};".encode())
        sha.update(values.data)
    return sha.hexdigest()


def digest_of_description(description: dict) -> str:
    """Return the SHA-256 of the description without its digest."""
    said = {key: value for key, value in description.items() if key != "digest"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def check_digest(description: dict) -> None:
    """Raise ValueError if the description does not match its digest."""
    if digest_of_description(description) != description["digest"]:
        raise ValueError("its description is not the one that was saved")


def read_arrays(path: Path, names: tuple[str, ...] = ARRAYS) -> dict[str, np.ndarray]:
    """Read the description and the named arrays of an npz.

    Compressed files are rejected: the memory a file can claim is then limited by its size.
    """
    with zipfile.ZipFile(path) as archive:
        if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
            raise ValueError("it is compressed")
    with np.load(path, allow_pickle=False) as archive:
        if names:
            names = (*names, *sorted({"moments", "own_spreads"} & set(archive.files)))
        return {name: archive[name] for name in ("description", *names)}
