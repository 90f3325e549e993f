"""Loops and conditions of Dr.Jit in Python's own words."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import wraps

import drjit as dr
import mitsuba as mi

from mitsuba_irrcache.errors import IrrcacheError


def symbolic(function: Callable) -> Callable:
    """``dr.syntax``, applied when the function is called for the first time.

    Each costs some milliseconds, and most programs call a few of the many that they import.
    ``dr.syntax`` reads the function's source from its file, by line numbers: in a file that was
    changed after it was imported, these are lines of something else. So that is an error.
    """
    transformed, file = None, function.__code__.co_filename
    imported = _modification_time(file)

    @wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        nonlocal transformed
        if transformed is None:
            if _modification_time(file) != imported:
                raise IrrcacheError(
                    f'irrcache: "{file}" was changed after it was imported; restart Python.'
                )
            transformed = dr.syntax(function)
        return transformed(*args, **kwargs)

    return call


def _modification_time(file: str) -> int | None:
    """When ``file`` was last changed [ns]; None where there is no such file."""
    try:
        return os.stat(file).st_mtime_ns
    except OSError:
        return None


class Divisor:
    """A ``number`` from 1 to 2^32 - 1 that divides any UInt32. Another number is the same
    kernel.

    There is no division of integer vectors: it is done one by one, and took most of the time of
    kernels that lay volumes out anew. A product and two shifts do the same (Granlund and
    Montgomery, *Division by invariant integers using multiplication*, 1994).
    """

    def __init__(self, number: int) -> None:
        bits = (number - 1).bit_length()
        self._number = dr.opaque(mi.UInt32, number)
        self._factor = dr.opaque(mi.UInt32, (((1 << bits) - number) << 32) // number + 1)
        self._shifts = [dr.opaque(mi.UInt32, n) for n in (min(bits, 1), max(bits - 1, 0))]

    def split(self, index: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Quotient and rest."""
        product = dr.mul_hi(index, self._factor)
        quotient = (((index - product) >> self._shifts[0]) + product) >> self._shifts[1]
        return quotient, index - quotient * self._number


def unravelled(index: mi.UInt32, sides: Sequence[Divisor]) -> tuple[mi.UInt32, ...]:
    """Places along all axes, the fastest first, of flat indices; ``sides`` are those of all axes
    but the last, which may have any.
    """
    places = []
    for side in sides:
        index, place = side.split(index)
        places.append(place)
    return (*places, index)
