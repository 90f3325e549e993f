"""File format of caches: an uncompressed npz with a description and digests."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path

import numpy as np

from mitsuba_irrcache.errors import CacheFileError

FORMAT = "mitsuba_irrcache 6"


WITH_MOMENTS = "mitsuba_irrcache 7"  # with angular moments of the radiance


ARRAYS = ("active", "totals", "spreads")  # arrays of a file in addition to the description


#: Upper limits for values read from a file: samples of a stream, and samples of a batch.
MAX_SAMPLES, MAX_BATCH = 1 << 31, 1 << 16


def unreadable(path: str | Path, error: Exception) -> CacheFileError:
    """Return the error for a file that is damaged or not a cache."""
    return CacheFileError(
        f'"{path}" is not a readable irradiance cache ({error}); delete it or name another '
        "cache_file."
    )


def samples_by_seed(description: dict) -> dict[int, int]:
    """Read and validate the number of samples of each seed."""
    streams = {int(seed): int(n) for seed, n in description["streams"].items()}
    if any(seed < 0 or not 0 <= n <= MAX_SAMPLES for seed, n in streams.items()):
        raise ValueError(f"samples {streams}; a stream has 0 to {MAX_SAMPLES}")
    return streams


def digest_of_arrays(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of all arrays of a file except its description."""
    sha = hashlib.sha256()
    for name in sorted(arrays.keys() - {"description"}):
        values = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {values.dtype.str} {values.shape};".encode())
        sha.update(values.data)
    return sha.hexdigest()


def digest_of_description(description: dict) -> str:
    """SHA-256 of the description except its digest."""
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
            names = (*names, *({"moments"} & set(archive.files)))
        return {name: archive[name] for name in ("description", *names)}
