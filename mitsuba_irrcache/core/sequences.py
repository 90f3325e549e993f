"""Random streams and low-discrepancy point sets, one function for each kind.

Random numbers come from PCG32 generators (O'Neill 2014) whose state is a hash of integers by the
Tiny Encryption Algorithm (Zafar, Olano and Curtis 2010), so that lanes and batches are independent
of each other and every value can be computed again.

Low-discrepancy points are Kronecker sequences: multiples, modulo 1, of the powers of the inverse
of the generalised golden ratio, the positive root of x^(d+1) = x + 1 in d dimensions (Roberts 2018,
"The unreasonable effectiveness of quasirandom sequences"). With a random shift (Cranley and
Patterson 1976) each point alone is uniformly distributed.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

#: The root of x^(d+1) = x + 1 for each dimension d.
GENERALISED_GOLDEN_RATIOS = {
    1: (1 + 5**0.5) / 2,
    2: 1.324717957244746,
    3: 1.2207440846057596,
    4: 1.1673039782614187,
}
#: One over the golden ratio.
GOLDEN_STEP = (5**0.5 - 1) / 2
#: Angle between successive points of a Fibonacci spiral on the sphere.
GOLDEN_ANGLE = 2.399963229728653


# Random streams


def hashed_seed(seed: tuple[int, int]) -> tuple[mi.UInt32, mi.UInt32]:
    """Return two random words that depend on a pair of integers.

    Kernels do not depend on the integers.
    """
    first, second = (dr.opaque(mi.UInt32, s) for s in seed)
    return mi.sample_tea_32(first, second)


def random_stream(
    words: tuple[mi.UInt32, mi.UInt32], sequence: mi.UInt32 | int | None = None
) -> mi.PCG32:
    """Return a generator that is initialised by two random words, in each lane.

    Without a ``sequence`` number, the words are its state and its sequence number; otherwise both
    form its state.
    """
    first, second = words
    if sequence is None:
        return mi.PCG32(initstate=mi.UInt64(first), initseq=mi.UInt64(second))
    return mi.PCG32(
        initstate=mi.UInt64(first) << 32 | mi.UInt64(second), initseq=mi.UInt64(sequence)
    )


# Kronecker sequences


def kronecker_steps(dimension: int) -> tuple[float, ...]:
    """Return the increment of each coordinate of the sequence, modulo 1."""
    ratio = GENERALISED_GOLDEN_RATIOS[dimension]
    return tuple(ratio ** -(k + 1) % 1.0 for k in range(dimension))


def kronecker(
    index: mi.UInt32, dimension: int, shift: Sequence[mi.Float] | None = None
) -> list[mi.Float]:
    """Return the coordinates in [0, 1) of point ``index`` of the sequence, shifted modulo 1."""
    values = [mi.Float(index) * step for step in kronecker_steps(dimension)]
    if shift is not None:
        values = [value + s for value, s in zip(values, shift, strict=True)]
    return [value - dr.floor(value) for value in values]


def kronecker_words(index: mi.UInt32, shift: Sequence[mi.UInt32]) -> list[mi.UInt32]:
    """Return the coordinates of point ``index`` of the sequence, times 2^32.

    There is one coordinate for each ``shift``, which is added modulo 2^32. Unlike single precision,
    integers are exact for any index.
    """
    steps = kronecker_steps(len(shift))
    return [
        s + index * mi.UInt32(round(step * 2**32)) for s, step in zip(shift, steps, strict=True)
    ]


def unit_floats(words: Sequence[mi.UInt32]) -> list[mi.Float]:
    """Convert the upper 24 bits of each word to a number in [0, 1)."""
    return [mi.Float(word >> 8) * 2.0**-24 for word in words]


def golden_words(index: mi.UInt32, shift: int = 0) -> mi.UInt32:
    """Return ``index`` over the golden ratio, modulo 1, times 2^32, plus ``shift``."""
    return index * mi.UInt32(int(GOLDEN_STEP * 2**32)) + mi.UInt32(shift)


def kronecker_points(index: np.ndarray, dimension: int) -> np.ndarray:
    """Return the points (dimension, n) of the sequence with these indices (n), float64."""
    return np.array([index * step % 1 for step in kronecker_steps(dimension)])


# Finite point sets


def lattice_points(count: int, step: float) -> np.ndarray:
    """Return a rank-1 lattice (2, count) in the unit square: ((i + 1/2) / count, i step mod 1)."""
    index = np.arange(count)
    return np.stack([(index + 0.5) / count, index * step % 1])


def fibonacci_hemisphere(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (count, 3) of a Fibonacci spiral on the upper unit hemisphere.

    The second result is their azimuths (count), in turns.
    """
    index = np.arange(count)
    z, turn = 1 - (index + 0.5) / count, index / GENERALISED_GOLDEN_RATIOS[1] % 1
    radius, angle = np.sqrt(1 - z * z), 2 * np.pi * turn
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1), turn


def fibonacci_direction(index: mi.UInt32, count: int, azimuth: float = 0.0) -> mi.Vector3f:
    """Return point ``index`` of a Fibonacci spiral of ``count`` points on the unit sphere.

    ``azimuth`` is that of point 0 [radians].
    """
    z = (mi.Float(index) + 0.5) * (2 / count) - 1
    radius = dr.sqrt(1 - z * z)
    sine, cosine = dr.sincos(mi.Float(index) * GOLDEN_ANGLE + azimuth)
    return mi.Vector3f(radius * cosine, radius * sine, z)
