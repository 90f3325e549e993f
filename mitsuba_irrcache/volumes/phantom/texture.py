"""Correlated random texture as a function of position, equal at all resolutions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Lattice spacings in mm of the interpolated random values that are summed, and their weights.
OCTAVES = ((9.0, 0.7), (3.0, 0.7))


def texture(
    coordinates: Sequence[np.ndarray],
    lower: Sequence[float],
    upper: Sequence[float],
    seed: int = 2015,
) -> np.ndarray:
    """Return a texture (z, y, x), float32, with mean 0 and a standard deviation of about 1/2.

    ``coordinates`` are the grid's x, y and z in mm, within the box from ``lower`` to ``upper``. The
    texture depends on this box and on ``seed`` only. Only uniform deviates of a fixed bit generator
    are drawn, whose stream NumPy guarantees.
    """
    generator = np.random.Generator(np.random.PCG64(seed))
    total = np.zeros([axis.size for axis in coordinates[::-1]], dtype=np.float32)
    for pitch, weight in OCTAVES:
        counts = [int(np.ceil((h - lo) / pitch)) + 1 for lo, h in zip(lower, upper, strict=True)]
        lattice = generator.random(counts[::-1], dtype=np.float32)
        # sqrt(12) is the inverse standard deviation of a uniform deviate; interpolation halves it.
        lattice = (lattice - 0.5) * np.float32(weight * 12**0.5)
        for axis, (coordinate, low) in enumerate(zip(coordinates, lower, strict=True)):
            lattice = interpolate(lattice, (coordinate - low) / pitch, 2 - axis)
        total += lattice
    return total


def interpolate(lattice: np.ndarray, position: np.ndarray, axis: int) -> np.ndarray:
    """Interpolate linearly along one axis at fractional indices ``position``."""
    index = np.clip(np.floor(position).astype(np.intp), 0, lattice.shape[axis] - 2)
    shape = [1, 1, 1]
    shape[axis] = position.size
    weight = (position - index).astype(np.float32).reshape(shape)
    low = np.take(lattice, index, axis=axis)
    high = np.take(lattice, index + 1, axis=axis)
    high -= low
    high *= weight
    low += high
    return low
